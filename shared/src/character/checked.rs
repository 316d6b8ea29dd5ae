//! A character after its checks.

use super::colour::{self, Colour};
use super::schema::{self, Face};
use super::zones::{self, Zones};
use crate::layout::NUM_IBUG;
use crate::limits::{MAX_BONE_TRAVEL, MAX_BONES, MAX_FEATURE_POINTS, MAX_POSES, MIN_POSE_TRAVEL};
use crate::names::ArkitShape;
use glam::Vec3;
use std::collections::BTreeMap;

pub use super::schema::{GroupDegenerate, LidKind, Mode, Side};

/// Why a character file was refused. Every message names the field and what was expected.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum CharacterError {
    /// Not a glTF binary, or a broken one.
    #[error("character file is not a readable .glb: {0}")]
    Glb(String),
    /// A field of the extension, the skin or the mesh has a value it must not have.
    #[error("character field {field}: {problem}")]
    Field {
        /// Path of the field, e.g. `RHYTID_face.bones[3].point`.
        field: String,
        /// What was wrong and what was expected.
        problem: String,
    },
}

impl CharacterError {
    pub(super) fn field(field: impl Into<String>, problem: impl Into<String>) -> Self {
        Self::Field { field: field.into(), problem: problem.into() }
    }
}

pub(super) type Result<T> = std::result::Result<T, CharacterError>;

/// A character, checked. Positions are metres in head space; `n` bones, `o` poses.
#[derive(Debug, Clone, PartialEq)]
pub struct Character {
    /// Shown to people.
    pub name: String,
    /// SHA-256 of the file, lower-case hex.
    pub sha256: String,
    /// Node name of the joint that carries the head.
    pub head_joint: String,
    /// Point about which the head turns.
    pub head_pivot: Vec3,
    /// The 68 iBUG landmarks on the neutral mesh.
    pub ibug68: Box<[Vec3; NUM_IBUG]>,
    /// Named feature points: the file's own and every bone's point.
    pub features: BTreeMap<String, Vec3>,
    /// The `n` bones.
    pub bones: Vec<Bone>,
    /// Groups of bone indices; a bone is in one at most.
    pub groups: Vec<Vec<usize>>,
    /// The `o` reference poses.
    pub poses: Vec<Pose>,
    /// Expression shapes the mesh has, with what each does to the bones.
    pub shapes: Vec<ShapeDeltas>,
    /// Authored combinations.
    pub correctives: Vec<Corrective>,
    /// Wrinkle zones, where the character has them.
    pub zones: Option<Zones>,
    /// How the skin's colour follows the face, where it does.
    pub colour: Option<Colour>,
    /// How several poses on one bone share its displacement.
    pub mode: Mode,
    /// What a group member does that a pose does not move.
    pub group_degenerate: GroupDegenerate,
    /// Weight from which wrinkles stop fading with the skinning weights, in (0, 1].
    pub falloff: f32,
}

/// A bone, checked.
#[derive(Debug, Clone, PartialEq)]
pub struct Bone {
    /// Unique name.
    pub name: String,
    /// Node name of the joint.
    pub joint: String,
    /// Evaluated point at rest.
    pub rest: Vec3,
    /// What moves it.
    pub drive: Drive,
    /// Multiplies the displacement per axis (angles: x).
    pub gain: Vec3,
    /// Index of the turning bone whose rotation this one copies.
    pub turns_with: Option<usize>,
}

impl Bone {
    /// The point about which this bone turns, if it turns by itself.
    pub fn pivot(&self) -> Option<Vec3> {
        match self.drive {
            Drive::Jaw { pivot, .. } | Drive::Lid { pivot, .. } | Drive::Eye { pivot, .. } => Some(pivot),
            Drive::Skin { .. } | Drive::Still => None,
        }
    }
}

/// A landmark's share in a bone's motion.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LandmarkWeight {
    /// iBUG index.
    pub landmark: usize,
    /// Share.
    pub weight: f32,
}

/// What moves a bone, checked.
#[derive(Debug, Clone, PartialEq)]
pub enum Drive {
    /// Translates by weighted landmark displacements.
    Skin {
        /// At least one.
        landmarks: Vec<LandmarkWeight>,
    },
    /// Turns about `pivot` so that the driver point follows the landmarks.
    Jaw {
        /// Centre of the hinge.
        pivot: Vec3,
        /// At least one.
        landmarks: Vec<LandmarkWeight>,
        /// Widest opening, radians.
        max_angle: f32,
    },
    /// Turns about +X through `pivot` by the openness of one eye.
    Lid {
        /// Which eye.
        eye: Side,
        /// Which lid.
        lid: LidKind,
        /// Centre of the eyeball.
        pivot: Vec3,
        /// Angle that shuts the eye, radians.
        shut_angle: f32,
        /// Angle at the widest, radians.
        wide_angle: f32,
    },
    /// Turns about `pivot` by gaze.
    Eye {
        /// Which eye.
        eye: Side,
        /// Centre of the eyeball.
        pivot: Vec3,
        /// Largest angle to the side and up or down, radians.
        range: [f32; 2],
    },
    /// Moved by `bones` frames only.
    Still,
}

/// A reference pose, checked.
#[derive(Debug, Clone, PartialEq)]
pub struct Pose {
    /// Unique name.
    pub name: String,
    /// `n` evaluated points; a bone the pose does not move has its rest point exactly.
    pub points: Vec<Vec3>,
    /// The wrinkles of this pose.
    pub map: Option<WrinkleMap>,
}

/// A wrinkle map's place in the file.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WrinkleMap {
    /// Index into glTF `textures`.
    pub texture: usize,
    /// Largest slope the codes reach.
    pub scale: f32,
    /// True where the map also contains the pores of the neutral map.
    pub contains_neutral: bool,
}

/// An expression shape's effect on bones and landmarks at weight 1.
#[derive(Debug, Clone, PartialEq)]
pub struct ShapeDeltas {
    /// Which shape.
    pub shape: ArkitShape,
    /// Morph target index in the mesh.
    pub target: usize,
    /// `n` displacements of the mesh at the bones' points, metres.
    pub deltas: Vec<Vec3>,
    /// 68 displacements of the mesh at the landmarks, metres.
    pub landmarks: Vec<Vec3>,
}

/// An authored combination, checked.
#[derive(Debug, Clone, PartialEq)]
pub struct Corrective {
    /// Weights of the example.
    pub weights: Vec<(ArkitShape, f32)>,
    /// `(bone index, displacement)` it shall have there, metres.
    pub bones: Vec<(usize, Vec3)>,
}

impl Character {
    /// Reads and checks a whole `.glb`: the extension, the skin, the mesh, the sizes of its images.
    pub fn from_glb(bytes: &[u8]) -> Result<Self> {
        super::glb::load(bytes)
    }

    /// Bones.
    pub fn num_bones(&self) -> usize {
        self.bones.len()
    }

    /// Reference poses, rest not counted.
    pub fn num_poses(&self) -> usize {
        self.poses.len()
    }

    /// Wrinkle zones; 0 for a character without any.
    pub fn num_zones(&self) -> usize {
        self.zones.as_ref().map_or(0, |zones| zones.list.len())
    }

    /// Index of the bone called `name`.
    pub fn bone_index(&self, name: &str) -> Option<usize> {
        self.bones.iter().position(|bone| bone.name == name)
    }

    /// Distance between the outer eye corners, metres: the face's own unit of length.
    pub fn interocular(&self) -> f32 {
        self.ibug68[36].distance(self.ibug68[45])
    }

    /// Checks the extension by itself. `head_pivot`, shapes and hash belong to the rest of the file and are given.
    pub(super) fn from_schema(face: &Face, head_pivot: Vec3, sha256: String) -> Result<Self> {
        if face.version != schema::VERSION {
            return Err(CharacterError::field(
                "RHYTID_face.version",
                format!("is {}, this program reads {}", face.version, schema::VERSION),
            ));
        }
        let head_pivot = check_point(head_pivot.to_array(), || format!("nodes: the origin of {:?}", face.head))?;
        let ibug68 = check_landmarks(face)?;
        let bones = check_bones(&face.bones)?;
        let index_of: BTreeMap<&str, usize> = bones.iter().enumerate().map(|(i, bone)| (bone.name.as_str(), i)).collect();
        let mut features = BTreeMap::new();
        for (name, point) in &face.features {
            features.insert(name.clone(), check_point(*point, || format!("RHYTID_face.features.{name}"))?);
        }
        features.extend(bones.iter().map(|bone| (bone.name.clone(), bone.rest)));
        if features.len() > MAX_FEATURE_POINTS {
            return Err(CharacterError::field(
                "RHYTID_face.features",
                format!("has {} points, at most {MAX_FEATURE_POINTS} are allowed", features.len()),
            ));
        }
        let groups = check_groups(&face.groups, &index_of)?;
        let poses = check_poses(&face.poses, &bones, &index_of)?;
        let correctives = check_correctives(&face.correctives, &index_of)?;
        let zones = face.zones.as_ref().map(|given| zones::check(given, &poses, &index_of)).transpose()?;
        let colour = face.colour.as_ref().map(|given| colour::check(given, &poses, zones.as_ref())).transpose()?;
        let falloff = face.evaluation.falloff;
        if !(falloff > 0.0 && falloff <= 1.0) {
            return Err(CharacterError::field(
                "RHYTID_face.evaluation.falloff",
                format!("is {falloff}, expected more than 0 and at most 1"),
            ));
        }
        Ok(Self {
            name: face.name.chars().take(128).collect(),
            sha256,
            head_joint: face.head.clone(),
            head_pivot,
            ibug68,
            features,
            bones,
            groups,
            poses,
            shapes: Vec::new(),
            correctives,
            zones,
            colour,
            mode: face.evaluation.mode,
            group_degenerate: face.evaluation.group_degenerate,
            falloff,
        })
    }
}

/// A head is about 0.25 m tall; a point a metre away means another unit.
const FARTHEST_POINT: f32 = 1.0;

fn check_point(point: [f32; 3], field: impl Fn() -> String) -> Result<Vec3> {
    let point = Vec3::from(point);
    if !point.is_finite() || point.abs().max_element() > FARTHEST_POINT {
        return Err(CharacterError::field(
            field(),
            format!("is {point}, expected finite metres within ±{FARTHEST_POINT} of the origin of head space"),
        ));
    }
    Ok(point)
}

fn check_landmarks(face: &Face) -> Result<Box<[Vec3; NUM_IBUG]>> {
    let field = "RHYTID_face.landmarks.ibug68";
    let given = face.landmarks.get("ibug68").ok_or_else(|| CharacterError::field(field, "is missing, expected 68 points"))?;
    if given.len() != NUM_IBUG {
        return Err(CharacterError::field(field, format!("has {} points, expected {NUM_IBUG}", given.len())));
    }
    let mut points = Box::new([Vec3::ZERO; NUM_IBUG]);
    for (i, point) in given.iter().enumerate() {
        points[i] = check_point(*point, || format!("{field}[{i}]"))?;
    }
    let interocular = points[36].distance(points[45]);
    if !(0.03..0.3).contains(&interocular) {
        return Err(CharacterError::field(
            field,
            format!("has its outer eye corners {interocular} m apart, expected 0.03 to 0.3 (are the units metres?)"),
        ));
    }
    if points[45].x <= points[36].x {
        return Err(CharacterError::field(
            field,
            "has the left eye (45) at smaller x than the right (36), expected +X to the character's left",
        ));
    }
    Ok(points)
}

fn check_bones(given: &[schema::Bone]) -> Result<Vec<Bone>> {
    if given.is_empty() || given.len() > MAX_BONES {
        return Err(CharacterError::field("RHYTID_face.bones", format!("has {} bones, expected 1 to {MAX_BONES}", given.len())));
    }
    let mut bones: Vec<Bone> = Vec::with_capacity(given.len());
    for (i, bone) in given.iter().enumerate() {
        let field = |part: &str| format!("RHYTID_face.bones[{i}].{part}");
        if bone.name.is_empty() || bone.name.len() > 64 {
            return Err(CharacterError::field(field("name"), "expected 1 to 64 bytes"));
        }
        if given[..i].iter().any(|other| other.name == bone.name) {
            return Err(CharacterError::field(field("name"), format!("{:?} is used twice, expected unique names", bone.name)));
        }
        let gain = Vec3::from(bone.gain);
        if !gain.is_finite() || gain.abs().max_element() > 10.0 {
            return Err(CharacterError::field(field("gain"), format!("is {gain}, expected finite values within ±10")));
        }
        let turns_with = match &bone.turns_with {
            None => None,
            Some(name) => Some(
                given
                    .iter()
                    .position(|other| other.name == *name && matches!(other.drive, schema::Drive::Jaw { .. }))
                    .ok_or_else(|| CharacterError::field(field("turns_with"), format!("{name:?} is not a jaw bone of this character")))?,
            ),
        };
        bones.push(Bone {
            name: bone.name.clone(),
            joint: bone.joint.clone().unwrap_or_else(|| bone.name.clone()),
            rest: check_point(bone.point, || field("point"))?,
            drive: check_drive(&bone.drive, field)?,
            gain,
            turns_with,
        });
    }
    Ok(bones)
}

fn check_drive(drive: &schema::Drive, field: impl Fn(&str) -> String) -> Result<Drive> {
    let pivot_of = |pivot: [f32; 3]| check_point(pivot, || field("drive.pivot"));
    let angle = |part: &str, degrees: f32, least: f32, most: f32| {
        if (least..=most).contains(&degrees) {
            Ok(degrees.to_radians())
        } else {
            Err(CharacterError::field(field(part), format!("is {degrees}, expected {least} to {most} degrees")))
        }
    };
    let landmarks_of = |given: &[(usize, f32)]| {
        if given.is_empty() || given.len() > NUM_IBUG {
            return Err(CharacterError::field(field("drive.landmarks"), format!("has {} entries, expected 1 to {NUM_IBUG}", given.len())));
        }
        given
            .iter()
            .map(|&(landmark, weight)| {
                if landmark >= NUM_IBUG {
                    Err(CharacterError::field(
                        field("drive.landmarks"),
                        format!("names landmark {landmark}, expected 0 to {}", NUM_IBUG - 1),
                    ))
                } else if !(weight.abs() > 0.0 && weight.abs() <= 2.0) {
                    Err(CharacterError::field(field("drive.landmarks"), format!("has weight {weight}, expected within ±2 and not 0")))
                } else {
                    Ok(LandmarkWeight { landmark, weight })
                }
            })
            .collect::<Result<Vec<_>>>()
    };
    Ok(match drive {
        schema::Drive::Skin { landmarks } => Drive::Skin { landmarks: landmarks_of(landmarks)? },
        schema::Drive::Jaw { pivot, landmarks, max_degrees } => Drive::Jaw {
            pivot: pivot_of(*pivot)?,
            landmarks: landmarks_of(landmarks)?,
            max_angle: angle("drive.max_degrees", *max_degrees, 1.0, 60.0)?,
        },
        schema::Drive::Lid { eye, lid, pivot, shut_degrees, wide_degrees } => Drive::Lid {
            eye: *eye,
            lid: *lid,
            pivot: pivot_of(*pivot)?,
            shut_angle: angle("drive.shut_degrees", *shut_degrees, -90.0, 90.0)?,
            wide_angle: angle("drive.wide_degrees", *wide_degrees, -45.0, 45.0)?,
        },
        schema::Drive::Eye { eye, pivot, range_degrees } => Drive::Eye {
            eye: *eye,
            pivot: pivot_of(*pivot)?,
            range: [
                angle("drive.range_degrees[0]", range_degrees[0], 1.0, 60.0)?,
                angle("drive.range_degrees[1]", range_degrees[1], 1.0, 60.0)?,
            ],
        },
        schema::Drive::Still => Drive::Still,
    })
}

fn check_groups(given: &[Vec<String>], index_of: &BTreeMap<&str, usize>) -> Result<Vec<Vec<usize>>> {
    let mut is_taken = vec![false; index_of.len()];
    let mut groups = Vec::with_capacity(given.len());
    for (g, names) in given.iter().enumerate() {
        let mut group = Vec::with_capacity(names.len());
        for name in names {
            let field = || format!("RHYTID_face.groups[{g}]");
            let &bone = index_of
                .get(name.as_str())
                .ok_or_else(|| CharacterError::field(field(), format!("names {name:?}, which is no bone of this character")))?;
            if std::mem::replace(&mut is_taken[bone], true) {
                return Err(CharacterError::field(
                    field(),
                    format!("names {name:?}, which is in a group already; a bone belongs to one at most"),
                ));
            }
            group.push(bone);
        }
        groups.push(group);
    }
    Ok(groups)
}

fn check_poses(given: &[schema::Pose], bones: &[Bone], index_of: &BTreeMap<&str, usize>) -> Result<Vec<Pose>> {
    if given.len() > MAX_POSES {
        return Err(CharacterError::field("RHYTID_face.poses", format!("has {} poses, at most {MAX_POSES} are allowed", given.len())));
    }
    let mut poses = Vec::with_capacity(given.len());
    for (k, pose) in given.iter().enumerate() {
        if pose.name.is_empty() || pose.name.len() > 64 || given[..k].iter().any(|other| other.name == pose.name) {
            return Err(CharacterError::field(
                format!("RHYTID_face.poses[{k}].name"),
                format!("is {:?}, expected 1 to 64 bytes, unique", pose.name),
            ));
        }
        let mut points: Vec<Vec3> = bones.iter().map(|bone| bone.rest).collect();
        for (name, point) in &pose.bones {
            let field = || format!("RHYTID_face.poses[{k}].bones.{name}");
            let &bone = index_of.get(name.as_str()).ok_or_else(|| CharacterError::field(field(), "is no bone of this character"))?;
            let point = check_point(*point, field)?;
            let travel = point - bones[bone].rest;
            if travel.length() > 0.0 && travel.length() < MIN_POSE_TRAVEL {
                return Err(CharacterError::field(
                    field(),
                    format!(
                        "moves the bone by {:.3} mm, expected nothing or at least {:.1} mm",
                        travel.length() * 1e3,
                        MIN_POSE_TRAVEL * 1e3
                    ),
                ));
            }
            if travel.abs().max_element() > MAX_BONE_TRAVEL {
                return Err(CharacterError::field(
                    field(),
                    format!("moves the bone by {travel} m, expected within ±{MAX_BONE_TRAVEL} m an axis"),
                ));
            }
            points[bone] = point;
        }
        if let Some(map) = &pose.map
            && !(map.scale > 0.0 && map.scale <= 4.0)
        {
            return Err(CharacterError::field(
                format!("RHYTID_face.poses[{k}].map.scale"),
                format!("is {}, expected more than 0 and at most 4", map.scale),
            ));
        }
        let map =
            pose.map.as_ref().map(|map| WrinkleMap { texture: map.texture, scale: map.scale, contains_neutral: map.contains_neutral });
        poses.push(Pose { name: pose.name.clone(), points, map });
    }
    Ok(poses)
}

fn check_correctives(given: &[schema::Corrective], index_of: &BTreeMap<&str, usize>) -> Result<Vec<Corrective>> {
    // Each example costs a Gaussian and a row a frame, and a dense solve at load.
    const MAX_CORRECTIVES: usize = 64;
    if given.len() > MAX_CORRECTIVES {
        return Err(CharacterError::field(
            "RHYTID_face.correctives",
            format!("has {} examples, at most {MAX_CORRECTIVES} are allowed", given.len()),
        ));
    }
    let mut correctives = Vec::with_capacity(given.len());
    for (e, corrective) in given.iter().enumerate() {
        let mut weights = Vec::with_capacity(corrective.weights.len());
        for (name, &weight) in &corrective.weights {
            let field = || format!("RHYTID_face.correctives[{e}].weights.{name}");
            let shape = ArkitShape::from_name(name).ok_or_else(|| CharacterError::field(field(), "is no ARKit shape"))?;
            if !(0.0..=1.0).contains(&weight) {
                return Err(CharacterError::field(field(), format!("is {weight}, expected 0 to 1")));
            }
            weights.push((shape, weight));
        }
        let mut bones = Vec::with_capacity(corrective.bones.len());
        for (name, &delta) in &corrective.bones {
            let field = || format!("RHYTID_face.correctives[{e}].bones.{name}");
            let &bone = index_of.get(name.as_str()).ok_or_else(|| CharacterError::field(field(), "is no bone of this character"))?;
            let delta = Vec3::from(delta);
            if !delta.is_finite() || delta.abs().max_element() > MAX_BONE_TRAVEL {
                return Err(CharacterError::field(
                    field(),
                    format!("is {delta} m, expected finite and within ±{MAX_BONE_TRAVEL} m an axis"),
                ));
            }
            bones.push((bone, delta));
        }
        correctives.push(Corrective { weights, bones });
    }
    Ok(correctives)
}
