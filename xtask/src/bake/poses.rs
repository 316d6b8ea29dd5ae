//! The four reference poses, from the expression shapes' own displacements where the bones stand.

use super::mesh::Mesh;
use super::rig::Rig;
use super::weights::shape;
use glam::Vec3;
use rhytid_shared::character::schema::{Corrective, Drive, Pose};
use std::collections::BTreeMap;

/// A pose: shapes at a weight (above 1 where the shape is too timid), and the bones it moves by name without `_l`, `_r`.
pub struct PoseRecipe {
    /// Name in the file.
    pub name: &'static str,
    shapes: &'static [(&'static str, f32)],
    bones: &'static [&'static str],
    /// Added by hand, left side; x is outwards. Metres.
    by_hand: &'static [(&'static str, Vec3)],
}

const fn mm(x: f32, y: f32, z: f32) -> Vec3 {
    Vec3::new(x * 1e-3, y * 1e-3, z * 1e-3)
}

/// In the order of the file. Brow travels after what people do (8 to 10 mm up, 5 to 6 mm down and in), which is twice as
/// much as MakeHuman's shapes give; the mouth's come from the shapes.
pub const POSES: [PoseRecipe; 4] = [
    PoseRecipe {
        name: "stretch",
        shapes: &[],
        bones: &["brow_inner", "brow_mid", "brow_outer", "brow_tail", "glabella"],
        by_hand: &[
            ("brow_inner", mm(0.0, 8.5, -0.6)),
            ("brow_mid", mm(0.4, 9.0, -1.6)),
            ("brow_outer", mm(1.0, 8.8, -2.4)),
            ("brow_tail", mm(1.4, 6.0, -1.8)),
            ("glabella", mm(0.0, 7.0, -0.2)),
        ],
    },
    PoseRecipe {
        name: "compress",
        shapes: &[("noseSneerLeft", 1.0), ("noseSneerRight", 1.0)],
        bones: &["brow_inner", "brow_mid", "brow_outer", "glabella", "nose_wing"],
        by_hand: &[
            ("brow_inner", mm(-2.6, -5.2, 1.4)),
            ("brow_mid", mm(-2.2, -5.6, 1.3)),
            ("brow_outer", mm(-1.4, -4.4, 1.0)),
            ("glabella", mm(0.0, -5.0, 1.4)),
            ("nose_wing", mm(0.3, 1.6, 0.0)),
        ],
    },
    PoseRecipe {
        name: "smile",
        // Only bones that a smile moves far and other expressions move elsewhere: the lips between the corners rise in a
        // smile as they do in any raised lip. Segments are as long as the smiles people make before a camera.
        shapes: &[("mouthSmileLeft", 0.62), ("mouthSmileRight", 0.62), ("cheekSquintLeft", 0.5), ("cheekSquintRight", 0.5)],
        bones: &["lip_corner", "lip_lower_outer", "cheek", "nasolabial"],
        by_hand: &[("lip_corner", mm(1.3, -1.0, 0.0))],
    },
    PoseRecipe {
        name: "pucker",
        shapes: &[("mouthPucker", 1.15), ("mouthShrugLower", 0.5)],
        bones: &["lip_corner", "lip_upper_outer", "lip_upper", "lip_upper_mid", "lip_lower_outer", "lip_lower", "lip_lower_mid", "chin"],
        by_hand: &[("lip_corner", mm(-2.0, 0.0, 0.0)), ("chin", mm(0.0, 5.8, 0.4))],
    },
];

impl PoseRecipe {
    /// Displacement of every skin bone the pose moves, by the bone's name.
    pub fn displacements(&self, mesh: &Mesh, rig: &Rig) -> BTreeMap<String, Vec3> {
        let skin_bones = rig.bones.iter().filter(|bone| matches!(bone.drive, Drive::Skin { .. }));
        skin_bones
            .zip(&rig.reaches)
            .filter_map(|(bone, reach)| {
                let stem = bone.name.strip_suffix("_l").or(bone.name.strip_suffix("_r")).unwrap_or(&bone.name);
                self.bones.contains(&stem).then(|| {
                    let from_shapes: Vec3 =
                        self.shapes.iter().map(|&(name, weight)| mesh.morphs[shape(name)][reach.vertex as usize] * weight).sum();
                    let mirror = Vec3::new(if bone.name.ends_with("_r") { -1.0 } else { 1.0 }, 1.0, 1.0);
                    let by_hand: Vec3 = self.by_hand.iter().filter(|(name, _)| *name == stem).map(|&(_, delta)| delta * mirror).sum();
                    (bone.name.clone(), from_shapes + by_hand)
                })
            })
            .collect()
    }

    /// The pose as the file has it, without its map.
    pub fn pose(&self, mesh: &Mesh, rig: &Rig) -> Pose {
        let displacements = self.displacements(mesh, rig);
        let rest = |name: &str| rig.bones.iter().find(|bone| bone.name == name).map_or(Vec3::ZERO, |bone| bone.point.into());
        let bones = displacements.into_iter().map(|(name, delta)| (rest(&name) + delta, name)).map(|(point, name)| (name, point.into()));
        Pose { name: self.name.to_owned(), bones: bones.collect(), map: None }
    }
}

/// A jaw that opens by this weight has parted the lips already...
const PARTED_AT: f32 = 0.12;
/// ...by so much more than the share of `jawOpen`: our lips rest on each other. Metres up.
const PARTED_BY: [(&str, f32); 5] =
    [("lip_lower_mid", -0.0015), ("lip_lower", -0.0014), ("lip_lower_outer", -0.0008), ("lip_upper_mid", 0.0004), ("lip_upper", 0.0003)];

/// What expression weights lack where they are taken in shares.
pub fn correctives(mesh: &Mesh, rig: &Rig) -> Vec<Corrective> {
    let skin_bones = rig.bones.iter().filter(|bone| matches!(bone.drive, Drive::Skin { .. }));
    let bones = skin_bones.zip(&rig.reaches).filter_map(|(bone, reach)| {
        let stem = bone.name.strip_suffix("_l").or(bone.name.strip_suffix("_r")).unwrap_or(&bone.name);
        let &(_, up) = PARTED_BY.iter().find(|(name, _)| *name == stem)?;
        let delta = mesh.morphs[shape("jawOpen")][reach.vertex as usize] * PARTED_AT + Vec3::Y * up;
        Some((bone.name.clone(), delta.into()))
    });
    vec![Corrective { weights: BTreeMap::from([("jawOpen".to_owned(), PARTED_AT)]), bones: bones.collect() }]
}
