//! Skinning weights of the skin: lids and jaw from the expression shapes' own motion, the face's skin bones by the
//! automatic rig, neck and shoulders by height.

use super::autorig::{self, Feature};
use super::bust::{Eyeball, Region};
use super::mesh::Mesh;
use super::part::Binding;
use super::rig::{HEAD, ROOT, Rig, Zone};
use glam::Vec3;
use rhytid_shared::ARKIT_NAMES;

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
    /// Eyes, left and right.
    pub eyes: [Eyeball; 2],
    /// Share of the jaw's turn of every vertex.
    pub jaw: Vec<f32>,
    /// Share of each lid's turn: `lids[left, right][upper, lower]`.
    pub lids: [[Vec<f32>; 2]; 2],
}

/// Weights of every vertex over the joints, summing to one, before they are cut to four.
pub type Weights = Vec<Vec<(u8, f32)>>;

/// Height, tilted forwards, over which the neck passes from the torso (0) to the head (1), metres.
const NECK_TILT: f32 = 0.72;
const NECK_RANGE: [f32; 2] = [-0.125, -0.058];

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

use glam::Vec3Swizzles;

/// Weights by all rules.
pub fn build(skin: &Skin<'_>, rig: &Rig) -> Weights {
    let num_vertices = skin.mesh.positions.len();
    let graph = autorig::edge_graph(skin.mesh);
    let features: Vec<Feature> = rig.reaches.iter().map(|reach| Feature { vertex: reach.vertex, reach: reach.reach }).collect();
    let allows = |j: usize, v: usize| {
        let is_lined = matches!(skin.regions[v], Region::Socket | Region::Cap);
        match rig.reaches[j].zone {
            Zone::Open => !is_lined,
            Zone::UpperLip => !is_lined && skin.lips[v] == Lip::Upper,
            Zone::LowerLip => !is_lined && skin.lips[v] == Lip::Lower,
        }
    };
    let mut influences = autorig::influences(&graph, &features, allows);
    for influence in &mut influences {
        autorig::smooth(&graph, influence, 2, |a, b| skin.lips[a] == skin.lips[b] && skin.regions[a] != Region::Socket && skin.regions[b] != Region::Socket);
    }
    let jaw = rig.joint_of("jaw");
    let lid_joints = [["lid_upper_l", "lid_lower_l"], ["lid_upper_r", "lid_lower_r"]].map(|pair| pair.map(|name| rig.joint_of(name)));
    (0..num_vertices)
        .map(|v| {
            let mut weights: Vec<(u8, f32)> = Vec::new();
            let mut left = 1.0;
            for (joints, fields) in lid_joints.iter().zip(&skin.lids) {
                for (&joint, field) in joints.iter().zip(fields) {
                    let weight = field[v].clamp(0.0, left);
                    weights.push((joint, weight));
                    left -= weight;
                }
            }
            let raw: Vec<f32> = influences.iter().map(|influence| influence[v]).collect();
            let mut skin_share = 0.0;
            for (share, reach) in autorig::shares(&raw).into_iter().zip(&rig.reaches) {
                weights.push((reach.joint, share * left));
                skin_share += share;
            }
            left *= (1.0 - skin_share).max(0.0);
            let jaw_share = skin.jaw[v] * left;
            weights.push((jaw, jaw_share));
            left -= jaw_share;
            let on_head = headness(skin.mesh.positions[v]);
            weights.push((HEAD, left * on_head));
            weights.push((ROOT, left * (1.0 - on_head)));
            // What does not turn with the head takes no face bones either; the fields end above it anyway.
            weights.retain(|&(_, weight)| weight > 0.0);
            weights
        })
        .collect()
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
