//! What the solve gives and the viewer draws: one solved frame of a face.

use crate::character::Character;
use crate::names::NUM_ARKIT_SHAPES;
use glam::{Quat, Vec3};

/// Rigid pose of the head against its neutral pose, in the character's model space (metres, +Y up, +Z out of the face).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HeadPose {
    /// Unit quaternion, turns about the character's head pivot.
    pub rotation: Quat,
    /// Metres from where the calibrated neutral had the head, each within ±0.3.
    pub position: Vec3,
}

impl Default for HeadPose {
    fn default() -> Self {
        Self { rotation: Quat::IDENTITY, position: Vec3::ZERO }
    }
}

/// One solved frame: where the bones are, how strongly each reference pose shows at each bone, and the head.
///
/// `n` bones in the order of the character, `o` reference poses (rest not counted).
#[derive(Debug, Clone, PartialEq)]
pub struct FaceFrame {
    /// Counts the publishers the room has had, from 1.
    pub session: u32,
    /// Counts the frames of this session, from 0.
    pub seq: u32,
    /// The sender's clock at capture, microseconds.
    pub captured_at_micros: u64,
    /// False while the tracker sees no face.
    pub face: bool,
    /// `n` evaluated points, metres, head space.
    pub points: Vec<Vec3>,
    /// `n` rotations in head space; identity for bones that do not turn.
    pub rotations: Vec<Quat>,
    /// `o * n` influences in `[0, 1]`, pose-major: `influences[k * n + i]`.
    pub influences: Vec<f32>,
    /// Zone weights in `[0, 1]`: how strongly the wrinkles of each zone show; empty for a character without zones.
    pub zones: Vec<f32>,
    /// As many again: how far each zone is stretched, in `[0, 1]`. What a zone's sum is below 0, where the character has a map
    /// for that; at most one of a zone's two values is not 0.
    pub stretched: Vec<f32>,
    /// Expression weights in `[0, 1]` where the feed carries them, in the order of [`crate::ARKIT_NAMES`].
    pub shapes: Option<[f32; NUM_ARKIT_SHAPES]>,
    /// Head pose.
    pub head: HeadPose,
}

impl FaceFrame {
    /// The character at rest, as frame 0 of session 1.
    pub fn at_rest(character: &Character) -> Self {
        Self {
            session: 1,
            seq: 0,
            captured_at_micros: 0,
            face: true,
            points: character.bones.iter().map(|bone| bone.rest).collect(),
            rotations: vec![Quat::IDENTITY; character.num_bones()],
            influences: vec![0.0; character.num_poses() * character.num_bones()],
            zones: vec![0.0; character.num_zones()],
            stretched: vec![0.0; character.num_zones()],
            shapes: None,
            head: HeadPose::default(),
        }
    }
}
