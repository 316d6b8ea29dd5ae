//! Lips touch: what shapes squeeze together does not shut an open mouth, and a mouth tracked as closed is closed.

use super::weights_to_bones::{Response, Weights};
use glam::Vec3;
use rhytid_shared::character::Drive;
use rhytid_shared::{ARKIT_NAMES, Character};

/// Landmarks of the upper lip's edge and those of the lower one that meet them.
const MEETING: [[usize; 2]; 5] = [[51, 57], [50, 58], [52, 56], [49, 59], [53, 55]];
/// What `jawOpen` exceeds `mouthClose` by where the lips are surely together still, and where they are surely apart:
/// trackers read a few hundredths on closed lips.
const TOGETHER: f32 = 0.06;
const APART: f32 = 0.25;
/// Share of the way to each other that the lower lip goes.
const LOWER_SHARE: f32 = 0.8;

/// How shapes move the two lips against each other.
#[derive(Debug, Clone)]
pub(super) struct Lips {
    jaw_open: usize,
    mouth_close: usize,
    /// `(shape, bone, metres up)`: what takes back how far a shape at weight 1 pushes a lip into the other.
    squeezes: Vec<(usize, usize, f32)>,
    /// `(bone, metres up)`: what `mouthClose` of 1 leaves open of `jawOpen` of 1.
    left_open: Vec<(usize, f32)>,
}

impl Lips {
    /// `responses` hold each shape's motions of all bones.
    pub(super) fn new(character: &Character, responses: &[Response]) -> Self {
        let index = |name: &str| ARKIT_NAMES.iter().position(|known| *known == name).unwrap_or(0);
        let (jaw_open, mouth_close) = (index("jawOpen"), index("mouthClose"));
        let share = |bone: usize, landmark: usize| match &character.bones[bone].drive {
            Drive::Skin { landmarks } => landmarks.iter().filter(|entry| entry.landmark == landmark).map(|entry| entry.weight).sum(),
            _ => 0.0_f32,
        };
        let bone_of = |landmark: usize| {
            let best = (0..character.num_bones()).max_by(|&a, &b| share(a, landmark).total_cmp(&share(b, landmark)));
            best.filter(|&bone| share(bone, landmark) > 0.5)
        };
        let mut lips = Self { jaw_open, mouth_close, squeezes: Vec::new(), left_open: Vec::new() };
        for [upper, lower] in MEETING {
            let (Some(upper), Some(lower)) = (bone_of(upper), bone_of(lower)) else { continue };
            let opening = |shape: usize| {
                let own = responses.iter().find(|response| response.shape == shape);
                own.map_or(0.0, |response| response.motions[upper].y - response.motions[lower].y)
            };
            for response in responses.iter().filter(|response| ![jaw_open, mouth_close].contains(&response.shape)) {
                let closing = -opening(response.shape);
                // Only what goes towards the other lip is taken back, each lip by its part.
                let (down, up) = (-response.motions[upper].y.min(0.0), response.motions[lower].y.max(0.0));
                if closing > 0.0 {
                    let part = closing / (down + up);
                    lips.squeezes.extend([(response.shape, upper, down * part), (response.shape, lower, -up * part)]);
                }
            }
            let left = opening(jaw_open) + opening(mouth_close);
            if left > 0.0 && opening(mouth_close) < 0.0 {
                lips.left_open.extend([(upper, -left * (1.0 - LOWER_SHARE)), (lower, left * LOWER_SHARE)]);
            }
        }
        lips
    }

    /// Adds to the motions of the lips' bones.
    pub(super) fn add(&self, weights: &Weights, motions: &mut [Vec3]) {
        let t = ((weights[self.jaw_open] - weights[self.mouth_close] - TOGETHER) / (APART - TOGETHER)).clamp(0.0, 1.0);
        let apart = t * t * (3.0 - 2.0 * t);
        for &(shape, bone, up) in &self.squeezes {
            motions[bone].y += up * weights[shape] * apart;
        }
        let closed = weights[self.mouth_close].min(weights[self.jaw_open]).max(0.0);
        for &(bone, up) in &self.left_open {
            motions[bone].y += up * closed;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::weights_to_bones::WeightRig;
    use super::*;
    use rhytid_shared::{ArkitShape, DEFAULT_CHARACTER_GLB, NUM_ARKIT_SHAPES};

    /// How far the middles of the lips move apart, metres.
    fn gap(named: &[(&str, f32)]) -> f32 {
        let character = Character::from_glb(DEFAULT_CHARACTER_GLB).expect("the built-in character is whole");
        let mut weights: Weights = [0.0; NUM_ARKIT_SHAPES];
        for (name, weight) in named {
            weights[ArkitShape::from_name(name).expect("a known shape").index()] = *weight;
        }
        let mut motions = vec![Vec3::ZERO; character.num_bones()];
        WeightRig::new(&character).solve(&weights, &mut motions);
        let [upper, lower] = ["lip_upper_mid", "lip_lower_mid"].map(|name| motions[character.bone_index(name).expect("a bone")].y);
        upper - lower
    }

    #[test]
    fn squeezed_lips_do_not_shut_an_open_mouth() {
        let open = gap(&[("jawOpen", 0.4)]);
        for squeeze in ["mouthPressLeft", "mouthRollUpper", "mouthRollLower", "mouthSmileLeft", "mouthShrugLower"] {
            assert!(gap(&[(squeeze, 1.0)]) < -1.0e-3, "{squeeze} squeezes lips that touch");
            let both = gap(&[("jawOpen", 0.4), (squeeze, 1.0)]);
            assert!((both - open).abs() < 1.0e-3, "{squeeze}: {both} m of {open} m are left");
        }
    }

    #[test]
    fn mouth_tracked_as_closed_is_closed_however_far_the_jaw_is_down() {
        for jaw in [0.02, 0.05, 0.1, 0.2, 0.3, 0.6, 1.0] {
            let [open, half, closed] = [0.0, 0.5, 1.0].map(|share| gap(&[("jawOpen", jaw), ("mouthClose", share * jaw)]));
            assert!(closed.abs() < 0.5e-3, "{closed} m are left at a jaw of {jaw}");
            assert!(half > 0.3 * open && half < 0.7 * open, "{half} m of {open} m");
        }
    }
}
