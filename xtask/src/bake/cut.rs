//! Cuts the body down to a bust along an ellipsoid and closes it below with a rounded rim, so that no edge is ragged
//! and no hole can be seen from anywhere.

use super::mesh::{Face, Mesh, Stencil};
use anyhow::{Result, ensure};
use glam::{Vec2, Vec3};
use std::collections::BTreeMap;

/// Shape of the cut, metres, head space; tuned by eye. Above the centre the ellipsoid goes on as a cylinder.
const CENTRE: Vec3 = Vec3::new(0.0, -0.060, -0.012);
const RADII: Vec3 = Vec3::new(0.196, 0.162, 0.162);
/// Where along an edge from a vertex a crossing is so near that the vertex itself is moved onto the cut: no slivers.
const SNAP: f32 = 0.34;
/// How far inwards each ring of the closing surface lies (1 is the middle), and how far it is lifted above the ellipsoid's
/// own height, as a share of the rim's height. The close first ring makes the rounded edge.
const RINGS: [f32; 4] = [0.035, 0.25, 0.5, 0.75];

/// Positive inside the bust, zero on the cut.
fn inside(p: Vec3) -> f32 {
    let q = (p - CENTRE) / RADII;
    1.0 - Vec3::new(q.x, q.y.min(0.0), q.z).length()
}

/// The part of `mesh` inside the cut, closed. `cap_uv` gives the texture coordinate of the closing surface's points.
pub fn cut_bust(mesh: &Mesh, cap_uv: impl Fn(Vec2) -> Vec2) -> Result<Mesh> {
    let mut level: Vec<f32> = mesh.positions.iter().map(|&p| inside(p)).collect();
    let mut stencils: Vec<Stencil> = (0..mesh.positions.len() as u32).map(|v| vec![(v, 1.0)]).collect();
    snap(mesh, &mut level, &mut stencils);

    let mut uv_stencils: Vec<Stencil> = (0..mesh.uvs.len() as u32).map(|t| vec![(t, 1.0)]).collect();
    let mut crossings: BTreeMap<(u32, u32), u32> = BTreeMap::new();
    let mut uv_crossings: BTreeMap<(u32, u32), u32> = BTreeMap::new();
    let mut faces = Vec::new();
    for face in &mesh.faces {
        if !face.vertices.iter().any(|&v| level[v as usize] > 0.0) {
            continue;
        }
        let (mut vertices, mut uvs) = (Vec::new(), Vec::new());
        let n = face.vertices.len();
        for i in 0..n {
            let (a, b) = (face.vertices[i], face.vertices[(i + 1) % n]);
            let (ta, tb) = (face.uvs[i], face.uvs[(i + 1) % n]);
            let (fa, fb) = (level[a as usize], level[b as usize]);
            if fa >= 0.0 {
                vertices.push(a);
                uvs.push(ta);
            }
            if fa * fb < 0.0 {
                // Always from the smaller index, so that both faces of the edge compute the same point.
                let along = |a: u32, b: u32, fa: f32, fb: f32| {
                    let t = fa / (fa - fb);
                    if a < b { vec![(a, 1.0 - t), (b, t)] } else { vec![(b, t), (a, 1.0 - t)] }
                };
                vertices.push(*crossings.entry((a.min(b), a.max(b))).or_insert_with(|| {
                    let mut point: Stencil = Vec::new();
                    for (v, w) in along(a, b, fa, fb) {
                        point.extend(stencils[v as usize].iter().map(|&(u, share)| (u, share * w)));
                    }
                    stencils.push(point);
                    (stencils.len() - 1) as u32
                }));
                uvs.push(*uv_crossings.entry((ta.min(tb), ta.max(tb))).or_insert_with(|| {
                    uv_stencils.push(along(ta, tb, fa, fb));
                    (uv_stencils.len() - 1) as u32
                }));
            }
        }
        if vertices.len() >= 3 {
            faces.push(Face { vertices, uvs });
        }
    }
    let mut bust = mesh.resampled(&stencils, &uv_stencils, faces);
    close(&mut bust, cap_uv)?;
    Ok(bust)
}

/// Moves vertices close to the cut onto it, along the edge that meets it first.
fn snap(mesh: &Mesh, level: &mut [f32], stencils: &mut [Stencil]) {
    let old = level.to_vec();
    for (v, neighbours) in mesh.neighbours().iter().enumerate() {
        let crossing = neighbours
            .iter()
            .filter(|&&u| old[v] * old[u as usize] < 0.0)
            .map(|&u| (old[v] / (old[v] - old[u as usize]), u))
            .min_by(|a, b| a.0.total_cmp(&b.0));
        if let Some((t, u)) = crossing
            && t < SNAP
        {
            stencils[v] = vec![(v as u32, 1.0 - t), (u, t)];
            level[v] = 0.0;
        }
    }
}

/// Closes the one open border with rings that shrink to the middle of the ellipsoid's bottom.
fn close(bust: &mut Mesh, cap_uv: impl Fn(Vec2) -> Vec2) -> Result<()> {
    let rim = border(bust)?;
    let centre = rim.iter().map(|&v| bust.positions[v as usize]).sum::<Vec3>() / rim.len() as f32;
    let bottom = Vec3::new(centre.x, CENTRE.y - RADII.y, centre.z);
    let positions: Vec<Vec3> = rim.iter().map(|&v| bust.positions[v as usize]).collect();
    let place = |share: f32, p: Vec3| {
        let mut q = p.lerp(bottom, share);
        let flat = Vec2::new((q.x - CENTRE.x) / RADII.x, (q.z - CENTRE.z) / RADII.z);
        q.y = CENTRE.y - RADII.y * (1.0 - flat.length_squared()).max(0.0).sqrt();
        q
    };
    let cap_at = |p: Vec3| cap_uv(Vec2::new((p.x - centre.x) / RADII.x, (p.z - centre.z) / RADII.x));
    let mut outer = rim.clone();
    let mut outer_uvs: Vec<u32> = positions.iter().map(|&p| cap_at(p)).map(|uv| bust.push_uv(uv)).collect();
    for share in RINGS {
        let ring: Vec<Vec3> = positions.iter().map(|&p| place(share, p)).collect();
        let inner_uvs: Vec<u32> = ring.iter().map(|&p| cap_at(p)).map(|uv| bust.push_uv(uv)).collect();
        let inner: Vec<u32> = ring.into_iter().map(|p| bust.push_still(p)).collect();
        for i in 0..rim.len() {
            let j = (i + 1) % rim.len();
            bust.faces.push(Face {
                vertices: vec![outer[i], outer[j], inner[j], inner[i]],
                uvs: vec![outer_uvs[i], outer_uvs[j], inner_uvs[j], inner_uvs[i]],
            });
        }
        (outer, outer_uvs) = (inner, inner_uvs);
    }
    bust.faces.push(Face { vertices: outer, uvs: outer_uvs });
    Ok(())
}

/// The open border as a ring in the direction its closing faces must run (against the faces that have it).
fn border(mesh: &Mesh) -> Result<Vec<u32>> {
    let mut once: BTreeMap<(u32, u32), (u32, u32)> = BTreeMap::new();
    for face in &mesh.faces {
        for (i, &a) in face.vertices.iter().enumerate() {
            let b = face.vertices[(i + 1) % face.vertices.len()];
            if once.remove(&(a.min(b), a.max(b))).is_none() {
                once.insert((a.min(b), a.max(b)), (a, b));
            }
        }
    }
    let next: BTreeMap<u32, u32> = once.values().map(|&(a, b)| (b, a)).collect();
    ensure!(next.len() == once.len(), "the cut's border touches itself");
    let Some((&first, _)) = next.iter().next() else { anyhow::bail!("the cut met nothing") };
    let mut ring = vec![first];
    while let Some(&v) = next.get(ring.last().expect("the ring starts with one vertex"))
        && v != first
    {
        ring.push(v);
        ensure!(ring.len() <= next.len(), "the cut's border does not close");
    }
    ensure!(ring.len() == next.len(), "the cut has several borders, {} of {} edges are in the first", ring.len(), next.len());
    Ok(ring)
}
