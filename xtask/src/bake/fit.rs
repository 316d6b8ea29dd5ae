//! Refines the automatic rig's weights so that the bones, put where an expression shape carries them, move the skin as
//! the shape does: per vertex a non-negative least-squares fit over the shapes, held towards the automatic weights.

use super::mesh::Mesh;
use super::weights::shape;
use glam::Vec3;
use rhytid_shared::ARKIT_NAMES;

/// A bone as the fit sees it.
#[derive(Debug, Clone, Copy)]
pub enum Mover {
    /// Goes with a vertex of the skin; with `turns` it also turns about that vertex as the jaw does.
    Skin {
        /// The vertex.
        vertex: u32,
        /// True for lower lip and chin.
        turns: bool,
    },
    /// Turns about the hinge.
    Jaw {
        /// The hinge.
        pivot: Vec3,
    },
}

/// How firmly weights are held to the automatic rig's, as a sum of squared displacements, square metres. Tuned by eye.
const HOLD: f32 = 3.0e-5;
/// Sweeps of coordinate descent; the weights settle to a thousandth well before.
const NUM_SWEEPS: usize = 40;

/// The shapes that bones of the skin can follow: not the lids' and the gaze's, which turn, nor the tongue's.
pub fn fitted_shapes() -> Vec<usize> {
    let is_fitted = |name: &str| !["eyeBlink", "eyeLook", "eyeWide", "tongue"].iter().any(|start| name.starts_with(start));
    (0..ARKIT_NAMES.len()).filter(|&s| is_fitted(ARKIT_NAMES[s])).collect()
}

/// Weights of the vertex `v` over `movers`, none negative, summing to at most one. `prior` has a weight for each mover;
/// one of exactly 0 stays 0. `hold` multiplies how firmly weights are held to it.
pub fn fit(mesh: &Mesh, shapes: &[usize], jaw_open: f32, v: usize, movers: &[Mover], prior: &[f32], hold: f32) -> Vec<f32> {
    let active: Vec<usize> = (0..movers.len()).filter(|&b| prior[b] > 0.0).collect();
    let n = active.len();
    let (sin, cos) = libm::sincosf(jaw_open);
    let turn = |arm: Vec3| Vec3::new(arm.x, cos * arm.y - sin * arm.z, sin * arm.y + cos * arm.z) - arm;
    let (mut gram, mut target) = (vec![0.0_f32; n * n], vec![0.0_f32; n]);
    let mut columns = vec![Vec3::ZERO; n];
    for &s in shapes {
        let opens = s == shape("jawOpen");
        for (column, &b) in columns.iter_mut().zip(&active) {
            *column = match movers[b] {
                Mover::Skin { vertex, turns } => {
                    let carried = mesh.morphs[s][vertex as usize];
                    if turns && opens { carried + turn(mesh.positions[v] - mesh.positions[vertex as usize]) } else { carried }
                }
                Mover::Jaw { pivot } if opens => turn(mesh.positions[v] - pivot),
                Mover::Jaw { .. } => Vec3::ZERO,
            };
        }
        for i in 0..n {
            target[i] += columns[i].dot(mesh.morphs[s][v]);
            for j in 0..n {
                gram[i * n + j] += columns[i].dot(columns[j]);
            }
        }
    }
    let mut weights: Vec<f32> = active.iter().map(|&b| prior[b]).collect();
    for i in 0..n {
        gram[i * n + i] += HOLD * hold;
        target[i] += HOLD * hold * weights[i];
    }
    for _ in 0..NUM_SWEEPS {
        for i in 0..n {
            let pull: f32 = (0..n).filter(|&j| j != i).map(|j| gram[i * n + j] * weights[j]).sum();
            weights[i] = ((target[i] - pull) / gram[i * n + i]).max(0.0);
        }
    }
    let sum: f32 = weights.iter().sum::<f32>().max(1.0);
    let mut all = vec![0.0; movers.len()];
    for (&b, weight) in active.iter().zip(weights) {
        all[b] = weight / sum;
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bake::mesh::Mesh;
    use rhytid_shared::NUM_ARKIT_SHAPES;

    /// Three vertices; the third moves as 0.3 of the first and 0.5 of the second do.
    fn mixed() -> Mesh {
        let mut mesh = Mesh { positions: vec![Vec3::ZERO, Vec3::X * 0.01, Vec3::X * 0.005], ..Mesh::default() };
        mesh.morphs = (0..NUM_ARKIT_SHAPES)
            .map(|s| {
                let a = Vec3::new(libm::sinf(s as f32), libm::cosf(1.7 * s as f32), 0.2) * 0.02;
                let b = Vec3::new(0.3, libm::sinf(2.9 * s as f32), libm::cosf(s as f32)) * 0.02;
                vec![a, b, a * 0.3 + b * 0.5]
            })
            .collect();
        mesh
    }

    #[test]
    fn fit_finds_the_mixture_a_vertex_was_made_of() {
        let movers = [0, 1].map(|vertex| Mover::Skin { vertex, turns: false });
        let weights = fit(&mixed(), &fitted_shapes(), 0.36, 2, &movers, &[0.5, 0.3], 1.0);
        assert!((weights[0] - 0.3).abs() < 0.01 && (weights[1] - 0.5).abs() < 0.01, "{weights:?}");
    }

    #[test]
    fn a_bone_the_automatic_rig_forbids_stays_out() {
        let movers = [0, 1].map(|vertex| Mover::Skin { vertex, turns: false });
        assert_eq!(fit(&mixed(), &fitted_shapes(), 0.36, 2, &movers, &[0.5, 0.0], 1.0)[1], 0.0);
    }
}
