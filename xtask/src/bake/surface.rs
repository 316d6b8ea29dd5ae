//! Rays onto the skin: where hairs stand and what moves them.

use super::mesh::Mesh;
use super::part::Binding;
use super::weights::Weights;
use glam::Vec3;
use std::collections::BTreeMap;

/// A set of triangles of the skin.
pub struct Surface<'a> {
    mesh: &'a Mesh,
    normals: Vec<Vec3>,
    triangles: Vec<[u32; 3]>,
}

/// A point on the skin.
#[derive(Debug, Clone, Copy)]
pub struct Hit {
    /// Corners of the triangle.
    pub vertices: [u32; 3],
    /// Their shares.
    pub shares: [f32; 3],
    /// Distance along the ray, metres.
    pub distance: f32,
}

impl<'a> Surface<'a> {
    /// The triangles all of whose corners are `wanted`.
    pub fn new(mesh: &'a Mesh, wanted: impl Fn(usize) -> bool) -> Self {
        let triangles = mesh.triangles().into_iter().map(|triangle| triangle.map(|corner| corner.0));
        let triangles = triangles.filter(|triangle| triangle.iter().all(|&v| wanted(v as usize))).collect();
        Self { mesh, normals: mesh.normals(&mesh.positions), triangles }
    }

    /// The nearest point the ray meets (Möller and Trumbore 1997), from either side.
    pub fn ray(&self, origin: Vec3, direction: Vec3) -> Option<Hit> {
        let mut nearest: Option<Hit> = None;
        for &vertices in &self.triangles {
            let [a, b, c] = vertices.map(|v| self.mesh.positions[v as usize]);
            let (e1, e2) = (b - a, c - a);
            let p = direction.cross(e2);
            let determinant = e1.dot(p);
            if determinant.abs() < 1e-14 {
                continue;
            }
            let s = origin - a;
            let u = s.dot(p) / determinant;
            let q = s.cross(e1);
            let v = direction.dot(q) / determinant;
            let distance = e2.dot(q) / determinant;
            let is_inside = u >= 0.0 && v >= 0.0 && u + v <= 1.0 && distance > 0.0;
            if is_inside && nearest.is_none_or(|hit| distance < hit.distance) {
                nearest = Some(Hit { vertices, shares: [1.0 - u - v, u, v], distance });
            }
        }
        nearest
    }

    /// Neutral position of a point.
    pub fn position(&self, hit: &Hit) -> Vec3 {
        blend(hit, &self.mesh.positions)
    }

    /// Unit normal at a point.
    pub fn normal(&self, hit: &Hit) -> Vec3 {
        blend(hit, &self.normals).normalize_or(Vec3::Z)
    }

    /// Displacement of a point by one shape.
    pub fn morph(&self, hit: &Hit, shape: usize) -> Vec3 {
        blend(hit, &self.mesh.morphs[shape])
    }

    /// Joints and weights of a point, from all weights of the corners.
    pub fn binding(&self, hit: &Hit, weights: &Weights) -> Binding {
        let mut sums: BTreeMap<u8, f32> = BTreeMap::new();
        for (&v, &share) in hit.vertices.iter().zip(&hit.shares) {
            for &(joint, weight) in &weights[v as usize] {
                *sums.entry(joint).or_default() += weight * share;
            }
        }
        Binding::from_weights(sums.into_iter().collect())
    }
}

fn blend(hit: &Hit, values: &[Vec3]) -> Vec3 {
    hit.vertices.iter().zip(&hit.shares).map(|(&v, &share)| values[v as usize] * share).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bake::mesh::Face;
    use glam::Vec2;

    #[test]
    fn ray_finds_the_near_one_of_two_sheets() {
        let sheet = |z: f32| [Vec3::new(-1.0, -1.0, z), Vec3::new(2.0, -1.0, z), Vec3::new(-1.0, 2.0, z)];
        let mesh = Mesh {
            positions: [sheet(0.0), sheet(1.0)].concat(),
            uvs: vec![Vec2::ZERO; 6],
            faces: [[0, 1, 2], [3, 4, 5]].map(|v| Face { vertices: v.to_vec(), uvs: v.to_vec() }).to_vec(),
            ..Mesh::default()
        };
        let surface = Surface::new(&mesh, |_| true);
        let hit = surface.ray(Vec3::new(0.1, 0.2, 5.0), Vec3::NEG_Z).expect("it meets both");
        assert!((hit.distance - 4.0).abs() < 1e-6);
        assert!(surface.position(&hit).distance(Vec3::new(0.1, 0.2, 1.0)) < 1e-6);
        assert!(surface.ray(Vec3::new(5.0, 0.0, 5.0), Vec3::NEG_Z).is_none());
    }
}
