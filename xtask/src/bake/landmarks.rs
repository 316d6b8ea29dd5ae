//! The 68 iBUG landmarks on the base mesh.

use glam::Vec2;
use rhytid_shared::layout::{IBUG_MIRROR, NUM_IBUG};

/// Vertex of MakeHuman's `base.obj` for each iBUG landmark: the nearest to where a face tracker's points, found on renders
/// of this character at five yaws within 14 degrees, meet the skin (median, both sides averaged). The inner lips are set by
/// hand on their edges, which a tracker cannot tell apart while they touch. The brows' (17 to 26) only serve to find [`BROW`]'s places on the skin.
pub const IBUG_VERTICES: [u32; NUM_IBUG] = [
    5754, 5763, 5098, 869, 912, 737, 3698, 914, 5296, 7616, 10366, 7457, 7614, 7574, 11713, 12360, 12351, // jaw line
    261, 255, 224, 205, 208, 6983, 6980, 6998, 7024, 7030, // brows
    132, 131, 201, 294, 358, 313, 316, 7076, 7119, // nose
    4854, 6, 4865, 70, 47, 36, // right eye
    6854, 11483, 6790, 11472, 6820, 6831, // left eye
    424, 5354, 456, 466, 7215, 11956, 7184, 7233, 7241, 492, 486, 478, // outer lip
    427, 462, 468, 7221, 7187, 7243, 494, 488, // inner lip
];

/// The left brow's landmarks from the inner one, seen from the front: metres from the origin of head space. Trackers put
/// them on the upper border of the hair, which is not where the mesh has vertices.
pub const BROW: [Vec2; 5] =
    [Vec2::new(0.0152, 0.0152), Vec2::new(0.0300, 0.0178), Vec2::new(0.0426, 0.0183), Vec2::new(0.0517, 0.0154), Vec2::new(0.0575, 0.0102)];

/// Vertices in front of the ears, between which head space has its origin.
pub const EARS: [u32; 2] = [5402, 12001];

/// The landmark on the other side of the face.
pub fn mirror(landmark: usize) -> usize {
    IBUG_MIRROR[landmark]
}
