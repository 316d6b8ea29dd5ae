//! What faces, weights and bones given directly come to.

use crate::solve_fixture::{IMAGE, View, character, expression, feed, hello, influence, landmark_frame, landmarks, see, weight_frame};
use crate::{hold, largest, solver};
use glam::{Quat, Vec3};
use rhytid_server::solve::{SolveConfig, SolveError, Solver};
use rhytid_shared::character::Corrective;
use rhytid_shared::layout::{IBUG_MIRROR, Layout};
use rhytid_shared::{ArkitShape, Character, FaceFrame, HeadPose, TrackingData, TrackingFrame};
use std::sync::Arc;

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
