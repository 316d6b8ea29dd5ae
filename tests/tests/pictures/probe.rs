//! Runs the shaders' own functions outside the renderer: draws into a float texture and reads it back.

use crate::read_back::read_back;
use rhytid_client::Headless;
use rhytid_client::renderer::picture_texture;
use wgpu::util::DeviceExt;

/// Pixels a row where each point is a pixel: point `index` goes to column `index % WIDTH` of row `index / WIDTH`.
pub const WIDTH: u32 = 256;
const FORMAT: wgpu::TextureFormat = wgpu::TextureFormat::Rgba32Float;

/// For the end of a source: `pixel_of(index)` is the clip position of point `index`.
pub const PLACE: &str = "
override ROWS: f32 = 1.0;
fn pixel_of(index: u32) -> vec4<f32> {
    let pixel = vec2<f32>(f32(index % 256u), f32(index / 256u)) + 0.5;
    return vec4<f32>(pixel / vec2<f32>(128.0, -0.5 * ROWS) + vec2<f32>(-1.0, 1.0), 0.0, 1.0);
}
";

/// One drawing.
pub struct Probe<'a> {
    /// WGSL.
    pub source: &'a str,
    /// Its vertex and fragment entries.
    pub entries: [&'a str; 2],
    /// Values of its overrides.
    pub constants: &'a [(&'a str, f64)],
    /// Groups by their number, each with its bindings by theirs.
    pub groups: &'a [(usize, &'a [(u32, Resource<'a>)])],
    /// What is drawn.
    pub what: What<'a>,
}

/// What a shader reads.
pub enum Resource<'a> {
    /// A uniform block.
    Block(&'a [u8]),
    /// A texture of one kind, one sample a texel.
    Texture { view: &'a wgpu::TextureView, dimension: wgpu::TextureViewDimension, is_filterable: bool },
    /// Linear within and between texels, repeating.
    Sampler,
}

/// What is drawn.
pub enum What<'a> {
    /// A pixel for each of `count` points.
    Points { layout: wgpu::VertexBufferLayout<'a>, bytes: &'a [u8], count: usize },
    /// One triangle over the whole picture of this size.
    Picture([u32; 2]),
}

/// Layers of tightly packed texels as a texture array.
pub fn texture(headless: &Headless, format: wgpu::TextureFormat, size: [u32; 2], layers: &[Vec<u8>]) -> wgpu::Texture {
    let (device, queue) = headless.device();
    let descriptor = wgpu::TextureDescriptor {
        label: Some("probe map"),
        size: wgpu::Extent3d { width: size[0], height: size[1], depth_or_array_layers: layers.len() as u32 },
        mip_level_count: 1,
        sample_count: 1,
        dimension: wgpu::TextureDimension::D2,
        format,
        usage: wgpu::TextureUsages::TEXTURE_BINDING | wgpu::TextureUsages::COPY_DST,
        view_formats: &[],
    };
    device.create_texture_with_data(queue, &descriptor, wgpu::util::TextureDataOrder::LayerMajor, &layers.concat())
}

/// Draws and returns one value a point, or a pixel by rows.
pub fn run(headless: &Headless, probe: &Probe<'_>) -> anyhow::Result<Vec<[f32; 4]>> {
    let (device, queue) = headless.device();
    let (size, num_values) = match probe.what {
        What::Points { count, .. } => ([WIDTH, (count as u32).div_ceil(WIDTH)], count),
        What::Picture(size) => (size, (size[0] * size[1]) as usize),
    };
    let groups: Vec<_> = probe.groups.iter().map(|(number, bindings)| (*number, bind(device, bindings))).collect();
    let mut layouts = vec![None; groups.iter().map(|(number, _)| number + 1).max().unwrap_or_default()];
    for (number, (layout, _)) in &groups {
        layouts[*number] = Some(layout);
    }
    let layout = device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
        label: Some("probe"),
        bind_group_layouts: &layouts,
        immediate_size: 0,
    });
    let pipeline = pipeline(device, probe, &layout, size[1]);
    let target = picture_texture(device, "probe", size, FORMAT, wgpu::TextureUsages::COPY_SRC);
    let mut encoder = device.create_command_encoder(&wgpu::CommandEncoderDescriptor { label: Some("probe") });
    {
        let mut pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
            label: Some("probe"),
            color_attachments: &[Some(wgpu::RenderPassColorAttachment {
                view: &target.create_view(&wgpu::TextureViewDescriptor::default()),
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
        for (number, (_, group)) in &groups {
            pass.set_bind_group(*number as u32, group, &[]);
        }
        match probe.what {
            What::Points { bytes, count, .. } => {
                let points = device.create_buffer_init(&wgpu::util::BufferInitDescriptor {
                    label: Some("probe points"),
                    contents: bytes,
                    usage: wgpu::BufferUsages::VERTEX,
                });
                pass.set_vertex_buffer(0, points.slice(..));
                pass.draw(0..count as u32, 0..1);
            }
            What::Picture(_) => pass.draw(0..3, 0..1),
        }
    }
    let bytes = read_back(device, queue, encoder, &target)?;
    Ok(bytemuck::cast_slice(&bytes)[..num_values].to_vec())
}

fn bind(device: &wgpu::Device, bindings: &[(u32, Resource<'_>)]) -> (wgpu::BindGroupLayout, wgpu::BindGroup) {
    let entries: Vec<_> = bindings
        .iter()
        .map(|&(binding, ref resource)| wgpu::BindGroupLayoutEntry {
            binding,
            visibility: wgpu::ShaderStages::VERTEX_FRAGMENT,
            ty: match resource {
                Resource::Block(_) => {
                    wgpu::BindingType::Buffer { ty: wgpu::BufferBindingType::Uniform, has_dynamic_offset: false, min_binding_size: None }
                }
                Resource::Texture { dimension, is_filterable, .. } => wgpu::BindingType::Texture {
                    sample_type: wgpu::TextureSampleType::Float { filterable: *is_filterable },
                    view_dimension: *dimension,
                    multisampled: false,
                },
                Resource::Sampler => wgpu::BindingType::Sampler(wgpu::SamplerBindingType::Filtering),
            },
            count: None,
        })
        .collect();
    let layout = device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor { label: Some("probe"), entries: &entries });
    let sampler = device.create_sampler(&wgpu::SamplerDescriptor {
        label: Some("probe"),
        address_mode_u: wgpu::AddressMode::Repeat,
        address_mode_v: wgpu::AddressMode::Repeat,
        mag_filter: wgpu::FilterMode::Linear,
        min_filter: wgpu::FilterMode::Linear,
        mipmap_filter: wgpu::MipmapFilterMode::Linear,
        ..Default::default()
    });
    let buffers: Vec<Option<wgpu::Buffer>> = bindings
        .iter()
        .map(|(_, resource)| match resource {
            Resource::Block(contents) => Some(device.create_buffer_init(&wgpu::util::BufferInitDescriptor {
                label: Some("probe block"),
                contents,
                usage: wgpu::BufferUsages::UNIFORM,
            })),
            Resource::Texture { .. } | Resource::Sampler => None,
        })
        .collect();
    let bound: Vec<_> = bindings
        .iter()
        .zip(&buffers)
        .map(|(&(binding, ref resource), buffer)| wgpu::BindGroupEntry {
            binding,
            resource: match (resource, buffer) {
                (_, Some(buffer)) => buffer.as_entire_binding(),
                (Resource::Texture { view, .. }, None) => wgpu::BindingResource::TextureView(view),
                (Resource::Block(_) | Resource::Sampler, None) => wgpu::BindingResource::Sampler(&sampler),
            },
        })
        .collect();
    let group = device.create_bind_group(&wgpu::BindGroupDescriptor { label: Some("probe"), layout: &layout, entries: &bound });
    (layout, group)
}

fn pipeline(device: &wgpu::Device, probe: &Probe<'_>, layout: &wgpu::PipelineLayout, num_rows: u32) -> wgpu::RenderPipeline {
    let source = wgpu::ShaderSource::Wgsl(probe.source.into());
    let module = device.create_shader_module(wgpu::ShaderModuleDescriptor { label: Some("probe"), source });
    let mut constants = probe.constants.to_vec();
    let (topology, buffers) = match &probe.what {
        What::Points { layout, .. } => {
            constants.push(("ROWS", f64::from(num_rows)));
            (wgpu::PrimitiveTopology::PointList, vec![Some(layout.clone())])
        }
        What::Picture(_) => (wgpu::PrimitiveTopology::TriangleList, Vec::new()),
    };
    let options = wgpu::PipelineCompilationOptions { constants: &constants, ..Default::default() };
    device.create_render_pipeline(&wgpu::RenderPipelineDescriptor {
        label: Some("probe"),
        layout: Some(layout),
        vertex: wgpu::VertexState {
            module: &module,
            entry_point: Some(probe.entries[0]),
            compilation_options: options.clone(),
            buffers: &buffers,
        },
        primitive: wgpu::PrimitiveState { topology, ..Default::default() },
        depth_stencil: None,
        multisample: wgpu::MultisampleState::default(),
        fragment: Some(wgpu::FragmentState {
            module: &module,
            entry_point: Some(probe.entries[1]),
            compilation_options: options,
            targets: &[Some(FORMAT.into())],
        }),
        multiview_mask: None,
        cache: None,
    })
}
