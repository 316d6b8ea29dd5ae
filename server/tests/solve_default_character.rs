//! What must hold for the character that everybody sees first, not only for a tidy fixture.

mod solve_fixture;

use glam::Vec3;
use rhytid_server::feed::{Feed, FeedItem};
use rhytid_server::solve::{SolveConfig, Solver};
use rhytid_shared::layout::{IBUG_FROM_MEDIAPIPE, IBUG_MIRROR, Layout, NUM_IBUG};
use rhytid_shared::{ARKIT_NAMES, ArkitShape, Character, DEFAULT_CHARACTER_GLB, FaceFrame, TrackingFrame};
use solve_fixture::{IMAGE, View, hello, influence, landmark_frame, see, weight_frame};
use std::sync::Arc;

fn default_character() -> Arc<Character> {
    Arc::new(Character::from_glb(DEFAULT_CHARACTER_GLB).expect("the built-in character is sound"))
}

fn solver(character: &Arc<Character>, layout: Option<Layout>, focal: Option<f32>) -> Solver {
    Solver::new(character.clone(), &SolveConfig::default(), &hello(layout, focal)).expect("a good session")
}

/// Largest influence and where it is.
fn largest(character: &Character, out: &FaceFrame) -> (f32, String) {
    let most = out.influences.iter().copied().enumerate().fold((0, 0.0_f32), |best, one| if one.1 > best.1 { one } else { best });
    let (pose, bone) = (most.0 / character.num_bones(), most.0 % character.num_bones());
    (most.1, format!("{} of {}", character.poses[pose].name, character.bones[bone].name))
}

/// Largest influence over turns of the neutral head, after calibration from the front through a camera of `true_focal`.
fn largest_over_turns(true_focal: f64, told: Option<f32>, is_explicit: bool) -> (f32, String) {
    let character = default_character();
    let mut solver = solver(&character, Some(Layout::Ibug68), told);
    let mut out = FaceFrame::at_rest(&character);
    let front = View { focal: true_focal, place: [0.02, 0.03, 0.65 * true_focal / 640.0], ..View::FRONT };
    let mut t = 0.0;
    let mut worst = (0.0, String::new());
    let mut show = |solver: &mut Solver, view: &View| {
        let pixels = see(&character.ibug68[..], character.head_pivot, view);
        solver.solve(&landmark_frame(t, pixels), &mut out).expect("a good frame");
        t += 1.0 / 30.0;
        largest(&character, &out)
    };
    for _ in 0..if is_explicit { 15 } else { 100 } {
        show(&mut solver, &front);
    }
    if is_explicit {
        solver.calibrate();
    }
    assert!(solver.take_calibrated().is_some());
    for (pitch, yaw) in [(0.0, 25.0), (0.0, -25.0), (25.0, 0.0), (-25.0, 0.0)] {
        for step in (0..=20).chain([20; 20]).chain((0..20).rev()) {
            let share = f64::from(step) / 20.0;
            let now = show(&mut solver, &View { pitch: pitch * share, yaw: yaw * share, ..front });
            if now.0 > worst.0 {
                worst = (now.0, format!("{} at pitch {pitch} yaw {yaw} times {share}", now.1));
            }
        }
    }
    worst
}

#[test]
fn turning_the_head_wrinkles_nothing() {
    for is_explicit in [true, false] {
        let (told, at) = largest_over_turns(640.0, Some(640.0), is_explicit);
        assert!(told <= 0.05, "focal given: {told}, {at}");
        let (assumed, at) = largest_over_turns(640.0, None, is_explicit);
        assert!(assumed <= 0.05, "focal as assumed: {assumed}, {at}");
        for factor in [0.8, 1.3] {
            let (told, at) = largest_over_turns(640.0 * factor, Some(640.0 * factor as f32), is_explicit);
            assert!(told <= 0.05, "focal {factor} of the width, given: {told}, {at}");
        }
    }
}

#[test]
fn a_real_head_that_turns_keeps_its_calm_mouth_in_place() {
    let character = default_character();
    let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/assets/demo.ibug68.jsonl");
    let mut feed = Feed::open(&path, &character).expect("the demo session is in the project");
    let mut solver = Solver::new(character.clone(), &SolveConfig::default(), &feed.hello).expect("a good session");
    let (mut frame, mut out) = (TrackingFrame::default(), FaceFrame::at_rest(&character));
    let mouth = ["lip_corner_l", "lip_corner_r", "lip_upper_mid", "lip_lower_mid"].map(|name| character.bone_index(name).expect("a lip"));
    let (mut slide, mut num) = (0.0, 0);
    while let Some(item) = feed.next_frame(&mut frame).expect("no bad line") {
        assert_eq!(item, FeedItem::Frame);
        solver.solve(&frame, &mut out).expect("a good frame");
        // The performer looks 9 to 14 degrees aside; the tracker saw no mouth weight above 0.03 besides the chin's own.
        if frame.t > 19.58 {
            let yaw = out.head.rotation.to_scaled_axis().y.to_degrees();
            assert!((-15.0..-8.0).contains(&yaw), "{yaw} at {}", frame.t);
            // Along the gains: what the face does, not how strongly this character shows it.
            let moved = |&bone: &usize| (out.points[bone].x - character.bones[bone].rest.x) / character.bones[bone].gain.x;
            slide += mouth.iter().map(moved).sum::<f32>() / 4.0;
            num += 1;
        }
    }
    let slide = slide / num as f32;
    // Their depth is off by several millimetres: taken for the character's, the lips slide by 1.9 mm.
    assert!(num == 11 && slide.abs() < 0.0012, "{} mm over {num} frames", slide * 1e3);
}

/// The character's landmarks with brows up, mouth open and corners out, right and left by amounts of their own.
fn expression(character: &Character, s: f32) -> Vec<Vec3> {
    let mut points = character.ibug68.to_vec();
    let wave = |k: f32| 0.5 - 0.5 * (s * k).cos();
    for (i, point) in points.iter_mut().enumerate() {
        match i {
            17..=21 => point.y += 0.009 * wave(1.0),
            22..=26 => point.y += 0.005 * wave(0.7),
            7..=9 | 55..=59 | 65..=67 => point.y -= 0.010 * wave(1.3),
            48 | 60 => *point += Vec3::new(-0.007, 0.004, 0.0) * wave(0.9),
            54 | 64 => *point += Vec3::new(0.004, 0.002, 0.0) * wave(1.1),
            _ => {}
        }
    }
    points
}

#[test]
fn mirrored_input_gives_mirrored_output() {
    let character = default_character();
    let (mut plain, mut mirrored) = (solver(&character, Some(Layout::Ibug68), None), solver(&character, Some(Layout::Ibug68), None));
    let (mut out, mut twin) = (FaceFrame::at_rest(&character), FaceFrame::at_rest(&character));
    let partner: Vec<usize> = (0..character.num_bones())
        .map(|i| {
            let name = &character.bones[i].name;
            let other = match name.rsplit_once('_') {
                Some((stem, "l")) => format!("{stem}_r"),
                Some((stem, "r")) => format!("{stem}_l"),
                _ => name.clone(),
            };
            character.bone_index(&other).expect("both sides are there")
        })
        .collect();
    let (mut most_off, mut most_moved, mut most_influence_off) = ((0.0_f32, String::new()), 0.0_f32, (0.0_f32, String::new()));
    for frame in 0..300 {
        let t = f64::from(frame) / 30.0;
        let s = (t - 3.0).max(0.0) as f32 * 1.7;
        let view = View { yaw: 15.0 * f64::from((s * 0.4).sin()), ..View::FRONT };
        let seen = see(&expression(&character, s), character.head_pivot, &view);
        let flipped = (0..NUM_IBUG).map(|i| [IMAGE[0] - seen[IBUG_MIRROR[i]][0], seen[IBUG_MIRROR[i]][1], 0.0]).collect();
        plain.solve(&landmark_frame(t, seen), &mut out).expect("a good frame");
        mirrored.solve(&landmark_frame(t, flipped), &mut twin).expect("a good frame");
        for (i, &other) in partner.iter().enumerate() {
            let moved = (out.points[i] - character.bones[i].rest) * Vec3::new(-1.0, 1.0, 1.0);
            let off = (twin.points[other] - character.bones[other].rest).distance(moved);
            most_moved = most_moved.max(moved.length());
            if off > most_off.0 {
                most_off = (off, format!("{} at {t}", character.bones[i].name));
            }
            for k in 0..character.num_poses() {
                let row = k * character.num_bones();
                let off = (twin.influences[row + other] - out.influences[row + i]).abs();
                if off > most_influence_off.0 {
                    most_influence_off = (off, format!("{} of {} at {t}", character.poses[k].name, character.bones[i].name));
                }
            }
        }
    }
    assert!(most_moved > 0.010, "the performance moves: {most_moved}");
    // Left and right of this face differ by up to a millimetre, as real ones do, so its answers differ a little, too: measured 0.46 mm and 0.14.
    assert!(most_off.0 < 0.001, "{most_off:?}");
    assert!(most_influence_off.0 < 0.2, "{most_influence_off:?}");
}

#[test]
fn zero_weights_are_the_neutral_to_the_last_bit() {
    let character = default_character();
    let mut solver = solver(&character, None, None);
    let (mut out, rest) = (FaceFrame::at_rest(&character), FaceFrame::at_rest(&character));
    let everything: Vec<(&str, f32)> = ARKIT_NAMES.iter().map(|name| (*name, 0.4)).collect();
    solver.solve(&weight_frame(0.0, &everything), &mut out).expect("a good frame");
    assert!(out.points != rest.points);
    // Later than the smoothing remembers.
    solver.solve(&weight_frame(1.0, &[]), &mut out).expect("a good frame");
    assert_eq!((&out.points, &out.rotations, &out.influences), (&rest.points, &rest.rotations, &rest.influences));
}

#[test]
fn left_is_left() {
    let character = default_character();
    let mut solver = solver(&character, Some(Layout::Ibug68), None);
    let mut out = FaceFrame::at_rest(&character);
    let mut raised = character.ibug68.to_vec();
    for point in &mut raised[22..=26] {
        point.y += 0.010;
    }
    for frame in 0..150 {
        let points = if frame < 100 { &character.ibug68[..] } else { &raised[..] };
        let seen = see(points, character.head_pivot, &View::FRONT);
        solver.solve(&landmark_frame(f64::from(frame) / 30.0, seen), &mut out).expect("a good frame");
    }
    let side = |side: &str| influence(&character, &out, "stretch", &format!("brow_mid_{side}"));
    assert!(side("l") > 0.6 && side("r") < 0.05, "left {} right {}", side("l"), side("r"));

    let mut wink = self::solver(&character, None, None);
    wink.solve(&weight_frame(0.0, &[("eyeBlinkRight", 1.0)]), &mut out).expect("a good frame");
    let lid = |name: &str| out.rotations[character.bone_index(name).expect("a lid")].to_scaled_axis().x;
    assert!(lid("lid_upper_r") > 0.5 && lid("lid_upper_l") == 0.0);
    assert_eq!(out.shapes.expect("passed on")[ArkitShape::from_name("eyeBlinkRight").expect("ARKit's").index()], 1.0);
}

#[test]
fn eyes_that_stay_on_the_camera_turn_against_the_head() {
    let character = default_character();
    let mut solver = solver(&character, Some(Layout::Mediapipe478), Some(640.0));
    let mut out = FaceFrame::at_rest(&character);
    let eye = character.bone_index("eye_l").expect("an eye");
    let mut worst = 0.0_f32;
    for frame in 0..30 * 25 {
        let t = f64::from(frame) / 30.0;
        let yaw = 15.0 * ((t - 3.0).max(0.0) * 0.9).sin();
        let mut face = character.ibug68.to_vec();
        for corners in [[36, 39], [42, 45]] {
            // The iris moves on a circle of about a third of the eye's width.
            let middle = (face[corners[0]] + face[corners[1]]) * 0.5;
            let radius = 0.35 * face[corners[0]].distance(face[corners[1]]);
            face.push(middle + Vec3::new(-radius * (yaw as f32).to_radians().sin(), 0.0, 0.0));
        }
        let seen = see(&face, character.head_pivot, &View { yaw, ..View::FRONT });
        let mut wide = vec![[IMAGE[0] / 2.0, IMAGE[1] / 2.0, 0.0]; 478];
        for (ibug, &at) in IBUG_FROM_MEDIAPIPE.iter().enumerate() {
            wide[at] = seen[ibug];
        }
        (wide[468], wide[473]) = (seen[68], seen[69]);
        solver.solve(&landmark_frame(t, wide), &mut out).expect("a good frame");
        // From the last look at the performer's depth on.
        if t > 21.0 {
            worst = worst.max((out.rotations[eye].to_scaled_axis().y + (yaw as f32).to_radians()).abs());
        }
    }
    assert!(worst.to_degrees() < 5.0, "off by {} degrees", worst.to_degrees());
}
