//! From each bone's motion to evaluated points and rotations, and from an animator's own bones to motions.

use super::easing::FaceState;
use super::error::SolveError;
use super::rotation;
use glam::{Quat, Vec3};
use rhytid_shared::Character;
use rhytid_shared::limits::MAX_BONE_TRAVEL;

/// An animator's bones are metres in head space; a point farther off means another unit.
const FARTHEST: f32 = 1.0;

#[derive(Debug, Clone, Copy)]
struct Bone {
    rest: Vec3,
    pivot: Option<Vec3>,
    turns_with: Option<usize>,
}

/// The character's bones.
#[derive(Debug, Clone)]
pub(super) struct Skeleton {
    bones: Vec<Bone>,
}

impl Skeleton {
    pub(super) fn new(character: &Character) -> Self {
        let bones = character.bones.iter().map(|bone| Bone { rest: bone.rest, pivot: bone.pivot(), turns_with: bone.turns_with }).collect();
        Self { bones }
    }

    pub(super) fn check_placed(&self, points: &[(usize, Vec3)]) -> Result<(), SolveError> {
        for &(index, point) in points {
            if index >= self.bones.len() {
                return Err(SolveError::BoneIndex { got: index, num_bones: self.bones.len() });
            }
            // A NaN is in no range.
            if let Some(got) = point.to_array().into_iter().find(|value| !(-FARTHEST..=FARTHEST).contains(value)) {
                return Err(SolveError::Value { field: "bones", index, got, expected: "within ±1 m of the origin of head space" });
            }
        }
        Ok(())
    }

    /// Bones that are placed directly: every motion is a displacement; bones not named stay at rest.
    pub(super) fn read_placed(&self, points: &[(usize, Vec3)], state: &mut FaceState) {
        state.motions.fill(Vec3::ZERO);
        for &(index, point) in points {
            state.motions[index] = point - self.bones[index].rest;
        }
        state.weights = None;
        state.is_placed = true;
    }

    /// Writes evaluated points, within a packet's range of rest, and rotations.
    pub(super) fn pose(&self, state: &FaceState, points: &mut [Vec3], rotations: &mut [Quat]) {
        let most = Vec3::splat(MAX_BONE_TRAVEL);
        for (i, (bone, motion)) in self.bones.iter().zip(&state.motions).enumerate() {
            rotations[i] = Quat::IDENTITY;
            let mut travel = *motion;
            if let Some(pivot) = bone.pivot {
                let arm = bone.rest - pivot;
                if state.is_placed {
                    rotations[i] = rotation::to_f32(rotation::shortest_arc(arm, arm + *motion));
                } else {
                    travel = Vec3::ZERO;
                    if motion.x != 0.0 || motion.y != 0.0 {
                        let turn = rotation::from_pitch_yaw(f64::from(motion.x), f64::from(motion.y));
                        travel = (rotation::rotate(turn, arm.as_dvec3()) - arm.as_dvec3()).as_vec3();
                        rotations[i] = rotation::to_f32(turn);
                    }
                }
            }
            points[i] = bone.rest + travel.clamp(-most, most);
        }
        for (i, bone) in self.bones.iter().enumerate() {
            if let Some(leader) = bone.turns_with {
                rotations[i] = rotations[leader];
            }
        }
    }
}
