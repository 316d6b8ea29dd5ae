//! The shaders' own functions against their CPU twins: for each vertex of the character, and for pseudo-random cases.

use crate::probe::{PLACE, Probe, Resource, What, run, texture};
use crate::{Add, Stage};
use anyhow::{Context, ensure};
use glam::{Vec2, Vec3, Vec4};
use rhytid_client::asset::{Morphs, Vertex};
use rhytid_client::render_cli::{StillSide, posed_points, solve_one};
use rhytid_client::renderer::{VERTEX_LAYOUT, bone_major, pose_table, uniforms};
use rhytid_client::twin::{self, WrinkleSample};
use rhytid_client::{BlendMode, CharacterAsset, RenderFrame};
use rhytid_shared::character::Pose;
use rhytid_shared::limits::MAX_POSES;
use rhytid_shared::{Character, TrackingData};
use std::sync::Arc;

/// Puts `value` of vertex `index` into pixel `index`; WHICH chooses the value.
const SKINNING_PROBE: &str = "
override WHICH: u32 = 0u;
struct Out { @builtin(position) at: vec4<f32>, @location(0) @interpolate(flat, either) value: vec4<f32> }
@vertex fn vs_probe(in: VertexIn, @builtin(vertex_index) index: u32) -> Out {
    let at = pixel_of(index);
    let deformed = deform(in);
    if WHICH == 0u { return Out(at, vec4<f32>(deformed.position, 1.0)); }
    if WHICH == 1u { return Out(at, vec4<f32>(deformed.normal, 1.0)); }
    if WHICH == 2u { return Out(at, vec4<f32>(deformed.tangent, 1.0)); }
    return Out(at, influences(in, WHICH - 3u));
}
@fragment fn fs_probe(in: Out) -> @location(0) vec4<f32> { return in.value; }
";

/// One case a vertex: base slope, two wrinkle slopes, two influences, whether they contain the base.
const BLEND_PROBE: &str = "
struct Case { @location(0) base: vec2<f32>, @location(1) slopes: vec4<f32>, @location(2) influences: vec2<f32>, @location(3) contains: vec2<f32> }
struct Out { @builtin(position) at: vec4<f32>, @location(0) @interpolate(flat, either) value: vec4<f32> }
@vertex fn vs_probe(in: Case, @builtin(vertex_index) index: u32) -> Out {
    var blend = begin_blend(in.base);
    blend = add_wrinkle(blend, in.slopes.xy, in.contains.x, in.influences.x);
    blend = add_wrinkle(blend, in.slopes.zw, in.contains.y, in.influences.y);
    return Out(pixel_of(index), vec4<f32>(end_blend(blend), 1.0));
}
@fragment fn fs_probe(in: Out) -> @location(0) vec4<f32> { return in.value; }
";

/// One place of the maps a vertex, with the frame and influences that the vertex stage would hand on.
const FRAGMENT_PROBE: &str = "
struct Case {
    @location(0) uv: vec2<f32>,
    @location(1) normal: vec3<f32>,
    @location(2) tangent: vec4<f32>,
    @location(3) influences_0_3: vec4<f32>,
    @location(4) influences_4_7: vec4<f32>,
}
struct Out {
    @builtin(position) at: vec4<f32>,
    @location(0) @interpolate(flat, either) uv: vec2<f32>,
    @location(1) @interpolate(flat, either) normal: vec3<f32>,
    @location(2) @interpolate(flat, either) tangent: vec4<f32>,
    @location(3) @interpolate(flat, either) influences_0_3: vec4<f32>,
    @location(4) @interpolate(flat, either) influences_4_7: vec4<f32>,
}
@vertex fn vs_probe(in: Case, @builtin(vertex_index) index: u32) -> Out {
    return Out(pixel_of(index), in.uv, in.normal, in.tangent, in.influences_0_3, in.influences_4_7);
}
@fragment fn fs_probe(in: Out) -> @location(0) vec4<f32> {
    var varyings: Varyings;
    varyings.uv = in.uv;
    varyings.normal = in.normal;
    varyings.tangent = in.tangent;
    varyings.influences_0_3 = in.influences_0_3;
    varyings.influences_4_7 = in.influences_4_7;
    return vec4<f32>(wrinkled_normal(varyings), 1.0);
}
";

pub fn add(add: &mut Add<'_>) {
    add("twins::skinning_and_turning_normals".into(), Box::new(skinning));
    add("twins::vertex_influences_of_one_to_all_poses".into(), Box::new(influences));
    for mode in BlendMode::ALL {
        add(format!("twins::blend_{mode}"), Box::new(move |stage| blend(stage, mode)));
        add(format!("twins::wrinkled_normal_{mode}"), Box::new(move |stage| wrinkled_normal(stage, mode)));
    }
}

/// A fixed sequence of values from `low` to `high`.
pub struct Sequence(pub u32);

impl Sequence {
    pub fn next(&mut self, low: f32, high: f32) -> f32 {
        self.0 = self.0.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        low + (high - low) * ((self.0 >> 8) as f32 / 16_777_216.0)
    }

    fn next_code(&mut self) -> u8 {
        self.next(0.0, 256.0) as u8
    }
}

/// A frame in which everything moves: brows, jaw, head.
pub fn moving_frame(stage: &Stage) -> anyhow::Result<RenderFrame> {
    let character = &stage.asset.character;
    let points = posed_points(character, &character.poses[0].name, 0.8, StillSide::Left)?;
    let mut frame = RenderFrame::from(&solve_one(character, TrackingData::Bones { points, head: None })?);
    for (i, bone) in character.bones.iter().enumerate() {
        if bone.pivot().is_some() {
            frame.rotations[i] = glam::Quat::from_rotation_x(0.3);
        }
    }
    frame.head.rotation = glam::Quat::from_rotation_y(0.4);
    frame.head.position = Vec3::new(0.02, -0.01, 0.03);
    Ok(frame)
}

pub fn all_vertices(stage: &Stage) -> Vec<Vertex> {
    stage.asset.primitives.iter().flat_map(|primitive| primitive.vertices.iter().copied()).collect()
}

/// One value a vertex; shapes deform it too where the frame carries weights.
pub fn probe_skinning(
    stage: &Stage,
    asset: &CharacterAsset,
    frame: &RenderFrame,
    vertices: &[Vertex],
    which: u32,
) -> anyhow::Result<Vec<[f32; 4]>> {
    let character = &asset.character;
    let rows: Vec<[[f32; 4]; 3]> = asset.palette.model_from_rest(character, frame).iter().map(uniforms::rows_of).collect();
    let mut palette = vec![0_u8; size_of::<uniforms::PaletteRows>()];
    palette[..size_of_val(rows.as_slice())].copy_from_slice(bytemuck::cast_slice(&rows));
    let vectors = bone_major(&frame.influences, character.num_bones(), character.num_poses());
    let mut coefficients = vec![0_u8; size_of::<uniforms::CoefficientVectors>()];
    coefficients[..size_of_val(vectors.as_slice())].copy_from_slice(bytemuck::cast_slice(&vectors));
    let table = pose_table(asset);
    let weights = uniforms::MorphWeights::new(frame.shapes.as_ref());
    let headless = stage.headless()?;
    let size = asset.morphs.texture_size();
    let mut texels: Vec<u8> = bytemuck::cast_slice(&asset.morphs.texels).to_vec();
    texels.resize((size[0] * size[1]) as usize * 8, 0);
    let deltas = texture(&headless, wgpu::TextureFormat::Rgba16Float, size, &[texels]).create_view(&wgpu::TextureViewDescriptor::default());
    let probe = Probe {
        source: &format!("{}{PLACE}{SKINNING_PROBE}", rhytid_shaders::SKINNING),
        entries: ["vs_probe", "fs_probe"],
        constants: &[("WHICH", f64::from(which)), ("NUM_POSES", character.num_poses() as f64)],
        groups: &[(
            1,
            &[
                (0, Resource::Block(&palette)),
                (1, Resource::Block(&coefficients)),
                (2, Resource::Block(bytemuck::bytes_of(&table))),
                (5, Resource::Texture { view: &deltas, dimension: wgpu::TextureViewDimension::D2, is_filterable: false }),
                (6, Resource::Block(bytemuck::bytes_of(&weights))),
            ],
        )],
        what: What::Points { layout: VERTEX_LAYOUT, bytes: bytemuck::cast_slice(vertices), count: vertices.len() },
    };
    run(&headless, &probe)
}

fn skinning(stage: &Stage) -> anyhow::Result<()> {
    let frame = moving_frame(stage)?;
    let vertices = all_vertices(stage);
    let palette = stage.asset.palette.model_from_rest(&stage.asset.character, &frame);
    let read = |which| probe_skinning(stage, &stage.asset, &frame, &vertices, which);
    let (positions, normals, tangents) = (read(0)?, read(1)?, read(2)?);
    let xyz = |value: [f32; 4]| Vec4::from(value).truncate();
    let mut num_turned = 0;
    for (v, vertex) in vertices.iter().enumerate() {
        let twin = twin::deform(vertex, &palette);
        let (position, normal, tangent) = (xyz(positions[v]), xyz(normals[v]), xyz(tangents[v]));
        ensure!(position.distance(twin.position) < 1e-6, "vertex {v} is at {position}, its twin at {}", twin.position);
        ensure!(normal.distance(twin.normal) < 2e-4, "vertex {v} has normal {normal}, its twin {}", twin.normal);
        ensure!(tangent.distance(twin.tangent) < 2e-4, "vertex {v} has tangent {tangent}, its twin {}", twin.tangent);
        // Without the gradients the twin must not match: the test sees the term that engines drop.
        let without = twin::deform(&Vertex { gradients: [[0.0; 2]; 3], ..*vertex }, &palette);
        num_turned += usize::from(without.normal.distance(normal) > 0.05);
    }
    ensure!(num_turned > 100, "only {num_turned} normals depend on the weight gradients");
    Ok(())
}

/// The character's bones with `num_poses` poses, each of which moves bones of its own choice.
fn with_poses(character: &Character, num_poses: usize, falloff: f32) -> Character {
    let mut sequence = Sequence(num_poses as u32);
    let pose = |k: usize| {
        let points = character.bones.iter().map(|bone| if sequence.next(0.0, 1.0) < 0.5 { bone.rest } else { bone.rest + Vec3::Y * 0.01 });
        Pose { name: format!("pose {k}"), points: points.collect(), map: None }
    };
    Character { poses: (0..num_poses).map(pose).collect(), falloff, ..character.clone() }
}

fn influences(stage: &Stage) -> anyhow::Result<()> {
    let vertices = all_vertices(stage);
    for (num_poses, falloff) in [(1, 1.0), (4, 0.4), (5, 1.0), (MAX_POSES, 0.4)] {
        let character = with_poses(&stage.asset.character, num_poses, falloff);
        let mut sequence = Sequence(7);
        let coefficients: Vec<f32> = (0..num_poses * character.num_bones()).map(|_| sequence.next(0.0, 1.0)).collect();
        let frame = RenderFrame { influences: coefficients.clone(), ..RenderFrame::at_rest(&character) };
        let without_falloff = Character { falloff: 1.0, ..character.clone() };
        let asset = CharacterAsset {
            character: Arc::new(character),
            primitives: Vec::new(),
            palette: stage.asset.palette.clone(),
            morphs: Morphs::default(),
            wrinkles: None,
            zones: None,
            blood: None,
        };
        let halves = (0..num_poses.div_ceil(4) as u32)
            .map(|half| probe_skinning(stage, &asset, &frame, &vertices, 3 + half))
            .collect::<anyhow::Result<Vec<_>>>()?;
        let (mut num_of_pose, mut num_widened) = (vec![0; num_poses], 0);
        for (v, vertex) in vertices.iter().enumerate() {
            let plain = twin::influences(vertex, &without_falloff, &coefficients);
            for (k, twin) in twin::influences(vertex, &asset.character, &coefficients).into_iter().enumerate() {
                let got = halves[k / 4][v][k % 4];
                ensure!((got - twin).abs() < 1e-5, "vertex {v}, pose {k} of {num_poses}: {got} on the device, {twin} in the twin");
                num_of_pose[k] += usize::from(twin > 0.1);
                num_widened += usize::from(twin - plain[k] > 0.05);
            }
        }
        ensure!(num_of_pose.iter().all(|num| *num > 1000), "poses show on {num_of_pose:?} vertices only");
        ensure!((num_widened > 1000) == (falloff < 1.0), "fall-off {falloff} widens {num_widened} influences");
    }
    Ok(())
}

#[repr(C)]
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct BlendCase {
    base: [f32; 2],
    slopes: [f32; 4],
    influences: [f32; 2],
    contains: [f32; 2],
}

fn number_of(mode: BlendMode) -> anyhow::Result<usize> {
    BlendMode::ALL.iter().position(|known| *known == mode).context("every mode is in the list")
}

fn blend(stage: &Stage, mode: BlendMode) -> anyhow::Result<()> {
    // Over the ranges that maps reach; 2,048 cases.
    let mut sequence = Sequence(1);
    let mut next = |low: f32, high: f32| sequence.next(low, high);
    let cases: Vec<BlendCase> = (0..2048)
        .map(|_| BlendCase {
            base: [next(-0.6, 0.6), next(-0.6, 0.6)],
            slopes: [next(-1.2, 1.2), next(-1.2, 1.2), next(-1.2, 1.2), next(-1.2, 1.2)],
            influences: [next(0.0, 1.0), next(0.0, 1.0)],
            contains: [next(0.0, 1.0).round(), next(0.0, 1.0).round()],
        })
        .collect();
    let layout = wgpu::VertexBufferLayout {
        array_stride: size_of::<BlendCase>() as u64,
        step_mode: wgpu::VertexStepMode::Vertex,
        attributes: &wgpu::vertex_attr_array![0 => Float32x2, 1 => Float32x4, 2 => Float32x2, 3 => Float32x2],
    };
    let number = number_of(mode)?;
    let probe = Probe {
        source: &format!("{}{PLACE}{BLEND_PROBE}", rhytid_shaders::WRINKLES),
        entries: ["vs_probe", "fs_probe"],
        constants: &[("BLEND", number as f64)],
        groups: &[],
        what: What::Points { layout, bytes: bytemuck::cast_slice(&cases), count: cases.len() },
    };
    let read = run(&*stage.headless()?, &probe)?;
    let other = BlendMode::ALL[(number + 1) % BlendMode::ALL.len()];
    let mut num_apart = 0;
    for (case, read) in cases.iter().zip(read) {
        let samples = [0, 1].map(|i: usize| WrinkleSample {
            slope: Vec2::new(case.slopes[2 * i], case.slopes[2 * i + 1]),
            contains_neutral: case.contains[i] == 1.0,
            influence: case.influences[i],
        });
        let (got, twin) = (Vec4::from(read).truncate(), twin::blend(mode, Vec2::from(case.base), &samples));
        ensure!(got.distance(twin) < 1e-5, "{got} on the device, {twin} in the twin");
        num_apart += usize::from(got.distance(twin::blend(other, Vec2::from(case.base), &samples)) > 1e-3);
    }
    ensure!(num_apart > 1000, "{mode} and {other} differ in {num_apart} cases only: the test could not tell them apart");
    Ok(())
}

#[repr(C)]
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct FragmentCase {
    uv: [f32; 2],
    normal: [f32; 3],
    tangent: [f32; 4],
    influences: [f32; MAX_POSES],
}

/// Side of the maps, texels.
const MAP_SIDE: usize = 16;
const BASE_SCALE: f32 = 0.55;
/// Poses that wrinkle what is drawn: some of either vec4, not all.
const MASK: u8 = 0b1101_0110;
/// A pose that reaches it as well but does not show in the frame.
const IDLE: u8 = 0b0000_0001;
/// A pose that shows in the frame but whose maps the code leaves out.
const LEFT_OUT: u8 = 0b0010_0000;

/// Eight maps of noise, each with a scale of its own, and the neutral one under them, read at the middles of texels.
fn wrinkled_normal(stage: &Stage, mode: BlendMode) -> anyhow::Result<()> {
    let mut sequence = Sequence(3);
    let mut map = || -> Vec<u8> { (0..MAP_SIDE * MAP_SIDE * 2).map(|_| sequence.next_code()).collect() };
    let (base_map, layers) = (map(), [(); MAX_POSES].map(|()| map()));
    let scales: [f32; MAX_POSES] = std::array::from_fn(|k| 0.3 + 0.1 * k as f32);
    let contains = [false, true, false, true, true, false, true, false];
    let cases: Vec<FragmentCase> = (0..MAP_SIDE * MAP_SIDE * 4)
        .map(|i| {
            let mut unit = || Vec3::new(sequence.next(-1.0, 1.0), sequence.next(-1.0, 1.0), sequence.next(0.2, 1.0)).normalize();
            let (normal, other) = (unit(), unit());
            let tangent = normal.cross(other).normalize_or(normal.any_orthonormal_vector());
            let (x, y) = (i % MAP_SIDE, i / MAP_SIDE % MAP_SIDE);
            FragmentCase {
                uv: [x, y].map(|at| (at as f32 + 0.5) / MAP_SIDE as f32),
                normal: normal.to_array(),
                tangent: tangent.extend(if i % 3 == 0 { -1.0 } else { 1.0 }).to_array(),
                influences: [(); MAX_POSES].map(|()| sequence.next(0.0, 0.5)),
            }
        })
        .collect();

    let mut table: uniforms::PoseTable = bytemuck::Zeroable::zeroed();
    for k in 0..MAX_POSES {
        table.scales[k / 4][k % 4] = scales[k];
        table.contains_neutral[k / 4][k % 4] = f32::from(u8::from(contains[k]));
    }
    let material = uniforms::Material { normal_scale: BASE_SCALE, ..bytemuck::Zeroable::zeroed() };
    let layout = wgpu::VertexBufferLayout {
        array_stride: size_of::<FragmentCase>() as u64,
        step_mode: wgpu::VertexStepMode::Vertex,
        attributes: &wgpu::vertex_attr_array![0 => Float32x2, 1 => Float32x3, 2 => Float32x4, 3 => Float32x4, 4 => Float32x4],
    };
    let headless = stage.headless()?;
    let view = |layers: &[Vec<u8>], dimension| {
        let side = MAP_SIDE as u32;
        texture(&headless, wgpu::TextureFormat::Rg8Unorm, [side, side], layers)
            .create_view(&wgpu::TextureViewDescriptor { dimension: Some(dimension), ..Default::default() })
    };
    use wgpu::TextureViewDimension::{D2, D2Array};
    let (base_view, layers_view) = (view(std::slice::from_ref(&base_map), D2), view(&layers, D2Array));
    let weights = uniforms::WrinkleWeights { active_poses: u32::from(!IDLE), ..bytemuck::Zeroable::zeroed() };
    let region = uniforms::Region { poses: u32::from(MASK | IDLE | LEFT_OUT), ..bytemuck::Zeroable::zeroed() };
    let probe = Probe {
        source: &format!("{}{PLACE}{FRAGMENT_PROBE}", rhytid_shaders::SURFACE),
        entries: ["vs_probe", "fs_probe"],
        constants: &[("NUM_POSES", MAX_POSES as f64), ("BLEND", number_of(mode)? as f64), ("POSES", f64::from(!LEFT_OUT))],
        groups: &[
            (
                1,
                &[
                    (2, Resource::Block(bytemuck::bytes_of(&table))),
                    (3, Resource::Texture { view: &layers_view, dimension: D2Array, is_filterable: true }),
                    (4, Resource::Sampler),
                    // Zones are left out, but the shader names what they read.
                    (7, Resource::Texture { view: &layers_view, dimension: D2Array, is_filterable: true }),
                    (8, Resource::Texture { view: &layers_view, dimension: D2Array, is_filterable: true }),
                    (9, Resource::Texture { view: &base_view, dimension: D2, is_filterable: true }),
                    (10, Resource::Block(bytemuck::bytes_of(&weights))),
                ],
            ),
            (
                2,
                &[
                    (0, Resource::Block(bytemuck::bytes_of(&material))),
                    (2, Resource::Texture { view: &base_view, dimension: D2, is_filterable: true }),
                    (4, Resource::Sampler),
                    (5, Resource::Block(bytemuck::bytes_of(&region))),
                ],
            ),
        ],
        what: What::Points { layout, bytes: bytemuck::cast_slice(&cases), count: cases.len() },
    };
    let read = run(&headless, &probe)?;

    let mut num_beyond_four = 0;
    for (i, (case, read)) in cases.iter().zip(read).enumerate() {
        let texel = i % (MAP_SIDE * MAP_SIDE) * 2;
        let codes = |map: &[u8]| [map[texel], map[texel + 1]];
        let twin_of = |poses: u8| {
            let samples: Vec<WrinkleSample> = (0..MAX_POSES)
                .filter(|k| poses >> k & 1 == 1)
                .map(|k| WrinkleSample {
                    slope: twin::slope_of(codes(&layers[k]), scales[k]),
                    contains_neutral: contains[k],
                    influence: case.influences[k],
                })
                .collect();
            let of_map = twin::blend(mode, twin::slope_of(codes(&base_map), BASE_SCALE), &samples);
            twin::world_from_tangent(Vec3::from(case.normal), Vec4::from(case.tangent), of_map)
        };
        let (got, twin) = (Vec4::from(read).truncate(), twin_of(MASK));
        ensure!(got.distance(twin) < 2e-5, "case {i}: {got} on the device, {twin} in the twin");
        num_beyond_four += usize::from(got.distance(twin_of(MASK & 0x0F)) > 1e-2 && got.distance(twin_of(u8::MAX)) > 1e-2);
    }
    ensure!(num_beyond_four * 10 > cases.len() * 9, "only {num_beyond_four} normals depend on the poses beyond the fourth and on the mask");
    Ok(())
}
