//! How skinning weights change along the surface. A bone that only translates turns no normal by its matrix; what turns
//! it is that neighbours follow the bone less. With `F = Σ w_i A_i + Σ (M_i v)(∇w_i)ᵀ` a normal goes to `cof(F) n`
//! (Tarini et al. 2014, "Accurate and efficient lighting for skinned models"), and the ∇w_i come from here.

use glam::Vec3;
use std::collections::HashMap;

/// Gradient of a value over a triangle, in the triangle's plane: `Σ_a w_a (n × e_a) / 2A`, where `e_a` is the edge
/// opposite corner `a`, counter-clockwise. Zero for a triangle without area.
pub fn triangle_gradient(corners: [Vec3; 3], values: [f32; 3]) -> Vec3 {
    let [a, b, c] = corners;
    // Twice the area times the unit normal, so that `cross(n, e) / 2A` is `cross(area_vector, e) / |area_vector|²`.
    let area_vector = (b - a).cross(c - a);
    let squared = area_vector.length_squared();
    if squared <= f32::MIN_POSITIVE {
        return Vec3::ZERO;
    }
    let sum = area_vector.cross(c - b) * values[0] + area_vector.cross(a - c) * values[1] + area_vector.cross(b - a) * values[2];
    sum / squared
}

/// Vertices by where they are: those on either side of a texture seam are at one place.
pub(super) struct Places {
    /// The place of each vertex.
    pub(super) of: Vec<usize>,
    /// How many places there are.
    pub(super) num: usize,
}

impl Places {
    pub(super) fn new(positions: &[Vec3]) -> Self {
        let mut known: HashMap<[u32; 3], usize> = HashMap::with_capacity(positions.len());
        let of = positions
            .iter()
            .map(|position| {
                let next = known.len();
                *known.entry(position.to_array().map(f32::to_bits)).or_insert(next)
            })
            .collect();
        Self { of, num: known.len() }
    }
}

/// A vertex's skinning with the gradients of its weights.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SkinnedWeights {
    /// Joints, the heaviest first. Free slots hold joints that reach the vertex's neighbours: weight 0, gradient not.
    pub joints: [u16; 4],
    /// Weights, sum 1.
    pub weights: [f32; 4],
    /// Gradients, 1/metre; they sum to zero, as the weights sum to one everywhere.
    pub gradients: [Vec3; 4],
}

/// Gradients of the weights at each vertex: mean over the triangles round it by area. Vertices at the same place (either
/// side of a texture seam) share their triangles, so that normals do not part there.
///
/// `positions`, `joints` and `weights` have one entry a vertex, `indices` three a triangle.
pub fn weight_gradients(positions: &[Vec3], indices: &[u32], joints: &[[u16; 4]], weights: &[[f32; 4]]) -> Vec<SkinnedWeights> {
    let Places { of: place_of, num: num_places } = Places::new(positions);

    // Per place: total area, and area-weighted gradient by joint.
    let mut area = vec![0.0_f32; num_places];
    let mut sums: Vec<Vec<(u16, Vec3)>> = vec![Vec::new(); num_places];
    for triangle in indices.as_chunks::<3>().0 {
        let corners = triangle.map(|index| index as usize);
        let points = corners.map(|corner| positions[corner]);
        let triangle_area = 0.5 * (points[1] - points[0]).cross(points[2] - points[0]).length();
        let places = corners.map(|corner| place_of[corner]);
        for place in places {
            area[place] += triangle_area;
        }
        for joint in distinct_joints(corners.map(|corner| (&joints[corner], &weights[corner]))) {
            let values = corners.map(|corner| weight_of(joint, &joints[corner], &weights[corner]));
            let gradient = triangle_gradient(points, values) * triangle_area;
            for place in places {
                match sums[place].iter_mut().find(|(known, _)| *known == joint) {
                    Some((_, sum)) => *sum += gradient,
                    None => sums[place].push((joint, gradient)),
                }
            }
        }
    }

    (0..positions.len())
        .map(|vertex| {
            let place = place_of[vertex];
            let scale = if area[place] > 0.0 { 1.0 / area[place] } else { 0.0 };
            let mut around: Vec<(u16, Vec3)> = sums[place].iter().map(|&(joint, sum)| (joint, sum * scale)).collect();
            around.sort_by(|a, b| b.1.length_squared().total_cmp(&a.1.length_squared()).then(a.0.cmp(&b.0)));
            choose_slots(&joints[vertex], &weights[vertex], &around)
        })
        .collect()
}

fn choose_slots(joints: &[u16; 4], weights: &[f32; 4], around: &[(u16, Vec3)]) -> SkinnedWeights {
    let mut own: Vec<(u16, f32)> = Vec::with_capacity(4);
    for (&joint, &weight) in joints.iter().zip(weights).filter(|&(_, &weight)| weight > 0.0) {
        match own.iter_mut().find(|(known, _)| *known == joint) {
            Some((_, sum)) => *sum += weight,
            None => own.push((joint, weight)),
        }
    }
    own.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
    let neighbours = around.iter().filter(|(joint, _)| !own.iter().any(|(known, _)| known == joint)).map(|&(joint, _)| (joint, 0.0));
    let mut slots: Vec<(u16, f32)> = own.iter().copied().chain(neighbours).take(4).collect();
    let heaviest = slots.first().copied().unwrap_or((joints[0], 1.0));
    slots.resize(4, (heaviest.0, 0.0));

    let total: f32 = slots.iter().map(|slot| slot.1).sum();
    let scale = if total > 0.0 { 1.0 / total } else { 0.0 };
    let mut gradients = [Vec3::ZERO; 4];
    for (slot, &(joint, _)) in slots.iter().enumerate().skip(1) {
        // A padded slot repeats the heaviest joint, whose gradient is slot 0's.
        if joint != heaviest.0 {
            gradients[slot] = around.iter().find(|(known, _)| *known == joint).map_or(Vec3::ZERO, |&(_, gradient)| gradient);
        }
    }
    gradients[0] = -(gradients[1] + gradients[2] + gradients[3]);
    SkinnedWeights {
        joints: [slots[0].0, slots[1].0, slots[2].0, slots[3].0],
        weights: [slots[0].1 * scale, slots[1].1 * scale, slots[2].1 * scale, slots[3].1 * scale],
        gradients,
    }
}

fn distinct_joints(corners: [(&[u16; 4], &[f32; 4]); 3]) -> Vec<u16> {
    let mut distinct = Vec::with_capacity(8);
    for (joints, weights) in corners {
        for (&joint, &weight) in joints.iter().zip(weights) {
            if weight > 0.0 && !distinct.contains(&joint) {
                distinct.push(joint);
            }
        }
    }
    distinct
}

fn weight_of(joint: u16, joints: &[u16; 4], weights: &[f32; 4]) -> f32 {
    joints.iter().zip(weights).filter(|&(&of, _)| of == joint).map(|(_, &weight)| weight).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    const UNIT: [Vec3; 3] = [Vec3::ZERO, Vec3::X, Vec3::Y];

    /// Vector V3.6 of the design documents.
    #[test]
    fn gradient_of_corner_weights_on_the_unit_triangle() {
        assert_eq!(triangle_gradient(UNIT, [0.0, 1.0, 0.0]), Vec3::new(1.0, 0.0, 0.0));
        assert_eq!(triangle_gradient(UNIT, [1.0, 0.0, 0.0]), Vec3::new(-1.0, -1.0, 0.0));
    }

    #[test]
    fn triangle_without_area_has_no_gradient() {
        assert_eq!(triangle_gradient([Vec3::ZERO, Vec3::X, Vec3::X * 2.0], [0.0, 1.0, 0.0]), Vec3::ZERO);
    }

    #[test]
    fn linear_weights_give_their_slope_at_every_vertex_and_sum_to_zero() {
        let positions: Vec<Vec3> = (0..9).map(|i| Vec3::new((i % 3) as f32, (i / 3) as f32, 0.0)).collect();
        let weights: Vec<[f32; 4]> = positions.iter().map(|p| [1.0 - p.x / 4.0, p.x / 4.0, 0.0, 0.0]).collect();
        let joints = vec![[7, 3, 0, 0]; 9];
        let mut indices = Vec::new();
        for (x, y) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
            let corner = y * 3 + x;
            indices.extend([corner, corner + 1, corner + 4, corner, corner + 4, corner + 3]);
        }
        for skinned in weight_gradients(&positions, &indices, &joints, &weights) {
            let slot = skinned.joints.iter().position(|&joint| joint == 3).expect("joint 3 reaches every vertex or a neighbour");
            assert!(skinned.gradients[slot].distance(Vec3::X * 0.25) < 1e-6, "{skinned:?}");
            assert!(skinned.gradients.iter().sum::<Vec3>().length() < 1e-6);
            assert!((skinned.weights.iter().sum::<f32>() - 1.0).abs() < 1e-6);
        }
    }

    #[test]
    fn seam_duplicates_get_the_same_gradients() {
        // Two triangles that share an edge in space but no vertex.
        let positions = [Vec3::ZERO, Vec3::X, Vec3::Y, Vec3::X, Vec3::new(1.0, 1.0, 0.0), Vec3::Y];
        let weights = [
            [1.0, 0.0, 0.0, 0.0],
            [0.5, 0.5, 0.0, 0.0],
            [1.0, 0.0, 0.0, 0.0],
            [0.5, 0.5, 0.0, 0.0],
            [0.2, 0.8, 0.0, 0.0],
            [1.0, 0.0, 0.0, 0.0],
        ];
        let skinned = weight_gradients(&positions, &[0, 1, 2, 3, 4, 5], &[[0, 1, 0, 0]; 6], &weights);
        assert_eq!(skinned[1], skinned[3]);
        assert_eq!(skinned[2], skinned[5]);
        assert_ne!(skinned[0].gradients, skinned[1].gradients);
    }
}
