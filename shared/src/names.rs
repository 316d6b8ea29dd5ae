//! Names that travel: rooms and ARKit's expression shapes.

use std::fmt;

/// A name that broke its rule.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum NameError {
    /// Not 1 to 64 characters of `[A-Za-z0-9_-]`.
    #[error("room name {got:?} is not 1 to 64 characters of A-Z a-z 0-9 _ -")]
    Room {
        /// The name as it was given, cut to 80 characters.
        got: String,
    },
}

/// The name of a room: 1 to 64 characters of `[A-Za-z0-9_-]`, so that it can stand in a URL, a log line and a file name.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct RoomName(String);

impl RoomName {
    /// Checks `name`.
    pub fn new(name: &str) -> Result<Self, NameError> {
        let is_allowed = |byte: u8| byte.is_ascii_alphanumeric() || byte == b'_' || byte == b'-';
        if name.is_empty() || name.len() > 64 || !name.bytes().all(is_allowed) {
            return Err(NameError::Room { got: name.chars().take(80).collect() });
        }
        Ok(Self(name.to_owned()))
    }

    /// The name itself.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl fmt::Display for RoomName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// How many expression shapes ARKit names.
pub const NUM_ARKIT_SHAPES: usize = 52;

/// ARKit's expression shapes in the order of Apple's face-tracking stream. Shapes are bound by name everywhere; this
/// order serves packets and arrays inside Rhytid. Left and right are the subject's own.
pub const ARKIT_NAMES: [&str; NUM_ARKIT_SHAPES] = [
    "eyeBlinkLeft",
    "eyeLookDownLeft",
    "eyeLookInLeft",
    "eyeLookOutLeft",
    "eyeLookUpLeft",
    "eyeSquintLeft",
    "eyeWideLeft",
    "eyeBlinkRight",
    "eyeLookDownRight",
    "eyeLookInRight",
    "eyeLookOutRight",
    "eyeLookUpRight",
    "eyeSquintRight",
    "eyeWideRight",
    "jawForward",
    "jawLeft",
    "jawRight",
    "jawOpen",
    "mouthClose",
    "mouthFunnel",
    "mouthPucker",
    "mouthLeft",
    "mouthRight",
    "mouthSmileLeft",
    "mouthSmileRight",
    "mouthFrownLeft",
    "mouthFrownRight",
    "mouthDimpleLeft",
    "mouthDimpleRight",
    "mouthStretchLeft",
    "mouthStretchRight",
    "mouthRollLower",
    "mouthRollUpper",
    "mouthShrugLower",
    "mouthShrugUpper",
    "mouthPressLeft",
    "mouthPressRight",
    "mouthLowerDownLeft",
    "mouthLowerDownRight",
    "mouthUpperUpLeft",
    "mouthUpperUpRight",
    "browDownLeft",
    "browDownRight",
    "browInnerUp",
    "browOuterUpLeft",
    "browOuterUpRight",
    "cheekPuff",
    "cheekSquintLeft",
    "cheekSquintRight",
    "noseSneerLeft",
    "noseSneerRight",
    "tongueOut",
];

/// One of ARKit's shapes: an index into [`ARKIT_NAMES`], always in range.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ArkitShape(u8);

impl ArkitShape {
    /// Finds a shape by name: any case, endings `Left`/`Right`, `_L`/`_R` and `_l`/`_r` alike. `None` for a name that is none.
    pub fn from_name(name: &str) -> Option<Self> {
        let (stem, side) = match name.len().checked_sub(2).and_then(|at| name.split_at_checked(at)) {
            Some((stem, "_L" | "_l")) => (stem, "left"),
            Some((stem, "_R" | "_r")) => (stem, "right"),
            _ => (name, ""),
        };
        ARKIT_NAMES
            .iter()
            .position(|known| {
                known.len() == stem.len() + side.len()
                    && known[..stem.len()].eq_ignore_ascii_case(stem)
                    && known[stem.len()..].eq_ignore_ascii_case(side)
            })
            .map(|index| Self(index as u8))
    }

    /// The shape a morph target of this name belongs to. Other heads split shapes that ARKit has once into halves
    /// (`browInnerUp_L`, `cheekPuff_R`): both belong to the whole, and their displacements add up to it.
    pub fn of_target(name: &str) -> Option<Self> {
        let half = || {
            let (stem, side) = name.split_at_checked(name.len().checked_sub(2)?)?;
            matches!(side, "_L" | "_l" | "_R" | "_r").then_some(stem)
        };
        Self::from_name(name).or_else(|| Self::from_name(half()?))
    }

    /// The shape at `index` of [`ARKIT_NAMES`], if there is one.
    pub fn from_index(index: usize) -> Option<Self> {
        (index < NUM_ARKIT_SHAPES).then_some(Self(index as u8))
    }

    /// Index into [`ARKIT_NAMES`].
    pub fn index(self) -> usize {
        usize::from(self.0)
    }

    /// Apple's camelCase name.
    pub fn name(self) -> &'static str {
        ARKIT_NAMES[self.index()]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shapes_are_found_under_every_spelling() {
        for (name, want) in
            [("jawOpen", "jawOpen"), ("JawOpen", "jawOpen"), ("eyeBlink_L", "eyeBlinkLeft"), ("MouthSmileRight", "mouthSmileRight")]
        {
            assert_eq!(ArkitShape::from_name(name).map(ArkitShape::name), Some(want), "{name}");
        }
        for name in ["", "_neutral", "jaw", "_L", "é_L", "jawOpen_L"] {
            assert_eq!(ArkitShape::from_name(name), None, "{name}");
        }
    }

    #[test]
    fn halves_of_a_target_belong_to_the_whole_shape() {
        for (name, want) in
            [("browInnerUp_L", Some("browInnerUp")), ("cheekPuff_R", Some("cheekPuff")), ("eyeBlink_L", Some("eyeBlinkLeft"))]
        {
            assert_eq!(ArkitShape::of_target(name).map(ArkitShape::name), want, "{name}");
        }
        // All that the ICT FaceKit's head has: of 57 targets four are none of ARKit's, the rest makes all shapes but the tongue.
        let sided = [
            "PupilDilate",
            "browDown",
            "browInnerUp",
            "browOuterUp",
            "cheekPuff",
            "cheekRaiser",
            "cheekSquint",
            "eyeBlink",
            "eyeLookDown",
            "eyeLookIn",
            "eyeLookOut",
            "eyeLookUp",
            "eyeSquint",
            "eyeWide",
            "mouthDimple",
            "mouthFrown",
            "mouthLowerDown",
            "mouthPress",
            "mouthSmile",
            "mouthStretch",
            "mouthUpperUp",
            "noseSneer",
        ];
        let whole = [
            "jawForward",
            "jawLeft",
            "jawOpen",
            "jawRight",
            "mouthClose",
            "mouthFunnel",
            "mouthLeft",
            "mouthPucker",
            "mouthRight",
            "mouthRollLower",
            "mouthRollUpper",
            "mouthShrugLower",
            "mouthShrugUpper",
        ];
        let names = sided.iter().flat_map(|stem| [format!("{stem}_L"), format!("{stem}_R")]).chain(whole.map(str::to_owned));
        let found: Vec<Option<ArkitShape>> = names.map(|name| ArkitShape::of_target(&name)).collect();
        assert_eq!((found.len(), found.iter().filter(|shape| shape.is_none()).count()), (57, 4));
        let distinct: std::collections::BTreeSet<ArkitShape> = found.into_iter().flatten().collect();
        assert_eq!(distinct.len(), NUM_ARKIT_SHAPES - 1);
        assert!(!distinct.iter().any(|shape| shape.name() == "tongueOut"));
        for name in ["", "_L", "PupilDilate_L", "cheekRaiser_R", "é_L"] {
            assert_eq!(ArkitShape::of_target(name), None, "{name}");
        }
    }

    #[test]
    fn room_names_keep_their_rule() {
        let longest = "a".repeat(64);
        for good in ["demo", "a", "A-b_9", longest.as_str()] {
            assert_eq!(RoomName::new(good).expect("allowed").as_str(), good);
        }
        let too_long = "a".repeat(65);
        for bad in ["", "a b", "../x", "ü", too_long.as_str()] {
            assert!(RoomName::new(bad).is_err(), "{bad}");
        }
    }
}
