//! A polygon mesh with welded positions, UVs that may part at seams, and expression displacements.

use glam::{Vec2, Vec3};
use rhytid_shared::NUM_ARKIT_SHAPES;
use std::collections::BTreeMap;

/// A polygon; both lists have the same length and run counter-clockwise seen from outside.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Face {
    /// Indices into [`Mesh::positions`].
    pub vertices: Vec<u32>,
    /// Indices into [`Mesh::uvs`].
    pub uvs: Vec<u32>,
}

/// The mesh while it is being worked on. Metres, head space.
#[derive(Debug, Clone, Default)]
pub struct Mesh {
    /// Neutral positions.
    pub positions: Vec<Vec3>,
    /// Displacement of every vertex by each ARKit shape at 1: `morphs[shape][vertex]`.
    pub morphs: Vec<Vec<Vec3>>,
    /// Texture coordinates.
    pub uvs: Vec<Vec2>,
    /// Polygons.
    pub faces: Vec<Face>,
}

/// A vertex as a weighted sum of vertices of another mesh.
pub type Stencil = Vec<(u32, f32)>;

impl Mesh {
    /// The mesh whose vertices and UVs are weighted sums of this one's, with `faces` over them.
    pub fn resampled(&self, vertices: &[Stencil], uvs: &[Stencil], faces: Vec<Face>) -> Self {
        let sum = |values: &[Vec3], stencil: &Stencil| stencil.iter().fold(Vec3::ZERO, |sum, &(i, w)| sum + values[i as usize] * w);
        Self {
            positions: vertices.iter().map(|stencil| sum(&self.positions, stencil)).collect(),
            morphs: self.morphs.iter().map(|shape| vertices.iter().map(|stencil| sum(shape, stencil)).collect()).collect(),
            uvs: uvs.iter().map(|stencil| stencil.iter().fold(Vec2::ZERO, |sum, &(i, w)| sum + self.uvs[i as usize] * w)).collect(),
            faces,
        }
    }

    /// Adds a vertex that no expression moves.
    pub fn push_still(&mut self, position: Vec3) -> u32 {
        self.positions.push(position);
        self.morphs.resize(NUM_ARKIT_SHAPES, vec![Vec3::ZERO; self.positions.len() - 1]);
        for shape in &mut self.morphs {
            shape.push(Vec3::ZERO);
        }
        (self.positions.len() - 1) as u32
    }

    /// Adds a texture coordinate.
    pub fn push_uv(&mut self, uv: Vec2) -> u32 {
        self.uvs.push(uv);
        (self.uvs.len() - 1) as u32
    }

    /// Drops vertices and UVs no face uses. Returns the new index of every old vertex that is left.
    pub fn compact(&mut self) -> BTreeMap<u32, u32> {
        let mut vertices: Vec<u32> = self.faces.iter().flat_map(|face| face.vertices.iter().copied()).collect();
        let mut uvs: Vec<u32> = self.faces.iter().flat_map(|face| face.uvs.iter().copied()).collect();
        for list in [&mut vertices, &mut uvs] {
            list.sort_unstable();
            list.dedup();
        }
        let vertex_of: BTreeMap<u32, u32> = vertices.iter().enumerate().map(|(new, &old)| (old, new as u32)).collect();
        let uv_of: BTreeMap<u32, u32> = uvs.iter().enumerate().map(|(new, &old)| (old, new as u32)).collect();
        self.positions = vertices.iter().map(|&v| self.positions[v as usize]).collect();
        for shape in &mut self.morphs {
            *shape = vertices.iter().map(|&v| shape[v as usize]).collect();
        }
        self.uvs = uvs.iter().map(|&t| self.uvs[t as usize]).collect();
        for face in &mut self.faces {
            face.vertices.iter_mut().for_each(|v| *v = vertex_of[v]);
            face.uvs.iter_mut().for_each(|t| *t = uv_of[t]);
        }
        vertex_of
    }

    /// Unit normals, area-weighted over the polygons round each vertex, for the given positions.
    pub fn normals(&self, positions: &[Vec3]) -> Vec<Vec3> {
        let mut normals = vec![Vec3::ZERO; positions.len()];
        for face in &self.faces {
            let at = |i: usize| positions[face.vertices[i % face.vertices.len()] as usize];
            // Newell: exact for planar polygons, a fair mean for bent ones.
            let area = (0..face.vertices.len()).fold(Vec3::ZERO, |sum, i| sum + at(i).cross(at(i + 1)));
            for &v in &face.vertices {
                normals[v as usize] += area;
            }
        }
        normals.into_iter().map(|normal| normal.normalize_or(Vec3::Y)).collect()
    }

    /// Polygons cut into triangles, quads along their shorter diagonal: `(vertex, uv)` corners.
    pub fn triangles(&self) -> Vec<[(u32, u32); 3]> {
        let mut triangles = Vec::with_capacity(self.faces.len() * 2);
        for face in &self.faces {
            let corner = |i: usize| (face.vertices[i % face.vertices.len()], face.uvs[i % face.uvs.len()]);
            let at = |i: usize| self.positions[corner(i).0 as usize];
            let first = usize::from(face.vertices.len() == 4 && at(1).distance_squared(at(3)) < at(0).distance_squared(at(2)));
            for i in 1..face.vertices.len() - 1 {
                triangles.push([corner(first), corner(first + i), corner(first + i + 1)]);
            }
        }
        triangles
    }

    /// Neighbours of every vertex along polygon edges, ascending.
    pub fn neighbours(&self) -> Vec<Vec<u32>> {
        let mut neighbours = vec![Vec::new(); self.positions.len()];
        for face in &self.faces {
            for (i, &a) in face.vertices.iter().enumerate() {
                let b = face.vertices[(i + 1) % face.vertices.len()];
                neighbours[a as usize].push(b);
                neighbours[b as usize].push(a);
            }
        }
        for list in &mut neighbours {
            list.sort_unstable();
            list.dedup();
        }
        neighbours
    }
}
