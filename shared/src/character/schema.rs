//! The root extension `RHYTID_face` of a character's `.glb`, as JSON. Positions are metres in head space: the glTF
//! scene's own frame (right-handed, +Y up, +Z out of the face, +X to the character's left) with the head at neutral.

use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Name of the extension; stands in `extensionsUsed`, never in `extensionsRequired`.
pub const EXTENSION: &str = "RHYTID_face";
/// Version of the extension this code reads and writes.
pub const VERSION: u32 = 1;

/// The extension.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Face {
    /// [`VERSION`].
    pub version: u32,
    /// Shown to people.
    pub name: String,
    /// Name of the node (a joint of the skin) that carries the head; its origin is the point about which the head
    /// turns. Joints below it move with the head, all others stay.
    pub head: String,
    /// Landmarks on the neutral mesh by layout; `ibug68` is required.
    pub landmarks: BTreeMap<String, Vec<[f32; 3]>>,
    /// Feature points by name that a sender's own layout may use, besides the bones' names.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub features: BTreeMap<String, [f32; 3]>,
    /// Bones whose poses are evaluated, in the order of packets.
    pub bones: Vec<Bone>,
    /// Bones whose influences are averaged, by name ([D09] 5.2).
    #[serde(default)]
    pub groups: Vec<Vec<String>>,
    /// Reference poses ([D09] 4).
    pub poses: Vec<Pose>,
    /// Authored combinations of expression weights and where they put bones.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub correctives: Vec<Corrective>,
    /// Wrinkle zones ([J11]).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub zones: Option<Zones>,
    /// How influences are computed.
    #[serde(default)]
    pub evaluation: Evaluation,
}

/// A bone.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Bone {
    /// Unique name; also the joint's node name unless `joint` says otherwise.
    pub name: String,
    /// Node name of the joint, where it differs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub joint: Option<String>,
    /// Where the evaluated point is at rest; for bones that turn, the driver point carried by the rotation.
    pub point: [f32; 3],
    /// What moves it.
    pub drive: Drive,
    /// Multiplies the retargeted displacement (or angle: its first component), per axis.
    #[serde(default = "one", skip_serializing_if = "is_one")]
    pub gain: [f32; 3],
    /// Name of a turning bone whose rotation this one copies about its own point (lower lip and chin turn with the jaw).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub turns_with: Option<String>,
}

/// What moves a bone.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "type", rename_all = "snake_case")]
pub enum Drive {
    /// Translates by the weighted displacements of landmarks after retargeting.
    Skin {
        /// `[ibug68 index, weight]`, weight in (0, 2].
        landmarks: Vec<(usize, f32)>,
    },
    /// Turns about `pivot` so that the driver point follows the landmarks (the chin).
    Jaw {
        /// Centre of the hinge.
        pivot: [f32; 3],
        /// As for `skin`.
        landmarks: Vec<(usize, f32)>,
        /// Widest opening, degrees.
        max_degrees: f32,
    },
    /// Turns about `pivot` by the openness of one eye.
    Lid {
        /// Which eye.
        eye: Side,
        /// Which lid.
        lid: LidKind,
        /// Centre of the eyeball.
        pivot: [f32; 3],
        /// Rotation about +X that shuts the eye, degrees (positive turns the front of the eye downward).
        shut_degrees: f32,
        /// Rotation about +X at the widest, degrees.
        wide_degrees: f32,
    },
    /// Turns about `pivot` by gaze.
    Eye {
        /// Which eye.
        eye: Side,
        /// Centre of the eyeball.
        pivot: [f32; 3],
        /// Largest gaze angle to the side and up or down, degrees.
        range_degrees: [f32; 2],
    },
    /// Moved by nothing but `bones` frames.
    Still,
}

/// The character's own left or right.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Side {
    /// The character's left, +X.
    Left,
    /// The character's right, -X.
    Right,
}

/// Upper or lower lid.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LidKind {
    /// Upper lid.
    Upper,
    /// Lower lid.
    Lower,
}

/// A reference pose.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Pose {
    /// Unique name.
    pub name: String,
    /// Where the pose puts evaluated points; bones not named stay at rest.
    pub bones: BTreeMap<String, [f32; 3]>,
    /// The wrinkles of this pose.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub map: Option<WrinkleMap>,
}

/// A wrinkle map: partial derivatives (`p = n.xy / n.z`) as `(code - 128) / 127 * scale` in red and green.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct WrinkleMap {
    /// Index into glTF `textures`; all maps of a character have the same size.
    pub texture: usize,
    /// Largest slope the codes reach.
    pub scale: f32,
    /// True where the map also contains the pores of the neutral map ([D09] 5.3, first case).
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub contains_neutral: bool,
}

/// An example for the correctives on expression weights.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Corrective {
    /// Expression weights of the example by ARKit name.
    pub weights: BTreeMap<String, f32>,
    /// Displacements from rest the named bones shall have there, metres.
    pub bones: BTreeMap<String, [f32; 3]>,
}

/// Wrinkle zones ([J11]: Jimenez, Echevarria, Oat, Gutierrez 2011): one wrinkle map for the whole face, and masks that say
/// which zone each place belongs to. A zone shows with `sum over expressions of amount * weight`, clamped once to `[0, 1]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Zones {
    /// Up to 8 zones, in the order of the masks' channels: the first four are red, green, blue and alpha of the first mask.
    pub list: Vec<Zone>,
    /// Indices into glTF `textures`, one for every four zones begun: squares of 4 to 256 texels (64 in the paper), PNG, linear.
    /// No texel's channels sum to more than 1 over all zones.
    pub masks: Vec<usize>,
    /// The wrinkles of all zones.
    pub map: ZoneMap,
    /// What takes the creases out of the neutral face where a zone's sum is below 0 (Oat 2007): added times `-sum`, clamped
    /// to `[0, 1]`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stretch: Option<ZoneMap>,
    /// The same wrinkles as differences of unit normals, `wrinkled - neutral` as `(code - 128) / 127` in red, green and blue
    /// ([J11] 1.2.1): index into glTF `textures`. Only where a viewer is asked for them.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub difference: Option<usize>,
    /// Distance from one wrinkle to the next, metres: where it covers less than a few pixels the wrinkles fade.
    #[serde(default = "wrinkle_wavelength")]
    pub wavelength: f32,
    /// How each expression weighs on each zone ([J11] Table 1.1). What a tracker's weights say about `joy`, `surprise`, `fear`,
    /// `anger`, `disgust` and `sad` is known; other names show only where a publisher sends them.
    #[serde(default)]
    pub expressions: Vec<Expression>,
    /// How the influences of reference poses weigh on zones where a frame has neither expressions nor expression weights.
    #[serde(default)]
    pub bridge: Vec<BridgeRow>,
}

/// A wrinkle zone.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Zone {
    /// Unique name; the paper calls its zones by colours.
    pub name: String,
    /// The half of the face it lies on; none for one in the middle, which follows the mean of both.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub side: Option<Side>,
}

/// Partial derivatives (`p = n.xy / n.z`) as `(code - 128) / 127 * scale` in red and green; a square of up to 1,024 texels with
/// a power of two a side (256 in the paper), the same for all maps of the zones.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ZoneMap {
    /// Index into glTF `textures`.
    pub texture: usize,
    /// Largest slope the codes reach.
    pub scale: f32,
}

/// A row of the expression table.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Expression {
    /// Unique name.
    pub name: String,
    /// One weight a zone, within ±2. Negative ones take back what other expressions ask for.
    pub weights: Vec<f32>,
}

/// A share of a pose's influence at a bone in a zone.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct BridgeRow {
    /// Name of the reference pose.
    pub pose: String,
    /// Name of the bone.
    pub bone: String,
    /// Name of the zone.
    pub zone: String,
    /// What influence 1 adds to the zone's sum, within ±2.
    pub gain: f32,
}

/// How influences are computed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Evaluation {
    /// Projection of each pose alone, or all together.
    pub mode: Mode,
    /// What a group member does that a pose does not move.
    pub group_degenerate: GroupDegenerate,
    /// Weight from which wrinkles stop fading with the skinning weights, in (0, 1]; 1 is [D09].
    pub falloff: f32,
}

impl Default for Evaluation {
    fn default() -> Self {
        Self { mode: Mode::Independent, group_degenerate: GroupDegenerate::Exclude, falloff: 1.0 }
    }
}

/// How several poses on one bone share its displacement.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Mode {
    /// [D09] 5.1: each pose by its own projection.
    Independent,
    /// Non-negative least squares over all poses.
    Joint,
}

/// What a group member does that a pose does not move.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum GroupDegenerate {
    /// Is left out of the mean.
    Exclude,
    /// Counts as 0.
    Zero,
}

/// Forehead wrinkles lie about 6 mm apart.
fn wrinkle_wavelength() -> f32 {
    0.006
}

fn one() -> [f32; 3] {
    [1.0; 3]
}

fn is_one(gain: &[f32; 3]) -> bool {
    *gain == one()
}
