//! The solve as its callers see it: sessions of frames in, face frames out.

mod solve_fixture;

use glam::{Quat, Vec3};
use rhytid_server::solve::{SolveConfig, SolveError, Solver};
use rhytid_shared::layout::{IBUG_FROM_MEDIAPIPE, IBUG_FROM_OPENSEEFACE, IBUG_MIRROR, Layout};
use rhytid_shared::{Character, FaceFrame, HeadPose, TrackingData, TrackingFrame};
use solve_fixture::*;
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

/// Largest influence over head turns of 25 degrees, after calibration from the front through a camera of `true_focal`.
fn largest_over_turns(true_focal: f64, told: Option<f32>, is_explicit: bool) -> f32 {
    let character = character();
    let mut solver = solver(&character, told);
    let mut out = FaceFrame::at_rest(&character);
    let place = [0.02, 0.03, 0.65 * true_focal / 640.0];
    let front = View { focal: true_focal, place, ..View::FRONT };
    let neutral = landmarks();
    let mut t = hold(&mut solver, &mut out, &character, &neutral, &front, 0.0, if is_explicit { 0.2 } else { 3.0 });
    if is_explicit {
        solver.calibrate();
    }
    assert!(solver.take_calibrated().is_some());
    t = hold(&mut solver, &mut out, &character, &neutral, &front, t, 1.0);
    assert!(largest(&out.influences) < 0.01, "the neutral itself is calm");
    let mut worst = 0.0_f32;
    for (pitch, yaw) in [(0.0, 25.0), (0.0, -25.0), (25.0, 0.0), (-25.0, 0.0), (25.0, 25.0), (-25.0, 25.0), (-25.0, -25.0), (25.0, -25.0)] {
        for step in 1..=10 {
            let share = f64::from(step) / 10.0;
            let view = View { pitch: pitch * share, yaw: yaw * share, ..front };
            solver.solve(&landmark_frame(t, see(&neutral, character.head_pivot, &view)), &mut out).expect("a good frame");
            t += 1.0 / 30.0;
            worst = worst.max(largest(&out.influences));
        }
        // The head follows; it is smoothed, so give it a moment.
        let view = View { pitch, yaw, ..front };
        t = hold(&mut solver, &mut out, &character, &neutral, &view, t, 0.7);
        worst = worst.max(largest(&out.influences));
        let want = Quat::from_mat3(&rotation(&view).as_mat3());
        let most = if told.is_some() { 0.02 } else { 0.12 };
        assert!(out.head.rotation.angle_between(want) < most, "{pitch} {yaw}: {} instead of {want}", out.head.rotation);
    }
    worst
}

#[test]
fn turning_the_head_wrinkles_nothing() {
    for is_explicit in [true, false] {
        let told = largest_over_turns(640.0, Some(640.0), is_explicit);
        assert!(told <= 0.05, "focal given: {told}");
        let assumed = largest_over_turns(640.0, None, is_explicit);
        assert!(assumed <= 0.05, "focal as assumed: {assumed}");
    }
}

#[test]
fn turning_the_head_wrinkles_little_through_an_unknown_lens() {
    for factor in [0.8, 1.3] {
        let told = largest_over_turns(640.0 * factor, Some(640.0 * factor as f32), true);
        assert!(told <= 0.05, "focal {factor} of the width, given: {told}");
        let unknown = largest_over_turns(640.0 * factor, None, true);
        assert!(unknown <= 0.15, "focal {factor} of the width, not given: {unknown}");
        println!("focal {factor}: {told} {unknown}");
    }
}
