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

    /// Says the same of a face in the other way: turning bones by displacements (`is_placed`) or by angles, so that a face of
    /// one kind can be blended into one of the other. Points stay where they are; a rotation may lose its roll about the arm.
    pub(super) fn convert(&self, state: &mut FaceState, is_placed: bool) {
        if state.is_placed == is_placed {
            return;
        }
        state.is_placed = is_placed;
        for (bone, motion) in self.bones.iter().zip(&mut state.motions) {
            let Some(pivot) = bone.pivot else { continue };
            if *motion == Vec3::ZERO {
                continue;
            }
            let arm = bone.rest - pivot;
            *motion = if is_placed {
                travel_of(arm, *motion)
            } else {
                let to = (arm + *motion).as_dvec3();
                let (pitch, yaw) = rotation::pitch_yaw_between(arm.as_dvec3(), to);
                // Off the circle about the pivot: the rest of the way goes along the arm.
                let stretch = to.length() / arm.as_dvec3().length().max(1e-9) - 1.0;
                Vec3::new(pitch as f32, yaw as f32, stretch as f32)
            };
        }
    }

    /// Writes evaluated points, within a packet's range of rest, and rotations. A bone whose motion is no number stays as it is
    /// in `points` and `rotations`: a clamp would make some number of it.
    pub(super) fn pose(&self, state: &FaceState, points: &mut [Vec3], rotations: &mut [Quat]) {
        let most = Vec3::splat(MAX_BONE_TRAVEL);
        for (i, (bone, motion)) in self.bones.iter().zip(&state.motions).enumerate() {
            if !motion.is_finite() {
                continue;
            }
            rotations[i] = Quat::IDENTITY;
            let mut travel = *motion;
            if let Some(pivot) = bone.pivot {
                let arm = bone.rest - pivot;
                if state.is_placed {
                    rotations[i] = rotation::to_f32(rotation::shortest_arc(arm, arm + *motion));
                } else {
                    travel = Vec3::ZERO;
                    if *motion != Vec3::ZERO {
                        let turn = rotation::from_pitch_yaw(f64::from(motion.x), f64::from(motion.y));
                        travel = travel_of(arm, *motion);
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

/// How far pitch, yaw (radians) and stretch (fraction of its length) carry the end of `arm`.
pub(super) fn travel_of(arm: Vec3, motion: Vec3) -> Vec3 {
    let turn = rotation::from_pitch_yaw(f64::from(motion.x), f64::from(motion.y));
    let arm = arm.as_dvec3();
    let mut end = rotation::rotate(turn, arm);
    if motion.z != 0.0 {
        end *= 1.0 + f64::from(motion.z);
    }
    (end - arm).as_vec3()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn skeleton() -> Skeleton {
        let turning = Bone { rest: Vec3::new(0.0, -0.1, 0.03), pivot: Some(Vec3::new(0.0, -0.02, -0.045)), turns_with: None };
        let sliding = Bone { rest: Vec3::new(0.03, 0.05, 0.05), pivot: None, turns_with: None };
        Skeleton { bones: vec![turning, sliding] }
    }

    fn posed(state: &FaceState) -> (Vec<Vec3>, Vec<Quat>) {
        let (mut points, mut rotations) = (vec![Vec3::ZERO; 2], vec![Quat::IDENTITY; 2]);
        skeleton().pose(state, &mut points, &mut rotations);
        (points, rotations)
    }

    #[test]
    fn a_motion_that_is_no_number_leaves_its_bone_where_it_was() {
        let mut state = FaceState::at_rest(2);
        state.motions = vec![Vec3::new(0.2, 0.0, 0.0), Vec3::new(0.0, 0.004, 0.0)];
        let (mut points, mut rotations) = posed(&state);
        let before = (points.clone(), rotations.clone());
        state.motions = vec![Vec3::new(f32::NAN, 0.0, 0.0), Vec3::new(0.0, f32::INFINITY, 0.0)];
        skeleton().pose(&state, &mut points, &mut rotations);
        assert_eq!((points, rotations), before);
    }

    #[test]
    fn a_face_said_in_the_other_way_is_the_same_face() {
        for (motion, is_placed) in [
            (Vec3::new(0.3, 0.05, 0.0), false),
            (Vec3::new(-0.1, -0.2, 0.0), false),
            (Vec3::new(0.002, -0.02, -0.01), true),
            (Vec3::new(-0.004, 0.006, 0.015), true),
            (Vec3::ZERO, true),
        ] {
            let mut state = FaceState::at_rest(2);
            state.motions = vec![motion, Vec3::new(0.001, 0.002, 0.003)];
            state.is_placed = is_placed;
            let (points, rotations) = posed(&state);
            skeleton().convert(&mut state, !is_placed);
            assert_eq!(state.is_placed, !is_placed);
            let (again, turned) = posed(&state);
            for i in 0..2 {
                assert!(points[i].distance(again[i]) < 1e-6, "{motion}: {} {}", points[i], again[i]);
                // The roll about the arm: of a yaw the part about it.
                let yaw = if is_placed { 0.3 } else { motion.y.abs() };
                let between = rotation::to_vector(rotations[i].as_dquat().inverse() * turned[i].as_dquat()).length();
                assert!(between <= f64::from(yaw) + 0.01, "{motion}: {} {}", rotations[i], turned[i]);
            }
        }
    }
}
