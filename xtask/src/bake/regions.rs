//! What each vertex of the skin belongs to, from MakeHuman's masks in the body atlas and from the islands.

use super::bust::Region;
use super::mesh::Mesh;
use super::source::Source;
use super::uv::Island;
use anyhow::{Context, Result};
use glam::Vec2;
use image::GrayImage;

/// Masks, from the one that wins where several cover a vertex.
const MASKS: [(&str, Region); 4] = [
    ("mpfb_lips.jpg", Region::Lips),
    ("mpfb_eyelids.jpg", Region::Eyelid),
    ("mpfb_ears.jpg", Region::Ear),
    ("mpfb_face.jpg", Region::Face),
];

/// The masks, decoded.
pub struct Masks(Vec<(GrayImage, Region)>);

impl Masks {
    /// Reads the masks.
    pub fn load(source: &mut Source) -> Result<Self> {
        MASKS
            .into_iter()
            .map(|(name, region)| {
                let bytes = source.read(&format!("mpfb2/textures/{name}"))?;
                Ok((image::load_from_memory(&bytes).with_context(|| format!("cannot decode {name}"))?.to_luma8(), region))
            })
            .collect::<Result<_>>()
            .map(Self)
    }

    fn at(&self, uv: Vec2) -> Option<Region> {
        self.0.iter().find_map(|(mask, region)| {
            let texel = |share: f32, size: u32| ((share * size as f32) as u32).min(size - 1);
            let level = mask.get_pixel(texel(uv.x, mask.width()), texel(1.0 - uv.y, mask.height())).0[0];
            (level > 127).then_some(*region)
        })
    }

    /// Region of every UV of `mesh`, which still lies in the body atlas: only what the masks say.
    pub fn sample(&self, mesh: &Mesh) -> Vec<Option<Region>> {
        mesh.uvs.iter().map(|&uv| self.at(uv)).collect()
    }
}

/// Region of every vertex, from its UVs' masks and islands.
pub fn of_vertices(mesh: &Mesh, masks: &[Option<Region>], islands: &[Island]) -> Vec<Region> {
    let mut regions: Vec<Option<Region>> = vec![None; mesh.positions.len()];
    for face in &mesh.faces {
        for (&v, &t) in face.vertices.iter().zip(&face.uvs) {
            let region = match islands[t as usize] {
                Island::Head => masks[t as usize].unwrap_or(Region::Body),
                Island::Torso => Region::Body,
                Island::Mouth => Region::Mouth,
                Island::SocketLeft | Island::SocketRight => Region::Socket,
                Island::Cap => Region::Cap,
            };
            // On a seam the outer side's region counts: regions are ordered from the face inwards.
            let entry = regions[v as usize].get_or_insert(region);
            *entry = (*entry).min(region);
        }
    }
    regions.into_iter().map(|region| region.unwrap_or(Region::Body)).collect()
}
