//! The depth of a performer's own face, from how its points shift against each other as the head turns.
//!
//! A single picture shows no depth, so the character's serves at first. Where it is wrong by `dz`, a point that is lifted
//! onto the character's depth slides by `-dz * q` as the head turns, `q` being the sideways slope of the ray in head
//! space. Regressing the slide on `q` over a session gives `dz`. Left and right are taken together: what an expression
//! does to both sides cancels.

use super::head_pose::{self, Pose};
use glam::{DVec2, DVec3};

/// Passes over the frames; each brings the head poses and the depths closer to each other.
const PASSES: usize = 3;
/// A face differs from the character's in depth by no more than this, as a fraction of the interocular distance.
const FARTHEST: f64 = 0.25;

/// What places and lifts a performer's face.
pub(super) struct Shape<'a> {
    /// The performer's points; z is refined.
    pub(super) model: &'a mut [DVec3],
    /// The character's depth of each.
    pub(super) prior: &'a [f64],
    /// Spread of `q` (radians, about) from which the depth of each point is believed by half: the more its own motion hides
    /// the slide, the more the head must have turned.
    pub(super) believed_spread: &'a [f64],
    /// The point on the other side of the face.
    pub(super) mirror: &'a [usize],
    /// Each iris and the corners of its eye, whose depth it takes: eyes that stay on the screen turn against the head, and
    /// that would pass for depth.
    pub(super) irises: &'a [(usize, (usize, usize))],
    pub(super) stable: &'a [(usize, f64)],
    /// True where the stable points are enough for a pose in perspective, and so for depths.
    pub(super) has_perspective: bool,
    /// Interocular distance, metres.
    pub(super) unit: f64,
    /// The character's head pivot.
    pub(super) pivot: DVec3,
}

#[derive(Debug, Clone, Copy, Default)]
struct Sums {
    q: f64,
    x: f64,
    qq: f64,
    qx: f64,
}

/// Refines the depths over frames given as rays of all points and the pose they were placed with.
pub(super) fn refine<'a>(shape: &mut Shape<'_>, frames: impl Iterator<Item = (Pose, &'a [DVec2])> + Clone) {
    let num = frames.clone().count() as f64;
    if num < 2.0 || !shape.has_perspective {
        return;
    }
    let mut sums = vec![Sums::default(); shape.model.len()];
    for _ in 0..PASSES {
        sums.fill(Sums::default());
        for (pose, rays) in frames.clone() {
            let Ok(fit) = head_pose::refine(Some(pose), shape.model, rays, shape.stable, shape.unit) else { continue };
            let matrix = fit.pose.matrix();
            for (i, sums) in sums.iter_mut().enumerate() {
                let (point, slope) = head_pose::lift_with_slope(&matrix, fit.pose.translation, rays[i], shape.model[i].z);
                sums.q += slope.x;
                sums.x += point.x;
                sums.qq += slope.x * slope.x;
                sums.qx += slope.x * point.x;
            }
        }
        let spread_of = |i: usize| sums[i].qq - sums[i].q * sums[i].q / num;
        let slide_of = |i: usize| sums[i].qx - sums[i].q * sums[i].x / num;
        for i in 0..shape.model.len() {
            let other = shape.mirror[i];
            let spread = 0.5 * (spread_of(i) + spread_of(other));
            let slide = 0.5 * (slide_of(i) + slide_of(other));
            let believed = shape.believed_spread[i];
            let step = -slide / (spread + num * believed * believed);
            let most = FARTHEST * shape.unit;
            shape.model[i].z = (shape.model[i].z + step).clamp(shape.prior[i] - most, shape.prior[i] + most);
        }
        for &(iris, (outer, inner)) in shape.irises {
            shape.model[iris].z = 0.5 * (shape.model[outer].z + shape.model[inner].z);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::rotation;
    use super::*;
    use glam::DQuat;

    #[test]
    fn a_longer_nose_is_found_from_turns_of_the_head() {
        let face = [
            DVec3::new(-0.045, 0.0, 0.0),
            DVec3::new(0.045, 0.0, 0.0),
            DVec3::new(-0.016, 0.0, 0.006),
            DVec3::new(0.016, 0.0, 0.006),
            DVec3::new(0.0, 0.005, 0.02),
            DVec3::new(0.0, -0.035, 0.052),
            DVec3::new(-0.012, -0.045, 0.03),
            DVec3::new(0.012, -0.045, 0.03),
            DVec3::new(-0.03, 0.025, 0.02),
            DVec3::new(0.03, 0.025, 0.02),
        ];
        let mirror = [1, 0, 3, 2, 4, 5, 7, 6, 9, 8];
        let stable: Vec<(usize, f64)> = (0..8).map(|i| (i, 1.0)).collect();
        // The character's brows lie 10 mm farther back, its nose tip 6 mm.
        let prior = [0.0, 0.0, 0.006, 0.006, 0.02, 0.046, 0.03, 0.03, 0.01, 0.01];
        let mut model: Vec<DVec3> = face.iter().zip(prior).map(|(p, z)| DVec3::new(p.x, p.y, z)).collect();
        let poses: Vec<Pose> = (-10..=10)
            .map(|step| Pose {
                rotation: DQuat::from_xyzw(1.0, 0.0, 0.0, 0.0) * rotation::from_pitch_yaw(0.05, f64::from(step) * 0.03),
                translation: DVec3::new(0.0, 0.0, 0.6),
            })
            .collect();
        let rays: Vec<Vec<DVec2>> =
            poses.iter().map(|pose| face.iter().map(|p| head_pose::project(&pose.matrix(), pose.translation, *p)).collect()).collect();
        let brow_slide = |model: &[DVec3]| {
            let lifted = |at: usize| {
                let fit = head_pose::refine(Some(poses[at]), model, &rays[at], &stable, 0.09).expect("a face");
                head_pose::lift(&fit.pose.matrix(), fit.pose.translation, rays[at][8], model[8].z)
            };
            (lifted(0) - lifted(20)).truncate().length()
        };
        let before = brow_slide(&model);
        let believed_spread = [0.03; 10];
        let mut shape = Shape {
            model: &mut model,
            prior: &prior,
            believed_spread: &believed_spread,
            mirror: &mirror,
            irises: &[],
            stable: &stable,
            has_perspective: true,
            unit: 0.09,
            pivot: DVec3::ZERO,
        };
        refine(&mut shape, poses.iter().copied().zip(rays.iter().map(Vec::as_slice)));
        let after = brow_slide(&model);
        assert!(before > 0.004 && after < 0.25 * before, "{before} {after}");
    }
}
