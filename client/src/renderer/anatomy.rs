//! Where the mouth and the eyes are, for the light inside them.

use super::RenderFrame;
use glam::Vec3;
use rhytid_shared::Character;
use rhytid_shared::character::{Bone, Drive, LidKind, Side};

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

/// Landmarks of the lids' edges: the corner of lower x and the other, two of the upper edge and two of the lower one.
const LID_MARKS: [[[usize; 2]; 3]; 2] = [[[42, 45], [43, 44], [46, 47]], [[36, 39], [37, 38], [40, 41]]];

/// The edges of one eye's lids, each as a parabola between the corners. Lengths are in radii of the ball, from its centre,
/// head space.
pub struct Lids {
    /// x and y of the corner of lower x, then of the other.
    pub corners: [f32; 4],
    /// How high the upper edge stands over the line between the corners, halfway.
    pub upper: f32,
    /// The same of the lower edge: below 0 where the eye is open.
    pub lower: f32,
}

impl Lids {
    /// Where the lids of a frame are: their edges turn with their bones. A character without such has them at rest.
    pub fn new(character: &Character, frame: &RenderFrame, side: Side) -> Self {
        let index = usize::from(side == Side::Right);
        let [x, y, z, radius] = eyeballs(character)[index];
        let centre = Vec3::new(x, y, z);
        let marks = LID_MARKS[index];
        let [low, high] = marks[0].map(|mark| (character.ibug68[mark] - centre) / radius);
        let arch = |kind: LidKind, marks: [usize; 2]| {
            let turn = character.bones.iter().zip(&frame.rotations).find_map(|(bone, turn)| match bone.drive {
                Drive::Lid { eye, lid, pivot, .. } if eye == side && lid == kind => Some((pivot, *turn)),
                _ => None,
            });
            let of = |mark: usize| {
                let rest = character.ibug68[mark];
                let at = turn.map_or(rest, |(pivot, turn)| pivot + turn * (rest - pivot));
                let at = (at - centre) / radius;
                // Off the corners, where a parabola says nothing of its height.
                let t = ((at.x - low.x) / (high.x - low.x).max(1e-3)).clamp(0.1, 0.9);
                (at.y - low.y - (high.y - low.y) * t) / (4.0 * t * (1.0 - t))
            };
            0.5 * (of(marks[0]) + of(marks[1]))
        };
        let (upper, lower) = (arch(LidKind::Upper, marks[1]), arch(LidKind::Lower, marks[2]));
        // Lids that are shut lie on each other.
        Self { corners: [low.x, low.y, high.x, high.y], upper: upper.max(lower), lower }
    }
}

/// Where the eyes look, left and right: unit vectors, world space.
pub fn gazes(character: &Character, frame: &RenderFrame) -> [[f32; 4]; 2] {
    [Side::Left, Side::Right].map(|side| {
        let bone = character.bones.iter().position(|bone| matches!(bone.drive, Drive::Eye { eye, .. } if eye == side));
        let in_head = bone.map_or(Vec3::Z, |bone| frame.rotations[bone] * Vec3::Z);
        (frame.head.rotation * in_head).extend(0.0).to_array()
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Quat;
    use rhytid_shared::DEFAULT_CHARACTER_GLB;

    #[test]
    fn lid_s_edge_comes_down_with_its_bone_and_stops_at_the_other_lid() {
        let character = Character::from_glb(DEFAULT_CHARACTER_GLB).expect("the built-in character is whole");
        let lids_at = |share: f32| {
            let mut frame = RenderFrame::at_rest(&character);
            for (bone, rotation) in character.bones.iter().zip(&mut frame.rotations) {
                if let Drive::Lid { eye: Side::Left, lid: LidKind::Upper, shut_angle, .. } = bone.drive {
                    *rotation = Quat::from_rotation_x(share * shut_angle);
                }
            }
            [Side::Left, Side::Right].map(|side| Lids::new(&character, &frame, side))
        };
        let [open, half, shut] = [0.0, 0.5, 1.0].map(lids_at);
        assert!((0.4..0.9).contains(&open[0].upper) && (-0.6..-0.1).contains(&open[0].lower), "{} {}", open[0].upper, open[0].lower);
        assert!(half[0].upper < open[0].upper - 0.2, "{}", half[0].upper);
        assert_eq!(shut[0].upper, shut[0].lower);
        assert_eq!(half[1].upper, open[1].upper, "the other eye stays open");
        for lids in open {
            assert!(lids.corners[0] < -0.8 && lids.corners[2] > 0.8, "{:?}", lids.corners);
        }
    }
}
