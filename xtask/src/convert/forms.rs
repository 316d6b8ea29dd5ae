//! The forms a wrinkled normal takes, and what storing them in eight bits costs (Jimenez et al. 2011, section 1.2).

use glam::{Vec2, Vec3};
use std::fmt;

/// Largest scale of derivatives in a character file.
pub const MAX_SCALE: f32 = 4.0;
/// Normals that lean farther than this are held there before they are divided by z: 88.9 degrees.
const LEAST_Z: f32 = 0.02;

/// One texel of wrinkled skin: unit normals in tangent space.
#[derive(Debug, Clone, Copy)]
pub struct Texel {
    /// With its wrinkles.
    pub wrinkled: Vec3,
    /// Of the neutral skin.
    pub base: Vec3,
}

impl Texel {
    /// What the wrinkles add to the base's derivatives.
    pub fn derivatives(&self) -> Vec2 {
        derivatives_of(self.wrinkled) - derivatives_of(self.base)
    }
}

/// `(code - 128) / 127`, not below -1: 0 is exact.
pub fn value_of(code: f32) -> f32 {
    ((code - 128.0) / 127.0).max(-1.0)
}

/// The code of a value, held within `[-1, 1]`.
pub fn code_of(value: f32) -> u8 {
    (128.0 + libm::roundf(127.0 * value.clamp(-1.0, 1.0))) as u8
}

/// The unit normal of a decoded texel; what leans back is held just before the edge, and nothing at all is flat.
pub fn normal_of(value: Vec3) -> Vec3 {
    let n = value.normalize_or(Vec3::Z);
    if n.z >= LEAST_Z { n } else { Vec3::new(n.x, n.y, LEAST_Z).normalize() }
}

/// `n.xy / n.z`.
pub fn derivatives_of(normal: Vec3) -> Vec2 {
    normal.truncate() / normal.z.max(LEAST_Z)
}

/// The normal that derivatives make of a base.
pub fn from_derivatives(derivatives: Vec2, base: Vec3) -> Vec3 {
    (derivatives_of(base) + derivatives).extend(1.0).normalize()
}

/// The normal that a difference makes of a base.
pub fn from_difference(difference: Vec3, base: Vec3) -> Vec3 {
    (base + difference).normalize_or(base)
}

/// Angle between two unit vectors, radians; exact for small ones.
pub fn angle(a: Vec3, b: Vec3) -> f32 {
    libm::atan2f(a.cross(b).length(), a.dot(b))
}

/// The smallest step of 0.05 that holds all derivatives, at most [`MAX_SCALE`].
pub fn scale_for(texels: &[Texel]) -> f32 {
    let most = texels.iter().map(|texel| texel.derivatives().abs().max_element()).fold(0.0, f32::max);
    // Twentieths, so that the scale prints as it is.
    (libm::ceilf(most * 20.0 - 1e-3).max(1.0) / 20.0).min(MAX_SCALE)
}

/// What writing texels in eight bits cost.
#[derive(Debug, Clone, Copy, Default)]
pub struct Loss {
    num_texels: usize,
    num_clipped: usize,
    /// Radians.
    sum: f64,
    largest: f32,
}

impl Loss {
    /// The codes of `value`, whose loss against `texel` is counted; `decode` gives the normal that the codes' values make.
    pub fn count(&mut self, texel: &Texel, value: Vec3, decode: impl Fn(Vec3) -> Vec3) -> [u8; 3] {
        let codes = value.to_array().map(code_of);
        let off = angle(texel.wrinkled, decode(Vec3::from(codes.map(|code| value_of(f32::from(code))))));
        self.num_texels += 1;
        // What rounds to the last code is not lost.
        self.num_clipped += usize::from(value.abs().max_element() > 1.0 + 0.5 / 127.0);
        self.sum += f64::from(off);
        self.largest = self.largest.max(off);
        codes
    }

    /// Mean angle between what was meant and what is stored, radians.
    pub fn mean(&self) -> f64 {
        self.sum / self.num_texels.max(1) as f64
    }
}

impl fmt::Display for Loss {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "loss: mean {:.3} degrees, largest {:.3} degrees; {} of {} texels clipped",
            self.mean().to_degrees(),
            self.largest.to_degrees(),
            self.num_clipped,
            self.num_texels
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const N: Vec3 = Vec3::new(0.3, 0.1, 0.948_683_3);
    const W: Vec3 = Vec3::new(-0.2, 0.4, 0.894_427_2);

    #[track_caller]
    fn assert_near(got: Vec3, want: Vec3) {
        assert!((got - want).abs().max_element() < 1e-5, "got {got}, expected {want}");
    }

    #[test]
    fn derivatives_hold_45_degrees_and_clip_beyond() {
        for (degrees, code, stored) in [(0.0_f32, 128, 0.0), (30.0, 201, 29.891), (45.0, 255, 45.0), (50.0, 255, 45.0)] {
            let (sin, cos) = libm::sincosf(degrees.to_radians());
            let texel = Texel { wrinkled: Vec3::new(sin, 0.0, cos), base: Vec3::Z };
            let mut loss = Loss::default();
            let codes = loss.count(&texel, texel.derivatives().extend(0.0), |value| from_derivatives(value.truncate(), Vec3::Z));
            assert_eq!(codes, [code, 128, 128], "{degrees} degrees");
            let back = from_derivatives(Vec2::new(value_of(f32::from(code)), 0.0), Vec3::Z);
            assert!((angle(Vec3::Z, back).to_degrees() - stored).abs() < 1e-3, "{degrees}: {}", angle(Vec3::Z, back).to_degrees());
            assert_eq!(loss.num_clipped, usize::from(degrees > 45.0), "{degrees} degrees");
            assert!((loss.mean().to_degrees() - f64::from((degrees - stored).abs())).abs() < 1e-3);
        }
        // On the diagonal the square reaches farther.
        assert!((angle(Vec3::Z, from_derivatives(Vec2::ONE, Vec3::Z)).to_degrees() - 54.7356).abs() < 1e-3);
    }

    #[test]
    fn derivatives_against_a_base_add_as_heights_do() {
        let texel = Texel { wrinkled: Vec3::new(-0.05, 0.35, 0.935_414_35), base: Vec3::new(0.1, 0.05, 0.993_730_35) };
        let delta = texel.derivatives();
        assert_near(delta.extend(0.0), Vec3::new(-0.154_083_17, 0.323_850_28, 0.0));
        assert_near(from_derivatives(delta, texel.base), texel.wrinkled);
        assert_near(from_derivatives(delta * 0.5, texel.base), Vec3::new(0.023_069_19, 0.207_560_71, 0.977_950_08));
    }

    #[test]
    fn differences_give_the_normal_back_unless_they_clip() {
        let difference = W - N;
        assert_near(difference * 0.5 + Vec3::splat(0.5), Vec3::new(0.25, 0.65, 0.472_871_9));
        assert_near(from_difference(difference, N), W);
        let half = N + difference * 0.5;
        assert!((half.length() - 0.956_171_6).abs() < 1e-6);
        assert_near(from_difference(difference * 0.5, N), Vec3::new(0.052_291_9, 0.261_459_4, 0.963_797));

        let texel = Texel { wrinkled: Vec3::new(-0.6, 0.0, 0.8), base: Vec3::new(0.8, 0.0, 0.6) };
        let clipped = (texel.wrinkled - texel.base).clamp(Vec3::NEG_ONE, Vec3::ONE);
        assert_near(from_difference(clipped, texel.base), Vec3::new(-0.242_535_6, 0.0, 0.970_142_5));
        let mut loss = Loss::default();
        loss.count(&texel, texel.wrinkled - texel.base, |value| from_difference(value, texel.base));
        assert_eq!(loss.num_clipped, 1);
        assert!(loss.mean().to_degrees() > 20.0 && loss.to_string().contains("1 of 1 texels clipped"), "{loss}");
    }

    #[test]
    fn the_scale_is_the_smallest_step_that_clips_nothing() {
        let leaning = |slope: f32| Texel { wrinkled: Vec3::new(slope, 0.0, 1.0).normalize(), base: Vec3::Z };
        for (slope, want) in [(0.0, 0.05), (0.31, 0.35), (0.35, 0.35), (-0.62, 0.65), (40.0, 4.0)] {
            assert!((scale_for(&[leaning(0.0), leaning(slope)]) - want).abs() < 1e-6, "{slope}");
        }
    }

    #[test]
    fn directions_no_skin_has_are_held() {
        assert!(normal_of(Vec3::new(1.0, 0.0, -0.5)).z > 0.01);
        assert_eq!(normal_of(Vec3::ZERO), Vec3::Z);
        assert_eq!([0.0, 1.0, 128.0, 255.0].map(value_of), [-1.0, -1.0, 0.0, 1.0]);
        assert_eq!([-2.0, -1.0, 0.0, 1.0, f32::NAN].map(code_of), [1, 1, 128, 255, 0]);
    }
}
