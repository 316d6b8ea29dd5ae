//! Lids: how far each vertex turns with them, and that the eyeball never pierces them.

use super::autorig;
use super::bust::{Eyeball, Region};
use super::eyes;
use super::mesh::Mesh;
use super::weights::{shape, turn_angles};
use glam::{Mat3, Vec3};
use rhytid_shared::layout::NUM_IBUG;

/// What the rig needs to know of the lids. Sides are left, right; kinds upper, lower.
pub struct Lids {
    /// Share of each lid's turn: `fields[side][kind][vertex]`.
    pub fields: [[Vec<f32>; 2]; 2],
    /// Driver points on the margins.
    pub points: [[Vec3; 2]; 2],
}

/// Angles about +X, degrees, that shut and that widen: `[upper, lower][shut, wide]`.
pub const LID_DEGREES: [[f32; 2]; 2] = [[SHUT_DEGREES, -9.0], [-1.0, 3.0]];
/// Turn of the upper lid whose share is 1. With that of the shape `eyeBlink` (the middle 44 degrees, the outer part 50)
/// it would go on for 2 mm over the edge of the lower lid, whose lashes would stick out of it.
const SHUT_DEGREES: f32 = 47.5;
/// Turn in the shape that makes a share of 1.
const SHAPE_DEGREES: f32 = 49.0;
/// Skin stays this far from the ball, metres.
const CLEARANCE: f32 = 0.000_35;
/// A vertex this far inside the ball belongs to the pocket behind the lids, metres.
const HIDDEN_DEPTH: f32 = 0.000_5;

const BLINKS: [&str; 2] = ["eyeBlinkLeft", "eyeBlinkRight"];
const SQUINTS: [&str; 2] = ["eyeSquintLeft", "eyeSquintRight"];
/// Landmarks on both sides of the middle of each margin.
const MARGINS: [[[usize; 2]; 2]; 2] = [[[43, 44], [46, 47]], [[37, 38], [40, 41]]];

/// Derives the fields from the blink and squint shapes.
pub fn fields(mesh: &Mesh, regions: &[Region], eyes: [Eyeball; 2], ibug68: &[Vec3; NUM_IBUG]) -> Lids {
    let graph = autorig::edge_graph(mesh);
    let mut points = [[Vec3::ZERO; 2]; 2];
    let fields = [0, 1].map(|s| {
        for k in 0..2 {
            let [a, b] = MARGINS[s][k];
            let middle = (ibug68[a] + ibug68[b]) * 0.5;
            points[s][k] = mesh.positions[autorig::nearest(&mesh.positions, middle, |v| regions[v] != Region::Socket) as usize];
        }
        let eye = eyes[s];
        // Behind the ball's middle the angle means nothing.
        let is_in_front =
            |v: usize| mesh.positions[v].z > eye.centre.z - 0.002 && mesh.positions[v].distance(eye.centre) < 2.2 * eye.radius;
        let angles = |name: &str| turn_angles(&mesh.positions, &mesh.morphs[shape(name)], eye.centre, 0.010);
        let field = |angles: Vec<f32>, full_degrees: f32| {
            let mut field: Vec<f32> = angles
                .iter()
                .enumerate()
                .map(|(v, angle)| if is_in_front(v) { (angle.to_degrees() / full_degrees).clamp(0.0, 1.0) } else { 0.0 })
                .collect();
            autorig::smooth(&graph, &mut field, 1, |_, _| true);
            field
        };
        let upper = field(angles(BLINKS[s]), SHAPE_DEGREES);
        let squint = angles(SQUINTS[s]);
        let mut lowest: Vec<f32> =
            (0..squint.len()).filter(|&v| is_in_front(v) && regions[v] == Region::Eyelid).map(|v| squint[v]).collect();
        lowest.sort_by(f32::total_cmp);
        // A hundredth of the lid may turn further than full: noise near the corners.
        let full = lowest.get(lowest.len() / 100).copied().unwrap_or(-0.1).min(-0.01);
        let mut lower = field(squint, full.to_degrees());
        for (lower, upper) in lower.iter_mut().zip(&upper) {
            *lower = lower.min(1.0 - upper);
        }
        [upper, lower]
    });
    Lids { fields, points }
}

/// Moves lid vertices outwards, in the neutral and at the end of a blink, until they clear the ball both open and shut.
pub fn clear_the_ball(mesh: &mut Mesh, regions: &[Region], eyes: [Eyeball; 2], fields: &[[Vec<f32>; 2]; 2]) {
    let neighbours = mesh.neighbours();
    let shut = turn(SHUT_DEGREES.to_radians());
    for s in 0..2 {
        let eye = eyes[s];
        let needed = |arm: Vec3| eyes::surface_radius(arm, eye.radius) + CLEARANCE;
        let mut lift = vec![0.0_f32; mesh.positions.len()];
        for v in 0..lift.len() {
            let arm = mesh.positions[v] - eye.centre;
            let is_lid = arm.length() < 1.6 * eye.radius && arm.z > 0.1 * eye.radius && matches!(regions[v], Region::Eyelid | Region::Face);
            if !is_lid || arm.length() < eye.radius - HIDDEN_DEPTH {
                continue;
            }
            let blinked = arm.lerp(shut * arm, fields[s][0][v]);
            lift[v] = (needed(arm) - arm.length()).max(needed(blinked) - blinked.length()).max(0.0);
        }
        // Spread, so that the raised vertices make no step.
        for _ in 0..3 {
            lift = (0..lift.len())
                .map(|v| {
                    let around = &neighbours[v];
                    let mean = around.iter().map(|&u| lift[u as usize]).sum::<f32>() / around.len().max(1) as f32;
                    if regions[v] == Region::Socket { lift[v] } else { lift[v].max(0.75 * mean) }
                })
                .collect();
        }
        let blink = shape(BLINKS[s]);
        for v in 0..lift.len() {
            let arm = mesh.positions[v] - eye.centre;
            let out = arm.normalize_or_zero();
            mesh.positions[v] += out * lift[v];
            let arm = arm + out * lift[v];
            if arm.length() > eye.radius && fields[s][0][v] > 0.02 {
                let end = arm + mesh.morphs[blink][v];
                mesh.morphs[blink][v] += end.normalize_or_zero() * (needed(end) - end.length()).max(0.0);
            }
        }
    }
}

/// Rotation about +X; positive turns the front down.
fn turn(angle: f32) -> Mat3 {
    let (sin, cos) = libm::sincosf(angle);
    Mat3::from_cols(Vec3::X, Vec3::new(0.0, cos, sin), Vec3::new(0.0, -sin, cos))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn positive_turn_carries_the_front_down() {
        let turned = turn(0.5) * Vec3::Z;
        assert!(turned.y < -0.4 && turned.z > 0.8);
        let angles = turn_angles(&[Vec3::Z * 0.02], &[(turned - Vec3::Z) * 0.02], Vec3::ZERO, 0.01);
        assert!((angles[0] - 0.5).abs() < 1e-5);
    }
}
