//! The skin of the bust from the base mesh to the drawable part.

use super::autorig;
use super::base::{Base, mean};
use super::brows;
use super::bust::{Bust, Eyeball, PoseField, Region};
use super::cut::cut_bust;
use super::landmarks::{BROW, IBUG_VERTICES};
use super::mesh::{Face, Mesh};
use super::part::{Binding, Material, Part, sparse};
use super::poses::POSES;
use super::regions::{self, Masks};
use super::rig::{Places, Rig};
use super::source::Source;
use super::subdivide::{counteract_shrinking, subdivide};
use super::surface::Surface;
use super::uv;
use super::weights::{self, Weights, shape};
use super::{lids, lips};
use anyhow::{Context, Result};
use glam::{Vec2, Vec3, Vec4};
use rhytid_shared::ARKIT_NAMES;
use rhytid_shared::layout::NUM_IBUG;
use std::collections::BTreeMap;

/// Skin with everything known about it.
pub struct Skin {
    /// Welded, subdivided, UVs packed.
    pub mesh: Mesh,
    /// Region of each vertex.
    pub regions: Vec<Region>,
    /// Landmarks on the neutral.
    pub ibug68: [Vec3; NUM_IBUG],
    /// Vertices where the lips' inner edges meet, right and left.
    pub lip_corners: [u32; 2],
    /// Left and right eye.
    pub eyes: [Eyeball; 2],
    /// Bones.
    pub rig: Rig,
    /// Skinning weights.
    pub weights: Weights,
}

impl Skin {
    /// Cuts, subdivides, packs, rigs.
    pub fn build(base: &Base, source: &mut Source, eyes: [Eyeball; 2]) -> Result<Self> {
        let mut body = Mesh {
            positions: base.positions.clone(),
            morphs: (0..ARKIT_NAMES.len()).map(|shape| base.dense_morph(shape)).collect(),
            uvs: base.obj.uvs.clone(),
            faces: base.obj.groups["body"]
                .iter()
                .map(|polygon| Face { vertices: polygon.iter().map(|c| c.0).collect(), uvs: polygon.iter().map(|c| c.1).collect() })
                .collect(),
        };
        // Landmarks keep their vertices through cut and subdivision: both put the old vertices first.
        let mut new_of = body.compact();
        let mut coarse = cut_bust(&body, uv::cap_uv)?;
        let after_cut = coarse.compact();
        new_of = new_of.into_iter().filter_map(|(old, new)| Some((old, *after_cut.get(&new)?))).collect();
        // The rim of the cut is to be rounded by subdividing, the face is not.
        let heights: Vec<f32> = coarse.positions.iter().map(|p| p.y).collect();
        counteract_shrinking(&mut coarse, |v| heights[v] > KEPT_ABOVE);
        let mut mesh = subdivide(&coarse);

        let masks = Masks::load(source)?.sample(&mesh);
        let islands = uv::pack(&mut mesh)?;
        let regions = regions::of_vertices(&mesh, &masks, &islands);

        let mut landmark_vertices = [0; NUM_IBUG];
        for (landmark, base_vertex) in landmark_vertices.iter_mut().zip(IBUG_VERTICES) {
            *landmark = *new_of.get(&base_vertex).with_context(|| format!("landmark vertex {base_vertex} was cut away"))?;
        }
        let lip_sides = lips::sides(&mesh, &landmark_vertices);
        let lip_corners = [landmark_vertices[60], landmark_vertices[64]];
        lips::seal(&mut mesh, &regions, &lip_sides, lip_corners);
        let landmarks = |mesh: &Mesh| landmark_vertices.map(|v| mesh.positions[v as usize]);
        let lids = lids::fields(&mesh, &regions, eyes, &landmarks(&mesh));
        lids::clear_the_ball(&mut mesh, &regions, eyes, &lids.fields);
        let mut ibug68 = landmarks(&mesh);
        place_brow_landmarks(&mesh, &regions, &mut ibug68)?;

        let jaw_pivot = jaw_hinge(base);
        let is_outside = |v: usize| matches!(regions[v], Region::Face | Region::Lips | Region::Body | Region::Eyelid);
        let on_skin = |point: Vec3| {
            let v = autorig::nearest(&mesh.positions, point, is_outside);
            (v, mesh.positions[v as usize])
        };
        let places = Places {
            ibug68: &ibug68,
            eyes,
            jaw_pivot,
            head_pivot: mean(&base.positions, &base.obj.vertices_of("joint-head")),
            neck_pivot: mean(&base.positions, &base.obj.vertices_of("joint-neck")),
            lid_degrees: lids::LID_DEGREES,
            lid_points: lids.points,
        };
        let rig = Rig::new(&places, on_skin);

        let jaw: Vec<f32> = weights::turn_angles(&mesh.positions, &mesh.morphs[shape("jawOpen")], jaw_pivot, 0.02)
            .into_iter()
            .map(|angle| (angle / JAW_OPEN_RADIANS).clamp(0.0, 1.0))
            .collect();
        let weights = weights::build(
            &weights::Skin {
                mesh: &mesh,
                regions: &regions,
                lips: &lip_sides,
                lip_corners,
                jaw,
                lids: lids.fields,
                jaw_pivot,
                jaw_open: JAW_OPEN_RADIANS,
            },
            &rig,
        );
        Ok(Self { mesh, regions, ibug68, lip_corners, eyes, rig, weights })
    }

    /// Corners split at UV seams: `(vertex, uv)` of each drawn vertex, and the triangles over them.
    fn split(&self) -> (Vec<(u32, u32)>, Vec<[u32; 3]>) {
        let mut index_of: BTreeMap<(u32, u32), u32> = BTreeMap::new();
        let mut corners = Vec::new();
        let triangles = self
            .mesh
            .triangles()
            .into_iter()
            .map(|triangle| {
                triangle.map(|corner| {
                    *index_of.entry(corner).or_insert_with(|| {
                        corners.push(corner);
                        (corners.len() - 1) as u32
                    })
                })
            })
            .collect();
        (corners, triangles)
    }

    /// The drawable part.
    pub fn part(&self) -> Result<Part> {
        let (corners, triangles) = self.split();
        let normals = self.mesh.normals(&self.mesh.positions);
        let positions: Vec<Vec3> = corners.iter().map(|&(v, _)| self.mesh.positions[v as usize]).collect();
        let normals: Vec<Vec3> = corners.iter().map(|&(v, _)| normals[v as usize]).collect();
        let uvs: Vec<Vec2> = corners.iter().map(|&(_, t)| self.mesh.uvs[t as usize]).collect();
        let bindings = weights::bind(&self.weights);
        Ok(Part {
            material: Material::Skin,
            tangents: Some(tangents(&positions, &normals, &uvs, &triangles)),
            bindings: corners.iter().map(|&(v, _)| bindings[v as usize]).collect(),
            morphs: self.mesh.morphs.iter().map(|shape| sparse(corners.iter().map(|&(v, _)| shape[v as usize]))).collect(),
            positions,
            normals,
            uvs,
            triangles,
        })
    }

    /// What the painter needs.
    pub fn for_painter(&self) -> Bust {
        let (corners, triangles) = self.split();
        let normals = self.mesh.normals(&self.mesh.positions);
        let bindings = weights::bind(&self.weights);
        let poses = POSES.iter().map(|recipe| {
            let moved = recipe.displacements(&self.mesh, &self.rig);
            let joints: Vec<u8> = moved.keys().map(|name| self.rig.joint_of(name)).collect();
            let share = |v: u32| {
                let Binding { joints: bound, weights } = bindings[v as usize];
                let of_pose = bound.iter().zip(weights).filter(|(joint, _)| joints.contains(joint));
                of_pose.map(|(_, weight)| f32::from(weight)).sum::<f32>() / 255.0
            };
            PoseField { name: recipe.name, influence: corners.iter().map(|&(v, _)| share(v)).collect() }
        });
        let positions: Vec<Vec3> = corners.iter().map(|&(v, _)| self.mesh.positions[v as usize]).collect();
        let normals: Vec<Vec3> = corners.iter().map(|&(v, _)| normals[v as usize]).collect();
        let uvs: Vec<Vec2> = corners.iter().map(|&(_, t)| self.mesh.uvs[t as usize]).collect();
        Bust {
            tangents: tangents(&positions, &normals, &uvs, &triangles),
            positions,
            normals,
            uvs,
            regions: corners.iter().map(|&(v, _)| self.regions[v as usize]).collect(),
            triangles,
            ibug68: self.ibug68,
            eyes: self.eyes,
            poses: poses.collect(),
        }
    }
}

/// Above this height, metres, the shape is kept through subdivision: the neck and all above.
const KEPT_ABOVE: f32 = -0.13;

/// By how much the shape `jawOpen` turns the jaw: the rigid turn of its lower teeth.
const JAW_OPEN_RADIANS: f32 = 0.361_3;

/// The point about which the shape `jawOpen` turns the lower teeth, by a rigid fit in the sagittal plane.
fn jaw_hinge(base: &Base) -> Vec3 {
    let teeth = base.obj.vertices_of("helper-lower-teeth");
    let opened = base.dense_morph(shape("jawOpen"));
    let centre = mean(&base.positions, &teeth);
    let shift = mean(&opened, &teeth);
    let (mut sin, mut cos) = (0.0, 0.0);
    for &v in &teeth {
        let from = base.positions[v as usize] - centre;
        let to = from + opened[v as usize] - shift;
        sin += from.y * to.z - from.z * to.y;
        cos += from.y * to.y + from.z * to.z;
    }
    // Fixed point p of p' = R (p - c) + c + s: (I - R) (p - c) = s.
    let angle = libm::atan2f(sin, cos);
    let half_cot = 0.5 / libm::tanf(0.5 * angle);
    Vec3::new(0.0, centre.y + 0.5 * shift.y - half_cot * shift.z, centre.z + 0.5 * shift.z + half_cot * shift.y)
}

/// Puts the brows' landmarks where trackers see them.
fn place_brow_landmarks(mesh: &Mesh, regions: &[Region], ibug68: &mut [Vec3; NUM_IBUG]) -> Result<()> {
    let surface = Surface::new(mesh, |v| matches!(regions[v], Region::Face | Region::Eyelid | Region::Body));
    for (i, at) in BROW.into_iter().enumerate() {
        for (landmark, side) in [(22 + i, 1.0), (21 - i, -1.0)] {
            let hit = brows::on_front(&surface, Vec2::new(at.x * side, at.y)).context("a brow landmark misses the face")?;
            ibug68[landmark] = surface.position(&hit);
        }
    }
    Ok(())
}

/// Tangents along +u with handedness, per vertex, from the area-weighted UV gradients of its triangles.
fn tangents(positions: &[Vec3], normals: &[Vec3], uvs: &[Vec2], triangles: &[[u32; 3]]) -> Vec<Vec4> {
    let mut along_u = vec![Vec3::ZERO; positions.len()];
    let mut along_v = vec![Vec3::ZERO; positions.len()];
    for triangle in triangles {
        let [a, b, c] = triangle.map(|v| v as usize);
        let (e1, e2) = (positions[b] - positions[a], positions[c] - positions[a]);
        let (d1, d2) = (uvs[b] - uvs[a], uvs[c] - uvs[a]);
        let determinant = d1.perp_dot(d2);
        if determinant.abs() < 1e-14 {
            continue;
        }
        let weight = e1.cross(e2).length() / determinant;
        for v in [a, b, c] {
            along_u[v] += ((e1 * d2.y - e2 * d1.y) * weight).normalize_or_zero() * e1.cross(e2).length();
            along_v[v] += ((e2 * d1.x - e1 * d2.x) * weight).normalize_or_zero() * e1.cross(e2).length();
        }
    }
    (0..positions.len())
        .map(|v| {
            let n = normals[v];
            let t = (along_u[v] - n * n.dot(along_u[v])).normalize_or(n.any_orthonormal_vector());
            // glTF's bitangent points towards larger v in texture space with v up, that is, against v here.
            let handedness = if n.cross(t).dot(along_v[v]) > 0.0 { -1.0 } else { 1.0 };
            t.extend(handedness)
        })
        .collect()
}
