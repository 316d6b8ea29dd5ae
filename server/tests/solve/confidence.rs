//! Landmarks that the tracker does not believe.

use crate::solve_fixture::{View, character, expression, hello, influence, landmark_frame, landmarks, see};
use crate::{hold, largest, solver};
use rhytid_server::solve::{SolveConfig, Solver};
use rhytid_shared::layout::Layout;
use rhytid_shared::{FaceFrame, TrackingData, TrackingFrame};

#[test]
fn a_landmark_the_tracker_does_not_believe_stays_where_it_was() {
    let character = character();
    let mut solver = solver(&character, None);
    let mut out = FaceFrame::at_rest(&character);
    let t = hold(&mut solver, &mut out, &character, &landmarks(), &View::FRONT, 0.0, 2.5);
    let raised = see(&expression([0.010, 0.010], 0.0, 0.0, 0.0), character.head_pivot, &View::FRONT);
    let confidence = (0..68).map(|i| if (17..=21).contains(&i) { 0.1 } else { 0.9 }).collect();
    let data = TrackingData::Landmarks { points: raised, confidence };
    for i in 0..20 {
        solver.solve(&TrackingFrame::new(t + f64::from(i) / 30.0, data.clone()), &mut out).expect("a good frame");
    }
    assert!(influence(&character, &out, "stretch", "brow_mid_r") < 0.05);
    assert!(influence(&character, &out, "stretch", "brow_mid_l") > 0.8);
}

#[test]
fn a_landmark_never_believed_stays_where_the_restored_neutral_has_it() {
    let character = character();
    let mut first = solver(&character, None);
    let mut out = FaceFrame::at_rest(&character);
    hold(&mut first, &mut out, &character, &landmarks(), &View::FRONT, 0.0, 2.5);
    let kept = first.calibration().cloned().expect("reached");
    let mut solver =
        Solver::with_calibration(character.clone(), &SolveConfig::default(), &hello(Some(Layout::Ibug68), None), kept).expect("fits");
    let mut confidence = vec![1.0; 68];
    confidence[17..=26].fill(0.1);
    let points = see(&landmarks(), character.head_pivot, &View::FRONT);
    solver.solve(&TrackingFrame::new(0.0, TrackingData::Landmarks { points, confidence }), &mut out).expect("a good frame");
    assert!(largest(&out.influences) < 0.02, "{:?}", out.influences);
}

#[test]
fn landmarks_never_believed_are_no_part_of_a_first_neutral() {
    let character = character();
    let mut solver = solver(&character, None);
    let mut out = FaceFrame::at_rest(&character);
    let mut points = see(&landmarks(), character.head_pivot, &View::FRONT);
    for point in &mut points[17..=21] {
        point[1] += 60.0;
    }
    let mut confidence = vec![1.0; 68];
    confidence[17..=21].fill(0.1);
    for i in 0..100 {
        let data = TrackingData::Landmarks { points: points.clone(), confidence: confidence.clone() };
        solver.solve(&TrackingFrame::new(f64::from(i) / 30.0, data), &mut out).expect("a good frame");
        assert!(largest(&out.influences) < 0.05, "frame {i}");
    }
    let brow = solver.calibration().expect("reached").points[19];
    assert!((brow[1] - f64::from(landmarks()[19].y)).abs() < 0.002, "{brow:?}");
}

#[test]
fn a_bridge_alone_does_not_place_the_head() {
    // The only stable points that the tracker is sure of lie on one line, about which the head could turn unseen.
    let character = character();
    let mut solver = solver(&character, Some(640.0));
    let mut out = FaceFrame::at_rest(&character);
    let view = View { yaw: 12.0, ..View::FRONT };
    let t = hold(&mut solver, &mut out, &character, &landmarks(), &View::FRONT, 0.0, 3.0);
    let confidence: Vec<f32> = (0..68).map(|i| if (31..=47).contains(&i) { 0.1 } else { 0.9 }).collect();
    for i in 0..40 {
        let points = see(&landmarks(), character.head_pivot, &view)
            .iter()
            .map(|p| [p[0] + if i % 2 == 0 { 0.3 } else { -0.3 }, p[1], 0.0])
            .collect();
        let data = TrackingData::Landmarks { points, confidence: confidence.clone() };
        solver.solve(&TrackingFrame::new(t + f64::from(i) / 30.0, data), &mut out).expect("a good frame");
    }
    let yaw = out.head.rotation.to_scaled_axis().y.to_degrees();
    assert!((yaw - 12.0).abs() < 3.0, "{yaw}");
    assert!(largest(&out.influences) < 0.15, "{:?}", out.influences);
}

#[test]
fn landmarks_not_believed_are_no_part_of_the_neutral() {
    let character = character();
    let mut solver = solver(&character, None);
    let mut out = FaceFrame::at_rest(&character);
    let points = see(&landmarks(), character.head_pivot, &View::FRONT);
    let mut stray = points.clone();
    for point in &mut stray[17..=21] {
        point[1] += 60.0;
    }
    let mut confidence = vec![1.0; 68];
    confidence[17..=21].fill(0.1);
    solver.solve(&landmark_frame(0.0, points), &mut out).expect("a good frame");
    for i in 1..100 {
        let data = TrackingData::Landmarks { points: stray.clone(), confidence: confidence.clone() };
        solver.solve(&TrackingFrame::new(f64::from(i) / 30.0, data), &mut out).expect("a good frame");
    }
    let brow = solver.calibration().expect("reached").points[19];
    assert!((brow[1] - f64::from(landmarks()[19].y)).abs() < 0.002, "{brow:?}");
}
