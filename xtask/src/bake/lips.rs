//! Lips: which of the two a vertex belongs to, and that they touch at rest.

use super::autorig;
use super::bust::Region;
use super::mesh::Mesh;
use super::weights::{Lip, smoothstep};
use rhytid_shared::layout::NUM_IBUG;

/// How far the lips' edges overlap at rest, metres: nothing may be seen between them.
const OVERLAP: f32 = 0.000_25;
/// Distance from the lips' edge at which nothing is moved any more, metres.
const REACH: f32 = 0.005;
/// Width of the columns in which the gap is measured, metres.
const COLUMN: f32 = 0.001_2;

/// Which lip each vertex is nearer to along the skin.
pub fn sides(mesh: &Mesh, landmark_vertices: &[u32; NUM_IBUG]) -> Vec<Lip> {
    let graph = autorig::edge_graph(mesh);
    let distances = |landmarks: &[usize]| {
        let starts: Vec<u32> = landmarks.iter().map(|&landmark| landmark_vertices[landmark]).collect();
        autorig::distances(&graph, &starts, f32::INFINITY)
    };
    let upper = distances(&[49, 50, 51, 52, 53, 61, 62, 63]);
    let lower = distances(&[55, 56, 57, 58, 59, 65, 66, 67]);
    upper.iter().zip(&lower).map(|(u, l)| if u <= l { Lip::Upper } else { Lip::Lower }).collect()
}

/// Closes the gap between the lips that is left at rest, each half way. `corners` are the inner corners' vertices.
pub fn seal(mesh: &mut Mesh, regions: &[Region], sides: &[Lip], corners: [u32; 2]) {
    let [right, left] = corners.map(|v| mesh.positions[v as usize]);
    let front = right.z.min(left.z) - 0.002;
    let is_lip = |v: usize| {
        let p = mesh.positions[v];
        matches!(regions[v], Region::Lips | Region::Mouth) && p.z > front && p.x > right.x - REACH && p.x < left.x + REACH
    };
    let lips: Vec<usize> = (0..mesh.positions.len()).filter(|&v| is_lip(v)).collect();
    // Lowest point of the upper and highest of the lower lip near a column.
    let edges = |x: f32| {
        lips.iter().filter(|&&v| (mesh.positions[v].x - x).abs() < COLUMN).fold((f32::INFINITY, f32::NEG_INFINITY), |(upper, lower), &v| {
            let y = mesh.positions[v].y;
            if sides[v] == Lip::Upper { (upper.min(y), lower) } else { (upper, lower.max(y)) }
        })
    };
    let num_columns = ((left.x - right.x) / COLUMN) as usize + 1;
    let columns: Vec<(f32, f32, f32)> = (0..=num_columns)
        .map(|i| {
            let x = right.x + (left.x - right.x) * i as f32 / num_columns as f32;
            let (upper, lower) = edges(x);
            (x, upper, lower)
        })
        .filter(|&(_, upper, lower)| upper.is_finite() && lower.is_finite())
        .collect();
    let mut moved = vec![0.0; mesh.positions.len()];
    for v in 0..mesh.positions.len() {
        let p = mesh.positions[v];
        let Some(&(x, upper, lower)) = columns.iter().min_by(|a, b| (a.0 - p.x).abs().total_cmp(&(b.0 - p.x).abs())) else { return };
        let edge = if sides[v] == Lip::Upper { upper } else { lower };
        let distance = (p.y - edge).abs().max((p.x - x).abs()).max((front - p.z).max(0.0));
        let share = 1.0 - smoothstep(0.000_5, REACH, distance);
        let half_gap = 0.5 * (upper - lower + OVERLAP).max(0.0);
        moved[v] = share * if sides[v] == Lip::Upper { -half_gap } else { half_gap };
    }
    let neighbours = mesh.neighbours();
    for v in 0..mesh.positions.len() {
        let own: Vec<f32> = neighbours[v].iter().filter(|&&u| sides[u as usize] == sides[v]).map(|&u| moved[u as usize]).collect();
        let mean = own.iter().sum::<f32>() / own.len().max(1) as f32;
        mesh.positions[v].y += 0.6 * moved[v] + 0.4 * mean;
    }
}
