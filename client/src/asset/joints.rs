//! From a drawn frame to one matrix a joint.

use crate::renderer::RenderFrame;
use glam::Affine3A;
use rhytid_shared::Character;
use rhytid_shared::limits::{MAX_BONES, MAX_JOINTS};

/// How a joint moves.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum JointMotion {
    /// Not at all: it lies outside the head's part of the skeleton.
    Still,
    /// With the head.
    Head,
    /// With a bone; joints below a bone that are none themselves move with it, too.
    Bone {
        /// Index into [`Character::bones`].
        bone: usize,
        /// Whether the joint lies below the head joint and so is carried by it.
        follows_head: bool,
    },
}

/// The joints that vertices refer to. Entry `i` below the number of bones belongs to bone `i`, so that a vertex's joint
/// number is also the number of its bone's coefficients; the skin's other joints follow.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Palette {
    /// One motion an entry, at most [`Palette::CAPACITY`].
    pub motions: Vec<JointMotion>,
}

impl Palette {
    /// Most entries: every bone and, for bones that share a joint, every joint besides.
    pub const CAPACITY: usize = MAX_BONES + MAX_JOINTS;

    /// `entries` matrices that take a point of the neutral mesh to where `frame` has it, model space.
    ///
    /// # Panics
    /// Where `frame` does not fit `character` ([`RenderFrame::fits`]).
    pub fn model_from_rest(&self, character: &Character, frame: &RenderFrame) -> Vec<Affine3A> {
        let head = character.head_motion(&frame.head);
        let of_motion = |motion: &JointMotion| match *motion {
            JointMotion::Still => Affine3A::IDENTITY,
            JointMotion::Head => head,
            JointMotion::Bone { bone, follows_head: true } => head * character.bone_motion(&frame.rotations, &frame.points, bone),
            JointMotion::Bone { bone, follows_head: false } => character.bone_motion(&frame.rotations, &frame.points, bone),
        };
        self.motions.iter().map(of_motion).collect()
    }

    /// As [`Self::model_from_rest`], with all bones at rest on a head that moves: for a face that its shapes deform.
    pub fn model_from_unposed(&self, character: &Character, frame: &RenderFrame) -> Vec<Affine3A> {
        let head = character.head_motion(&frame.head);
        let of_motion = |motion: &JointMotion| match *motion {
            JointMotion::Still | JointMotion::Bone { follows_head: false, .. } => Affine3A::IDENTITY,
            JointMotion::Head | JointMotion::Bone { follows_head: true, .. } => head,
        };
        self.motions.iter().map(of_motion).collect()
    }
}
