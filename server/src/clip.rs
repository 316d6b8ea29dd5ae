//! An animation clip inside a character's `.glb`, as a feed of `bones` frames: whatever moves the bones wrinkles the face.
//!
//! All in f64, whose operations are the same on every machine; single-precision quaternions and matrices are not.

#![deny(clippy::disallowed_methods)]

use glam::{DMat4, DQuat, DVec3, Vec3};
use gltf::animation::util::ReadOutputs;
use gltf::animation::{Interpolation, Property};
use rhytid_shared::Character;
use std::collections::BTreeMap;
use std::fmt::Write;
use std::io::{BufRead, Read};

/// Frames a second at which clips are sampled.
const CLIP_FPS: f64 = 60.0;
/// Longest clip, seconds.
const MAX_SECONDS: f64 = 600.0;

/// Why a clip could not be sent.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ClipError {
    /// No such clip.
    #[error("there is no clip called {name:?} in this character; it has {has}")]
    Unknown {
        /// The name asked for.
        name: String,
        /// The clips it has, or "none".
        has: String,
    },
    /// The clip moves nothing that wrinkles.
    #[error("clip {name:?} moves no joint of a bone of the face")]
    MovesNothing {
        /// The clip.
        name: String,
    },
    /// The file is broken.
    #[error("clip {name:?}: {problem}")]
    Broken {
        /// The clip.
        name: String,
        /// What is wrong with it.
        problem: String,
    },
}

/// Local transform of a node.
#[derive(Debug, Clone, Copy)]
struct Local {
    translation: DVec3,
    rotation: DQuat,
    scale: DVec3,
}

/// One animated property of one node: `times` seconds, ascending.
#[derive(Debug, Clone)]
struct Channel {
    node: usize,
    times: Vec<f64>,
    interpolation: Interpolation,
    values: Values,
}

/// Keys of a channel; three a time for cubic splines (in-tangent, value, out-tangent).
#[derive(Debug, Clone)]
enum Values {
    Translations(Vec<DVec3>),
    Rotations(Vec<DQuat>),
    Scales(Vec<DVec3>),
}

/// A bone of the face: what it is called, its evaluated point at rest, and the node of its joint.
#[derive(Debug, Clone)]
struct Bone {
    name: String,
    rest: Vec3,
    joint: usize,
}

/// A clip that has been checked and can be read as a feed, 60 frames a second.
///
/// Head motion is taken out of the bones' points and sent as `head`: `head(rest) * head(t)⁻¹ * joint(t) * joint(rest)⁻¹` carries
/// a bone's point in head space.
#[derive(Debug, Clone)]
pub struct Clip {
    name: String,
    channels: Vec<Channel>,
    /// By node.
    rest: Vec<Local>,
    world_rest: Vec<DMat4>,
    /// Nodes of the scenes after their parents, and those.
    order: Vec<(usize, Option<usize>)>,
    head: usize,
    bones: Vec<Bone>,
    num_frames: usize,
}

impl Clip {
    /// Takes the clip called `name` of `character`, whose file is `glb`.
    pub fn open(glb: &[u8], character: &Character, name: &str) -> Result<Self, ClipError> {
        let broken = |problem: &str| ClipError::Broken { name: name.to_owned(), problem: problem.to_owned() };
        let gltf = gltf::Gltf::from_slice(glb).map_err(|error| broken(&error.to_string()))?;
        let blob = gltf.blob.as_deref().ok_or_else(|| broken("the file has no binary chunk"))?;
        let Some(animation) = gltf.animations().find(|animation| animation.name() == Some(name)) else {
            let names: Vec<&str> = gltf.animations().filter_map(|animation| animation.name()).collect();
            let has = if names.is_empty() { "none".to_owned() } else { names.join(", ") };
            return Err(ClipError::Unknown { name: name.to_owned(), has });
        };
        let channels = read_channels(&animation, blob).map_err(|problem| broken(&problem))?;
        let seconds = channels.iter().filter_map(|channel| channel.times.last()).fold(0.0f64, |longest, time| longest.max(*time));
        if seconds > MAX_SECONDS {
            return Err(broken(&format!("is {seconds} s long, at most {MAX_SECONDS} are allowed")));
        }
        let rest: Vec<Local> = gltf
            .nodes()
            .map(|node| {
                let (translation, rotation, scale) = node.transform().decomposed();
                let vector = |v: [f32; 3]| DVec3::from(v.map(f64::from));
                Local { translation: vector(translation), rotation: DQuat::from_array(rotation.map(f64::from)), scale: vector(scale) }
            })
            .collect();
        let node_of: BTreeMap<&str, usize> = gltf.nodes().filter_map(|node| Some((node.name()?, node.index()))).collect();
        let head = node_of.get(character.head_joint.as_str()).copied().ok_or_else(|| broken("the head's joint is missing"))?;
        let bones = character.bones.iter().map(|bone| {
            let joint = node_of.get(bone.joint.as_str()).copied().ok_or_else(|| broken(&format!("joint {:?} is missing", bone.joint)))?;
            Ok(Bone { name: bone.name.clone(), rest: bone.rest, joint })
        });
        let mut clip = Self {
            name: name.to_owned(),
            channels,
            order: order_of(&gltf),
            world_rest: Vec::new(),
            head,
            bones: bones.collect::<Result<_, ClipError>>()?,
            num_frames: (seconds * CLIP_FPS).floor() as usize + 1,
            rest,
        };
        clip.world_rest = clip.world_of(&clip.rest);
        let mut moves_something = false;
        for index in 0..clip.num_frames {
            let world = clip.world_at(index);
            for bone in &clip.bones {
                let point = clip.point(&world, bone);
                if !point.is_finite() {
                    return Err(broken("gives a point that is not finite"));
                }
                moves_something |= point.distance(bone.rest) > 1e-6;
            }
        }
        if moves_something { Ok(clip) } else { Err(ClipError::MovesNothing { name: name.to_owned() }) }
    }

    /// The feed, written line by line as it is read: ten minutes of it would be a hundred megabytes.
    pub fn reader(&self) -> ClipReader<'_> {
        ClipReader { clip: self, next: 0, line: String::new(), at: 0 }
    }

    /// Line `index` of the feed, with its end: the hello, then frames. `None` after the last.
    fn write_line(&self, index: usize, line: &mut String) -> Option<()> {
        line.clear();
        // Writing to a String cannot fail.
        let Some(index) = index.checked_sub(1) else {
            let source = serde_json::Value::from(format!("clip {}", self.name));
            let _ = writeln!(line, r#"{{"type":"hello","version":1,"source":{source},"fps":{CLIP_FPS}}}"#);
            return Some(());
        };
        if index >= self.num_frames {
            return None;
        }
        let world = self.world_at(index);
        let _ = write!(line, r#"{{"type":"frame","t":{},"bones":{{"#, index as f64 / CLIP_FPS);
        for (i, bone) in self.bones.iter().enumerate() {
            let name = serde_json::Value::from(bone.name.as_str());
            let _ = write!(line, "{}{name}:{:?}", if i == 0 { "" } else { "," }, self.point(&world, bone).to_array());
        }
        let (_, rotation, position) = (world[self.head] * self.world_rest[self.head].inverse()).to_scale_rotation_translation();
        // The head's position is that of its pivot.
        let pivot = self.world_rest[self.head].w_axis.truncate();
        let position = (position + rotation * pivot - pivot).as_vec3();
        let (rotation, position) = (rotation.to_array().map(|component| component as f32), position.to_array());
        let _ = writeln!(line, r#"}},"head":{{"rotation":{rotation:?},"position":{position:?}}}}}"#);
        Some(())
    }

    /// A bone's evaluated point in head space, metres.
    fn point(&self, world: &[DMat4], bone: &Bone) -> Vec3 {
        let head_rest_from_head = self.world_rest[self.head] * world[self.head].inverse();
        let joint_from_rest = world[bone.joint] * self.world_rest[bone.joint].inverse();
        (head_rest_from_head * joint_from_rest).transform_point3(bone.rest.as_dvec3()).as_vec3()
    }

    fn world_at(&self, index: usize) -> Vec<DMat4> {
        let mut locals = self.rest.clone();
        self.channels.iter().for_each(|channel| channel.apply(index as f64 / CLIP_FPS, &mut locals));
        self.world_of(&locals)
    }

    /// Where every node is, model space. Nodes outside every scene stay where their own transform puts them.
    fn world_of(&self, locals: &[Local]) -> Vec<DMat4> {
        let matrix = |local: &Local| DMat4::from_scale_rotation_translation(local.scale, local.rotation, local.translation);
        let mut world: Vec<DMat4> = locals.iter().map(matrix).collect();
        for &(node, parent) in &self.order {
            if let Some(parent) = parent {
                world[node] = world[parent] * world[node];
            }
        }
        world
    }
}

/// The clip called `name` of `character`, whose file is `glb`, as the text of a feed file, all of it at once.
pub fn clip_feed(glb: &[u8], character: &Character, name: &str) -> Result<String, ClipError> {
    let clip = Clip::open(glb, character, name)?;
    let (mut text, mut line) = (String::new(), String::new());
    for index in 0.. {
        if clip.write_line(index, &mut line).is_none() {
            break;
        }
        text.push_str(&line);
    }
    Ok(text)
}

/// A clip being read as a feed file.
#[derive(Debug)]
pub struct ClipReader<'a> {
    clip: &'a Clip,
    next: usize,
    line: String,
    at: usize,
}

impl BufRead for ClipReader<'_> {
    fn fill_buf(&mut self) -> std::io::Result<&[u8]> {
        if self.at == self.line.len() {
            self.at = 0;
            self.next += usize::from(self.clip.write_line(self.next, &mut self.line).is_some());
        }
        Ok(&self.line.as_bytes()[self.at..])
    }

    fn consume(&mut self, num_bytes: usize) {
        self.at += num_bytes;
    }
}

impl Read for ClipReader<'_> {
    fn read(&mut self, buffer: &mut [u8]) -> std::io::Result<usize> {
        let num_bytes = self.fill_buf()?.read(buffer)?;
        self.consume(num_bytes);
        Ok(num_bytes)
    }
}

/// The nodes of all scenes, parents first.
fn order_of(gltf: &gltf::Gltf) -> Vec<(usize, Option<usize>)> {
    let mut order = Vec::new();
    // The character's checks have walked the same tree: it has no cycle.
    let mut open: Vec<(gltf::Node<'_>, Option<usize>)> = gltf.scenes().flat_map(|scene| scene.nodes()).map(|node| (node, None)).collect();
    while let Some((node, parent)) = open.pop() {
        order.push((node.index(), parent));
        open.extend(node.children().map(|child| (child, Some(node.index()))));
    }
    order
}

fn read_channels(animation: &gltf::Animation<'_>, blob: &[u8]) -> Result<Vec<Channel>, String> {
    let mut channels = Vec::new();
    for (c, channel) in animation.channels().enumerate() {
        let sampler = channel.sampler();
        for accessor in [sampler.input(), sampler.output()] {
            if !is_inside(&accessor, blob.len()) {
                return Err(format!("channel {c} reaches past the end of the file"));
            }
        }
        if channel.target().property() == Property::MorphTargetWeights {
            continue;
        }
        let reader = channel.reader(|buffer| matches!(buffer.source(), gltf::buffer::Source::Bin).then_some(blob));
        let times: Vec<f64> = reader.read_inputs().map(|times| times.map(f64::from).collect()).unwrap_or_default();
        let (values, num_values) = match reader.read_outputs() {
            Some(ReadOutputs::Translations(all)) => {
                let all: Vec<DVec3> = all.map(|v| DVec3::from(v.map(f64::from))).collect();
                let len = all.len();
                (Values::Translations(all), len)
            }
            Some(ReadOutputs::Rotations(all)) => {
                let all: Vec<DQuat> = all.into_f32().map(|q| DQuat::from_array(q.map(f64::from))).collect();
                let len = all.len();
                (Values::Rotations(all), len)
            }
            Some(ReadOutputs::Scales(all)) => {
                let all: Vec<DVec3> = all.map(|v| DVec3::from(v.map(f64::from))).collect();
                let len = all.len();
                (Values::Scales(all), len)
            }
            Some(ReadOutputs::MorphTargetWeights(_)) | None => return Err(format!("channel {c} has no values")),
        };
        let interpolation = sampler.interpolation();
        let keys = if interpolation == Interpolation::CubicSpline { 3 } else { 1 };
        if times.is_empty()
            || num_values != times.len() * keys
            || times.iter().any(|time| !(0.0..=f64::MAX).contains(time))
            || times.windows(2).any(|pair| pair[0] >= pair[1])
        {
            return Err(format!(
                "channel {c} has {} times and {num_values} values, expected ascending times and {keys} value(s) for each",
                times.len()
            ));
        }
        channels.push(Channel { node: channel.target().node().index(), times, interpolation, values });
    }
    Ok(channels)
}

/// The gltf crate reads accessors without looking where they end.
fn is_inside(accessor: &gltf::Accessor<'_>, blob_len: usize) -> bool {
    let Some(view) = accessor.view() else { return false };
    let stride = view.stride().unwrap_or(accessor.size());
    let end = accessor
        .count()
        .checked_sub(1)
        .and_then(|last| last.checked_mul(stride)?.checked_add(accessor.size())?.checked_add(accessor.offset()));
    accessor.sparse().is_none()
        && end.is_some_and(|end| end <= view.length())
        && view.offset().checked_add(view.length()).is_some_and(|end| end <= blob_len)
}

impl Channel {
    /// Writes the channel's value at `t` into its node.
    fn apply(&self, t: f64, locals: &mut [Local]) {
        let local = &mut locals[self.node];
        let add = |values: &[DVec3], weights: [f64; 4], at: [usize; 4]| (0..4).fold(DVec3::ZERO, |sum, i| sum + values[at[i]] * weights[i]);
        let (at, weights) = self.keys(t);
        match &self.values {
            Values::Translations(values) => local.translation = add(values, weights, at),
            Values::Scales(values) => local.scale = add(values, weights, at),
            Values::Rotations(values) if self.interpolation == Interpolation::CubicSpline => {
                local.rotation = (0..4).fold(DQuat::from_xyzw(0.0, 0.0, 0.0, 0.0), |sum, i| sum + values[at[i]] * weights[i]).normalize();
            }
            Values::Rotations(values) => local.rotation = slerp(values[at[0]].normalize(), values[at[1]].normalize(), weights[1]),
        }
    }

    /// Indices of up to four values and their weights at `t`.
    fn keys(&self, t: f64) -> ([usize; 4], [f64; 4]) {
        let last = self.times.len() - 1;
        let after = self.times.partition_point(|time| *time <= t);
        let (a, b) = (after.saturating_sub(1), after.min(last));
        let span = self.times[b] - self.times[a];
        let u = if span > 0.0 { ((t - self.times[a]) / span).clamp(0.0, 1.0) } else { 0.0 };
        match self.interpolation {
            Interpolation::Step => ([a; 4], [1.0, 0.0, 0.0, 0.0]),
            Interpolation::Linear => ([a, b, a, a], [1.0 - u, u, 0.0, 0.0]),
            // Hermite, as glTF 2.0 appendix C.4 gives it; value, out-tangent, value, in-tangent.
            Interpolation::CubicSpline => {
                let (u2, u3) = (u * u, u * u * u);
                let weights = [2.0 * u3 - 3.0 * u2 + 1.0, span * (u3 - 2.0 * u2 + u), -2.0 * u3 + 3.0 * u2, span * (u3 - u2)];
                ([3 * a + 1, 3 * a + 2, 3 * b + 1, 3 * b], weights)
            }
        }
    }
}

/// The shorter way from one unit quaternion to the other, at an even speed.
fn slerp(from: DQuat, to: DQuat, u: f64) -> DQuat {
    let dot = from.x * to.x + from.y * to.y + from.z * to.z + from.w * to.w;
    let (to, dot) = if dot < 0.0 { (-to, -dot) } else { (to, dot) };
    // Nearly the same: the sines below would lose their digits, and a straight line is as good.
    if dot > 0.9999 {
        return (from * (1.0 - u) + to * u).normalize();
    }
    let angle = libm::acos(dot);
    (from * libm::sin((1.0 - u) * angle) + to * libm::sin(u * angle)) / libm::sin(angle)
}

#[cfg(test)]
#[allow(clippy::disallowed_methods, reason = "a test compares with a tolerance")]
mod tests {
    use super::*;
    use crate::feed::{Feed, FeedItem};
    use glam::Quat;
    use rhytid_shared::{DEFAULT_CHARACTER_GLB, TrackingData, TrackingFrame};

    /// The built-in character with a clip "nod" of one second: the left brow's joint rises by 8 mm while the head turns by
    /// 0.4 rad about +Y and moves by 2 cm.
    fn with_clip() -> (Vec<u8>, Character) {
        let character = Character::from_glb(DEFAULT_CHARACTER_GLB).unwrap();
        let json_len = u32::from_le_bytes(DEFAULT_CHARACTER_GLB[12..16].try_into().unwrap()) as usize;
        let mut json: serde_json::Value = serde_json::from_slice(&DEFAULT_CHARACTER_GLB[20..20 + json_len]).unwrap();
        let mut blob = DEFAULT_CHARACTER_GLB[20 + json_len + 8..].to_vec();
        blob.resize(blob.len().next_multiple_of(4), 0);
        let node_of =
            |json: &serde_json::Value, name: &str| json["nodes"].as_array().unwrap().iter().position(|node| node["name"] == name).unwrap();
        let rest_of = |json: &serde_json::Value, node: usize| -> Vec3 {
            json["nodes"][node]["translation"]
                .as_array()
                .map_or(Vec3::ZERO, |t| Vec3::from_slice(&t.iter().map(|x| x.as_f64().unwrap() as f32).collect::<Vec<_>>()))
        };
        let mut add = |json: &mut serde_json::Value, values: &[f32], count: usize, kind: &str| {
            let view = json["bufferViews"].as_array().unwrap().len();
            json["bufferViews"]
                .as_array_mut()
                .unwrap()
                .push(serde_json::json!({"buffer": 0, "byteOffset": blob.len(), "byteLength": values.len() * 4}));
            blob.extend(values.iter().flat_map(|value| value.to_le_bytes()));
            let (min, max) = (values[0], values[values.len() - 1]);
            let mut accessor = serde_json::json!({"bufferView": view, "componentType": 5126, "count": count, "type": kind});
            if kind == "SCALAR" {
                (accessor["min"], accessor["max"]) = (vec![min].into(), vec![max].into());
            }
            json["accessors"].as_array_mut().unwrap().push(accessor);
            json["accessors"].as_array().unwrap().len() - 1
        };
        let (brow, head) = (node_of(&json, &character.bones[0].joint), node_of(&json, &character.head_joint));
        let (brow_rest, head_rest) = (rest_of(&json, brow), rest_of(&json, head));
        let turn = Quat::from_rotation_y(0.4);
        let (brow_top, head_end) = (brow_rest + Vec3::new(0.0, 0.008, 0.0), head_rest + Vec3::new(0.02, 0.0, 0.0));
        let times = add(&mut json, &[0.0, 1.0], 2, "SCALAR");
        let lift = add(&mut json, &[brow_rest.to_array(), brow_top.to_array()].concat(), 2, "VEC3");
        let shift = add(&mut json, &[head_rest.to_array(), head_end.to_array()].concat(), 2, "VEC3");
        let spin = add(&mut json, &[Quat::IDENTITY.to_array(), turn.to_array()].concat(), 2, "VEC4");
        let channel =
            |sampler: usize, node: usize, path: &str| serde_json::json!({"sampler": sampler, "target": {"node": node, "path": path}});
        let sampler = |output: usize| serde_json::json!({"input": times, "output": output});
        json["animations"] = serde_json::json!([{
            "name": "nod",
            "samplers": [sampler(lift), sampler(shift), sampler(spin)],
            "channels": [channel(0, brow, "translation"), channel(1, head, "translation"), channel(2, head, "rotation")],
        }]);
        json["buffers"][0]["byteLength"] = blob.len().into();
        let mut text = serde_json::to_vec(&json).unwrap();
        text.resize(text.len().next_multiple_of(4), b' ');
        let mut glb = b"glTF\x02\0\0\0".to_vec();
        glb.extend((12 + 8 + text.len() as u32 + 8 + blob.len() as u32).to_le_bytes());
        glb.extend([&(text.len() as u32).to_le_bytes()[..], b"JSON", &text, &(blob.len() as u32).to_le_bytes(), b"BIN\0", &blob].concat());
        let character = Character::from_glb(&glb).unwrap();
        (glb, character)
    }

    #[test]
    fn a_clip_becomes_bones_frames_without_the_heads_motion() {
        let (glb, character) = with_clip();
        let text = clip_feed(&glb, &character, "nod").unwrap();
        let mut feed = Feed::new(text.as_bytes(), "clip".into(), &character).unwrap();
        assert_eq!((feed.hello.source.as_str(), feed.hello.fps), ("clip nod", Some(60.0)));
        let (mut frame, mut num_frames) = (TrackingFrame::default(), 0);
        while feed.next_frame(&mut frame).unwrap() == Some(FeedItem::Frame) {
            let TrackingData::Bones { points, head } = &frame.data else { panic!("not bones") };
            let u = num_frames as f32 / 60.0;
            assert!((frame.t - f64::from(u)).abs() < 1e-6);
            for &(bone, point) in points {
                let lift = if bone == 0 { 0.008 * u } else { 0.0 };
                let wanted = character.bones[bone].rest + Vec3::new(0.0, lift, 0.0);
                assert!(point.distance(wanted) < 2e-6, "{} is at {point}, expected {wanted} at {u}", character.bones[bone].name);
            }
            let head = head.expect("the head moves");
            assert!(head.rotation.angle_between(Quat::from_rotation_y(0.4 * u)) < 2e-3);
            assert!(head.position.distance(Vec3::new(0.02 * u, 0.0, 0.0)) < 1e-5, "{}", head.position);
            num_frames += 1;
        }
        assert_eq!(num_frames, 61);
    }

    #[test]
    fn a_clip_is_written_as_it_is_read() {
        let (glb, character) = with_clip();
        let clip = Clip::open(&glb, &character, "nod").unwrap();
        let mut text = String::new();
        clip.reader().read_to_string(&mut text).unwrap();
        assert_eq!(text, clip_feed(&glb, &character, "nod").unwrap());
        let mut reader = clip.reader();
        reader.read_line(&mut String::new()).unwrap();
        assert!(reader.fill_buf().unwrap().len() < 8192, "one line at a time");
    }

    #[test]
    fn rotations_turn_evenly_the_shorter_way() {
        let turn = |angle: f64| DQuat::from_xyzw(0.0, 0.0, libm::sin(0.5 * angle), libm::cos(0.5 * angle));
        for (to, u) in [(1.2, 0.25), (1.2, 0.5), (0.01, 0.5), (-2.5, 0.75), (0.0, 0.5)] {
            for sign in [1.0, -1.0] {
                let got = slerp(turn(0.0), turn(to) * sign, u);
                assert!((got - turn(u * to)).length() < 1e-9, "{to} {u}: {got}");
            }
        }
    }

    #[test]
    fn what_is_no_clip_is_refused() {
        let (mut glb, character) = with_clip();
        let error = clip_feed(&glb, &character, "run").unwrap_err().to_string();
        assert_eq!(error, "there is no clip called \"run\" in this character; it has nod");
        // An accessor that reaches past the end of its view.
        let at = glb.windows(8).position(|eight| eight == b"\"count\":").map(|first| first + 8).unwrap();
        let last = glb.windows(9).rposition(|nine| nine == b"\"count\":2").unwrap() + 8;
        assert!(last > at);
        glb[last] = b'9';
        let error = clip_feed(&glb, &character, "nod").unwrap_err().to_string();
        assert!(error.contains("reaches past the end"), "{error}");
    }
}
