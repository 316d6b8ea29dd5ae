//! Teeth and tongue.

use super::base::Base;
use super::part::{Binding, Material, Part, sparse};
use super::rig::HEAD;
use glam::{Vec2, Vec3};
use rhytid_shared::ARKIT_NAMES;

/// Both rows of teeth.
pub fn build(base: &Base, jaw: u8) -> Part {
    let mut part = helper(base, "helper-upper-teeth", Material::Teeth, HEAD);
    let lower = helper(base, "helper-lower-teeth", Material::Teeth, jaw);
    let first = part.positions.len() as u32;
    part.positions.extend(lower.positions);
    part.normals.extend(lower.normals);
    part.uvs.extend(lower.uvs);
    part.bindings.extend(lower.bindings);
    part.triangles.extend(lower.triangles.iter().map(|t| t.map(|v| v + first)));
    for (all, own) in part.morphs.iter_mut().zip(lower.morphs) {
        all.extend(own.into_iter().map(|(v, delta)| (v + first, delta)));
    }
    part
}

/// The tongue.
pub fn tongue(base: &Base, jaw: u8) -> Part {
    helper(base, "helper-tongue", Material::Tongue, jaw)
}

/// A helper group of the base mesh, bound to one joint.
fn helper(base: &Base, group: &str, material: Material, joint: u8) -> Part {
    let vertices = base.obj.vertices_of(group);
    let index_of = |v: u32| vertices.binary_search(&v).expect("the group's own vertices") as u32;
    let positions: Vec<Vec3> = vertices.iter().map(|&v| base.positions[v as usize]).collect();
    let mut normals = vec![Vec3::ZERO; positions.len()];
    let mut triangles = Vec::new();
    for polygon in &base.obj.groups[group] {
        for i in 1..polygon.len() - 1 {
            let triangle = [polygon[0].0, polygon[i].0, polygon[i + 1].0].map(index_of);
            let [a, b, c] = triangle.map(|v| positions[v as usize]);
            triangle.iter().for_each(|&v| normals[v as usize] += (b - a).cross(c - a));
            triangles.push(triangle);
        }
    }
    Part {
        material,
        normals: normals.into_iter().map(|n| n.normalize_or(Vec3::Y)).collect(),
        tangents: None,
        uvs: vec![Vec2::splat(0.25); positions.len()],
        bindings: vec![Binding::rigid(joint); positions.len()],
        morphs: (0..ARKIT_NAMES.len())
            .map(|shape| {
                let dense = base.dense_morph(shape);
                sparse(vertices.iter().map(|&v| dense[v as usize]))
            })
            .collect(),
        positions,
        triangles,
    }
}
