//! The animated GIF: one palette, ordered dither, only what changed.

use gif::{DisposalMethod, Encoder, EncodingError, Frame, Repeat};
use image::RgbaImage;
use std::borrow::Cow;
use std::fs::File;
use std::io::BufWriter;
use std::path::Path;
use std::sync::mpsc::{SyncSender, sync_channel};
use std::thread::JoinHandle;
use std::time::Duration;

/// Palette entry that stands for "as it was".
const UNCHANGED: u8 = 255;
/// Colours besides it.
const NUM_COLORS: usize = 255;
/// Bits a channel by which colours are looked up.
const LOOK_UP_BITS: u32 = 6;
/// Half the range of the dither, of 255: about half the distance of neighbouring skin tones in the palette. Tuned by eye.
const DITHER: i32 = 3;
/// Ordered dither: it stands still from picture to picture, so that what did not change needs no bytes (Bayer 1973).
const BAYER: [[i32; 4]; 4] = [[0, 8, 2, 10], [12, 4, 14, 6], [3, 11, 1, 9], [15, 7, 13, 5]];
/// Pictures that wait for the encoder; a slow disk slows the film down, it does not fill the memory.
const MAX_WAITING: usize = 4;

/// The colours of a film.
#[derive(Debug, Clone)]
pub(crate) struct Palette {
    /// `NUM_COLORS` times red, green, blue, sRGB-encoded.
    colors: Vec<[u8; 3]>,
    /// Nearest entry of a colour of `LOOK_UP_BITS` a channel, once somebody asked.
    nearest: Vec<Option<u8>>,
}

impl Palette {
    /// Colours for pictures like these.
    pub(crate) fn of(pictures: &[RgbaImage]) -> Self {
        let samples: Vec<u8> = pictures.iter().flat_map(|picture| picture.pixels()).flat_map(|pixel| pixel.0).collect();
        // Learning from a third of the pixels is enough and takes 50 ms.
        let colors = color_quant::NeuQuant::new(3, NUM_COLORS, &samples).color_map_rgb();
        let colors = colors.chunks_exact(3).map(|color| [color[0], color[1], color[2]]).collect();
        Self { colors, nearest: vec![None; 1 << (3 * LOOK_UP_BITS)] }
    }

    fn nearest(&mut self, color: [u8; 3]) -> u8 {
        let key = color.iter().fold(0, |key, &channel| (key << LOOK_UP_BITS) | usize::from(channel >> (8 - LOOK_UP_BITS)));
        if let Some(index) = self.nearest[key] {
            return index;
        }
        let half_step = 1 << (7 - LOOK_UP_BITS);
        let middle = color.map(|channel| i32::from(channel >> (8 - LOOK_UP_BITS) << (8 - LOOK_UP_BITS)) + half_step);
        let distance = |entry: &[u8; 3]| {
            let [r, g, b] = [0, 1, 2].map(|c| middle[c] - i32::from(entry[c]));
            // A cheap stand-in for what eyes tell apart (Riemersma, "Colour metric").
            let (red, blue) = if middle[0] >= 128 { (3, 2) } else { (2, 3) };
            red * r * r + 4 * g * g + blue * b * b
        };
        let index = (0..self.colors.len()).min_by_key(|&index| distance(&self.colors[index])).unwrap_or(0) as u8;
        self.nearest[key] = Some(index);
        index
    }

    fn indices(&mut self, picture: &RgbaImage) -> Vec<u8> {
        picture
            .enumerate_pixels()
            .map(|(x, y, pixel)| {
                let dither = (2 * BAYER[(y % 4) as usize][(x % 4) as usize] - 15) * DITHER / 15;
                let [r, g, b, _] = pixel.0;
                self.nearest([r, g, b].map(|channel| (i32::from(channel) + dither).clamp(0, 255) as u8))
            })
            .collect()
    }
}

/// A GIF being written, on a thread of its own.
pub(crate) struct Animation {
    pictures: SyncSender<(RgbaImage, Duration)>,
    writer: JoinHandle<Result<Writer, EncodingError>>,
}

impl Animation {
    /// Begins the file at `path`; pictures have `size`.
    pub(crate) fn create(path: &Path, size: [u32; 2], palette: Palette) -> Result<Self, EncodingError> {
        let mut writer = Writer::create(path, size, palette)?;
        let (pictures, waiting) = sync_channel::<(RgbaImage, Duration)>(MAX_WAITING);
        let writer = std::thread::spawn(move || {
            for (picture, at) in waiting {
                writer.add(&picture, at)?;
            }
            Ok(writer)
        });
        Ok(Self { pictures, writer })
    }

    /// Adds the picture of `at`, counted from the beginning.
    pub(crate) fn add(&mut self, picture: RgbaImage, at: Duration) -> Result<(), EncodingError> {
        // The writer hangs up when it failed; `finish` tells why.
        self.pictures.send((picture, at)).map_err(|_| EncodingError::from(std::io::Error::other("the file could not be written")))
    }

    /// Ends the file; the last picture is shown until `at`.
    pub(crate) fn finish(self, at: Duration) -> Result<(), EncodingError> {
        drop(self.pictures);
        let writer = self.writer.join().map_err(|_| EncodingError::from(std::io::Error::other("the encoder panicked")))??;
        writer.finish(at)
    }
}

struct Writer {
    encoder: Encoder<BufWriter<File>>,
    palette: Palette,
    size: [u16; 2],
    /// What the file shows by now.
    canvas: Vec<u8>,
    /// The picture whose end is not known yet, and when it began, in hundredths of a second.
    pending: Option<(Frame<'static>, u64)>,
}

impl Writer {
    fn create(path: &Path, size: [u32; 2], palette: Palette) -> Result<Self, EncodingError> {
        let side = |pixels: u32| {
            u16::try_from(pixels).map_err(|_| EncodingError::from(std::io::Error::other("a GIF has at most 65,535 pixels a side")))
        };
        let size = [side(size[0])?, side(size[1])?];
        let mut colors: Vec<u8> = palette.colors.iter().flatten().copied().collect();
        colors.resize(3 * usize::from(UNCHANGED), 0);
        colors.extend([0, 0, 0]);
        let mut encoder = Encoder::new(BufWriter::new(File::create(path)?), size[0], size[1], &colors)?;
        encoder.set_repeat(Repeat::Infinite)?;
        Ok(Self { encoder, palette, size, canvas: Vec::new(), pending: None })
    }

    fn add(&mut self, picture: &RgbaImage, at: Duration) -> Result<(), EncodingError> {
        let indices = self.palette.indices(picture);
        let began_at = hundredths(at);
        self.write_pending(began_at)?;
        let frame = self.difference(&indices);
        self.canvas = indices;
        self.pending = Some((frame, began_at));
        Ok(())
    }

    fn finish(mut self, at: Duration) -> Result<(), EncodingError> {
        self.write_pending(hundredths(at))?;
        self.encoder.into_inner()?;
        Ok(())
    }

    fn write_pending(&mut self, ends_at: u64) -> Result<(), EncodingError> {
        if let Some((mut frame, began_at)) = self.pending.take() {
            // Viewers take less than 2 for a mistake and show such pictures slowly.
            frame.delay = ends_at.saturating_sub(began_at).clamp(2, u16::MAX.into()) as u16;
            self.encoder.write_frame(&frame)?;
        }
        Ok(())
    }

    /// The smallest rectangle that holds what changed; within it, unchanged pixels are let through.
    fn difference(&self, indices: &[u8]) -> Frame<'static> {
        let width = usize::from(self.size[0]);
        let changed = |at: usize| self.canvas.get(at) != Some(&indices[at]);
        let (mut left, mut right, mut top, mut bottom) = (width, 0, usize::from(self.size[1]), 0);
        for at in (0..indices.len()).filter(|&at| changed(at)) {
            (left, right) = (left.min(at % width), right.max(at % width + 1));
            (top, bottom) = (top.min(at / width), bottom.max(at / width + 1));
        }
        if left >= right {
            // Nothing changed: one pixel that lets through.
            (left, right, top, bottom) = (0, 1, 0, 1);
        }
        let buffer: Vec<u8> = (top..bottom)
            .flat_map(|y| (left..right).map(move |x| y * width + x))
            .map(|at| if changed(at) { indices[at] } else { UNCHANGED })
            .collect();
        Frame {
            left: left as u16,
            top: top as u16,
            width: (right - left) as u16,
            height: (bottom - top) as u16,
            transparent: Some(UNCHANGED),
            dispose: DisposalMethod::Keep,
            buffer: Cow::Owned(buffer),
            ..Frame::default()
        }
    }
}

fn hundredths(time: Duration) -> u64 {
    (time.as_secs_f64() * 100.0).round() as u64
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::codecs::gif::GifDecoder;
    use image::{AnimationDecoder, Rgba};
    use std::io::BufReader;

    /// A skin-coloured slope with a dark square at `x`.
    fn picture(x: u32) -> RgbaImage {
        RgbaImage::from_fn(64, 48, |px, py| {
            let is_square = (x..x + 12).contains(&px) && (16..28).contains(&py);
            if is_square { Rgba([60, 20, 24, 255]) } else { Rgba([230 - px as u8, 180 - py as u8, 150, 255]) }
        })
    }

    #[test]
    fn animation_shows_the_pictures_at_their_times_in_nearly_their_colors() {
        let path = std::env::temp_dir().join(format!("rhytid-animation-{}.gif", std::process::id()));
        let pictures: Vec<RgbaImage> = [0, 0, 20, 40].into_iter().map(picture).collect();
        let mut animation = Animation::create(&path, [64, 48], Palette::of(&pictures)).unwrap();
        for (picture, millis) in pictures.iter().zip([0, 80, 210, 250]) {
            animation.add(picture.clone(), Duration::from_millis(millis)).unwrap();
        }
        animation.finish(Duration::from_millis(1250)).unwrap();

        let decoder = GifDecoder::new(BufReader::new(File::open(&path).unwrap())).unwrap();
        let frames = decoder.into_frames().collect_frames().unwrap();
        std::fs::remove_file(&path).unwrap();
        assert_eq!(frames.len(), 4);
        let millis: Vec<u32> = frames.iter().map(|frame| frame.delay().numer_denom_ms()).map(|(n, d)| n / d).collect();
        assert_eq!(millis, [80, 130, 40, 1000]);
        for (frame, picture) in frames.iter().zip(&pictures) {
            let worst = frame.buffer().pixels().zip(picture.pixels()).map(|(a, b)| (0..3).map(|c| a.0[c].abs_diff(b.0[c])).max()).max();
            assert!(worst.flatten().is_some_and(|worst| worst <= 20), "{worst:?}");
        }
    }
}
