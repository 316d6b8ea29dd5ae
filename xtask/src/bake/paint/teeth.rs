//! Teeth and gums in one picture: enamel above (root to edge downwards), gum below.

use super::super::bust::Encoded;
use super::encode;
use super::noise::{fractal, lerp, noise, smoothstep};
use anyhow::Result;
use glam::Vec3;

/// Texels a side.
const SIZE: usize = 128;

/// Paints the picture.
pub fn paint() -> Result<Encoded> {
    let rgb: Vec<u8> = (0..SIZE * SIZE)
        .flat_map(|i| {
            let (u, v) = ((i % SIZE) as f32 / SIZE as f32, (i / SIZE) as f32 / SIZE as f32);
            let color =
                if v < 0.5 { enamel(u, v * 2.0) * depth_shade(u) } else { gum(u, v * 2.0 - 1.0) * depth_shade((2.0 * u - 1.0).abs()) };
            color.to_array().map(encode::srgb)
        })
        .collect();
    encode::jpeg(SIZE, &rgb, 92)
}

/// How much light reaches what lies this far back, 0 the middle incisors to 1 the last molars: nothing else in the file
/// darkens the depth of the mouth. Redder where it is darker.
fn depth_shade(back: f32) -> Vec3 {
    let dark = smoothstep(0.22, 0.85, back);
    Vec3::ONE.lerp(Vec3::new(0.46, 0.37, 0.32), dark)
}

/// `down` runs from the neck of the tooth (0) to its edge (1).
fn enamel(u: f32, down: f32) -> Vec3 {
    let root = srgb(226, 200, 156);
    let body = srgb(243, 227, 194);
    let edge = srgb(234, 226, 208);
    let stain = fractal(Vec3::new(u * 9.0, down * 3.0, 1.0), 3, 501);
    let streak = noise(Vec3::new(u * 60.0, down * 2.0, 2.0), 502);
    let color = root.lerp(body, smoothstep(0.0, 0.45, down + 0.1 * stain)).lerp(edge, 0.6 * smoothstep(0.78, 1.0, down));
    color * (1.0 + 0.05 * stain + 0.03 * streak)
}

fn gum(u: f32, down: f32) -> Vec3 {
    let blotch = fractal(Vec3::new(u * 12.0, down * 6.0, 3.0), 3, 503);
    srgb(214, 136, 128).lerp(srgb(196, 112, 106), (0.5 + 0.5 * blotch).clamp(0.0, 1.0)) * lerp(1.0, 0.8, down)
}

fn srgb(r: u8, g: u8, b: u8) -> Vec3 {
    Vec3::new(encode::linear(r), encode::linear(g), encode::linear(b))
}
