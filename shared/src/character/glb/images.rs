//! Checks images by their headers: kind, size, and what all of them together will take.

use super::super::checked::{Character, CharacterError};
use super::Result;
use crate::limits::{MAX_IMAGES, MAX_TEXELS, MAX_TEXTURE_SIDE};
use image::ImageFormat;
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
    let gltf::image::Source::View { view, .. } = image.source() else {
        return Err(CharacterError::field(field, "refers to another file, expected it inside the .glb"));
    };
    let bytes = blob
        .get(view.offset()..view.offset().saturating_add(view.length()))
        .ok_or_else(|| CharacterError::field(&field, "reaches past the end of the file"))?;
    let refused = |problem: &str| CharacterError::field(&field, format!("is neither PNG nor JPEG: {problem}"));
    let reader = image::ImageReader::new(Cursor::new(bytes)).with_guessed_format().map_err(|error| refused(&error.to_string()))?;
    if !matches!(reader.format(), Some(ImageFormat::Png | ImageFormat::Jpeg)) {
        return Err(refused("it begins like neither"));
    }
    let (width, height) = reader.into_dimensions().map_err(|error| refused(&error.to_string()))?;
    if width == 0 || height == 0 || width > MAX_TEXTURE_SIDE || height > MAX_TEXTURE_SIDE {
        return Err(CharacterError::field(&field, format!("is {width} x {height}, expected sides of 1 to {MAX_TEXTURE_SIDE}")));
    }
    Ok((width, height))
}

/// `textures`: the image of each texture.
fn check_wrinkle_maps(textures: &[usize], size_of: &[Size], character: &Character) -> Result<()> {
    let mut first: Option<Size> = None;
    for (k, map) in character.poses.iter().enumerate().filter_map(|(k, pose)| Some((k, pose.map?))) {
        let field = format!("RHYTID_face.poses[{k}].map.texture");
        let &image = textures
            .get(map.texture)
            .ok_or_else(|| CharacterError::field(&field, format!("is {}, but there are {} textures", map.texture, textures.len())))?;
        let (width, height) = size_of[image];
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
    let mut total = 0_u64;
    for texture in of_parts.chain(of_poses) {
        let (width, height) = size_of[textures[texture]];
        total += u64::from(width) * u64::from(height);
        if total > MAX_TEXELS {
            return Err(CharacterError::field(
                "images",
                format!("have more than {MAX_TEXELS} texels together, each use by a part or a pose counted"),
            ));
        }
    }
    Ok(())
}
