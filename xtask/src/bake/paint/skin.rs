//! The colour of the skin and of what grows on it.

use super::super::bust::Encoded;
use super::atlas::{Atlas, Texel, fill_gaps};
use super::encode;
use super::features::{Features, Marks};
use super::hairs::Hairs;
use super::noise::{bell, cells, fractal, hash, lerp, noise, smoothstep, unit};
use anyhow::Result;
use glam::{Vec2, Vec3};

/// Skin with the pigments of an ordinary cheekless place, sRGB. Tuned by eye.
const BASE_SRGB: [u8; 3] = [207, 161, 139];
/// Optical density one unit of each pigment adds to red, green and blue (directions of Tsumura's separation of skin
/// images into melanin and haemoglobin, 1999, as public implementations have them).
const MELANIN: Vec3 = Vec3::new(0.4143, 0.3570, 0.8372);
const HAEMOGLOBIN: Vec3 = Vec3::new(0.2988, 0.6838, 0.6657);
/// Colours of what is not skin, sRGB. Tuned by eye.
const HAIR_SRGB: [u8; 3] = [43, 30, 23];
const STUBBLE_SRGB: [u8; 3] = [80, 72, 72];
const LIP_SRGB: [u8; 3] = [172, 106, 95];
const MOUTH_SRGB: [u8; 3] = [112, 46, 44];
const CORNER_SRGB: [u8; 3] = [150, 82, 72];
const WATERLINE_SRGB: [u8; 3] = [214, 150, 138];
const NOSTRIL_SRGB: [u8; 3] = [74, 34, 27];

/// Amounts of pigment beyond the base, in units of optical density along their directions.
#[derive(Clone, Copy)]
struct Pigment {
    melanin: f32,
    blood: f32,
}

/// Paints the colour. `openness` is the share of the sky each texel sees, 0 to 1.
pub fn paint(atlas: &Atlas, features: &Features, hairs: &Hairs, openness: impl Fn(Vec2) -> f32 + Sync) -> Result<Encoded> {
    let moles = moles(features);
    let size = atlas.size();
    let skin = atlas.map(|texel| {
        let marks = features.marks(texel);
        color(features, texel, &marks, &moles, openness(texel.uv)).to_array()
    });
    let hair = rgb(HAIR_SRGB);
    let filled = fill_gaps(size, &skin);
    let bytes = filled
        .iter()
        .enumerate()
        .flat_map(|(i, &under)| {
            let mixed = Vec3::from_array(under).lerp(hair * hairs.tone[i], hairs.cover[i]);
            mixed.to_array().map(encode::srgb)
        })
        .collect::<Vec<u8>>();
    encode::jpeg(size, &bytes, 90)
}

fn color(features: &Features, texel: &Texel, marks: &Marks, moles: &[(Vec3, f32, f32)], openness: f32) -> Vec3 {
    let p = texel.place;
    let pigment = pigment(features, p, marks, moles);
    let density = MELANIN * pigment.melanin + HAEMOGLOBIN * pigment.blood;
    let mut color = rgb(BASE_SRGB) * Vec3::from_array(density.to_array().map(|d| libm::expf(-d)));

    // Shadow of hair and beard roots under the skin: darker and less red.
    let roots = (0.66 * marks.hair).max(0.34 * marks.brow);
    color = color.lerp(rgb(HAIR_SRGB) * 1.5, roots);
    color = color.lerp(color * rgb(STUBBLE_SRGB) * 2.6, 0.30 * marks.beard);

    let lip = lip_color(features, p, marks);
    color = color.lerp(lip, marks.lip);
    color = color.lerp(rgb(MOUTH_SRGB) * 0.8, marks.lip_gap * marks.lip * 0.6);
    color = color.lerp(color * Vec3::new(1.06, 1.05, 1.05), 0.6 * marks.lip_rim * (1.0 - marks.lip));

    color = color.lerp(rgb(HAIR_SRGB) * 0.75, 0.72 * marks.lash_line);
    color = color.lerp(rgb(WATERLINE_SRGB), 0.85 * marks.waterline * (1.0 - 0.6 * marks.lash_line));
    color = color.lerp(rgb([206, 124, 114]), 0.42 * marks.eye_corner);

    // Where hardly any light comes in, skin is lit through itself: deep red-brown, not grey.
    let nose = features.chart.middle(&[31, 33, 35]);
    let nostril = bell(((p - nose) / Vec3::new(14.0, 11.0, 14.0)).length(), 1.0) * smoothstep(0.30, 0.12, openness);
    color = color.lerp(rgb(NOSTRIL_SRGB), 0.9 * nostril.min(1.0));
    let mouth = rgb(MOUTH_SRGB) * (1.0 + 0.25 * fractal(p / 4.0, 2, 21));
    // A corner that opens a little shows flesh that light gets through, not a hole.
    color = color.lerp(mouth.lerp(rgb(CORNER_SRGB), marks.lip_corner), marks.mouth);
    color.lerp(rgb([188, 110, 100]), marks.socket)
}

fn pigment(features: &Features, p: Vec3, marks: &Marks, moles: &[(Vec3, f32, f32)]) -> Pigment {
    let blotch = fractal(p / 19.0, 3, 1);
    if marks.hair > 0.98 {
        // Under hair nobody sees more.
        return Pigment { melanin: 0.0, blood: 0.095 * blotch };
    }
    let mottle = fractal(p / 5.5, 3, 2);
    let grain = fractal(p / 1.3, 2, 3);
    let mut melanin = 0.055 * fractal(p / 33.0, 2, 4) + 0.06 * mottle + 0.045 * grain;
    let mut blood = 0.095 * blotch + 0.095 * fractal(p / 3.6, 3, 5) + 0.045 * noise(p / 0.9, 6);
    // Cheeks are mottled more than the rest: fine vessels.
    let flush = marks.cheek * (1.0 + 0.5 * fractal(p / 7.0, 3, 7));
    blood += 0.27 * flush + 0.34 * marks.nose_tip * (1.0 + 0.25 * mottle) + 0.06 * marks.nose + 0.13 * marks.chin + 0.26 * marks.ear;
    blood += 0.17 * marks.under_eye + 0.18 * marks.upper_lid + 0.05 * marks.brow;
    melanin += 0.04 * marks.under_eye + 0.03 * marks.upper_lid + 0.055 * marks.forehead + 0.03 * marks.beard;
    let visible = features.chart.front(p) * (1.0 - marks.hair);
    let freckles = if visible > 0.0 { freckles(p) } else { 0.0 };
    let freckles = freckles * (0.35 + marks.cheek + 0.8 * marks.nose + 0.3 * marks.forehead).min(1.3) * visible;
    // Forehead, temples and neck are paler in blood; the neck is shaded by the chin and less tanned in front.
    blood += 0.10 * freckles;
    blood -= 0.07 * marks.forehead + 0.05 * marks.neck;
    melanin += marks.neck * (0.03 + 0.04 * blotch);
    melanin += 0.30 * freckles;
    for &(centre, radius, strength) in moles {
        let away = (p - centre).length();
        if away < 3.0 * radius {
            let edge = away + 0.25 * radius * noise(p / (radius * 0.8), 12);
            melanin += strength * smoothstep(1.15 * radius, 0.55 * radius, edge);
            blood += 0.95 * strength * smoothstep(1.3 * radius, 0.6 * radius, edge);
        }
    }
    if visible > 0.0 {
        // Small red spots, rare.
        let spot = cells(p / 8.5, 13);
        blood += if unit(spot.id) > 0.93 { 0.10 * bell(spot.first * 8.5, 1.1) } else { 0.0 };
    }
    Pigment { melanin, blood }
}

/// Freckles: small, unequal, in drifts.
fn freckles(p: Vec3) -> f32 {
    let drift = smoothstep(-0.15, 0.7, fractal(p / 17.0, 2, 14));
    let mut sum = 0.0;
    for (period, seed) in [(2.6, 15), (4.1, 16)] {
        let cell = cells(p / period, seed);
        let chance = unit(cell.id);
        let radius = lerp(0.35, 0.75, unit(cell.id.rotate_left(11)));
        sum += f32::from(chance > 0.62) * smoothstep(radius, 0.4 * radius, cell.first * period) * unit(cell.id.rotate_left(19));
    }
    (sum * drift).min(1.2)
}

fn lip_color(features: &Features, p: Vec3, marks: &Marks) -> Vec3 {
    let at = features.chart.unroll(p);
    // Fine upright folds, warped so that they are not a comb.
    let along = at.x + 0.8 * noise(p / 3.0, 31) + 0.3 * noise(p / 1.1, 32);
    let folds = noise(Vec3::new(along / 0.75, at.y / 7.0, 3.0), 33) + 0.5 * noise(Vec3::new(along / 0.38, at.y / 5.0, 5.0), 34);
    let blotch = fractal(p / 4.5, 3, 35);
    let upper = smoothstep(-1.5, 2.5, p.y - features.chart.middle(&[62, 66]).y);
    let base = rgb(LIP_SRGB) * lerp(1.0, 0.86, upper);
    let density = HAEMOGLOBIN * (0.10 * blotch + 0.13 * folds - 0.05 * marks.lip_rim) + MELANIN * 0.05 * blotch;
    base * Vec3::from_array(density.to_array().map(|d| libm::expf(-d)))
}

/// A few moles: centre, radius (mm), strength.
fn moles(features: &Features) -> Vec<(Vec3, f32, f32)> {
    let chart = features.chart;
    let places = [
        (Vec2::new(41.0, -31.0), 0.95, 0.85),
        (Vec2::new(-19.0, -90.0), 0.7, 0.6),
        (Vec2::new(-55.0, -12.0), 0.65, 0.75),
        (Vec2::new(62.0, 6.0), 0.55, 0.6),
        (Vec2::new(-68.0, -52.0), 0.8, 0.6),
        (Vec2::new(28.0, -118.0), 1.1, 0.8),
        (Vec2::new(-9.0, -126.0), 0.7, 0.6),
    ];
    let eyes = chart.middle(&[39, 42]);
    places
        .iter()
        .filter_map(|&(offset, radius, strength)| {
            let (centre, _) = chart.skin(Vec2::new(0.0, eyes.y) + offset * chart.scale())?;
            Some((centre, radius, strength + 0.1 * unit(hash(centre.x as i32, 0, 0, 17))))
        })
        .collect()
}

fn rgb(code: [u8; 3]) -> Vec3 {
    Vec3::from_array(code.map(encode::linear))
}
