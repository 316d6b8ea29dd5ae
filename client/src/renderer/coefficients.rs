//! Influences in the order the vertex stage reads them.

use super::uniforms::{CoefficientVectors, PoseTable};
use crate::asset::CharacterAsset;
use rhytid_shared::Character;
use rhytid_shared::limits::MAX_BONES;

/// Vec4s a bone: one for up to four poses, else two.
pub fn pose_vectors(num_poses: usize) -> usize {
    if num_poses > 4 { 2 } else { 1 }
}

/// Bone-major vec4s from pose-major influences: what stands at `pose_major[k * n + i]` goes to component `k % 4` of vec4
/// `i * pose_vectors + k / 4`. Values outside `[0, 1]` cannot come from a solve and are clamped.
pub fn bone_major(pose_major: &[f32], num_bones: usize, num_poses: usize) -> Vec<[f32; 4]> {
    let stride = pose_vectors(num_poses);
    let mut vectors = vec![[0.0; 4]; num_bones * stride];
    for k in 0..num_poses {
        for i in 0..num_bones {
            vectors[i * stride + k / 4][k % 4] = pose_major[k * num_bones + i].clamp(0.0, 1.0);
        }
    }
    vectors
}

/// One bit for each pose that shows anywhere, of influences pose-major.
pub fn active_poses(pose_major: &[f32], num_bones: usize) -> u32 {
    let is_active = |influences: &[f32]| influences.iter().any(|influence| *influence > 0.0);
    pose_major.chunks(num_bones.max(1)).enumerate().map(|(k, influences)| u32::from(is_active(influences)) << k).sum()
}

/// The table that stays on the device.
pub fn pose_table(asset: &CharacterAsset) -> PoseTable {
    let character = &asset.character;
    let (num_bones, num_poses) = (character.num_bones(), character.num_poses());
    let moves: Vec<f32> =
        (0..num_poses).flat_map(|k| (0..num_bones).map(move |i| f32::from(u8::from(moves_bone(character, k, i))))).collect();
    let mut moved: CoefficientVectors = [[0.0; 4]; _];
    for (to, from) in moved.iter_mut().zip(bone_major(&moves, num_bones, num_poses)) {
        *to = from;
    }
    let mut table = PoseTable {
        moved,
        scales: [[0.0; 4]; 2],
        contains_neutral: [[0.0; 4]; 2],
        num_bones: num_bones as u32,
        falloff: character.falloff,
        padding: [0; 2],
    };
    if let Some(wrinkles) = &asset.wrinkles {
        for k in 0..num_poses {
            table.scales[k / 4][k % 4] = wrinkles.scales[k];
            table.contains_neutral[k / 4][k % 4] = f32::from(u8::from(wrinkles.contains_neutral[k]));
        }
    }
    table
}

/// Whether pose `k` moves bone `i`; the checks leave no travel between nothing and something.
pub fn moves_bone(character: &Character, k: usize, i: usize) -> bool {
    character.poses[k].points[i] != character.bones[i].rest
}

const _: () = assert!(MAX_BONES <= u8::MAX as usize, "vertices name bones by one byte");

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn four_poses_take_one_vector_a_bone_and_exactly_o_times_n_values() {
        let pose_major: Vec<f32> = (0..12).map(|value| value as f32 / 16.0).collect();
        let vectors = bone_major(&pose_major, 3, 4);
        assert_eq!(
            vectors,
            [[0.0, 3.0, 6.0, 9.0], [1.0, 4.0, 7.0, 10.0], [2.0, 5.0, 8.0, 11.0]].map(|bone| bone.map(|value: f32| value / 16.0))
        );
    }

    #[test]
    fn a_fifth_pose_opens_the_second_vector() {
        let mut pose_major = vec![0.0; 5 * 2];
        pose_major[4 * 2 + 1] = 0.5;
        let vectors = bone_major(&pose_major, 2, 5);
        assert_eq!(vectors.len(), 4);
        assert_eq!(vectors[3], [0.5, 0.0, 0.0, 0.0]);
    }
}
