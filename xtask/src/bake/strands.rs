//! Ribbons of hair.

use super::part::{Binding, Material, Part, sparse};
use glam::{Vec2, Vec3};
use rhytid_shared::ARKIT_NAMES;

/// A point along a hair.
pub struct Knot {
    /// Metres, head space.
    pub position: Vec3,
    /// Skin normal under it.
    pub normal: Vec3,
    /// Half the hair's width here, metres.
    pub half_width: f32,
    /// What moves it.
    pub binding: Binding,
    /// Displacement by every shape.
    pub morphs: Vec<Vec3>,
}

/// An empty part of hairs.
pub fn empty(material: Material) -> Part {
    Part {
        material,
        positions: Vec::new(),
        normals: Vec::new(),
        tangents: None,
        uvs: Vec::new(),
        bindings: Vec::new(),
        morphs: vec![Vec::new(); ARKIT_NAMES.len()],
        triangles: Vec::new(),
    }
}

/// Adds one hair: a ribbon that lies flat against `normal` and ends in a point.
pub fn push(part: &mut Part, knots: &[Knot]) {
    let first = part.positions.len() as u32;
    let last = knots.len() - 1;
    let mut deltas: Vec<Vec<Vec3>> = vec![Vec::new(); ARKIT_NAMES.len()];
    for (k, knot) in knots.iter().enumerate() {
        let along = knots[(k + 1).min(last)].position - knots[k.saturating_sub(1)].position;
        let side = along.cross(knot.normal).normalize_or(Vec3::X) * knot.half_width;
        let across: &[f32] = if k == last { &[0.0] } else { &[-1.0, 1.0] };
        for &x in across {
            part.positions.push(knot.position + side * x);
            part.normals.push(knot.normal);
            part.uvs.push(Vec2::new(0.5 + 0.5 * x, k as f32 / last as f32));
            part.bindings.push(knot.binding);
            deltas.iter_mut().zip(&knot.morphs).for_each(|(all, &delta)| all.push(delta));
        }
        if k < last {
            let a = first + 2 * k as u32;
            part.triangles.push([a, a + 1, a + 2]);
            if k + 1 < last {
                part.triangles.push([a + 1, a + 3, a + 2]);
            }
        }
    }
    for (all, own) in part.morphs.iter_mut().zip(deltas) {
        all.extend(sparse(own.into_iter()).into_iter().map(|(v, delta)| (v + first, delta)));
    }
}
