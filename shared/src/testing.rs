//! A character small enough to reason about, for this crate's tests.

use crate::character::{Bone, Character, Drive, Expression, GroupDegenerate, Mode, Pose, Zone, ZoneMap, Zones};
use crate::layout::NUM_IBUG;
use glam::Vec3;
use std::collections::BTreeMap;

/// Two brows in a group, a jaw that turns, a chin that turns with it, a cheek that no pose moves; two poses: `raise` lifts
/// both brows, `open` turns the jaw and moves the chin.
pub(crate) fn tiny_character() -> Character {
    let still = |name: &str, rest: Vec3| Bone {
        name: name.to_owned(),
        joint: name.to_owned(),
        rest,
        drive: Drive::Still,
        gain: Vec3::ONE,
        turns_with: None,
    };
    let pivot = Vec3::new(0.0, -0.02, -0.06);
    let bones = vec![
        still("brow_l", Vec3::new(0.03, 0.05, 0.09)),
        still("brow_r", Vec3::new(-0.03, 0.05, 0.09)),
        Bone { drive: Drive::Jaw { pivot, landmarks: Vec::new(), max_angle: 0.5 }, ..still("jaw", Vec3::new(0.0, -0.1, 0.02)) },
        Bone { turns_with: Some(2), ..still("chin", Vec3::new(0.0, -0.09, 0.03)) },
        still("cheek", Vec3::new(0.05, -0.02, 0.05)),
    ];
    let rest: Vec<Vec3> = bones.iter().map(|bone| bone.rest).collect();
    let moved = |deltas: &[(usize, Vec3)]| {
        let mut points = rest.clone();
        deltas.iter().for_each(|&(bone, delta)| points[bone] += delta);
        points
    };
    let up = Vec3::new(0.0, 0.01, 0.0);
    let down = Vec3::new(0.0, -0.02, -0.01);
    let poses = vec![
        Pose { name: "raise".into(), points: moved(&[(0, up), (1, up)]), map: None },
        Pose { name: "open".into(), points: moved(&[(2, down), (3, down)]), map: None },
    ];
    Character {
        name: "tiny".into(),
        sha256: "0".repeat(64),
        head_joint: "head".into(),
        head_pivot: Vec3::ZERO,
        ibug68: Box::new([Vec3::ZERO; NUM_IBUG]),
        features: bones.iter().map(|bone| (bone.name.clone(), bone.rest)).collect::<BTreeMap<_, _>>(),
        bones,
        groups: vec![vec![0, 1]],
        poses,
        shapes: Vec::new(),
        correctives: Vec::new(),
        zones: None,
        mode: Mode::Independent,
        group_degenerate: GroupDegenerate::Exclude,
        falloff: 1.0,
    }
}

/// One zone on which every expression weighs 1.
pub(crate) fn one_zone(expressions: &[&str]) -> Zones {
    Zones {
        list: vec![Zone { name: "forehead".into(), side: None }],
        masks: vec![0],
        map: ZoneMap { texture: 0, scale: 1.0 },
        stretch: None,
        difference: None,
        wavelength: 0.006,
        expressions: expressions.iter().map(|name| Expression { name: (*name).into(), weights: vec![1.0] }).collect(),
        bridge: Vec::new(),
    }
}
