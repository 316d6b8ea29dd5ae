//! Expressions as weights of ARKit's shapes, after the muscles that EMFACS gives each emotion; amounts tuned by eye.

/// Amounts by name.
pub(crate) type Amounts = [(&'static str, f32)];

/// An expression by the name that the paper's Table 1.1 has for it.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Expression {
    pub(crate) name: &'static str,
    pub(crate) weights: &'static Amounts,
}

pub(crate) const JOY: Expression = Expression {
    name: "joy",
    weights: &[
        ("mouthSmileLeft", 0.85),
        ("mouthSmileRight", 0.85),
        ("cheekSquintLeft", 0.7),
        ("cheekSquintRight", 0.7),
        ("mouthDimpleLeft", 0.2),
        ("mouthDimpleRight", 0.2),
        ("eyeSquintLeft", 0.3),
        ("eyeSquintRight", 0.3),
        ("browOuterUpLeft", 0.45),
        ("browOuterUpRight", 0.45),
    ],
};

pub(crate) const SURPRISE: Expression = Expression {
    name: "surprise",
    weights: &[
        ("browInnerUp", 0.9),
        ("browOuterUpLeft", 0.9),
        ("browOuterUpRight", 0.9),
        ("eyeWideLeft", 0.7),
        ("eyeWideRight", 0.7),
        ("jawOpen", 0.35),
    ],
};

pub(crate) const FEAR: Expression = Expression {
    name: "fear",
    weights: &[
        ("browInnerUp", 0.95),
        ("browOuterUpLeft", 0.3),
        ("browOuterUpRight", 0.3),
        ("browDownLeft", 0.3),
        ("browDownRight", 0.3),
        ("eyeWideLeft", 0.9),
        ("eyeWideRight", 0.9),
        ("mouthStretchLeft", 0.7),
        ("mouthStretchRight", 0.7),
        ("jawOpen", 0.18),
    ],
};

pub(crate) const ANGER: Expression = Expression {
    name: "anger",
    weights: &[
        ("browDownLeft", 1.0),
        ("browDownRight", 1.0),
        ("noseSneerLeft", 0.4),
        ("noseSneerRight", 0.4),
        ("eyeSquintLeft", 0.4),
        ("eyeSquintRight", 0.4),
        ("mouthPressLeft", 0.6),
        ("mouthPressRight", 0.6),
        ("mouthFrownLeft", 0.35),
        ("mouthFrownRight", 0.35),
    ],
};

pub(crate) const DISGUST: Expression = Expression {
    name: "disgust",
    weights: &[
        ("noseSneerLeft", 1.0),
        ("noseSneerRight", 1.0),
        ("mouthUpperUpLeft", 0.7),
        ("mouthUpperUpRight", 0.7),
        ("browDownLeft", 0.5),
        ("browDownRight", 0.5),
        ("cheekSquintLeft", 0.5),
        ("cheekSquintRight", 0.5),
        ("eyeSquintLeft", 0.4),
        ("eyeSquintRight", 0.4),
        ("mouthFrownLeft", 0.3),
        ("mouthFrownRight", 0.3),
        ("mouthShrugLower", 0.4),
    ],
};

pub(crate) const SAD: Expression = Expression {
    name: "sad",
    weights: &[
        ("browInnerUp", 0.95),
        ("browDownLeft", 0.15),
        ("browDownRight", 0.15),
        ("mouthFrownLeft", 0.8),
        ("mouthFrownRight", 0.8),
        ("mouthShrugLower", 0.6),
        ("eyeLookDownLeft", 0.3),
        ("eyeLookDownRight", 0.3),
        ("eyeSquintLeft", 0.2),
        ("eyeSquintRight", 0.2),
    ],
};

/// In the order of the table.
pub(crate) const ALL: [Expression; 6] = [JOY, SURPRISE, FEAR, ANGER, DISGUST, SAD];

/// Many shapes at once, no two halves alike: half a disgusted grin under brows that disagree.
#[cfg(feature = "embedded")]
pub(crate) const COMPLEX: Expression = Expression {
    name: "complex",
    weights: &[
        ("browOuterUpLeft", 0.95),
        ("browInnerUp", 0.45),
        ("browDownRight", 0.75),
        ("noseSneerLeft", 0.35),
        ("noseSneerRight", 0.9),
        ("cheekSquintRight", 0.7),
        ("eyeSquintRight", 0.55),
        ("eyeWideLeft", 0.4),
        ("mouthSmileLeft", 0.55),
        ("mouthUpperUpRight", 0.6),
        ("mouthDimpleLeft", 0.3),
        ("mouthStretchRight", 0.35),
        ("mouthLeft", 0.25),
        ("jawOpen", 0.12),
        ("jawLeft", 0.2),
        ("eyeLookInLeft", 0.25),
        ("eyeLookOutRight", 0.25),
    ],
};
