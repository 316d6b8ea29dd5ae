//! The skin's light on the device against its twins: the tone map, highlights, what shines through, what spreads.

use crate::probe::{PLACE, Probe, Resource, What, run, texture};
use crate::{Add, Stage};
use anyhow::{Context, ensure};
use glam::{Vec3, Vec4};
use rhytid_client::asset::{MipChain, Surface, Texels};
use rhytid_client::render_cli::solve_one;
use rhytid_client::renderer::{Term, scattering, uniforms};
use rhytid_client::{Camera, DrawSettings, RenderFrame, ViewMode, twin};
use rhytid_shared::character::{Drive, Side};
use rhytid_shared::{ArkitShape, NUM_ARKIT_SHAPES, TrackingData};

pub fn add(add: &mut Add<'_>) {
    add("skin::tone_map".into(), Box::new(tone_map));
    add("skin::highlights".into(), Box::new(highlights));
    add("skin::intensity_of_every_code".into(), Box::new(intensity));
    add("skin::highlights_follow_the_map_of_intensity".into(), Box::new(mapped_intensity));
    add("skin::transmittance".into(), Box::new(transmittance));
    add("skin::shadow_of_the_lid_follows_a_blink".into(), Box::new(shadow_of_the_lid));
    add("skin::scattering_spreads_light_along_the_surface_only".into(), Box::new(scattering_of_an_edge));
}

const PICTURE: wgpu::TextureViewDimension = wgpu::TextureViewDimension::D2;

/// The pass itself, on light from darkness to far beyond white.
fn tone_map(stage: &Stage) -> anyhow::Result<()> {
    const SIZE: [u32; 2] = [64, 4];
    let lights: Vec<[f32; 4]> = (0..SIZE[0] * SIZE[1])
        .map(|i| {
            // 2^-10 to 2^6, and nothing at all.
            let light = if i == 0 { 0.0 } else { f32::exp2(i as f32 / 16.0 - 10.0) };
            [light, light * 0.5, light * 0.25, 1.0]
        })
        .collect();
    let headless = stage.headless()?;
    let scene = texture(&headless, wgpu::TextureFormat::Rgba32Float, SIZE, &[bytemuck::cast_slice(&lights).to_vec()]);
    let view = scene.create_view(&wgpu::TextureViewDescriptor::default());
    for exposure in [0.5, 1.0, 2.0] {
        // 0: all light; the highlights add as much again.
        let tone = uniforms::Tone { exposure, grain: 0.0, seed: 0, shown: 0 };
        let picture = |at| (at, Resource::Texture { view: &view, dimension: PICTURE, is_filterable: false });
        let probe = Probe {
            source: rhytid_shaders::TONE,
            entries: ["vs_fullscreen", "fs_tone"],
            constants: &[],
            groups: &[(0, &[(0, Resource::Block(bytemuck::bytes_of(&tone))), picture(1), picture(2), picture(3)])],
            what: What::Picture(SIZE),
        };
        for (light, got) in lights.iter().zip(run(&headless, &probe)?) {
            for channel in 0..3 {
                let twin = srgb_from_linear(twin::filmic(2.0 * light[channel], exposure));
                ensure!(
                    (got[channel] - twin).abs() < 2e-5,
                    "light {} at exposure {exposure}: {} on the device, {twin} in the twin",
                    2.0 * light[channel],
                    got[channel]
                );
            }
        }
    }
    Ok(())
}

fn srgb_from_linear(linear: f32) -> f32 {
    if linear <= 0.003_130_8 { linear * 12.92 } else { 1.055 * linear.powf(1.0 / 2.4) - 0.055 }
}

/// A value a point: `CASE` is the expression of `in.a` and `in.b`.
pub fn function_probe(stage: &Stage, call: &str, cases: &[[[f32; 4]; 2]]) -> anyhow::Result<Vec<[f32; 4]>> {
    let source = format!(
        "{}{PLACE}
        struct Case {{ @location(0) a: vec4<f32>, @location(1) b: vec4<f32> }}
        struct Out {{ @builtin(position) at: vec4<f32>, @location(0) @interpolate(flat, either) value: vec4<f32> }}
        @vertex fn vs_probe(in: Case, @builtin(vertex_index) index: u32) -> Out {{ return Out(pixel_of(index), {call}); }}
        @fragment fn fs_probe(in: Out) -> @location(0) vec4<f32> {{ return in.value; }}",
        rhytid_shaders::SKIN
    );
    let layout = wgpu::VertexBufferLayout {
        array_stride: 32,
        step_mode: wgpu::VertexStepMode::Vertex,
        attributes: &wgpu::vertex_attr_array![0 => Float32x4, 1 => Float32x4],
    };
    let probe = Probe {
        source: &source,
        entries: ["vs_probe", "fs_probe"],
        constants: &[],
        groups: &[],
        what: What::Points { layout, bytes: bytemuck::cast_slice(cases), count: cases.len() },
    };
    run(&*stage.headless()?, &probe)
}

fn highlights(stage: &Stage) -> anyhow::Result<()> {
    let mut sequence = crate::twins::Sequence(11);
    let cases: Vec<[[f32; 4]; 2]> = (0..2048)
        .map(|_| {
            let mut unit = || Vec3::new(sequence.next(-1.0, 1.0), sequence.next(-1.0, 1.0), sequence.next(-0.2, 1.0)).normalize();
            let (view, light) = (unit(), unit());
            [view.extend(sequence.next(0.05, 0.6)).to_array(), light.extend(0.0).to_array()]
        })
        .collect();
    let call =
        "vec4<f32>(highlight(vec3<f32>(0.0, 0.0, 1.0), in.a.xyz, in.b.xyz, in.a.w, 0.028), masking(in.a.xyz, in.b.xyz, in.a.w), 0.0, 0.0)";
    let read = function_probe(stage, call, &cases)?;
    let mut num_bright = 0;
    for ([a, b], got) in cases.iter().zip(read) {
        let (view, light) = (Vec4::from(*a), Vec4::from(*b));
        let twin = twin::skin::highlight(Vec3::Z, view.truncate(), light.truncate(), view.w, 0.028);
        ensure!((got[0] - twin).abs() < 1e-4 + 2e-3 * twin, "view {view}, light {light}: {} on the device, {twin} in the twin", got[0]);
        let masking = twin::skin::masking(view.truncate(), light.truncate(), view.w);
        ensure!(
            (got[1] - masking).abs() < 1e-4,
            "view {view}, light {light}: {} of it is left on the device, {masking} in the twin",
            got[1]
        );
        num_bright += usize::from(twin > 0.05);
    }
    ensure!(num_bright > 50, "only {num_bright} cases show a highlight");
    Ok(())
}

fn intensity(stage: &Stage) -> anyhow::Result<()> {
    let cases: Vec<[[f32; 4]; 2]> = (0..512).map(|i| [[(i % 256) as f32 / 255.0, (i / 256) as f32, 0.0, 0.0], [0.0; 4]]).collect();
    let read = function_probe(stage, "vec4<f32>(intensity_of(in.a.x, in.a.y))", &cases)?;
    for (i, got) in read.iter().enumerate() {
        let twin = twin::skin::intensity((i % 256) as u8, i >= 256);
        ensure!((got[0] - twin).abs() < 1e-5, "code {i}: {} on the device, {twin} in the twin", got[0]);
    }
    Ok(())
}

/// The view of highlights under maps of one intensity each.
fn mapped_intensity(stage: &Stage) -> anyhow::Result<()> {
    let view = |stage: &Stage| -> anyhow::Result<_> {
        let character = &stage.asset.character;
        let settings = DrawSettings { view: ViewMode::Term(Term::Specular), ..DrawSettings::new(Camera::front(character)) };
        let picture = stage.headless()?.render([128, 128], &settings, &RenderFrame::at_rest(character))?;
        Ok(picture.pixels().map(|pixel| u64::from(pixel[1])).sum::<u64>())
    };
    let with = |code: u8| {
        view(&stage.variant(|asset| {
            let skin = asset.primitives.iter_mut().filter(|primitive| primitive.surface == Surface::Skin);
            for material in skin.map(|primitive| &mut primitive.material) {
                material.surface_map = Some(MipChain::uniform([4, 4], Texels::Linear4, &[255, 128, code, 255]));
                material.has_intensity = true;
            }
        })?)
    };
    let [none, half, whole, most] = [with(0)?, with(64)?, with(128)?, with(255)?];
    ensure!(none * 4 < whole && none < half && half < whole && whole < most, "highlights of {none}, {half}, {whole} and {most} codes");
    Ok(())
}

fn transmittance(stage: &Stage) -> anyhow::Result<()> {
    let cases: Vec<[[f32; 4]; 2]> = (0..256).map(|i| [[i as f32 * 0.02, 0.0, 0.0, 0.0], [0.0; 4]]).collect();
    let read = function_probe(stage, "vec4<f32>(transmittance(in.a.x), 1.0)", &cases)?;
    for ([a, _], got) in cases.iter().zip(read) {
        let twin = twin::skin::transmittance(a[0]);
        ensure!(Vec4::from(got).truncate().distance(twin) < 1e-5, "{} mm: {got:?} on the device, {twin} in the twin", a[0]);
    }
    Ok(())
}

/// The whites of both eyes, left and right, a little above their lower lids, while the left eye shuts by a share.
fn shadow_of_the_lid(stage: &Stage) -> anyhow::Result<()> {
    const SIDE: u32 = 256;
    // On the outer side of the iris and below the ball's middle, metres.
    const ASIDE: f32 = 0.008;
    const BELOW: f32 = 0.003;
    let character = &stage.asset.character;
    let whites = |blink: f32| -> anyhow::Result<[f32; 2]> {
        let mut weights = Box::new([0.0; NUM_ARKIT_SHAPES]);
        weights[ArkitShape::from_name("eyeBlinkLeft").context("a shape")?.index()] = blink;
        let frame = RenderFrame::from(&solve_one(character, TrackingData::Weights { weights, head: None })?);
        let mut found = [0.0; 2];
        for (found, (side, outwards)) in found.iter_mut().zip([(Side::Left, 1.0), (Side::Right, -1.0)]) {
            let eye = character.bones.iter().find_map(|bone| match bone.drive {
                Drive::Eye { eye, pivot, .. } if eye == side => Some((pivot, bone.rest.distance(pivot))),
                _ => None,
            });
            let (centre, radius) = eye.context("the built-in character has eyes")?;
            let ahead = (radius * radius - ASIDE * ASIDE - BELOW * BELOW).sqrt();
            let at = centre + Vec3::new(ASIDE * outwards, -BELOW, ahead);
            let camera = Camera { target: at, yaw: 0.0, pitch: 0.0, distance: 0.4, ..Camera::front(character) };
            let settings = DrawSettings { view: ViewMode::Term(Term::Diffuse), ..DrawSettings::new(camera) };
            let picture = stage.headless()?.render([SIDE; 2], &settings, &frame)?;
            let middle = picture.get_pixel(SIDE / 2, SIDE / 2).0;
            *found = f32::from(middle[1]);
        }
        Ok(found)
    };
    let [open, half] = [whites(0.0)?, whites(0.4)?];
    ensure!(open[0] > 60.0, "no white at {open:?}");
    ensure!(half[0] < 0.9 * open[0], "the lid comes down and the white below it stays at {} codes of {}", half[0], open[0]);
    ensure!((half[1] - open[1]).abs() <= 1.0, "the other eye changes from {} to {}", open[1], half[1]);
    Ok(())
}

/// A lit half beside a dark half on one surface, and beyond a step in depth another lit half.
fn scattering_of_an_edge(stage: &Stage) -> anyhow::Result<()> {
    const SIZE: [u32; 2] = [96, 3];
    const EDGE: usize = 32;
    const STEP: usize = 64;
    let row: Vec<(Vec3, f32)> = (0..SIZE[0] as usize)
        .map(|x| (if (EDGE..STEP).contains(&x) { Vec3::splat(0.05) } else { Vec3::new(1.0, 0.8, 0.6) }, if x < STEP { 0.0 } else { 0.05 }))
        .collect();
    let kernel = scattering::kernel(25);
    let pixels_per_mm_at_metre = 2.5;
    let mut block: uniforms::Scatter = bytemuck::Zeroable::zeroed();
    for (to, from) in block.kernel.iter_mut().zip(&kernel) {
        *to = from.weight.extend(from.offset_mm).to_array();
    }
    block.uv_per_mm_at_metre = [pixels_per_mm_at_metre / SIZE[0] as f32, 0.0];
    (block.depth_origin, block.rejection, block.num_samples) = (0.6, 163.0, 25);
    let texels: Vec<[f32; 4]> = (0..SIZE[1]).flat_map(|_| row.iter().map(|(light, depth)| light.extend(*depth).to_array())).collect();
    // The last pixels do not scatter.
    let strength: Vec<f32> = (0..row.len()).map(|x| if x < 90 { 1.0 } else { 0.0 }).collect();
    let masks: Vec<[f32; 4]> = (0..SIZE[1]).flat_map(|_| strength.iter().map(|strength| [0.0, 0.0, 0.0, 1.0 + strength])).collect();
    let headless = stage.headless()?;
    let [diffuse, specular] = [&texels, &masks].map(|texels| {
        // Half floats hold these values to a part in two thousand.
        let halves: Vec<u8> = texels.iter().flatten().flat_map(|value| half::f16::from_f32(*value).to_le_bytes()).collect();
        texture(&headless, wgpu::TextureFormat::Rgba16Float, SIZE, &[halves]).create_view(&wgpu::TextureViewDescriptor::default())
    });
    let probe = Probe {
        source: rhytid_shaders::SCATTER,
        entries: ["vs_fullscreen", "fs_scatter"],
        constants: &[],
        groups: &[(
            0,
            &[
                (0, Resource::Block(bytemuck::bytes_of(&block))),
                (1, Resource::Texture { view: &diffuse, dimension: PICTURE, is_filterable: true }),
                (2, Resource::Texture { view: &specular, dimension: PICTURE, is_filterable: true }),
                (3, Resource::Sampler),
            ],
        )],
        what: What::Picture(SIZE),
    };
    let read = run(&headless, &probe)?;
    let twin = twin::skin::scatter_row(&kernel, &row, &strength, pixels_per_mm_at_metre, 0.6, 163.0);
    // The probe's sampler repeats where the renderer's holds: the ends are left out.
    for x in 12..row.len() - 12 {
        let got = Vec4::from(read[SIZE[0] as usize + x]).truncate();
        ensure!(got.distance(twin[x]) < 3e-3, "pixel {x}: {got} on the device, {} in the twin", twin[x]);
    }
    let (beside, behind) = (twin[EDGE + 2], twin[STEP - 3]);
    ensure!(beside.x > 0.10 && beside.x - 0.05 > 1.5 * (beside.z - 0.05), "red does not spread over the edge: {beside}");
    ensure!((behind - Vec3::splat(0.05)).abs().max_element() < 1e-3, "light leaks over a step in depth: {behind}");
    Ok(())
}
