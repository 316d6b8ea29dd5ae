//! `cargo xtask convert`: wrinkles as artists have them (tangent-space normal maps) to the forms Rhytid stores and back, with
//! what the way costs printed.

mod forms;

use anyhow::{Context, Result, bail, ensure};
use clap::{Args, ValueEnum};
use forms::{Loss, Texel};
use glam::{Vec2, Vec3};
use image::{ImageFormat, Rgb, RgbImage};
use std::path::{Path, PathBuf};

/// How a picture holds the wrinkled skin's direction. In each, code 128 is exactly 0 and 255 is 1.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Form {
    /// A tangent-space normal map: x, y, z in red, green, blue; green up, as in glTF
    Normals,
    /// Partial derivatives x/z, y/z over a scale in red and green, less those of the base: `poses[].map`, `zones.map`
    Derivatives,
    /// Normal less the base's normal in red, green, blue: `zones.difference`
    Differences,
}

/// What to convert.
#[derive(Debug, Args)]
pub struct Conversion {
    /// PNG to read, 8 or 16 bits a channel
    input: PathBuf,
    /// PNG to write, 8 bits a channel
    output: PathBuf,
    /// Form of the input
    #[arg(long, value_enum)]
    from: Form,
    /// Form of the output
    #[arg(long, value_enum)]
    to: Form,
    /// Normal map of the neutral skin that derivatives and differences are against, of the size of the input; flat without it
    #[arg(long)]
    base: Option<PathBuf>,
    /// Scale of derivatives that are read
    #[arg(long, default_value_t = 1.0)]
    from_scale: f32,
    /// Scale of derivatives that are written; the smallest step of 0.05 that holds them all, up to 4, without it
    #[arg(long)]
    scale: Option<f32>,
    /// Texels a side of the output: the input's side divided by a whole number (derivatives are averaged)
    #[arg(long)]
    size: Option<u32>,
    /// Normal maps (input and base) have green pointing down, as some tools write them
    #[arg(long)]
    green_down: bool,
}

/// Converts one picture and prints what was lost.
pub fn run(conversion: &Conversion) -> Result<()> {
    for scale in [Some(conversion.from_scale), conversion.scale].into_iter().flatten() {
        ensure!(scale > 0.0 && scale <= forms::MAX_SCALE, "a scale is {scale}, expected more than 0 and at most {}", forms::MAX_SCALE);
    }
    // Of what is read it would say nothing, and the picture would be wrong.
    ensure!(
        conversion.scale.is_none() || conversion.to == Form::Derivatives,
        "--scale is for derivatives that are written; the scale of those that are read is --from-scale"
    );
    let (picture, side) = read(&conversion.input)?;
    let base = match &conversion.base {
        Some(path) => {
            let (base, base_side) = read(path)?;
            ensure!(base_side == side, "{} is {base_side:?} texels, expected {side:?} as the input", path.display());
            Some(base)
        }
        None => None,
    };
    let flip = if conversion.green_down { -1.0 } else { 1.0 };
    let normal = |value: Vec3| forms::normal_of(value * Vec3::new(1.0, flip, 1.0));
    let texels: Vec<Texel> = picture
        .iter()
        .enumerate()
        .map(|(i, &value)| {
            let base = base.as_ref().map_or(Vec3::Z, |base| normal(base[i]));
            let wrinkled = match conversion.from {
                Form::Normals => normal(value),
                Form::Derivatives => forms::from_derivatives(value.truncate() * conversion.from_scale, base),
                Form::Differences => forms::from_difference(value, base),
            };
            Texel { wrinkled, base }
        })
        .collect();
    let (texels, side) = match conversion.size {
        Some(size) => reduce(&texels, side, size)?,
        None => (texels, side),
    };

    let scale = conversion.scale.unwrap_or_else(|| forms::scale_for(&texels));
    let mut loss = Loss::default();
    let mut out = RgbImage::new(side.0, side.1);
    for (texel, pixel) in texels.iter().zip(out.pixels_mut()) {
        *pixel = Rgb(match conversion.to {
            Form::Normals => loss.count(texel, texel.wrinkled, forms::normal_of),
            Form::Derivatives => {
                let [red, green, _] = loss.count(texel, (texel.derivatives() / scale).extend(0.0), |value| {
                    forms::from_derivatives(value.truncate() * scale, texel.base)
                });
                [red, green, 255]
            }
            Form::Differences => loss.count(texel, texel.wrinkled - texel.base, |value| forms::from_difference(value, texel.base)),
        });
    }
    out.save_with_format(&conversion.output, ImageFormat::Png).with_context(|| format!("cannot write {}", conversion.output.display()))?;
    let scale = if conversion.to == Form::Derivatives { format!(", scale {scale}") } else { String::new() };
    println!("{}: {} x {} texels{scale}", conversion.output.display(), side.0, side.1);
    println!("{loss}");
    Ok(())
}

type Side = (u32, u32);

/// A picture's texels in `[-1, 1]`, and its size.
fn read(path: &Path) -> Result<(Vec<Vec3>, Side)> {
    let bytes = std::fs::read(path).with_context(|| format!("cannot read {}", path.display()))?;
    let picture = image::load_from_memory_with_format(&bytes, ImageFormat::Png).with_context(|| format!("{} is no PNG", path.display()))?;
    ensure!(picture.color().channel_count() >= 3, "{} is gray, expected red, green and blue", path.display());
    let rgb = picture.into_rgb16();
    let texels = rgb.pixels().map(|pixel| Vec3::from(pixel.0.map(|wide| forms::value_of(f32::from(wide) / 257.0)))).collect();
    Ok((texels, rgb.dimensions()))
}

/// Averages the slopes of both normals over squares of texels.
fn reduce(texels: &[Texel], (width, height): Side, size: u32) -> Result<(Vec<Texel>, Side)> {
    if size == 0 || width != height || !width.is_multiple_of(size) {
        bail!("--size {size} does not divide {width} x {height}, expected a square input and a whole number of its texels in each");
    }
    let step = width / size;
    let share = 1.0 / (step * step) as f32;
    let mean = |x: u32, y: u32, of: &dyn Fn(&Texel) -> Vec2| {
        let inside = (0..step * step).map(|k| of(&texels[((y * step + k / step) * width + x * step + k % step) as usize]));
        (inside.sum::<Vec2>() * share).extend(1.0).normalize()
    };
    let reduced = (0..size * size).map(|i| {
        let (x, y) = (i % size, i / size);
        Texel {
            wrinkled: mean(x, y, &|texel| forms::derivatives_of(texel.wrinkled)),
            base: mean(x, y, &|texel| forms::derivatives_of(texel.base)),
        }
    });
    Ok((reduced.collect(), (size, size)))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A folder of this test's own, gone when the test ends.
    struct Folder(PathBuf);

    impl Folder {
        fn new(name: &str) -> Self {
            let path = std::env::temp_dir().join(format!("rhytid-convert-{name}-{}", std::process::id()));
            std::fs::create_dir_all(&path).expect("a folder for the test");
            Self(path)
        }
    }

    impl Drop for Folder {
        fn drop(&mut self) {
            let _ = std::fs::remove_dir_all(&self.0);
        }
    }

    /// A normal map of soft waves up to about 45 degrees.
    fn waves(path: &Path, side: u32, strength: f32) {
        let picture = RgbImage::from_fn(side, side, |x, y| {
            let (s, t) = (x as f32 * 0.21, y as f32 * 0.13);
            let n = Vec3::new(strength * libm::sinf(s), strength * libm::cosf(t), 1.0).normalize();
            Rgb(n.to_array().map(forms::code_of))
        });
        picture.save(path).expect("written");
    }

    fn conversion(folder: &Folder, input: &str, output: &str, from: Form, to: Form) -> Conversion {
        let (input, output) = (folder.0.join(input), folder.0.join(output));
        Conversion { input, output, from, to, base: None, from_scale: 1.0, scale: None, size: None, green_down: false }
    }

    fn largest_angle(a: &Path, b: &Path) -> f32 {
        let (a, b) = (read(a).expect("read").0, read(b).expect("read").0);
        a.iter().zip(&b).map(|(a, b)| forms::angle(forms::normal_of(*a), forms::normal_of(*b))).fold(0.0, f32::max)
    }

    /// Only derivatives have one.
    fn scale_of(form: Form, scale: f32) -> Option<f32> {
        (form == Form::Derivatives).then_some(scale)
    }

    #[test]
    fn normals_come_back_from_either_form_with_any_base() {
        let folder = Folder::new("round");
        waves(&folder.0.join("in.png"), 64, 0.6);
        waves(&folder.0.join("base.png"), 64, 0.2);
        for base in [None, Some(folder.0.join("base.png"))] {
            for form in [Form::Derivatives, Form::Differences] {
                let there = Conversion {
                    base: base.clone(),
                    scale: scale_of(form, 0.9),
                    ..conversion(&folder, "in.png", "form.png", Form::Normals, form)
                };
                run(&there).expect("converted");
                let back =
                    Conversion { base: base.clone(), from_scale: 0.9, ..conversion(&folder, "form.png", "out.png", form, Form::Normals) };
                run(&back).expect("converted");
                let angle = largest_angle(&folder.0.join("in.png"), &folder.0.join("out.png")).to_degrees();
                // Two roundings to eight bits.
                assert!(angle < 0.8, "{form:?}, base {base:?}: {angle} degrees");
            }
        }
        // Against another base than it was made with, the wrinkles are others: the comparison can fail.
        run(&Conversion {
            base: Some(folder.0.join("base.png")),
            ..conversion(&folder, "form.png", "wrong.png", Form::Differences, Form::Normals)
        })
        .expect("converted");
        run(&conversion(&folder, "form.png", "other.png", Form::Differences, Form::Normals)).expect("converted");
        assert!(largest_angle(&folder.0.join("wrong.png"), &folder.0.join("other.png")).to_degrees() > 5.0);
    }

    #[test]
    fn a_flat_map_is_flat_in_every_form() {
        let folder = Folder::new("flat");
        RgbImage::from_pixel(4, 4, Rgb([128, 128, 255])).save(folder.0.join("in.png")).expect("written");
        for (to, want) in [(Form::Derivatives, [128, 128, 255]), (Form::Differences, [128, 128, 128]), (Form::Normals, [128, 128, 255])] {
            run(&Conversion { scale: scale_of(to, 0.3), ..conversion(&folder, "in.png", "out.png", Form::Normals, to) })
                .expect("converted");
            let out = image::open(folder.0.join("out.png")).expect("read").to_rgb8();
            assert!(out.pixels().all(|pixel| pixel.0 == want), "{to:?}");
        }
    }

    #[test]
    fn green_that_points_down_is_turned_and_maps_are_made_smaller() {
        let folder = Folder::new("green");
        waves(&folder.0.join("in.png"), 64, 0.5);
        let turned = image::open(folder.0.join("in.png")).expect("read").to_rgb8();
        let turned = RgbImage::from_fn(64, 64, |x, y| {
            let [red, green, blue] = turned.get_pixel(x, y).0;
            Rgb([red, (256 - u32::from(green)) as u8, blue])
        });
        turned.save(folder.0.join("turned.png")).expect("written");
        let to = |input, output| Conversion { size: Some(16), ..conversion(&folder, input, output, Form::Normals, Form::Derivatives) };
        run(&to("in.png", "up.png")).expect("converted");
        run(&Conversion { green_down: true, ..to("turned.png", "down.png") }).expect("converted");
        let (up, down) = (image::open(folder.0.join("up.png")).expect("read"), image::open(folder.0.join("down.png")).expect("read"));
        assert_eq!((up.width(), up.to_rgb8()), (16, down.to_rgb8()));
    }

    #[test]
    fn mistakes_are_told() {
        let folder = Folder::new("mistakes");
        waves(&folder.0.join("in.png"), 8, 0.5);
        waves(&folder.0.join("base.png"), 16, 0.5);
        std::fs::write(folder.0.join("text.png"), "no picture").expect("written");
        image::GrayImage::new(8, 8).save(folder.0.join("gray.png")).expect("written");
        let plain = |input| conversion(&folder, input, "out.png", Form::Normals, Form::Derivatives);
        let says = |conversion: Conversion, part: &str| {
            let message = format!("{:#}", run(&conversion).expect_err("refused"));
            assert!(message.contains(part), "{message:?} lacks {part:?}");
        };
        says(plain("missing.png"), "cannot read");
        says(plain("text.png"), "is no PNG");
        says(plain("gray.png"), "is gray");
        says(Conversion { base: Some(folder.0.join("base.png")), ..plain("in.png") }, "expected (8, 8) as the input");
        says(Conversion { scale: Some(0.0), ..plain("in.png") }, "a scale is 0");
        says(Conversion { scale: Some(0.6), to: Form::Normals, ..plain("in.png") }, "is --from-scale");
        says(Conversion { size: Some(3), ..plain("in.png") }, "--size 3 does not divide 8 x 8");
    }
}
