//! Pictures as they go into the file.

use super::super::bust::Encoded;
use anyhow::Result;
use image::ExtendedColorType::{Rgb8, Rgba8};
use image::ImageEncoder;
use image::codecs::jpeg::JpegEncoder;
use image::codecs::png::{CompressionType, FilterType, PngEncoder};

/// A JPEG (no chroma subsampling) of `size`² RGB texels.
pub fn jpeg(size: usize, rgb: &[u8], quality: u8) -> Result<Encoded> {
    let mut bytes = Vec::new();
    JpegEncoder::new_with_quality(&mut bytes, quality).write_image(rgb, size as u32, size as u32, Rgb8)?;
    Ok(Encoded { mime: "image/jpeg", bytes })
}

/// A PNG of `size`² RGB texels.
pub fn png(size: usize, rgb: &[u8]) -> Result<Encoded> {
    let mut bytes = Vec::new();
    let encoder = PngEncoder::new_with_quality(&mut bytes, CompressionType::Best, FilterType::Adaptive);
    encoder.write_image(rgb, size as u32, size as u32, Rgb8)?;
    Ok(Encoded { mime: "image/png", bytes })
}

/// A PNG of `size`² RGBA texels.
pub fn png_rgba(size: usize, rgba: &[u8]) -> Result<Encoded> {
    let mut bytes = Vec::new();
    let encoder = PngEncoder::new_with_quality(&mut bytes, CompressionType::Best, FilterType::Adaptive);
    encoder.write_image(rgba, size as u32, size as u32, Rgba8)?;
    Ok(Encoded { mime: "image/png", bytes })
}

/// The sRGB code of linear light in [0, 1] (IEC 61966-2-1).
pub fn srgb(linear: f32) -> u8 {
    let x = linear.clamp(0.0, 1.0);
    let encoded = if x <= 0.003_130_8 { 12.92 * x } else { 1.055 * libm::powf(x, 1.0 / 2.4) - 0.055 };
    (encoded * 255.0 + 0.5) as u8
}

/// Linear light of an sRGB code.
pub fn linear(code: u8) -> f32 {
    let x = f32::from(code) / 255.0;
    if x <= 0.040_45 { x / 12.92 } else { libm::powf((x + 0.055) / 1.055, 2.4) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn srgb_codes_survive_the_way_there_and_back() {
        for code in 0..=255 {
            assert_eq!(srgb(linear(code)), code);
        }
    }
}
