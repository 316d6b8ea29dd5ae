//! Where the mouth and the eyes are, for the light inside them.

use super::RenderFrame;
use glam::Vec3;
use rhytid_shared::Character;
use rhytid_shared::character::{Bone, Drive, Side};

/// The opening of the lips.
pub struct Mouth {
    /// Between the inner lips at rest, head space.
    pub middle: Vec3,
    /// Half its width at rest, metres.
    pub half_width: f32,
    /// How far the corners lie behind the middle, in units of `half_width`.
    pub corner_depth: f32,
    /// How far the lips are apart, in units of `half_width`.
    gap: f32,
}

impl Mouth {
    pub fn new(character: &Character, frame: &RenderFrame) -> Self {
        let marks = &character.ibug68;
        let (upper, lower) = (marks[62], marks[66]);
        let middle = (upper + lower) * 0.5;
        let half_width = (0.5 * marks[60].distance(marks[64])).max(1e-3);
        // The bone that follows the inner lip; where none does, the nearest.
        let share = |bone: &Bone, landmark: usize| match &bone.drive {
            Drive::Skin { landmarks } => landmarks.iter().filter(|entry| entry.landmark == landmark).map(|entry| entry.weight).sum(),
            _ => 0.0_f32,
        };
        let lift = |landmark: usize| {
            let best = (0..character.num_bones()).max_by(|&a, &b| {
                let [(share_a, far_a), (share_b, far_b)] =
                    [a, b].map(|i| (share(&character.bones[i], landmark), character.bones[i].rest.distance_squared(marks[landmark])));
                share_a.total_cmp(&share_b).then(far_b.total_cmp(&far_a))
            });
            best.map_or(0.0, |bone| frame.points[bone].y - character.bones[bone].rest.y)
        };
        Self {
            middle,
            half_width,
            corner_depth: (middle.z - 0.5 * (marks[60].z + marks[64].z)) / half_width,
            gap: (lift(62) - lift(66)).max(0.0) / half_width,
        }
    }

    /// How deep light reaches, in units of `half_width`: hardly to the teeth where the lips meet, behind the tongue's
    /// tip where they stand wide apart. Tuned by eye.
    pub fn light_reach(&self) -> f32 {
        0.32 + 1.7 * (self.gap / 0.25).min(1.0)
    }
}

/// Centres and radii of the eyeballs: the pivots of the eye bones, else from the landmarks. Left, then right.
pub fn eyeballs(character: &Character) -> [[f32; 4]; 2] {
    // An adult's eyeball measures 24 mm across and the corners of the lids lie 86 mm apart (Farkas 1994).
    let radius = character.interocular() * 0.14;
    let centre = |side: Side, corners: [usize; 2]| {
        let pivot = character.bones.iter().find_map(|bone| match bone.drive {
            Drive::Eye { eye, pivot, .. } if eye == side => Some(pivot),
            _ => None,
        });
        pivot.unwrap_or_else(|| (character.ibug68[corners[0]] + character.ibug68[corners[1]]) * 0.5 - Vec3::Z * radius * 0.8)
    };
    [centre(Side::Left, [42, 45]).extend(radius).to_array(), centre(Side::Right, [36, 39]).extend(radius).to_array()]
}

/// Where the eyes look, left and right: unit vectors, world space.
pub fn gazes(character: &Character, frame: &RenderFrame) -> [[f32; 4]; 2] {
    [Side::Left, Side::Right].map(|side| {
        let bone = character.bones.iter().position(|bone| matches!(bone.drive, Drive::Eye { eye, .. } if eye == side));
        let in_head = bone.map_or(Vec3::Z, |bone| frame.rotations[bone] * Vec3::Z);
        (frame.head.rotation * in_head).extend(0.0).to_array()
    })
}
