//! Wrinkle zones on the device against their twin, and what they cost.

use crate::golden::{Lens, camera};
use crate::probe::{PLACE, Probe, Resource, What, run, texture};
use crate::twins::Sequence;
use crate::{Add, Stage};
use anyhow::{Context, ensure};
use glam::{Vec2, Vec3, Vec4};
use image::{Rgba, RgbaImage};
use rhytid_client::asset::{MipChain, Texels, ZoneMaps};
use rhytid_client::render_cli::solve_first;
use rhytid_client::renderer::{AdapterChoice, WrinkleSystem, ZoneBlend, uniforms};
use rhytid_client::twin::{self, zones::ZoneSample};
use rhytid_client::{CharacterAsset, DrawSettings, Headless, RenderFrame, ViewMode};
use rhytid_shared::limits::MAX_EXPRESSIONS;
use rhytid_shared::{DEFAULT_CHARACTER_GLB, TrackingData, TrackingFrame};

const PROBE: &str = "
struct Case { @location(0) uv: vec2<f32> }
struct Out { @builtin(position) at: vec4<f32>, @location(0) @interpolate(flat, either) uv: vec2<f32> }
@vertex fn vs_probe(in: Case, @builtin(vertex_index) index: u32) -> Out { return Out(pixel_of(index), in.uv); }
@fragment fn fs_probe(in: Out) -> @location(0) vec4<f32> {
    var varyings: Varyings;
    varyings.uv = in.uv;
    varyings.normal = vec3<f32>(0.0, 0.0, 1.0);
    varyings.tangent = vec4<f32>(1.0, 0.0, 0.0, 1.0);
    return vec4<f32>(wrinkled_normal(varyings), 1.0);
}
";
const SIDE: usize = 16;
const BASE_SCALE: f32 = 0.5;
/// Side of a picture of the forehead, pixels.
const PICTURE: u32 = 256;

pub fn add(add: &mut Add<'_>) {
    for blend in ZoneBlend::ALL {
        add(format!("zones::blend_{blend}"), Box::new(move |stage| blended(stage, *blend)));
    }
    add("zones::anger_takes_back_the_forehead_s_wrinkles_of_surprise".into(), Box::new(opposed));
    add("zones::masks_and_map_fit_the_paper_s_96_kilobytes".into(), Box::new(bytes));
}

fn blended(stage: &Stage, blend: ZoneBlend) -> anyhow::Result<()> {
    let mut sequence = Sequence(21);
    let mut map = |channels: usize| -> Vec<u8> { (0..SIDE * SIDE * channels).map(|_| sequence.next(1.0, 256.0) as u8).collect() };
    let (base, wrinkles, stretch, difference) = (map(2), map(2), map(2), map(4));
    // Masks of a place sum to one at most.
    let masks = [map(4), map(4)].map(|mask| mask.iter().map(|code| code / 8).collect::<Vec<u8>>());
    let (scale, stretch_scale) = (0.6, 0.4);
    let wrinkled: Vec<f32> = (0..8).map(|z| 0.1 + 0.1 * z as f32).collect();
    let stretched: Vec<f32> = (0..8).map(|z| 0.9 - 0.1 * z as f32).collect();
    let packed =
        |weights: &[f32], factor: f32| -> [[f32; 4]; 2] { std::array::from_fn(|v| std::array::from_fn(|c| weights[4 * v + c] * factor)) };
    let block = uniforms::WrinkleWeights {
        wrinkled: packed(&wrinkled, if blend == ZoneBlend::Difference { 1.0 } else { scale }),
        stretched: packed(&stretched, stretch_scale),
        ..bytemuck::Zeroable::zeroed()
    };
    let cases: Vec<[f32; 2]> = (0..SIDE * SIDE).map(|i| [i % SIDE, i / SIDE].map(|at| (at as f32 + 0.5) / SIDE as f32)).collect();
    let headless = stage.headless()?;
    let view = |layers: &[Vec<u8>], format, dimension| {
        texture(&headless, format, [SIDE as u32; 2], layers)
            .create_view(&wgpu::TextureViewDescriptor { dimension: Some(dimension), ..Default::default() })
    };
    use wgpu::TextureFormat::{Rg8Unorm, Rgba8Unorm};
    use wgpu::TextureViewDimension::{D2, D2Array};
    let base_view = view(std::slice::from_ref(&base), Rg8Unorm, D2);
    let masks_view = view(&masks, Rgba8Unorm, D2Array);
    let maps_view = view(&[wrinkles.clone(), stretch.clone()], Rg8Unorm, D2Array);
    let difference_view = view(std::slice::from_ref(&difference), Rgba8Unorm, D2);
    let material = uniforms::Material { normal_scale: BASE_SCALE, ..bytemuck::Zeroable::zeroed() };
    let table: uniforms::PoseTable = bytemuck::Zeroable::zeroed();
    let region: uniforms::Region = bytemuck::Zeroable::zeroed();
    let number = ZoneBlend::ALL.iter().position(|known| *known == blend).unwrap_or_default() + 1;
    let read = |number: usize| {
        let read = |view, dimension| Resource::Texture { view, dimension, is_filterable: true };
        let probe = Probe {
            source: &format!("{}{PLACE}{PROBE}", rhytid_shaders::SURFACE),
            entries: ["vs_probe", "fs_probe"],
            constants: &[("NUM_POSES", 4.0), ("POSES", 0.0), ("ZONES", number as f64), ("ZONES_STRETCH", 1.0)],
            groups: &[
                (
                    1,
                    &[
                        (2, Resource::Block(bytemuck::bytes_of(&table))),
                        (3, read(&maps_view, D2Array)),
                        (4, Resource::Sampler),
                        (7, read(&masks_view, D2Array)),
                        (8, read(&maps_view, D2Array)),
                        (9, read(&difference_view, D2)),
                        (10, Resource::Block(bytemuck::bytes_of(&block))),
                    ],
                ),
                (
                    2,
                    &[
                        (0, Resource::Block(bytemuck::bytes_of(&material))),
                        (2, read(&base_view, D2)),
                        (4, Resource::Sampler),
                        (5, Resource::Block(bytemuck::bytes_of(&region))),
                    ],
                ),
            ],
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
        run(&headless, &probe)
    };
    let (got, other) = (read(number)?, read(number % 3 + 1)?);
    let signed = |code: u8| (f32::from(code) - 128.0) / 127.0;
    let mut num_apart = 0;
    for i in 0..cases.len() {
        let slope = |map: &[u8], scale: f32| Vec2::new(signed(map[2 * i]), signed(map[2 * i + 1])) * scale;
        let sample = ZoneSample {
            masks: std::array::from_fn(|z| f32::from(masks[z / 4][4 * i + z % 4]) / 255.0),
            wrinkled: slope(&wrinkles, scale),
            stretched: slope(&stretch, stretch_scale),
            difference: Vec3::new(signed(difference[4 * i]), signed(difference[4 * i + 1]), signed(difference[4 * i + 2])),
        };
        let base = twin::slope_of([base[2 * i], base[2 * i + 1]], BASE_SCALE).extend(1.0).normalize();
        let twin = twin::zones::blend(blend, base, &sample, &wrinkled, &stretched);
        let normal = Vec4::from(got[i]).truncate();
        ensure!(normal.distance(twin) < 3e-5, "place {i}: {normal} on the device, {twin} in the twin");
        num_apart += usize::from(Vec4::from(other[i]).truncate().distance(normal) > 5e-3);
    }
    ensure!(num_apart > SIDE * SIDE / 2, "{blend} differs from another blend at {num_apart} places only");
    Ok(())
}

/// The face at rest, wrinkled by expressions alone.
fn expressed(stage: &Stage, expressions: &[(&str, f32)]) -> anyhow::Result<RenderFrame> {
    let character = &stage.asset.character;
    let zones = character.zones.as_ref().context("the built-in character has zones")?;
    let mut amounts = [0.0; MAX_EXPRESSIONS];
    for (name, amount) in expressions {
        let row = zones.expressions.iter().position(|row| row.name == *name).context("the table has this expression")?;
        amounts[row] = *amount;
    }
    let data = TrackingData::Bones { points: Vec::new(), head: None };
    let tracked = TrackingFrame { expressions: Some(amounts), ..TrackingFrame::new(0.0, data) };
    Ok(RenderFrame::from(&solve_first(character, &tracked)?))
}

/// Figure 1.5: negative weights cancel positive ones, and the forehead smooths out.
fn opposed(stage: &Stage) -> anyhow::Result<()> {
    let character = &stage.asset.character;
    let camera = camera(character, Lens::Forehead);
    let settings = DrawSettings { view: ViewMode::Normals, system: WrinkleSystem::Zones, ..DrawSettings::new(camera) };
    let mut headless = stage.headless()?;
    let mut normals = |frame: &RenderFrame| headless.render([PICTURE; 2], &settings, frame);
    let rest = normals(&RenderFrame::at_rest(character))?;
    // Nothing but the forehead's zones, which are the first four: where they show is the forehead. Between the brows the
    // zones overlap with those of anger's own lines.
    let (mut forehead, mut below) = (RenderFrame::at_rest(character), RenderFrame::at_rest(character));
    forehead.zones[..4].fill(1.0);
    below.zones[4..].fill(1.0);
    let squared = |a: &Rgba<u8>, b: &Rgba<u8>| (0..3).map(|c| (f64::from(a[c]) - f64::from(b[c])).powi(2)).sum::<f64>();
    let (forehead, below) = (normals(&forehead)?, normals(&below)?);
    let region: Vec<bool> = (0..PICTURE * PICTURE)
        .map(|i| {
            let at = |picture: &RgbaImage| squared(picture.get_pixel(i % PICTURE, i / PICTURE), rest.get_pixel(i % PICTURE, i / PICTURE));
            at(&forehead) > 16.0 && at(&below) < 4.0
        })
        .collect();
    let num_pixels = region.iter().filter(|is_in| **is_in).count();
    ensure!(num_pixels > 2000, "the forehead's zones show in {num_pixels} pixels");
    let mut energy = |expressions: &[(&str, f32)]| -> anyhow::Result<f64> {
        let picture = normals(&expressed(stage, expressions)?)?;
        let pixels = picture.pixels().zip(rest.pixels()).zip(&region);
        Ok(pixels.filter(|(_, is_in)| **is_in).map(|((a, b), _)| squared(a, b)).sum())
    };
    let surprise = energy(&[("surprise", 1.0)])?;
    let with_anger = energy(&[("surprise", 1.0), ("anger", 1.0)])?;
    let with_little_anger = energy(&[("surprise", 1.0), ("anger", 0.25)])?;
    ensure!(with_anger <= 0.3 * surprise, "energy {with_anger:.0} of surprise and anger, {surprise:.0} of surprise alone");
    ensure!(
        with_little_anger > 0.3 * surprise,
        "energy {with_little_anger:.0} of surprise and a little anger, {surprise:.0} of surprise alone"
    );
    Ok(())
}

/// Two masks of 64² and a map of 256², as the paper has them: with blocks 96 KiB and their smallest levels, else plain.
fn bytes(stage: &Stage) -> anyhow::Result<()> {
    let mut asset = CharacterAsset::from_glb(DEFAULT_CHARACTER_GLB)?;
    let mask = || MipChain::uniform([64, 64], Texels::Linear4, &[30; 4]);
    let map = || MipChain::uniform([256, 256], Texels::Slopes, &[128; 2]);
    asset.zones = Some(ZoneMaps {
        masks: [mask(), mask()],
        map: map(),
        scale: 0.5,
        stretch: map(),
        stretch_scale: 0.0,
        difference: None,
        wavelength: 0.006,
    });
    let has_blocks = stage.headless()?.device().0.features().contains(wgpu::Features::TEXTURE_COMPRESSION_BC);
    let headless = Headless::on(&asset, AdapterChoice::Software)?;
    let expected = if has_blocks { 98_384 } else { 2 * 21_844 + 174_762 };
    ensure!(headless.zone_bytes() == expected, "zones take {} bytes, expected {expected}", headless.zone_bytes());
    Ok(())
}
