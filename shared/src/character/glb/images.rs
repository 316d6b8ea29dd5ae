//! Checks images: kind, size and what all of them together will take by their headers alone; the small masks of wrinkle zones by
//! their texels.

use super::super::checked::{Character, CharacterError};
use super::super::zones::Zones;
use super::Result;
use crate::limits::{MAX_IMAGES, MAX_MASK_SIDE, MAX_TEXELS, MAX_TEXTURE_SIDE, MAX_ZONE_MAP_SIDE};
use image::{ImageFormat, ImageReader};
use std::io::Cursor;

/// Texels by width and height.
type Size = (u32, u32);

pub(super) fn check_images(document: &gltf::Document, blob: &[u8], character: &Character) -> Result<()> {
    let num_images = document.images().count();
    if num_images > MAX_IMAGES {
        return Err(CharacterError::field("images", format!("there are {num_images}, at most {MAX_IMAGES} are allowed")));
    }
    let size_of = document.images().map(|image| image_size(document, &image, blob)).collect::<Result<Vec<_>>>()?;
    let textures: Vec<usize> = document.textures().map(|texture| texture.source().index()).collect();
    check_wrinkle_maps(&textures, &size_of, character)?;
    if let Some(zones) = &character.zones {
        check_zone_maps(&textures, &size_of, zones)?;
        check_masks(document, &textures, &size_of, blob, zones)?;
    }
    check_total(document, &textures, &size_of, character)
}

fn image_size(document: &gltf::Document, image: &gltf::Image<'_>, blob: &[u8]) -> Result<Size> {
    let field = format!("images[{}]", image.index());
    // The gltf crate takes for granted what its validation does not check.
    let json = &document.as_json().images[image.index()];
    if json.buffer_view.is_none() {
        return Err(CharacterError::field(field, "refers to another file, expected it inside the .glb"));
    }
    if json.mime_type.is_none() {
        return Err(CharacterError::field(field, "has no mimeType, expected image/png or image/jpeg"));
    }
    let bytes = image_bytes(image, blob).ok_or_else(|| CharacterError::field(&field, "reaches past the end of the file"))?;
    let refused = |problem: &str| CharacterError::field(&field, format!("is neither PNG nor JPEG: {problem}"));
    let reader = ImageReader::new(Cursor::new(bytes)).with_guessed_format().map_err(|error| refused(&error.to_string()))?;
    if !matches!(reader.format(), Some(ImageFormat::Png | ImageFormat::Jpeg)) {
        return Err(refused("it begins like neither"));
    }
    let (width, height) = reader.into_dimensions().map_err(|error| refused(&error.to_string()))?;
    if width == 0 || height == 0 || width > MAX_TEXTURE_SIDE || height > MAX_TEXTURE_SIDE {
        return Err(CharacterError::field(&field, format!("is {width} x {height}, expected sides of 1 to {MAX_TEXTURE_SIDE}")));
    }
    Ok((width, height))
}

fn image_bytes<'a>(image: &gltf::Image<'_>, blob: &'a [u8]) -> Option<&'a [u8]> {
    let gltf::image::Source::View { view, .. } = image.source() else { return None };
    blob.get(view.offset()..view.offset().saturating_add(view.length()))
}

/// The image of a texture.
fn image_of(texture: usize, textures: &[usize], field: &str) -> Result<usize> {
    textures
        .get(texture)
        .copied()
        .ok_or_else(|| CharacterError::field(field, format!("is {texture}, but there are {} textures", textures.len())))
}

/// A square of a power of two, `least` to `most` a side.
fn check_square((width, height): Size, least: u32, most: u32, field: &str) -> Result<()> {
    if width == height && width.is_power_of_two() && (least..=most).contains(&width) {
        return Ok(());
    }
    Err(CharacterError::field(field, format!("is {width} x {height}, expected a square with a power of two a side, {least} to {most}")))
}

fn check_zone_maps(textures: &[usize], size_of: &[Size], zones: &Zones) -> Result<()> {
    let first = size_of[image_of(zones.map.texture, textures, "RHYTID_face.zones.map.texture")?];
    let others = [("stretch.texture", zones.stretch.map(|map| map.texture)), ("difference", zones.difference)];
    check_square(first, 4, MAX_ZONE_MAP_SIDE, "RHYTID_face.zones.map.texture")?;
    for (field, texture) in others.into_iter().filter_map(|(field, texture)| Some((field, texture?))) {
        let field = format!("RHYTID_face.zones.{field}");
        let size = size_of[image_of(texture, textures, &field)?];
        if size != first {
            return Err(CharacterError::field(
                field,
                format!("is {} x {}, expected {} x {} as the zones' wrinkle map", size.0, size.1, first.0, first.1),
            ));
        }
    }
    Ok(())
}

/// The masks' kinds and sizes, and that no texel belongs to more than the whole of all zones.
fn check_masks(document: &gltf::Document, textures: &[usize], size_of: &[Size], blob: &[u8], zones: &Zones) -> Result<()> {
    let num_zones = zones.list.len();
    let mut first: Option<Size> = None;
    let mut sums: Vec<u32> = Vec::new();
    for (m, &texture) in zones.masks.iter().enumerate() {
        let field = format!("RHYTID_face.zones.masks[{m}]");
        let index = image_of(texture, textures, &field)?;
        let size = size_of[index];
        check_square(size, 4, MAX_MASK_SIDE, &field)?;
        let expected = *first.get_or_insert(size);
        if size != expected {
            return Err(CharacterError::field(
                field,
                format!("is {} x {}, expected {} x {} as the first mask", size.0, size.1, expected.0, expected.1),
            ));
        }
        let refused = |problem: String| CharacterError::field(&field, problem);
        let bytes = document.images().nth(index).and_then(|image| image_bytes(&image, blob)).unwrap_or_default();
        let reader = ImageReader::with_format(Cursor::new(bytes), ImageFormat::Png);
        let picture = reader.decode().map_err(|error| refused(format!("is no PNG: {}", super::one_line(&error.to_string()))))?;
        let num_channels = (num_zones - 4 * m).min(4);
        if num_channels == 4 && !picture.color().has_alpha() {
            return Err(refused("has no alpha channel, expected RGBA: four of the zones are in it".to_owned()));
        }
        let texels = picture.into_rgba8();
        sums.resize(texels.len() / 4, 0);
        for (sum, texel) in sums.iter_mut().zip(texels.chunks_exact(4)) {
            *sum += texel[..num_channels].iter().map(|&code| u32::from(code)).sum::<u32>();
        }
    }
    // Each zone's code may be rounded up by half.
    let most = 255 + num_zones.div_ceil(2) as u32;
    let side = first.map_or(1, |size| size.0);
    match sums.iter().position(|&sum| sum > most) {
        Some(at) => Err(CharacterError::field(
            "RHYTID_face.zones.masks",
            format!(
                "sum to {:.3} over all zones at texel ({}, {}), expected at most 1",
                sums[at] as f32 / 255.0,
                at as u32 % side,
                at as u32 / side
            ),
        )),
        None => Ok(()),
    }
}

/// `textures`: the image of each texture.
fn check_wrinkle_maps(textures: &[usize], size_of: &[Size], character: &Character) -> Result<()> {
    let mut first: Option<Size> = None;
    for (k, map) in character.poses.iter().enumerate().filter_map(|(k, pose)| Some((k, pose.map?))) {
        let field = format!("RHYTID_face.poses[{k}].map.texture");
        let (width, height) = size_of[image_of(map.texture, textures, &field)?];
        if width != height || !width.is_power_of_two() {
            return Err(CharacterError::field(&field, format!("is {width} x {height}, expected a square with a power of two a side")));
        }
        let expected = *first.get_or_insert((width, height));
        if expected != (width, height) {
            return Err(CharacterError::field(
                &field,
                format!("is {width} x {height}, expected {} x {} as the first: wrinkle maps share one array", expected.0, expected.1),
            ));
        }
    }
    Ok(())
}

/// Every use counts: each part of the character and each pose gets textures of its own on the GPU.
fn check_total(document: &gltf::Document, textures: &[usize], size_of: &[Size], character: &Character) -> Result<()> {
    let of_parts = document.meshes().flat_map(|mesh| mesh.primitives()).flat_map(|primitive| {
        let material = primitive.material();
        let pbr = material.pbr_metallic_roughness();
        let of_pbr = [pbr.base_color_texture(), pbr.metallic_roughness_texture()];
        let of_material =
            [material.normal_texture().map(|info| info.texture().index()), material.occlusion_texture().map(|info| info.texture().index())];
        of_pbr.map(|info| info.map(|info| info.texture().index())).into_iter().chain(of_material).flatten()
    });
    let of_poses = character.poses.iter().filter_map(|pose| pose.map.map(|map| map.texture));
    let of_zones = character.zones.iter().flat_map(|zones| {
        let others = [Some(zones.map.texture), zones.stretch.map(|map| map.texture), zones.difference];
        zones.masks.iter().copied().chain(others.into_iter().flatten())
    });
    let mut total = 0_u64;
    for texture in of_parts.chain(of_poses).chain(of_zones) {
        let (width, height) = size_of[textures[texture]];
        total += u64::from(width) * u64::from(height);
        if total > MAX_TEXELS {
            return Err(CharacterError::field(
                "images",
                format!("have more than {MAX_TEXELS} texels together, each use by a part, a pose or the zones counted"),
            ));
        }
    }
    Ok(())
}
