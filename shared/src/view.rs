//! What a viewer gets besides packets: the text hello, and the JSON form of frames for scripts and people.

use crate::character::Character;
use crate::face::FaceFrame;
use crate::names::ARKIT_NAMES;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Version of the protocol; stands in both hellos and in the subprotocol's name.
pub const PROTOCOL_VERSION: u32 = 1;
/// The WebSocket subprotocol.
pub const SUBPROTOCOL: &str = "rhytid.v1";
/// Offered besides [`SUBPROTOCOL`] with a token behind it, where a browser cannot set a header; never chosen by the server.
pub const TOKEN_PROTOCOL: &str = "rhytid.token.";

/// A text message to a viewer.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "type", rename_all = "snake_case")]
pub enum ViewMessage {
    /// The first message.
    Hello(ViewHello),
    /// A frame, where the viewer asked for `?format=json`.
    Frame(JsonFrame),
    /// Why the server closes the socket; sent before it does.
    Error {
        /// Short and stable, for programs.
        code: String,
        /// For people.
        message: String,
    },
}

/// The first message on a view socket.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ViewHello {
    /// [`PROTOCOL_VERSION`].
    pub version: u32,
    /// The room that is watched.
    pub room: String,
    /// The character that is moved.
    pub character: CharacterHello,
}

/// What a viewer must know of the character to read packets and to recompute influences.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CharacterHello {
    /// Shown to people.
    pub name: String,
    /// Path of the `.glb` on the same server.
    pub url: String,
    /// SHA-256 of the `.glb`, lower-case hex.
    pub sha256: String,
    /// The `n` bones, in the order of packets.
    pub bones: Vec<BoneHello>,
    /// The `o` reference poses.
    pub poses: Vec<PoseHello>,
    /// Names of bones whose influences are averaged.
    pub groups: Vec<Vec<String>>,
    /// Names of wrinkle zones.
    #[serde(default)]
    pub zones: Vec<String>,
    /// Expression shapes the mesh has, by ARKit name.
    #[serde(default)]
    pub shapes: Vec<String>,
}

/// A bone, as a viewer learns it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct BoneHello {
    /// Unique name.
    pub name: String,
    /// Rest position of the evaluated point, metres, head space.
    pub rest: [f32; 3],
    /// Where the bone turns by itself: the point it turns about, metres, head space. Its evaluated point is then
    /// `pivot + R * (rest - pivot)`, and packets carry only `R`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pivot: Option<[f32; 3]>,
    /// Name of the turning bone whose rotation this one copies.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub turns_with: Option<String>,
}

/// A reference pose, as a viewer learns it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PoseHello {
    /// Unique name.
    pub name: String,
    /// Where the pose puts evaluated points, metres, head space; bones not named stay at rest.
    pub bones: BTreeMap<String, [f32; 3]>,
}

/// A frame as JSON.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct JsonFrame {
    /// Counts the publishers the room has had, from 1.
    pub session: u32,
    /// Counts the frames of the session, from 0.
    pub seq: u32,
    /// The sender's clock at capture, seconds.
    pub t: f64,
    /// False while the tracker sees no face.
    pub face: bool,
    /// `n` evaluated points, metres, head space, in the order of the hello.
    pub bones: Vec<[f32; 3]>,
    /// Rotations `[x, y, z, w]` of the bones that turn, by name.
    pub rotations: BTreeMap<String, [f32; 4]>,
    /// `o` rows of `n` influences in `[0, 1]`.
    pub influence: Vec<Vec<f32>>,
    /// Zone weights in `[0, 1]`, in the order of the hello.
    pub zones: Vec<f32>,
    /// How far each zone is stretched, in `[0, 1]`, where its sum is below 0.
    #[serde(default)]
    pub stretched: Vec<f32>,
    /// Expression weights in `[0, 1]` by ARKit name; empty where the feed carries none.
    pub shapes: BTreeMap<String, f32>,
    /// Head pose.
    pub head: JsonHead,
}

/// The head pose of a [`JsonFrame`].
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct JsonHead {
    /// Unit quaternion `[x, y, z, w]`.
    pub rotation: [f32; 4],
    /// Metres from the calibrated neutral.
    pub position: [f32; 3],
}

impl ViewHello {
    /// The hello for a viewer of `room`, whose character stands at `url`.
    pub fn new(room: &str, character: &Character, url: String) -> Self {
        let bones = &character.bones;
        let name_of = |&bone: &usize| bones[bone].name.clone();
        Self {
            version: PROTOCOL_VERSION,
            room: room.to_owned(),
            character: CharacterHello {
                name: character.name.clone(),
                url,
                sha256: character.sha256.clone(),
                bones: bones
                    .iter()
                    .map(|bone| BoneHello {
                        name: bone.name.clone(),
                        rest: bone.rest.to_array(),
                        pivot: bone.pivot().map(|pivot| pivot.to_array()),
                        turns_with: bone.turns_with.as_ref().map(name_of),
                    })
                    .collect(),
                poses: character
                    .poses
                    .iter()
                    .map(|pose| PoseHello {
                        name: pose.name.clone(),
                        bones: bones
                            .iter()
                            .zip(&pose.points)
                            .filter(|(bone, point)| bone.rest != **point)
                            .map(|(bone, point)| (bone.name.clone(), point.to_array()))
                            .collect(),
                    })
                    .collect(),
                groups: character.groups.iter().map(|group| group.iter().map(name_of).collect()).collect(),
                zones: character.zones.iter().flat_map(|zones| &zones.list).map(|zone| zone.name.clone()).collect(),
                shapes: character.shapes.iter().map(|shape| shape.shape.name().to_owned()).collect(),
            },
        }
    }
}

impl JsonFrame {
    /// `frame` with the names of `hello`.
    pub fn new(frame: &FaceFrame, hello: &CharacterHello) -> Self {
        let num_bones = hello.bones.len().max(1);
        Self {
            session: frame.session,
            seq: frame.seq,
            t: frame.captured_at_micros as f64 / 1e6,
            face: frame.face,
            bones: frame.points.iter().map(|point| point.to_array()).collect(),
            rotations: hello
                .bones
                .iter()
                .zip(&frame.rotations)
                .filter(|(bone, _)| bone.pivot.is_some() || bone.turns_with.is_some())
                .map(|(bone, rotation)| (bone.name.clone(), rotation.to_array()))
                .collect(),
            influence: frame.influences.chunks(num_bones).map(<[f32]>::to_vec).collect(),
            zones: frame.zones.clone(),
            stretched: frame.stretched.clone(),
            shapes: frame
                .shapes
                .iter()
                .flat_map(|weights| ARKIT_NAMES.iter().zip(weights))
                .map(|(name, weight)| ((*name).to_owned(), *weight))
                .collect(),
            head: JsonHead { rotation: frame.head.rotation.to_array(), position: frame.head.position.to_array() },
        }
    }
}
