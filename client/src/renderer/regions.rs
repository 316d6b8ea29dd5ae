//! Parts of a mesh by the reference poses and zones that can wrinkle them: where no bone of a pose reaches and no mask lies,
//! no map need be read.

use super::coefficients::moves_bone;
use crate::asset::{CharacterAsset, MipChain, PrimitiveAsset, Surface, Vertex};
use glam::Vec2;
use std::collections::BTreeMap;
use std::ops::Range;

/// Triangles that the same poses and zones can wrinkle.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Region {
    /// Bit `k` stands where pose `k` has a wrinkle map and moves a bone of one of the vertices.
    pub poses: u8,
    /// The masks of the zones reach it.
    pub has_zones: bool,
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
    let masks = asset.zones.as_ref().filter(|_| primitive.surface == Surface::Skin).map(|zones| &zones.masks);
    split_by(
        &primitive.indices,
        |index| poses_of_vertex(&primitive.vertices[index as usize], &poses_of_bone),
        |triangle| masks.is_some_and(|masks| has_mask(masks, triangle.map(|index| Vec2::from(primitive.vertices[index as usize].uv)))),
    )
}

/// Whether any mask lies on or near a triangle of the texture. Smaller versions of a mask reach a little further.
fn has_mask(masks: &[MipChain; 2], corners: [Vec2; 3]) -> bool {
    const NEAR: f32 = 3.0;
    let [width, height] = masks[0].size.map(|side| side as i32);
    let low = corners.into_iter().fold(Vec2::INFINITY, Vec2::min) * Vec2::new(width as f32, height as f32) - NEAR;
    let high = corners.into_iter().fold(Vec2::NEG_INFINITY, Vec2::max) * Vec2::new(width as f32, height as f32) + NEAR;
    // A triangle over a seam of the texture, or outside of it, has them for certain.
    if !(high - low).is_finite() || (high - low).max_element() > 0.5 * width as f32 {
        return true;
    }
    (low.y.floor() as i32..=high.y.floor() as i32).any(|y| {
        (low.x.floor() as i32..=high.x.floor() as i32).any(|x| {
            let at = 4 * (y.rem_euclid(height) * width + x.rem_euclid(width)) as usize;
            masks.iter().any(|mask| mask.levels[0][at..at + 4].iter().any(|code| *code > 0))
        })
    })
}

fn poses_of_vertex(vertex: &Vertex, poses_of_bone: &[u8]) -> u8 {
    let reached = vertex.joints.iter().zip(vertex.weights).filter(|&(_, weight)| weight > 0.0);
    reached.filter_map(|(&joint, _)| poses_of_bone.get(usize::from(joint))).fold(0, |all, poses| all | poses)
}

fn split_by(indices: &[u32], poses_of_index: impl Fn(u32) -> u8, has_zones: impl Fn([u32; 3]) -> bool) -> (Vec<u32>, Vec<Region>) {
    let mut by_poses: BTreeMap<(u8, bool), Vec<u32>> = BTreeMap::new();
    for triangle in indices.as_chunks::<3>().0 {
        let poses = triangle.iter().fold(0, |all, &index| all | poses_of_index(index));
        by_poses.entry((poses, has_zones(*triangle))).or_default().extend(triangle);
    }
    let mut sorted = Vec::with_capacity(indices.len());
    let mut regions = Vec::with_capacity(by_poses.len());
    for ((poses, has_zones), triangles) in by_poses {
        let begin = sorted.len() as u32;
        sorted.extend(triangles);
        regions.push(Region { poses, has_zones, indices: begin..sorted.len() as u32 });
    }
    (sorted, regions)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::asset::Texels;

    #[test]
    fn every_triangle_stands_in_one_region_with_all_poses_of_its_corners() {
        // Corners 0 to 5; pose 0 reaches corners 1 and 2, pose 1 reaches corner 2.
        let poses = [0, 1, 3, 0, 0, 0];
        let (sorted, regions) =
            split_by(&[3, 4, 5, 0, 1, 3, 1, 2, 3, 5, 4, 0], |index| poses[index as usize], |triangle| triangle.contains(&5));
        assert_eq!(sorted, [3, 4, 5, 5, 4, 0, 0, 1, 3, 1, 2, 3]);
        let expected =
            [(0, true, 0..6), (1, false, 6..9), (3, false, 9..12)].map(|(poses, has_zones, indices)| Region { poses, has_zones, indices });
        assert_eq!(regions, expected);
    }

    #[test]
    fn masks_are_found_on_and_near_a_triangle_and_across_seams() {
        let mut codes = vec![0_u8; 64 * 64 * 4];
        codes[4 * (32 * 64 + 32) + 2] = 9;
        let masks = [MipChain::uniform([64, 64], Texels::Linear4, &[0; 4]), MipChain::from_texels([64, 64], Texels::Linear4, codes)];
        let triangle = |u: f32, v: f32| [Vec2::new(u, v), Vec2::new(u + 0.02, v), Vec2::new(u, v + 0.02)];
        assert!(has_mask(&masks, triangle(0.5, 0.5)) && has_mask(&masks, triangle(0.46, 0.5)));
        assert!(!has_mask(&masks, triangle(0.3, 0.5)) && !has_mask(&masks, triangle(0.5, 0.7)));
        assert!(has_mask(&masks, [Vec2::new(0.01, 0.1), Vec2::new(0.99, 0.1), Vec2::new(0.5, 0.1)]));
    }

    #[test]
    fn a_pose_reaches_a_vertex_by_weight_only() {
        let mut vertex: Vertex = bytemuck::Zeroable::zeroed();
        vertex.joints = [0, 1, 9, 0];
        vertex.weights = [0.0, 0.4, 0.6, 0.0];
        assert_eq!(poses_of_vertex(&vertex, &[0b01, 0b10]), 0b10);
    }
}
