//! Eye rotations and the gaze shapes that stand for them.

use rhytid_shared::{ArkitShape, NUM_ARKIT_SHAPES};

/// Turn of an eye at which its gaze shape is 1, radians: the slope of the rotations that Live Link Face sends beside the shapes
/// is 0.48 to 0.61.
pub const FULL_LOOK: f32 = 0.6;

/// How far an eye is turned, radians.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct EyeTurn {
    /// Down is positive.
    pub pitch: f32,
    /// To the performer's left is positive.
    pub yaw: f32,
}

/// Shapes of each eye, the left first: down, up, towards the performer's left, towards their right.
const GAZE: [[&str; 4]; 2] = [
    ["eyeLookDownLeft", "eyeLookUpLeft", "eyeLookOutLeft", "eyeLookInLeft"],
    ["eyeLookDownRight", "eyeLookUpRight", "eyeLookInRight", "eyeLookOutRight"],
];

fn index(eye: usize, way: usize) -> usize {
    ArkitShape::from_name(GAZE[eye][way]).expect("the table holds ARKit's names").index()
}

/// True for the eight shapes of the gaze.
pub(super) fn is_gaze(shape: usize) -> bool {
    (0..2).any(|eye| (0..4).any(|way| index(eye, way) == shape))
}

/// Sets the gaze shapes to what the eyes (left, right) look at.
pub(super) fn write_gaze(eyes: [EyeTurn; 2], weights: &mut [f32; NUM_ARKIT_SHAPES]) {
    for (eye, turn) in eyes.into_iter().enumerate() {
        for (way, angle) in [turn.pitch, -turn.pitch, turn.yaw, -turn.yaw].into_iter().enumerate() {
            weights[index(eye, way)] = (angle / FULL_LOOK).clamp(0.0, 1.0);
        }
    }
}

/// How far the eyes (left, right) are turned where the gaze shapes have these weights.
pub(super) fn read_gaze(weights: &[f32; NUM_ARKIT_SHAPES]) -> [EyeTurn; 2] {
    std::array::from_fn(|eye| {
        let of = |way| weights[index(eye, way)];
        EyeTurn { pitch: (of(0) - of(1)) * FULL_LOOK, yaw: (of(2) - of(3)) * FULL_LOOK }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn eyes_that_look_left_turn_one_out_and_one_in() {
        let mut weights = [0.0; NUM_ARKIT_SHAPES];
        write_gaze([EyeTurn { pitch: 0.3, yaw: 0.15 }, EyeTurn { pitch: -0.15, yaw: 0.3 }], &mut weights);
        let of = |name| weights[ArkitShape::from_name(name).unwrap().index()];
        assert_eq!((of("eyeLookOutLeft"), of("eyeLookInLeft"), of("eyeLookDownLeft")), (0.25, 0.0, 0.5));
        assert_eq!((of("eyeLookInRight"), of("eyeLookOutRight"), of("eyeLookUpRight")), (0.5, 0.0, 0.25));
        assert_eq!(read_gaze(&weights), [EyeTurn { pitch: 0.3, yaw: 0.15 }, EyeTurn { pitch: -0.15, yaw: 0.3 }]);
    }
}
