//! What is drawn: one moment of a face, usually between two solved frames.

use glam::{Quat, Vec3};
use rhytid_shared::{Character, FaceFrame, HeadPose, NUM_ARKIT_SHAPES};

/// One moment of a face. `n` bones in the character's order, `o` reference poses.
#[derive(Debug, Clone, PartialEq)]
pub struct RenderFrame {
    /// `n` evaluated points, metres, head space.
    pub points: Vec<Vec3>,
    /// `n` rotations, head space.
    pub rotations: Vec<Quat>,
    /// `o * n` influences in `[0, 1]`, pose-major: `influences[k * n + i]`.
    pub influences: Vec<f32>,
    /// Zone weights in `[0, 1]`; empty for a character without zones.
    pub zones: Vec<f32>,
    /// As many again: how far each zone is stretched.
    pub stretched: Vec<f32>,
    /// Expression weights in `[0, 1]` in the order of [`rhytid_shared::ARKIT_NAMES`], where the feed carries them.
    pub shapes: Option<[f32; NUM_ARKIT_SHAPES]>,
    /// Head pose.
    pub head: HeadPose,
}

impl RenderFrame {
    /// The character at rest.
    pub fn at_rest(character: &Character) -> Self {
        Self::from(&FaceFrame::at_rest(character))
    }

    /// True where the arrays have the lengths this character needs.
    pub fn fits(&self, character: &Character) -> bool {
        let num_bones = character.num_bones();
        let num_zones = character.num_zones();
        self.points.len() == num_bones
            && self.rotations.len() == num_bones
            && self.influences.len() == num_bones * character.num_poses()
            && self.zones.len() == num_zones
            && self.stretched.len() == num_zones
    }
}

impl From<&FaceFrame> for RenderFrame {
    fn from(frame: &FaceFrame) -> Self {
        Self {
            points: frame.points.clone(),
            rotations: frame.rotations.clone(),
            influences: frame.influences.clone(),
            zones: frame.zones.clone(),
            stretched: frame.stretched.clone(),
            shapes: frame.shapes,
            head: frame.head,
        }
    }
}
