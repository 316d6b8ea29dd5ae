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
    num_bytes: u64,
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
            num_bytes: 0,
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
        if !moves_something {
            return Err(ClipError::MovesNothing { name: name.to_owned() });
        }
        let mut line = String::new();
        clip.num_bytes = (0..).map_while(|index| clip.write_line(index, &mut line).map(|()| line.len() as u64)).sum();
        Ok(clip)
    }

    /// Length of the feed, bytes.
    pub fn num_bytes(&self) -> u64 {
        self.num_bytes
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
mod tests {
    use super::*;

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
}
