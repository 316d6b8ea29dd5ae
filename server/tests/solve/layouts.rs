//! Layouts of landmarks.

use crate::solve_fixture::{IMAGE, character, feed, hello, landmark_frame};
use crate::solver;
use glam::{Quat, Vec3};
use rhytid_server::feed::{Feed, FeedItem};
use rhytid_server::solve::{SolveConfig, Solver};
use rhytid_shared::layout::{IBUG_FROM_MEDIAPIPE, IBUG_FROM_OPENSEEFACE, IBUG_MIRROR, Layout};
use rhytid_shared::{FaceFrame, TrackingData, TrackingFrame};

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
