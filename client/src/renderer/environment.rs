//! What lies all round, ready for the shaders: irradiance as spherical harmonics, reflections by roughness in an
//! octahedral map. Both are computed from the set-up of lights; no picture is loaded.

use super::studio::Studio;
use glam::{Vec2, Vec3};
use std::f32::consts::PI;

/// Texels a side of the sharpest level.
pub const SIDE: u32 = 128;
/// Levels; the last is the roughest (`ROUGHEST_LEVEL` in `lighting.wgsl`).
pub const NUM_LEVELS: u32 = 5;
pub const FORMAT: wgpu::TextureFormat = wgpu::TextureFormat::Rgba16Float;
/// As `MARGIN` in `lighting.wgsl`: half a texel of the smallest level.
const MARGIN: f32 = 0.0625;
/// Directions a texel of a rough level gathers.
const NUM_GATHERED: u32 = 96;
/// Directions the irradiance is summed over.
const NUM_SUMMED: u32 = 2048;

/// Nine coefficients for `ambient_irradiance` in `lighting.wgsl`: light on a white surface by its normal, convolved with
/// the cosine and divided by pi (Ramamoorthi and Hanrahan 2001, eq. 13, constants folded in).
pub fn irradiance(studio: Studio) -> [Vec3; 9] {
    let mut sums = [Vec3::ZERO; 9];
    for i in 0..NUM_SUMMED {
        let d = spiral(i, NUM_SUMMED);
        let light = studio.radiance(d) * (4.0 * PI / NUM_SUMMED as f32);
        for (sum, basis) in sums.iter_mut().zip(basis(d)) {
            *sum += light * basis;
        }
    }
    // Cosine lobe by band over pi, times the basis' constant once more for evaluation.
    const BY_BAND: [f32; 3] = [1.0, 2.0 / 3.0, 0.25];
    const BAND_OF: [usize; 9] = [0, 1, 1, 1, 2, 2, 2, 2, 2];
    std::array::from_fn(|i| sums[i] * BY_BAND[BAND_OF[i]] * CONSTANTS[i])
}

/// Constants of the real spherical harmonics up to order two, in the order `1, y, z, x, xy, yz, 3z²-1, xz, x²-y²`.
const CONSTANTS: [f32; 9] = [0.282095, 0.488603, 0.488603, 0.488603, 1.092548, 1.092548, 0.315392, 1.092548, 0.546274];

fn basis(d: Vec3) -> [f32; 9] {
    let terms = [1.0, d.y, d.z, d.x, d.x * d.y, d.y * d.z, 3.0 * d.z * d.z - 1.0, d.x * d.z, d.x * d.x - d.y * d.y];
    std::array::from_fn(|i| terms[i] * CONSTANTS[i])
}

/// Direction `i` of `count` spread evenly over the sphere (Fibonacci spiral).
fn spiral(i: u32, count: u32) -> Vec3 {
    const GOLDEN_TURN: f32 = 2.399_963_1;
    let z = 1.0 - (2.0 * i as f32 + 1.0) / count as f32;
    let (sin, cos) = (GOLDEN_TURN * i as f32).sin_cos();
    let r = (1.0 - z * z).max(0.0).sqrt();
    Vec3::new(r * cos, r * sin, z)
}

/// Texels of each level, linear RGB and 1, as half floats.
pub fn levels(studio: Studio) -> Vec<Vec<u8>> {
    (0..NUM_LEVELS)
        .map(|level| {
            let side = SIDE >> level;
            let roughness = level as f32 / (NUM_LEVELS - 1) as f32;
            (0..side * side)
                .flat_map(|at| {
                    let uv = Vec2::new((at % side) as f32 + 0.5, (at / side) as f32 + 0.5) / side as f32;
                    let light = gathered(studio, direction_of(uv), roughness);
                    [light.x, light.y, light.z, 1.0].map(|value| half::f16::from_f32(value).to_le_bytes())
                })
                .flatten()
                .collect()
        })
        .collect()
}

/// Light that a mirror of `roughness` gathers about `axis`, each direction weighted by its cosine (Karis 2013).
fn gathered(studio: Studio, axis: Vec3, roughness: f32) -> Vec3 {
    if roughness == 0.0 {
        return studio.radiance(axis);
    }
    let slope2 = roughness.powi(4);
    let (across, up) = axis.any_orthonormal_pair();
    let (mut sum, mut total) = (Vec3::ZERO, 0.0);
    for i in 0..NUM_GATHERED {
        // Halfway vectors by Beckmann's distribution, seen along the axis.
        let u = (i as f32 + 0.5) / NUM_GATHERED as f32;
        let tan2 = -slope2 * (1.0 - u).ln();
        let cos = 1.0 / (1.0 + tan2).sqrt();
        let sin = (1.0 - cos * cos).max(0.0).sqrt();
        let (s, c) = (2.399_963_1 * i as f32).sin_cos();
        let half = across * (sin * c) + up * (sin * s) + axis * cos;
        let light = half * (2.0 * axis.dot(half)) - axis;
        let weight = light.dot(axis);
        if weight > 0.0 {
            sum += studio.radiance(light) * weight;
            total += weight;
        }
    }
    sum / total.max(1e-6)
}

/// Inverse of `octahedral` in `lighting.wgsl`, with its margin.
fn direction_of(uv: Vec2) -> Vec3 {
    let mut p = (uv - 0.5) / (0.5 - MARGIN);
    // What lies beyond an edge is what lies on the other side of its middle.
    if p.x.abs() > 1.0 {
        p = Vec2::new(p.x.signum() * 2.0 - p.x, -p.y);
    }
    if p.y.abs() > 1.0 {
        p = Vec2::new(-p.x, p.y.signum() * 2.0 - p.y);
    }
    let z = 1.0 - p.x.abs() - p.y.abs();
    let folded = (Vec2::ONE - Vec2::new(p.y, p.x).abs()) * Vec2::new(sign(p.x), sign(p.y));
    let xy = if z < 0.0 { folded } else { p };
    xy.extend(z).normalize()
}

fn sign(x: f32) -> f32 {
    if x >= 0.0 { 1.0 } else { -1.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Twin of `ambient_irradiance` in `lighting.wgsl`.
    fn lit(e: &[Vec3; 9], n: Vec3) -> Vec3 {
        let terms = [1.0, n.y, n.z, n.x, n.x * n.y, n.y * n.z, 3.0 * n.z * n.z - 1.0, n.x * n.z, n.x * n.x - n.y * n.y];
        e.iter().zip(terms).map(|(e, term)| *e * term).sum()
    }

    #[test]
    fn irradiance_is_the_room_summed_over_the_hemisphere() {
        for studio in Studio::ALL {
            let e = irradiance(studio);
            for normal in [Vec3::Y, Vec3::NEG_Y, Vec3::Z, Vec3::new(0.6, 0.0, 0.8), Vec3::new(-0.6, 0.64, 0.48)] {
                let count = 20_000;
                let summed: Vec3 =
                    (0..count).map(|i| spiral(i, count)).map(|d| studio.radiance(d) * d.dot(normal).max(0.0) * (4.0 / count as f32)).sum();
                assert!((lit(&e, normal) - summed).abs().max_element() < 0.03, "{studio} {normal}: {} {summed}", lit(&e, normal));
            }
        }
    }

    #[test]
    fn octahedral_map_reads_back_the_direction_it_was_made_for() {
        // Twin of `octahedral` in `lighting.wgsl`.
        let uv_of = |direction: Vec3| {
            let d = direction / (direction.x.abs() + direction.y.abs() + direction.z.abs());
            let folded = (Vec2::ONE - Vec2::new(d.y, d.x).abs()) * Vec2::new(sign(d.x), sign(d.y));
            (if d.z < 0.0 { folded } else { d.truncate() }) * (0.5 - MARGIN) + 0.5
        };
        for i in 0..500 {
            let d = spiral(i, 500);
            assert!(direction_of(uv_of(d)).distance(d) < 1e-5, "{d}");
        }
    }
}
