//! An animation clip inside a character's `.glb`, as a feed of `bones` frames: whatever moves the bones wrinkles the face.

use glam::{Mat4, Quat, Vec3};
use gltf::animation::util::ReadOutputs;
use gltf::animation::{Interpolation, Property};
use rhytid_shared::Character;
use std::collections::BTreeMap;
use std::fmt::Write;

/// Frames a second at which clips are sampled.
const CLIP_FPS: f32 = 60.0;
/// Longest clip, seconds.
const MAX_SECONDS: f32 = 600.0;

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
    translation: Vec3,
    rotation: Quat,
    scale: Vec3,
}

/// One animated property of one node: `times` seconds, ascending.
struct Channel {
    node: usize,
    times: Vec<f32>,
    interpolation: Interpolation,
    values: Values,
}

/// Keys of a channel; three a time for cubic splines (in-tangent, value, out-tangent).
enum Values {
    Translations(Vec<Vec3>),
    Rotations(Vec<Quat>),
    Scales(Vec<Vec3>),
}

/// The clip called `name` of `character`, whose file is `glb`, as the text of a feed file, 60 frames a second.
///
/// Head motion is taken out of the bones' points and sent as `head`: `head(rest) * head(t)⁻¹ * joint(t) * joint(rest)⁻¹` carries
/// a bone's point in head space.
pub fn clip_feed(glb: &[u8], character: &Character, name: &str) -> Result<String, ClipError> {
    let broken = |problem: &str| ClipError::Broken { name: name.to_owned(), problem: problem.to_owned() };
    let gltf = gltf::Gltf::from_slice(glb).map_err(|error| broken(&error.to_string()))?;
    let blob = gltf.blob.as_deref().ok_or_else(|| broken("the file has no binary chunk"))?;
    let Some(animation) = gltf.animations().find(|animation| animation.name() == Some(name)) else {
        let names: Vec<&str> = gltf.animations().filter_map(|animation| animation.name()).collect();
        let has = if names.is_empty() { "none".to_owned() } else { names.join(", ") };
        return Err(ClipError::Unknown { name: name.to_owned(), has });
    };
    let channels = read_channels(&animation, blob).map_err(|problem| broken(&problem))?;
    let seconds = channels.iter().filter_map(|channel| channel.times.last()).fold(0.0f32, |longest, time| longest.max(*time));
    if seconds > MAX_SECONDS {
        return Err(broken(&format!("is {seconds} s long, at most {MAX_SECONDS} are allowed")));
    }
    let rest: Vec<Local> = gltf
        .nodes()
        .map(|node| {
            let (translation, rotation, scale) = node.transform().decomposed();
            Local { translation: translation.into(), rotation: Quat::from_array(rotation), scale: scale.into() }
        })
        .collect();
    let node_of: BTreeMap<&str, usize> = gltf.nodes().filter_map(|node| Some((node.name()?, node.index()))).collect();
    let head = node_of.get(character.head_joint.as_str()).copied().ok_or_else(|| broken("the head's joint is missing"))?;
    let joint_of = |name: &str| node_of.get(name).copied().ok_or_else(|| broken(&format!("joint {name:?} is missing")));
    let joints = character.bones.iter().map(|bone| joint_of(&bone.joint)).collect::<Result<Vec<_>, _>>()?;
    let world_rest = world_of(&gltf, &rest);

    let mut text = String::new();
    // Writing to a String cannot fail.
    let source = serde_json::Value::from(format!("clip {name}"));
    let _ = writeln!(text, r#"{{"type":"hello","version":1,"source":{source},"fps":{CLIP_FPS}}}"#);
    let mut moves_something = false;
    for index in 0..=(seconds * CLIP_FPS).floor() as usize {
        let t = index as f32 / CLIP_FPS;
        let mut locals = rest.clone();
        channels.iter().for_each(|channel| channel.apply(t, &mut locals));
        let world = world_of(&gltf, &locals);
        let head_rest_from_head = world_rest[head] * world[head].inverse();
        let mut bones = serde_json::Map::new();
        for (bone, &joint) in character.bones.iter().zip(&joints) {
            let point = (head_rest_from_head * world[joint] * world_rest[joint].inverse()).transform_point3(bone.rest);
            if !point.is_finite() {
                return Err(broken("gives a point that is not finite"));
            }
            moves_something |= point.distance(bone.rest) > 1e-6;
            bones.insert(bone.name.clone(), point.to_array().to_vec().into());
        }
        let (_, rotation, position) = (world[head] * world_rest[head].inverse()).to_scale_rotation_translation();
        // The head's position is that of its pivot.
        let position = position + rotation * world_rest[head].w_axis.truncate() - world_rest[head].w_axis.truncate();
        let bones = serde_json::Value::from(bones);
        let (rotation, position) = (rotation.to_array(), position.to_array());
        let _ = writeln!(
            text,
            r#"{{"type":"frame","t":{},"bones":{bones},"head":{{"rotation":{rotation:?},"position":{position:?}}}}}"#,
            index as f64 / f64::from(CLIP_FPS)
        );
    }
    if moves_something { Ok(text) } else { Err(ClipError::MovesNothing { name: name.to_owned() }) }
}

/// Where every node is, model space. Nodes outside every scene stay where their own transform puts them.
fn world_of(gltf: &gltf::Gltf, locals: &[Local]) -> Vec<Mat4> {
    let matrix = |node: usize| Mat4::from_scale_rotation_translation(locals[node].scale, locals[node].rotation, locals[node].translation);
    let mut world: Vec<Mat4> = (0..locals.len()).map(matrix).collect();
    // The character's checks have walked the same tree: it has no cycle.
    let mut open: Vec<(gltf::Node<'_>, Mat4)> = gltf.scenes().flat_map(|scene| scene.nodes()).map(|node| (node, Mat4::IDENTITY)).collect();
    while let Some((node, parent)) = open.pop() {
        let here = parent * matrix(node.index());
        world[node.index()] = here;
        open.extend(node.children().map(|child| (child, here)));
    }
    world
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
        let times: Vec<f32> = reader.read_inputs().map(Iterator::collect).unwrap_or_default();
        let (values, num_values) = match reader.read_outputs() {
            Some(ReadOutputs::Translations(all)) => {
                let all: Vec<Vec3> = all.map(Vec3::from).collect();
                let len = all.len();
                (Values::Translations(all), len)
            }
            Some(ReadOutputs::Rotations(all)) => {
                let all: Vec<Quat> = all.into_f32().map(Quat::from_array).collect();
                let len = all.len();
                (Values::Rotations(all), len)
            }
            Some(ReadOutputs::Scales(all)) => {
                let all: Vec<Vec3> = all.map(Vec3::from).collect();
                let len = all.len();
                (Values::Scales(all), len)
            }
            Some(ReadOutputs::MorphTargetWeights(_)) | None => return Err(format!("channel {c} has no values")),
        };
        let interpolation = sampler.interpolation();
        let keys = if interpolation == Interpolation::CubicSpline { 3 } else { 1 };
        if times.is_empty()
            || num_values != times.len() * keys
            || times.iter().any(|time| !(0.0..=f32::MAX).contains(time))
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
    fn apply(&self, t: f32, locals: &mut [Local]) {
        let local = &mut locals[self.node];
        let add = |values: &[Vec3], weights: [f32; 4], at: [usize; 4]| (0..4).fold(Vec3::ZERO, |sum, i| sum + values[at[i]] * weights[i]);
        let (at, weights) = self.keys(t);
        match &self.values {
            Values::Translations(values) => local.translation = add(values, weights, at),
            Values::Scales(values) => local.scale = add(values, weights, at),
            Values::Rotations(values) if self.interpolation == Interpolation::CubicSpline => {
                local.rotation = (0..4).fold(Quat::from_xyzw(0.0, 0.0, 0.0, 0.0), |sum, i| sum + values[at[i]] * weights[i]).normalize();
            }
            Values::Rotations(values) => local.rotation = values[at[0]].normalize().slerp(values[at[1]].normalize(), weights[1]),
        }
    }

    /// Indices of up to four values and their weights at `t`.
    fn keys(&self, t: f32) -> ([usize; 4], [f32; 4]) {
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
