//! How far a performer's expressions go, stretched to how far the character's do.
//!
//! Each step of the guided fit is a face of the character's own: a direction among the motions of its bones. What a frame's
//! motions hold of each direction is found by least squares with amounts that cannot be negative; that part is stretched, the
//! rest of the motion stays as it was seen. A sender of weights has its weights stretched instead, before they move any bone.

use super::weights_to_bones::{WeightRig, Weights};
use glam::Vec3;
use rhytid_shared::character::Drive;
use rhytid_shared::{ArkitShape, Character, FitStep, NUM_ARKIT_SHAPES, Ranges};

/// The faces that are stretched; the mouth to the right shares the factor of that to the left.
const CHANNELS: [(FitStep, &[&str]); NUM_CHANNELS] = [
    (FitStep::BrowsUp, &["browInnerUp", "browOuterUpLeft", "browOuterUpRight"]),
    (FitStep::Frown, &["browDownLeft", "browDownRight"]),
    (FitStep::Smile, &["mouthSmileLeft", "mouthSmileRight"]),
    (FitStep::Pucker, &["mouthPucker"]),
    (FitStep::JawOpen, &["jawOpen"]),
    (FitStep::Blink, &["eyeBlinkLeft", "eyeBlinkRight"]),
    (FitStep::MouthLeft, &["mouthLeft"]),
    (FitStep::MouthLeft, &["mouthRight"]),
];
pub(super) const NUM_CHANNELS: usize = 8;
/// The mouth to the right, the last of the channels.
pub(super) const MOUTH_RIGHT: usize = NUM_CHANNELS - 1;

/// Amounts of the channels, 1 where the character's own shape is at 1.
pub(super) type ChannelAmounts = [f32; NUM_CHANNELS];

/// What a stretched amount may reach; one that was seen beyond it stays as it was seen.
const MOST: f32 = 1.2;
/// Metres that weigh as much as a radian: of the jaw, and of lids and eyes.
const JAW_LEVER: f32 = 0.1;
const EYE_LEVER: f32 = 0.012;
/// Rounds of the least squares: the directions are nearly apart, so a few would do.
const ROUNDS: usize = 24;
/// Share of the mean square that is added to each, so that directions a character lacks stay at 0.
const RIDGE: f64 = 1e-3;

/// The channel of a step, if it has one.
pub(super) fn channel_of(step: FitStep) -> Option<usize> {
    CHANNELS.iter().position(|(of, _)| *of == step)
}

/// The amounts that weights have.
pub(super) fn amounts_of_weights(weights: &Weights) -> ChannelAmounts {
    CHANNELS.map(|(_, names)| indices(names).map(|shape| weights[shape]).sum::<f32>() / names.len() as f32)
}

fn indices(names: &'static [&'static str]) -> impl Iterator<Item = usize> {
    names.iter().filter_map(|name| ArkitShape::from_name(name)).map(ArkitShape::index)
}

/// One character's directions, and a performer's factors.
pub(super) struct RangeRig {
    /// By channel a motion for each bone.
    directions: [Vec<Vec3>; NUM_CHANNELS],
    levers: Vec<f32>,
    /// Products of the directions, with the ridge.
    gram: [[f64; NUM_CHANNELS]; NUM_CHANNELS],
    factors: ChannelAmounts,
}

impl RangeRig {
    pub(super) fn new(character: &Character, rig: &WeightRig) -> Self {
        let levers: Vec<f32> = character
            .bones
            .iter()
            .map(|bone| match bone.drive {
                Drive::Skin { .. } | Drive::Still => 1.0,
                Drive::Jaw { .. } => JAW_LEVER,
                Drive::Lid { .. } | Drive::Eye { .. } => EYE_LEVER,
            })
            .collect();
        let directions = CHANNELS.map(|(_, names)| {
            let mut weights: Weights = [0.0; NUM_ARKIT_SHAPES];
            indices(names).for_each(|shape| weights[shape] = 1.0);
            let mut motions = vec![Vec3::ZERO; character.num_bones()];
            rig.solve(&weights, &mut motions);
            motions
        });
        let mut gram = [[0.0; NUM_CHANNELS]; NUM_CHANNELS];
        for (row, a) in gram.iter_mut().zip(&directions) {
            for (cell, b) in row.iter_mut().zip(&directions) {
                *cell = product(a, b, &levers);
            }
        }
        let mean = (0..NUM_CHANNELS).map(|i| gram[i][i]).sum::<f64>() / NUM_CHANNELS as f64;
        for (i, row) in gram.iter_mut().enumerate() {
            row[i] += RIDGE * mean.max(f64::MIN_POSITIVE);
        }
        Self { directions, levers, gram, factors: [1.0; NUM_CHANNELS] }
    }

    pub(super) fn set(&mut self, ranges: &Ranges) {
        self.factors = CHANNELS.map(|(step, _)| ranges.of(step));
    }

    /// Nothing is stretched.
    pub(super) fn is_one(&self) -> bool {
        self.factors == [1.0; NUM_CHANNELS]
    }

    /// By shape the factor of its weight.
    pub(super) fn of_shapes(&self) -> Weights {
        let mut factors = [1.0; NUM_ARKIT_SHAPES];
        for ((_, names), factor) in CHANNELS.into_iter().zip(self.factors) {
            indices(names).for_each(|shape| factors[shape] = factor);
        }
        factors
    }

    /// How much of each direction the motions hold, none less than 0.
    pub(super) fn amounts(&self, motions: &[Vec3]) -> ChannelAmounts {
        let products: [f64; NUM_CHANNELS] = std::array::from_fn(|i| product(&self.directions[i], motions, &self.levers));
        let mut amounts = [0.0; NUM_CHANNELS];
        for _ in 0..ROUNDS {
            for i in 0..NUM_CHANNELS {
                let others: f64 = (0..NUM_CHANNELS).filter(|k| *k != i).map(|k| self.gram[i][k] * amounts[k]).sum();
                amounts[i] = ((products[i] - others) / self.gram[i][i]).max(0.0);
            }
        }
        amounts.map(|amount| amount as f32)
    }

    /// Stretches motions.
    pub(super) fn stretch(&self, motions: &mut [Vec3]) {
        if self.is_one() {
            return;
        }
        let amounts = self.amounts(motions);
        for ((direction, amount), factor) in self.directions.iter().zip(amounts).zip(self.factors) {
            let more = stretched(amount, factor, MOST) - amount;
            if more != 0.0 {
                motions.iter_mut().zip(direction).for_each(|(motion, unit)| *motion += *unit * more);
            }
        }
    }
}

/// `amount` by `factor`, at most `most` or what it was.
pub(super) fn stretched(amount: f32, factor: f32, most: f32) -> f32 {
    (amount * factor).min(most.max(amount))
}

fn product(a: &[Vec3], b: &[Vec3], levers: &[f32]) -> f64 {
    a.iter()
        .zip(b)
        .zip(levers)
        .map(|((a, b), lever)| {
            let weight = f64::from(*lever) * f64::from(*lever);
            weight * (f64::from(a.x) * f64::from(b.x) + f64::from(a.y) * f64::from(b.y) + f64::from(a.z) * f64::from(b.z))
        })
        .sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use rhytid_shared::DEFAULT_CHARACTER_GLB;

    #[test]
    fn what_is_stretched_is_the_part_along_each_face_and_nothing_else() {
        let character = Character::from_glb(DEFAULT_CHARACTER_GLB).unwrap();
        let weight_rig = WeightRig::new(&character);
        let mut rig = RangeRig::new(&character, &weight_rig);
        let motions = |of: &[(&str, f32)]| {
            let mut weights: Weights = [0.0; NUM_ARKIT_SHAPES];
            of.iter().for_each(|(name, weight)| weights[ArkitShape::from_name(name).unwrap().index()] = *weight);
            let mut motions = vec![Vec3::ZERO; character.num_bones()];
            weight_rig.solve(&weights, &mut motions);
            motions
        };
        for (channel, (step, names)) in CHANNELS.into_iter().enumerate() {
            let half = motions(&names.iter().map(|name| (*name, 0.5)).collect::<Vec<_>>());
            let amounts = rig.amounts(&half);
            assert!((amounts[channel] - 0.5).abs() < 0.06, "{step:?}: {amounts:?}");
            let others = amounts.iter().enumerate().filter(|(i, _)| *i != channel).map(|(_, amount)| *amount).fold(0.0, f32::max);
            assert!(others < 0.12, "{step:?}: {amounts:?}");
        }
        let mut seen = motions(&[("mouthSmileLeft", 0.3), ("mouthSmileRight", 0.3), ("browOuterUpLeft", 0.2)]);
        let before = seen.clone();
        rig.stretch(&mut seen);
        assert_eq!(seen, before, "without factors no bit changes");
        rig.set(&Ranges { smile: 2.0, ..Ranges::ONE });
        rig.stretch(&mut seen);
        let wanted = motions(&[("mouthSmileLeft", 0.6), ("mouthSmileRight", 0.6), ("browOuterUpLeft", 0.2)]);
        let off = seen.iter().zip(&wanted).map(|(a, b)| a.distance(*b)).fold(0.0, f32::max);
        let way = before.iter().zip(&wanted).map(|(a, b)| a.distance(*b)).fold(0.0, f32::max);
        assert!(off < 0.15 * way, "{off} of {way}");
        // A whole smile has nowhere to go but a little.
        assert_eq!(stretched(1.0, 3.0, MOST), MOST);
        assert_eq!(stretched(1.4, 3.0, MOST), 1.4);
    }
}
