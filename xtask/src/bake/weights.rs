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

/// Weights of every vertex over the joints, summing to one, before they are cut to four.
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
    (0..skin.mesh.positions.len())
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
        .collect()
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
    fields
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
