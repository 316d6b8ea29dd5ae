//! A head that turns shows no wrinkles.

use crate::solve_fixture::{View, character, expression, landmark_frame, landmarks, rotation, see};
use crate::{hold, largest, solver};
use glam::Quat;
use rhytid_shared::FaceFrame;

/// Pitch and yaw, degrees.
const STRAIGHT: [(f64, f64); 4] = [(0.0, 25.0), (0.0, -25.0), (25.0, 0.0), (-25.0, 0.0)];

const SLANTED: [(f64, f64); 4] = [(25.0, 25.0), (-25.0, 25.0), (-25.0, -25.0), (25.0, -25.0)];

/// Largest influence over turns of the head, after calibration from the front through a camera of `true_focal`.
fn largest_over_turns(true_focal: f64, told: Option<f32>, is_explicit: bool, turns: &[(f64, f64)]) -> f32 {
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
    for &(pitch, yaw) in turns {
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
    for turns in [STRAIGHT, SLANTED] {
        for is_explicit in [true, false] {
            let told = largest_over_turns(640.0, Some(640.0), is_explicit, &turns);
            assert!(told <= 0.05, "focal given: {told}");
            let assumed = largest_over_turns(640.0, None, is_explicit, &turns);
            assert!(assumed <= 0.05, "focal as assumed: {assumed}");
        }
    }
}

#[test]
fn turning_the_head_wrinkles_little_through_an_unknown_lens() {
    for factor in [0.8, 1.3] {
        for (turns, most) in [(STRAIGHT, 0.15), (SLANTED, 0.2)] {
            let told = largest_over_turns(640.0 * factor, Some(640.0 * factor as f32), true, &turns);
            assert!(told <= 0.05, "focal {factor} of the width, given: {told}");
            let unknown = largest_over_turns(640.0 * factor, None, true, &turns);
            assert!(unknown <= most, "focal {factor} of the width, not given: {unknown}");
        }
    }
}

/// Largest influence while the head turns on which mouth and chin lie 8 mm deeper than the character's.
fn largest_with_a_deep_mouth(turns: &[(f64, f64)]) -> f32 {
    let character = character();
    let mut solver = solver(&character, Some(640.0));
    let mut out = FaceFrame::at_rest(&character);
    let mut deep = landmarks();
    for i in (6..=10).chain(48..=67) {
        deep[i].z -= 0.008;
    }
    let mut t = hold(&mut solver, &mut out, &character, &deep, &View::FRONT, 0.0, 3.0);
    let mut worst = 0.0_f32;
    for &(pitch, yaw) in turns {
        for step in 1..=20 {
            let share = f64::from(step) / 20.0;
            let view = View { pitch: pitch * share, yaw: yaw * share, ..View::FRONT };
            t = hold(&mut solver, &mut out, &character, &deep, &view, t, 1.0 / 30.0);
            worst = worst.max(largest(&out.influences));
        }
    }
    worst
}

#[test]
fn turning_a_head_with_a_deeper_mouth_wrinkles_little() {
    for turn in STRAIGHT {
        // Taken for the character's own depth, their slide of 3.6 mm gives an influence of 1.
        let worst = largest_with_a_deep_mouth(&[turn]);
        assert!(worst < 0.16, "{turn:?}: {worst}");
    }
}

#[test]
fn a_mouth_that_opens_on_a_turned_head_still_opens() {
    let character = character();
    let mut solver = solver(&character, Some(640.0));
    let mut out = FaceFrame::at_rest(&character);
    let t = hold(&mut solver, &mut out, &character, &landmarks(), &View::FRONT, 0.0, 3.0);
    let jaw = character.bone_index("jaw").expect("a jaw");
    let open = expression([0.0; 2], 0.015, 0.0, 0.0);
    let mut t = hold(&mut solver, &mut out, &character, &open, &View::FRONT, t, 1.0);
    let straight = out.rotations[jaw].to_scaled_axis().x;
    for (view, least) in [(View { yaw: 20.0, ..View::FRONT }, 0.95), (View { pitch: 6.0, ..View::FRONT }, 0.85)] {
        t = hold(&mut solver, &mut out, &character, &open, &view, t, 1.0);
        let turned = out.rotations[jaw].to_scaled_axis().x;
        assert!(turned > least * straight, "{view:?}: {turned} of {straight}");
    }
}
