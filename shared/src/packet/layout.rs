//! What both ends must know of a character to agree on what a packet carries and what goes without saying.

use super::PacketError;
use super::kriging::{Expectation, Symmetry, slopes};
use crate::character::Character;
use crate::face::{FaceFrame, HeadPose};
use crate::limits::{MAX_BONES, MAX_POSES, MAX_ZONES};
use crate::view::CharacterHello;
use glam::{Quat, Vec3};
use std::collections::BTreeMap;

/// What both ends know of a character: made from the character itself or from a viewer's hello, with the same result.
#[derive(Debug, Clone, PartialEq)]
pub struct PacketLayout {
    /// `n` evaluated points at rest, metres, head space.
    pub(super) rest: Vec<Vec3>,
    pub(super) num_poses: usize,
    pub(super) num_zones: usize,
    /// Bones whose displacement is sent.
    pub(super) moving: Vec<usize>,
    /// What is expected of their x, and of their y and z.
    pub(super) sideways: Expectation,
    pub(super) upright: Expectation,
    /// How z changes with x and y where they slide along the face.
    pub(super) slopes: Vec<[f32; 2]>,
    /// Bones whose rotation is sent; their point follows from it.
    pub(super) turning: Vec<Turning>,
    /// `(bone, the turning bone whose rotation it copies)`.
    pub(super) followers: Vec<(usize, usize)>,
    /// Coefficients that can differ from 0 and from each other.
    pub(super) slots: Vec<Slot>,
}

/// A bone whose rotation is sent.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Turning {
    pub bone: usize,
    pub pivot: Vec3,
}

/// One coefficient of a packet: a bone by itself, or a group, whose members share their mean ([D09] 5.2).
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Slot {
    pub pose: usize,
    /// At least one.
    pub bones: Vec<usize>,
    /// Those of them that the pose moves, at least one.
    pub moved: Vec<Member>,
}

/// A bone that a pose moves.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Member {
    pub place: BonePlace,
    /// The pose's displacement over its square: its dot product with a displacement is the influence ([D09] 5.1).
    pub direction: Vec3,
}

/// Where a bone's codes stand.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum BonePlace {
    /// Index into `moving`.
    Moving(usize),
    /// Index into `turning`.
    Turning(usize),
}

/// The parts of a character, wherever they come from.
struct Parts<'a> {
    rest: Vec<Vec3>,
    pivots: Vec<Option<Vec3>>,
    turns_with: Vec<Option<usize>>,
    /// For each pose, how it displaces each bone.
    moves: Vec<Vec<Vec3>>,
    groups: &'a [Vec<usize>],
    num_zones: usize,
}

impl From<&Character> for PacketLayout {
    fn from(character: &Character) -> Self {
        let rest: Vec<Vec3> = character.bones.iter().map(|bone| bone.rest).collect();
        Self::from_parts(Parts {
            pivots: character.bones.iter().map(|bone| bone.pivot()).collect(),
            turns_with: character.bones.iter().map(|bone| bone.turns_with).collect(),
            moves: character.poses.iter().map(|pose| pose.points.iter().zip(&rest).map(|(point, rest)| *point - *rest).collect()).collect(),
            rest,
            groups: &character.groups,
            num_zones: character.num_zones(),
        })
    }
}

impl TryFrom<&CharacterHello> for PacketLayout {
    type Error = PacketError;

    /// Refuses a hello that names more than this program's limits allow, or bones that are none.
    fn try_from(hello: &CharacterHello) -> Result<Self, PacketError> {
        let n = hello.bones.len();
        if n == 0 || n > MAX_BONES || hello.poses.len() > MAX_POSES || hello.zones.len() > MAX_ZONES {
            return Err(PacketError::Hello("it has no bones, or more bones, poses or zones than this program can take"));
        }
        let index_of: BTreeMap<&str, usize> = hello.bones.iter().enumerate().map(|(i, bone)| (bone.name.as_str(), i)).collect();
        let find = |name: &String| index_of.get(name.as_str()).copied().ok_or(PacketError::Hello("it names a bone that is none"));
        let rest: Vec<Vec3> = hello.bones.iter().map(|bone| Vec3::from(bone.rest)).collect();
        let pivots: Vec<Option<Vec3>> = hello.bones.iter().map(|bone| bone.pivot.map(Vec3::from)).collect();
        if !rest.iter().chain(pivots.iter().flatten()).all(|point| point.is_finite()) {
            return Err(PacketError::Hello("it has a point that is not finite"));
        }
        let mut moves = Vec::with_capacity(hello.poses.len());
        for pose in &hello.poses {
            let mut row = vec![Vec3::ZERO; n];
            for (name, point) in &pose.bones {
                let bone = find(name)?;
                row[bone] = Vec3::from(*point) - rest[bone];
                if !row[bone].is_finite() {
                    return Err(PacketError::Hello("it has a point that is not finite"));
                }
            }
            moves.push(row);
        }
        let groups = hello.groups.iter().map(|group| group.iter().map(find).collect()).collect::<Result<Vec<Vec<usize>>, _>>()?;
        let turns_with = hello.bones.iter().map(|bone| bone.turns_with.as_ref().map(find).transpose()).collect::<Result<_, _>>()?;
        Ok(Self::from_parts(Parts { rest, pivots, turns_with, moves, groups: &groups, num_zones: hello.zones.len() }))
    }
}

impl PacketLayout {
    fn from_parts(parts: Parts<'_>) -> Self {
        let n = parts.rest.len();
        let mut moving = Vec::new();
        let mut turning = Vec::new();
        let mut places = Vec::with_capacity(n);
        for bone in 0..n {
            match parts.pivots[bone] {
                Some(pivot) => {
                    places.push(BonePlace::Turning(turning.len()));
                    turning.push(Turning { bone, pivot });
                }
                None => {
                    places.push(BonePlace::Moving(moving.len()));
                    moving.push(bone);
                }
            }
        }
        let mut slots = Vec::new();
        let is_grouped = |bone: usize| parts.groups.iter().any(|group| group.contains(&bone));
        for (pose, moves) in parts.moves.iter().enumerate() {
            let alone = (0..n).filter(|bone| !is_grouped(*bone)).map(|bone| vec![bone]);
            for bones in parts.groups.iter().cloned().chain(alone) {
                let moved: Vec<Member> = bones
                    .iter()
                    .filter(|bone| moves[**bone] != Vec3::ZERO)
                    .map(|bone| Member {
                        place: places[*bone],
                        direction: moves[*bone] / moves[*bone].length_squared().max(f32::MIN_POSITIVE),
                    })
                    .collect();
                if !moved.is_empty() {
                    slots.push(Slot { pose, bones, moved });
                }
            }
        }
        let points: Vec<Vec3> = moving.iter().map(|bone| parts.rest[*bone]).collect();
        Self {
            followers: parts.turns_with.iter().enumerate().filter_map(|(bone, leader)| Some((bone, (*leader)?))).collect(),
            rest: parts.rest,
            num_poses: parts.moves.len(),
            num_zones: parts.num_zones,
            sideways: Expectation::new(&points, Symmetry::Odd),
            upright: Expectation::new(&points, Symmetry::Even),
            slopes: slopes(&points),
            moving,
            turning,
            slots,
        }
    }

    /// The character at rest, as frame 0 of session 1: a buffer of the right size for [`super::Decoder::decode`].
    pub fn frame_at_rest(&self) -> FaceFrame {
        FaceFrame {
            session: 1,
            seq: 0,
            captured_at_micros: 0,
            face: true,
            points: self.rest.clone(),
            rotations: vec![Quat::IDENTITY; self.rest.len()],
            influences: vec![0.0; self.num_poses * self.rest.len()],
            zones: vec![0.0; self.num_zones],
            stretched: vec![0.0; self.num_zones],
            shapes: None,
            head: HeadPose::default(),
        }
    }
}
