//! Colour that follows the face: on the device against its twin, and where faces flush and pale.

use crate::golden::{Lens, SIDE, camera};
use crate::probe::{PLACE, Probe, Resource, What, run, texture};
use crate::skin::function_probe;
use crate::{Add, Stage};
use anyhow::{Context, ensure};
use glam::{Vec3, Vec4};
use image::RgbaImage;
use rhytid_client::render_cli::{StillSide, posed_points, solve_one};
use rhytid_client::renderer::{SkinSettings, Term, uniforms};
use rhytid_client::{DrawSettings, RenderFrame, ViewMode, twin};
use rhytid_shared::character::ColourDriver;
use rhytid_shared::{Character, TrackingData};
use std::sync::Arc;

pub fn add(add: &mut Add<'_>) {
    add("blood::albedo_with_more_blood".into(), Box::new(albedo));
    add("blood::codes_of_the_map".into(), Box::new(codes));
    add("blood::smile_reddens_the_cheeks".into(), Box::new(smile));
    add("blood::frown_reddens_the_glabella".into(), Box::new(frown));
    add("blood::raised_brows_pale_the_forehead".into(), Box::new(raised_brows));
    add("blood::half_a_smile_reddens_one_cheek".into(), Box::new(half_a_smile));
    add("blood::zones_drive_it_where_there_are_no_poses".into(), Box::new(zones_alone));
    add("blood::switched_off_is_a_face_without_it".into(), Box::new(switched_off));
}

fn albedo(stage: &Stage) -> anyhow::Result<()> {
    let mut sequence = crate::twins::Sequence(31);
    let worked = [[0.55, 0.35, 0.27, 0.3], [0.0; 4]];
    let cases: Vec<[[f32; 4]; 2]> = std::iter::once(worked)
        .chain((0..512).map(|_| {
            let mut channel = || sequence.next(0.0, 1.0);
            let albedo = [channel(), channel(), channel()];
            [[albedo[0], albedo[1], albedo[2], sequence.next(-0.5, 0.5)], [0.0; 4]]
        }))
        .collect();
    let read = function_probe(stage, "vec4<f32>(with_blood(in.a.xyz, in.a.w), 1.0)", &cases)?;
    for ([a, _], got) in cases.iter().zip(&read) {
        let twin = twin::blood::with_blood(Vec4::from(*a).truncate(), a[3]);
        ensure!(Vec4::from(*got).truncate().distance(twin) < 1e-5, "{a:?}: {got:?} on the device, {twin} in the twin");
    }
    ensure!(Vec4::from(read[0]).truncate().distance(Vec3::new(0.50284314, 0.28508665, 0.22112142)) < 1e-5, "{:?}", read[0]);
    Ok(())
}

/// Every code as the shader reads it.
fn codes(stage: &Stage) -> anyhow::Result<()> {
    const SIZE: u32 = 16;
    let source = format!(
        "{}{PLACE}
        struct Case {{ @location(0) uv: vec2<f32> }}
        struct Out {{ @builtin(position) at: vec4<f32>, @location(0) @interpolate(flat, either) uv: vec2<f32> }}
        @vertex fn vs_probe(in: Case, @builtin(vertex_index) index: u32) -> Out {{ return Out(pixel_of(index), in.uv); }}
        @fragment fn fs_probe(in: Out) -> @location(0) vec4<f32> {{ return vec4<f32>(blood_change(in.uv)); }}",
        rhytid_shaders::SKIN
    );
    let cases: Vec<[f32; 2]> = (0..SIZE * SIZE).map(|i| [i % SIZE, i / SIZE].map(|at| (at as f32 + 0.5) / SIZE as f32)).collect();
    let headless = stage.headless()?;
    let map = texture(&headless, wgpu::TextureFormat::R8Unorm, [SIZE; 2], &[(0..=255).collect()]);
    let view = map.create_view(&wgpu::TextureViewDescriptor::default());
    let range = 0.4;
    let frame = uniforms::Frame { blood: [range, 0.0, 0.0, 0.0], ..bytemuck::Zeroable::zeroed() };
    let picture = Resource::Texture { view: &view, dimension: wgpu::TextureViewDimension::D2, is_filterable: true };
    let probe = Probe {
        source: &source,
        entries: ["vs_probe", "fs_probe"],
        constants: &[],
        groups: &[(0, &[(0, Resource::Block(bytemuck::bytes_of(&frame)))]), (1, &[(4, Resource::Sampler), (11, picture)])],
        what: What::Points {
            layout: wgpu::VertexBufferLayout {
                array_stride: 8,
                step_mode: wgpu::VertexStepMode::Vertex,
                attributes: &wgpu::vertex_attr_array![0 => Float32x2],
            },
            bytes: bytemuck::cast_slice(&cases),
            count: cases.len(),
        },
    };
    for (code, got) in run(&headless, &probe)?.into_iter().enumerate() {
        let twin = (code as f32 - 128.0) / 127.0 * range;
        ensure!((got[0] - twin).abs() < 1e-5, "code {code}: {} on the device, {twin} in the twin", got[0]);
    }
    Ok(())
}

fn posed(character: &Character, pose: &str, side: StillSide) -> anyhow::Result<RenderFrame> {
    let points = posed_points(character, pose, 1.0, side)?;
    Ok(RenderFrame::from(&solve_one(&Arc::new(character.clone()), TrackingData::Bones { points, head: None })?))
}

fn render(stage: &Stage, frame: &RenderFrame, view: ViewMode, blood: f32) -> anyhow::Result<RgbaImage> {
    let skin = SkinSettings { blood, ..SkinSettings::default() };
    let settings = DrawSettings { view, skin, ..DrawSettings::new(camera(&stage.asset.character, Lens::Face)) };
    Ok(stage.headless()?.render([SIDE, SIDE], &settings, frame)?)
}

/// Mean of red less green about a place on the neutral face, metres, codes; the picture is taken from the front.
fn redness(picture: &RgbaImage, character: &Character, place: Vec3) -> f64 {
    const REACH: i64 = 5;
    let clip = camera(character, Lens::Face).clip_from_world(1.0) * place.extend(1.0);
    let at = [clip.x / clip.w, -clip.y / clip.w].map(|v| ((0.5 * v + 0.5) * SIDE as f32) as i64);
    let mut sum = 0.0;
    for (dx, dy) in (-REACH..=REACH).flat_map(|dx| (-REACH..=REACH).map(move |dy| (dx, dy))) {
        let pixel = picture.get_pixel((at[0] + dx) as u32, (at[1] + dy) as u32);
        sum += f64::from(pixel[0]) - f64::from(pixel[1]);
    }
    sum / ((2 * REACH + 1) * (2 * REACH + 1)) as f64
}

/// How much redder a pose's blood makes a place: the same face with it and without.
fn reddening(stage: &Stage, pose: &str, side: StillSide, places: &[Vec3]) -> anyhow::Result<Vec<f64>> {
    let character = &stage.asset.character;
    stage.asset.blood.as_ref().context("the built-in character has no blood: bake it anew")?;
    let frame = posed(character, pose, side)?;
    let [with, without] = [1.0, 0.0].map(|blood| render(stage, &frame, ViewMode::Beauty, blood));
    let (with, without) = (with?, without?);
    Ok(places.iter().map(|&place| redness(&with, character, place) - redness(&without, character, place)).collect())
}

fn cheek(character: &Character, landmark: usize, sign: f32) -> Vec3 {
    character.ibug68[landmark] + Vec3::new(0.006 * sign, -0.018, 0.0)
}

fn smile(stage: &Stage) -> anyhow::Result<()> {
    let character = &stage.asset.character;
    let places = [cheek(character, 46, 1.0), cheek(character, 41, -1.0), character.ibug68[27] + Vec3::Y * 0.035];
    let [left, right, forehead] = reddening(stage, "smile", StillSide::Both, &places)?[..] else { unreachable!("three places") };
    ensure!(left > 4.0 && right > 4.0, "the cheeks redden by {left:.1} and {right:.1} codes");
    ensure!(forehead.abs() < 1.0, "the forehead changes by {forehead:.1} codes");
    Ok(())
}

fn frown(stage: &Stage) -> anyhow::Result<()> {
    let marks = &stage.asset.character.ibug68;
    let reddens = reddening(stage, "compress", StillSide::Both, &[marks[27] + Vec3::Y * 0.006])?[0];
    ensure!(reddens > 2.5, "the glabella reddens by {reddens:.1} codes");
    Ok(())
}

fn raised_brows(stage: &Stage) -> anyhow::Result<()> {
    let marks = &stage.asset.character.ibug68;
    let reddens = reddening(stage, "stretch", StillSide::Both, &[marks[27] + Vec3::Y * 0.045])?[0];
    ensure!(reddens < -2.5, "the forehead reddens by {reddens:.1} codes");
    Ok(())
}

fn half_a_smile(stage: &Stage) -> anyhow::Result<()> {
    let character = &stage.asset.character;
    let places = [cheek(character, 46, 1.0), cheek(character, 41, -1.0)];
    let [left, right] = reddening(stage, "smile", StillSide::Left, &places)?[..] else { unreachable!("two places") };
    ensure!(left > 4.0 && right.abs() < 0.25 * left, "the left cheek reddens by {left:.1} codes, the right by {right:.1}");
    Ok(())
}

/// The character without its poses, the frown's blood driven by the zone between the brows.
fn zones_alone(stage: &Stage) -> anyhow::Result<()> {
    let character = &stage.asset.character;
    let frown = character.poses.iter().position(|pose| pose.name == "compress").context("a pose of frowning")?;
    let zones = character.zones.as_ref().context("the built-in character has zones")?;
    let glabella = zones.list.iter().position(|zone| zone.side.is_none()).context("a zone between the brows")?;
    let without_poses = stage.variant(|asset| {
        Arc::make_mut(&mut asset.character).poses.clear();
        asset.wrinkles = None;
        if let Some(blood) = &mut asset.blood {
            blood.changes.retain(|change| change.driver == ColourDriver::Pose(frown));
            blood.changes.iter_mut().for_each(|change| change.driver = ColourDriver::Zone(glabella));
        }
    })?;
    let place = character.ibug68[27] + Vec3::Y * 0.006;
    let reddens = |weight: f32| -> anyhow::Result<f64> {
        let mut frame = RenderFrame::at_rest(&without_poses.asset.character);
        frame.zones[glabella] = weight;
        let [with, without] = [1.0, 0.0].map(|blood| render(&without_poses, &frame, ViewMode::Beauty, blood));
        Ok(redness(&with?, character, place) - redness(&without?, character, place))
    };
    let [rest, half, whole] = [reddens(0.0)?, reddens(0.5)?, reddens(1.0)?];
    ensure!(
        rest.abs() < 0.2 && half > 1.0 && whole > half + 0.8,
        "between the brows the skin reddens by {rest:.1}, {half:.1} and {whole:.1} codes"
    );
    Ok(())
}

fn switched_off(stage: &Stage) -> anyhow::Result<()> {
    let without = stage.variant(|asset| asset.blood = None)?;
    let frame = posed(&stage.asset.character, "smile", StillSide::Both)?;
    let off = render(stage, &frame, ViewMode::Beauty, 0.0)?;
    ensure!(off == render(&without, &frame, ViewMode::Beauty, 1.0)?, "switched off it still changes the picture");
    ensure!(off != render(stage, &frame, ViewMode::Beauty, 1.0)?, "switched on it changes nothing");
    // At rest the view of it is grey.
    let rest = render(stage, &RenderFrame::at_rest(&stage.asset.character), ViewMode::Term(Term::Blood), 1.0)?;
    let most = rest.pixels().map(|pixel| pixel[0].abs_diff(pixel[1]).max(pixel[1].abs_diff(pixel[2]))).max();
    ensure!(most.is_some_and(|most| most <= 12), "at rest blood differs by {most:?} codes");
    Ok(())
}
