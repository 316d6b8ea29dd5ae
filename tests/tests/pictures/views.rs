//! Views of single terms on the device against what the character says: masks of zones and bones, what shapes do.

use crate::golden::{Lens, camera};
use crate::{Add, Stage};
use anyhow::{Context, ensure};
use glam::{Vec3, Vec4};
use image::RgbaImage;
use rhytid_client::asset::{Surface, Vertex};
use rhytid_client::{Camera, DrawSettings, RenderFrame, ViewMode, twin};
use rhytid_shared::character::Side;
use rhytid_shared::{ArkitShape, NUM_ARKIT_SHAPES};

const SIDE: u32 = 256;
/// As `HOTTEST` in `deltas.wgsl`, metres.
const HOTTEST: f32 = 0.012;
/// What a pixel may be off from the colour of a vertex in it: triangles are as large as pixels, and colours run over them.
const NEAR: f32 = 0.10;
/// A vertex that faces the camera by at least this cosine is hidden by nothing but lids and lips.
const FACING: f32 = 0.75;

pub fn add(add: &mut Add<'_>) {
    add("views::masks_of_zones_lie_where_the_zones_are".into(), Box::new(zone_masks));
    add("views::bone_masks_are_the_skinning_weights".into(), Box::new(bone_masks));
    add("views::shape_deltas_are_the_ways_of_the_vertices".into(), Box::new(shape_deltas));
}

fn drawn(stage: &Stage, view: &str, frame: &RenderFrame) -> anyhow::Result<RgbaImage> {
    let character = &stage.asset.character;
    let settings = DrawSettings { view: ViewMode::parse(view, character)?, ..DrawSettings::new(camera(character, Lens::Face)) };
    Ok(stage.headless()?.render([SIDE; 2], &settings, frame)?)
}

/// How much colour a pixel has: 0 for greys.
fn saturation(pixel: &image::Rgba<u8>) -> u8 {
    let [r, g, b, _] = pixel.0;
    r.max(g).max(b) - r.min(g).min(b)
}

/// Coloured pixels left and right of the picture's middle, where the eyes, the wall and teeth have none.
fn coloured(picture: &RgbaImage) -> [usize; 2] {
    let mut count = [0; 2];
    for (x, _, pixel) in picture.enumerate_pixels() {
        count[usize::from(x >= SIDE / 2)] += usize::from(saturation(pixel) > 60);
    }
    count
}

fn zone_masks(stage: &Stage) -> anyhow::Result<()> {
    let character = &stage.asset.character;
    let zones = character.zones.as_ref().context("the built-in character has zones")?;
    let rest = RenderFrame::at_rest(character);
    for zone in &zones.list {
        // The character's right is on the left of the picture.
        let [right, left] = coloured(&drawn(stage, &format!("masks:{}", zone.name), &rest)?);
        let is_there = match zone.side {
            Some(Side::Left) => left > 100 && right * 10 < left,
            Some(Side::Right) => right > 100 && left * 10 < right,
            None => left > 20 && right > 20 && left.abs_diff(right) * 2 < left + right,
        };
        ensure!(is_there, "zone {} of side {:?} shows in {right} pixels of the right and {left} of the left half", zone.name, zone.side);
    }
    let [right, left] = coloured(&drawn(stage, "masks", &rest)?);
    ensure!(right + left > 2000, "all zones show in {right} and {left} pixels only");
    let blank = stage.variant(|asset| {
        if let Some(zones) = &mut asset.zones {
            zones.masks.iter_mut().flat_map(|mask| &mut mask.levels).for_each(|level| level.fill(0));
        }
    })?;
    ensure!(coloured(&drawn(&blank, "masks", &rest)?) == [0, 0], "empty masks show");
    Ok(())
}

/// The colour of the pixel a point falls on, display values; none outside of the picture.
fn at(picture: &RgbaImage, camera: &Camera, world: Vec3) -> Option<Vec3> {
    let clip = camera.clip_from_world(1.0) * world.extend(1.0);
    let [x, y] = [clip.x / clip.w, -clip.y / clip.w].map(|side| ((side + 1.0) * 0.5 * SIDE as f32).floor());
    let is_inside = |side: f32| (0.0..SIDE as f32).contains(&side);
    (is_inside(x) && is_inside(y))
        .then(|| Vec4::from(picture.get_pixel(x as u32, y as u32).0.map(|code| f32::from(code) / 255.0)).truncate())
}

/// Share of the front's vertices whose pixel has the colour that `expected` gives them, and how many these are.
fn share_near(
    stage: &Stage,
    picture: &RgbaImage,
    placed: impl Fn(&Vertex) -> (Vec3, Vec3),
    expected: impl Fn(&Vertex, f32) -> Option<Vec3>,
) -> (f32, usize) {
    let camera = camera(&stage.asset.character, Lens::Face);
    let (mut num, mut num_near) = (0, 0);
    for vertex in
        stage.asset.primitives.iter().filter(|primitive| primitive.surface == Surface::Skin).flat_map(|primitive| &primitive.vertices)
    {
        let (position, normal) = placed(vertex);
        let facing = normal.normalize_or_zero().dot((camera.eye() - position).normalize());
        let Some(colour) = expected(vertex, facing).filter(|_| facing > FACING) else { continue };
        let Some(got) = at(picture, &camera, position) else { continue };
        num += 1;
        num_near += usize::from((got - colour).abs().max_element() < NEAR);
    }
    (num_near as f32 / num.max(1) as f32, num)
}

fn bone_masks(stage: &Stage) -> anyhow::Result<()> {
    let character = &stage.asset.character;
    let num_bones = character.num_bones();
    let picture = drawn(stage, "bone-masks", &RenderFrame::at_rest(character))?;
    let at_rest = |vertex: &Vertex| (Vec3::from(vertex.position), Vec3::from(vertex.normal));
    // `shift` counts bones on: what the picture would be if each had another's weights.
    let colour = |shift: usize| {
        move |vertex: &Vertex, facing: f32| {
            let bones = vertex.joints.iter().zip(vertex.weights).filter(|&(&joint, _)| usize::from(joint) < num_bones);
            let (sum, total) = bones.fold((Vec3::ZERO, 0.0), |(sum, total), (&joint, weight)| {
                (sum + weight * twin::hues::hue_of((usize::from(joint) + shift) % num_bones), total + weight)
            });
            (total > 0.5).then(|| twin::hues::over_grey(facing, sum / total, total))
        }
    };
    let (share, num) = share_near(stage, &picture, at_rest, colour(0));
    ensure!(num > 500 && share > 0.85, "{share:.2} of {num} vertices have the colour of their bones");
    let (share, _) = share_near(stage, &picture, at_rest, colour(1));
    ensure!(share < 0.3, "{share:.2} of the vertices have the colour of the next bones");
    Ok(())
}

fn shape_deltas(stage: &Stage) -> anyhow::Result<()> {
    let character = &stage.asset.character;
    let mut weights = [0.0; NUM_ARKIT_SHAPES];
    for (name, weight) in [("mouthSmileLeft", 0.8), ("browOuterUpRight", 1.0), ("jawOpen", 0.2)] {
        weights[ArkitShape::from_name(name).context("a shape's name")?.index()] = weight;
    }
    let frame = RenderFrame { shapes: Some(weights), ..RenderFrame::at_rest(character) };
    let picture = drawn(stage, "shape-deltas", &frame)?;
    let palette = stage.asset.palette.model_from_unposed(character, &frame);
    let morphed = |vertex: &Vertex| twin::morph(vertex, &stage.asset.morphs, &weights);
    let placed = |vertex: &Vertex| {
        let deformed = twin::deform_morphed(vertex, &morphed(vertex), &palette);
        (deformed.position, deformed.normal)
    };
    let colour = |factor: f32| {
        move |vertex: &Vertex, facing: f32| {
            let share =
                factor * twin::morph(vertex, &stage.asset.morphs, &weights).position.distance(Vec3::from(vertex.position)) / HOTTEST;
            Some(twin::hues::over_grey(facing, twin::hues::heat(share), share * 8.0))
        }
    };
    let (share, num) = share_near(stage, &picture, placed, colour(1.0));
    ensure!(num > 2000 && share > 0.75, "{share:.2} of {num} vertices have the colour of their way");
    let (wrong, _) = share_near(stage, &picture, placed, colour(2.0));
    ensure!(wrong < share - 0.1, "{wrong:.2} of the vertices have the colour of twice their way, {share:.2} that of theirs");
    let [right, left] = coloured(&drawn(stage, "shape-deltas", &RenderFrame::at_rest(character))?);
    ensure!(right + left == 0, "a frame without weights shows a way in {} pixels", right + left);
    Ok(())
}
