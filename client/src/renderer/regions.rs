//! Parts of a mesh by the reference poses that can wrinkle them: where no bone of a pose reaches, its map need not be read.

use super::coefficients::moves_bone;
use crate::asset::{CharacterAsset, PrimitiveAsset, Surface, Vertex};
use std::collections::BTreeMap;
use std::ops::Range;

/// Triangles that the same poses can wrinkle.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Region {
    /// Bit `k` stands where pose `k` has a wrinkle map and moves a bone of one of the vertices.
    pub poses: u8,
    /// Where its indices stand.
    pub indices: Range<u32>,
}

/// The triangles of a part sorted into regions, each triangle once and in the file's order within its region.
pub fn split(asset: &CharacterAsset, primitive: &PrimitiveAsset) -> (Vec<u32>, Vec<Region>) {
    let scales = match &asset.wrinkles {
        Some(wrinkles) if primitive.surface == Surface::Skin => wrinkles.scales.as_slice(),
        _ => &[],
    };
    let character = &asset.character;
    let poses_of_bone: Vec<u8> = (0..character.num_bones())
        .map(|i| (0..scales.len()).filter(|&k| scales[k] > 0.0 && moves_bone(character, k, i)).fold(0, |poses, k| poses | 1 << k))
        .collect();
    split_by(&primitive.indices, |index| poses_of_vertex(&primitive.vertices[index as usize], &poses_of_bone))
}

fn poses_of_vertex(vertex: &Vertex, poses_of_bone: &[u8]) -> u8 {
    let reached = vertex.joints.iter().zip(vertex.weights).filter(|&(_, weight)| weight > 0.0);
    reached.filter_map(|(&joint, _)| poses_of_bone.get(usize::from(joint))).fold(0, |all, poses| all | poses)
}

fn split_by(indices: &[u32], poses_of_index: impl Fn(u32) -> u8) -> (Vec<u32>, Vec<Region>) {
    let mut by_poses: BTreeMap<u8, Vec<u32>> = BTreeMap::new();
    for triangle in indices.as_chunks::<3>().0 {
        let poses = triangle.iter().fold(0, |all, &index| all | poses_of_index(index));
        by_poses.entry(poses).or_default().extend(triangle);
    }
    let mut sorted = Vec::with_capacity(indices.len());
    let mut regions = Vec::with_capacity(by_poses.len());
    for (poses, triangles) in by_poses {
        let begin = sorted.len() as u32;
        sorted.extend(triangles);
        regions.push(Region { poses, indices: begin..sorted.len() as u32 });
    }
    (sorted, regions)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_triangle_stands_in_one_region_with_all_poses_of_its_corners() {
        // Corners 0 to 5; pose 0 reaches corners 1 and 2, pose 1 reaches corner 2.
        let poses = [0, 1, 3, 0, 0, 0];
        let (sorted, regions) = split_by(&[3, 4, 5, 0, 1, 3, 1, 2, 3, 5, 4, 0], |index| poses[index as usize]);
        assert_eq!(sorted, [3, 4, 5, 5, 4, 0, 0, 1, 3, 1, 2, 3]);
        let expected = [(0, 0..6), (1, 6..9), (3, 9..12)].map(|(poses, indices)| Region { poses, indices });
        assert_eq!(regions, expected);
    }

    #[test]
    fn a_pose_reaches_a_vertex_by_weight_only() {
        let mut vertex: Vertex = bytemuck::Zeroable::zeroed();
        vertex.joints = [0, 1, 9, 0];
        vertex.weights = [0.0, 0.4, 0.6, 0.0];
        assert_eq!(poses_of_vertex(&vertex, &[0b01, 0b10]), 0b10);
    }
}
