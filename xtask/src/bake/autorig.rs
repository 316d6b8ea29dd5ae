//! Automatic rig after [D09]'s retargeting: bone weights from feature points, by distance along the surface.

use super::mesh::Mesh;
use glam::Vec3;
use std::cmp::Reverse;
use std::collections::BinaryHeap;

/// A feature point with the reach of its influence.
pub struct Feature {
    /// Vertex it sits on.
    pub vertex: u32,
    /// Distance along the surface at which its influence ends, metres.
    pub reach: f32,
}

/// Wendland's C2 function: `(1 - r)^4 (4 r + 1)` below 1, else 0.
pub fn wendland(r: f32) -> f32 {
    if r >= 1.0 {
        return 0.0;
    }
    let s = (1.0 - r) * (1.0 - r);
    s * s * (4.0 * r + 1.0)
}

/// Shares of one vertex: `u / max(1, sum u)`. What is missing to one is the head's.
pub fn shares(influences: &[f32]) -> Vec<f32> {
    let sum: f32 = influences.iter().sum();
    influences.iter().map(|u| u / sum.max(1.0)).collect()
}

/// Edges with their lengths: `graph[vertex]` lists `(neighbour, metres)`. Diagonals of polygons count, so that distances
/// do not depend so much on how the quads lie.
pub fn edge_graph(mesh: &Mesh) -> Vec<Vec<(u32, f32)>> {
    let mut graph: Vec<Vec<(u32, f32)>> = vec![Vec::new(); mesh.positions.len()];
    for face in &mesh.faces {
        for &a in &face.vertices {
            for &b in &face.vertices {
                if a != b && !graph[a as usize].iter().any(|&(known, _)| known == b) {
                    graph[a as usize].push((b, mesh.positions[a as usize].distance(mesh.positions[b as usize])));
                }
            }
        }
    }
    graph
}

/// Distance along the surface from any of `starts` to each vertex (Dijkstra), infinite beyond `limit`.
pub fn distances(graph: &[Vec<(u32, f32)>], starts: &[u32], limit: f32) -> Vec<f32> {
    let mut distance = vec![f32::INFINITY; graph.len()];
    // Distances are not negative, so their bits order as they do.
    let mut queue: BinaryHeap<Reverse<(u32, u32)>> = BinaryHeap::new();
    for &start in starts {
        distance[start as usize] = 0.0;
        queue.push(Reverse((0, start)));
    }
    while let Some(Reverse((bits, v))) = queue.pop() {
        let reached = f32::from_bits(bits);
        if reached > distance[v as usize] {
            continue;
        }
        for &(u, length) in &graph[v as usize] {
            let through = reached + length;
            if through < distance[u as usize] && through <= limit {
                distance[u as usize] = through;
                queue.push(Reverse((through.to_bits(), u)));
            }
        }
    }
    distance
}

/// Influence of each feature on each vertex before normalising: `influence[feature][vertex]`. `allows(feature, vertex)`
/// keeps regions apart that touch but do not move together (upper and lower lip, upper and lower lid).
pub fn influences(graph: &[Vec<(u32, f32)>], features: &[Feature], allows: impl Fn(usize, usize) -> bool) -> Vec<Vec<f32>> {
    features
        .iter()
        .enumerate()
        .map(|(j, feature)| {
            let distance = distances(graph, &[feature.vertex], feature.reach);
            (0..graph.len()).map(|v| if allows(j, v) { wendland(distance[v] / feature.reach) } else { 0.0 }).collect()
        })
        .collect()
}

/// `rounds` passes that move each value halfway to the mean of its neighbours of the same region.
pub fn smooth(graph: &[Vec<(u32, f32)>], values: &mut Vec<f32>, rounds: usize, is_same: impl Fn(usize, usize) -> bool) {
    for _ in 0..rounds {
        *values = (0..values.len())
            .map(|v| {
                let (mut sum, mut count) = (0.0, 0.0);
                for &(u, _) in &graph[v] {
                    if is_same(v, u as usize) {
                        sum += values[u as usize];
                        count += 1.0;
                    }
                }
                if count > 0.0 { 0.5 * values[v] + 0.5 * sum / count } else { values[v] }
            })
            .collect();
    }
}

/// Vertex nearest to `point` among those `allowed`.
pub fn nearest(positions: &[Vec3], point: Vec3, allowed: impl Fn(usize) -> bool) -> u32 {
    (0..positions.len())
        .filter(|&v| allowed(v))
        .min_by(|&a, &b| positions[a].distance_squared(point).total_cmp(&positions[b].distance_squared(point)))
        .expect("a mesh has vertices") as u32
}

#[cfg(test)]
mod tests {
    use super::*;

    fn weights_of(distances: [f32; 2], reach: f32) -> (f32, f32, f32) {
        let w = shares(&distances.map(|g| wendland(g / reach)));
        (w[0], w[1], (1.0 - w[0] - w[1]).max(0.0))
    }

    #[test]
    fn shares_match_the_worked_numbers() {
        // Two points, reach 30 mm.
        let close = |got: (f32, f32, f32), expected: (f32, f32, f32)| {
            let difference = (got.0 - expected.0).abs().max((got.1 - expected.1).abs()).max((got.2 - expected.2).abs());
            assert!(difference < 1e-6, "{got:?} {expected:?}");
        };
        close(weights_of([0.0, 20.0], 30.0), (0.956_692_9, 0.043_307_09, 0.0));
        close(weights_of([10.0, 10.0], 30.0), (0.460_905_35, 0.460_905_35, 0.078_189_3));
        close(weights_of([20.0, 40.0], 30.0), (0.045_267_49, 0.0, 0.954_732_5));
    }

    #[test]
    fn wendland_matches_the_worked_numbers() {
        for (r, expected) in [(0.0, 1.0), (0.25, 0.632_812_5), (0.5, 0.1875), (0.75, 0.015_625), (1.0, 0.0)] {
            assert!((wendland(r) - expected).abs() < 1e-6);
        }
    }

    #[test]
    fn distance_goes_along_the_edges_not_through_the_gap() {
        // A U of five vertices, ends close to each other: 0-1-2-3-4.
        let edge = |a: u32, b: u32| (a, b, 1.0_f32);
        let mut graph = vec![Vec::new(); 5];
        for (a, b, length) in [edge(0, 1), edge(1, 2), edge(2, 3), edge(3, 4)] {
            graph[a as usize].push((b, length));
            graph[b as usize].push((a, length));
        }
        assert_eq!(distances(&graph, &[0], 10.0), [0.0, 1.0, 2.0, 3.0, 4.0]);
        assert_eq!(distances(&graph, &[0], 2.5)[3], f32::INFINITY);
    }
}
