//! Blood under the skin and what poses and zones do to it, decoded.

use super::AssetError;
use image::RgbaImage;
use rhytid_shared::Character;
use rhytid_shared::character::ColourDriver;

/// Colour that follows the face (Jimenez, Scully and others 2010). Amounts are optical densities along haemoglobin's direction.
#[derive(Debug, Clone, PartialEq)]
pub struct BloodMaps {
    /// Texels a side of all maps; `t` texels each, by rows.
    pub side: u32,
    /// `t` places at rest.
    pub base: Vec<BloodTexel>,
    /// What poses and zones do.
    pub changes: Vec<BloodChange>,
    /// Most a place can hold.
    pub most: f32,
    /// Multiplies what the changes do to the colour.
    pub strength: f32,
}

/// A place at rest.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BloodTexel {
    /// Amount.
    pub amount: f32,
    /// Its mean all round.
    pub mean: f32,
    /// How much it belongs to the left half of the face, 0 to 1.
    pub left: f32,
}

/// What one pose or zone does.
#[derive(Debug, Clone, PartialEq)]
pub struct BloodChange {
    /// What it follows.
    pub driver: ColourDriver,
    /// `t` pairs: how much more uneven (ratio less 1), how much more.
    pub texels: Vec<[f32; 2]>,
}

/// A code about 128, -1 to 1.
fn signed(code: u8) -> f32 {
    (f32::from(code) - 128.0) / 127.0
}

/// `decode` gives the picture of a texture.
pub(super) fn read(
    character: &Character,
    mut decode: impl FnMut(usize) -> Result<Option<RgbaImage>, AssetError>,
) -> Result<Option<BloodMaps>, AssetError> {
    let Some(colour) = &character.colour else { return Ok(None) };
    let Some(picture) = decode(colour.base)? else { return Ok(None) };
    let share = |code: u8| f32::from(code) / 255.0;
    let base = picture.pixels().map(|texel| BloodTexel {
        amount: share(texel[0]) * colour.most,
        mean: share(texel[1]) * colour.most,
        left: share(texel[2]),
    });
    let mut maps = BloodMaps {
        side: picture.width(),
        base: base.collect(),
        changes: Vec::with_capacity(colour.changes.len()),
        most: colour.most,
        strength: colour.strength,
    };
    for change in &colour.changes {
        let Some(picture) = decode(change.texture)? else { continue };
        let texels = picture.pixels().map(|texel| [signed(texel[0]) * change.spread, signed(texel[1]) * change.shift]);
        maps.changes.push(BloodChange { driver: change.driver, texels: texels.collect() });
    }
    Ok(Some(maps))
}
