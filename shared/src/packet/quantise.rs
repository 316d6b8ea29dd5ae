//! Values to integer codes and back. Zero, one and identity are exact.

#![deny(clippy::disallowed_methods)]

use crate::limits::MAX_HEAD_TRAVEL;
use glam::Quat;

/// One step of a bone's displacement from rest, metres.
pub(super) const POINT_STEP: f32 = 25e-6;
/// Largest code of a displacement: 12 bits with their sign, so ±51.175 mm (and half a step of rounding).
pub(super) const POINT_MAX: i32 = 2047;
/// Largest code of a head position: 16 bits with their sign over ±0.3 m.
pub(super) const HEAD_MAX: i32 = 32_767;

/// A displacement, metres, in steps of 25 µm. What is not finite counts as rest.
pub(super) fn point_code(displacement: f32) -> i32 {
    // The cast saturates and takes NaN to 0.
    ((displacement / POINT_STEP).round() as i32).clamp(-POINT_MAX, POINT_MAX)
}

/// A coefficient in `[0, 1]` to 8 bits with rounding, `floor(255 x + 0.5)`; 0 and 1 are exact.
pub(super) fn unit_code(value: f32) -> i32 {
    ((value * 255.0 + 0.5).floor() as i32).clamp(0, 255)
}

/// A head position, metres, to 16 bits.
pub(super) fn head_code(position: f32) -> i32 {
    ((position / MAX_HEAD_TRAVEL * HEAD_MAX as f32).round() as i32).clamp(-HEAD_MAX, HEAD_MAX)
}

/// A head position from its code.
pub(super) fn head_value(code: i32) -> f32 {
    code as f32 / HEAD_MAX as f32 * MAX_HEAD_TRAVEL
}

/// A unit quaternion without its largest component, which the other three determine ("smallest three").
///
/// `BITS` a component, mid-tread: the code 0 means exactly 0, so that identity comes back exactly (an even number of steps
/// over the range cannot represent 0 and leaves a head turned for ever).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct SmallestThree<const BITS: u32> {
    /// Which of x, y, z, w is left out, 0 to 3.
    pub dropped: u8,
    /// The others in order, `-Self::MAX..=Self::MAX` over `-1/√2..=1/√2`.
    pub codes: [i32; 3],
}

impl<const BITS: u32> SmallestThree<BITS> {
    /// Largest code.
    pub const MAX: i32 = (1 << (BITS - 1)) - 1;
    /// No rotation.
    pub const IDENTITY: Self = Self { dropped: 3, codes: [0; 3] };

    /// Quantises `rotation`, which is normalised first; what cannot be normalised counts as identity.
    pub fn new(rotation: Quat) -> Self {
        let length = length_of(rotation.to_array());
        if !(length > 1e-3 && length.is_finite()) {
            return Self::IDENTITY;
        }
        let q = rotation.to_array().map(|component| component / length);
        let mut dropped = 3;
        for (i, component) in q.iter().enumerate() {
            if component.abs() > q[dropped].abs() {
                dropped = i;
            }
        }
        let sign = if q[dropped] < 0.0 { -1.0 } else { 1.0 };
        let scale = sign * std::f32::consts::SQRT_2 * Self::MAX as f32;
        let mut codes = [0; 3];
        for (code, i) in codes.iter_mut().zip((0..4).filter(|i| *i != dropped)) {
            *code = ((q[i] * scale).round() as i32).clamp(-Self::MAX, Self::MAX);
        }
        Self { dropped: dropped as u8, codes }
    }

    /// The rotation, of unit length.
    pub fn rotation(self) -> Quat {
        let scale = std::f32::consts::SQRT_2 * Self::MAX as f32;
        let three = self.codes.map(|code| code as f32 / scale);
        let rest = 1.0 - (three[0] * three[0] + three[1] * three[1] + three[2] * three[2]);
        let mut q = [0.0; 4];
        for (value, i) in three.into_iter().zip((0..4).filter(|i| *i != usize::from(self.dropped))) {
            q[i] = value;
        }
        q[usize::from(self.dropped)] = rest.max(0.0).sqrt();
        // Three codes at the end of their range make more than unit length; the codes of a real rotation do not.
        if rest < 0.0 {
            let length = length_of(q);
            q = q.map(|component| component / length);
        }
        Quat::from_array(q)
    }
}

/// Written out: a vector unit would add in an order of its own, and packets have the same bits on every machine.
fn length_of([x, y, z, w]: [f32; 4]) -> f32 {
    (x * x + y * y + z * z + w * w).sqrt()
}

#[cfg(test)]
#[allow(clippy::disallowed_methods, reason = "a test compares with a tolerance")]
mod tests {
    use super::*;
    use glam::Vec3;

    #[test]
    fn coefficients_are_rounded() {
        // V8.4 of the project's formulae: u8(0.7) = 179, which is 0.7019607843 again; 0, 1 exact; a half goes up.
        assert_eq!([0.0, 1.0, 0.7, 0.5, 0.8, 0.480_769_23].map(unit_code), [0, 255, 179, 128, 204, 123]);
        assert_eq!([-3.0, 9.0, f32::NAN, f32::INFINITY].map(unit_code), [0, 255, 0, 255]);
        assert!((179.0f32 / 255.0 - 0.701_960_8).abs() < 1e-7);
    }

    #[test]
    fn displacements_keep_half_a_step_over_the_stated_range() {
        let most = crate::limits::MAX_BONE_TRAVEL;
        for i in -1000..=1000 {
            let x = most * i as f32 / 1000.0;
            let back = point_code(x) as f32 * POINT_STEP;
            assert!((back - x).abs() <= POINT_STEP / 2.0 * 1.001, "{x} came back as {back}");
        }
        assert_eq!([1.0, -1.0, f32::NAN].map(point_code), [POINT_MAX, -POINT_MAX, 0]);
    }

    #[test]
    fn smallest_three_agrees_with_the_worked_example() {
        // V8.5 of the project's formulae, 10 bits: index 3, codes 583, 366, 728 about the middle 511.
        let q = Quat::from_xyzw(0.1, -0.2, 0.3, 0.927_361_85);
        let code = SmallestThree::<10>::new(q);
        assert_eq!((code.dropped, code.codes.map(|c| c + 511)), (3, [583, 366, 728]));
        let want = [0.099_631_48, -0.200_646_74, 0.300_278_22, 0.927_171_74];
        for (got, want) in code.rotation().to_array().into_iter().zip(want) {
            assert!((got - want).abs() < 1e-6, "{got} is not {want}");
        }
        assert_eq!(SmallestThree::<10>::new(Quat::IDENTITY), SmallestThree::IDENTITY);
        assert_eq!(SmallestThree::<10>::IDENTITY.rotation(), Quat::IDENTITY);
        assert_eq!(SmallestThree::<10>::new(Quat::from_xyzw(0.0, 0.0, 0.0, 0.0)), SmallestThree::IDENTITY);
    }

    #[test]
    fn any_rotation_comes_back_within_the_bound() {
        let mut worst = [0.0f32; 2];
        for i in 0..4000 {
            let (a, b) = (i as f32 * 0.618, i as f32 * 0.3247);
            let axis = Vec3::new(a.cos(), b.sin(), (a + b).cos()).normalize();
            let q = Quat::from_axis_angle(axis, i as f32 * 0.017);
            // By the sine: the arc cosine of a number near 1 has no digits left.
            let angle = |back: Quat| (q.conjugate() * back).xyz().length().min(1.0).asin().to_degrees() * 2.0;
            worst[0] = worst[0].max(angle(SmallestThree::<10>::new(q).rotation()));
            worst[1] = worst[1].max(angle(SmallestThree::<12>::new(q).rotation()));
        }
        // 2 √12 times half a step: 0.274 degrees at 10 bits, 0.068 at 12.
        assert!(worst[0] < 0.274 && worst[0] > 0.1, "{worst:?}");
        assert!(worst[1] < 0.069, "{worst:?}");
    }
}
