//! The animated PNG: every colour, only what changed.

use image::RgbaImage;
use png::{BitDepth, BlendOp, ColorType, Compression, DisposeOp, Encoder, EncodingError, Writer};
use std::fs::File;
use std::io::BufWriter;
use std::path::Path;
use std::time::Duration;

/// Ticks a second that delays are counted in; a delay has 16 bits, so a picture stays for a minute at most.
const TICKS: u16 = 1000;

/// An animated PNG being written; it plays for ever.
pub(crate) struct Apng {
    writer: Writer<BufWriter<File>>,
    /// What the file shows by now.
    shown: Option<RgbaImage>,
    /// The picture whose end is not known yet, and when it began.
    pending: Option<(RgbaImage, Duration)>,
}

impl Apng {
    /// Begins the file at `path`: `num` pictures of `size`, no more and no less.
    pub(crate) fn create(path: &Path, size: [u32; 2], num: u32) -> Result<Self, EncodingError> {
        let mut encoder = Encoder::new(BufWriter::new(File::create(path)?), size[0], size[1]);
        encoder.set_color(ColorType::Rgba);
        encoder.set_depth(BitDepth::Eight);
        encoder.set_compression(Compression::Balanced);
        encoder.set_source_srgb(png::SrgbRenderingIntent::Perceptual);
        encoder.set_animated(num, 0)?;
        Ok(Self { writer: encoder.write_header()?, shown: None, pending: None })
    }

    /// Adds the picture of `at`, counted from the beginning.
    pub(crate) fn add(&mut self, picture: RgbaImage, at: Duration) -> Result<(), EncodingError> {
        self.write_pending(at)?;
        self.pending = Some((picture, at));
        Ok(())
    }

    /// Ends the file; the last picture is shown until `at`.
    pub(crate) fn finish(mut self, at: Duration) -> Result<(), EncodingError> {
        self.write_pending(at)?;
        self.writer.finish()
    }

    fn write_pending(&mut self, ends_at: Duration) -> Result<(), EncodingError> {
        let Some((picture, began_at)) = self.pending.take() else { return Ok(()) };
        let ticks = |time: Duration| (time.as_secs_f64() * f64::from(TICKS)).round() as u64;
        // 0 means as fast as it goes.
        let delay = ticks(ends_at).saturating_sub(ticks(began_at)).clamp(1, u16::MAX.into()) as u16;
        self.writer.set_frame_delay(delay, TICKS)?;
        // The first picture is the whole one: it is what programs show that know no animation.
        if let Some(shown) = &self.shown {
            let [left, top, width, height] = changed(shown, &picture);
            // Before it is moved, so that it is inside at every step.
            self.writer.reset_frame_position()?;
            self.writer.set_frame_dimension(width, height)?;
            self.writer.set_frame_position(left, top)?;
            self.writer.set_blend_op(BlendOp::Source)?;
            self.writer.set_dispose_op(DisposeOp::None)?;
            let part = image::imageops::crop_imm(&picture, left, top, width, height).to_image();
            self.writer.write_image_data(part.as_raw())?;
        } else {
            self.writer.write_image_data(picture.as_raw())?;
        }
        self.shown = Some(picture);
        Ok(())
    }
}

/// Left, top, width and height of the smallest rectangle that holds all that differs; one pixel where nothing does.
fn changed(a: &RgbaImage, b: &RgbaImage) -> [u32; 4] {
    let (mut left, mut top, mut right, mut bottom) = (u32::MAX, u32::MAX, 0, 0);
    for ((x, y, was), is) in a.enumerate_pixels().zip(b.pixels()) {
        if was != is {
            (left, top) = (left.min(x), top.min(y));
            (right, bottom) = (right.max(x + 1), bottom.max(y + 1));
        }
    }
    if left >= right { [0, 0, 1, 1] } else { [left, top, right - left, bottom - top] }
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::codecs::png::PngDecoder;
    use image::{AnimationDecoder, Rgba};
    use std::io::BufReader;

    #[test]
    fn an_animated_png_shows_every_picture_as_it_was() {
        let path = std::env::temp_dir().join(format!("rhytid-apng-{}.png", std::process::id()));
        let picture = |x: u32| {
            RgbaImage::from_fn(40, 30, |px, py| {
                if (x..x + 8).contains(&px) && (10..20).contains(&py) {
                    Rgba([200, 10, 20, 255])
                } else {
                    Rgba([px as u8, py as u8, 9, 255])
                }
            })
        };
        let pictures: Vec<RgbaImage> = [0, 0, 20, 31].into_iter().map(picture).collect();
        let mut animation = Apng::create(&path, [40, 30], 4).unwrap();
        for (picture, millis) in pictures.iter().zip([0, 80, 210, 250]) {
            animation.add(picture.clone(), Duration::from_millis(millis)).unwrap();
        }
        animation.finish(Duration::from_millis(1250)).unwrap();
        let decoder = PngDecoder::new(BufReader::new(File::open(&path).unwrap())).unwrap().apng().unwrap();
        let frames = decoder.into_frames().collect_frames().unwrap();
        std::fs::remove_file(&path).unwrap();
        assert_eq!(frames.len(), 4);
        let millis: Vec<u32> = frames.iter().map(|frame| frame.delay().numer_denom_ms()).map(|(n, d)| n / d).collect();
        assert_eq!(millis, [80, 130, 40, 1000]);
        for (frame, picture) in frames.iter().zip(&pictures) {
            assert!(frame.buffer() == picture, "to the bit");
        }
    }
}
