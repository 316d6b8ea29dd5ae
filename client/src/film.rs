//! `film`: watches a room as any viewer does, without a window, and records what a window would have shown.
//!
//! Pictures are drawn as fast as the adapter can, at most `--fps` a second, each at the moment it shows: a slow adapter
//! gives fewer pictures, never a slow film. The animation is a GIF: it opens everywhere, and the one palette is taken
//! from the character itself before the film begins. The contact sheet keeps all colours.

mod animation;
mod sheet;

use crate::asset::{AssetError, CharacterAsset};
use crate::picture_size::parse_size;
use crate::renderer::{Camera, DrawSettings, Headless, RenderError, RenderFrame, ViewMode};
use crate::spectator::{Spectator, Status, StatusKind, WatchArgs};
use crate::video::{Video, VideoError};
pub(crate) use animation::{Animation, Palette};
use glam::Quat;
use image::RgbaImage;
use rhytid_shared::character::Drive;
use rhytid_shared::{Character, DEFAULT_CHARACTER_GLB};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// What to film.
#[derive(Debug, Clone, clap::Args)]
pub struct FilmArgs {
    /// Whom to watch.
    #[command(flatten)]
    pub watch: WatchArgs,
    /// Folder for face.gif and contact-sheet.png; made if it is not there
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Longest film, seconds; it ends sooner when the sender goes away
    #[arg(long, default_value_t = 20.0, value_parser = parse_seconds)]
    pub seconds: f64,
    /// Size of the animation, pixels
    #[arg(long, default_value = "384x384", value_parser = parse_size)]
    pub size: [u32; 2],
    /// Most pictures a second
    #[arg(long, default_value_t = 12, value_parser = clap::value_parser!(u32).range(1..=50))]
    pub fps: u32,
    /// Write face.mp4 as well, through ffmpeg
    #[arg(long)]
    pub mp4: bool,
}

/// What was filmed.
#[derive(Debug, Clone, PartialEq)]
pub struct Film {
    /// The GIF.
    pub animation: PathBuf,
    /// The PNG.
    pub contact_sheet: PathBuf,
    /// Pictures in the animation.
    pub num_pictures: usize,
    /// From the first picture to the last.
    pub length: Duration,
}

/// Why there is no film.
#[derive(Debug, thiserror::Error)]
pub enum FilmError {
    /// No adapter, no device, or a picture that does not come back.
    #[error(transparent)]
    Render(#[from] RenderError),
    /// The character cannot be drawn.
    #[error(transparent)]
    Asset(#[from] AssetError),
    /// A file cannot be written.
    #[error("{path}: {problem}")]
    Write {
        /// The file.
        path: PathBuf,
        /// What the system or the encoder said.
        problem: String,
    },
    /// The video cannot be written.
    #[error(transparent)]
    Video(#[from] VideoError),
    /// No live face came.
    #[error("nothing to film, no live face came: {status}")]
    NeverLive {
        /// How things stood at the end.
        status: String,
    },
}

/// How long a film waits for its first live face.
const PATIENCE: Duration = Duration::from_secs(30);
/// How long the sender may be away before the film is over: longer than the easing to neutral, which belongs to the film.
const GONE_AFTER: Duration = Duration::from_millis(800);
/// Nearer than the usual front view: small pictures shall show wrinkles. Tuned by eye.
const CLOSE_UP: f32 = 0.74;
/// Size of the pictures the palette is taken from, pixels; more only takes longer.
pub(crate) const PALETTE_SIZE: [u32; 2] = [128, 128];
/// How often a waiting film looks.
const LOOK_EVERY: Duration = Duration::from_millis(10);

/// A moment of the film, kept for the contact sheet.
#[derive(Debug, Clone)]
struct Moment {
    /// Since the film began.
    at: Duration,
    frame: RenderFrame,
}

/// Films until `--seconds` are over, the sender is gone, or `is_stopped` is set.
pub fn run(args: &FilmArgs, is_stopped: &AtomicBool) -> Result<Film, FilmError> {
    std::fs::create_dir_all(&args.out).map_err(|error| write_error(&args.out, &error))?;
    let asset = CharacterAsset::from_glb(DEFAULT_CHARACTER_GLB)?;
    let mut crew = Crew { headless: Headless::new(&asset)?, character: Arc::clone(&asset.character) };
    drop(asset);
    tracing::info!(adapter = crew.headless.adapter().name, "filming");
    let mut palette = crew.palette()?;
    let mut spectator = Spectator::open(args.watch.clone(), Arc::clone(&crew.character), || ());

    let waiting_since = Instant::now();
    loop {
        let has_changed = crew.update(&mut spectator)?;
        if has_changed {
            palette = crew.palette()?;
        }
        let now = Instant::now();
        spectator.sample(now);
        let status = spectator.status(now);
        match status.kind {
            StatusKind::Live => break,
            StatusKind::Refused | StatusKind::Unusable => return Err(never_live(&status)),
            _ if now - waiting_since > PATIENCE || is_stopped.load(Ordering::SeqCst) => return Err(never_live(&status)),
            _ => std::thread::sleep(LOOK_EVERY),
        }
    }

    let path = args.out.join("face.gif");
    let mut animation = Animation::create(&path, args.size, palette).map_err(|error| write_error(&path, &error))?;
    let mut video = match args.mp4 {
        true => Some(Video::create(&args.out.join("face.mp4"), args.size, f64::from(args.fps))?),
        false => None,
    };
    let mut moments: Vec<Moment> = Vec::new();
    let beginning = Instant::now();
    let interval = Duration::from_secs(1) / args.fps;
    let (mut next_at, mut live_at) = (beginning, beginning);
    loop {
        crew.update(&mut spectator)?;
        let now = Instant::now();
        let frame = spectator.sample(now).clone();
        if matches!(spectator.status(now).kind, StatusKind::Live | StatusKind::FaceLost | StatusKind::Silent) {
            live_at = now;
        }
        let is_over = (now - beginning).as_secs_f64() >= args.seconds || now - live_at > GONE_AFTER || is_stopped.load(Ordering::SeqCst);
        if is_over {
            break;
        }
        let picture = crew.draw(&frame, ViewMode::Beauty, args.size)?;
        if let Some(video) = &mut video {
            video.add(&picture, now - beginning)?;
        }
        animation.add(picture, now - beginning).map_err(|error| write_error(&path, &error))?;
        moments.push(Moment { at: now - beginning, frame });
        // Missed beats are left out, not caught up with.
        next_at = (next_at + interval).max(Instant::now());
        while Instant::now() < next_at && !is_stopped.load(Ordering::SeqCst) {
            std::thread::sleep(LOOK_EVERY.min(next_at.saturating_duration_since(Instant::now())));
        }
    }
    let length = moments.last().map_or(Duration::ZERO, |moment| moment.at);
    if let Some(video) = video {
        video.finish(beginning.elapsed())?;
    }
    animation.finish(beginning.elapsed()).map_err(|error| write_error(&path, &error))?;

    let contact_sheet = args.out.join("contact-sheet.png");
    let title = format!("Room {}, {:.1} s, {} pictures", args.watch.room, length.as_secs_f64(), moments.len());
    let sheet = sheet::contact_sheet(&mut crew, &moments, &title)?;
    sheet.save(&contact_sheet).map_err(|error| write_error(&contact_sheet, &error))?;
    Ok(Film { animation: path, contact_sheet, num_pictures: moments.len(), length })
}

/// Who draws.
struct Crew {
    headless: Headless,
    character: Arc<Character>,
}

impl Crew {
    /// Takes what the link brought; true where the character is another one now.
    fn update(&mut self, spectator: &mut Spectator) -> Result<bool, FilmError> {
        let mut replaced: Option<Result<(), RenderError>> = None;
        spectator.update(|glb| {
            let asset = CharacterAsset::from_glb(&glb).map_err(|error| error.to_string())?;
            let character = Arc::clone(&asset.character);
            replaced = Some(Headless::new(&asset).map(|headless| (self.headless, self.character) = (headless, Arc::clone(&character))));
            Ok(character)
        });
        Ok(replaced.transpose()?.is_some())
    }

    fn draw(&mut self, frame: &RenderFrame, view: ViewMode, size: [u32; 2]) -> Result<RgbaImage, RenderError> {
        let mut settings = DrawSettings::new(Camera::front(&self.character));
        settings.camera.zoom(CLOSE_UP);
        settings.view = view;
        self.headless.render(size, &settings, frame)
    }

    /// The colours of this character: at rest, in each reference pose, and with its mouth open and its head turned.
    fn palette(&mut self) -> Result<Palette, RenderError> {
        let frames = colorful_frames(&self.character);
        let pictures = frames.iter().map(|frame| self.draw(frame, ViewMode::Beauty, PALETTE_SIZE)).collect::<Result<Vec<_>, _>>()?;
        Ok(Palette::of(&pictures))
    }
}

/// Faces that show the character's colours.
pub(crate) fn colorful_frames(character: &Character) -> Vec<RenderFrame> {
    let rest = RenderFrame::at_rest(character);
    let num_bones = character.num_bones();
    let mut frames = vec![rest.clone()];
    for (k, pose) in character.poses.iter().enumerate() {
        let mut frame = rest.clone();
        frame.points.clone_from(&pose.points);
        frame.influences[k * num_bones..(k + 1) * num_bones].fill(1.0);
        frames.push(frame);
    }
    let mut frame = rest;
    for (i, bone) in character.bones.iter().enumerate() {
        let turns_with = bone.turns_with.map(|of| &character.bones[of].drive);
        if let Drive::Jaw { max_angle, .. } = turns_with.unwrap_or(&bone.drive) {
            frame.rotations[i] = Quat::from_rotation_x(0.7 * max_angle);
        }
    }
    frame.head.rotation = Quat::from_rotation_y(0.3);
    frames.push(frame);
    frames
}

fn never_live(status: &Status) -> FilmError {
    FilmError::NeverLive { status: format!("{}: {}", status.headline, status.detail) }
}

fn write_error(path: &Path, problem: &dyn std::fmt::Display) -> FilmError {
    FilmError::Write { path: path.to_owned(), problem: problem.to_string() }
}

fn parse_seconds(text: &str) -> Result<f64, String> {
    // An hour of moments for the contact sheet takes about 100 MB.
    text.parse()
        .ok()
        .filter(|seconds| (0.1..=3600.0).contains(seconds))
        .ok_or_else(|| format!("{text:?} is no length, expected 0.1 to 3600 seconds"))
}
