//! From heights to partial-derivative maps: `p = n.xy / n.z` in the tangent frame.

use super::super::bust::SlopeMap;
use super::atlas::{Atlas, Texel, fill_gaps};
use super::encode;
use anyhow::Result;
use glam::{Vec2, Vec3};

/// Slopes of a relief over every covered texel. `height` takes the texel and a place near it and returns millimetres;
/// `reach` is the half distance of the differences, mm: about half a texel.
pub fn of_relief<H: Fn(Vec3) -> f32>(atlas: &Atlas, reach: f32, relief: impl Fn(&Texel) -> Option<H> + Sync) -> Vec<Option<[f32; 2]>> {
    atlas.map(|texel| {
        let Some(height) = relief(texel) else { return [0.0; 2] };
        let along = |axis: Vec3| (height(texel.place + axis * reach) - height(texel.place - axis * reach)) / (2.0 * reach);
        // A height field z = h(x, y) has the normal (-dh/dx, -dh/dy, 1).
        [-along(texel.tangent), -along(texel.bitangent)]
    })
}

/// The smallest scale, in steps of 0.05, that holds all but the `spared` steepest share of the slopes.
pub fn scale_for(slopes: &[Option<[f32; 2]>], spared: f64) -> f32 {
    let mut steepest: Vec<f32> = slopes.iter().flatten().map(|p| p[0].abs().max(p[1].abs())).filter(|&p| p > 0.0).collect();
    steepest.sort_by(f32::total_cmp);
    let index = (steepest.len() as f64 * (1.0 - spared)) as usize;
    let most = steepest.get(index.min(steepest.len().saturating_sub(1))).copied().unwrap_or(0.0);
    (most / 0.05).ceil().max(1.0) * 0.05
}

/// The code of a slope: `128 + 127 p / scale`, so that zero is exact.
pub fn code(slope: f32, scale: f32) -> u8 {
    (128.0 + libm::roundf(127.0 * (slope / scale).clamp(-1.0, 1.0))) as u8
}

/// RGB texels of a map, blue 255; flat outside the islands if `is_flat_outside`, else filled from their borders.
pub fn encode_map(size: usize, slopes: &[Option<[f32; 2]>], scale: f32, is_flat_outside: bool) -> Vec<u8> {
    let filled = if is_flat_outside { slopes.iter().map(|p| p.unwrap_or_default()).collect() } else { fill_gaps(size, slopes) };
    filled.iter().flat_map(|p| [code(p[0], scale), code(p[1], scale), 255]).collect()
}

/// A wrinkle map's picture. The steepest ten-thousandth is clipped.
pub fn wrinkle_map(size: usize, slopes: &[Option<[f32; 2]>]) -> Result<SlopeMap> {
    let scale = scale_for(slopes, 1e-4);
    Ok(SlopeMap { image: encode::png(size, &encode_map(size, slopes, scale, true))?, scale })
}

/// Length of a slope.
pub fn steepness(slope: [f32; 2]) -> f32 {
    Vec2::from_array(slope).length()
}
