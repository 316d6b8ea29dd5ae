//! Eyes from where the irises stand between the corners.

use super::points::EyePoints;
use glam::DVec2;

/// Radius of the circle an iris centre moves on, over the width of the eye: about 10.5 mm over 30 mm.
const RADIUS: f64 = 0.35;
/// A neutral gaze is believed to be off the middle of the eye by no more than this share of its width.
const MOST_OFFSET: f64 = 0.15;

/// One eye's measure, fixed at calibration.
#[derive(Debug, Clone, Copy)]
pub(super) struct GazeMeasure {
    points: EyePoints,
    iris: usize,
    /// Where the iris stands from the middle of the corners when looking straight ahead, metres.
    ahead: DVec2,
    radius: f64,
}

impl GazeMeasure {
    /// Measures the neutral face, which looks straight ahead.
    pub(super) fn new(points: EyePoints, iris: usize, neutral: &[DVec2]) -> Self {
        let width = neutral[points.corners.0].distance(neutral[points.corners.1]).max(1e-6);
        let mut measure = Self { points, iris, ahead: DVec2::ZERO, radius: RADIUS * width };
        let most = DVec2::splat(MOST_OFFSET * width);
        measure.ahead = measure.offset(neutral).clamp(-most, most);
        measure
    }

    fn offset(&self, points: &[DVec2]) -> DVec2 {
        points[self.iris] - (points[self.points.corners.0] + points[self.points.corners.1]) * 0.5
    }

    /// Pitch (down is positive) and yaw (towards the character's left is positive), radians.
    pub(super) fn pitch_yaw(&self, points: &[DVec2]) -> (f64, f64) {
        let moved = (self.offset(points) - self.ahead) / self.radius;
        let arc_sine = |sine: f64| std::f64::consts::FRAC_PI_2 - libm::acos(sine.clamp(-1.0, 1.0));
        (-arc_sine(moved.y), arc_sine(moved.x))
    }
}
