//! A recording for other programs: Live Link Face's CSV, and glTF animations on the character.

use super::faces::{Faces, Moment};
use super::reader::ReadError;
use crate::trackers::livelink;
use glam::{Affine3A, Mat4, Quat};
use rhytid_shared::{ARKIT_NAMES, ArkitShape, Character, FaceFrame};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::io::{self, Write};

/// Frames a second that a timecode counts.
const RATE: f64 = 60.0;
/// Most bytes of animation: Blender reads such a file in minutes.
const MAX_ANIMATION: u64 = 1 << 30;

/// Why a recording could not be exported.
#[derive(Debug, thiserror::Error)]
pub enum ExportError {
    /// The file could not be read.
    #[error(transparent)]
    Read(#[from] ReadError),
    /// The result could not be written.
    #[error("cannot write: {0}")]
    Write(#[from] io::Error),
    /// The recording has not what the format holds.
    #[error("{0}")]
    Lacks(String),
    /// It is too long for one file.
    #[error("the animation would take {bytes} bytes, the most is {MAX_ANIMATION}: export a part with --from and --until")]
    TooLong {
        /// How many.
        bytes: u64,
    },
    /// The character's file does not fit the recording.
    #[error("character: {0}")]
    Character(String),
}

/// Reads the faces from `range[0]` to `range[1]`, seconds since the recording began.
fn each_face(
    faces: &mut Faces,
    range: [f64; 2],
    mut take: impl FnMut(Moment, &FaceFrame) -> Result<(), ExportError>,
) -> Result<u64, ExportError> {
    let mut next = if range[0] > 0.0 { faces.seek(range[0])? } else { faces.advance()? };
    let mut num = 0;
    while let Some(moment) = next.filter(|moment| moment.smooth <= range[1]) {
        take(moment, faces.frame())?;
        num += 1;
        next = faces.advance()?;
    }
    if num == 0 { Err(ExportError::Lacks("there is no face in that part of the recording".into())) } else { Ok(num) }
}

/// Columns of Live Link Face's CSV after the count, in its order: JawRight before JawLeft and MouthRight before MouthLeft, unlike its
/// datagrams.
fn csv_columns() -> Vec<(String, usize)> {
    let mut names: Vec<&str> = ARKIT_NAMES.to_vec();
    for (right, left) in [("jawRight", "jawLeft"), ("mouthRight", "mouthLeft")] {
        let place = |name: &str| names.iter().position(|other| *other == name);
        if let (Some(right), Some(left)) = (place(right), place(left))
            && left < right
        {
            names.swap(left, right);
        }
    }
    let pascal = |name: &str| name[..1].to_ascii_uppercase() + &name[1..];
    names.iter().filter_map(|name| Some((pascal(name), ArkitShape::from_name(name)?.index()))).collect()
}

/// Writes the expression weights and the head as Live Link Face records them: one row a face, its time of day (UTC) at 60 frames a
/// second with thousandths; rows without a face have a count of 0. Gives the number of rows.
pub fn export_csv(faces: &mut Faces, range: [f64; 2], out: &mut impl Write) -> Result<u64, ExportError> {
    let columns = csv_columns();
    let start = faces.recording().start() as f64 / 1e9 % 86_400.0;
    write!(out, "Timecode,BlendShapeCount")?;
    for (name, _) in &columns {
        write!(out, ",{name}")?;
    }
    let angles =
        ["HeadYaw", "HeadPitch", "HeadRoll", "LeftEyeYaw", "LeftEyePitch", "LeftEyeRoll", "RightEyeYaw", "RightEyePitch", "RightEyeRoll"];
    writeln!(out, ",{}", angles.join(","))?;
    each_face(faces, range, |moment, frame| {
        let Some(weights) = frame.shapes.as_ref() else {
            let why = "it has no expression weights (the server's estimate_weights was off)";
            return Err(ExportError::Lacks(format!("at {:.3} s of the recording: {why}", moment.at)));
        };
        let thousandths = ((start + moment.smooth) * RATE * 1000.0).round() as u64;
        let (frames, part) = (thousandths / 1000, thousandths % 1000);
        let (seconds, frame_number) = (frames / RATE as u64 % 86_400, frames % RATE as u64);
        write!(out, "{:02}:{:02}:{:02}:{frame_number:02}.{part:03}", seconds / 3600, seconds / 60 % 60, seconds % 60)?;
        write!(out, ",{}", if frame.face { columns.len() + angles.len() } else { 0 })?;
        for (_, index) in &columns {
            write!(out, ",{:.10}", weights[*index])?;
        }
        let values = livelink::values(weights, frame.head.rotation);
        for angle in &values[values.len() - angles.len()..] {
            write!(out, ",{angle:.10}")?;
        }
        writeln!(out)?;
        Ok(())
    })
}

/// Faces farther apart than this, seconds, have a pause between them, in which viewers saw the one before: slower than any camera.
const PAUSE: f32 = 1.0;
/// How long before the first face after a pause the last one still stands, seconds.
const HAND_OVER: f32 = 1.0 / 60.0;
/// What is nearer to rest than this (metres, quaternions' components) is at rest: less than packets tell apart, more than rounding.
const AT_REST: f32 = 1e-6;

/// What an animation does to one node.
#[derive(Default)]
struct Track {
    rotations: Vec<[f32; 4]>,
    translations: Vec<[f32; 3]>,
}

/// Gives the character's `.glb` with the recording as two animations, `bones` (bones and head) and `shapes` (expression weights and
/// head): they are two ways to move one face, so a player shall play one. Each holds at rest what only the other moves, for programs
/// that go from one to the other and leave what is not animated where it was. With it the number of faces.
pub fn export_gltf(faces: &mut Faces, range: [f64; 2], character: &Character, glb: &[u8]) -> Result<(Vec<u8>, u64), ExportError> {
    if faces.recording().character().sha256 != character.sha256 {
        let recorded = &faces.recording().character().name;
        return Err(ExportError::Character(format!("the recording is of {recorded:?}, this is another file ({:?})", character.name)));
    }
    let broken = |problem: &str| ExportError::Character(problem.to_owned());
    let parsed = gltf::Gltf::from_slice(glb).map_err(|error| ExportError::Character(error.to_string()))?;
    let container = gltf::Glb::from_slice(glb).map_err(|error| ExportError::Character(error.to_string()))?;
    let mut document: Value = serde_json::from_slice(&container.json).map_err(|error| ExportError::Character(error.to_string()))?;
    let mut bin = container.bin.map(std::borrow::Cow::into_owned).ok_or_else(|| broken("it has no binary chunk"))?;

    let rig = Rig::new(&parsed, character)?;
    let (mut times, mut weights) = (Vec::<f32>::new(), Vec::<f32>::new());
    let mut tracks: Vec<Track> = rig.moved.iter().map(|_| Track::default()).collect();
    let mut first = None;
    let bytes_a_face = 4 + tracks.len() as u64 * 28 + rig.targets.len() as u64 * 4;
    let num = each_face(faces, range, |moment, frame| {
        let t = (moment.smooth - *first.get_or_insert(moment.smooth)) as f32;
        // Two faces of one time are one key.
        if times.last().is_some_and(|last| t <= *last) {
            return Ok(());
        }
        let bytes = bytes_a_face * (times.len() as u64 + 2);
        if bytes > MAX_ANIMATION {
            return Err(ExportError::TooLong { bytes });
        }
        if times.last().is_some_and(|last| t - last > PAUSE) {
            times.push(t - HAND_OVER);
            for track in &mut tracks {
                track.rotations.extend(track.rotations.last().copied());
                track.translations.extend(track.translations.last().copied());
            }
            weights.extend_from_within(weights.len() - rig.targets.len()..);
        }
        times.push(t);
        rig.pose(character, frame, &mut tracks);
        weights.extend(rig.targets.iter().map(|shape| shape.and_then(|shape| Some(frame.shapes?[shape])).unwrap_or(0.0)));
        Ok(())
    })?;

    let mut file = Additions { document: &mut document, bin: &mut bin };
    let moving = file.accessor("SCALAR", 1, &times, true);
    // What stays at rest does so from the first key to the last.
    let ends: &[f32] = if let [first, .., last] = times[..] { &[first, last] } else { &times };
    let still = file.accessor("SCALAR", 1, ends, true);
    let mut channels: [Vec<Channel>; 2] = Default::default();
    for (moved, track) in rig.moved.iter().zip(&tracks) {
        let is_head = moved.node == rig.head;
        let (rotations, translations) = (track.rotations.as_flattened(), track.translations.as_flattened());
        let properties: [(_, _, &[f32], _); 2] =
            [("rotation", "VEC4", &moved.local.0, rotations), ("translation", "VEC3", &moved.local.1, translations)];
        for (path, kind, rest, values) in properties {
            let leaves_rest = |value: &[f32]| value.iter().zip(rest).any(|(value, rest)| (value - rest).abs() > AT_REST);
            if !is_head && !values.chunks(rest.len()).any(leaves_rest) {
                continue;
            }
            let channel = |input, output| Channel { node: moved.node, path, input, output };
            let keys = channel(moving, file.accessor(kind, rest.len(), values, false));
            if is_head {
                channels[1].push(keys);
            } else {
                channels[1].push(channel(still, file.accessor(kind, rest.len(), &rest.repeat(ends.len()), false)));
            }
            channels[0].push(keys);
        }
        file.decompose(moved);
    }
    if let Some(node) = rig.mesh_node.filter(|_| weights.iter().any(|weight| *weight != 0.0)) {
        let none = vec![0.0; rig.targets.len() * ends.len()];
        for (channels, (input, values)) in channels.iter_mut().zip([(still, &none), (moving, &weights)]) {
            let output = file.accessor("SCALAR", 1, values, false);
            channels.push(Channel { node, path: "weights", input, output });
        }
    }
    for (name, channels) in ["bones", "shapes"].into_iter().zip(channels) {
        file.animation(name, &channels);
    }
    Ok((write_glb(&document, &bin)?, num))
}

/// What moves one property of a node: accessors of times and of values.
#[derive(Clone, Copy)]
struct Channel {
    node: usize,
    path: &'static str,
    input: usize,
    output: usize,
}

/// What a recording adds to a glTF file.
struct Additions<'a> {
    document: &'a mut Value,
    bin: &'a mut Vec<u8>,
}

impl Additions<'_> {
    fn push(&mut self, list: &str, value: Value) -> usize {
        let list = &mut self.document[list];
        if !list.is_array() {
            *list = json!([]);
        }
        let list = list.as_array_mut().expect("made one above");
        list.push(value);
        list.len() - 1
    }

    /// Adds floats, `width` an element; gives the accessor.
    fn accessor(&mut self, kind: &str, width: usize, values: &[f32], has_bounds: bool) -> usize {
        self.bin.resize(self.bin.len().next_multiple_of(4), 0);
        let offset = self.bin.len();
        self.bin.extend(values.iter().flat_map(|value| value.to_le_bytes()));
        let view = self.push("bufferViews", json!({ "buffer": 0, "byteOffset": offset, "byteLength": values.len() * 4 }));
        let mut accessor = json!({ "bufferView": view, "componentType": 5126, "count": values.len() / width, "type": kind });
        if has_bounds {
            accessor["min"] = json!([values.first()]);
            accessor["max"] = json!([values.last()]);
        }
        self.push("accessors", accessor)
    }

    /// Gives a node that is animated its place in parts: a matrix cannot be animated.
    fn decompose(&mut self, moved: &Moved) {
        if let Some(node) = self.document["nodes"][moved.node].as_object_mut()
            && node.remove("matrix").is_some()
        {
            let (rotation, translation, scale) = moved.local;
            node.extend([
                ("rotation".to_owned(), json!(rotation)),
                ("translation".to_owned(), json!(translation)),
                ("scale".to_owned(), json!(scale)),
            ]);
        }
    }

    fn animation(&mut self, name: &str, channels: &[Channel]) {
        if channels.is_empty() {
            return;
        }
        let samplers: Vec<Value> =
            channels.iter().map(|channel| json!({ "input": channel.input, "output": channel.output, "interpolation": "LINEAR" })).collect();
        let channels: Vec<Value> = channels
            .iter()
            .enumerate()
            .map(|(sampler, Channel { node, path, .. })| json!({ "sampler": sampler, "target": { "node": node, "path": path } }))
            .collect();
        self.push("animations", json!({ "name": name, "samplers": samplers, "channels": channels }));
    }
}

fn write_glb(document: &Value, bin: &[u8]) -> Result<Vec<u8>, ExportError> {
    let mut document = document.clone();
    document["buffers"][0]["byteLength"] = json!(bin.len());
    let json = serde_json::to_vec(&document).expect("plain data can be written");
    let glb =
        gltf::Glb { header: gltf::binary::Header { magic: *b"glTF", version: 2, length: 0 }, json: json.into(), bin: Some(bin.into()) };
    glb.to_vec().map_err(|error| ExportError::Character(error.to_string()))
}

/// A node that the recording moves.
struct Moved {
    node: usize,
    /// Index into the character's bones; the head's own joint has none.
    bone: Option<usize>,
    /// Carried by the head.
    follows_head: bool,
    /// Model space at rest.
    rest: Affine3A,
    /// Below its parent at rest: rotation (x, y, z, w), translation, scale.
    local: ([f32; 4], [f32; 3], [f32; 3]),
    /// The nearest node above it that is moved, as an index into `Rig::moved`, and where its parent is at rest.
    above: Option<usize>,
    parent_rest: Affine3A,
}

/// The character's skeleton as its file has it.
struct Rig {
    head: usize,
    /// Parents before their children.
    moved: Vec<Moved>,
    mesh_node: Option<usize>,
    /// For each morph target of the mesh, its expression shape.
    targets: Vec<Option<usize>>,
}

impl Rig {
    fn new(gltf: &gltf::Gltf, character: &Character) -> Result<Self, ExportError> {
        let mut parents = BTreeMap::new();
        for node in gltf.nodes() {
            for child in node.children() {
                parents.insert(child.index(), node.index());
            }
        }
        let locals: Vec<Affine3A> =
            gltf.nodes().map(|node| Affine3A::from_mat4(Mat4::from_cols_array_2d(&node.transform().matrix()))).collect();
        // The document's own check has refused cycles of nodes; the bound is for those it may miss.
        let line = |node: usize| std::iter::successors(Some(node), |node| parents.get(node).copied()).take(locals.len());
        let world = |node: usize| line(node).fold(Affine3A::IDENTITY, |below, node| locals[node] * below);
        let named = |name: &str| {
            let node = gltf.nodes().find(|node| node.name() == Some(name));
            node.map(|node| node.index()).ok_or_else(|| ExportError::Character(format!("there is no node {name:?}")))
        };
        let head = named(&character.head_joint)?;
        let mut nodes: Vec<(usize, Option<usize>)> = vec![(head, None)];
        for (bone, description) in character.bones.iter().enumerate() {
            let node = named(&description.joint)?;
            // Of bones that share a joint, the first moves it.
            if nodes.iter().all(|(other, _)| *other != node) {
                nodes.push((node, Some(bone)));
            }
        }
        nodes.sort_by_key(|(node, _)| line(*node).count());
        let mut moved: Vec<Moved> = Vec::new();
        for (node, bone) in nodes {
            let above = line(node).skip(1).find_map(|parent| moved.iter().position(|moved| moved.node == parent));
            let parent_rest = parents.get(&node).map_or(Affine3A::IDENTITY, |parent| world(*parent));
            let follows_head = node == head || line(node).skip(1).any(|parent| parent == head);
            let (scale, rotation, translation) = locals[node].to_scale_rotation_translation();
            let local = (rotation.normalize().to_array(), translation.to_array(), scale.to_array());
            moved.push(Moved { node, bone, follows_head, rest: world(node), local, above, parent_rest });
        }
        let mesh_node =
            gltf.nodes().find(|node| node.mesh().is_some_and(|mesh| mesh.primitives().any(|part| part.morph_targets().len() > 0)));
        let targets = mesh_node.as_ref().and_then(|node| target_names(&node.mesh()?)).unwrap_or_default();
        Ok(Self { head, moved, mesh_node: mesh_node.map(|node| node.index()), targets })
    }

    /// Adds a key of `frame` to every track.
    fn pose(&self, character: &Character, frame: &FaceFrame, tracks: &mut [Track]) {
        let head = character.head_motion(&frame.head);
        let mut motions: Vec<Affine3A> = Vec::with_capacity(self.moved.len());
        for (moved, track) in self.moved.iter().zip(tracks) {
            let carried = if moved.follows_head { head } else { Affine3A::IDENTITY };
            let motion = moved.bone.map_or(carried, |bone| carried * character.bone_motion(&frame.rotations, &frame.points, bone));
            // What the parent does comes from the nearest joint above that moves.
            let parent = moved.above.map_or(Affine3A::IDENTITY, |above| motions[above]) * moved.parent_rest;
            let local = parent.inverse() * (motion * moved.rest);
            motions.push(motion);
            let (_, mut rotation, translation) = local.to_scale_rotation_translation();
            // The same rotation in the half of its numbers where players interpolate the short way.
            if Quat::from_array(*track.rotations.last().unwrap_or(&moved.local.0)).dot(rotation) < 0.0 {
                rotation = -rotation;
            }
            track.rotations.push(rotation.normalize().to_array());
            track.translations.push(translation.to_array());
        }
    }
}

/// The shape of each morph target; nothing for those that are none.
fn target_names(mesh: &gltf::Mesh<'_>) -> Option<Vec<Option<usize>>> {
    let extras: Value = serde_json::from_str(mesh.extras().as_ref()?.get()).ok()?;
    let shape_of = |name: &Value| {
        let name = name.as_str()?;
        // Halves of a shape take the whole one's weight.
        let whole = name.strip_suffix("_L").or_else(|| name.strip_suffix("_R")).unwrap_or(name);
        ARKIT_NAMES.iter().position(|known| known.eq_ignore_ascii_case(name) || known.eq_ignore_ascii_case(whole))
    };
    Some(extras["targetNames"].as_array()?.iter().map(shape_of).collect())
}
