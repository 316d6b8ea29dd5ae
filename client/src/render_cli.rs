//! `render`: a feed file to pictures, the server's solve in this process. `still`: one picture of a pose.

use crate::asset::{AssetError, CharacterAsset};
use crate::picture_size::parse_size;
use crate::renderer::{
    BlendMode, Camera, Deformation, DrawSettings, Headless, RenderError, RenderFrame, Studio, ViewError, ViewMode, WrinkleSystem, ZoneBlend,
};
use glam::{Quat, Vec3};
use image::RgbaImage;
use indicatif::{ProgressBar, ProgressStyle};
use rhytid_server::feed::{Feed, FeedError, FeedItem};
use rhytid_server::solve::{SolveConfig, SolveError, Solver};
use rhytid_shared::{
    ArkitShape, Character, DEFAULT_CHARACTER_GLB, FaceFrame, HeadPose, NUM_ARKIT_SHAPES, PublishHello, TrackingData, TrackingFrame,
};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Why there is no picture.
#[derive(Debug, thiserror::Error)]
pub enum PictureError {
    /// The character file.
    #[error("{path}: {source}")]
    Character {
        /// The file.
        path: String,
        /// What is wrong with it.
        source: AssetError,
    },
    /// A file cannot be read or written.
    #[error("{path}: {source}")]
    Io {
        /// The file or folder.
        path: String,
        /// What the system said.
        source: std::io::Error,
    },
    /// A picture cannot be written.
    #[error("{path}: {source}")]
    Write {
        /// The picture.
        path: String,
        /// What the encoder said.
        source: image::ImageError,
    },
    /// The feed file.
    #[error(transparent)]
    Feed(#[from] FeedError),
    /// A frame of the feed was refused.
    #[error("{path}:{line}: {source}")]
    Frame {
        /// The feed.
        path: String,
        /// Its line, from 1.
        line: usize,
        /// What the solve said.
        source: SolveError,
    },
    /// A file holds no neutral face.
    #[error("{path} holds no neutral face: {source}")]
    Calibration {
        /// The file.
        path: String,
        /// What was read instead.
        source: serde_json::Error,
    },
    /// A neutral face is not one for this feed.
    #[error("{path} is of another feed or damaged: {source}")]
    Unfit {
        /// The file.
        path: String,
        /// What the solve said.
        source: SolveError,
    },
    /// There is no neutral face to write.
    #[error("{feed} came to no neutral face, nothing to write to {path}")]
    NoNeutral {
        /// The feed.
        feed: String,
        /// The file.
        path: String,
    },
    /// A pose given on the command line was refused.
    #[error(transparent)]
    Solve(#[from] SolveError),
    /// Drawing failed.
    #[error(transparent)]
    Render(#[from] RenderError),
    /// The view is unknown.
    #[error(transparent)]
    View(#[from] ViewError),
    /// A name on the command line is unknown.
    #[error("{what} {got:?} is unknown, expected one of: {expected}")]
    Name {
        /// What was named.
        what: &'static str,
        /// What was given.
        got: String,
        /// The names there are.
        expected: String,
    },
    /// The character has not what a picture shows.
    #[error("the character has no {0}")]
    Lacks(&'static str),
}

type Result<T> = std::result::Result<T, PictureError>;

/// What every picture needs.
#[derive(Debug, Clone, clap::Args)]
pub struct PictureArgs {
    /// Pixels, WIDTHxHEIGHT
    #[arg(long, default_value = "512x512", value_parser = parse_size)]
    pub size: [u32; 2],
    /// beauty, bare, split, influence, influence:POSE, normals, wireframe, diffuse, specular, scattering, translucency, blood, masks, masks:ZONE, bone-masks
    /// or shape-deltas
    #[arg(long, default_value = "beauty")]
    pub view: String,
    /// How wrinkle maps become normals: pd, simple or printed
    #[arg(long, default_value_t = BlendMode::PartialDerivatives)]
    pub blend: BlendMode,
    /// What deforms the face: bones, or the mesh's own expression shapes where the frame has weights for them
    #[arg(long, default_value_t = Deformation::Bones, value_name = "bones|shapes")]
    pub deform: Deformation,
    /// Character file; the built-in one where none is given
    #[arg(long, value_name = "FILE.glb")]
    pub character: Option<PathBuf>,
    /// Turn of the camera about the head in degrees, YAW,PITCH: positive goes to the character's left and up
    #[arg(long, default_value = "0,0", value_parser = parse_pair, allow_hyphen_values = true)]
    pub orbit: [f32; 2],
    /// Distance of the camera, 1 frames the head
    #[arg(long, default_value_t = 1.0, value_parser = parse_zoom)]
    pub zoom: f32,
    /// Whose wrinkles: own (what the character is made for), bones, zones or both
    #[arg(long, default_value_t = WrinkleSystem::Own)]
    pub wrinkles: WrinkleSystem,
    /// How zones' wrinkles are blended: pd, difference or two-maps
    #[arg(long, default_value_t = ZoneBlend::PartialDerivatives)]
    pub zone_blend: ZoneBlend,
    /// Set-up of lights: portrait or sunset
    #[arg(long, default_value_t = Studio::Portrait)]
    pub light: Studio,
    /// Turn of the key light in degrees: positive goes to the character's left
    #[arg(long, default_value_t = 0.0, value_parser = parse_degrees, allow_hyphen_values = true)]
    pub key_turn: f32,
    /// Picture is drawn this many times as large a side and averaged, 1 to 4
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=4))]
    pub supersample: u32,
}

/// Arguments of `render`.
#[derive(Debug, Clone, clap::Args)]
pub struct RenderArgs {
    /// Feed file
    #[arg(value_name = "FEED.jsonl")]
    pub feed: PathBuf,
    /// Folder for the pictures, named by the index of their frame: 00000.png, …
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Draw every n-th frame; all are solved
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..))]
    pub every: u32,
    /// Stop after this many pictures
    #[arg(long)]
    pub limit: Option<usize>,
    /// Start from the neutral face that --save-calibration wrote instead of searching for one
    #[arg(long, value_name = "FILE.json")]
    pub calibration: Option<PathBuf>,
    /// Write the neutral face that the feed came to
    #[arg(long, value_name = "FILE.json")]
    pub save_calibration: Option<PathBuf>,
    /// Picture
    #[command(flatten)]
    pub picture: PictureArgs,
}

/// Arguments of `still`.
#[derive(Debug, Clone, clap::Args)]
pub struct StillArgs {
    /// Reference pose by name; the face at rest where none is given
    #[arg(long)]
    pub pose: Option<String>,
    /// How much of the pose, 0 to 1
    #[arg(long, default_value_t = 1.0, value_parser = parse_amount)]
    pub amount: f32,
    /// Which bones take it: the character's own left or right, or both
    #[arg(long, value_enum, default_value_t = StillSide::Both)]
    pub side: StillSide,
    /// Expression weight NAME=VALUE (ARKit's names), instead of a pose; may be repeated
    #[arg(long = "weight", value_name = "NAME=VALUE", conflicts_with = "pose")]
    pub weights: Vec<String>,
    /// Turn of the head in degrees, YAW,PITCH: positive turns to the character's left and up
    #[arg(long, default_value = "0,0", value_parser = parse_pair, allow_hyphen_values = true)]
    pub head: [f32; 2],
    /// The picture's file
    #[arg(long, value_name = "FILE.png")]
    pub out: PathBuf,
    /// Picture
    #[command(flatten)]
    pub picture: PictureArgs,
}

/// Which side of the face takes a pose.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum StillSide {
    /// The character's left, +X.
    Left,
    /// The character's right, -X.
    Right,
    /// Both, with the bones between.
    Both,
}

/// A character on a device, with the settings of the command line.
struct PictureMaker {
    asset: CharacterAsset,
    headless: Headless,
    settings: DrawSettings,
    size: [u32; 2],
    supersample: u32,
}

impl PictureMaker {
    fn open(args: &PictureArgs) -> Result<Self> {
        let asset = load_character(args.character.as_deref())?;
        let mut camera = Camera::front(&asset.character);
        camera.orbit(args.orbit[0].to_radians(), args.orbit[1].to_radians());
        camera.zoom(args.zoom);
        let view = ViewMode::parse(&args.view, &asset.character)?;
        let settings = DrawSettings {
            view,
            deform: args.deform,
            blend: args.blend,
            system: args.wrinkles,
            zone_blend: args.zone_blend,
            studio: args.light,
            key_turn: args.key_turn.to_radians(),
            ..DrawSettings::new(camera)
        };
        let headless = Headless::new(&asset)?;
        tracing::info!(adapter = headless.adapter().name, "drawing");
        Ok(Self { asset, headless, settings, size: args.size, supersample: args.supersample })
    }

    fn draw(&mut self, frame: &FaceFrame, path: &Path) -> Result<()> {
        let large = self.size.map(|side| side * self.supersample);
        let picture = self.headless.render(large, &self.settings, &RenderFrame::from(frame))?;
        let picture = if self.supersample > 1 { averaged(&picture, self.supersample) } else { picture };
        picture.save(path).map_err(|source| PictureError::Write { path: path.display().to_string(), source })
    }
}

/// Solves a whole feed and draws its frames; returns how many pictures were written.
pub fn render(args: &RenderArgs) -> Result<usize> {
    let mut maker = PictureMaker::open(&args.picture)?;
    let character = Arc::clone(&maker.asset.character);
    let path = args.feed.display().to_string();
    let num_frames = count_frames(&args.feed)?;
    let mut feed = Feed::open(&args.feed, &character)?;
    let mut solver = match &args.calibration {
        Some(path) => start_calibrated(&character, &feed.hello, path)?,
        None => Solver::new(Arc::clone(&character), &SolveConfig::default(), &feed.hello)?,
    };
    std::fs::create_dir_all(&args.out).map_err(|source| PictureError::Io { path: args.out.display().to_string(), source })?;

    let progress = progress_bar(num_frames);
    let mut tracked = TrackingFrame::default();
    let mut solved = FaceFrame::at_rest(&character);
    let (mut index, mut num_written) = (0_usize, 0);
    while let Some(item) = feed.next_frame(&mut tracked)? {
        match item {
            FeedItem::Command(command) => solver.command(&command)?,
            FeedItem::Frame => {
                solver.solve(&tracked, &mut solved).map_err(|source| PictureError::Frame {
                    path: path.clone(),
                    line: feed.line(),
                    source,
                })?;
                if index.is_multiple_of(args.every as usize) {
                    maker.draw(&solved, &args.out.join(format!("{index:05}.png")))?;
                    num_written += 1;
                }
                index += 1;
                progress.inc(1);
                if args.limit.is_some_and(|limit| num_written >= limit) {
                    break;
                }
            }
        }
    }
    progress.finish_and_clear();
    if let Some(path) = &args.save_calibration {
        save_calibration(&solver, &args.feed, path)?;
    }
    Ok(num_written)
}

/// A solver that starts from the neutral face in the file at `path`.
fn start_calibrated(character: &Arc<Character>, hello: &PublishHello, path: &Path) -> Result<Solver> {
    let shown = path.display().to_string();
    let text = std::fs::read(path).map_err(|source| PictureError::Io { path: shown.clone(), source })?;
    let calibration = serde_json::from_slice(&text).map_err(|source| PictureError::Calibration { path: shown.clone(), source })?;
    // What is wrong with the hello is no fault of the file.
    Solver::new(Arc::clone(character), &SolveConfig::default(), hello)?;
    Solver::with_calibration(Arc::clone(character), &SolveConfig::default(), hello, calibration)
        .map_err(|source| PictureError::Unfit { path: shown, source })
}

/// Writes the neutral face in use to the file at `path`.
fn save_calibration(solver: &Solver, feed: &Path, path: &Path) -> Result<()> {
    let shown = path.display().to_string();
    let Some(calibration) = solver.calibration() else {
        return Err(PictureError::NoNeutral { feed: feed.display().to_string(), path: shown });
    };
    let text = serde_json::to_string_pretty(calibration).map_err(|source| PictureError::Calibration { path: shown.clone(), source })?;
    std::fs::write(path, text + "\n").map_err(|source| PictureError::Io { path: shown, source })
}

/// Draws one picture of a pose, through the same solve as everything else.
pub fn still(args: &StillArgs) -> Result<()> {
    let mut maker = PictureMaker::open(&args.picture)?;
    let character = Arc::clone(&maker.asset.character);
    let head = HeadPose {
        rotation: Quat::from_rotation_y(args.head[0].to_radians()) * Quat::from_rotation_x(-args.head[1].to_radians()),
        position: Vec3::ZERO,
    };
    let data = if args.weights.is_empty() {
        let points = match &args.pose {
            Some(name) => posed_points(&character, name, args.amount, args.side)?,
            None => Vec::new(),
        };
        TrackingData::Bones { points, head: Some(head) }
    } else {
        TrackingData::Weights { weights: Box::new(parse_weights(&args.weights)?), head: Some(head) }
    };
    let solved = solve_one(&character, data)?;
    maker.draw(&solved, &args.out)
}

/// One frame by itself, as the first of a session.
pub fn solve_one(character: &Arc<Character>, data: TrackingData) -> std::result::Result<FaceFrame, SolveError> {
    solve_first(character, &TrackingFrame::new(0.0, data))
}

/// As [`solve_one`], with all that a frame may say besides.
pub fn solve_first(character: &Arc<Character>, tracked: &TrackingFrame) -> std::result::Result<FaceFrame, SolveError> {
    let hello = PublishHello { source: "still".into(), ..PublishHello::default() };
    let mut solver = Solver::new(Arc::clone(character), &SolveConfig::default(), &hello)?;
    let mut solved = FaceFrame::at_rest(character);
    solver.solve(tracked, &mut solved)?;
    Ok(solved)
}

/// `(bone, point)` for `amount` of the pose called `name` on one side of the face or both.
pub fn posed_points(character: &Character, name: &str, amount: f32, side: StillSide) -> Result<Vec<(usize, Vec3)>> {
    let pose = character.poses.iter().find(|pose| pose.name == name).ok_or_else(|| PictureError::Name {
        what: "pose",
        got: name.to_owned(),
        expected: character.poses.iter().map(|pose| pose.name.as_str()).collect::<Vec<_>>().join(", "),
    })?;
    // A bone this near to the middle belongs to neither side, metres.
    const MIDDLE: f32 = 0.002;
    let middle = 0.5 * (character.ibug68[36].x + character.ibug68[45].x);
    let takes = |rest: Vec3| match side {
        StillSide::Left => rest.x > middle + MIDDLE,
        StillSide::Right => rest.x < middle - MIDDLE,
        StillSide::Both => true,
    };
    Ok(character
        .bones
        .iter()
        .zip(&pose.points)
        .enumerate()
        .filter(|(_, (bone, point))| takes(bone.rest) && bone.rest != **point)
        .map(|(i, (bone, point))| (i, bone.rest.lerp(*point, amount.clamp(0.0, 1.0))))
        .collect())
}

pub(crate) fn load_character(path: Option<&Path>) -> Result<CharacterAsset> {
    let Some(path) = path else {
        return CharacterAsset::from_glb(DEFAULT_CHARACTER_GLB)
            .map_err(|source| PictureError::Character { path: "built-in character".into(), source });
    };
    let shown = path.display().to_string();
    let bytes = std::fs::read(path).map_err(|source| PictureError::Io { path: shown.clone(), source })?;
    CharacterAsset::from_glb(&bytes).map_err(|source| PictureError::Character { path: shown, source })
}

/// Lines after the hello: what the progress bar counts against.
fn count_frames(path: &Path) -> Result<u64> {
    let bytes = std::fs::read(path).map_err(|source| PictureError::Io { path: path.display().to_string(), source })?;
    Ok((bytes.iter().filter(|&&byte| byte == b'\n').count() as u64).saturating_sub(1))
}

fn progress_bar(num_frames: u64) -> ProgressBar {
    let style =
        ProgressStyle::with_template("{bar:40} {pos}/{len} frames, {per_sec}, {eta} left").unwrap_or_else(|_| ProgressStyle::default_bar());
    ProgressBar::new(num_frames).with_style(style)
}

fn parse_weights(given: &[String]) -> Result<[f32; NUM_ARKIT_SHAPES]> {
    let mut weights = [0.0; NUM_ARKIT_SHAPES];
    for text in given {
        let parsed = text.split_once('=').and_then(|(name, value)| Some((ArkitShape::from_name(name)?, parse_amount(value).ok()?)));
        let (shape, value) = parsed.ok_or_else(|| PictureError::Name {
            what: "weight",
            got: text.clone(),
            expected: format!("NAME=VALUE with 0 to 1 and a name of {}", rhytid_shared::ARKIT_NAMES.join(", ")),
        })?;
        weights[shape.index()] = value;
    }
    Ok(weights)
}

fn parse_zoom(text: &str) -> std::result::Result<f32, String> {
    let zoom = text.trim().parse().ok().filter(|zoom| (0.05..=20.0).contains(zoom));
    zoom.ok_or_else(|| format!("{text:?} is no distance, expected 0.05 to 20, where 1 frames the head"))
}

fn parse_amount(text: &str) -> std::result::Result<f32, String> {
    let amount = text.trim().parse().ok().filter(|amount| (0.0..=1.0).contains(amount));
    amount.ok_or_else(|| format!("{text:?} is no amount, expected 0 to 1"))
}

fn parse_degrees(text: &str) -> std::result::Result<f32, String> {
    text.parse().ok().filter(|value: &f32| value.is_finite()).ok_or_else(|| format!("{text:?} is no angle, expected degrees"))
}

/// Each pixel the mean of `factor` by `factor`, in linear light.
pub(crate) fn averaged(picture: &RgbaImage, factor: u32) -> RgbaImage {
    let linear: Vec<f32> = (0..256)
        .map(|code| {
            let encoded = code as f32 / 255.0;
            if encoded <= 0.04045 { encoded / 12.92 } else { ((encoded + 0.055) / 1.055).powf(2.4) }
        })
        .collect();
    let encode = |light: f32| if light <= 0.003_130_8 { light * 12.92 } else { 1.055 * light.powf(1.0 / 2.4) - 0.055 };
    RgbaImage::from_fn(picture.width() / factor, picture.height() / factor, |x, y| {
        let mut sum = [0.0; 3];
        for i in 0..factor * factor {
            let texel = picture.get_pixel(x * factor + i % factor, y * factor + i / factor);
            for channel in 0..3 {
                sum[channel] += linear[usize::from(texel[channel])];
            }
        }
        let [r, g, b] = sum.map(|sum| (encode(sum / (factor * factor) as f32) * 255.0).round() as u8);
        image::Rgba([r, g, b, 255])
    })
}

fn parse_pair(text: &str) -> std::result::Result<[f32; 2], String> {
    let expected = || format!("{text:?} is no pair, expected YAW,PITCH in degrees, -180 to 180 each");
    let (yaw, pitch) = text.split_once(',').ok_or_else(expected)?;
    let angle = |text: &str| text.trim().parse().ok().filter(|angle: &f32| angle.abs() <= 180.0);
    Ok([angle(yaw).ok_or_else(expected)?, angle(pitch).ok_or_else(expected)?])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn angles_are_read_or_refused_with_what_was_expected() {
        assert_eq!(parse_pair("-30,12.5"), Ok([-30.0, 12.5]));
        for bad in ["1", "nan,0", "1,2,3", "400,0"] {
            assert!(parse_pair(bad).is_err_and(|message| message.contains("expected YAW,PITCH")), "{bad}");
        }
    }

    #[test]
    fn distances_and_amounts_are_numbers_within_reason() {
        assert_eq!((parse_zoom("0.5"), parse_amount("1")), (Ok(0.5), Ok(1.0)));
        for bad in ["nan", "inf", "0", "-1", "near"] {
            assert!(parse_zoom(bad).is_err_and(|message| message.contains("expected 0.05 to 20")), "{bad}");
        }
        for bad in ["nan", "-0.1", "1.01", ""] {
            assert!(parse_amount(bad).is_err_and(|message| message.contains("expected 0 to 1")), "{bad}");
        }
    }

    #[test]
    fn unknown_weight_names_are_refused() {
        assert!(parse_weights(&["jawOpen=0.5".into()]).is_ok());
        for bad in ["jawOpne=0.5", "jawOpen", "jawOpen=x", "jawOpen=nan", "jawOpen=1.5"] {
            assert!(matches!(parse_weights(&[bad.into()]), Err(PictureError::Name { what: "weight", .. })), "{bad}");
        }
    }
}
