//! Whatever comes in, nothing panics.

use crate::solve_fixture::{IMAGE, View, character, expression, hello, landmark_frame, landmarks, see, weight_frame};
use crate::solver;
use glam::Vec3;
use proptest::prelude::*;
use rhytid_server::solve::{SolveConfig, SolveError, Solver};
use rhytid_shared::layout::IBUG_MIRROR;
use rhytid_shared::{FaceFrame, TrackingData, TrackingFrame};

/// A view, how far each point is off in pixels, confidences, and whether the face may be lost.
type Shown = (View, Vec<[f32; 2]>, Vec<f32>, bool);

/// What a tracker may give: a face somewhere before the camera, each point off by some pixels, some of them unsure.
fn frames() -> impl Strategy<Value = Vec<Shown>> {
    let view = (-40.0..40.0, -40.0..40.0, -60.0..60.0, -0.2..0.2, -0.2..0.2, 0.3..2.0).prop_map(|(pitch, yaw, roll, x, y, z)| View {
        pitch,
        yaw,
        roll,
        place: [x, y, z],
        focal: 640.0,
    });
    let jitter = (0.0_f32..40.0, prop::collection::vec([-1.0_f32..1.0, -1.0_f32..1.0], 68))
        .prop_map(|(most, points)| points.into_iter().map(|p| p.map(|value| value * most)).collect());
    prop::collection::vec((view, jitter, prop::collection::vec(0.0_f32..=1.0, 68), any::<bool>()), 1..12)
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 96, ..ProptestConfig::default() })]

    #[test]
    fn any_landmarks_give_numbers_within_their_ranges(frames in frames(), steps in prop::collection::vec(1e-6..0.4_f64, 12), asks in 0_usize..12) {
        let character = character();
        let mut solver = solver(&character, None);
        let mut out = FaceFrame::at_rest(&character);
        let mut t = 0.0;
        for (i, (view, jitter, confidence, is_lost)) in frames.into_iter().enumerate() {
            t += steps[i];
            let points = see(&landmarks(), character.head_pivot, &view).iter().zip(&jitter).map(|(p, off)| [p[0] + off[0], p[1] + off[1], 0.0]).collect();
            let data = if is_lost && i % 3 == 2 { TrackingData::NoFace } else { TrackingData::Landmarks { points, confidence } };
            if i == asks {
                solver.calibrate();
            }
            if solver.solve(&TrackingFrame::new(t, data), &mut out).is_ok() {
                let falling = TrackingFrame::new(t - steps[i] * 0.5, TrackingData::NoFace);
                prop_assert!(matches!(solver.solve(&falling, &mut out), Err(SolveError::Time { .. })), "time does not fall");
            }
            for (point, bone) in out.points.iter().zip(&character.bones) {
                prop_assert!(point.is_finite() && point.distance(bone.rest) < 0.09, "{point}");
            }
            prop_assert!(out.influences.iter().all(|value| (0.0..=1.0).contains(value)), "{:?}", out.influences);
            prop_assert!(out.rotations.iter().all(|turn| (turn.length() - 1.0).abs() < 1e-4));
            prop_assert!((out.head.rotation.length() - 1.0).abs() < 1e-4 && out.head.position.is_finite());
        }
    }

    #[test]
    fn any_landmarks_mirrored_give_the_mirrored_face(brow in [0.0_f32..0.01, 0.0_f32..0.01], open in 0.0_f32..0.02, side in -0.006_f32..0.006, yaw in -20.0..20.0, pitch in -15.0..15.0) {
        let character = character();
        let (mut plain, mut mirrored) = (solver(&character, None), solver(&character, None));
        let (mut out, mut twin) = (FaceFrame::at_rest(&character), FaceFrame::at_rest(&character));
        let mut shown = expression(brow, open, 0.0, 0.0);
        shown[48].x += side;
        for i in 0..90 {
            let (points, view) = if i < 70 { (landmarks(), View::FRONT) } else { (shown, View { yaw, pitch, ..View::FRONT }) };
            let seen = see(&points, character.head_pivot, &view);
            let flipped = (0..68).map(|i| [IMAGE[0] - seen[IBUG_MIRROR[i]][0], seen[IBUG_MIRROR[i]][1], 0.0]).collect();
            let t = f64::from(i) / 30.0;
            plain.solve(&landmark_frame(t, seen), &mut out).expect("a good frame");
            mirrored.solve(&landmark_frame(t, flipped), &mut twin).expect("a good frame");
        }
        for (i, bone) in character.bones.iter().enumerate() {
            let other = match bone.name.rsplit_once('_') {
                Some((stem, "l")) => format!("{stem}_r"),
                Some((stem, "r")) => format!("{stem}_l"),
                _ => bone.name.clone(),
            };
            let other = character.bone_index(&other).expect("both sides are there");
            let want = out.points[i] * Vec3::new(-1.0, 1.0, 1.0);
            prop_assert!(twin.points[other].distance(want) < 2e-5, "{}: {} instead of {want}", bone.name, twin.points[other]);
        }
    }

    #[test]
    fn whatever_came_before_zero_weights_are_the_neutral(before in prop::collection::vec(0.0_f32..=1.2, rhytid_shared::NUM_ARKIT_SHAPES)) {
        let character = character();
        let mut solver = Solver::new(character.clone(), &SolveConfig::default(), &hello(None, None)).expect("a good session");
        let (mut out, rest) = (FaceFrame::at_rest(&character), FaceFrame::at_rest(&character));
        let weights = Box::new(std::array::from_fn(|i| before[i]));
        solver.solve(&TrackingFrame::new(0.0, TrackingData::Weights { weights, head: None }), &mut out).expect("a good frame");
        solver.solve(&weight_frame(1.0, &[]), &mut out).expect("a good frame");
        prop_assert_eq!((&out.points, &out.rotations, &out.influences), (&rest.points, &rest.rotations, &rest.influences));
    }
}
