//! How much of each of the six expressions a tracker's weights show, in each half of the face.

use super::weights_to_bones::Weights;
use rhytid_shared::ArkitShape;
use rhytid_shared::character::Side;

/// The expressions of Jimenez et al. 2011, Table 1.1.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Emotion {
    Joy,
    Surprise,
    Fear,
    Anger,
    Disgust,
    Sad,
}

impl Emotion {
    /// The one a character's table calls so; its other expressions are known to publishers only.
    pub(super) fn from_name(name: &str) -> Option<Self> {
        Some(match name {
            "joy" => Self::Joy,
            "surprise" => Self::Surprise,
            "fear" => Self::Fear,
            "anger" => Self::Anger,
            "disgust" => Self::Disgust,
            "sad" => Self::Sad,
            _ => return None,
        })
    }
}

/// The shapes that expressions are read from, of one half of the face or of its middle.
#[derive(Debug, Clone, Copy)]
struct Half {
    mouth_smile: ArkitShape,
    cheek_squint: ArkitShape,
    brow_outer_up: ArkitShape,
    eye_wide: ArkitShape,
    mouth_stretch: ArkitShape,
    brow_down: ArkitShape,
    nose_sneer: ArkitShape,
    mouth_upper_up: ArkitShape,
    mouth_frown: ArkitShape,
}

/// Reads expressions from weights.
#[derive(Debug, Clone)]
pub(super) struct EmotionReader {
    halves: [Half; 2],
    brow_inner_up: ArkitShape,
    jaw_open: ArkitShape,
    mouth_shrug_lower: ArkitShape,
}

fn shape(name: &str) -> ArkitShape {
    ArkitShape::from_name(name).expect("the names below are ARKit's, as a test sees")
}

impl EmotionReader {
    pub(super) fn new() -> Self {
        let half = |side: &str| {
            let shape = |stem: &str| shape(&format!("{stem}{side}"));
            Half {
                mouth_smile: shape("mouthSmile"),
                cheek_squint: shape("cheekSquint"),
                brow_outer_up: shape("browOuterUp"),
                eye_wide: shape("eyeWide"),
                mouth_stretch: shape("mouthStretch"),
                brow_down: shape("browDown"),
                nose_sneer: shape("noseSneer"),
                mouth_upper_up: shape("mouthUpperUp"),
                mouth_frown: shape("mouthFrown"),
            }
        };
        Self {
            halves: [half("Left"), half("Right")],
            brow_inner_up: shape("browInnerUp"),
            jaw_open: shape("jawOpen"),
            mouth_shrug_lower: shape("mouthShrugLower"),
        }
    }

    /// How much of an expression one half of the face shows, in `[0, 1]`. Combinations of muscles after EMFACS; shapes without
    /// sides (inner brows, jaw) count for both halves.
    pub(super) fn amount(&self, emotion: Emotion, side: Side, weights: &Weights) -> f32 {
        let of = |shape: ArkitShape| weights[shape.index()];
        let half = self.halves[usize::from(side == Side::Right)];
        let amount = match emotion {
            // A smile that reaches the eyes counts more.
            Emotion::Joy => of(half.mouth_smile) * (1.0 + 0.25 * of(half.cheek_squint)),
            Emotion::Surprise => 0.25 * (of(self.brow_inner_up) + of(half.brow_outer_up) + of(half.eye_wide) + of(self.jaw_open)),
            Emotion::Fear => of(self.brow_inner_up).min(of(half.eye_wide)) + of(half.mouth_stretch),
            Emotion::Anger => of(half.brow_down) + 0.5 * of(half.nose_sneer),
            Emotion::Disgust => of(half.nose_sneer) + of(half.mouth_upper_up),
            Emotion::Sad => of(self.brow_inner_up) * (1.0 - of(half.brow_outer_up)) + of(half.mouth_frown) + of(self.mouth_shrug_lower),
        };
        amount.clamp(0.0, 1.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rhytid_shared::NUM_ARKIT_SHAPES;

    fn amounts(emotion: Emotion, named: &[(&str, f32)]) -> [f32; 2] {
        let mut weights = [0.0; NUM_ARKIT_SHAPES];
        named.iter().for_each(|&(name, weight)| weights[shape(name).index()] = weight);
        let reader = EmotionReader::new();
        [Side::Left, Side::Right].map(|side| reader.amount(emotion, side, &weights))
    }

    #[test]
    fn each_expression_is_read_from_its_shapes_in_each_half() {
        use Emotion::{Anger, Disgust, Fear, Joy, Sad, Surprise};
        type Case<'a> = (Emotion, &'a [(&'a str, f32)], [f32; 2]);
        let cases: [Case; 8] = [
            (Joy, &[("mouthSmileLeft", 0.8), ("cheekSquintLeft", 1.0), ("mouthSmileRight", 0.5)], [1.0, 0.5]),
            (Surprise, &[("browInnerUp", 1.0), ("browOuterUpRight", 1.0), ("jawOpen", 0.4)], [0.35, 0.6]),
            (Fear, &[("browInnerUp", 0.7), ("eyeWideLeft", 0.5), ("mouthStretchLeft", 0.25)], [0.75, 0.0]),
            (Anger, &[("browDownLeft", 0.4), ("noseSneerLeft", 0.6), ("browDownRight", 0.9), ("noseSneerRight", 0.4)], [0.7, 1.0]),
            (Disgust, &[("noseSneerRight", 0.5), ("mouthUpperUpRight", 0.25)], [0.0, 0.75]),
            (Sad, &[("browInnerUp", 0.8), ("browOuterUpLeft", 0.5), ("mouthFrownRight", 0.1)], [0.4, 0.9]),
            (Sad, &[("mouthShrugLower", 0.6)], [0.6, 0.6]),
            (Surprise, &[], [0.0, 0.0]),
        ];
        for (emotion, weights, want) in cases {
            let got = amounts(emotion, weights);
            assert!((0..2).all(|side| (got[side] - want[side]).abs() < 1e-6), "{emotion:?} of {weights:?} is {got:?}, expected {want:?}");
        }
    }
}
