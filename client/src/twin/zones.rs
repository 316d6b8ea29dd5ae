//! Twins of the wrinkle zones.

use crate::renderer::ZoneBlend;
use glam::{Vec2, Vec3};

/// The maps of the zones at one place.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ZoneSample {
    /// Share of each zone here, as the masks have it.
    pub masks: [f32; 8],
    /// Partial derivatives of the wrinkles.
    pub wrinkled: Vec2,
    /// Partial derivatives of what stretching takes away.
    pub stretched: Vec2,
    /// Wrinkled less neutral unit normal.
    pub difference: Vec3,
}

/// Twin of the zones in `surface.wgsl` and `wrinkles.wgsl`: the unit tangent-space normal of `normal` (unit) with the
/// zones' wrinkles over it. `wrinkled` and `stretched` are a frame's weights in `[0, 1]`.
pub fn blend(mode: ZoneBlend, normal: Vec3, sample: &ZoneSample, wrinkled: &[f32], stretched: &[f32]) -> Vec3 {
    let amount = |weights: &[f32]| -> f32 { sample.masks.iter().zip(weights).map(|(mask, weight)| mask * weight).sum() };
    let slope = sample.wrinkled * amount(wrinkled) + sample.stretched * amount(stretched);
    match mode {
        ZoneBlend::PartialDerivatives => (normal.truncate() / normal.z.max(0.02) + slope).extend(1.0).normalize(),
        ZoneBlend::Difference => (normal + sample.difference * amount(wrinkled)).normalize(),
        ZoneBlend::TwoMaps => {
            let detail = slope.extend(1.0).normalize();
            Vec3::new(normal.x + detail.x, normal.y + detail.y, normal.z * detail.z).normalize()
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample(wrinkled: Vec2, difference: Vec3) -> ZoneSample {
        ZoneSample { masks: [0.5, 0.25, 0.0, 0.0, 0.0, 0.0, 0.1, 0.0], wrinkled, stretched: Vec2::ZERO, difference }
    }

    #[test]
    fn half_a_surprise_adds_three_tenths_of_the_wrinkles() {
        // Surprise 0.5 by Table 1.1 of the paper.
        let weights = [0.4, 0.4, 0.4, 0.4, 0.0, 0.0, 0.0, 0.0];
        let base = Vec3::new(0.1, 0.05, 1.0).normalize();
        let got = blend(ZoneBlend::PartialDerivatives, base, &sample(Vec2::new(0.4, -0.2), Vec3::ZERO), &weights, &[]);
        assert!((got - Vec3::new(0.21485154, -0.00976598, 0.97659789)).abs().max_element() < 1e-6, "{got}");
    }

    #[test]
    fn a_whole_difference_gives_the_wrinkled_normal_and_half_of_it_needs_renormalising() {
        let (neutral, wrinkled) = (Vec3::new(0.3, 0.1, 0.9486833), Vec3::new(-0.2, 0.4, 0.8944272));
        let of = |masks| ZoneSample { masks, ..sample(Vec2::ZERO, wrinkled - neutral) };
        let whole = blend(ZoneBlend::Difference, neutral, &of([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]), &[1.0], &[]);
        assert!((whole - wrinkled).abs().max_element() < 1e-6, "{whole}");
        let half = blend(ZoneBlend::Difference, neutral, &of([0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]), &[1.0], &[]);
        assert!((half - Vec3::new(0.0522919, 0.2614594, 0.963797)).abs().max_element() < 1e-6, "{half}");
    }
}
