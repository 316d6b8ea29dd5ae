//! The neutral face: how it is found, asked for, kept and refused.

use crate::solve_fixture::{View, character, expression, feed, hello, influence, landmarks, weight_frame};
use crate::{hold, largest, solver};
use rhytid_server::pipeline::Pipeline;
use rhytid_server::solve::{SolveConfig, Solver};
use rhytid_shared::layout::Layout;
use rhytid_shared::{FaceFrame, TrackingData, TrackingFrame};

#[test]
fn another_neutral_is_taken_at_once_and_blended_in() {
    let character = character();
    let mut solver = solver(&character, None);
    let mut out = FaceFrame::at_rest(&character);
    let mut t = hold(&mut solver, &mut out, &character, &landmarks(), &View::FRONT, 0.0, 3.0);
    assert!(solver.take_calibrated().is_some_and(|report| !report.requested && report.t <= 2.1));
    assert!(solver.take_calibrated().is_none(), "told once");
    let raised = expression([0.008, 0.008], 0.0, 0.0, 0.0);
    t = hold(&mut solver, &mut out, &character, &raised, &View::FRONT, t, 1.0);
    let before = influence(&character, &out, "stretch", "brow_mid_r");
    assert!(before > 0.6, "{before}");
    solver.calibrate();
    let report = solver.take_calibrated().expect("the last moments are there");
    assert!(report.requested && report.num_frames >= 3, "{report:?}");
    let mut last = before;
    for frame in 0..20 {
        t = hold(&mut solver, &mut out, &character, &raised, &View::FRONT, t, 1.0 / 30.0);
        let now = influence(&character, &out, "stretch", "brow_mid_r");
        assert!((now - last).abs() < 0.12, "frame {frame}: {last} to {now}");
        last = now;
    }
    assert!(last < 0.02, "raised is neutral now: {last}");
}

#[test]
fn asking_before_the_first_face_is_answered_by_the_first_faces() {
    let character = character();
    let mut solver = solver(&character, None);
    let mut out = FaceFrame::at_rest(&character);
    solver.calibrate();
    assert!(solver.take_calibrated().is_none());
    let t = hold(&mut solver, &mut out, &character, &landmarks(), &View::FRONT, 0.0, 0.2);
    assert!(solver.take_calibrated().is_none(), "one frame makes no neutral");
    hold(&mut solver, &mut out, &character, &landmarks(), &View::FRONT, t, 0.4);
    assert!(solver.take_calibrated().is_some_and(|report| report.requested && report.num_frames > 3));
}

#[test]
fn a_neutral_asked_for_while_the_face_is_away_is_taken_from_several_frames() {
    let character = character();
    let mut solver = solver(&character, None);
    let mut out = FaceFrame::at_rest(&character);
    let t = hold(&mut solver, &mut out, &character, &landmarks(), &View::FRONT, 0.0, 3.0);
    assert!(solver.take_calibrated().is_some());
    for frame in 0..30 {
        solver.solve(&TrackingFrame::new(t + f64::from(frame) / 30.0, TrackingData::NoFace), &mut out).expect("a good frame");
    }
    solver.calibrate();
    assert!(solver.take_calibrated().is_none());
    hold(&mut solver, &mut out, &character, &landmarks(), &View::FRONT, t + 5.0, 1.0);
    let report = solver.take_calibrated().expect("answered once the face is back");
    assert!(report.requested && report.num_frames > 3, "{report:?}");
}

#[test]
fn asking_before_the_first_frame_is_answered_whatever_comes() {
    // The hello names a layout, and then come weights.
    let character = character();
    let mut out = FaceFrame::at_rest(&character);
    let mut weights = solver(&character, None);
    weights.calibrate();
    weights.solve(&weight_frame(0.0, &[("jawOpen", 0.2)]), &mut out).expect("a good frame");
    assert!(weights.take_calibrated().is_some_and(|report| report.requested));
    hold(&mut weights, &mut out, &character, &landmarks(), &View::FRONT, 1.0, 1.0);
    assert!(weights.take_calibrated().is_none_or(|report| !report.requested), "answered once");

    // Landmarks were on their way to an answer when the sender changed over.
    let mut changing = solver(&character, None);
    changing.calibrate();
    let t = hold(&mut changing, &mut out, &character, &landmarks(), &View::FRONT, 0.0, 0.1);
    assert!(changing.take_calibrated().is_none());
    changing.solve(&weight_frame(t + 0.1, &[]), &mut out).expect("a good frame");
    assert!(changing.take_calibrated().is_some_and(|report| report.requested));
}

#[test]
fn refinements_of_a_neutral_that_was_asked_for_are_not_told() {
    let character = character();
    let mut solver = solver(&character, None);
    let mut out = FaceFrame::at_rest(&character);
    let t = hold(&mut solver, &mut out, &character, &landmarks(), &View::FRONT, 0.0, 3.0);
    solver.calibrate();
    assert!(solver.take_calibrated().is_some_and(|report| report.requested));
    hold(&mut solver, &mut out, &character, &landmarks(), &View::FRONT, t, 9.0);
    assert_eq!(solver.take_calibrated(), None, "nobody asked again");
}

#[test]
fn a_long_absence_does_not_use_up_the_looks_at_the_neutral() {
    let character = character();
    let mut solver = solver(&character, None);
    let mut out = FaceFrame::at_rest(&character);
    let smile = expression([0.0; 2], 0.004, 0.008, 0.0);
    let t = hold(&mut solver, &mut out, &character, &smile, &View::FRONT, 0.0, 3.0);
    solver.solve(&TrackingFrame::new(t, TrackingData::NoFace), &mut out).expect("a good frame");
    hold(&mut solver, &mut out, &character, &landmarks(), &View::FRONT, 200.0, 20.0);
    assert!(largest(&out.influences) < 0.05, "the calm face is at rest: {:?}", out.influences);
}

#[test]
fn another_performer_who_sits_down_can_ask_for_a_neutral() {
    let character = character();
    let mut solver = solver(&character, None);
    let mut out = FaceFrame::at_rest(&character);
    let t = hold(&mut solver, &mut out, &character, &landmarks(), &View::FRONT, 0.0, 3.0);
    assert!(solver.take_calibrated().is_some());
    // A far longer nose: no pose of the first performer's head fits.
    let mut other = landmarks();
    for point in &mut other[28..=35] {
        point.y *= 1.9;
    }
    let t = hold(&mut solver, &mut out, &character, &other, &View::FRONT, t, 3.0);
    solver.calibrate();
    let t = hold(&mut solver, &mut out, &character, &other, &View::FRONT, t, 1.5);
    assert!(solver.take_calibrated().is_some_and(|report| report.requested));
    hold(&mut solver, &mut out, &character, &other, &View::FRONT, t, 1.0);
    assert!(largest(&out.influences) < 0.02, "{:?}", out.influences);
}

#[test]
fn a_session_that_begins_with_a_smile_finds_the_neutral_later() {
    let character = character();
    let mut solver = solver(&character, None);
    let mut out = FaceFrame::at_rest(&character);
    let smile = expression([0.0; 2], 0.004, 0.008, 0.0);
    let mut t = hold(&mut solver, &mut out, &character, &smile, &View::FRONT, 0.0, 3.0);
    t = hold(&mut solver, &mut out, &character, &landmarks(), &View::FRONT, t, 3.0);
    t = hold(&mut solver, &mut out, &character, &landmarks(), &View::FRONT, t, 0.6);
    assert!(largest(&out.influences) < 0.05, "the calm face is at rest: {:?}", out.influences);
    hold(&mut solver, &mut out, &character, &smile, &View::FRONT, t, 1.0);
    assert!(influence(&character, &out, "smile", "lip_corner_l") > 0.5);
}

#[test]
fn a_part_of_a_session_is_replayed_with_the_neutral_it_had() {
    let character = character();
    let hello = hello(Some(Layout::Ibug68), None);
    let config = SolveConfig::default();
    let frames = feed(&character, 900);
    let mut whole = Pipeline::new(character.clone(), &config, &hello, 1).expect("a good session");
    let (mut packet, mut faces) = (Vec::new(), Vec::new());
    for frame in &frames {
        whole.frame(frame, &mut packet).expect("a good frame");
        faces.push(whole.face().clone());
    }
    // From a second before the part on, so that the filters have forgotten where they began.
    let calibration = whole.calibration().cloned().expect("reached");
    let mut part = Pipeline::with_calibration(character.clone(), &config, &hello, 1, calibration.clone()).expect("it fits");
    for (i, frame) in frames.iter().enumerate().skip(700) {
        part.frame(frame, &mut packet).expect("a good frame");
        if i >= 760 {
            let off = part.face().points.iter().zip(&faces[i].points).map(|(a, b)| a.distance(*b)).fold(0.0, f32::max);
            assert!(off < 1e-5, "frame {i}: {off}");
        }
    }
    assert_eq!(part.calibration(), Some(&calibration));
}

#[test]
fn a_damaged_calibration_is_refused() {
    let character = character();
    let mut solver = solver(&character, None);
    let mut out = FaceFrame::at_rest(&character);
    hold(&mut solver, &mut out, &character, &landmarks(), &View::FRONT, 0.0, 2.5);
    let good = solver.calibration().cloned().expect("reached");
    let refusal = |damage: &dyn Fn(&mut rhytid_server::solve::Calibration)| {
        let mut calibration = good.clone();
        damage(&mut calibration);
        let result = Solver::with_calibration(character.clone(), &SolveConfig::default(), &hello(Some(Layout::Ibug68), None), calibration);
        result.err().expect("refused").to_string()
    };
    assert!(refusal(&|kept| kept.points[3][0] = f64::NAN).contains("not finite"));
    assert!(refusal(&|kept| kept.points[3][1] = 1e300).contains("points[3]"));
    assert!(refusal(&|kept| kept.head_position = [0.0; 3]).contains("before the camera"));
    assert!(refusal(&|kept| kept.head_rotation = [0.0; 4]).contains("rotation"));
}

#[test]
fn a_calibration_of_another_layout_is_refused() {
    let character = character();
    let mut solver = solver(&character, None);
    let mut out = FaceFrame::at_rest(&character);
    hold(&mut solver, &mut out, &character, &landmarks(), &View::FRONT, 0.0, 2.5);
    let mut calibration = solver.calibration().cloned().expect("reached");
    calibration.points.pop();
    let result = Solver::with_calibration(character.clone(), &SolveConfig::default(), &hello(Some(Layout::Ibug68), None), calibration);
    let error = result.err().expect("refused");
    assert_eq!(error.to_string(), "calibration has 67 points, expected 68");
}
