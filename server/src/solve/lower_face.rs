//! Mouth and chin where their depth is not known.
//!
//! A performer's mouth lies some millimetres nearer or farther than the character's, and what the mouth does hides it from
//! the search for depths (`depth.rs`). As the head turns, a depth that is wrong by `dz` slides all these points together
//! by `-dz * dq`, `dq` being how much the slope of their rays in head space differs from what it was at neutral. A slide that
//! all of them share is explained by the likeliest `dz`: with `d` their mean displacement, normal priors for the depth
//! (standard deviation `sz`) and for what an expression moves all of them by (`se`),
//! `dz = -(d . dq) sz² / (sz² |dq|² + se²)`. From the front `dq` is zero, and nothing changes.

use super::head_pose::{self, Pose};
use glam::{DVec2, DVec3};

/// How far faces differ in the depth of the mouth, metres, once the eyes and the nose agree: measured 7 to 9 mm on two performers.
const DEPTH_SPREAD: f64 = 0.007;
/// How far expressions move mouth and chin as a whole, metres. Tuned on recordings of two performers: a correlation of the
/// strongest smile influence with the smiles the tracker saw of 0.77 and 0.47 (0.66 and 0.36 without any of this, 0.75 and
/// 0.44 with 1.5 mm); less would take the fall of a jaw for depth as soon as the head nods. A depth learnt over the session
/// instead wandered with the expressions and measured no better (0.74 and 0.46).
const MOTION_SPREAD: f64 = 0.001;
/// A face differs from the character's by no more than this, metres.
const FARTHEST: f64 = 0.012;

/// The points of mouth and chin and how they were seen at neutral.
#[derive(Debug, Clone, Default)]
pub(super) struct LowerFace {
    /// Places of the points in the session's.
    points: Vec<usize>,
    neutral: Vec<DVec2>,
    /// Slope of each one's ray at neutral, and how much it differs now.
    neutral_slopes: Vec<DVec2>,
    slopes: Vec<DVec2>,
}

impl LowerFace {
    pub(super) fn new(points: Vec<usize>) -> Self {
        let zero = vec![DVec2::ZERO; points.len()];
        Self { points, neutral: zero.clone(), neutral_slopes: zero.clone(), slopes: zero }
    }

    /// Takes a neutral face, `model`, as `pose` showed it.
    pub(super) fn adopt(&mut self, model: &[DVec3], pose: &Pose) {
        let matrix = pose.matrix();
        for (at, &i) in self.points.iter().enumerate() {
            let ray = head_pose::project(&matrix, pose.translation, model[i]);
            self.neutral[at] = model[i].truncate();
            self.neutral_slopes[at] = head_pose::slope(&matrix.transpose(), ray);
        }
    }

    /// Takes the shared slide out of `settled`, which holds the points as lifted. Points that are not sure neither tell of it nor
    /// are changed.
    pub(super) fn settle(&mut self, pose: &Pose, rays: &[DVec2], is_sure: &[bool], settled: &mut [DVec2]) {
        let head_from_camera = pose.matrix().transpose();
        let (mut moved, mut slope, mut num) = (DVec2::ZERO, DVec2::ZERO, 0.0);
        for (at, &i) in self.points.iter().enumerate().filter(|(_, i)| is_sure[**i]) {
            self.slopes[at] = head_pose::slope(&head_from_camera, rays[i]) - self.neutral_slopes[at];
            moved += settled[i] - self.neutral[at];
            slope += self.slopes[at];
            num += 1.0;
        }
        if num == 0.0 {
            return;
        }
        let depth = likeliest_depth(moved / num, slope / num);
        for (at, &i) in self.points.iter().enumerate().filter(|(_, i)| is_sure[**i]) {
            settled[i] += self.slopes[at] * depth;
        }
    }
}

/// How much farther to the front the points lie than is assumed, metres.
fn likeliest_depth(moved: DVec2, slope: DVec2) -> f64 {
    const DEPTH_SQUARE: f64 = DEPTH_SPREAD * DEPTH_SPREAD;
    let depth = -moved.dot(slope) * DEPTH_SQUARE / (DEPTH_SQUARE * slope.length_squared() + MOTION_SPREAD * MOTION_SPREAD);
    depth.clamp(-FARTHEST, FARTHEST)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_slide_is_depth_only_where_the_head_has_turned() {
        let slide = |slope: DVec2| slope * -0.008;
        let turned = DVec2::new(0.45, 0.1);
        let depth = likeliest_depth(slide(turned), turned);
        assert!((depth - 0.008).abs() < 0.001, "{depth}");
        assert_eq!(likeliest_depth(DVec2::new(0.003, -0.004), DVec2::ZERO), 0.0, "from the front nothing is explained");
        // A mouth that opens while the head looks aside moves across the slide.
        assert_eq!(likeliest_depth(DVec2::new(0.0, -0.006), DVec2::new(0.4, 0.0)), 0.0);
        assert_eq!(likeliest_depth(slide(turned) * 9.0, turned), FARTHEST);
    }
}
