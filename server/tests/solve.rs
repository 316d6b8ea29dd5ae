//! The solve as its callers see it: sessions of frames in, face frames out.

mod solve_fixture;

use glam::{Quat, Vec3};
use rhytid_server::solve::{SolveConfig, SolveError, Solver};
use rhytid_shared::character::Corrective;
use rhytid_shared::layout::{IBUG_FROM_MEDIAPIPE, IBUG_FROM_OPENSEEFACE, IBUG_MIRROR, Layout};
use rhytid_shared::{ArkitShape, Character, FaceFrame, HeadPose, TrackingData, TrackingFrame};
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

#[test]
fn one_raised_brow_wrinkles_its_own_side() {
    let character = character();
    let mut solver = solver(&character, None);
    let mut out = FaceFrame::at_rest(&character);
    let t = hold(&mut solver, &mut out, &character, &landmarks(), &View::FRONT, 0.0, 2.5);
    let view = View { yaw: 8.0, ..View::FRONT };
    hold(&mut solver, &mut out, &character, &expression([0.010, 0.0], 0.0, 0.0, 0.0), &view, t, 1.0);
    for (bone, want) in [("brow_inner_r", 1.0), ("brow_mid_r", 1.0), ("brow_outer_r", 1.0)] {
        assert!(influence(&character, &out, "stretch", bone) > 0.9 * want, "{bone}");
    }
    for bone in ["brow_inner_l", "brow_mid_l", "brow_outer_l"] {
        assert!(influence(&character, &out, "stretch", bone) < 0.05, "{bone}");
    }
    assert!(largest(&out.influences[character.num_bones()..]) < 0.05, "no other pose shows");
}

#[test]
fn a_mouth_that_opens_turns_the_jaw_as_far() {
    let character = character();
    let mut solver = solver(&character, None);
    let mut out = FaceFrame::at_rest(&character);
    let t = hold(&mut solver, &mut out, &character, &landmarks(), &View::FRONT, 0.0, 2.5);
    hold(&mut solver, &mut out, &character, &expression([0.0; 2], 0.015, 0.0, 0.0), &View::FRONT, t, 1.0);
    let jaw = character.bone_index("jaw").expect("a jaw");
    let fall = character.bones[jaw].rest.y - out.points[jaw].y;
    assert!((fall - 0.015).abs() < 0.001, "{fall}");
    let chin = character.bone_index("chin").expect("a chin");
    assert_eq!(out.rotations[chin], out.rotations[jaw], "the chin turns with the jaw");
    assert!(out.rotations[jaw].x > 0.05, "{}", out.rotations[jaw]);
}

#[test]
fn mirrored_input_gives_mirrored_output() {
    let character = character();
    let (mut plain, mut mirrored) = (solver(&character, None), solver(&character, None));
    let (mut out, mut twin) = (FaceFrame::at_rest(&character), FaceFrame::at_rest(&character));
    let partner: Vec<usize> = character
        .bones
        .iter()
        .map(|bone| {
            let other = match bone.name.rsplit_once('_') {
                Some((stem, "l")) => format!("{stem}_r"),
                Some((stem, "r")) => format!("{stem}_l"),
                _ => bone.name.clone(),
            };
            character.bone_index(&other).expect("both sides are there")
        })
        .collect();
    let mut largest_motion = 0.0_f32;
    for frame in feed(&character, 240) {
        plain.solve(&frame, &mut out).expect("a good frame");
        let TrackingData::Landmarks { points, .. } = &frame.data else { panic!("landmarks") };
        let flipped = (0..points.len()).map(|i| [IMAGE[0] - points[IBUG_MIRROR[i]][0], points[IBUG_MIRROR[i]][1], 0.0]).collect();
        mirrored.solve(&landmark_frame(frame.t, flipped), &mut twin).expect("a good frame");
        for (i, &other) in partner.iter().enumerate() {
            let want = out.points[i] * Vec3::new(-1.0, 1.0, 1.0);
            assert!(twin.points[other].distance(want) < 2e-5, "{}: {} instead of {want}", character.bones[i].name, twin.points[other]);
            largest_motion = largest_motion.max(out.points[i].distance(character.bones[i].rest));
        }
    }
    assert!(largest_motion > 0.005, "the feed moves: {largest_motion}");

    // The setting does the same to a mirrored picture.
    let config = SolveConfig { mirror: true, ..SolveConfig::default() };
    let mut set_right = Solver::new(character.clone(), &config, &hello(Some(Layout::Ibug68), None)).expect("a good session");
    let mut plain = solver(&character, None);
    for frame in feed(&character, 120) {
        let TrackingData::Landmarks { points, .. } = &frame.data else { panic!("landmarks") };
        let flipped = (0..points.len()).map(|i| [IMAGE[0] - points[IBUG_MIRROR[i]][0], points[IBUG_MIRROR[i]][1], 0.0]).collect();
        plain.solve(&frame, &mut out).expect("a good frame");
        set_right.solve(&landmark_frame(frame.t, flipped), &mut twin).expect("a good frame");
        for i in 0..partner.len() {
            assert!(twin.points[i].distance(out.points[i]) < 2e-5, "{}", character.bones[i].name);
        }
    }
}

#[test]
fn zero_weights_give_the_neutral_and_single_shapes_are_exact() {
    let character = character();
    let mut solver = Solver::new(character.clone(), &SolveConfig::default(), &hello(None, None)).expect("a good session");
    let mut out = FaceFrame::at_rest(&character);
    solver.solve(&weight_frame(0.0, &[]), &mut out).expect("a good frame");
    let rest = FaceFrame::at_rest(&character);
    assert_eq!((&out.points, &out.rotations, &out.influences), (&rest.points, &rest.rotations, &rest.influences));

    solver.solve(&weight_frame(10.0, &[("mouthSmileLeft", 1.0)]), &mut out).expect("a good frame");
    assert!((influence(&character, &out, "smile", "lip_corner_l") - 1.0).abs() < 1e-5);
    assert_eq!(influence(&character, &out, "smile", "lip_corner_r"), 0.0);
    assert_eq!(out.shapes.expect("passed on")[ArkitShape::from_name("mouthSmileLeft").expect("ARKit's").index()], 1.0);

    solver.solve(&weight_frame(20.0, &[("eyeBlinkLeft", 1.0)]), &mut out).expect("a good frame");
    let (left, right) = (character.bone_index("lid_upper_l").expect("a lid"), character.bone_index("lid_upper_r").expect("a lid"));
    assert!((out.rotations[left].to_scaled_axis().x - 0.7).abs() < 1e-5, "shut: {}", out.rotations[left]);
    assert_eq!(out.rotations[right], Quat::IDENTITY, "a wink is one eye");

    solver.solve(&weight_frame(30.0, &[("eyeLookOutLeft", 1.0), ("eyeLookInRight", 1.0)]), &mut out).expect("a good frame");
    for eye in ["eye_l", "eye_r"] {
        let turn = out.rotations[character.bone_index(eye).expect("an eye")].to_scaled_axis();
        assert!((turn.y - 0.6).abs() < 1e-5, "{eye} looks to the left: {turn}");
    }
}

#[test]
fn blinks_shut_the_lids_of_sleepy_eyes() {
    let character = character();
    let mut solver = solver(&character, None);
    let mut out = FaceFrame::at_rest(&character);
    let sleepy = expression([0.0; 2], 0.0, 0.0, 0.5);
    let t = hold(&mut solver, &mut out, &character, &sleepy, &View::FRONT, 0.0, 2.5);
    let lid = character.bone_index("lid_upper_r").expect("a lid");
    let at_rest = out.rotations[lid].to_scaled_axis().x;
    assert!(at_rest > 0.1 && at_rest < 0.55, "half closed is shown half closed: {at_rest}");
    hold(&mut solver, &mut out, &character, &expression([0.0; 2], 0.0, 0.0, 0.95), &View::FRONT, t, 0.2);
    assert!((out.rotations[lid].to_scaled_axis().x - 0.7).abs() < 0.01, "{}", out.rotations[lid]);
}

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

#[test]
fn other_layouts_give_the_same_face() {
    let character = character();
    let spread = |points: &[[f32; 3]], table: &[usize; 68], num: usize| {
        let mut wide = vec![[IMAGE[0] / 2.0, IMAGE[1] / 2.0, 0.0]; num];
        for (ibug, &at) in table.iter().enumerate() {
            wide[at] = points[ibug];
        }
        wide
    };
    let mut ibug = solver(&character, None);
    let mut mesh = Solver::new(character.clone(), &SolveConfig::default(), &hello(Some(Layout::Mediapipe478), None)).expect("good");
    let mut open = Solver::new(character.clone(), &SolveConfig::default(), &hello(Some(Layout::OpenSeeFace66), None)).expect("good");
    let mut out = [FaceFrame::at_rest(&character), FaceFrame::at_rest(&character), FaceFrame::at_rest(&character)];
    let eye = character.bone_index("eye_l").expect("an eye");
    for frame in feed(&character, 200) {
        let TrackingData::Landmarks { points, .. } = &frame.data else { panic!("landmarks") };
        ibug.solve(&frame, &mut out[0]).expect("a good frame");
        let mut wide = spread(points, &IBUG_FROM_MEDIAPIPE, 478);
        for (iris, corners) in [(468, [36, 39]), (473, [42, 45])] {
            let middle = |axis: usize| 0.5 * (points[corners[0]][axis] + points[corners[1]][axis]);
            // From five seconds on the performer looks to the right of the picture.
            wide[iris] = [middle(0) + if frame.t > 5.0 { 3.0 } else { 0.0 }, middle(1), 0.0];
        }
        mesh.solve(&landmark_frame(frame.t, wide), &mut out[1]).expect("a good frame");
        open.solve(&landmark_frame(frame.t, spread(points, &IBUG_FROM_OPENSEEFACE, 66)), &mut out[2]).expect("a good frame");
        for bone in ["brow_inner_r", "brow_outer_l", "cheek_l", "chin", "lip_lower_mid"] {
            let at = character.bone_index(bone).expect("a bone");
            // The calmest frames a neutral is made of differ a little where points are missing or added.
            for other in &out[1..] {
                assert!(
                    other.points[at].distance(out[0].points[at]) < 1.5e-3,
                    "{bone} at {}: {} {}",
                    frame.t,
                    other.points[at],
                    out[0].points[at]
                );
            }
        }
    }
    assert!(out[1].rotations[eye].to_scaled_axis().y > 0.2, "irises turn the eyes: {}", out[1].rotations[eye]);
    assert_eq!(out[0].rotations[eye], Quat::IDENTITY, "without irises they look ahead");
}

#[test]
fn named_points_move_their_own_bones_and_their_neighbours() {
    let character = character();
    let own = [
        "brow_inner_l",
        "brow_inner_r",
        "brow_outer_l",
        "brow_outer_r",
        "lip_corner_l",
        "lip_corner_r",
        "nose_wing_l",
        "nose_wing_r",
        "chin",
        "lip_upper_mid",
    ];
    let names: Vec<String> = own.iter().map(|name| (*name).to_owned()).collect();
    let points_of = |raise: f32| -> Vec<Vec3> {
        own.iter().map(|name| character.features[*name] + Vec3::new(0.0, if name.starts_with("brow") { raise } else { 0.0 }, 0.0)).collect()
    };
    let mut solver = Solver::new(character.clone(), &SolveConfig::default(), &hello(Some(Layout::Named(names)), None)).expect("good");
    let mut out = FaceFrame::at_rest(&character);
    let t = hold(&mut solver, &mut out, &character, &points_of(0.0), &View { roll: 5.0, ..View::FRONT }, 0.0, 2.5);
    assert!(largest(&out.influences) < 0.02);
    hold(&mut solver, &mut out, &character, &points_of(0.010), &View { roll: 5.0, ..View::FRONT }, t, 1.0);
    for bone in ["brow_inner_l", "brow_outer_r"] {
        assert!(influence(&character, &out, "stretch", bone) > 0.5, "{bone}: {:?}", out.influences);
    }
    assert!(influence(&character, &out, "stretch", "brow_mid_l") > 0.3, "between two that rise");

    let refused = |names: &[&str]| {
        let names = names.iter().map(|name| (*name).to_owned()).collect();
        Solver::new(character.clone(), &SolveConfig::default(), &hello(Some(Layout::Named(names)), None))
            .err()
            .expect("refused")
            .to_string()
    };
    assert_eq!(refused(&["chin"]), "layout has 1 points, expected at least 5");
    assert_eq!(
        refused(&["chin", "beard", "lip_corner_l", "lip_corner_r", "nose_wing_l"]),
        "layout[1] is \"beard\", expected a feature point or bone of the character"
    );
    assert_eq!(
        refused(&["chin", "chin", "lip_corner_l", "lip_corner_r", "nose_wing_l"]),
        "layout[1] is \"chin\" a second time, expected each point once"
    );
}

#[test]
fn bones_given_directly_are_evaluated_as_they_are() {
    let character = character();
    let mut solver = Solver::new(character.clone(), &SolveConfig::default(), &hello(None, None)).expect("a good session");
    let mut out = FaceFrame::at_rest(&character);
    let index = |name| character.bone_index(name).expect("a bone");
    let brow = index("brow_inner_r");
    let placed = character.bones[brow].rest + Vec3::new(0.0, 0.0045, 0.0);
    let jaw = index("jaw");
    let open = character.bones[jaw].rest + Vec3::new(0.0, -0.02, -0.01);
    let head = HeadPose { rotation: Quat::from_xyzw(0.0, 0.0, 0.6, 0.8), position: Vec3::new(0.1, 0.0, -2.0) };
    let data = TrackingData::Bones { points: vec![(brow, placed), (jaw, open)], head: Some(head) };
    solver.solve(&TrackingFrame::new(1.0, data), &mut out).expect("a good frame");
    assert_eq!((out.points[brow], out.points[jaw]), (placed, open));
    assert!((influence(&character, &out, "stretch", "brow_inner_r") - 0.5).abs() < 1e-5);
    assert!(out.rotations[jaw].x > 0.05 && out.rotations[brow] == Quat::IDENTITY);
    assert!(out.head.rotation.angle_between(head.rotation) < 1e-5);
    assert_eq!(out.head.position, Vec3::new(0.1, 0.0, -0.3), "bounded on the way out");

    let error = solver.solve(&TrackingFrame::new(2.0, TrackingData::Bones { points: vec![(99, Vec3::ZERO)], head: None }), &mut out);
    assert_eq!(error, Err(SolveError::BoneIndex { got: 99, num_bones: character.num_bones() }));
    // Asked for, the head as it is now becomes the neutral one.
    solver.calibrate();
    let data = TrackingData::Bones { points: Vec::new(), head: Some(head) };
    solver.solve(&TrackingFrame::new(3.0, data.clone()), &mut out).expect("a good frame");
    solver.solve(&TrackingFrame::new(4.0, data), &mut out).expect("a good frame");
    assert!(out.head.rotation.angle_between(Quat::IDENTITY) < 1e-5 && out.head.position.length() < 1e-5);
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
    refuse(landmark_frame(1.0, good.clone()), "t is 1 s, expected more than the frame before it, 1 s");
    refuse(landmark_frame(0.5, good.clone()), "t is 0.5 s, expected more than the frame before it, 1 s");
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

#[test]
fn smoothing_of_weights_is_reported() {
    let character = character();
    let mut solver = Solver::new(character.clone(), &SolveConfig::default(), &hello(None, None)).expect("a good session");
    let mut out = FaceFrame::at_rest(&character);
    for i in 0..3 {
        solver.solve(&weight_frame(f64::from(i) / 30.0, &[]), &mut out).expect("a good frame");
    }
    let delay = solver.added_delay();
    assert!(delay.mouth > 0.01 && delay.head == 0.0, "{delay:?}");
}

#[test]
fn zero_weights_are_exactly_neutral_with_correctives_too() {
    let mut character = Character::clone(&character());
    let shape = |name| ArkitShape::from_name(name).expect("a name of ARKit's");
    let (corner, jaw) = (character.bone_index("lip_corner_l").expect("a bone"), character.bone_index("jaw").expect("a jaw"));
    // Two examples that nearly coincide: their system is regularised.
    character.correctives = [0.7, 0.70002]
        .map(|smile| Corrective {
            weights: vec![(shape("jawOpen"), 1.0), (shape("mouthSmileLeft"), smile)],
            bones: vec![(corner, Vec3::new(0.003, -0.004, 0.001)), (jaw, Vec3::new(0.0, -0.012, -0.004))],
        })
        .into();
    let character = Arc::new(character);
    let mut solver = Solver::new(character.clone(), &SolveConfig::default(), &hello(None, None)).expect("a good session");
    let (mut out, rest) = (FaceFrame::at_rest(&character), FaceFrame::at_rest(&character));
    solver.solve(&weight_frame(0.0, &[]), &mut out).expect("a good frame");
    assert_eq!((&out.points, &out.rotations, &out.influences), (&rest.points, &rest.rotations, &rest.influences));
    solver.solve(&weight_frame(1.0, &[("jawOpen", 1.0), ("mouthSmileLeft", 0.7)]), &mut out).expect("a good frame");
    let moved = out.points[corner] - rest.points[corner];
    assert!(moved.distance(Vec3::new(0.003, -0.004, 0.001)) < 1e-5, "{moved}");
}

#[test]
fn delay_is_reported_by_group() {
    let character = character();
    let mut solver = solver(&character, None);
    let mut out = FaceFrame::at_rest(&character);
    hold(&mut solver, &mut out, &character, &landmarks(), &View::FRONT, 0.0, 1.0);
    let at_rest = solver.added_delay();
    assert!(at_rest.eyelids < at_rest.mouth && at_rest.mouth < at_rest.brows && at_rest.brows < 0.15, "{at_rest:?}");
}
