//! Eyebrows: a few hundred hairs a side that lie on the skin and are moved exactly as the skin under them is.

use super::part::{Material, Part};
use super::random::Random;
use super::strands::{self, Knot};
use super::surface::{Hit, Surface};
use super::weights::Weights;
use glam::{Vec2, Vec3};
use rhytid_shared::ARKIT_NAMES;

/// Middle line of the left brow from the nose outwards, seen from the front: metres from the origin of head space, which
/// is at the height of the eyes. Higher than MakeHuman's ridge, which a tracker takes for a frown. Tuned by eye and tracker.
const LINE: [Vec2; 6] = [
    Vec2::new(0.0125, 0.0094),
    Vec2::new(0.0225, 0.0120),
    Vec2::new(0.0330, 0.0146),
    Vec2::new(0.0430, 0.0147),
    Vec2::new(0.0505, 0.0122),
    Vec2::new(0.0565, 0.0078),
];
/// Half the brow's height along the line, metres.
const HALF_HEIGHT: [f32; 6] = [0.0036, 0.0042, 0.0038, 0.0032, 0.0022, 0.0008];
/// Hairs' direction along the line: angle above "outwards", degrees.
const DIRECTION: [f32; 6] = [72.0, 46.0, 30.0, 10.0, -14.0, -36.0];
/// Hairs' lengths along the line, metres.
const LENGTH: [f32; 6] = [0.0062, 0.0086, 0.0092, 0.0088, 0.0076, 0.0056];
/// Hairs a side.
const NUM_HAIRS: usize = 340;
/// Half the width of a hair at its root, metres; somewhat more than a real one's, a pixel must show it.
const HALF_WIDTH: f32 = 0.000_10;
/// Height of a hair's points over the skin, root to tip, metres.
const LIFT: [f32; 4] = [-0.000_1, 0.000_45, 0.000_65, 0.000_35];

/// Point of the left brow's middle line, seen from the front; `t` 0 to 1 from the nose outwards.
pub fn line(t: f32) -> Vec2 {
    Vec2::new(along(&LINE.map(|p| p.x), t), along(&LINE.map(|p| p.y), t))
}

/// Half the brow's height there, metres.
pub fn half_height(t: f32) -> f32 {
    along(&HALF_HEIGHT, t)
}

/// Both brows.
pub fn build(surface: &Surface<'_>, weights: &Weights) -> Part {
    let mut part = strands::empty(Material::Brow);
    for (side, seed) in [(1.0, 11), (-1.0, 29)] {
        let mut random = Random::new(seed);
        for i in 0..NUM_HAIRS {
            let t = (i as f32 + random.unit()) / NUM_HAIRS as f32;
            // More hairs in the middle of the height than at the border.
            let across = 0.62 * random.signed() + 0.38 * random.signed();
            let ahead = line((t + 0.02).min(1.0)) - line((t - 0.02).max(0.0));
            let upwards = Vec2::new(-ahead.y, ahead.x).normalize_or(Vec2::Y);
            let root = line(t) + upwards * across * along(&HALF_HEIGHT, t);
            // Upper hairs lean down and lower ones up, so that they meet in the middle.
            let degrees = along(&DIRECTION, t) - 14.0 * across * (1.0 - t) + 9.0 * random.signed();
            let length = along(&LENGTH, t) * (0.8 + 0.3 * random.unit()) * (1.0 - 0.25 * across.abs());
            let bend = -0.35 + 0.2 * random.signed();
            let mut knots = Vec::with_capacity(LIFT.len());
            for (k, lift) in LIFT.into_iter().enumerate() {
                let s = k as f32 / (LIFT.len() - 1) as f32;
                let angle = (degrees * (1.0 + bend * s)).to_radians();
                let at = root + Vec2::new(libm::cosf(angle), libm::sinf(angle)) * (length * s);
                let Some(hit) = on_front(surface, Vec2::new(at.x * side, at.y)) else { break };
                let normal = surface.normal(&hit);
                knots.push(Knot {
                    position: surface.position(&hit) + normal * lift,
                    normal,
                    half_width: HALF_WIDTH * (1.0 - 0.45 * s) * (0.8 + 0.4 * random.unit()),
                    binding: surface.binding(&hit, weights),
                    morphs: (0..ARKIT_NAMES.len()).map(|shape| surface.morph(&hit, shape)).collect(),
                });
            }
            if knots.len() == LIFT.len() {
                strands::push(&mut part, &knots);
            }
        }
    }
    part
}

/// The frontmost point of the skin behind a point of the frontal view.
pub fn on_front(surface: &Surface<'_>, at: Vec2) -> Option<Hit> {
    surface.ray(at.extend(0.3), Vec3::NEG_Z)
}

/// Catmull–Rom through equally spaced values.
fn along<const N: usize>(values: &[f32; N], t: f32) -> f32 {
    let x = t.clamp(0.0, 1.0) * (N - 1) as f32;
    let i = (x as usize).min(N - 2);
    let f = x - i as f32;
    let (b, c) = (values[i], values[i + 1]);
    let a = if i == 0 { 2.0 * b - c } else { values[i - 1] };
    let d = if i + 2 == N { 2.0 * c - b } else { values[i + 2] };
    b + 0.5 * f * (c - a + f * (2.0 * a - 5.0 * b + 4.0 * c - d + f * (3.0 * (b - c) + d - a)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn curve_passes_through_its_values_and_keeps_straight_lines() {
        let values = [1.0, 4.0, 2.0, 7.0];
        for (i, value) in values.into_iter().enumerate() {
            assert!((along(&values, i as f32 / 3.0) - value).abs() < 1e-5);
        }
        assert!((along(&[0.0, 1.0, 2.0, 3.0], 0.5) - 1.5).abs() < 1e-6);
    }
}
