//! The 68 iBUG landmarks on the base mesh.

use rhytid_shared::layout::{IBUG_MIRROR, NUM_IBUG};

/// Vertex of MakeHuman's `base.obj` for each iBUG landmark. Found by a face tracker on renders, corrected by hand on
/// renders of this character. The brows' (17 to 26) only serve until the hair is placed.
pub const IBUG_VERTICES: [u32; NUM_IBUG] = [
    5402, 5763, 5092, 5241, 5240, 915, 922, 5292, 5225, 11898, 7624, 7617, 11849, 11850, 11707, 12360, 12001, // jaw line
    211, 207, 206, 1134, 209, 6984, 7826, 6981, 6982, 6986, // brows
    133, 5063, 291, 5054, 347, 359, 312, 7120, 7108, // nose
    6759, 4849, 55, 74, 4863, 41, // right eye
    6858, 6839, 11467, 13355, 6825, 11481, // left eye
    424, 5354, 456, 455, 7215, 11956, 7184, 7235, 7241, 492, 486, 480, // outer lip
    427, 462, 468, 7221, 7187, 7243, 494, 488, // inner lip
];

/// The landmark on the other side of the face.
pub fn mirror(landmark: usize) -> usize {
    IBUG_MIRROR[landmark]
}
