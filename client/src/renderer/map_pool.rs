//! Maps that several characters on one device share: each distinct one is there once, for as long as someone uses it.

use sha2::{Digest, Sha256};
use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError, Weak};

/// What makes two maps the same on a device.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct MapKey {
    format: wgpu::TextureFormat,
    /// Width and height in texels, number of layers.
    size: [u32; 3],
    num_levels: u32,
    /// SHA-256 of the texels of all layers before they are compressed, largest level: characters come from strangers, and a
    /// weaker hash would let one put its maps on another.
    digest: [u8; 32],
}

impl MapKey {
    /// The key of a map of `size` (width, height, layers), whose texels come in `pieces`, always cut the same way.
    pub fn new<'a>(format: wgpu::TextureFormat, size: wgpu::Extent3d, num_levels: u32, pieces: impl IntoIterator<Item = &'a [u8]>) -> Self {
        let digest = pieces.into_iter().fold(Sha256::new(), |digest, piece| digest.chain_update(piece)).finalize();
        Self { format, size: [size.width, size.height, size.depth_or_array_layers], num_levels, digest: digest.into() }
    }
}

/// One map on the device, which leaves its pool when the last character that uses it is dropped.
#[derive(Debug)]
pub struct PooledMap {
    /// Never written again after it was filled.
    pub texture: wgpu::Texture,
    /// Of all layers and levels.
    pub bytes: u64,
    key: MapKey,
    pool: Weak<Mutex<Maps>>,
}

type Maps = HashMap<MapKey, Weak<PooledMap>>;

/// The maps of all characters on one device. Clones are the same pool; one pool serves one device.
#[derive(Debug, Clone, Default)]
pub struct MapPool {
    maps: Arc<Mutex<Maps>>,
}

impl MapPool {
    /// Without maps.
    pub fn new() -> Self {
        Self::default()
    }

    /// Number of maps in use.
    pub fn num_maps(&self) -> usize {
        self.in_use().len()
    }

    /// Bytes of the maps in use, each counted once.
    pub fn bytes(&self) -> u64 {
        self.in_use().iter().map(|map| map.bytes).sum()
    }

    fn in_use(&self) -> Vec<Arc<PooledMap>> {
        // Taken out of the lock's scope: dropping the last use of a map takes the lock as well.
        let maps = self.maps.lock().unwrap_or_else(PoisonError::into_inner);
        maps.values().filter_map(Weak::upgrade).collect()
    }

    /// The map of `key`, made (texture and bytes) by `make` unless it is there already.
    pub(super) fn map_of(&self, key: MapKey, make: impl FnOnce() -> (wgpu::Texture, u64)) -> Arc<PooledMap> {
        let known = self.maps.lock().unwrap_or_else(PoisonError::into_inner).get(&key).and_then(Weak::upgrade);
        known.unwrap_or_else(|| {
            let (texture, bytes) = make();
            let map = Arc::new(PooledMap { texture, bytes, key, pool: Arc::downgrade(&self.maps) });
            self.maps.lock().unwrap_or_else(PoisonError::into_inner).insert(key, Arc::downgrade(&map));
            map
        })
    }
}

impl Drop for PooledMap {
    fn drop(&mut self) {
        let Some(maps) = self.pool.upgrade() else { return };
        let mut maps = maps.lock().unwrap_or_else(PoisonError::into_inner);
        // Another of the same key may stand there by now.
        if maps.get(&self.key).is_some_and(|map| map.strong_count() == 0) {
            maps.remove(&self.key);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn key(format: wgpu::TextureFormat, size: [u32; 3], num_levels: u32, texels: &[u8]) -> MapKey {
        let size = wgpu::Extent3d { width: size[0], height: size[1], depth_or_array_layers: size[2] };
        MapKey::new(format, size, num_levels, [texels])
    }

    #[test]
    fn maps_are_the_same_by_texels_format_and_size() {
        let of = |format, size, num_levels, texels: &[u8]| key(format, size, num_levels, texels);
        let rg = wgpu::TextureFormat::Rg8Unorm;
        let one = of(rg, [2, 1, 1], 1, &[1, 2, 3, 4]);
        assert_eq!(one, of(rg, [2, 1, 1], 1, &[1, 2, 3, 4]));
        assert_ne!(one, of(rg, [2, 1, 1], 1, &[1, 2, 3, 5]));
        assert_ne!(one, of(rg, [1, 2, 1], 1, &[1, 2, 3, 4]));
        assert_ne!(one, of(rg, [1, 1, 2], 1, &[1, 2, 3, 4]));
        assert_ne!(one, of(rg, [2, 1, 1], 2, &[1, 2, 3, 4]));
        assert_ne!(one, of(wgpu::TextureFormat::Rg8Snorm, [2, 1, 1], 1, &[1, 2, 3, 4]));
    }
}
