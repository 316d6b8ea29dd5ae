//! A small symmetric character and a camera that sees it, for tests and benchmarks of the solve.
#![allow(dead_code, reason = "each test binary uses its own part")]

use glam::{DMat3, DVec3, Vec3};
use rhytid_shared::character::{
    Bone, BridgeRow, Drive, Expression, GroupDegenerate, LandmarkWeight, LidKind, Mode, Pose, ShapeDeltas, Side, Zone, ZoneMap, Zones,
};
use rhytid_shared::layout::{IBUG_MIRROR, Layout, NUM_IBUG};
use rhytid_shared::{ArkitShape, Character, FaceFrame, HeadPose, PublishHello, TrackingData, TrackingFrame};
use std::sync::Arc;

/// The right half of a face and its middle, millimetres in head space; the left half is its mirror image.
const HALF_FACE: [(usize, [f32; 3]); 39] = [
    (0, [-71.0, 2.0, -52.0]),
    (1, [-70.0, -14.0, -48.0]),
    (2, [-68.0, -30.0, -42.0]),
    (3, [-65.0, -46.0, -34.0]),
    (4, [-59.0, -62.0, -22.0]),
    (5, [-49.0, -78.0, -6.0]),
    (6, [-36.0, -92.0, 10.0]),
    (7, [-19.0, -102.0, 24.0]),
    (8, [0.0, -105.0, 30.0]),
    (17, [-54.0, 17.0, 4.0]),
    (18, [-47.0, 24.0, 16.0]),
    (19, [-37.0, 27.0, 24.0]),
    (20, [-26.0, 25.0, 30.0]),
    (21, [-13.0, 21.0, 33.0]),
    (27, [0.0, 8.0, 31.0]),
    (28, [0.0, -6.0, 37.0]),
    (29, [0.0, -20.0, 44.0]),
    (30, [0.0, -33.0, 51.0]),
    (31, [-14.0, -42.0, 33.0]),
    (32, [-7.0, -45.0, 38.0]),
    (33, [0.0, -47.0, 40.0]),
    (36, [-45.0, 1.0, 11.0]),
    (37, [-36.0, 6.0, 19.0]),
    (38, [-26.0, 6.0, 21.0]),
    (39, [-17.0, -1.0, 17.0]),
    (40, [-26.0, -4.0, 20.0]),
    (41, [-36.0, -3.5, 18.0]),
    (48, [-25.0, -68.0, 29.0]),
    (49, [-16.0, -63.0, 37.0]),
    (50, [-6.0, -60.0, 41.0]),
    (51, [0.0, -61.0, 42.0]),
    (57, [0.0, -80.0, 40.0]),
    (58, [-8.0, -79.0, 39.0]),
    (59, [-17.0, -75.0, 35.0]),
    (60, [-22.0, -68.0, 31.0]),
    (61, [-8.0, -67.5, 39.0]),
    (62, [0.0, -68.0, 40.0]),
    (66, [0.0, -68.6, 40.0]),
    (67, [-8.0, -68.4, 39.0]),
];

/// The landmarks, metres.
pub fn landmarks() -> [Vec3; NUM_IBUG] {
    let mut points = [Vec3::ZERO; NUM_IBUG];
    for (i, mm) in HALF_FACE {
        let point = Vec3::from(mm) * 1e-3;
        points[i] = point;
        points[IBUG_MIRROR[i]] = point * Vec3::new(-1.0, 1.0, 1.0);
    }
    points
}

fn bone(name: &str, rest: Vec3, drive: Drive) -> Bone {
    Bone { name: name.to_owned(), joint: name.to_owned(), rest, drive, gain: Vec3::ONE, turns_with: None }
}

fn skin(points: &[Vec3; NUM_IBUG], name: &str, shares: &[(usize, f32)]) -> Bone {
    let total: f32 = shares.iter().map(|(_, share)| share).sum();
    let rest = shares.iter().map(|&(i, share)| points[i] * share).sum::<Vec3>() / total;
    let landmarks = shares.iter().map(|&(landmark, weight)| LandmarkWeight { landmark, weight }).collect();
    bone(name, rest, Drive::Skin { landmarks })
}

/// 31 bones and 4 poses: brows up, brows down, smile, pucker.
pub fn character() -> Arc<Character> {
    let points = landmarks();
    let mut bones = Vec::new();
    let halves: [(&str, &[(usize, f32)]); 10] = [
        ("brow_inner", &[(21, 1.0)]),
        ("brow_mid", &[(19, 0.5), (20, 0.5)]),
        ("brow_outer", &[(17, 0.4), (18, 0.6)]),
        ("nose_wing", &[(31, 1.0)]),
        ("cheek", &[(31, 0.3), (48, 0.5), (41, 0.2)]),
        ("lip_corner", &[(48, 1.0)]),
        ("lip_upper_side", &[(49, 0.5), (50, 0.5)]),
        ("lip_lower_side", &[(58, 0.5), (59, 0.5)]),
        ("chin_side", &[(7, 1.0)]),
        ("lip_inner_lower", &[(67, 1.0)]),
    ];
    for (name, shares) in halves {
        bones.push(skin(&points, &format!("{name}_r"), shares));
        let mirrored: Vec<(usize, f32)> = shares.iter().map(|&(i, share)| (IBUG_MIRROR[i], share)).collect();
        bones.push(skin(&points, &format!("{name}_l"), &mirrored));
    }
    bones.push(skin(&points, "lip_upper_mid", &[(51, 0.7), (62, 0.3)]));
    bones.push(skin(&points, "lip_lower_mid", &[(57, 0.7), (66, 0.3)]));
    bones.push(skin(&points, "chin", &[(8, 1.0)]));
    let jaw = Drive::Jaw {
        pivot: Vec3::new(0.0, -0.02, -0.045),
        landmarks: vec![LandmarkWeight { landmark: 8, weight: 1.0 }],
        max_angle: 30.0_f32.to_radians(),
    };
    bones.push(bone("jaw", points[8], jaw));
    for (side, name, x) in [(Side::Right, "r", -1.0), (Side::Left, "l", 1.0)] {
        let pivot = Vec3::new(0.031 * x, 0.0, 0.006);
        let lid = |lid, shut_angle: f32, wide_angle: f32| Drive::Lid { eye: side, lid, pivot, shut_angle, wide_angle };
        bones.push(bone(&format!("lid_upper_{name}"), pivot + Vec3::new(0.0, 0.006, 0.013), lid(LidKind::Upper, 0.7, -0.15)));
        bones.push(bone(&format!("lid_lower_{name}"), pivot + Vec3::new(0.0, -0.004, 0.013), lid(LidKind::Lower, -0.15, 0.05)));
        bones.push(bone(&format!("eye_{name}"), pivot + Vec3::new(0.0, 0.0, 0.012), Drive::Eye { eye: side, pivot, range: [0.6, 0.45] }));
    }
    bones.push(bone("hair", Vec3::new(0.0, 0.1, 0.0), Drive::Still));
    let leader = bones.iter().position(|bone| bone.name == "jaw");
    for bone in &mut bones {
        if bone.name == "chin" || bone.name == "lip_lower_mid" {
            bone.turns_with = leader;
        }
    }
    let pose = |name: &str, moved: &[(&str, [f32; 3])]| {
        let points = bones
            .iter()
            .map(|bone| {
                let stem = bone.name.trim_end_matches("_l").trim_end_matches("_r");
                let side = if bone.name.ends_with("_l") { 1.0 } else { -1.0 };
                let mm = moved.iter().find(|(name, _)| *name == stem).map_or([0.0; 3], |(_, mm)| *mm);
                bone.rest + Vec3::new(mm[0] * side, mm[1], mm[2]) * 1e-3
            })
            .collect();
        Pose { name: name.to_owned(), points, map: None }
    };
    let poses = vec![
        pose("stretch", &[("brow_inner", [0.0, 9.0, 0.0]), ("brow_mid", [0.0, 10.0, 0.0]), ("brow_outer", [0.0, 7.0, 0.0])]),
        pose("compress", &[("brow_inner", [-4.0, -7.0, 0.0]), ("brow_mid", [-2.0, -6.0, 0.0]), ("nose_wing", [0.5, 4.0, 0.0])]),
        pose("smile", &[("lip_corner", [9.0, 7.0, -4.0]), ("cheek", [3.0, 6.0, 1.0])]),
        pose("pucker", &[("lip_corner", [-8.0, 0.0, 4.0]), ("lip_upper_side", [-3.0, -1.0, 3.0]), ("lip_lower_side", [-3.0, 1.0, 3.0])]),
    ];
    let delta = |shape: &str, moved: &[(&str, [f32; 3])]| ShapeDeltas {
        shape: ArkitShape::from_name(shape).expect("a name of ARKit's"),
        target: 0,
        deltas: bones
            .iter()
            .map(|bone| moved.iter().find(|(name, _)| *name == bone.name).map_or(Vec3::ZERO, |(_, mm)| Vec3::from(*mm) * 1e-3))
            .collect(),
    };
    let shapes = vec![
        delta("jawOpen", &[("jaw", [0.0, -22.0, -14.0]), ("chin", [0.0, -22.0, -14.0]), ("lip_lower_mid", [0.0, -20.0, -9.0])]),
        delta("mouthSmileLeft", &[("lip_corner_l", [9.0, 7.0, -4.0]), ("cheek_l", [3.0, 5.0, 1.0])]),
        delta("mouthSmileRight", &[("lip_corner_r", [-9.0, 7.0, -4.0]), ("cheek_r", [-3.0, 5.0, 1.0])]),
        delta("browInnerUp", &[("brow_inner_l", [0.0, 8.0, 0.0]), ("brow_inner_r", [0.0, 8.0, 0.0])]),
    ];
    let features = bones.iter().map(|bone| (bone.name.clone(), bone.rest)).collect();
    Arc::new(Character {
        name: "fixture".to_owned(),
        sha256: String::new(),
        head_joint: "head".to_owned(),
        head_pivot: Vec3::new(0.0, -0.06, -0.07),
        ibug68: Box::new(points),
        features,
        groups: Vec::new(),
        bones,
        poses,
        shapes,
        correctives: Vec::new(),
        zones: None,
        mode: Mode::Independent,
        group_degenerate: GroupDegenerate::Exclude,
        falloff: 1.0,
    })
}

/// The fixture with the paper's eight zones and Table 1.1; stretched and compressed brows drive the forehead of their side.
pub fn character_with_zones() -> Arc<Character> {
    let plain = character();
    let (left, right) = (Some(Side::Left), Some(Side::Right));
    let list = [
        ("red", left),
        ("green", right),
        ("blue", left),
        ("brown", right),
        ("cyan", left),
        ("magenta", right),
        ("orange", None),
        ("gray", None),
    ];
    let table: [(&str, [f32; 8]); 6] = [
        ("joy", [1.0, 1.0, 0.2, 0.2, 0.0, 0.0, 0.0, 0.0]),
        ("surprise", [0.8, 0.8, 0.8, 0.8, 0.0, 0.0, 0.0, 0.0]),
        ("fear", [0.2, 0.2, 0.75, 0.75, 0.3, 0.3, 0.0, 0.6]),
        ("anger", [-0.6, -0.6, -0.8, -0.8, 0.8, 0.8, 1.0, 0.0]),
        ("disgust", [0.0, 0.0, -0.1, -0.1, 1.0, 1.0, 1.0, 0.5]),
        ("sad", [0.2, 0.2, 0.75, 0.75, 0.0, 0.0, 0.1, 1.0]),
    ];
    let rows = [(0, "brow_mid", 0, 0.5), (0, "brow_outer", 0, 0.5), (0, "brow_inner", 2, 1.0), (1, "brow_inner", 2, -0.8)];
    let halves = [("_l", 0), ("_r", 1)];
    let bridge = halves.iter().flat_map(|&(suffix, half)| {
        let bone = |stem: &str| plain.bone_index(&format!("{stem}{suffix}")).expect("a bone");
        rows.map(|(pose, stem, zone, gain)| BridgeRow { pose, bone: bone(stem), zone: zone + half, gain })
    });
    let zones = Zones {
        list: list.map(|(name, side)| Zone { name: name.to_owned(), side }).to_vec(),
        masks: vec![0, 1],
        map: ZoneMap { texture: 2, scale: 1.0 },
        stretch: Some(ZoneMap { texture: 3, scale: 1.0 }),
        difference: None,
        wavelength: 0.006,
        expressions: table.map(|(name, weights)| Expression { name: name.to_owned(), weights: weights.to_vec() }).to_vec(),
        bridge: bridge.collect(),
    };
    Arc::new(Character { zones: Some(zones), ..(*plain).clone() })
}

pub const IMAGE: [f32; 2] = [640.0, 480.0];

pub fn hello(layout: Option<Layout>, focal: Option<f32>) -> PublishHello {
    PublishHello { source: "test".to_owned(), fps: Some(30.0), layout, image: Some(IMAGE), focal, ..PublishHello::default() }
}

/// A head before a camera.
#[derive(Debug, Clone, Copy)]
pub struct View {
    /// Degrees: chin down, to the character's left, and over the shoulder.
    pub pitch: f64,
    pub yaw: f64,
    pub roll: f64,
    /// Of the pivot before the camera, metres: right, up, away.
    pub place: [f64; 3],
    /// True focal length, pixels.
    pub focal: f64,
}

impl View {
    pub const FRONT: Self = Self { pitch: 0.0, yaw: 0.0, roll: 0.0, place: [0.0, 0.0, 0.65], focal: 640.0 };
}

/// Rotation of the view's head.
pub fn rotation(view: &View) -> DMat3 {
    DMat3::from_rotation_z(view.roll.to_radians())
        * DMat3::from_rotation_y(view.yaw.to_radians())
        * DMat3::from_rotation_x(view.pitch.to_radians())
}

/// Pixels at which the camera sees the points.
pub fn see(points: &[Vec3], pivot: Vec3, view: &View) -> Vec<[f32; 3]> {
    let turn = rotation(view);
    points
        .iter()
        .map(|point| {
            let p = turn * (*point - pivot).as_dvec3() + DVec3::new(view.place[0], view.place[1], -view.place[2]);
            let x = f64::from(IMAGE[0]) / 2.0 + view.focal * p.x / -p.z;
            let y = f64::from(IMAGE[1]) / 2.0 - view.focal * p.y / -p.z;
            [x as f32, y as f32, 0.0]
        })
        .collect()
}

pub fn landmark_frame(t: f64, points: Vec<[f32; 3]>) -> TrackingFrame {
    TrackingFrame::new(t, TrackingData::Landmarks { points, confidence: Vec::new() })
}

pub fn weight_frame(t: f64, named: &[(&str, f32)]) -> TrackingFrame {
    let mut weights = Box::new([0.0; rhytid_shared::NUM_ARKIT_SHAPES]);
    for (name, weight) in named {
        weights[ArkitShape::from_name(name).expect("a name of ARKit's").index()] = *weight;
    }
    TrackingFrame::new(t, TrackingData::Weights { weights, head: None::<HeadPose> })
}

/// The landmarks with an expression: brows up by `brow` right and left, lips apart by `open`, corners out by `smile`, lids shut by
/// `blink` in 0 to 1; metres.
pub fn expression(brow: [f32; 2], open: f32, smile: f32, blink: f32) -> [Vec3; NUM_IBUG] {
    let mut points = landmarks();
    for i in 17..=26 {
        points[i].y += if i <= 21 { brow[0] } else { brow[1] };
    }
    for i in (55..=59).chain(65..=67).chain(7..=9) {
        points[i].y -= open;
    }
    for (corner, side) in [(48, -1.0), (60, -1.0), (54, 1.0), (64, 1.0)] {
        points[corner] += Vec3::new(side * smile, 0.6 * smile - 0.4 * open, 0.0);
    }
    for (upper, lower) in [(37, 41), (38, 40), (43, 47), (44, 46)] {
        let gap = points[upper].y - points[lower].y;
        points[upper].y -= gap * blink;
    }
    points
}

/// A deterministic performance of `num` frames at 30 a second: three calm seconds, then expressions and head turns.
pub fn feed(character: &Character, num: usize) -> Vec<TrackingFrame> {
    (0..num)
        .map(|i| {
            let t = i as f64 / 30.0;
            let s = ((t - 3.0).max(0.0) * 1.7) as f32;
            let wave = |k: f32| 0.5 - 0.5 * (s * k).cos();
            let points = expression(
                [0.008 * wave(1.0), 0.006 * wave(0.7)],
                0.012 * wave(1.3),
                0.006 * wave(0.9),
                if i % 70 > 66 { 0.9 } else { 0.0 },
            );
            let view = View { yaw: 20.0 * f64::from((s * 0.4).sin()), pitch: 10.0 * f64::from((s * 0.3).sin()), ..View::FRONT };
            landmark_frame(t, see(&points, character.head_pivot, &view))
        })
        .collect()
}

pub fn influence(character: &Character, frame: &FaceFrame, pose: &str, bone: &str) -> f32 {
    let k = character.poses.iter().position(|p| p.name == pose).expect("a pose");
    let i = character.bone_index(bone).expect("a bone");
    frame.influences[k * character.num_bones() + i]
}
