//! CPU twins of what the GPU computes: shapes, skinning with turning normals, vertex influences, slopes of maps, each wrinkle
//! blend, the tone curve. The tests hold these to published and derived numbers, and the GPU to these.

pub mod blood;
pub mod hues;
mod morph;
pub mod skin;
pub mod zones;

pub use morph::{Morphed, morph};

use crate::asset::Vertex;
use crate::renderer::{BlendMode, moves_bone};
use glam::{Affine3A, Vec2, Vec3, Vec4};
use rhytid_shared::Character;

/// A vertex after skinning, in the space the palette's matrices lead to.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Deformed {
    /// Position.
    pub position: Vec3,
    /// Unit normal.
    pub normal: Vec3,
    /// Unit tangent, orthogonal to the normal.
    pub tangent: Vec3,
}

/// Twin of `deform` in `skinning.wgsl`. Linear-blend skinning; with `F = Σ w_i A_i + Σ (M_i v)(∇w_i)ᵀ` the normal is
/// `cof(F) n = F t × F b` for an orthonormal `t`, `b`, `n = t × b`.
pub fn deform(vertex: &Vertex, palette: &[Affine3A]) -> Deformed {
    deform_morphed(vertex, &Morphed::neutral(vertex), palette)
}

/// As [`deform`], after the shapes: by the chain rule `F` takes the morphed position, tangent and bitangent, and the
/// weights' gradients as they are.
pub fn deform_morphed(vertex: &Vertex, morphed: &Morphed, palette: &[Affine3A]) -> Deformed {
    let matrices = vertex.joints.map(|joint| palette[usize::from(joint)]);
    let moved = matrices.map(|matrix| matrix.transform_point3(morphed.position));
    let weighted = |values: [Vec3; 4]| (0..4).map(|slot| values[slot] * vertex.weights[slot]).sum::<Vec3>();
    let along = |direction: Vec3, component: usize| {
        let rigid = weighted(matrices.map(|matrix| matrix.transform_vector3(direction)));
        rigid + (1..4).map(|slot| (moved[slot] - moved[0]) * vertex.gradients[slot - 1][component]).sum::<Vec3>()
    };
    let f_tangent = along(morphed.tangent, 0);
    let normal = f_tangent.cross(along(morphed.bitangent, 1)).normalize_or_zero();
    Deformed { position: weighted(moved), normal, tangent: (f_tangent - normal * f_tangent.dot(normal)).normalize_or_zero() }
}

/// Twin of `influences` in `skinning.wgsl`: for each of the `o` poses `Σ w_i I_ik`, divided by `max(W, falloff)` where
/// `W` is the weight of the bones that the pose moves. `coefficients` are pose-major, `o * n`.
pub fn influences(vertex: &Vertex, character: &Character, coefficients: &[f32]) -> Vec<f32> {
    let num_bones = character.num_bones();
    let bones = || vertex.joints.iter().zip(vertex.weights).filter(|&(&joint, _)| usize::from(joint) < num_bones);
    (0..character.num_poses())
        .map(|k| {
            let sum: f32 = bones().map(|(&joint, weight)| weight * coefficients[k * num_bones + usize::from(joint)]).sum();
            let moved: f32 = bones().filter(|&(&joint, _)| moves_bone(character, k, usize::from(joint))).map(|(_, weight)| weight).sum();
            if character.falloff < 1.0 { sum / moved.max(character.falloff) } else { sum }
        })
        .collect()
}

/// Twin of `slope_of` in `wrinkles.wgsl`: code 128 is exactly flat, 1 and 255 are `∓scale`.
pub fn slope_of(codes: [u8; 2], scale: f32) -> Vec2 {
    Vec2::from(codes.map(|code| ((f32::from(code) - 128.0) / 127.0).max(-1.0))) * scale
}

/// A pose's wrinkle map at one place.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WrinkleSample {
    /// Partial derivatives `n.xy / n.z`.
    pub slope: Vec2,
    /// Whether `slope` has the neutral map's in it.
    pub contains_neutral: bool,
    /// Influence of the pose here.
    pub influence: f32,
}

/// Twin of the blend in `wrinkles.wgsl`: the unit tangent-space normal of a base slope and the wrinkles over it.
pub fn blend(mode: BlendMode, base: Vec2, wrinkles: &[WrinkleSample]) -> Vec3 {
    let delta = |wrinkle: &WrinkleSample| if wrinkle.contains_neutral { wrinkle.slope - base } else { wrinkle.slope };
    let rest = (1.0 - wrinkles.iter().map(|wrinkle| wrinkle.influence).sum::<f32>()).max(0.0);
    let mean = |of_rest: Vec3, normal: &dyn Fn(&WrinkleSample) -> Vec3| {
        (of_rest * rest + wrinkles.iter().map(|wrinkle| normal(wrinkle) * wrinkle.influence).sum::<Vec3>()).normalize()
    };
    match mode {
        BlendMode::PartialDerivatives => normal_of(base + wrinkles.iter().map(|wrinkle| delta(wrinkle) * wrinkle.influence).sum::<Vec2>()),
        BlendMode::Simple => mean(normal_of(base), &|wrinkle| normal_of(base + delta(wrinkle))),
        BlendMode::Printed => whiteout(normal_of(base), mean(Vec3::Z, &|wrinkle| normal_of(delta(wrinkle)))),
    }
}

/// Unit normal of a slope.
fn normal_of(slope: Vec2) -> Vec3 {
    slope.extend(1.0).normalize()
}

/// "Whiteout" (Oat 2007), the formula that Dutreve et al. 2009, 5.3, print.
fn whiteout(base: Vec3, detail: Vec3) -> Vec3 {
    Vec3::new(base.x + detail.x, base.y + detail.y, base.z * detail.z).normalize()
}

/// Twin of `world_from_tangent` in `surface.wgsl`: unit; `tangent.w` is the bitangent's sign.
pub fn world_from_tangent(normal: Vec3, tangent: Vec4, of_map: Vec3) -> Vec3 {
    let bitangent = tangent.w * normal.cross(tangent.truncate());
    (tangent.truncate() * of_map.x + bitangent * of_map.y + normal * of_map.z).normalize()
}

/// Twin of the tone curve in `tone.wgsl` (Hable 2010): linear light to linear display values.
pub fn filmic(light: f32, exposure: f32) -> f32 {
    let curve = |x: f32| (x * (0.15 * x + 0.05) + 0.004) / (x * (0.15 * x + 0.50) + 0.06) - 0.02 / 0.30;
    (curve(2.0 * exposure * light) / curve(11.2)).clamp(0.0, 1.0)
}

#[cfg(test)]
#[allow(clippy::excessive_precision, reason = "numbers stand as they were worked out")]
mod tests {
    use super::*;
    use crate::asset::{CharacterAsset, Surface};
    use crate::renderer::RenderFrame;
    use glam::{Mat3, Quat};
    use std::collections::HashMap;

    /// A vertex with the frame t = X, b = Y, n = Z unless `normal` says otherwise.
    fn vertex(position: Vec3, normal: Vec3, weights: [f32; 4], gradients: [Vec3; 3]) -> Vertex {
        let tangent = normal.any_orthonormal_vector();
        let bitangent = normal.cross(tangent);
        Vertex {
            position: position.to_array(),
            normal: normal.to_array(),
            tangent: tangent.extend(1.0).to_array(),
            uv: [0.0; 2],
            joints: [0, 1, 2, 3],
            weights,
            gradients: gradients.map(|gradient| [gradient.dot(tangent), gradient.dot(bitangent)]),
            morphs: [0; 2],
        }
    }

    fn palette(given: &[Affine3A]) -> Vec<Affine3A> {
        let mut all = given.to_vec();
        all.resize(4, Affine3A::IDENTITY);
        all
    }

    fn translation(x: f32, y: f32, z: f32) -> Affine3A {
        Affine3A::from_translation(Vec3::new(x, y, z))
    }

    #[track_caller]
    fn assert_near(got: Vec3, expected: [f32; 3]) {
        assert!(got.distance(Vec3::from(expected)) < 1e-5, "got {got}, expected {expected:?}");
    }

    /// V3.1, V3.2, V3.3: positions of linear-blend skinning.
    #[test]
    fn positions_blend_linearly() {
        let half = vertex(Vec3::Y, Vec3::Z, [0.5, 0.5, 0.0, 0.0], [Vec3::ZERO; 3]);
        for (degrees, expected) in [(90.0_f32, [0.0, 0.5, 0.5]), (170.0, [0.0, 0.007_596_12, 0.086_824_09]), (180.0, [0.0, 0.0, 0.0])] {
            let turned = palette(&[Affine3A::IDENTITY, Affine3A::from_rotation_x(degrees.to_radians())]);
            assert_near(deform(&half, &turned).position, expected);
        }
        let v = vertex(Vec3::ONE, Vec3::Z, [0.25, 0.75, 0.0, 0.0], [Vec3::ZERO; 3]);
        assert_near(deform(&v, &palette(&[Affine3A::IDENTITY, translation(0.0, 2.0, 4.0)])).position, [1.0, 2.5, 4.0]);
        let v = vertex(Vec3::X, Vec3::Z, [0.3, 0.7, 0.0, 0.0], [Vec3::ZERO; 3]);
        let turned = Affine3A::from_rotation_translation(Quat::from_rotation_z(60_f32.to_radians()), Vec3::new(1.0, 2.0, 3.0));
        assert_near(deform(&v, &palette(&[Affine3A::IDENTITY, turned])).position, [1.35, 2.006_217_78, 2.1]);
    }

    /// V3.4: two bones that only translate turn the normal by 26.6°.
    #[test]
    fn translating_bones_turn_normals() {
        let bones = palette(&[Affine3A::IDENTITY, translation(0.0, 0.0, 0.5)]);
        let v = vertex(Vec3::ZERO, Vec3::Z, [0.5, 0.5, 0.0, 0.0], [Vec3::X, Vec3::ZERO, Vec3::ZERO]);
        let deformed = deform(&v, &bones);
        assert_near(deformed.normal, [-0.447_213_6, 0.0, 0.894_427_2]);
        assert!(deformed.normal.dot(deformed.tangent).abs() < 1e-6);
        let without_gradients = vertex(Vec3::ZERO, Vec3::Z, [0.5, 0.5, 0.0, 0.0], [Vec3::ZERO; 3]);
        assert_near(deform(&without_gradients, &bones).normal, [0.0, 0.0, 1.0]);
    }

    /// V3.5: non-uniform scale takes the cofactor; a mirror keeps its sign.
    #[test]
    fn scaled_normals_take_the_cofactor() {
        let scaled = palette(&[Affine3A::from_scale(Vec3::new(2.0, 1.0, 1.0))]);
        let v = vertex(Vec3::ZERO, Vec3::new(1.0, 1.0, 0.0).normalize(), [1.0, 0.0, 0.0, 0.0], [Vec3::ZERO; 3]);
        assert_near(deform(&v, &scaled).normal, [0.447_213_6, 0.894_427_2, 0.0]);
        let mirrored = palette(&[Affine3A::from_scale(Vec3::new(-1.0, 1.0, 1.0))]);
        for (normal, expected) in [(Vec3::X, [1.0, 0.0, 0.0]), (Vec3::Y, [0.0, -1.0, 0.0]), (Vec3::Z, [0.0, 0.0, -1.0])] {
            assert_near(deform(&vertex(Vec3::ZERO, normal, [1.0, 0.0, 0.0, 0.0], [Vec3::ZERO; 3]), &mirrored).normal, expected);
        }
    }

    /// V3.7: rotation, translations and gradients together.
    #[test]
    fn full_deformation_gradient() {
        let turned = Affine3A::from_mat3_translation(Mat3::from_rotation_x(30_f32.to_radians()), Vec3::new(0.0, 0.01, 0.02));
        let bones = palette(&[Affine3A::IDENTITY, turned, translation(0.0, 0.0, 0.005)]);
        let position = Vec3::new(0.1, 0.2, 0.3);
        let gradients = [Vec3::new(-2.5, 2.5, 0.0), Vec3::new(-2.5, -2.5, 0.0), Vec3::ZERO];
        let v = vertex(position, Vec3::Z, [0.5, 0.3, 0.2, 0.0], gradients);
        assert_near(deform(&v, &bones).normal, [0.371_450_304_3, -0.489_732_343_5, 0.788_788_249_9]);
        let constant = vertex(position, Vec3::Z, [0.5, 0.3, 0.2, 0.0], [Vec3::ZERO; 3]);
        assert_near(deform(&constant, &bones).normal, [0.0, -0.154_407_085_1, 0.988_007_313_8]);
    }

    #[test]
    fn rigid_motion_of_all_bones_turns_normals_with_it() {
        let motion = Affine3A::from_rotation_translation(Quat::from_rotation_y(0.7), Vec3::new(0.3, -0.1, 0.2));
        let v = vertex(
            Vec3::new(0.02, 0.05, 0.1),
            Vec3::new(0.2, 0.4, 0.9).normalize(),
            [0.4, 0.3, 0.2, 0.1],
            [Vec3::X * 40.0, Vec3::Y * -30.0, Vec3::Z * 9.0],
        );
        let deformed = deform(&v, &[motion; 4]);
        assert_near(deformed.normal, motion.transform_vector3(Vec3::from(v.normal)).to_array());
    }

    /// Sum of the area vectors of the triangles round each vertex; vertices at the same place at rest share theirs.
    pub(in crate::twin) fn area_normals(rest: &[Vertex], positions: &[Vec3], indices: &[u32]) -> Vec<Vec3> {
        let place = |vertex: u32| rest[vertex as usize].position.map(f32::to_bits);
        let mut sums: HashMap<[u32; 3], Vec3> = HashMap::new();
        for triangle in indices.as_chunks::<3>().0 {
            let [a, b, c] = triangle.map(|vertex| positions[vertex as usize]);
            for vertex in triangle {
                *sums.entry(place(*vertex)).or_default() += (b - a).cross(c - a);
            }
        }
        (0..rest.len() as u32).map(|vertex| sums.get(&place(vertex)).copied().unwrap_or_default().normalize_or_zero()).collect()
    }

    /// The gradients feed the device and the twin alike; here they are held to the deformed mesh itself. Without them the
    /// normals of skin that moved are off by 4° to 7° in the mean, with them by 0.3° to 1.1°.
    #[test]
    fn gradients_turn_the_default_characters_normals_as_its_triangles_turn() {
        let asset = CharacterAsset::from_glb(rhytid_shared::DEFAULT_CHARACTER_GLB).expect("the built-in character is whole");
        let character = &*asset.character;
        for pose in &character.poses {
            let frame = RenderFrame { points: pose.points.clone(), ..RenderFrame::at_rest(character) };
            let palette = asset.palette.model_from_rest(character, &frame);
            let (mut num_moved, mut error, mut error_without) = (0, 0.0, 0.0);
            for primitive in asset.primitives.iter().filter(|primitive| primitive.surface == Surface::Skin) {
                let rest: Vec<Vec3> = primitive.vertices.iter().map(|vertex| Vec3::from(vertex.position)).collect();
                let deformed: Vec<Deformed> = primitive.vertices.iter().map(|vertex| deform(vertex, &palette)).collect();
                let positions: Vec<Vec3> = deformed.iter().map(|vertex| vertex.position).collect();
                let before = area_normals(&primitive.vertices, &rest, &primitive.indices);
                let after = area_normals(&primitive.vertices, &positions, &primitive.indices);
                for (v, vertex) in primitive.vertices.iter().enumerate() {
                    if positions[v].distance(rest[v]) < 1e-4 || before[v] == Vec3::ZERO || after[v] == Vec3::ZERO {
                        continue;
                    }
                    // The file's normals need not be those of its triangles: they turn as the triangles' do.
                    let expected = Quat::from_rotation_arc(before[v], after[v]) * Vec3::from(vertex.normal);
                    let without = deform(&Vertex { gradients: [[0.0; 2]; 3], ..*vertex }, &palette).normal;
                    num_moved += 1;
                    error += expected.angle_between(deformed[v].normal).to_degrees();
                    error_without += expected.angle_between(without).to_degrees();
                }
            }
            let [with, without] = [error, error_without].map(|sum| sum / num_moved as f32);
            let what = format!("{}: {num_moved} vertices moved, mean error {with}° with gradients, {without}° without", pose.name);
            assert!(num_moved > 500 && without > 1.0, "shows nothing: {what}");
            assert!(with < 0.25 * without, "{what}");
        }
    }

    /// As unit normals give it.
    fn slope(x: f32, y: f32, z: f32) -> Vec2 {
        Vec2::new(x / z, y / z)
    }

    fn wrinkle(slope: Vec2, contains_neutral: bool, influence: f32) -> WrinkleSample {
        WrinkleSample { slope, contains_neutral, influence }
    }

    const NZ: f32 = 0.948_683_3;
    const WZ: f32 = 0.894_427_2;

    /// V4.1, V4.2: one wrinkle at full influence over a base, and over none.
    #[test]
    fn one_whole_wrinkle_over_a_base() {
        let (n, w) = (slope(0.3, 0.1, NZ), slope(-0.2, 0.4, WZ));
        assert_near(blend(BlendMode::PartialDerivatives, n, &[wrinkle(w, false, 1.0)]), [0.080_801, 0.482_098_7, 0.872_382_9]);
        assert_near(blend(BlendMode::Printed, n, &[wrinkle(w, false, 1.0)]), [0.101_015_3, 0.505_076_3, 0.857_142_9]);
        for mode in BlendMode::ALL {
            assert_near(blend(mode, Vec2::ZERO, &[wrinkle(w, false, 1.0)]), [-0.2, 0.4, WZ]);
        }
    }

    /// V4.3: maps that contain the pores.
    #[test]
    fn simple_blend_is_a_weighted_mean_with_the_rest_normal() {
        let n = slope(0.3, 0.1, NZ);
        let (w1, w2) = (slope(-0.2, 0.4, WZ), slope(0.1, -0.3, NZ));
        let at = |a, b| blend(BlendMode::Simple, n, &[wrinkle(w1, true, a), wrinkle(w2, true, b)]);
        assert_near(at(0.5, 0.25), [0.0, 0.160_654_1, 0.987_010_8]);
        assert_near(at(1.0, 0.5), [-0.107_183_1, 0.178_638_5, 0.978_059_3]);
    }

    /// V4.4: the printed formula keeps the base where no wrinkle shows, because the rest term is there.
    #[test]
    fn printed_blend_fades_to_the_base() {
        let (n, w) = (slope(0.3, 0.1, NZ), slope(-0.2, 0.4, WZ));
        assert_near(blend(BlendMode::Printed, n, &[wrinkle(w, false, 0.0)]), [0.3, 0.1, NZ]);
        assert_near(blend(BlendMode::Printed, n, &[wrinkle(w, false, 0.25)]), [0.250_095_6, 0.202_945_7, 0.946_712_9]);
    }

    /// V4.5: flat is exactly flat; the last code is 45° at scale 1.
    #[test]
    fn codes_have_an_exact_zero() {
        assert_eq!(slope_of([128, 128], 0.6), Vec2::ZERO);
        assert_eq!(slope_of([255, 1], 1.0), Vec2::new(1.0, -1.0));
        assert_eq!(slope_of([0, 0], 1.0), Vec2::splat(-1.0));
        assert!((slope_of([201, 128], 1.0).x - 73.0 / 127.0).abs() < 1e-7);
    }

    /// V4.7: a map that contains the pores, as a difference of partial derivatives.
    #[test]
    fn partial_derivatives_meet_both_ends() {
        let (n, w) = (slope(0.1, 0.05, 0.993_730_35), slope(-0.05, 0.35, 0.935_414_35));
        let at = |influence| blend(BlendMode::PartialDerivatives, n, &[wrinkle(w, true, influence)]);
        assert_near(at(0.0), [0.1, 0.05, 0.993_730_35]);
        assert_near(at(0.5), [0.023_069_19, 0.207_560_71, 0.977_950_08]);
        assert_near(at(1.0), [-0.05, 0.35, 0.935_414_35]);
    }

    /// V9: two poses after grouping and quantising, through all blends.
    #[test]
    fn end_to_end_blends() {
        let z = |x: f32, y: f32| (1.0 - x * x - y * y).sqrt();
        let n = slope(0.1, 0.05, z(0.1, 0.05));
        let both = [wrinkle(slope(0.0, 0.3, z(0.0, 0.3)), false, 0.56), wrinkle(slope(-0.2, 0.0, z(-0.2, 0.0)), false, 0.144_705_882_4)];
        assert_near(blend(BlendMode::Printed, Vec2::ZERO, &both), [-0.029_348_258_8, 0.170_363_063_4, 0.984_944_214_8]);
        assert_near(blend(BlendMode::Printed, n, &both), [0.070_247_566_9, 0.219_102_445_2, 0.973_169_768_2]);
        assert_near(blend(BlendMode::PartialDerivatives, n, &both), [0.069_171_643_9, 0.220_308_033_9, 0.972_974_641_9]);
    }

    /// V6.5: Hable's curve with the exposure bias inside.
    #[test]
    fn filmic_curve() {
        for (light, expected) in
            [(0.0, 0.0), (0.18, 0.128_338_45), (0.5, 0.304_300_56), (1.0, 0.492_918_55), (2.0, 0.713_238_01), (5.6, 1.0)]
        {
            assert!((filmic(light, 1.0) - expected).abs() < 1e-5, "{light}");
        }
    }

    /// Three bones of the default character, one pose that moves the first two.
    fn three_bones(falloff: f32) -> Character {
        let mut character = Character::from_glb(rhytid_shared::DEFAULT_CHARACTER_GLB).expect("the built-in character is whole");
        character.bones.truncate(3);
        character.poses.truncate(1);
        let rest: Vec<Vec3> = character.bones.iter().map(|bone| bone.rest).collect();
        character.poses[0].points = vec![rest[0] + Vec3::Y * 0.01, rest[1] + Vec3::Y * 0.01, rest[2]];
        character.falloff = falloff;
        character
    }

    /// V1.6 (first pose) and V1.8: weighted sums, and the plateau that the fall-off remedy widens.
    #[test]
    fn influences_are_weighted_sums_over_what_the_pose_moves() {
        let half = vertex(Vec3::ZERO, Vec3::Z, [0.5, 0.5, 0.0, 0.0], [Vec3::ZERO; 3]);
        assert!((influences(&half, &three_bones(1.0), &[0.9, 0.0, 0.0])[0] - 0.45).abs() < 1e-6);
        let edge = vertex(Vec3::ZERO, Vec3::Z, [0.25, 0.15, 0.6, 0.0], [Vec3::ZERO; 3]);
        for (falloff, expected) in [(1.0, 0.32), (0.5, 0.64), (0.25, 0.8)] {
            let got = influences(&edge, &three_bones(falloff), &[0.8, 0.8, 0.0])[0];
            assert!((got - expected).abs() < 1e-6, "falloff {falloff}: {got}");
        }
    }

    #[test]
    fn joints_that_are_no_bones_have_no_influence() {
        let mut v = vertex(Vec3::ZERO, Vec3::Z, [0.5, 0.5, 0.0, 0.0], [Vec3::ZERO; 3]);
        v.joints = [0, 3, 3, 3];
        assert!((influences(&v, &three_bones(1.0), &[1.0; 3])[0] - 0.5).abs() < 1e-6);
    }
}
