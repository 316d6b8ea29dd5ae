//! A character on the device.

use super::blood::Blood;
use super::layouts::Layouts;
use super::map_pool::PooledMap;
use super::upload::{CharacterGroup, Primitive, Uploader};
use super::zones::ZoneScales;
use crate::asset::{CharacterAsset, Palette};
use glam::Vec3;
use rhytid_shared::Character;
use std::sync::Arc;

/// All of a character that is drawn, whatever draws it.
#[derive(Debug)]
pub struct Model {
    pub character: Arc<Character>,
    pub palette: Palette,
    pub has_shapes: bool,
    pub bounds: Bounds,
    pub primitives: Vec<Primitive>,
    pub group: CharacterGroup,
    pub zone_scales: Option<ZoneScales>,
    pub blood: Option<Blood>,
    /// Of buffers and maps, shared ones included.
    pub bytes: u64,
    /// What the bind groups read from: kept in the pool for as long as this character is drawn.
    pub maps: Vec<Arc<PooledMap>>,
}

/// Sphere round the neutral character, metres, model space.
#[derive(Debug, Clone, Copy)]
pub struct Bounds {
    pub centre: Vec3,
    pub radius: f32,
}

impl Model {
    /// Uploads `asset`.
    pub fn new(uploader: &mut Uploader<'_>, layouts: &Layouts, asset: &CharacterAsset) -> Self {
        let primitives = asset.primitives.iter().map(|primitive| uploader.primitive(layouts, asset, primitive)).collect();
        Self {
            character: Arc::clone(&asset.character),
            palette: asset.palette.clone(),
            has_shapes: !asset.morphs.is_empty(),
            bounds: Bounds::new(asset),
            primitives,
            group: uploader.character(layouts, asset),
            zone_scales: asset.zones.as_ref().map(ZoneScales::new),
            blood: asset.blood.as_ref().map(|maps| Blood::new(&asset.character, maps)),
            bytes: uploader.bytes,
            maps: std::mem::take(&mut uploader.maps),
        }
    }
}

impl Bounds {
    fn new(asset: &CharacterAsset) -> Self {
        let positions =
            || asset.primitives.iter().flat_map(|primitive| primitive.vertices.iter().map(|vertex| Vec3::from(vertex.position)));
        let (low, high) =
            positions().fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(low, high), position| (low.min(position), high.max(position)));
        let centre = (low + high) * 0.5;
        let radius = positions().map(|position| position.distance(centre)).fold(0.01, f32::max);
        Self { centre, radius }
    }
}
