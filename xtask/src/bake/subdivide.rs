//! One level of Catmull–Clark subdivision (Catmull and Clark 1978) of positions and displacements; UVs are halved
//! linearly, so that seams stay where they are.

use super::mesh::{Face, Mesh, Stencil};
use std::collections::BTreeMap;

/// Moves the vertices for which `keeps` holds by what subdividing would pull them in, so that afterwards they are (nearly)
/// where they were: lids stay on the ball, lips closed, nose and ears sharp.
pub fn counteract_shrinking(mesh: &mut Mesh, keeps: impl Fn(usize) -> bool) {
    let mut edges: BTreeMap<(u32, u32), Edge> = BTreeMap::new();
    for (f, face) in mesh.faces.iter().enumerate() {
        for (a, b) in ring(&face.vertices) {
            edges.entry(key(a, b)).or_default().faces.push(f);
        }
    }
    let face_point = |f: usize| -> Stencil {
        let share = 1.0 / mesh.faces[f].vertices.len() as f32;
        mesh.faces[f].vertices.iter().map(|&v| (v, share)).collect()
    };
    let mut stencils = vertex_points(mesh, &edges, mesh.positions.len(), &face_point);
    for (v, stencil) in stencils.iter_mut().enumerate() {
        // 2 p - S p for those that keep their place, p for the others.
        if keeps(v) {
            stencil.iter_mut().for_each(|(_, weight)| *weight = -*weight);
            stencil.push((v as u32, 2.0));
        } else {
            *stencil = vec![(v as u32, 1.0)];
        }
    }
    let uvs: Vec<Stencil> = (0..mesh.uvs.len() as u32).map(|t| vec![(t, 1.0)]).collect();
    *mesh = mesh.resampled(&stencils, &uvs, mesh.faces.clone());
}

#[derive(Default)]
struct Edge {
    faces: Vec<usize>,
    index: usize,
}

/// The subdivided mesh, all quads. Its first vertices are the old ones in their order.
pub fn subdivide(mesh: &Mesh) -> Mesh {
    let num_old = mesh.positions.len();
    let mut edges: BTreeMap<(u32, u32), Edge> = BTreeMap::new();
    for (f, face) in mesh.faces.iter().enumerate() {
        for (a, b) in ring(&face.vertices) {
            edges.entry(key(a, b)).or_default().faces.push(f);
        }
    }
    for (index, edge) in edges.values_mut().enumerate() {
        edge.index = index;
    }
    let face_point = |f: usize| -> Stencil {
        let share = 1.0 / mesh.faces[f].vertices.len() as f32;
        mesh.faces[f].vertices.iter().map(|&v| (v, share)).collect()
    };

    let mut stencils = vertex_points(mesh, &edges, num_old, &face_point);
    for (&(a, b), edge) in &edges {
        stencils.push(if edge.faces.len() == 2 {
            let mut stencil = vec![(a, 0.25), (b, 0.25)];
            for &f in &edge.faces {
                stencil.extend(face_point(f).into_iter().map(|(v, w)| (v, 0.25 * w)));
            }
            merged(stencil)
        } else {
            vec![(a, 0.5), (b, 0.5)]
        });
    }
    stencils.extend((0..mesh.faces.len()).map(face_point));

    let mut uv_stencils: Vec<Stencil> = (0..mesh.uvs.len() as u32).map(|t| vec![(t, 1.0)]).collect();
    let mut uv_edges: BTreeMap<(u32, u32), u32> = BTreeMap::new();
    let mut faces = Vec::with_capacity(mesh.faces.len() * 4);
    for (f, face) in mesh.faces.iter().enumerate() {
        let n = face.vertices.len();
        let centre_uv = uv_stencils.len() as u32;
        uv_stencils.push(face.uvs.iter().map(|&t| (t, 1.0 / n as f32)).collect());
        let edge_uvs: Vec<u32> = ring(&face.uvs)
            .map(|(a, b)| {
                *uv_edges.entry(key(a, b)).or_insert_with(|| {
                    uv_stencils.push(vec![(a, 0.5), (b, 0.5)]);
                    (uv_stencils.len() - 1) as u32
                })
            })
            .collect();
        let edge_vertices: Vec<u32> = ring(&face.vertices).map(|(a, b)| (num_old + edges[&key(a, b)].index) as u32).collect();
        let centre = (num_old + edges.len() + f) as u32;
        for i in 0..n {
            let before = (i + n - 1) % n;
            faces.push(Face {
                vertices: vec![face.vertices[i], edge_vertices[i], centre, edge_vertices[before]],
                uvs: vec![face.uvs[i], edge_uvs[i], centre_uv, edge_uvs[before]],
            });
        }
    }
    mesh.resampled(&stencils, &uv_stencils, faces)
}

/// Where the old vertices go: (F + 2R + (n-3)P)/n inside, (1, 6, 1)/8 along borders.
fn vertex_points(mesh: &Mesh, edges: &BTreeMap<(u32, u32), Edge>, num_old: usize, face_point: &impl Fn(usize) -> Stencil) -> Vec<Stencil> {
    let mut faces_at = vec![Vec::new(); num_old];
    for (f, face) in mesh.faces.iter().enumerate() {
        for &v in &face.vertices {
            faces_at[v as usize].push(f);
        }
    }
    let mut edges_at = vec![Vec::new(); num_old];
    for (&(a, b), edge) in edges {
        edges_at[a as usize].push((b, edge.faces.len()));
        edges_at[b as usize].push((a, edge.faces.len()));
    }
    (0..num_old)
        .map(|v| {
            let rim: Vec<u32> = edges_at[v].iter().filter(|edge| edge.1 == 1).map(|edge| edge.0).collect();
            let own = v as u32;
            if let [a, b] = rim[..] {
                return merged(vec![(own, 0.75), (a, 0.125), (b, 0.125)]);
            }
            if !rim.is_empty() || faces_at[v].is_empty() {
                return vec![(own, 1.0)];
            }
            let n = faces_at[v].len() as f32;
            let mut stencil = vec![(own, (n - 3.0) / n)];
            for &f in &faces_at[v] {
                stencil.extend(face_point(f).into_iter().map(|(i, w)| (i, w / (n * n))));
            }
            for &(other, _) in &edges_at[v] {
                stencil.push((own, 1.0 / (n * n)));
                stencil.push((other, 1.0 / (n * n)));
            }
            merged(stencil)
        })
        .collect()
}

fn ring(indices: &[u32]) -> impl Iterator<Item = (u32, u32)> + '_ {
    indices.iter().enumerate().map(|(i, &a)| (a, indices[(i + 1) % indices.len()]))
}

fn key(a: u32, b: u32) -> (u32, u32) {
    (a.min(b), a.max(b))
}

fn merged(stencil: Stencil) -> Stencil {
    let mut sums: BTreeMap<u32, f32> = BTreeMap::new();
    for (i, w) in stencil {
        *sums.entry(i).or_default() += w;
    }
    sums.into_iter().collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{Vec2, Vec3};
    use rhytid_shared::NUM_ARKIT_SHAPES;

    fn cube() -> Mesh {
        let corner = |i: u32| Vec3::new((i & 1) as f32, (i >> 1 & 1) as f32, (i >> 2) as f32) * 2.0 - 1.0;
        let sides: [[u32; 4]; 6] = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
        Mesh {
            positions: (0..8).map(corner).collect(),
            morphs: vec![vec![Vec3::X; 8]; NUM_ARKIT_SHAPES],
            uvs: vec![Vec2::ZERO; 8],
            faces: sides.iter().map(|side| Face { vertices: side.to_vec(), uvs: side.to_vec() }).collect(),
        }
    }

    #[test]
    fn cube_gives_the_published_points_and_carries_displacements() {
        let fine = subdivide(&cube());
        assert_eq!((fine.positions.len(), fine.faces.len()), (26, 24));
        // Catmull and Clark: a corner of the cube goes to 5/9, an edge point to 3/4 of its place, face points stay.
        assert!(fine.positions[7].distance(Vec3::splat(5.0 / 9.0)) < 1e-6);
        assert!((fine.positions[8].length() - 0.75 * 2.0_f32.sqrt()).abs() < 1e-6);
        assert!((fine.positions[25].length() - 1.0).abs() < 1e-6);
        assert!(fine.morphs[3].iter().all(|delta| delta.distance(Vec3::X) < 1e-6));
    }

    #[test]
    fn counteracting_halves_the_shrinking_at_least() {
        let shrunk = subdivide(&cube()).positions[7].distance(Vec3::ONE);
        let mut kept = cube();
        counteract_shrinking(&mut kept, |_| true);
        assert!(subdivide(&kept).positions[7].distance(Vec3::ONE) < 0.5 * shrunk);
    }

    #[test]
    fn border_of_an_open_sheet_stays_on_its_line() {
        let mut sheet = cube();
        sheet.faces.truncate(1);
        let fine = subdivide(&sheet);
        assert!(fine.positions.iter().skip(8).all(|p| p.z == -1.0 && p.x.abs() <= 1.0 && p.y.abs() <= 1.0));
    }
}
