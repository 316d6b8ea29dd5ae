//! The solve as its callers see it: sessions of frames in, face frames out.

mod any_input;
mod confidence;
mod continuity;
mod faces;
mod layouts;
mod neutral;
mod refusals;
#[path = "../solve_fixture/mod.rs"]
mod solve_fixture;
mod turns;

use glam::Vec3;
use rhytid_server::solve::{SolveConfig, Solver};
use rhytid_shared::layout::Layout;
use rhytid_shared::{Character, FaceFrame};
use solve_fixture::{View, hello, landmark_frame, see};
use std::sync::Arc;

fn solver(character: &Arc<Character>, focal: Option<f32>) -> Solver {
    Solver::new(character.clone(), &SolveConfig::default(), &hello(Some(Layout::Ibug68), focal)).expect("a good session")
}

/// Solves `points` seen through `view` for `seconds` from `t`, at 30 frames a second; gives the time after.
fn hold(solver: &mut Solver, out: &mut FaceFrame, character: &Character, points: &[Vec3], view: &View, t: f64, seconds: f64) -> f64 {
    let num = (seconds * 30.0).round() as usize;
    for i in 0..num {
        solver.solve(&landmark_frame(t + i as f64 / 30.0, see(points, character.head_pivot, view)), out).expect("a good frame");
    }
    t + num as f64 / 30.0
}

fn largest(influences: &[f32]) -> f32 {
    influences.iter().copied().fold(0.0, f32::max)
}
