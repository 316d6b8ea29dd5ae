//! Landmark layouts and how they map onto each other.

/// How the points of a tracker are numbered.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Layout {
    /// iBUG / 300-W, 68 points.
    Ibug68,
    /// MediaPipe's face mesh with irises, 478 points.
    Mediapipe478,
    /// OpenSeeFace, 66 points (iBUG without the two outer mouth corners).
    OpenSeeFace66,
    /// The sender's own list of feature points, by the character's names.
    Named(Vec<String>),
}

impl Layout {
    /// Points a frame in this layout carries.
    pub fn num_points(&self) -> usize {
        match self {
            Self::Ibug68 => NUM_IBUG,
            Self::Mediapipe478 => 478,
            Self::OpenSeeFace66 => 66,
            Self::Named(names) => names.len(),
        }
    }
}

/// Points of the iBUG layout.
pub const NUM_IBUG: usize = 68;

/// MediaPipe's vertex for each iBUG landmark (the consensus of public tables, mirror-symmetric).
pub const IBUG_FROM_MEDIAPIPE: [usize; NUM_IBUG] = [
    127, 234, 93, 132, 58, 136, 150, 176, 152, 400, 379, 365, 288, 361, 323, 454, 356, // jaw line
    70, 63, 105, 66, 107, 336, 296, 334, 293, 300, // brows
    168, 197, 5, 4, 98, 97, 2, 326, 327, // nose
    33, 160, 158, 133, 153, 144, // right eye
    362, 385, 387, 263, 373, 380, // left eye
    61, 39, 37, 0, 267, 269, 291, 321, 314, 17, 84, 91, // outer lip
    78, 82, 13, 312, 308, 317, 14, 87, // inner lip
];

/// OpenSeeFace's point for each iBUG landmark; the two outer mouth corners it lacks take the inner ones.
pub const IBUG_FROM_OPENSEEFACE: [usize; NUM_IBUG] = {
    let mut table = [0; NUM_IBUG];
    let mut ibug = 0;
    while ibug < NUM_IBUG {
        table[ibug] = match ibug {
            0..48 => ibug,
            48 => 58,
            49..54 => ibug - 1,
            54 => 62,
            55..60 => ibug - 2,
            _ => ibug - 2,
        };
        ibug += 1;
    }
    table
};

/// The landmark on the other side of the face.
pub const IBUG_MIRROR: [usize; NUM_IBUG] = [
    16, 15, 14, 13, 12, 11, 10, 9, 8, 7, 6, 5, 4, 3, 2, 1, 0, //
    26, 25, 24, 23, 22, 21, 20, 19, 18, 17, //
    27, 28, 29, 30, 35, 34, 33, 32, 31, //
    45, 44, 43, 42, 47, 46, 39, 38, 37, 36, 41, 40, //
    54, 53, 52, 51, 50, 49, 48, 59, 58, 57, 56, 55, //
    64, 63, 62, 61, 60, 67, 66, 65,
];

/// Landmarks that expressions do not move: nose bridge, nostril base, eye corners.
pub const IBUG_STABLE: [usize; 13] = [27, 28, 29, 30, 31, 32, 33, 34, 35, 36, 39, 42, 45];
