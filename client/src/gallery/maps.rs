//! The figures of Jimenez, Echevarria, Oat, Gutierrez 2011 that show textures.

use super::Result;
use super::easel::Easel;
use crate::asset::{CharacterAsset, MipChain, Surface, Texels, ZoneMaps};
use crate::render_cli::PictureError;
use crate::renderer::{DrawSettings, RenderFrame, ViewMode, WrinkleSystem, ZoneBlend};
use crate::sheet::{Cell, Row, Sheet};
use crate::view::expressions::{DISGUST, SURPRISE};
use glam::{Vec2, Vec3};
use image::{Rgba, RgbaImage};

/// Side of a texture's picture, pixels.
const SIDE: u32 = 400;
/// What the paper calls the zones, sRGB.
const ZONE_COLORS: [[f32; 3]; 8] = [
    [220.0, 60.0, 50.0],
    [70.0, 175.0, 70.0],
    [60.0, 90.0, 215.0],
    [140.0, 90.0, 50.0],
    [70.0, 200.0, 210.0],
    [205.0, 70.0, 190.0],
    [240.0, 150.0, 40.0],
    [150.0, 150.0, 150.0],
];

/// Figure 1.3.
pub(super) fn masks_and_maps(easel: &mut Easel) -> Result<Sheet> {
    let (base, zones) = maps(&easel.asset)?;
    let mut textures = Row { heading: "Textures, drawn as they are stored".into(), cells: Vec::new() };
    textures.cells.push(Cell::new(slopes(base), format!("base map, {} × {}", base.size[0], base.size[1])));
    textures.cells.push(Cell::new(slopes(&zones.map), format!("wrinkle map, {} × {}", zones.map.size[0], zones.map.size[1])));
    let mask = &zones.masks[0];
    let (colors, cover) = (painted_zones(zones, SIDE), format!("masks of all zones, {} × {}", mask.size[0], mask.size[1]));
    textures.cells.push(Cell::new(colors, cover));

    // The masks on the face: mixed into the colour of its skin.
    let painted = |asset: &mut CharacterAsset| {
        let Some(zones) = &asset.zones else { return };
        let colors = painted_zones(zones, 512);
        let skin = asset.primitives.iter_mut().filter(|primitive| primitive.surface == Surface::Skin);
        for primitive in skin.filter(|primitive| primitive.material.normal.is_some()) {
            let texels = colors.pixels().flat_map(|pixel| {
                let grey = [185.0, 165.0, 155.0];
                let cover = f32::from(pixel[3]) / 255.0;
                let mix = |c: usize| (f32::from(pixel[c]) + grey[c] * (1.0 - cover)).min(255.0) as u8;
                [mix(0), mix(1), mix(2), 255]
            });
            primitive.material.albedo = Some(MipChain::from_texels([512, 512], Texels::AlbedoSrgb, texels.collect()));
        }
    };
    let mut with_masks = easel.variant(painted)?;
    let size = [SIDE, SIDE];
    let rest = RenderFrame::at_rest(easel.character());
    let mut faces = Row { heading: "On the face".into(), cells: Vec::new() };
    let settings = DrawSettings { view: ViewMode::Bare, ..easel.face() };
    faces.cells.push(Cell::new(with_masks.draw(size, &settings, &rest)?, "masks on the face"));
    let frame = easel.expression(SURPRISE.weights, &[("surprise", 1.0)])?;
    for (view, caption) in [(ViewMode::Normals, "normals: base and wrinkles of surprise"), (ViewMode::Beauty, "the face they give")] {
        let settings = DrawSettings { view, system: WrinkleSystem::Zones, ..easel.face() };
        faces.cells.push(Cell::new(easel.draw(size, &settings, &frame)?, caption));
    }
    let subtitle = "partial derivatives: what is blended is a sum".into();
    Ok(Sheet { title: "Jimenez et al. 2011, Figure 1.3".into(), subtitle, rows: vec![textures, faces] })
}

/// Figure 1.4.
pub(super) fn differences(easel: &mut Easel) -> Result<Sheet> {
    let (_, zones) = maps(&easel.asset)?;
    let difference = zones.difference.as_ref().ok_or(PictureError::Lacks("difference map of its wrinkle zones"))?;
    let mut textures = Row { heading: "Textures".into(), cells: Vec::new() };
    textures.cells.push(Cell::new(normals(&zones.map, zones.scale), "wrinkles as normals"));
    let flat = RgbaImage::from_pixel(SIDE, SIDE, Rgba([128, 128, 255, 255]));
    textures.cells.push(Cell::new(flat, "less the base, here flat"));
    let texel = |x: u32, y: u32| Rgba([0, 1, 2].map(|c| difference.levels[0][4 * (y * difference.size[0] + x) as usize + c]).into_rgba());
    let stored = RgbaImage::from_fn(difference.size[0], difference.size[1], texel);
    textures.cells.push(Cell::new(enlarged(&stored), "is the difference map"));

    let frame = easel.expression(DISGUST.weights, &[("disgust", 1.0)])?;
    let settings = DrawSettings { system: WrinkleSystem::Zones, ..easel.face() };
    let size = [SIDE, SIDE];
    let derivatives = easel.draw(size, &settings, &frame)?;
    let from_differences = easel.draw(size, &DrawSettings { zone_blend: ZoneBlend::Difference, ..settings }, &frame)?;
    let apart = RgbaImage::from_fn(SIDE, SIDE, |x, y| {
        let (a, b) = (derivatives.get_pixel(x, y), from_differences.get_pixel(x, y));
        Rgba([0, 1, 2].map(|c| a[c].abs_diff(b[c]).saturating_mul(8)).into_rgba())
    });
    let mut faces = Row { heading: "Disgust".into(), cells: Vec::new() };
    faces.cells.push(Cell::new(from_differences, "by differences, made unit again"));
    faces.cells.push(Cell::new(derivatives, "by partial derivatives"));
    faces.cells.push(Cell::new(apart, "how far the two are apart, eight times as strong"));
    let subtitle = "wrinkled less base normal, added where the masks say".into();
    Ok(Sheet { title: "Jimenez et al. 2011, Figure 1.4".into(), subtitle, rows: vec![textures, faces] })
}

/// The base map of the face's skin, and the maps of its zones.
fn maps(asset: &CharacterAsset) -> Result<(&MipChain, &ZoneMaps)> {
    let skin = asset.primitives.iter().filter(|primitive| primitive.surface == Surface::Skin);
    let base = skin.filter_map(|primitive| primitive.material.normal.as_ref()).next();
    let zones = asset.zones.as_ref().ok_or(PictureError::Lacks("wrinkle zones"))?;
    Ok((base.ok_or(PictureError::Lacks("normal map of its skin"))?, zones))
}

/// Partial derivatives in red and green, as the paper shows them.
fn slopes(map: &MipChain) -> RgbaImage {
    let texel = |x: u32, y: u32| {
        let at = 2 * (y * map.size[0] + x) as usize;
        Rgba([map.levels[0][at], map.levels[0][at + 1], 0, 255])
    };
    enlarged(&RgbaImage::from_fn(map.size[0], map.size[1], texel))
}

/// The same as unit normals, `n * 0.5 + 0.5`.
fn normals(map: &MipChain, scale: f32) -> RgbaImage {
    let texel = |x: u32, y: u32| {
        let at = 2 * (y * map.size[0] + x) as usize;
        let slope = |code: u8| (f32::from(code) - 128.0) / 127.0 * scale;
        let normal = Vec2::new(slope(map.levels[0][at]), slope(map.levels[0][at + 1])).extend(1.0).normalize();
        let [r, g, b] = (normal * 127.5 + Vec3::splat(127.5)).to_array().map(|value| value.round() as u8);
        Rgba([r, g, b, 255])
    };
    enlarged(&RgbaImage::from_fn(map.size[0], map.size[1], texel))
}

/// Each zone in its colour, premultiplied by its share; alpha is the share of all.
fn painted_zones(zones: &ZoneMaps, side: u32) -> RgbaImage {
    let [width, height] = zones.masks[0].size;
    let picture = RgbaImage::from_fn(width, height, |x, y| {
        let at = 4 * (y * width + x) as usize;
        let (mut sum, mut cover) = ([0.0; 3], 0.0);
        for (zone, color) in ZONE_COLORS.iter().enumerate() {
            let share = f32::from(zones.masks[zone / 4].levels[0][at + zone % 4]) / 255.0;
            (0..3).for_each(|c| sum[c] += share * color[c]);
            cover += 255.0 * share;
        }
        Rgba([sum[0] as u8, sum[1] as u8, sum[2] as u8, cover as u8])
    });
    let large = image::imageops::resize(&picture, side, side, image::imageops::FilterType::Triangle);
    // Cells have no transparency.
    if side == SIDE { RgbaImage::from_fn(side, side, |x, y| Rgba([0, 1, 2].map(|c| large.get_pixel(x, y)[c]).into_rgba())) } else { large }
}

fn enlarged(picture: &RgbaImage) -> RgbaImage {
    image::imageops::resize(picture, SIDE, SIDE, image::imageops::FilterType::Triangle)
}

/// Three channels, opaque.
trait IntoRgba {
    fn into_rgba(self) -> [u8; 4];
}

impl IntoRgba for [u8; 3] {
    fn into_rgba(self) -> [u8; 4] {
        [self[0], self[1], self[2], 255]
    }
}
