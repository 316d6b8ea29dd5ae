//! The eyeball's picture: front pole in the middle, distance from it proportional to the angle from the pole.

use super::super::bust::{Bust, Encoded};
use super::super::eyes::{IRIS_RADIUS, TEXTURE_ANGLE};
use super::encode;
use super::noise::{bell, fractal, lerp, noise, smoothstep};
use anyhow::Result;
use glam::{Vec2, Vec3};

/// Texels a side.
const SIZE: usize = 512;
/// The pupil's radius as a share of the iris'.
const PUPIL: f32 = 0.36;

/// Paints the eyeball.
pub fn paint(bust: &Bust) -> Result<Encoded> {
    let iris = libm::asinf(IRIS_RADIUS / bust.eyes[0].radius) / TEXTURE_ANGLE;
    let rgb: Vec<u8> = (0..SIZE * SIZE)
        .flat_map(|i| {
            // Four samples a texel: the limbus and the pupil are sharp.
            let sum = [(0.25, 0.25), (0.75, 0.25), (0.25, 0.75), (0.75, 0.75)].iter().fold(Vec3::ZERO, |sum, &(dx, dy)| {
                let p = Vec2::new((i % SIZE) as f32 + dx, (i / SIZE) as f32 + dy) / SIZE as f32 * 2.0 - Vec2::ONE;
                sum + color(p, iris)
            });
            (sum / 4.0).to_array().map(encode::srgb)
        })
        .collect();
    encode::jpeg(SIZE, &rgb, 92)
}

/// Colour at `p`, the unit disk, with the iris ending at radius `iris`.
fn color(p: Vec2, iris: f32) -> Vec3 {
    let angle = libm::atan2f(p.y, p.x);
    let radius = p.length() / iris;
    let edge = radius + 0.012 * noise(Vec3::new(p.x, p.y, 0.0) * 45.0, 401);
    sclera(p, angle, radius).lerp(iris_color(p / iris, angle, radius), smoothstep(1.06, 0.95, edge))
}

fn iris_color(p: Vec2, angle: f32, radius: f32) -> Vec3 {
    let (sin, cos) = libm::sincosf(angle);
    let wave = 0.12 * noise(Vec3::new(p.x * 3.0, p.y * 3.0, 1.0), 402);
    // Fibres run from the pupil to the limbus: noise stretched along the radius, on a ring so that it closes.
    let fibre = |count: f32, along: f32, seed: u32| noise(Vec3::new(cos * count, sin * count, radius * along + wave), seed);
    let fibres = 0.55 * fibre(9.0, 1.6, 403) + 0.35 * fibre(20.0, 2.2, 404) + 0.25 * fibre(38.0, 3.0, 405);
    let collarette = 0.56 + 0.05 * fibre(7.0, 0.0, 406) + 0.02 * fibre(17.0, 0.0, 407);
    let outer = srgb(84, 87, 78).lerp(srgb(100, 98, 85), 0.5 + 0.5 * fractal(Vec3::new(p.x, p.y, 2.0) * 2.3, 2, 408));
    let inner = srgb(112, 86, 60);
    let mut color = inner.lerp(outer, smoothstep(collarette - 0.07, collarette + 0.16, radius + 0.10 * fibres));
    color *= 0.62 * (1.0 + 0.70 * fibres);
    color *= 1.0 + 0.35 * bell(radius - collarette, 0.05);
    // Crypts: dark notches outside the collarette.
    let crypt =
        smoothstep(0.35, 0.75, fibre(6.0, 2.5, 409)) * smoothstep(collarette, collarette + 0.1, radius) * smoothstep(0.92, 0.75, radius);
    color *= 1.0 - 0.45 * crypt;
    color *= lerp(1.0, 0.24, smoothstep(0.80, 0.99, radius));
    // The upper lid's shadow lies on the eye even where the renderer casts none.
    color *= lerp(1.0, 0.62, smoothstep(0.1, 1.0, -p.y));
    let pupil = PUPIL + 0.008 * fibre(10.0, 0.0, 410);
    color.max(Vec3::ZERO).lerp(Vec3::splat(0.0035), smoothstep(pupil + 0.03, pupil - 0.02, radius))
}

fn sclera(p: Vec2, angle: f32, radius: f32) -> Vec3 {
    let away = p.length();
    let mut color = srgb(198, 186, 174).lerp(srgb(186, 171, 158), 0.5 + 0.5 * fractal(Vec3::new(p.x, p.y, 4.0) * 3.0, 3, 411));
    // Pinker towards the corners, where the lids' lining begins.
    let corner = smoothstep(0.24, 0.66, p.x.abs() + 0.3 * p.y.abs());
    color = color.lerp(srgb(206, 142, 130), 0.62 * corner);
    color = color.lerp(srgb(196, 128, 118), 0.7 * smoothstep(0.66, 0.95, away));
    // Thin vessels that wind in from the corners and thin out before the limbus.
    let vein = |turns: f32, seed: u32| {
        let bend = 0.9 * fractal(Vec3::new(p.x, p.y, 5.0) * 4.0, 3, seed) + 0.3 * noise(Vec3::new(p.x, p.y, 6.0) * 17.0, seed + 1);
        let line = noise(Vec3::new((angle + bend * 0.30) * turns, away * 1.6, 7.0), seed + 2).abs();
        smoothstep(0.055, 0.0, line)
    };
    let reach = smoothstep(1.35, 2.4, radius);
    color = color.lerp(srgb(176, 78, 68), (0.34 * vein(5.0, 420) + 0.20 * vein(9.0, 430)) * reach);
    color *= lerp(1.0, 0.80, smoothstep(0.12, 0.5, -p.y));
    // The limbus shades the white around it.
    color * lerp(0.72, 1.0, smoothstep(0.98, 1.25, radius))
}

fn srgb(r: u8, g: u8, b: u8) -> Vec3 {
    Vec3::new(encode::linear(r), encode::linear(g), encode::linear(b))
}
