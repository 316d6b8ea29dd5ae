//! Skinning weights of the skin: lids and jaw from the expression shapes' own motion, the face's skin bones by the
//! automatic rig, neck and shoulders by height.

use super::autorig::{self, Feature};
use super::bust::Region;
use super::fit::{self, Mover};
use super::mesh::Mesh;
use super::part::Binding;
use super::rig::{HEAD, ROOT, Reach, Rig, Zone};
use glam::{Vec3, Vec3Swizzles};
use rhytid_shared::ARKIT_NAMES;
use std::collections::BTreeMap;

/// Which side of the mouth a vertex is on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Lip {
    /// Nearer to the upper lip along the skin.
    Upper,
    /// Nearer to the lower lip.
    Lower,
}

/// What the weights are made from. Arrays over the skin's vertices.
pub struct Skin<'a> {
    /// The welded skin.
    pub mesh: &'a Mesh,
    /// Region of every vertex.
    pub regions: &'a [Region],
    /// Side of the mouth of every vertex.
    pub lips: &'a [Lip],
    /// Vertices where the lips' inner edges meet.
    pub lip_corners: [u32; 2],
    /// Share of the jaw's turn of every vertex.
    pub jaw: Vec<f32>,
    /// Hinge of the jaw.
    pub jaw_pivot: Vec3,
    /// Angle of the shape `jawOpen`, radians.
    pub jaw_open: f32,
    /// Share of each lid's turn: `lids[left, right][upper, lower]`.
    pub lids: [[Vec<f32>; 2]; 2],
}

/// How much more firmly weights are held to the automatic rig's where an echo speaks.
const ECHO_HOLD: f32 = 30.0;

/// How far from the lips' inner corners along the skin both lips move as one, and where they are wholly apart, metres.
const CORNER_RANGE: [f32; 2] = [0.002_5, 0.008];

/// Half the width of the strip about the midline over which the bones of one side hand over to those of the other, metres.
const HALVES_BLEND: f32 = 0.002_5;

/// Joints a vertex of the file can have.
const NUM_KEPT: usize = 4;
/// Smaller weights do not show.
const LEAST_WEIGHT: f32 = 0.004;
/// Distance along the skin in which a joint fades out before it is dropped, metres. Tuned by eye: shorter creases show.
const FADE_LENGTH: f32 = 0.009;

/// Weights of every vertex over at most four joints, summing to one.
pub type Weights = Vec<Vec<(u8, f32)>>;

/// Height, tilted forwards, over which the neck passes from the torso (0) to the head (1), metres.
const NECK_TILT: f32 = 0.60;
const NECK_RANGE: [f32; 2] = [-0.152, -0.093];

/// Index of an ARKit shape.
pub fn shape(name: &str) -> usize {
    ARKIT_NAMES.iter().position(|known| *known == name).expect("the bake names ARKit shapes only")
}

/// Angle about the X axis through `pivot` by which each vertex turns in a shape, radians; positive turns the front down.
/// Nearer to the axis than `least_radius` the angle would be noise and is held down.
pub fn turn_angles(positions: &[Vec3], deltas: &[Vec3], pivot: Vec3, least_radius: f32) -> Vec<f32> {
    positions
        .iter()
        .zip(deltas)
        .map(|(&p, &delta)| {
            let (from, to) = (p - pivot, p + delta - pivot);
            let radius = from.yz().length().max(least_radius);
            let turned = libm::atan2f(from.y * to.z - from.z * to.y, from.yz().dot(to.yz()));
            turned * (from.yz().length() / radius)
        })
        .collect()
}

/// Weights by all rules.
pub fn build(skin: &Skin<'_>, rig: &Rig) -> Weights {
    let graph = autorig::edge_graph(skin.mesh);
    let fields = skin_fields(skin, rig, &graph);
    let jaw = rig.joint_of("jaw");
    let lid_joints = [["lid_upper_l", "lid_lower_l"], ["lid_upper_r", "lid_lower_r"]].map(|pair| pair.map(|name| rig.joint_of(name)));
    let mut weights: Weights = (0..skin.mesh.positions.len())
        .map(|v| {
            let mut weights: Vec<(u8, f32)> = Vec::new();
            let mut left = 1.0;
            for (joints, lids) in lid_joints.iter().zip(&skin.lids) {
                for (&joint, lid) in joints.iter().zip(lids) {
                    let weight = lid[v].clamp(0.0, left);
                    weights.push((joint, weight));
                    left -= weight;
                }
            }
            let joints = rig.reaches.iter().map(|reach| reach.joint).chain([jaw]);
            let taken: f32 = fields.iter().map(|field| field[v]).sum::<f32>();
            weights.extend(joints.zip(&fields).map(|(joint, field)| (joint, field[v] * left / taken.max(1.0))));
            left *= (1.0 - taken).max(0.0);
            // The mouth's cavity reaches down to the neck, but it is the head's.
            let is_inner = matches!(skin.regions[v], Region::Mouth | Region::Socket);
            let on_head = if is_inner { 1.0 } else { headness(skin.mesh.positions[v]) };
            weights.push((HEAD, left * on_head));
            weights.push((ROOT, left * (1.0 - on_head)));
            weights.retain(|&(_, weight)| weight > 0.0);
            weights
        })
        .collect();
    keep_four(&graph, &mut weights);
    // Where three joints faded at once the fourth took over steeply. Lids and lips are left as their shapes have them.
    let is_open = |v: usize| matches!(skin.regions[v], Region::Face | Region::Body);
    smooth_all(&graph, &mut weights, is_open);
    // Smoothing carries each half over the midline once more.
    part_halves_of(skin.mesh, rig, &mut weights);
    weights
}

/// Smooths the weights of all joints over the vertices `is_open`, and leaves each its four heaviest.
fn smooth_all(graph: &[Vec<(u32, f32)>], weights: &mut Weights, is_open: impl Fn(usize) -> bool) {
    const NUM_ROUNDS: usize = 6;
    let num_joints = weights.iter().flatten().map(|&(joint, _)| joint + 1).max().unwrap_or(0);
    let mut smoothed: Weights = vec![Vec::new(); weights.len()];
    for joint in 0..num_joints {
        let of = |list: &Vec<(u8, f32)>| list.iter().find(|(own, _)| *own == joint).map_or(0.0, |&(_, weight)| weight);
        let mut field: Vec<f32> = weights.iter().map(of).collect();
        autorig::smooth(graph, &mut field, NUM_ROUNDS, |a, b| is_open(a) && is_open(b));
        smoothed.iter_mut().zip(field).filter(|(_, weight)| *weight > LEAST_WEIGHT).for_each(|(list, weight)| list.push((joint, weight)));
    }
    for list in &mut smoothed {
        list.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
        list.truncate(NUM_KEPT);
        let sum: f32 = list.iter().map(|&(_, weight)| weight).sum();
        list.iter_mut().for_each(|(_, weight)| *weight /= sum);
    }
    *weights = smoothed;
}

/// Leaves each vertex its four heaviest joints. A joint fades out along the skin towards where it is dropped: cut off at
/// once, its missing gradient would stand as a dark spot in the normals, which bend with the weights.
fn keep_four(graph: &[Vec<(u32, f32)>], weights: &mut Weights) {
    for list in weights.iter_mut() {
        list.retain(|&(_, weight)| weight > LEAST_WEIGHT);
        list.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
    }
    let mut dropped_at: BTreeMap<u8, Vec<u32>> = BTreeMap::new();
    for (v, list) in weights.iter_mut().enumerate() {
        for (joint, _) in list.drain(list.len().min(NUM_KEPT)..) {
            dropped_at.entry(joint).or_default().push(v as u32);
        }
    }
    for (joint, places) in dropped_at {
        let distances = autorig::distances(graph, &places, FADE_LENGTH);
        for (list, distance) in weights.iter_mut().zip(distances).filter(|(_, distance)| distance.is_finite()) {
            let share = smoothstep(0.0, FADE_LENGTH, distance).max(1e-3);
            list.iter_mut().filter(|(own, _)| *own == joint).for_each(|(_, weight)| *weight *= share);
        }
    }
    for list in weights.iter_mut() {
        let sum: f32 = list.iter().map(|&(_, weight)| weight).sum();
        list.iter_mut().for_each(|(_, weight)| *weight /= sum);
    }
}

/// Weights of the skin bones and, last, of the jaw: automatic rig first, then fitted to the shapes, then smoothed.
fn skin_fields(skin: &Skin<'_>, rig: &Rig, graph: &[Vec<(u32, f32)>]) -> Vec<Vec<f32>> {
    let num_vertices = skin.mesh.positions.len();
    let features: Vec<Feature> = rig.reaches.iter().map(|reach| Feature { vertex: reach.vertex, reach: reach.reach }).collect();
    let allows = |j: usize, v: usize| {
        let is_lined = matches!(skin.regions[v], Region::Socket | Region::Cap);
        match rig.reaches[j].zone {
            Zone::Open => !is_lined,
            Zone::UpperLip => !is_lined && skin.lips[v] == Lip::Upper,
            Zone::LowerLip => !is_lined && skin.lips[v] == Lip::Lower,
        }
    };
    let influences = autorig::influences(graph, &features, allows);
    let echoes: Vec<Vec<f32>> = rig.reaches.iter().enumerate().map(|(j, reach)| echo(graph, reach, |v| allows(j, v))).collect();
    let mut movers: Vec<Mover> =
        rig.reaches.iter().map(|reach| Mover::Skin { vertex: reach.vertex, turns: reach.zone == Zone::LowerLip }).collect();
    movers.push(Mover::Jaw { pivot: skin.jaw_pivot });
    let shapes = fit::fitted_shapes();
    let mut fields = vec![vec![0.0; num_vertices]; movers.len()];
    for v in 0..num_vertices {
        let raw: Vec<f32> = influences.iter().zip(&echoes).map(|(influence, echo)| influence[v].max(echo[v])).collect();
        let mut prior = autorig::shares(&raw);
        // The shapes move the forehead less than foreheads move: where an echo speaks, the automatic rig is believed.
        let echoed = influences.iter().zip(&echoes).map(|(influence, echo)| (echo[v] - influence[v]).max(0.0)).fold(0.0, f32::max);
        let hold = 1.0 + ECHO_HOLD * echoed;
        let left = 1.0 - prior.iter().sum::<f32>();
        prior.push((skin.jaw[v] * left.max(0.0)).max(if skin.jaw[v] > 0.0 { 1e-6 } else { 0.0 }));
        for (field, weight) in fields.iter_mut().zip(fit::fit(skin.mesh, &shapes, skin.jaw_open, v, &movers, &prior, hold)) {
            field[v] = weight;
        }
    }
    // Lips and the pocket behind the lids are kept apart; on the cheek the line between upper and lower must not show.
    let is_open = |v: usize| matches!(skin.regions[v], Region::Face | Region::Body);
    let is_same = |a: usize, b: usize| {
        (skin.lips[a] == skin.lips[b] || (is_open(a) && is_open(b)))
            && (skin.regions[a] == Region::Socket) == (skin.regions[b] == Region::Socket)
    };
    for field in &mut fields {
        autorig::smooth(graph, field, 4, is_same);
    }
    // A corner that lifts while only one lip follows it would gape: there both move as one piece.
    for corner in skin.lip_corners {
        let distances = autorig::distances(graph, &[corner], CORNER_RANGE[1]);
        for field in &mut fields {
            let whole = field[corner as usize];
            for (weight, &distance) in field.iter_mut().zip(&distances) {
                *weight += (whole - *weight) * (1.0 - smoothstep(CORNER_RANGE[0], CORNER_RANGE[1], distance));
            }
        }
    }
    part_halves(skin.mesh, rig, &mut fields);
    fields
}

/// Indices of the reaches of mirrored pairs of bones, left and right.
fn pairs(rig: &Rig) -> Vec<[usize; 2]> {
    let name = |reach: &Reach| &rig.joints[usize::from(reach.joint)].name;
    let right_of = |stem: &str| rig.reaches.iter().position(|other| name(other).strip_suffix("_r") == Some(stem));
    rig.reaches.iter().enumerate().filter_map(|(left, reach)| Some([left, right_of(name(reach).strip_suffix("_l")?)?])).collect()
}

/// Share of the left one of a mirrored pair of bones at `x`.
fn share_of_left(x: f32) -> f32 {
    smoothstep(-HALVES_BLEND, HALVES_BLEND, x)
}

/// Gives what a bone has beyond the midline to its mirror image: half a face that moves leaves the other alone, and where both
/// move nothing changes.
fn part_halves(mesh: &Mesh, rig: &Rig, fields: &mut [Vec<f32>]) {
    for [left, right] in pairs(rig) {
        for (v, position) in mesh.positions.iter().enumerate() {
            let both = fields[left][v] + fields[right][v];
            fields[left][v] = share_of_left(position.x) * both;
            fields[right][v] = (1.0 - share_of_left(position.x)) * both;
        }
    }
}

/// As [`part_halves`] for the weights of all joints.
fn part_halves_of(mesh: &Mesh, rig: &Rig, weights: &mut Weights) {
    for joints in pairs(rig).iter().map(|pair| pair.map(|reach| rig.reaches[reach].joint)) {
        for (list, position) in weights.iter_mut().zip(&mesh.positions) {
            let both: f32 = list.iter().filter(|(joint, _)| joints.contains(joint)).map(|&(_, weight)| weight).sum();
            let left = share_of_left(position.x);
            let num_others = list.iter().filter(|(joint, _)| !joints.contains(joint)).count();
            // A vertex that has no place for a second joint gives all to the nearer half.
            let shares = if num_others + 2 > NUM_KEPT { [left.round(), 1.0 - left.round()] } else { [left, 1.0 - left] };
            if both > 0.0 {
                list.retain(|(joint, _)| !joints.contains(joint));
                list.extend(joints.into_iter().zip(shares.map(|share| share * both)).filter(|&(_, weight)| weight > 0.0));
            }
        }
    }
    weights.iter_mut().for_each(|list| list.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0))));
}

/// Influence of a bone's echoes.
fn echo(graph: &[Vec<(u32, f32)>], reach: &Reach, allows: impl Fn(usize) -> bool) -> Vec<f32> {
    let features: Vec<Feature> = reach.echoes.iter().map(|&(vertex, _, reach)| Feature { vertex, reach }).collect();
    let fields = autorig::influences(graph, &features, |_, v| allows(v));
    (0..graph.len()).map(|v| fields.iter().zip(&reach.echoes).map(|(field, echo)| field[v] * echo.1).fold(0.0, f32::max)).collect()
}

fn headness(p: Vec3) -> f32 {
    let height = p.y + NECK_TILT * p.z.clamp(-0.06, 0.10);
    smoothstep(NECK_RANGE[0], NECK_RANGE[1], height)
}

/// Hermite step from 0 at `low` to 1 at `high`.
pub fn smoothstep(low: f32, high: f32, x: f32) -> f32 {
    let t = ((x - low) / (high - low)).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

/// Cuts to four and quantises.
pub fn bind(weights: &Weights) -> Vec<Binding> {
    weights.iter().map(|weights| Binding::from_weights(weights.clone())).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn joints_fade_out_before_they_are_dropped() {
        // A line of vertices a millimetre apart on which a fifth joint comes up and takes over from the fourth.
        let num = 60_u32;
        let graph: Vec<Vec<(u32, f32)>> =
            (0..num).map(|v| [v.wrapping_sub(1), v + 1].into_iter().filter(|&u| u < num).map(|u| (u, 0.001)).collect()).collect();
        let mut weights: Weights = (0..num)
            .map(|v| {
                let rising = 0.2 * v as f32 / num as f32;
                vec![(0, 0.3), (1, 0.3), (2, 0.2), (3, 0.2 - rising), (4, rising)]
            })
            .collect();
        keep_four(&graph, &mut weights);
        let of = |v: usize, joint: u8| weights[v].iter().find(|(known, _)| *known == joint).map_or(0.0, |&(_, weight)| weight);
        for v in 0..num as usize {
            assert!(weights[v].len() <= 4 && (weights[v].iter().map(|w| w.1).sum::<f32>() - 1.0).abs() < 1e-5);
            if v > 0 {
                assert!((0..5).all(|joint| (of(v, joint) - of(v - 1, joint)).abs() < 0.05), "a step at {v}");
            }
        }
    }
}
