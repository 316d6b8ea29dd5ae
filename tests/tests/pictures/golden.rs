//! Golden pictures. Each comes with a wrong picture that must not pass for it.

use crate::{Add, Stage};
use anyhow::{Context, ensure};
use image::{Rgb, RgbImage, RgbaImage};
use rhytid_client::render_cli::{StillSide, posed_points, solve_one};
use rhytid_client::{BlendMode, Camera, DrawSettings, RenderFrame, ViewMode};
use rhytid_server::feed::{Feed, FeedItem};
use rhytid_server::pipeline::Pipeline;
use rhytid_server::solve::SolveConfig;
use rhytid_shared::{Character, FaceFrame, TrackingData, TrackingFrame};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Side of a golden, pixels: small enough to commit, large enough for furrows.
const SIDE: u32 = 256;
/// A channel that is off by more than this many codes counts as different: another version of the software adapter
/// rounds and places samples a little differently.
const CODES: u8 = 10;
/// How many pixels may be different: edges that fall on other samples.
const MOST_DIFFERENT: usize = (SIDE * SIDE / 400) as usize;
/// Mean difference over all channels, codes.
const MOST_MEAN: f64 = 0.5;

/// What one golden shows.
#[derive(Clone)]
pub struct Shot {
    pub face: Face,
    pub view: &'static str,
    pub blend: BlendMode,
}

/// The face one golden shows.
#[derive(Clone, Copy)]
pub enum Face {
    Rest,
    Pose(&'static str, f32, StillSide),
    /// The frame of the built-in session with this index, solved with all that came before it.
    Session(usize),
}

const REST: Shot = Shot { face: Face::Rest, view: "beauty", blend: BlendMode::PartialDerivatives };

const fn posed(pose: &'static str) -> Shot {
    Shot { face: Face::Pose(pose, 1.0, StillSide::Both), ..REST }
}

const fn in_session(frame: usize) -> Shot {
    Shot { face: Face::Session(frame), ..REST }
}

/// Name, golden, and the wrong picture.
fn shots() -> Vec<(&'static str, Shot, Shot)> {
    let stretch = || posed("stretch");
    let viewed = |view: &'static str| Shot { view, ..stretch() };
    let blended = |blend: BlendMode| Shot { blend, ..stretch() };
    let raised = |amount: f32, side: StillSide| Shot { face: Face::Pose("stretch", amount, side), ..REST };
    vec![
        ("neutral", REST, stretch()),
        ("stretch", stretch(), viewed("bare")),
        ("compress", posed("compress"), REST),
        ("smile", posed("smile"), REST),
        ("pucker", posed("pucker"), REST),
        ("stretch_half", raised(0.5, StillSide::Both), stretch()),
        ("stretch_right_only", raised(1.0, StillSide::Right), raised(1.0, StillSide::Left)),
        ("stretch_blend_simple", blended(BlendMode::Simple), viewed("bare")),
        ("stretch_blend_printed", blended(BlendMode::Printed), viewed("bare")),
        ("stretch_view_bare", viewed("bare"), stretch()),
        ("stretch_view_split", viewed("split"), stretch()),
        ("stretch_view_influence", viewed("influence"), viewed("influence:stretch")),
        ("stretch_view_influence_stretch", viewed("influence:stretch"), viewed("influence:compress")),
        ("stretch_view_normals", viewed("normals"), Shot { view: "normals", ..REST }),
        ("session_brows", in_session(110), in_session(30)),
        ("session_smile", in_session(200), in_session(110)),
        ("session_jaw", in_session(350), in_session(200)),
        ("stretch_view_wireframe", viewed("wireframe"), Shot { view: "wireframe", ..REST }),
    ]
}

pub fn add(add: &mut Add<'_>) {
    for (name, shot, wrong) in shots() {
        add(format!("golden::{name}"), Box::new(move |stage| check(stage, name, &shot, &wrong)));
    }
}

/// Draws a shot from the front, closer than the default so that the face fills the picture.
pub fn draw(stage: &Stage, shot: &Shot, side: u32) -> anyhow::Result<RgbaImage> {
    let character = &stage.asset.character;
    let posed = |points| -> anyhow::Result<FaceFrame> { Ok(solve_one(character, TrackingData::Bones { points, head: None })?) };
    let frame = RenderFrame::from(&match shot.face {
        Face::Rest => posed(Vec::new())?,
        Face::Pose(pose, amount, side) => posed(posed_points(character, pose, amount, side)?)?,
        Face::Session(index) => session_frame(character, index)?,
    });
    let mut camera = Camera::front(character);
    camera.zoom(0.62);
    let settings = DrawSettings { view: ViewMode::parse(shot.view, character)?, blend: shot.blend, ..DrawSettings::new(camera) };
    let mut headless = stage.headless.lock().map_err(|_| anyhow::anyhow!("another test broke the renderer"))?;
    Ok(headless.render([side, side], &settings, &frame)?)
}

/// Replays the built-in session up to one of its frames.
fn session_frame(character: &Arc<Character>, index: usize) -> anyhow::Result<FaceFrame> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/assets/demo.ibug68.jsonl");
    let mut feed = Feed::open(&path, character)?;
    let mut pipeline = Pipeline::new(Arc::clone(character), &SolveConfig::default(), &feed.hello, 1)?;
    let mut frame = TrackingFrame::new(0.0, TrackingData::NoFace);
    let (mut packet, mut num_frames) = (Vec::new(), 0);
    while let Some(item) = feed.next_frame(&mut frame)? {
        ensure!(item == FeedItem::Frame, "the built-in session holds frames only");
        pipeline.frame(&frame, &mut packet)?;
        if num_frames == index {
            return Ok(pipeline.face().clone());
        }
        num_frames += 1;
    }
    anyhow::bail!("the built-in session has {num_frames} frames, none with index {index}")
}

fn check(stage: &Stage, name: &str, shot: &Shot, wrong: &Shot) -> anyhow::Result<()> {
    let golden_path = Path::new(env!("CARGO_MANIFEST_DIR")).join("goldens").join(format!("{name}.png"));
    let actual = draw(stage, shot, SIDE)?;
    if std::env::var_os("RHYTID_UPDATE_GOLDENS").is_some_and(|value| value == "1") {
        std::fs::create_dir_all(golden_path.parent().context("goldens stand in a folder")?)?;
        image::DynamicImage::ImageRgba8(actual.clone()).into_rgb8().save(&golden_path)?;
    }
    let golden = image::open(&golden_path)
        .with_context(|| format!("{} (make it with RHYTID_UPDATE_GOLDENS=1, then look at it)", golden_path.display()))?
        .into_rgba8();
    if let Err(problem) = compare(&actual, &golden) {
        let (actual_path, difference_path) = write_out(name, &actual, &golden)?;
        anyhow::bail!("{problem}; see {} and {}", actual_path.display(), difference_path.display());
    }
    let wrong = draw(stage, wrong, SIDE)?;
    ensure!(compare(&wrong, &golden).is_err(), "the wrong picture passes for {name}: this golden shows nothing");
    Ok(())
}

/// Says how two pictures differ by more than the tolerance.
fn compare(actual: &RgbaImage, golden: &RgbaImage) -> Result<(), String> {
    if actual.dimensions() != golden.dimensions() {
        return Err(format!("is {:?} pixels large, the golden {:?}", actual.dimensions(), golden.dimensions()));
    }
    let off = |(a, b): (&u8, &u8)| a.abs_diff(*b);
    let pixels = || actual.pixels().zip(golden.pixels());
    let num_different = pixels().filter(|(a, b)| a.0.iter().zip(&b.0).any(|pair| off(pair) > CODES)).count();
    let sum: u64 = pixels().flat_map(|(a, b)| a.0.iter().zip(&b.0).take(3)).map(|pair| u64::from(off(pair))).sum();
    let mean = sum as f64 / (f64::from(actual.width() * actual.height()) * 3.0);
    if num_different > MOST_DIFFERENT || mean > MOST_MEAN {
        return Err(format!(
            "{num_different} pixels differ by more than {CODES} codes (at most {MOST_DIFFERENT} may), the mean difference is {mean:.3} (at most {MOST_MEAN})"
        ));
    }
    Ok(())
}

fn write_out(name: &str, actual: &RgbaImage, golden: &RgbaImage) -> anyhow::Result<(PathBuf, PathBuf)> {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("pictures");
    std::fs::create_dir_all(&folder)?;
    let (actual_path, difference_path) = (folder.join(format!("{name}.actual.png")), folder.join(format!("{name}.difference.png")));
    actual.save(&actual_path)?;
    let (width, height) = actual.dimensions();
    let difference = RgbImage::from_fn(width, height, |x, y| {
        let golden = golden.get_pixel_checked(x, y).map_or([0; 4], |pixel| pixel.0);
        let actual = actual.get_pixel(x, y).0;
        // Eight times as strong, or nobody would see it.
        Rgb([0, 1, 2].map(|channel: usize| actual[channel].abs_diff(golden[channel]).saturating_mul(8)))
    });
    difference.save(&difference_path)?;
    Ok((actual_path, difference_path))
}
