//! Runs the shaders' own functions for each vertex or case, one pixel each, and compares with the CPU twins.

use crate::{Add, Stage};
use anyhow::{Context, ensure};
use glam::{Vec2, Vec3};
use rhytid_client::asset::Vertex;
use rhytid_client::render_cli::{StillSide, posed_points, solve_one};
use rhytid_client::renderer::{VERTEX_LAYOUT, bone_major, pose_table, uniforms};
use rhytid_client::twin::{self, WrinkleSample};
use rhytid_client::{BlendMode, Headless, RenderFrame};
use rhytid_shared::TrackingData;
use wgpu::util::DeviceExt;

/// Pixels a row.
const WIDTH: u32 = 256;

/// Puts `value` of vertex `index` into pixel `index`; WHICH chooses the value.
const SKINNING_PROBE: &str = "
override WHICH: u32 = 0u;
override ROWS: f32 = 1.0;
struct Out { @builtin(position) at: vec4<f32>, @location(0) @interpolate(flat, either) value: vec4<f32> }
@vertex fn vs_probe(in: VertexIn, @builtin(vertex_index) index: u32) -> Out {
    let pixel = vec2<f32>(f32(index % 256u), f32(index / 256u)) + 0.5;
    let at = vec4<f32>(pixel / vec2<f32>(128.0, -0.5 * ROWS) + vec2<f32>(-1.0, 1.0), 0.0, 1.0);
    let deformed = deform(in);
    if WHICH == 0u { return Out(at, vec4<f32>(deformed.position, 1.0)); }
    if WHICH == 1u { return Out(at, vec4<f32>(deformed.normal, 1.0)); }
    if WHICH == 2u { return Out(at, vec4<f32>(deformed.tangent, 1.0)); }
    return Out(at, influences(in, 0u));
}
@fragment fn fs_probe(in: Out) -> @location(0) vec4<f32> { return in.value; }
";

/// One case a vertex: base slope, two wrinkle slopes, two influences, whether they contain the base.
const BLEND_PROBE: &str = "
override ROWS: f32 = 1.0;
struct Case { @location(0) base: vec2<f32>, @location(1) slopes: vec4<f32>, @location(2) influences: vec2<f32>, @location(3) contains: vec2<f32> }
struct Out { @builtin(position) at: vec4<f32>, @location(0) @interpolate(flat, either) value: vec4<f32> }
@vertex fn vs_probe(in: Case, @builtin(vertex_index) index: u32) -> Out {
    let pixel = vec2<f32>(f32(index % 256u), f32(index / 256u)) + 0.5;
    let at = vec4<f32>(pixel / vec2<f32>(128.0, -0.5 * ROWS) + vec2<f32>(-1.0, 1.0), 0.0, 1.0);
    var blend = begin_blend(in.base);
    blend = add_wrinkle(blend, in.slopes.xy, in.contains.x, in.influences.x);
    blend = add_wrinkle(blend, in.slopes.zw, in.contains.y, in.influences.y);
    return Out(at, vec4<f32>(end_blend(blend), 1.0));
}
@fragment fn fs_probe(in: Out) -> @location(0) vec4<f32> { return in.value; }
";

pub fn add(add: &mut Add<'_>) {
    add("twins::skinning_and_turning_normals".into(), Box::new(skinning));
    add("twins::vertex_influences".into(), Box::new(influences));
    for mode in BlendMode::ALL {
        add(format!("twins::blend_{mode}"), Box::new(move |stage| blend(stage, mode)));
    }
}

/// A frame in which everything moves: brows, jaw, head.
fn moving_frame(stage: &Stage) -> anyhow::Result<RenderFrame> {
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

fn all_vertices(stage: &Stage) -> Vec<Vertex> {
    stage.asset.primitives.iter().flat_map(|primitive| primitive.vertices.iter().copied()).collect()
}

fn probe_skinning(stage: &Stage, frame: &RenderFrame, vertices: &[Vertex], which: u32) -> anyhow::Result<Vec<[f32; 4]>> {
    let character = &stage.asset.character;
    let rows: Vec<[[f32; 4]; 3]> = stage.asset.palette.model_from_rest(character, frame).iter().map(uniforms::rows_of).collect();
    let mut palette = vec![0_u8; size_of::<uniforms::PaletteRows>()];
    palette[..size_of_val(rows.as_slice())].copy_from_slice(bytemuck::cast_slice(&rows));
    let vectors = bone_major(&frame.influences, character.num_bones(), character.num_poses());
    let mut coefficients = vec![0_u8; size_of::<uniforms::CoefficientVectors>()];
    coefficients[..size_of_val(vectors.as_slice())].copy_from_slice(bytemuck::cast_slice(&vectors));
    let table = pose_table(&stage.asset);
    let headless = stage.headless.lock().map_err(|_| anyhow::anyhow!("another test broke the renderer"))?;
    let constants = [("WHICH", f64::from(which)), ("NUM_POSES", character.num_poses() as f64)];
    let source = format!("{}{SKINNING_PROBE}", rhytid_shaders::SKINNING);
    run(
        &headless,
        &source,
        &constants,
        &[&palette, &coefficients, bytemuck::bytes_of(&table)],
        VERTEX_LAYOUT,
        bytemuck::cast_slice(vertices),
        vertices.len(),
    )
}

fn skinning(stage: &Stage) -> anyhow::Result<()> {
    let frame = moving_frame(stage)?;
    let vertices = all_vertices(stage);
    let palette = stage.asset.palette.model_from_rest(&stage.asset.character, &frame);
    let read = |which| probe_skinning(stage, &frame, &vertices, which);
    let (positions, normals, tangents) = (read(0)?, read(1)?, read(2)?);
    let xyz = |value: [f32; 4]| Vec3::new(value[0], value[1], value[2]);
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

fn influences(stage: &Stage) -> anyhow::Result<()> {
    let frame = moving_frame(stage)?;
    let vertices = all_vertices(stage);
    let read = probe_skinning(stage, &frame, &vertices, 3)?;
    let mut highest = 0.0_f32;
    for (v, vertex) in vertices.iter().enumerate() {
        for (k, twin) in twin::influences(vertex, &stage.asset.character, &frame.influences).into_iter().enumerate().take(4) {
            ensure!((read[v][k] - twin).abs() < 1e-5, "vertex {v}, pose {k}: {} on the device, {twin} in the twin", read[v][k]);
            highest = highest.max(twin);
        }
    }
    ensure!(highest > 0.5, "no vertex has an influence above {highest}");
    Ok(())
}

#[repr(C)]
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct Case {
    base: [f32; 2],
    slopes: [f32; 4],
    influences: [f32; 2],
    contains: [f32; 2],
}

fn blend(stage: &Stage, mode: BlendMode) -> anyhow::Result<()> {
    // A fixed sequence over the ranges that maps reach; 2,048 cases.
    let mut state = 1_u32;
    let mut next = |low: f32, high: f32| {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        low + (high - low) * ((state >> 8) as f32 / 16_777_216.0)
    };
    let cases: Vec<Case> = (0..2048)
        .map(|_| Case {
            base: [next(-0.6, 0.6), next(-0.6, 0.6)],
            slopes: [next(-1.2, 1.2), next(-1.2, 1.2), next(-1.2, 1.2), next(-1.2, 1.2)],
            influences: [next(0.0, 1.0), next(0.0, 1.0)],
            contains: [next(0.0, 1.0).round(), next(0.0, 1.0).round()],
        })
        .collect();
    let layout = wgpu::VertexBufferLayout {
        array_stride: size_of::<Case>() as u64,
        step_mode: wgpu::VertexStepMode::Vertex,
        attributes: &wgpu::vertex_attr_array![0 => Float32x2, 1 => Float32x4, 2 => Float32x2, 3 => Float32x2],
    };
    let number = BlendMode::ALL.iter().position(|known| *known == mode).context("every mode is in the list")?;
    let source = format!("{}{BLEND_PROBE}", rhytid_shaders::WRINKLES);
    let headless = stage.headless.lock().map_err(|_| anyhow::anyhow!("another test broke the renderer"))?;
    let read = run(&headless, &source, &[("BLEND", number as f64)], &[], layout, bytemuck::cast_slice(&cases), cases.len())?;
    let other = BlendMode::ALL[(number + 1) % BlendMode::ALL.len()];
    let mut num_apart = 0;
    for (case, read) in cases.iter().zip(read) {
        let samples = [0, 1].map(|i: usize| WrinkleSample {
            slope: Vec2::new(case.slopes[2 * i], case.slopes[2 * i + 1]),
            contains_neutral: case.contains[i] == 1.0,
            influence: case.influences[i],
        });
        let (got, twin) = (Vec3::new(read[0], read[1], read[2]), twin::blend(mode, Vec2::from(case.base), &samples));
        ensure!(got.distance(twin) < 1e-5, "{got} on the device, {twin} in the twin");
        num_apart += usize::from(got.distance(twin::blend(other, Vec2::from(case.base), &samples)) > 1e-3);
    }
    ensure!(num_apart > 1000, "{mode} and {other} differ in {num_apart} cases only: the test could not tell them apart");
    Ok(())
}

/// Draws one point a vertex into a float texture and reads it back.
fn run(
    headless: &Headless,
    source: &str,
    constants: &[(&str, f64)],
    blocks: &[&[u8]],
    layout: wgpu::VertexBufferLayout<'_>,
    vertices: &[u8],
    num_vertices: usize,
) -> anyhow::Result<Vec<[f32; 4]>> {
    let (device, queue) = headless.device();
    let rows = (num_vertices as u32).div_ceil(WIDTH);
    let module =
        device.create_shader_module(wgpu::ShaderModuleDescriptor { label: Some("probe"), source: wgpu::ShaderSource::Wgsl(source.into()) });
    let entry = |binding: usize| wgpu::BindGroupLayoutEntry {
        binding: binding as u32,
        visibility: wgpu::ShaderStages::VERTEX,
        ty: wgpu::BindingType::Buffer { ty: wgpu::BufferBindingType::Uniform, has_dynamic_offset: false, min_binding_size: None },
        count: None,
    };
    let entries: Vec<_> = (0..blocks.len()).map(entry).collect();
    let group_layout = device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor { label: Some("probe"), entries: &entries });
    let buffers: Vec<wgpu::Buffer> = blocks
        .iter()
        .map(|contents| {
            device.create_buffer_init(&wgpu::util::BufferInitDescriptor {
                label: Some("probe block"),
                contents,
                usage: wgpu::BufferUsages::UNIFORM,
            })
        })
        .collect();
    let bound: Vec<_> = buffers
        .iter()
        .enumerate()
        .map(|(binding, buffer)| wgpu::BindGroupEntry { binding: binding as u32, resource: buffer.as_entire_binding() })
        .collect();
    let group = device.create_bind_group(&wgpu::BindGroupDescriptor { label: Some("probe"), layout: &group_layout, entries: &bound });
    let pipeline_layout = device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
        label: Some("probe"),
        bind_group_layouts: &[None, Some(&group_layout)],
        immediate_size: 0,
    });
    let mut constants = constants.to_vec();
    constants.push(("ROWS", f64::from(rows)));
    let options = wgpu::PipelineCompilationOptions { constants: &constants, ..Default::default() };
    let format = wgpu::TextureFormat::Rgba32Float;
    let pipeline = device.create_render_pipeline(&wgpu::RenderPipelineDescriptor {
        label: Some("probe"),
        layout: Some(&pipeline_layout),
        vertex: wgpu::VertexState {
            module: &module,
            entry_point: Some("vs_probe"),
            compilation_options: options,
            buffers: &[Some(layout)],
        },
        primitive: wgpu::PrimitiveState { topology: wgpu::PrimitiveTopology::PointList, ..Default::default() },
        depth_stencil: None,
        multisample: wgpu::MultisampleState::default(),
        fragment: Some(wgpu::FragmentState {
            module: &module,
            entry_point: Some("fs_probe"),
            compilation_options: Default::default(),
            targets: &[Some(format.into())],
        }),
        multiview_mask: None,
        cache: None,
    });
    let size = wgpu::Extent3d { width: WIDTH, height: rows, depth_or_array_layers: 1 };
    let texture = device.create_texture(&wgpu::TextureDescriptor {
        label: Some("probe"),
        size,
        mip_level_count: 1,
        sample_count: 1,
        dimension: wgpu::TextureDimension::D2,
        format,
        usage: wgpu::TextureUsages::RENDER_ATTACHMENT | wgpu::TextureUsages::COPY_SRC,
        view_formats: &[],
    });
    let buffer = device.create_buffer(&wgpu::BufferDescriptor {
        label: Some("probe read-back"),
        size: u64::from(WIDTH) * u64::from(rows) * 16,
        usage: wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST,
        mapped_at_creation: false,
    });
    let points = device.create_buffer_init(&wgpu::util::BufferInitDescriptor {
        label: Some("probe points"),
        contents: vertices,
        usage: wgpu::BufferUsages::VERTEX,
    });
    let mut encoder = device.create_command_encoder(&wgpu::CommandEncoderDescriptor { label: Some("probe") });
    {
        let mut pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
            label: Some("probe"),
            color_attachments: &[Some(wgpu::RenderPassColorAttachment {
                view: &texture.create_view(&wgpu::TextureViewDescriptor::default()),
                depth_slice: None,
                resolve_target: None,
                ops: wgpu::Operations { load: wgpu::LoadOp::Clear(wgpu::Color::TRANSPARENT), store: wgpu::StoreOp::Store },
            })],
            depth_stencil_attachment: None,
            timestamp_writes: None,
            occlusion_query_set: None,
            multiview_mask: None,
        });
        pass.set_pipeline(&pipeline);
        pass.set_bind_group(1, &group, &[]);
        pass.set_vertex_buffer(0, points.slice(..));
        pass.draw(0..num_vertices as u32, 0..1);
    }
    let copied = wgpu::TexelCopyBufferLayout { offset: 0, bytes_per_row: Some(WIDTH * 16), rows_per_image: None };
    encoder.copy_texture_to_buffer(texture.as_image_copy(), wgpu::TexelCopyBufferInfo { buffer: &buffer, layout: copied }, size);
    queue.submit([encoder.finish()]);
    buffer.map_async(wgpu::MapMode::Read, .., |_| {});
    device.poll(wgpu::PollType::wait_indefinitely())?;
    let mapped = buffer.get_mapped_range(..)?;
    let values: &[[f32; 4]] = bytemuck::cast_slice(&mapped);
    Ok(values[..num_vertices].to_vec())
}
