//! Golden pictures. Each comes with wrong pictures that must not pass for it: another blend, weaker wrinkles, another
//! solve, another share of the term that is shown. How near a picture must come is a share of how far the wrong ones are, so the rules hold for any character.

use crate::{Add, Stage};
use anyhow::{Context, ensure};
use glam::Vec3;
use image::{Rgb, RgbImage, RgbaImage};
use rhytid_client::render_cli::{StillSide, posed_points, solve_first, solve_one};
use rhytid_client::renderer::{SkinSettings, Studio, WrinkleSystem};
use rhytid_client::{BlendMode, Camera, DrawSettings, RenderFrame, ViewMode};
use rhytid_server::feed::{Feed, FeedItem};
use rhytid_server::pipeline::Pipeline;
use rhytid_server::solve::{OneEuroConfig, SolveConfig};
use rhytid_shared::limits::MAX_EXPRESSIONS;
use rhytid_shared::{ArkitShape, Character, FaceFrame, NUM_ARKIT_SHAPES, TrackingData, TrackingFrame};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Side of a golden, pixels: small enough to commit, large enough for furrows.
pub const SIDE: u32 = 256;
/// A channel that is off by more than this many codes counts as different: another version of the software adapter
/// rounds and places samples a little differently.
const CODES: u8 = 10;
/// How many pixels may be different: edges that fall on other samples.
const MOST_DIFFERENT: usize = (SIDE * SIDE / 400) as usize;
/// Mean difference over all channels, codes.
const MOST_MEAN: f64 = 0.5;
/// A wrong picture shows where it is off by at least this many codes in a channel …
const SHOWS: u8 = 4;
/// … and must show in this many pixels, or the golden would say nothing about it.
const LEAST_SHOWN: usize = (SIDE * SIDE / 200) as usize;
/// There, the right picture must be nearer to the golden than this share of the wrong one's distance.
const MOST_SHARE: f64 = 0.25;

/// What one golden shows.
#[derive(Clone)]
pub struct Shot {
    pub face: Face,
    /// Multiplies all influences, zone weights and expression weights.
    pub strength: f32,
    pub view: &'static str,
    pub blend: BlendMode,
    pub lens: Lens,
    pub system: WrinkleSystem,
    pub studio: Studio,
    /// Turn of the key light, degrees.
    pub key_turn: f32,
    pub skin: SkinSettings,
}

/// The face one golden shows.
#[derive(Clone, Copy)]
pub enum Face {
    Rest,
    Pose(&'static str, f32, StillSide),
    /// The frame of the built-in session with this index, solved with all that came before it.
    Session(usize, Solve),
    /// Expression weights, and an expression of the character's table that is shown in full.
    Expression(&'static str, &'static [(&'static str, f32)]),
}

/// How a session is solved.
#[derive(Clone, Copy)]
pub enum Solve {
    Default,
    /// Landmarks smoothed twice as much.
    Smoother,
}

/// Frames of the built-in session in which much moves, so that what the solve does to motion shows.
const BROWS_RISE: usize = 64;
const SMILE_BEGINS: usize = 176;
const JAW_DROPS: usize = 282;
const LIPS_PUCKER: usize = 492;

/// Where the picture is taken from; always the front.
#[derive(Clone, Copy)]
pub enum Lens {
    /// Closer than the default, so that the face fills the picture.
    Face,
    /// Brows and forehead.
    Forehead,
    /// Half as wide, above the brows.
    Furrows,
}

/// As `SkinSettings::default()`, which is no constant.
const SKIN: SkinSettings = SkinSettings { scattering: 1.0, translucency: 1.0, gloss: 1.0, roughness: 1.0, blood: 1.0 };

pub const REST: Shot = Shot {
    face: Face::Rest,
    strength: 1.0,
    view: "beauty",
    blend: BlendMode::PartialDerivatives,
    lens: Lens::Face,
    system: WrinkleSystem::Own,
    studio: Studio::Portrait,
    key_turn: 0.0,
    skin: SKIN,
};

const SURPRISE: Face = Face::Expression(
    "surprise",
    &[("browInnerUp", 0.9), ("browOuterUpLeft", 0.9), ("browOuterUpRight", 0.9), ("eyeWideLeft", 0.7), ("eyeWideRight", 0.7)],
);
const ANGER: Face = Face::Expression(
    "anger",
    &[("browDownLeft", 1.0), ("browDownRight", 1.0), ("noseSneerLeft", 0.4), ("noseSneerRight", 0.4), ("mouthPressLeft", 0.6)],
);
const GRIN: Face =
    Face::Expression("joy", &[("mouthSmileLeft", 0.8), ("mouthSmileRight", 0.8), ("cheekSquintLeft", 0.6), ("cheekSquintRight", 0.6)]);

pub const fn posed(pose: &'static str) -> Shot {
    Shot { face: Face::Pose(pose, 1.0, StillSide::Both), ..REST }
}

const fn in_session(frame: usize) -> Shot {
    Shot { face: Face::Session(frame, Solve::Default), ..REST }
}

fn weaker(shot: &Shot) -> Shot {
    Shot { strength: 0.8 * shot.strength, ..shot.clone() }
}

/// Name, golden, and the wrong pictures.
fn shots() -> Vec<(&'static str, Shot, Vec<Shot>)> {
    let viewed = |view: &'static str| Shot { view, ..posed("stretch") };
    let raised = |amount: f32, side: StillSide| Shot { face: Face::Pose("stretch", amount, side), ..REST };
    let forehead = |shot: Shot| Shot { lens: Lens::Forehead, view: "normals", ..shot };
    let mut shots = vec![
        ("neutral", REST, vec![posed("stretch")]),
        ("compress", posed("compress"), vec![REST]),
        ("smile", posed("smile"), vec![REST]),
        ("pucker", posed("pucker"), vec![REST]),
        ("stretch", posed("stretch"), vec![viewed("bare")]),
        ("stretch_half", raised(0.5, StillSide::Both), vec![posed("stretch")]),
        ("stretch_right_only", raised(1.0, StillSide::Right), vec![raised(1.0, StillSide::Left)]),
        ("stretch_view_bare", viewed("bare"), vec![posed("stretch")]),
        ("stretch_view_split", viewed("split"), vec![posed("stretch"), viewed("bare")]),
        ("stretch_view_influence", viewed("influence"), vec![viewed("influence:stretch"), weaker(&viewed("influence"))]),
        ("stretch_view_influence_stretch", viewed("influence:stretch"), vec![viewed("influence:compress")]),
        ("stretch_view_normals", viewed("normals"), vec![Shot { view: "normals", ..REST }]),
        ("stretch_view_wireframe", viewed("wireframe"), vec![Shot { view: "wireframe", ..REST }]),
    ];
    for (name, pose) in [("stretch_forehead", "stretch"), ("compress_forehead", "compress")] {
        let shot = forehead(posed(pose));
        shots.push((name, shot.clone(), vec![weaker(&shot)]));
    }
    shots.extend(terms());
    for (name, frame) in [("session_brows", BROWS_RISE), ("session_smile", SMILE_BEGINS), ("session_jaw", JAW_DROPS)] {
        let smoother = Shot { face: Face::Session(frame, Solve::Smoother), ..REST };
        shots.push((name, in_session(frame), vec![REST, smoother]));
    }
    for (name, frame) in
        [("session_brows_influence", BROWS_RISE), ("session_smile_influence", SMILE_BEGINS), ("session_pucker_influence", LIPS_PUCKER)]
    {
        let shown = |solve| Shot { face: Face::Session(frame, solve), view: "influence", ..REST };
        shots.push((name, shown(Solve::Default), vec![shown(Solve::Smoother), weaker(&shown(Solve::Default))]));
    }
    shots
}

/// Each term of the light by itself, masks and ways of shapes, the zones' wrinkles, the other set-up of lights; wrong is a
/// little less or more of what is shown.
fn terms() -> Vec<(&'static str, Shot, Vec<Shot>)> {
    let grin = Shot { face: GRIN, ..REST };
    let viewed = |view: &'static str| Shot { view, ..grin.clone() };
    let term = |name: &'static str, shot: Shot, skin: SkinSettings| (name, shot.clone(), vec![Shot { skin, ..shot }]);
    let sunset = Shot { studio: Studio::Sunset, ..REST };
    let zones = |face: Face| Shot { face, system: WrinkleSystem::Zones, lens: Lens::Forehead, ..REST };
    let by_zones = |name: &'static str, face: Face| {
        let bones = Shot { system: WrinkleSystem::Bones, ..zones(face) };
        // Furrows between the brows are few and soft: a fifth less of them would hardly show.
        let weaker = Shot { strength: 0.7, ..zones(face) };
        (name, zones(face), vec![weaker, bones])
    };
    vec![
        term("term_diffuse", viewed("diffuse"), SkinSettings { scattering: 0.0, ..SKIN }),
        term("term_specular", viewed("specular"), SkinSettings { gloss: 0.7, ..SKIN }),
        term("term_scattering", viewed("scattering"), SkinSettings { scattering: 0.6, ..SKIN }),
        term("term_translucency", Shot { view: "translucency", ..sunset.clone() }, SkinSettings { translucency: 0.6, ..SKIN }),
        term("term_blood", viewed("blood"), SkinSettings { blood: 0.6, ..SKIN }),
        ("view_masks", Shot { view: "masks", ..REST }, vec![Shot { view: "masks:red", ..REST }, Shot { view: "bone-masks", ..REST }]),
        ("view_bone_masks", Shot { view: "bone-masks", ..REST }, vec![Shot { view: "masks", ..REST }]),
        ("view_shape_deltas", viewed("shape-deltas"), vec![weaker(&viewed("shape-deltas")), Shot { view: "shape-deltas", ..REST }]),
        by_zones("zones_surprise", SURPRISE),
        by_zones("zones_anger", ANGER),
        ("sunset", sunset.clone(), vec![REST, Shot { key_turn: 12.0, ..sunset }]),
    ]
}

pub fn add(add: &mut Add<'_>) {
    for (name, shot, wrong) in shots() {
        add(format!("golden::{name}"), Box::new(move |stage| check(stage, name, &shot, &wrong)));
    }
    for (number, blend) in BlendMode::ALL.into_iter().enumerate() {
        let name = ["blend_pd", "blend_simple", "blend_printed"][number];
        let check = move |stage: &Stage| {
            let others = BlendMode::ALL.into_iter().filter(|other| *other != blend).map(|other| blended(other, 1.0));
            check(&rough(stage)?, name, &blended(blend, 1.0), &others.chain([blended(blend, 0.8)]).collect::<Vec<_>>())
        };
        add(format!("golden::{name}"), Box::new(check));
    }
}

/// Close to the furrows of a raised brow, as normals.
fn blended(blend: BlendMode, strength: f32) -> Shot {
    Shot { lens: Lens::Furrows, view: "normals", blend, strength, ..posed("stretch") }
}

/// The character with four times as steep pores: blends differ by what they make of a slope under a furrow, and the
/// character's own pores are too shallow to show it.
fn rough(stage: &Stage) -> anyhow::Result<Stage> {
    stage.variant(|asset| asset.primitives.iter_mut().for_each(|primitive| primitive.material.normal_scale *= 4.0))
}

/// Draws a shot from the front.
pub fn draw(stage: &Stage, shot: &Shot, side: u32) -> anyhow::Result<RgbaImage> {
    let character = &stage.asset.character;
    let posed = |points| -> anyhow::Result<FaceFrame> { Ok(solve_one(character, TrackingData::Bones { points, head: None })?) };
    let mut frame = RenderFrame::from(&match shot.face {
        Face::Rest => posed(Vec::new())?,
        Face::Pose(pose, amount, side) => posed(posed_points(character, pose, amount, side)?)?,
        Face::Session(index, solve) => session_frame(character, solve, index)?,
        Face::Expression(expression, weights) => expressed(character, expression, weights)?,
    });
    let shapes = frame.shapes.iter_mut().flatten();
    frame.influences.iter_mut().chain(&mut frame.zones).chain(&mut frame.stretched).chain(shapes).for_each(|value| *value *= shot.strength);
    let camera = camera(character, shot.lens);
    let settings = DrawSettings {
        view: ViewMode::parse(shot.view, character)?,
        blend: shot.blend,
        system: shot.system,
        studio: shot.studio,
        key_turn: shot.key_turn.to_radians(),
        skin: shot.skin,
        ..DrawSettings::new(camera)
    };
    let mut headless = stage.headless()?;
    Ok(headless.render([side, side], &settings, &frame)?)
}

pub fn camera(character: &Character, lens: Lens) -> Camera {
    let mut camera = Camera::front(character);
    let marks = &character.ibug68;
    let (brows, width) = ((marks[19] + marks[24]) * 0.5, marks[17].distance(marks[26]));
    // Widths of the picture and heights of its middle above the brows, in units of the brows' whole width.
    let (seen, above) = match lens {
        Lens::Face => {
            camera.zoom(0.62);
            return camera;
        }
        Lens::Forehead => (1.0, 0.18),
        Lens::Furrows => (0.5, 0.28),
    };
    camera.target = brows + Vec3::Y * above * width;
    camera.distance = 0.5 * seen * width / (0.5 * camera.fovy).tan();
    camera
}

fn expressed(character: &Arc<Character>, expression: &str, named: &[(&str, f32)]) -> anyhow::Result<FaceFrame> {
    let mut weights = Box::new([0.0; NUM_ARKIT_SHAPES]);
    for &(name, weight) in named {
        weights[ArkitShape::from_name(name).with_context(|| name.to_owned())?.index()] = weight;
    }
    let zones = character.zones.as_ref().context("the built-in character has zones")?;
    let mut amounts = [0.0; MAX_EXPRESSIONS];
    amounts[zones.expression_index(expression).with_context(|| expression.to_owned())?] = 1.0;
    let data = TrackingData::Weights { weights, head: None };
    Ok(solve_first(character, &TrackingFrame { expressions: Some(amounts), ..TrackingFrame::new(0.0, data) })?)
}

/// Replays the built-in session up to one of its frames.
fn session_frame(character: &Arc<Character>, solve: Solve, index: usize) -> anyhow::Result<FaceFrame> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/assets/demo.ibug68.jsonl");
    let mut feed = Feed::open(&path, character)?;
    let mut config = SolveConfig::default();
    if matches!(solve, Solve::Smoother) {
        for OneEuroConfig { min_cutoff, beta, .. } in [&mut config.filter.brows, &mut config.filter.mouth] {
            *min_cutoff *= 0.5;
            *beta *= 0.5;
        }
    }
    let mut pipeline = Pipeline::new(Arc::clone(character), &config, &feed.hello, 1)?;
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

fn check(stage: &Stage, name: &str, shot: &Shot, wrong: &[Shot]) -> anyhow::Result<()> {
    let golden_path = Path::new(env!("CARGO_MANIFEST_DIR")).join("goldens").join(format!("{name}.png"));
    let actual = draw(stage, shot, SIDE)?;
    if std::env::var_os("RHYTID_UPDATE_GOLDENS").is_some_and(|value| value == "1") {
        std::fs::create_dir_all(golden_path.parent().context("goldens stand in a folder")?)?;
        image::DynamicImage::ImageRgba8(actual.clone()).into_rgb8().save(&golden_path)?;
    }
    let golden = image::open(&golden_path)
        .with_context(|| format!("{} (make it with RHYTID_UPDATE_GOLDENS=1, then look at it)", golden_path.display()))?
        .into_rgba8();
    let written_out = |problem: String| match write_out(name, &actual, &golden) {
        Ok((actual, difference)) => anyhow::anyhow!("{problem}; see {} and {}", actual.display(), difference.display()),
        Err(error) => error.context(problem),
    };
    compare(&actual, &golden).map_err(written_out)?;
    for (number, wrong) in wrong.iter().enumerate() {
        let wrong = draw(stage, wrong, SIDE)?;
        let apart = Apart::new(&actual, &wrong, &golden);
        ensure!(
            apart.num_shown >= LEAST_SHOWN,
            "wrong picture {number} of {name} shows in {} pixels only, of at least {LEAST_SHOWN}: this golden says nothing about it",
            apart.num_shown
        );
        if apart.share > MOST_SHARE {
            return Err(written_out(format!(
                "{:.2} as far from the golden as wrong picture {number} is, at most {MOST_SHARE} is near enough",
                apart.share
            )));
        }
    }
    Ok(())
}

/// How a picture and a wrong one lie to the golden.
struct Apart {
    /// Pixels where the wrong one shows.
    num_shown: usize,
    /// Distance of the picture from the golden over those, in units of the wrong one's.
    share: f64,
}

impl Apart {
    fn new(actual: &RgbaImage, wrong: &RgbaImage, golden: &RgbaImage) -> Self {
        let channels = |a: &image::Rgba<u8>, b: &image::Rgba<u8>| [0, 1, 2].map(|channel: usize| a[channel].abs_diff(b[channel]));
        let sum = |apart: [u8; 3]| apart.map(u64::from).iter().sum::<u64>();
        let (mut num_shown, mut of_actual, mut of_wrong) = (0, 0, 0);
        for ((actual, wrong), golden) in actual.pixels().zip(wrong.pixels()).zip(golden.pixels()) {
            let apart = channels(wrong, golden);
            if apart.iter().any(|codes| *codes >= SHOWS) {
                num_shown += 1;
                of_wrong += sum(apart);
                of_actual += sum(channels(actual, golden));
            }
        }
        Self { num_shown, share: of_actual as f64 / (of_wrong as f64).max(1.0) }
    }
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
