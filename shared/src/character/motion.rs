//! How head and bones carry what hangs on them: the same for all that draws a face or writes it down.

use super::Character;
use crate::face::HeadPose;
use glam::{Affine3A, Quat, Vec3};

impl Character {
    /// The rigid motion of the head, model space: about its pivot, then to its place.
    pub fn head_motion(&self, head: &HeadPose) -> Affine3A {
        about(head.rotation, self.head_pivot, self.head_pivot + head.position)
    }

    /// The motion of bone number `bone` in head space, metres. Bones that turn do so about their pivot; all others carry their
    /// evaluated point to its place and turn about it: by the rotation of the bone they turn with, or their own.
    ///
    /// # Panics
    /// Where `rotations` or `points` have fewer entries than there are bones.
    pub fn bone_motion(&self, rotations: &[Quat], points: &[Vec3], bone: usize) -> Affine3A {
        let description = &self.bones[bone];
        if let Some(pivot) = description.pivot() {
            return about(rotations[bone], pivot, pivot);
        }
        let rotation = rotations[description.turns_with.unwrap_or(bone)];
        about(rotation, description.rest, points[bone])
    }
}

/// Turns about `from` and moves `from` to `to`.
fn about(rotation: Quat, from: Vec3, to: Vec3) -> Affine3A {
    Affine3A::from_rotation_translation(rotation, to - rotation * from)
}
