//! Eyelids from how open an eye is. Openness is absolute: no neutral is subtracted, so that a blink shuts the lids
//! fully for whoever sits with half-closed eyes, too.

use super::points::EyePoints;
use glam::DVec2;
use rhytid_shared::character::LidKind;

/// Opening over width of eyes that rest open, as trackers see most people's. What is measured below it may be a neutral
/// taken with tired eyes, and is believed by half.
const OPEN_USUAL: f64 = 0.29;
const OPEN_LEAST: f64 = 0.22;
const OPEN_MOST: f64 = 0.38;
/// An eye is shut at this share of its open ratio: trackers rarely let the lids meet (blinks of 0.1 s are half missed at 25 Hz).
const SHUT_SHARE: f64 = 0.34;
/// Openness from which an eye is wide, and at which it is widest.
const WIDE_FROM: f64 = 1.08;
const WIDEST: f64 = 1.4;

/// One eye's measure, fixed at calibration.
#[derive(Debug, Clone, Copy)]
pub(super) struct LidMeasure {
    points: EyePoints,
    /// Width of the eye at neutral, metres: squints do not change the measure.
    width: f64,
    /// Ratios at which the eye is open and shut.
    open: f64,
    shut: f64,
}

impl LidMeasure {
    /// Measures the neutral face.
    pub(super) fn new(points: EyePoints, neutral: &[DVec2]) -> Self {
        let width = neutral[points.corners.0].distance(neutral[points.corners.1]).max(1e-6);
        let mut measure = Self { points, width, open: 1.0, shut: 0.0 };
        let measured = measure.ratio(neutral);
        measure.open = measured.max(0.5 * (measured + OPEN_USUAL)).clamp(OPEN_LEAST, OPEN_MOST);
        measure.shut = SHUT_SHARE * measure.open;
        measure
    }

    /// Mean opening over width.
    fn ratio(&self, points: &[DVec2]) -> f64 {
        let [(upper_a, lower_a), (upper_b, lower_b)] = self.points.lids;
        0.5 * ((points[upper_a].y - points[lower_a].y) + (points[upper_b].y - points[lower_b].y)) / self.width
    }

    /// 0 shut, 1 open, above 1 wide.
    pub(super) fn openness(&self, points: &[DVec2]) -> f64 {
        ((self.ratio(points) - self.shut) / (self.open - self.shut)).max(0.0)
    }
}

/// Angle of a lid about +X for an openness.
pub(super) fn lid_pitch(openness: f64, shut_angle: f64, wide_angle: f64) -> f64 {
    if openness < 1.0 {
        (1.0 - openness) * shut_angle
    } else {
        ((openness - WIDE_FROM) / (WIDEST - WIDE_FROM)).clamp(0.0, 1.0) * wide_angle
    }
}

/// Share of the eye's up and down that a lid follows where nothing has measured the lid itself.
pub(super) fn gaze_share(lid: LidKind) -> f64 {
    match lid {
        LidKind::Upper => 0.35,
        LidKind::Lower => 0.15,
    }
}

#[cfg(test)]
mod tests {
    use super::super::points::RIGHT_EYE;
    use super::*;

    /// An eye 30 mm wide, open by `ratio` of that.
    fn eye(ratio: f64) -> Vec<DVec2> {
        let mut points = vec![DVec2::ZERO; 68];
        points[36] = DVec2::new(-0.045, 0.0);
        points[39] = DVec2::new(-0.015, 0.0);
        for (upper, lower) in RIGHT_EYE.lids {
            points[upper].y = 0.6 * ratio * 0.03;
            points[lower].y = -0.4 * ratio * 0.03;
        }
        points
    }

    #[test]
    fn a_blink_shuts_fully_even_for_a_half_closed_neutral() {
        for neutral in [0.30, 0.22, 0.15, 0.10] {
            let measure = LidMeasure::new(RIGHT_EYE, &eye(neutral));
            assert_eq!(measure.openness(&eye(0.05)), 0.0, "neutral {neutral}");
            assert!((lid_pitch(measure.openness(&eye(0.05)), 0.5, -0.1) - 0.5).abs() < 1e-12);
        }
    }

    #[test]
    fn open_neutral_is_rest_and_half_closed_neutral_is_half_closed() {
        let open = LidMeasure::new(RIGHT_EYE, &eye(0.30));
        assert!((open.openness(&eye(0.30)) - 1.0).abs() < 1e-12);
        let sleepy = LidMeasure::new(RIGHT_EYE, &eye(0.15));
        let at_rest = sleepy.openness(&eye(0.15));
        assert!(at_rest > 0.3 && at_rest < 0.7, "{at_rest}");
        assert!((sleepy.openness(&eye(0.22)) - 1.0).abs() < 1e-9, "their eyes open fully when they do");
    }

    #[test]
    fn surprise_widens_and_noise_does_not() {
        let measure = LidMeasure::new(RIGHT_EYE, &eye(0.30));
        assert_eq!(lid_pitch(measure.openness(&eye(0.31)), 0.5, -0.1), 0.0);
        assert!(lid_pitch(measure.openness(&eye(0.40)), 0.5, -0.1) < -0.05);
    }
}
