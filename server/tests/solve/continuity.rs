//! From one face to the next: lost faces, other sources, the same bits again.

use crate::solve_fixture::{View, character, expression, feed, hello, influence, landmark_frame, landmarks, see, weight_frame};
use crate::{hold, largest, solver};
use glam::Vec3;
use rhytid_server::solve::{SolveConfig, Solver};
use rhytid_shared::layout::Layout;
use rhytid_shared::{FaceFrame, TrackingData, TrackingFrame};

#[test]
fn a_lost_face_is_held_eased_and_comes_back_without_a_jump() {
    let character = character();
    let mut solver = solver(&character, None);
    let mut out = FaceFrame::at_rest(&character);
    solver.solve(&TrackingFrame::new(0.0, TrackingData::NoFace), &mut out).expect("a good frame");
    assert!(!out.face && largest(&out.influences) == 0.0, "no face yet");
    let raised = expression([0.010, 0.010], 0.0, 0.0, 0.0);
    let mut t = hold(&mut solver, &mut out, &character, &landmarks(), &View::FRONT, 0.1, 2.5);
    t = hold(&mut solver, &mut out, &character, &raised, &View::FRONT, t, 1.5);
    let shown = influence(&character, &out, "stretch", "brow_mid_r");
    assert!(out.face && shown > 0.8);
    let lost_at = t;
    let mut before = shown;
    for _ in 0..30 {
        solver.solve(&TrackingFrame::new(t, TrackingData::NoFace), &mut out).expect("a good frame");
        let now = influence(&character, &out, "stretch", "brow_mid_r");
        let since = t - lost_at;
        assert!(!out.face);
        if since < 0.249 {
            assert_eq!(now, shown, "held for a quarter of a second, {since}");
        } else if since > 0.751 {
            assert_eq!(now, 0.0, "at rest after three quarters, {since}");
        }
        assert!(before - now < 0.15, "eased");
        before = now;
        t += 1.0 / 30.0;
    }
    let mut before = out.points.clone();
    for _ in 0..30 {
        t = hold(&mut solver, &mut out, &character, &raised, &View::FRONT, t, 1.0 / 30.0);
        let jump = out.points.iter().zip(&before).map(|(a, b)| a.distance(*b)).fold(0.0, f32::max);
        assert!(out.face && jump < 0.0025, "{jump}");
        before.clone_from(&out.points);
    }
    assert!((influence(&character, &out, "stretch", "brow_mid_r") - shown).abs() < 0.03);
}

#[test]
fn another_source_is_blended_in() {
    let character = character();
    let jaw = character.bone_index("jaw").expect("a jaw");
    let placed = |t: f64| {
        let at = character.bones[jaw].rest + Vec3::new(0.0, -0.018, -0.012);
        TrackingFrame::new(t, TrackingData::Bones { points: vec![(jaw, at)], head: None })
    };
    let smile = see(&expression([0.0; 2], 0.0, 0.008, 0.0), character.head_pivot, &View { yaw: 10.0, ..View::FRONT });
    let frame_of = |source: usize, t: f64| match source {
        0 => landmark_frame(t, smile.clone()),
        1 => weight_frame(t, &[("jawOpen", 0.8), ("mouthSmileLeft", 0.5), ("eyeLookOutLeft", 0.5)]),
        _ => placed(t),
    };
    for (from, to) in [(0, 1), (1, 0), (0, 2), (2, 0), (1, 2), (2, 1)] {
        for is_lost_between in [false, true] {
            let mut solver = solver(&character, None);
            let mut out = FaceFrame::at_rest(&character);
            let mut t = hold(&mut solver, &mut out, &character, &landmarks(), &View::FRONT, 0.0, 3.0);
            let mut worst = (0.0_f32, 0.0_f32, 0.0_f32);
            let (mut num, mut farthest) = (0, 0.0_f32);
            let mut run = |source: Option<usize>, frames: usize, is_watched: bool| {
                for _ in 0..frames {
                    let before = out.clone();
                    let frame = source.map_or(TrackingFrame::new(t, TrackingData::NoFace), |source| frame_of(source, t));
                    solver.solve(&frame, &mut out).expect("a good frame");
                    t += 1.0 / 30.0;
                    if is_watched {
                        num += 1;
                        farthest = farthest.max(out.points[jaw].distance(character.bones[jaw].rest));
                        worst.0 = out.points.iter().zip(&before.points).map(|(a, b)| a.distance(*b)).fold(worst.0, f32::max);
                        worst.1 = out.rotations.iter().zip(&before.rotations).map(|(a, b)| a.angle_between(*b)).fold(worst.1, f32::max);
                        let shapes = |face: &FaceFrame| face.shapes.unwrap_or([0.0; rhytid_shared::NUM_ARKIT_SHAPES]);
                        worst.2 = shapes(&out).iter().zip(shapes(&before)).map(|(a, b)| (a - b).abs()).fold(worst.2, f32::max);
                    }
                }
            };
            run(Some(from), 60, false);
            if is_lost_between {
                run(None, 12, true);
            }
            run(Some(to), 40, true);
            // Half a second for at most 22 mm, half a radian and a weight of 0.8: an even blend takes 1.5 times its mean step at most.
            assert!(num >= 40 && worst.0 < 0.0035 && worst.1 < 0.1 && worst.2 < 0.13, "{from} to {to}: {worst:?}");
            assert!((to == 0) || farthest > 0.01, "{from} to {to}: it arrives");
        }
    }
}

#[test]
fn the_same_feed_gives_the_same_bits() {
    let character = character();
    let run = || {
        let mut solver = solver(&character, None);
        let mut out = FaceFrame::at_rest(&character);
        let mut all = Vec::new();
        for frame in feed(&character, 400) {
            solver.solve(&frame, &mut out).expect("a good frame");
            all.push(out.clone());
        }
        (all, solver.calibration().cloned().expect("reached"))
    };
    let ((first, calibration), (second, again)) = (run(), run());
    assert_eq!(first, second);
    assert_eq!(calibration, again);

    // Kept as JSON and restored, the neutral serves from the first frame on.
    let text = serde_json::to_string(&calibration).expect("plain data");
    let kept = serde_json::from_str(&text).expect("its own words");
    let mut restored =
        Solver::with_calibration(character.clone(), &SolveConfig::default(), &hello(Some(Layout::Ibug68), None), kept).expect("fits");
    let mut out = FaceFrame::at_rest(&character);
    restored.solve(&feed(&character, 1)[0], &mut out).expect("a good frame");
    assert!(largest(&out.influences) < 0.02);
    assert_eq!(restored.calibration(), Some(&calibration));
}
