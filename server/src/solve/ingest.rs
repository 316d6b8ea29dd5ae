//! From a tracker's pixels to rays of the camera, with the checks that need the session.

use super::error::SolveError;
use super::points::PointSet;
use glam::DVec2;
use rhytid_shared::PublishHello;
use rhytid_shared::layout::Layout;
use rhytid_shared::limits::FOCAL_RANGE;

/// Landmarks may lie outside the picture, but not by more than this many of its sizes.
const FARTHEST: f32 = 10.0;
/// Points that spread less than this (root mean square), pixels, are no face.
const LEAST_SPREAD: f64 = 0.3;
/// A landmark less sure than this is not believed: its last place serves.
const LEAST_CONFIDENCE: f32 = 0.3;

/// A pinhole camera without distortion, principal point in the middle of the picture.
#[derive(Debug, Clone, Copy)]
pub(super) struct Camera {
    /// Pixels.
    focal: f64,
    centre: DVec2,
    image: [f32; 2],
    mirror: bool,
}

/// One frame's points as rays: `(x, y)` at distance 1, x to the right and y *down* the picture.
#[derive(Debug, Clone, Default)]
pub(super) struct Observation {
    /// The points, then the irises where the layout has them.
    pub(super) rays: Vec<DVec2>,
    /// Whether each ray is to be believed.
    pub(super) is_sure: Vec<bool>,
}

impl Camera {
    pub(super) fn new(hello: &PublishHello, mirror: bool) -> Result<Self, SolveError> {
        let image = hello.image.ok_or(SolveError::NoImage)?;
        for got in image {
            if !(got.is_finite() && got > 0.0) {
                return Err(SolveError::BadCamera { field: "image", got });
            }
        }
        // Unknown lenses: webcams and phones see about 50 to 60 degrees, which is a focal length near the width.
        let focal = hello.focal.unwrap_or(image[0]);
        if !(focal.is_finite() && focal > 0.0) {
            return Err(SolveError::BadCamera { field: "focal", got: focal });
        }
        let [least, most] = FOCAL_RANGE.map(|widths| widths * image[0]);
        if !(least..=most).contains(&focal) {
            return Err(SolveError::FocalRange { got: focal, least, most });
        }
        let centre = DVec2::new(f64::from(image[0]), f64::from(image[1])) * 0.5;
        Ok(Self { focal: f64::from(focal), centre, image, mirror })
    }

    /// Spread of rays (root mean square) below which they are no face.
    pub(super) fn least_spread(&self) -> f64 {
        LEAST_SPREAD / self.focal
    }

    fn ray(&self, pixel: [f32; 3]) -> DVec2 {
        let x = (f64::from(pixel[0]) - self.centre.x) / self.focal;
        DVec2::new(if self.mirror { -x } else { x }, (f64::from(pixel[1]) - self.centre.y) / self.focal)
    }

    /// Checks a frame's landmarks and turns them into `observation`, which is untouched on an error.
    pub(super) fn observe(
        &self,
        layout: &Layout,
        points: &PointSet,
        landmarks: &[[f32; 3]],
        confidence: &[f32],
        observation: &mut Observation,
    ) -> Result<(), SolveError> {
        let expected = layout.num_points();
        if landmarks.len() != expected {
            return Err(SolveError::PointCount { got: landmarks.len(), expected });
        }
        if !confidence.is_empty() && confidence.len() != expected {
            return Err(SolveError::ConfidenceCount { got: confidence.len(), expected });
        }
        let farthest = [FARTHEST * self.image[0], FARTHEST * self.image[1], FARTHEST * self.image[0]];
        for (index, point) in landmarks.iter().enumerate() {
            for axis in 0..3 {
                let got = point[axis];
                if !(got.is_finite() && got.abs() <= farthest[axis]) {
                    return Err(SolveError::Value { field: "landmarks", index, got, expected: "within ten sizes of the picture" });
                }
            }
        }
        for (index, &got) in confidence.iter().enumerate() {
            if !(0.0..=1.0).contains(&got) {
                return Err(SolveError::Value { field: "confidence", index, got, expected: "0 to 1" });
            }
        }
        observation.rays.clear();
        observation.is_sure.clear();
        for &source in points.source_of.iter().chain(points.irises.iter().flatten()) {
            observation.rays.push(self.ray(landmarks[source]));
            observation.is_sure.push(confidence.get(source).is_none_or(|&sure| sure >= LEAST_CONFIDENCE));
        }
        Ok(())
    }
}
