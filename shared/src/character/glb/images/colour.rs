//! Maps of the colour that follows the face.

use super::super::super::checked::CharacterError;
use super::super::super::colour::Colour;
use super::super::Result;
use super::{Size, check_square, image_bytes, image_of};
use crate::limits::MAX_COLOUR_SIDE;

const PNG_SIGNATURE: &[u8] = b"\x89PNG\r\n\x1a\n";

/// Squares of one size, PNG: a JPEG would make blood of its own.
pub(super) fn check(document: &gltf::Document, textures: &[usize], size_of: &[Size], blob: &[u8], colour: &Colour) -> Result<()> {
    let base = size_of[image_of(colour.base, textures, "RHYTID_face.colour.base")?];
    check_square(base, 4, MAX_COLOUR_SIDE, "RHYTID_face.colour.base")?;
    let changes = colour.changes.iter().enumerate().map(|(c, change)| (format!("RHYTID_face.colour.changes[{c}].texture"), change.texture));
    for (field, texture) in [("RHYTID_face.colour.base".to_owned(), colour.base)].into_iter().chain(changes) {
        let index = image_of(texture, textures, &field)?;
        let size = size_of[index];
        if size != base {
            return Err(CharacterError::field(field, format!("is {} x {}, expected {} x {} as the base", size.0, size.1, base.0, base.1)));
        }
        let bytes = document.images().nth(index).and_then(|image| image_bytes(&image, blob)).unwrap_or_default();
        if !bytes.starts_with(PNG_SIGNATURE) {
            return Err(CharacterError::field(field, "is no PNG, expected one: its values are numbers, not a picture"));
        }
    }
    Ok(())
}

/// The textures it uses, each use counted.
pub(super) fn textures(colour: &Colour) -> impl Iterator<Item = usize> {
    std::iter::once(colour.base).chain(colour.changes.iter().map(|change| change.texture))
}
