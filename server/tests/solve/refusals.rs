//! What is refused, and that it leaves no trace.

use crate::solve_fixture::{View, character, hello, landmark_frame, landmarks, see};
use crate::{hold, largest, solver};
use glam::{Quat, Vec3};
use rhytid_server::solve::{SolveConfig, SolveError, Solver};
use rhytid_shared::layout::Layout;
use rhytid_shared::{FaceFrame, HeadPose, TrackingData, TrackingFrame};

#[test]
fn times_closer_than_the_packets_clock_are_refused_and_leave_no_trace() {
    let character = character();
    let mut solver = solver(&character, None);
    let mut out = FaceFrame::at_rest(&character);
    let good = see(&landmarks(), character.head_pivot, &View::FRONT);
    solver.solve(&landmark_frame(0.0, good.clone()), &mut out).expect("a good frame");
    for t in [5e-324, 1e-300, 9.9e-7] {
        assert_eq!(solver.solve(&landmark_frame(t, good.clone()), &mut out), Err(SolveError::Time { got: t, previous: 0.0 }));
    }
    hold(&mut solver, &mut out, &character, &landmarks(), &View::FRONT, 1e-6, 0.5);
    assert!(out.points.iter().all(|point| point.is_finite()) && largest(&out.influences) < 0.02);
}

#[test]
fn bad_frames_are_refused_and_count_for_nothing() {
    let character = character();
    let mut solver = solver(&character, None);
    let mut out = FaceFrame::at_rest(&character);
    let good = see(&landmarks(), character.head_pivot, &View::FRONT);
    solver.solve(&landmark_frame(1.0, good.clone()), &mut out).expect("a good frame");
    let before = out.clone();
    let mut refuse = |frame: TrackingFrame, want: &str| {
        let error = solver.solve(&frame, &mut out).expect_err(want).to_string();
        assert_eq!(error, want);
        assert_eq!(out, before, "{want}");
    };
    refuse(landmark_frame(1.0, good.clone()), "t is 1 s, expected a microsecond or more after the frame before it, 1 s");
    refuse(landmark_frame(1.0000001, good.clone()), "t is 1.0000001 s, expected a microsecond or more after the frame before it, 1 s");
    refuse(landmark_frame(0.5, good.clone()), "t is 0.5 s, expected a microsecond or more after the frame before it, 1 s");
    refuse(landmark_frame(f64::NAN, good.clone()), "t is NaN, expected seconds from 0 to 9e9");
    refuse(landmark_frame(-1.0, good.clone()), "t is -1, expected seconds from 0 to 9e9");
    refuse(landmark_frame(2.0, good[..67].to_vec()), "landmarks has 67 points, expected 68");
    let with = |value: f32| {
        let mut points = good.clone();
        points[5][1] = value;
        landmark_frame(2.0, points)
    };
    refuse(with(f32::NAN), "landmarks[5] is NaN, expected finite and within ten sizes of the picture");
    refuse(with(f32::INFINITY), "landmarks[5] is inf, expected finite and within ten sizes of the picture");
    refuse(with(1e6), "landmarks[5] is 1000000, expected finite and within ten sizes of the picture");
    refuse(
        landmark_frame(2.0, vec![[320.0, 240.0, 0.0]; 68]),
        "landmarks do not span a face: they lie in one place, expected a face of at least a few pixels",
    );
    let data = TrackingData::Landmarks { points: good.clone(), confidence: vec![0.5; 3] };
    refuse(TrackingFrame::new(2.0, data), "confidence has 3 entries, expected 68 or none");
    let data = TrackingData::Landmarks { points: good.clone(), confidence: vec![1.5; 68] };
    refuse(TrackingFrame::new(2.0, data), "confidence[0] is 1.5, expected finite and 0 to 1");
    let head = HeadPose { rotation: Quat::from_xyzw(0.0, 0.0, 0.0, 0.0), position: Vec3::ZERO };
    refuse(
        TrackingFrame::new(2.0, TrackingData::Bones { points: Vec::new(), head: Some(head) }),
        "head.rotation[0] is 0, expected finite and of length 1",
    );
    let mut weightless = Solver::new(character.clone(), &SolveConfig::default(), &hello(None, None)).expect("a good session");
    assert_eq!(weightless.solve(&landmark_frame(1.0, good.clone()), &mut out), Err(SolveError::NoLayout));
    solver.solve(&landmark_frame(1.1, good), &mut out).expect("the session goes on");
    assert_eq!(out.seq, 1);
}

#[test]
fn a_camera_without_a_picture_is_refused() {
    let character = character();
    let mut without = hello(Some(Layout::Ibug68), None);
    without.image = None;
    let error = Solver::new(character.clone(), &SolveConfig::default(), &without).err();
    assert_eq!(error, Some(SolveError::NoImage));
    let error = Solver::new(character, &SolveConfig::default(), &hello(Some(Layout::Ibug68), Some(-3.0))).err();
    assert_eq!(error.map(|error| error.to_string()).as_deref(), Some("hello.focal is -3, expected finite and more than 0"));
}

#[test]
fn a_focal_length_no_lens_has_is_refused() {
    let character = character();
    let start = |focal| Solver::new(character.clone(), &SolveConfig::default(), &hello(Some(Layout::Ibug68), Some(focal)));
    for focal in [60.0, 33_000.0, 1e5] {
        let error = start(focal).err().expect("refused").to_string();
        assert_eq!(error, format!("hello.focal is {focal}, expected 64 to 32000 pixels, a tenth to fifty times the picture's width"));
    }
    // Through the longest lens a face of a hundred pixels is still a face.
    let mut solver = start(32_000.0).expect("a good session");
    let mut out = FaceFrame::at_rest(&character);
    let view = View { focal: 32_000.0, place: [0.0, 0.0, 29.0], ..View::FRONT };
    hold(&mut solver, &mut out, &character, &landmarks(), &view, 0.0, 0.5);
    assert!(largest(&out.influences) < 0.05);
    // Through the widest a face can come so near that it would reach behind the camera.
    let mut solver = start(64.0).expect("a good session");
    let huge =
        see(&landmarks(), character.head_pivot, &View::FRONT).iter().map(|p| [p[0] * 9.0 - 2560.0, p[1] * 9.0 - 1920.0, 0.0]).collect();
    let error = solver.solve(&landmark_frame(0.0, huge), &mut out).expect_err("refused").to_string();
    assert_eq!(error, "landmarks do not span a face: they are so large that the head would reach behind the camera");
}
