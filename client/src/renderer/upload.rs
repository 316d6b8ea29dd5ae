//! Puts a decoded character on the device and counts the bytes.

use super::blood;
use super::coefficients::pose_table;
use super::layouts::Layouts;
use super::map_pool::{MapKey, MapPool, PooledMap};
use super::regions::{self, Region};
use super::uniforms;
use crate::asset::{Alpha, CharacterAsset, MaterialAsset, MipChain, Morphs, PrimitiveAsset, Surface, Texels};
use std::borrow::Cow;
use std::sync::Arc;
use wgpu::util::DeviceExt;

/// Sides of a texel's footprint that are sampled at most: skin is seen at grazing angles all round its outline.
const ANISOTROPY: u16 = 8;
/// Half precision: 8 µm for a displacement of 16 mm.
const MORPH_FORMAT: wgpu::TextureFormat = wgpu::TextureFormat::Rgba16Float;

/// Creates objects on one device and counts their bytes.
#[derive(Debug)]
pub struct Uploader<'a> {
    pub device: &'a wgpu::Device,
    pub queue: &'a wgpu::Queue,
    /// Maps of this and other characters on the device.
    pub pool: &'a MapPool,
    /// Maps used so far, each once.
    pub maps: Vec<Arc<PooledMap>>,
    /// Bytes used so far, those of maps that were there already as well.
    pub bytes: u64,
}

/// A part on the device.
#[derive(Debug)]
pub struct Primitive {
    pub surface: Surface,
    pub alpha: Alpha,
    pub is_double_sided: bool,
    pub vertices: wgpu::Buffer,
    pub indices: wgpu::Buffer,
    pub num_indices: u32,
    /// The triangles by the poses that can wrinkle them.
    pub regions: Vec<Region>,
    /// Each edge once, as pairs of indices.
    pub edges: wgpu::Buffer,
    pub num_edge_indices: u32,
    /// Group 2; a draw call adds the offset of its region's block.
    pub material: wgpu::BindGroup,
    /// Bytes from one region's block to the next.
    pub region_stride: u32,
}

/// What of a character changes from frame to frame, its shapes and its wrinkle maps: group 1.
#[derive(Debug)]
pub struct CharacterGroup {
    pub palette: wgpu::Buffer,
    pub coefficients: wgpu::Buffer,
    pub morph_weights: wgpu::Buffer,
    pub wrinkle_weights: wgpu::Buffer,
    /// Change of haemoglobin.
    pub blood: wgpu::Texture,
    /// Bytes of the zones' masks and of their wrinkle map.
    pub zone_bytes: u64,
    pub group: wgpu::BindGroup,
}

impl<'a> Uploader<'a> {
    pub fn new(device: &'a wgpu::Device, queue: &'a wgpu::Queue, pool: &'a MapPool) -> Self {
        Self { device, queue, pool, maps: Vec::new(), bytes: 0 }
    }

    pub fn uniform(&mut self, label: &str, size: usize) -> wgpu::Buffer {
        self.bytes += size as u64;
        self.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some(label),
            size: size as u64,
            usage: wgpu::BufferUsages::UNIFORM | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        })
    }

    fn filled(&mut self, label: &str, contents: &[u8], usage: wgpu::BufferUsages) -> wgpu::Buffer {
        self.bytes += contents.len() as u64;
        self.device.create_buffer_init(&wgpu::util::BufferInitDescriptor { label: Some(label), contents, usage })
    }

    /// Layers that make an array on every back end: with OpenGL wgpu takes one layer for no array and six square ones for a
    /// cube. What is added is never read.
    fn as_array<'c>(&self, layers: &[&'c MipChain]) -> Vec<&'c MipChain> {
        let mut layers = layers.to_vec();
        let is_taken_for_another = layers.len() == 1 || layers.len().is_multiple_of(6);
        if self.device.adapter_info().backend == wgpu::Backend::Gl && is_taken_for_another {
            layers.extend(layers.last().copied());
        }
        layers
    }

    /// Layers of the same size and kind as one array texture. Levels larger than the device takes are left out.
    fn texture(&mut self, label: &str, layers: &[&MipChain]) -> wgpu::Texture {
        let format = match layers[0].texels {
            Texels::AlbedoSrgb => wgpu::TextureFormat::Rgba8UnormSrgb,
            Texels::Slopes | Texels::Linear2 => wgpu::TextureFormat::Rg8Unorm,
            Texels::Linear4 => wgpu::TextureFormat::Rgba8Unorm,
        };
        self.texture_of(label, layers, format, |chain, level, _| chain.levels[level].as_slice().into())
    }

    /// As [`Uploader::texture`], compressed in blocks where the device has those: slopes as BC5, four values as BC3.
    fn compressed_texture(&mut self, label: &str, layers: &[&MipChain]) -> wgpu::Texture {
        let is_in_blocks = layers[0].size.iter().all(|side| side % 4 == 0);
        if !is_in_blocks || !self.device.features().contains(wgpu::Features::TEXTURE_COMPRESSION_BC) {
            return self.texture(label, layers);
        }
        let (format, encoder) = match layers[0].texels {
            Texels::Slopes | Texels::Linear2 => (wgpu::TextureFormat::Bc5RgUnorm, texpresso::Format::Bc5),
            Texels::AlbedoSrgb => (wgpu::TextureFormat::Bc3RgbaUnormSrgb, texpresso::Format::Bc3),
            Texels::Linear4 => (wgpu::TextureFormat::Bc3RgbaUnorm, texpresso::Format::Bc3),
        };
        self.texture_of(label, layers, format, |chain, level, [width, height]| {
            let rgba: Vec<u8> = match chain.texels.size() {
                2 => chain.levels[level].as_chunks::<2>().0.iter().flat_map(|&[r, g]| [r, g, 0, 255]).collect(),
                _ => chain.levels[level].clone(),
            };
            // Masks are four maps in one: each channel counts the same.
            let params = texpresso::Params { algorithm: texpresso::Algorithm::ClusterFit, weights: [1.0; 3], weigh_colour_by_alpha: false };
            let mut blocks = vec![0; encoder.compressed_size(width as usize, height as usize)];
            encoder.compress(&rgba, width as usize, height as usize, params, &mut blocks);
            blocks.into()
        })
    }

    /// `encoded` gives the bytes of a level of a chain, whose size in texels it is told.
    fn texture_of(
        &mut self,
        label: &str,
        layers: &[&MipChain],
        format: wgpu::TextureFormat,
        encoded: impl for<'c> Fn(&'c MipChain, usize, [u32; 2]) -> Cow<'c, [u8]>,
    ) -> wgpu::Texture {
        let most = self.device.limits().max_texture_dimension_2d;
        let first = layers[0];
        let side_at = |level: usize, axis: usize| (first.size[axis] >> level).max(1);
        let skipped = (0..first.levels.len()).find(|&level| side_at(level, 0).max(side_at(level, 1)) <= most).unwrap_or(0);
        let size = wgpu::Extent3d { width: side_at(skipped, 0), height: side_at(skipped, 1), depth_or_array_layers: layers.len() as u32 };
        let num_levels = (first.levels.len() - skipped) as u32;
        // The smaller levels follow from the largest.
        let texels = layers.iter().map(|chain| chain.levels[skipped].as_slice());
        let key = MapKey::new(format, size, num_levels, texels);
        let (device, queue) = (self.device, self.queue);
        self.pooled(key, || {
            let texture = device.create_texture(&map_descriptor(label, size, num_levels, format));
            let (block_width, _) = format.block_dimensions();
            let block_bytes = format.block_copy_size(None).unwrap_or(4);
            let mut num_bytes = 0;
            for (layer, chain) in layers.iter().enumerate() {
                for level in skipped..chain.levels.len() {
                    let size = wgpu::Extent3d { width: side_at(level, 0), height: side_at(level, 1), depth_or_array_layers: 1 };
                    let bytes = encoded(chain, level, [size.width, size.height]);
                    queue.write_texture(
                        wgpu::TexelCopyTextureInfo {
                            texture: &texture,
                            mip_level: (level - skipped) as u32,
                            origin: wgpu::Origin3d { x: 0, y: 0, z: layer as u32 },
                            aspect: wgpu::TextureAspect::All,
                        },
                        &bytes,
                        wgpu::TexelCopyBufferLayout {
                            offset: 0,
                            bytes_per_row: Some(size.width.div_ceil(block_width) * block_bytes),
                            rows_per_image: None,
                        },
                        size.physical_size(format),
                    );
                    num_bytes += bytes.len() as u64;
                }
            }
            (texture, num_bytes)
        })
    }

    /// The map of `key`, made only if no character on the device has it.
    fn pooled(&mut self, key: MapKey, make: impl FnOnce() -> (wgpu::Texture, u64)) -> wgpu::Texture {
        let map = self.pool.map_of(key, make);
        let texture = map.texture.clone();
        // Two materials of one character may share a map as well.
        if !self.maps.iter().any(|known| Arc::ptr_eq(known, &map)) {
            self.bytes += map.bytes;
            self.maps.push(map);
        }
        texture
    }

    /// Wrinkle maps and the uniforms of a frame.
    pub fn character(&mut self, layouts: &Layouts, asset: &CharacterAsset) -> CharacterGroup {
        let palette = self.uniform("joint palette", size_of::<uniforms::PaletteRows>());
        let coefficients = self.uniform("influence coefficients", size_of::<uniforms::CoefficientVectors>());
        let table = self.filled("pose table", bytemuck::bytes_of(&pose_table(asset)), wgpu::BufferUsages::UNIFORM);
        let flat = MipChain::uniform([1, 1], Texels::Slopes, &[128, 128]);
        let layers: Vec<&MipChain> = match &asset.wrinkles {
            Some(wrinkles) => wrinkles.layers.iter().collect(),
            None => vec![&flat],
        };
        let maps = self.texture("wrinkle maps", &self.as_array(&layers));
        let view =
            maps.create_view(&wgpu::TextureViewDescriptor { dimension: Some(wgpu::TextureViewDimension::D2Array), ..Default::default() });
        let sampler = self.map_sampler("wrinkle sampler");
        let morph_deltas = self.morph_deltas(&asset.morphs);
        let morph_weights = self.uniform("morph weights", size_of::<uniforms::MorphWeights>());
        let wrinkle_weights = self.uniform("wrinkle weights", size_of::<uniforms::WrinkleWeights>());
        let (no_mask, no_difference) =
            (MipChain::uniform([1, 1], Texels::Linear4, &[0; 4]), MipChain::uniform([1, 1], Texels::Linear4, &[128; 4]));
        let before = self.bytes;
        let (masks, zone_maps, difference) = match &asset.zones {
            Some(zones) => {
                let masks = self.compressed_texture("zone masks", &[&zones.masks[0], &zones.masks[1]]);
                // Without a map for stretching one layer is enough.
                let layers: &[&MipChain] = if zones.stretch_scale > 0.0 { &[&zones.map, &zones.stretch] } else { &[&zones.map] };
                let maps = self.compressed_texture("zone maps", &self.as_array(layers));
                (masks, maps, zones.difference.as_ref())
            }
            None => (self.texture("no masks", &[&no_mask, &no_mask]), self.texture("no zones", &self.as_array(&[&flat])), None),
        };
        let zone_bytes = self.bytes - before;
        let difference = self.texture("zone differences", &[difference.unwrap_or(&no_difference)]);
        let blood = self.blood(asset.blood.as_ref().map_or(1, |maps| maps.side));
        let array = |texture: &wgpu::Texture| {
            texture.create_view(&wgpu::TextureViewDescriptor { dimension: Some(wgpu::TextureViewDimension::D2Array), ..Default::default() })
        };
        let (masks, zone_maps, difference) =
            (array(&masks), array(&zone_maps), difference.create_view(&wgpu::TextureViewDescriptor::default()));
        let group = self.device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some("character"),
            layout: &layouts.character,
            entries: &[
                entry(0, palette.as_entire_binding()),
                entry(1, coefficients.as_entire_binding()),
                entry(2, table.as_entire_binding()),
                entry(3, wgpu::BindingResource::TextureView(&view)),
                entry(4, wgpu::BindingResource::Sampler(&sampler)),
                entry(5, wgpu::BindingResource::TextureView(&morph_deltas)),
                entry(6, morph_weights.as_entire_binding()),
                entry(7, wgpu::BindingResource::TextureView(&masks)),
                entry(8, wgpu::BindingResource::TextureView(&zone_maps)),
                entry(9, wgpu::BindingResource::TextureView(&difference)),
                entry(10, wrinkle_weights.as_entire_binding()),
                entry(11, wgpu::BindingResource::TextureView(&blood.create_view(&wgpu::TextureViewDescriptor::default()))),
            ],
        });
        CharacterGroup { palette, coefficients, morph_weights, wrinkle_weights, blood, zone_bytes, group }
    }

    /// The map of blood, `side` texels a side, as it is at rest.
    fn blood(&mut self, side: u32) -> wgpu::Texture {
        let texture = self.device.create_texture(&wgpu::TextureDescriptor {
            label: Some("change of blood"),
            size: wgpu::Extent3d { width: side, height: side, depth_or_array_layers: 1 },
            mip_level_count: 1,
            sample_count: 1,
            dimension: wgpu::TextureDimension::D2,
            format: blood::FORMAT,
            usage: wgpu::TextureUsages::TEXTURE_BINDING | wgpu::TextureUsages::COPY_DST,
            view_formats: &[],
        });
        self.bytes += u64::from(side) * u64::from(side);
        write_blood(self.queue, &texture, &vec![blood::UNCHANGED; (side * side) as usize]);
        texture
    }

    /// The deltas of all shapes; rows are filled up with zeros.
    fn morph_deltas(&mut self, morphs: &Morphs) -> wgpu::TextureView {
        let [width, height] = morphs.texture_size();
        let mut texels = morphs.texels.clone();
        texels.resize((width * height) as usize, [half::f16::ZERO; 4]);
        let bytes: &[u8] = bytemuck::cast_slice(&texels);
        let size = wgpu::Extent3d { width, height, depth_or_array_layers: 1 };
        let (device, queue) = (self.device, self.queue);
        let texture = self.pooled(MapKey::new(MORPH_FORMAT, size, 1, [bytes]), || {
            let descriptor = map_descriptor("morph deltas", size, 1, MORPH_FORMAT);
            let texture = device.create_texture_with_data(queue, &descriptor, wgpu::util::TextureDataOrder::LayerMajor, bytes);
            (texture, bytes.len() as u64)
        });
        texture.create_view(&wgpu::TextureViewDescriptor::default())
    }

    /// One part with its material.
    pub fn primitive(&mut self, layouts: &Layouts, character: &CharacterAsset, asset: &PrimitiveAsset) -> Primitive {
        let edges = edges(&asset.indices);
        let (indices, regions) = regions::split(character, asset);
        let label = |what: &str| format!("{} {what}", asset.name);
        Primitive {
            surface: asset.surface,
            alpha: asset.material.alpha,
            is_double_sided: asset.material.is_double_sided,
            vertices: self.filled(&label("vertices"), bytemuck::cast_slice(&asset.vertices), wgpu::BufferUsages::VERTEX),
            indices: self.filled(&label("triangles"), bytemuck::cast_slice(&indices), wgpu::BufferUsages::INDEX),
            num_indices: indices.len() as u32,
            edges: self.filled(&label("edges"), bytemuck::cast_slice(&edges), wgpu::BufferUsages::INDEX),
            num_edge_indices: edges.len() as u32,
            material: self.material(layouts, &asset.name, &asset.material, &regions),
            region_stride: self.region_stride(),
            regions,
        }
    }

    /// Bytes from one region's block to the next: as close as the device binds them.
    fn region_stride(&self) -> u32 {
        self.device.limits().min_uniform_buffer_offset_alignment.max(size_of::<uniforms::Region>() as u32)
    }

    fn material(&mut self, layouts: &Layouts, name: &str, asset: &MaterialAsset, regions: &[Region]) -> wgpu::BindGroup {
        let block = uniforms::Material {
            base_color: asset.base_color,
            normal_scale: asset.normal_scale,
            roughness: asset.roughness,
            occlusion_strength: asset.occlusion_strength,
            has_intensity: f32::from(u8::from(asset.has_intensity)),
        };
        let label = |what: &str| format!("{name} {what}");
        let block = self.filled(&label("material"), bytemuck::bytes_of(&block), wgpu::BufferUsages::UNIFORM);
        let mut view = |what: &str, chain: &Option<MipChain>, texels: Texels, missing: &[u8]| {
            let texture = match chain {
                Some(chain) => self.texture(&label(what), &[chain]),
                None => self.texture(&label(what), &[&MipChain::uniform([1, 1], texels, missing)]),
            };
            texture.create_view(&wgpu::TextureViewDescriptor::default())
        };
        let albedo = view("albedo", &asset.albedo, Texels::AlbedoSrgb, &[255; 4]);
        let normal = view("normal", &asset.normal, Texels::Slopes, &[128; 2]);
        let surface = view("surface", &asset.surface_map, Texels::Linear2, &[255; 2]);
        let sampler = self.map_sampler(&label("sampler"));
        let stride = self.region_stride() as usize;
        let mut blocks = vec![0; stride * regions.len().max(1)];
        for (bytes, region) in blocks.chunks_exact_mut(stride).zip(regions) {
            let block = uniforms::Region { poses: region.poses.into(), padding: [0; 3] };
            bytes[..size_of_val(&block)].copy_from_slice(bytemuck::bytes_of(&block));
        }
        let blocks = self.filled(&label("regions"), &blocks, wgpu::BufferUsages::UNIFORM);
        let region = wgpu::BufferBinding { buffer: &blocks, offset: 0, size: wgpu::BufferSize::new(size_of::<uniforms::Region>() as u64) };
        self.device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some(name),
            layout: &layouts.material,
            entries: &[
                entry(0, block.as_entire_binding()),
                entry(1, wgpu::BindingResource::TextureView(&albedo)),
                entry(2, wgpu::BindingResource::TextureView(&normal)),
                entry(3, wgpu::BindingResource::TextureView(&surface)),
                entry(4, wgpu::BindingResource::Sampler(&sampler)),
                entry(5, wgpu::BindingResource::Buffer(region)),
            ],
        })
    }

    fn map_sampler(&self, label: &str) -> wgpu::Sampler {
        // A processor that draws takes several times as long for the whole frame with it.
        let is_software = self.device.adapter_info().device_type == wgpu::DeviceType::Cpu;
        self.device.create_sampler(&wgpu::SamplerDescriptor {
            label: Some(label),
            address_mode_u: wgpu::AddressMode::Repeat,
            address_mode_v: wgpu::AddressMode::Repeat,
            mag_filter: wgpu::FilterMode::Linear,
            min_filter: wgpu::FilterMode::Linear,
            mipmap_filter: wgpu::MipmapFilterMode::Linear,
            anisotropy_clamp: if is_software { 1 } else { ANISOTROPY },
            ..Default::default()
        })
    }
}

/// A map to read from, filled once.
fn map_descriptor(label: &str, size: wgpu::Extent3d, mip_level_count: u32, format: wgpu::TextureFormat) -> wgpu::TextureDescriptor<'_> {
    wgpu::TextureDescriptor {
        label: Some(label),
        size,
        mip_level_count,
        sample_count: 1,
        dimension: wgpu::TextureDimension::D2,
        format,
        usage: wgpu::TextureUsages::TEXTURE_BINDING | wgpu::TextureUsages::COPY_DST,
        view_formats: &[],
    }
}

/// Fills the map of blood.
pub fn write_blood(queue: &wgpu::Queue, texture: &wgpu::Texture, codes: &[u8]) {
    let layout = wgpu::TexelCopyBufferLayout { offset: 0, bytes_per_row: Some(texture.width()), rows_per_image: None };
    queue.write_texture(texture.as_image_copy(), codes, layout, texture.size());
}

/// Shorthand for one entry of a bind group.
pub fn entry(binding: u32, resource: wgpu::BindingResource<'_>) -> wgpu::BindGroupEntry<'_> {
    wgpu::BindGroupEntry { binding, resource }
}

/// Each edge of the triangles once.
fn edges(indices: &[u32]) -> Vec<u32> {
    let triangles = indices.as_chunks::<3>().0.iter();
    let mut edges: Vec<[u32; 2]> = triangles.flat_map(|&[a, b, c]| [(a, b), (b, c), (c, a)].map(|(a, b)| [a.min(b), a.max(b)])).collect();
    edges.sort_unstable();
    edges.dedup();
    edges.into_flattened()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_edge_two_triangles_share_is_drawn_once() {
        assert_eq!(edges(&[0, 1, 2, 2, 1, 3]), [0, 1, 0, 2, 1, 2, 1, 3, 2, 3]);
    }
}
