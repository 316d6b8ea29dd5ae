//! Twin of the expression shapes.

use crate::asset::{Morphs, Vertex};
use glam::Vec3;
use rhytid_shared::NUM_ARKIT_SHAPES;

/// A vertex after the shapes, model space.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Morphed {
    /// Position.
    pub position: Vec3,
    /// What the unit tangent has become: neither unit nor orthogonal to the other.
    pub tangent: Vec3,
    /// What `cross(normal, tangent)` has become.
    pub bitangent: Vec3,
}

impl Morphed {
    /// No shape shows.
    pub fn neutral(vertex: &Vertex) -> Self {
        let [x, y, z, _] = vertex.tangent;
        let tangent = Vec3::new(x, y, z);
        Self { position: Vec3::from(vertex.position), tangent, bitangent: Vec3::from(vertex.normal).cross(tangent) }
    }
}

/// Twin of `morph` in `skinning.wgsl`: `v + Σ w_s d_s`, `t + Σ w_s ∂d_s/∂t` and `b` alike.
pub fn morph(vertex: &Vertex, morphs: &Morphs, weights: &[f32; NUM_ARKIT_SHAPES]) -> Morphed {
    morphs.of_vertex(vertex.morphs).fold(Morphed::neutral(vertex), |sum, entry| {
        let weight = weights[entry.shape];
        Morphed {
            position: sum.position + entry.displacement * weight,
            tangent: sum.tangent + entry.gradients[0] * weight,
            bitangent: sum.bitangent + entry.gradients[1] * weight,
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::asset::{CharacterAsset, PrimitiveAsset, Surface};
    use crate::renderer::RenderFrame;
    use crate::twin::deform_morphed;
    use crate::twin::tests::area_normals;
    use glam::{Affine3A, Quat};
    use rhytid_shared::{ARKIT_NAMES, DEFAULT_CHARACTER_GLB};

    fn default_character() -> CharacterAsset {
        CharacterAsset::from_glb(DEFAULT_CHARACTER_GLB).expect("the built-in character is whole")
    }

    fn skin(asset: &CharacterAsset) -> impl Iterator<Item = &PrimitiveAsset> {
        asset.primitives.iter().filter(|primitive| primitive.surface == Surface::Skin)
    }

    /// Degrees, means over the vertices that move, against the triangles of the deformed mesh.
    #[derive(Debug, Default, Clone, Copy)]
    struct Errors {
        num: usize,
        with: f32,
        without: f32,
        /// Differences of unit normals, computed for each shape at weight 1, weighted, added and renormalised.
        by_differences: f32,
        /// Of the tangents.
        tangents: f32,
    }

    /// `palette` moves what the shapes give.
    fn errors(asset: &CharacterAsset, weights: &[f32; NUM_ARKIT_SHAPES], palette: &[Affine3A]) -> Errors {
        let mut sum = Errors::default();
        for primitive in skin(asset) {
            let vertices = &primitive.vertices;
            let rest: Vec<Vec3> = vertices.iter().map(|vertex| Vec3::from(vertex.position)).collect();
            let deformed: Vec<_> =
                vertices.iter().map(|vertex| deform_morphed(vertex, &morph(vertex, &asset.morphs, weights), palette)).collect();
            let positions: Vec<Vec3> = deformed.iter().map(|vertex| vertex.position).collect();
            let (before, after) =
                (area_normals(vertices, &rest, &primitive.indices), area_normals(vertices, &positions, &primitive.indices));
            let tangents = area_tangents(primitive, &positions);
            for (v, vertex) in vertices.iter().enumerate() {
                if positions[v].distance(rest[v]) < 1e-4 || before[v] == Vec3::ZERO || after[v] == Vec3::ZERO {
                    continue;
                }
                // The file's normals need not be those of its triangles: they turn as the triangles' do.
                let expected = Quat::from_rotation_arc(before[v], after[v]) * Vec3::from(vertex.normal);
                let unturned = deform_morphed(vertex, &Morphed { position: positions[v], ..Morphed::neutral(vertex) }, palette).normal;
                let neutral = Vec3::from(vertex.normal);
                let differences: Vec3 = asset
                    .morphs
                    .of_vertex(vertex.morphs)
                    .map(|entry| {
                        let mut alone = [0.0; NUM_ARKIT_SHAPES];
                        alone[entry.shape] = 1.0;
                        let morphed = morph(vertex, &asset.morphs, &alone);
                        (morphed.tangent.cross(morphed.bitangent).normalize() - neutral) * weights[entry.shape]
                    })
                    .sum();
                sum.num += 1;
                sum.with += expected.angle_between(deformed[v].normal).to_degrees();
                sum.without += expected.angle_between(unturned).to_degrees();
                sum.by_differences += expected.angle_between((neutral + differences).normalize()).to_degrees();
                let along = (tangents[v] - expected * tangents[v].dot(expected)).normalize_or(deformed[v].tangent);
                sum.tangents += along.angle_between(deformed[v].tangent).to_degrees();
            }
        }
        let mean = |value: f32| value / sum.num.max(1) as f32;
        let Errors { num, with, without, by_differences, tangents } = sum;
        Errors { num, with: mean(with), without: mean(without), by_differences: mean(by_differences), tangents: mean(tangents) }
    }

    /// Where the file's tangents go when each triangle carries its own piece of the plane: area-weighted over the triangles
    /// round a vertex.
    fn area_tangents(primitive: &PrimitiveAsset, positions: &[Vec3]) -> Vec<Vec3> {
        let mut sums = vec![Vec3::ZERO; positions.len()];
        for triangle in primitive.indices.as_chunks::<3>().0 {
            let [a, b, c] = triangle.map(|index| index as usize);
            let at_rest = |v: usize| Vec3::from(primitive.vertices[v].position);
            let (e1, e2) = (at_rest(b) - at_rest(a), at_rest(c) - at_rest(a));
            let (f1, f2) = (positions[b] - positions[a], positions[c] - positions[a]);
            let normal = e1.cross(e2);
            let squared = normal.length_squared();
            if squared <= f32::MIN_POSITIVE {
                continue;
            }
            for corner in [a, b, c] {
                let [x, y, z, _] = primitive.vertices[corner].tangent;
                let tangent = Vec3::new(x, y, z);
                // Barycentric rates of e1 and e2 along the tangent.
                let (r1, r2) = (tangent.cross(e2).dot(normal) / squared, e1.cross(tangent).dot(normal) / squared);
                sums[corner] += (f1 * r1 + f2 * r2) * squared.sqrt();
            }
        }
        sums.into_iter().map(Vec3::normalize_or_zero).collect()
    }

    /// Every shape alone at weight 1, against the deformed mesh itself: in the mean over shapes normals are off by 0.26° and
    /// tangents by 0.42°, normals left as they were by 5.9°.
    #[test]
    fn shapes_turn_the_default_characters_normals_as_its_triangles_turn() {
        let asset = default_character();
        let still = vec![Affine3A::IDENTITY; asset.palette.motions.len()];
        let (mut with, mut without, mut tangents, mut num_shapes) = (0.0, 0.0, 0.0, 0);
        for shape in 0..NUM_ARKIT_SHAPES {
            let mut weights = [0.0; NUM_ARKIT_SHAPES];
            weights[shape] = 1.0;
            let errors = errors(&asset, &weights, &still);
            if errors.num < 100 {
                continue;
            }
            let what = format!("{}: {errors:?}", ARKIT_NAMES[shape]);
            assert!(errors.with < 0.4 * errors.without.max(2.0), "{what}");
            num_shapes += 1;
            (with, without) = (with + errors.with, without + errors.without);
            tangents += errors.tangents;
        }
        let mean = |sum: f32| sum / num_shapes as f32;
        let (with, without, tangents) = (mean(with), mean(without), mean(tangents));
        assert!(num_shapes >= 45, "{num_shapes} shapes move the skin");
        assert!(with < 0.1 * without && tangents < 0.1 * without, "normals {with}°, tangents {tangents}°, unturned {without}°");
    }

    /// All 52 at 0.4: off by 0.4°, sums of differences by 3.8°, normals left as they were by 8.7°.
    #[test]
    fn gradients_hold_for_many_shapes_at_once_where_differences_of_normals_do_not() {
        let asset = default_character();
        let still = vec![Affine3A::IDENTITY; asset.palette.motions.len()];
        let all = errors(&asset, &[0.4; NUM_ARKIT_SHAPES], &still);
        assert!(all.num > 5000 && all.with < 0.25 * all.without && all.with < 0.6 * all.by_differences, "{all:?}");
    }

    #[test]
    fn shapes_and_bones_turn_normals_together() {
        let asset = default_character();
        let pose = &asset.character.poses[0];
        let frame = RenderFrame { points: pose.points.clone(), ..RenderFrame::at_rest(&asset.character) };
        let palette = asset.palette.model_from_rest(&asset.character, &frame);
        let mut weights = [0.0; NUM_ARKIT_SHAPES];
        for name in ["mouthSmileLeft", "jawOpen", "browDownRight"] {
            weights[rhytid_shared::ArkitShape::from_name(name).expect("an ARKit shape").index()] = 0.7;
        }
        let both = errors(&asset, &weights, &palette);
        assert!(both.num > 2000 && both.with < 0.25 * both.without, "{both:?}");
    }

    #[test]
    fn no_weights_leave_the_neutral_bit_by_bit() {
        let asset = default_character();
        for vertex in asset.primitives.iter().flat_map(|primitive| &primitive.vertices) {
            assert_eq!(morph(vertex, &asset.morphs, &[0.0; NUM_ARKIT_SHAPES]), Morphed::neutral(vertex));
        }
    }
}
