//! From heights to partial-derivative maps: `p = n.xy / n.z` in the tangent frame.

use super::super::bust::SlopeMap;
use super::atlas::{Atlas, Texel, fill_gaps};
use super::encode;
use anyhow::Result;
use glam::Vec3;

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

/// Slopes of heights given one a texel, mm, by differences between neighbours; flat where a neighbour is missing.
pub fn of_heights(atlas: &Atlas, heights: &[Option<f32>]) -> Vec<Option<[f32; 2]>> {
    let size = atlas.size();
    let slope = |x: usize, y: usize| {
        if x == 0 || y == 0 || x + 1 == size || y + 1 == size {
            return None;
        }
        let at = |x: usize, y: usize| heights[y * size + x];
        let (dx, dy) = ((at(x + 1, y)? - at(x - 1, y)?) * 0.5, (at(x, y + 1)? - at(x, y - 1)?) * 0.5);
        let (texel, [sx, sy]) = atlas.texel_with_steps(x, y)?;
        let (xx, xy, yy) = (sx.dot(sx), sx.dot(sy), sy.dot(sy));
        let determinant = xx * yy - xy * xy;
        // The gradient in space from the differences along two oblique steps (dual basis).
        let gradient = (sx * (dx * yy - dy * xy) + sy * (dy * xx - dx * xy)) / determinant;
        (determinant > 1e-9).then(|| [-gradient.dot(texel.tangent), -gradient.dot(texel.bitangent)])
    };
    (0..size * size).map(|i| heights[i].map(|_| slope(i % size, i / size).unwrap_or_default())).collect()
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

/// A wrinkle map's picture. The steepest thousandth of its slopes is clipped.
pub fn wrinkle_map(size: usize, slopes: &[Option<[f32; 2]>]) -> Result<SlopeMap> {
    let scale = scale_for(slopes, 1e-3);
    Ok(SlopeMap { image: encode::png(size, &encode_map(size, slopes, scale, true))?, scale })
}

#[cfg(test)]
mod tests {
    use super::super::sample::plane;
    use super::*;

    #[test]
    fn a_ramp_has_its_slope_with_the_sign_of_the_normal() {
        let surface = plane();
        let atlas = Atlas::new(&surface, 64);
        let ramp = |p: Vec3| 0.3 * p.x - 0.2 * p.y;
        let relief = of_relief(&atlas, 0.1, |_| Some(ramp));
        let heights = of_heights(&atlas, &atlas.map(|texel| ramp(texel.place)));
        for slopes in [relief, heights] {
            let p = slopes[40 * 64 + 20].expect("inside the island");
            assert!((p[0] + 0.3).abs() < 1e-3 && (p[1] - 0.2).abs() < 1e-3, "{p:?}");
        }
    }

    #[test]
    fn a_bump_is_lit_from_above_on_its_upper_side() {
        let surface = plane();
        let atlas = Atlas::new(&surface, 64);
        let slopes = of_relief(&atlas, 0.1, |_| Some(|p: Vec3| libm::expf(-p.length_squared() / 25.0)));
        // Rows above the middle of the picture lie higher on the plane: their normals lean up, green over 128.
        let codes = encode_map(64, &slopes, 0.5, true);
        let texel = |x: usize, y: usize| &codes[(y * 64 + x) * 3..][..3];
        assert!(texel(32, 26)[1] > 140 && texel(32, 37)[1] < 116, "{:?} {:?}", texel(32, 26), texel(32, 37));
        assert!(texel(37, 32)[0] > 140 && texel(26, 32)[0] < 116);
        assert_eq!(texel(1, 1), [128, 128, 255]);
    }

    #[test]
    fn codes_hold_zero_exactly_and_the_scale_holds_the_steepest() {
        assert_eq!((code(0.0, 0.7), code(0.7, 0.7), code(-0.7, 0.7), code(9.0, 0.7)), (128, 255, 1, 255));
        let slopes = vec![Some([0.31, -0.02]), Some([0.0, -0.62]), None];
        assert!((scale_for(&slopes, 0.0) - 0.65).abs() < 1e-6);
    }
}
