//! The solve as its callers see it: sessions of frames in, face frames out.

mod solve_fixture;

use glam::{Quat, Vec3};
use rhytid_server::feed::{Feed, FeedItem};
use rhytid_server::pipeline::Pipeline;
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

#[test]
fn one_jumbled_frame_shows_nothing() {
    let character = character();
    let mut solver = solver(&character, None);
    let mut out = FaceFrame::at_rest(&character);
    let mut t = hold(&mut solver, &mut out, &character, &landmarks(), &View::FRONT, 0.0, 3.0);
    let before = out.points.clone();
    let good = see(&landmarks(), character.head_pivot, &View::FRONT);
    let mut random = 1_u32;
    let mut noise = || {
        random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (random >> 16) as f32 / 65_536.0 * 50.0 - 25.0
    };
    let jumbled = good.iter().map(|p| [p[0] + noise(), p[1] + noise(), 0.0]).collect();
    solver.solve(&landmark_frame(t, jumbled), &mut out).expect("values a tracker may give");
    let most = out.points.iter().zip(&before).map(|(a, b)| a.distance(*b)).fold(0.0, f32::max);
    assert!(most < 1e-3 && largest(&out.influences) < 0.1, "{most} {:?}", out.influences);
    t = hold(&mut solver, &mut out, &character, &landmarks(), &View::FRONT, t + 1.0 / 30.0, 0.1);
    assert!(t > 3.0 && largest(&out.influences) < 0.05);
}

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

/// The table of 68 points as its public sources give it, by what each point is.
#[test]
fn layouts_map_the_points_they_are_said_to() {
    let mediapipe = [
        (8, 152, "chin"),
        (0, 127, "right ear"),
        (16, 356, "left ear"),
        (17, 70, "right brow, outer end"),
        (21, 107, "right brow, inner end"),
        (22, 336, "left brow, inner end"),
        (26, 300, "left brow, outer end"),
        (27, 168, "bridge"),
        (30, 4, "tip of the nose"),
        (33, 2, "below the nose"),
        (36, 33, "right eye, outer corner"),
        (39, 133, "right eye, inner corner"),
        (37, 160, "right upper lid, outer"),
        (41, 144, "right lower lid, outer"),
        (42, 362, "left eye, inner corner"),
        (45, 263, "left eye, outer corner"),
        (48, 61, "right mouth corner"),
        (54, 291, "left mouth corner"),
        (51, 0, "upper lip"),
        (57, 17, "lower lip"),
        (60, 78, "right inner corner"),
        (62, 13, "upper lip, inside"),
        (64, 308, "left inner corner"),
        (66, 14, "lower lip, inside"),
    ];
    for (ibug, at, what) in mediapipe {
        assert_eq!(IBUG_FROM_MEDIAPIPE[ibug], at, "{what}");
    }
    // 66 points: iBUG's without its outer mouth corners, for which the inner ones serve.
    for (ibug, at) in [(0, 0), (47, 47), (49, 48), (53, 52), (55, 53), (59, 57), (60, 58), (64, 62), (67, 65), (48, 58), (54, 62)] {
        assert_eq!(IBUG_FROM_OPENSEEFACE[ibug], at, "{ibug}");
    }
    for table in [&IBUG_FROM_MEDIAPIPE, &IBUG_FROM_OPENSEEFACE] {
        for ibug in 0..68 {
            let repeated = (0..68).filter(|other| table[*other] == table[ibug]).count();
            let allowed = if table == &IBUG_FROM_OPENSEEFACE && matches!(ibug, 48 | 54 | 60 | 64) { 2 } else { 1 };
            assert_eq!(repeated, allowed, "{ibug} has a point of its own");
        }
    }
    let pairs =
        [(0, 16), (7, 9), (8, 8), (17, 26), (21, 22), (27, 27), (31, 35), (36, 45), (37, 44), (38, 43), (39, 42), (40, 47), (41, 46)];
    for (right, left) in pairs.into_iter().chain([(48, 54), (49, 53), (50, 52), (51, 51), (55, 59), (56, 58), (60, 64), (61, 63), (65, 67)])
    {
        assert_eq!((IBUG_MIRROR[right], IBUG_MIRROR[left]), (left, right));
    }
}

/// A recording of all 478 points that is kept beside the project, where it is there.
#[test]
fn a_recorded_face_of_478_points_is_one() {
    let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/feeds/short.mediapipe478.jsonl");
    let character = character();
    if !path.exists() {
        eprintln!("{} is not there: nothing tested", path.display());
        return;
    }
    let mut feed = Feed::open(&path, &character).expect("a feed");
    let mut solver = Solver::new(character.clone(), &SolveConfig::default(), &feed.hello).expect("a good session");
    let (mut frame, mut out) = (TrackingFrame::default(), FaceFrame::at_rest(&character));
    let (mut num_faces, mut num_strong) = (0, 0);
    while let Some(item) = feed.next_frame(&mut frame).expect("no bad line") {
        assert_eq!(item, FeedItem::Frame);
        if let TrackingData::Landmarks { points, .. } = &frame.data {
            num_faces += 1;
            let at = |ibug: usize| Vec3::from(points[IBUG_FROM_MEDIAPIPE[ibug]]).truncate();
            // Partners mirror each other about the line from the bridge to the chin, as far as a turned head lets them.
            let (up, unit) = ((at(27) - at(8)).normalize(), at(36).distance(at(45)));
            for ibug in 0..68 {
                let (a, b) = (at(ibug) - at(27), at(IBUG_MIRROR[ibug]) - at(27));
                assert!(((a - b).dot(up) / unit).abs() < 0.35, "{ibug} and its partner are level");
                if ibug != IBUG_MIRROR[ibug] {
                    let across = |p: glam::Vec2| up.perp_dot(p) / unit;
                    assert!(across(a) * across(b) < 0.1, "{ibug} and its partner are on either side: {} {}", across(a), across(b));
                }
            }
        }
        solver.solve(&frame, &mut out).expect("a good frame");
        assert!(out.points.iter().all(|point| point.is_finite()));
        num_strong += usize::from(out.influences.iter().filter(|value| **value > 0.9).count() > 6);
        assert!(out.head.rotation.to_scaled_axis().length() < 0.7, "{}", out.head.rotation);
    }
    assert!(num_faces > 60 && num_strong < num_faces / 4, "{num_strong} of {num_faces} frames are grimaces");
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

mod any_input {
    use super::*;
    use proptest::prelude::*;

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
}
