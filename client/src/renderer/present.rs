//! From the scene to the picture, and the attachments that depend on its size.

use super::layouts::{binding, texture, uniform};
use super::pipelines::{DEPTH_FORMAT, SAMPLES, SCENE_FORMAT};
use super::uniforms;
use super::upload::entry;

/// The last pass.
#[derive(Debug)]
pub struct Presenter {
    pipeline: wgpu::RenderPipeline,
    layout: wgpu::BindGroupLayout,
    pub block: wgpu::Buffer,
    /// Whether the target's format encodes sRGB by itself.
    pub target_encodes_srgb: bool,
}

/// Attachments of one size.
#[derive(Debug)]
pub struct Targets {
    pub size: [u32; 2],
    /// Linear light, several samples a pixel.
    pub samples: wgpu::TextureView,
    /// The same resolved.
    pub scene: wgpu::TextureView,
    pub depth: wgpu::TextureView,
    pub group: wgpu::BindGroup,
    /// Bytes of all three.
    pub bytes: u64,
}

impl Presenter {
    pub fn new(device: &wgpu::Device, target_format: wgpu::TextureFormat) -> Self {
        let layout = device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor {
            label: Some("present"),
            entries: &[
                uniform(0, wgpu::ShaderStages::FRAGMENT, size_of::<uniforms::Present>()),
                // Read texel by texel: filtering halves is not something every browser does.
                binding(
                    1,
                    wgpu::ShaderStages::FRAGMENT,
                    texture(wgpu::TextureSampleType::Float { filterable: false }, wgpu::TextureViewDimension::D2),
                ),
            ],
        });
        let module = device.create_shader_module(wgpu::ShaderModuleDescriptor {
            label: Some("present"),
            source: wgpu::ShaderSource::Wgsl(rhytid_shaders::PRESENT.into()),
        });
        let pipeline_layout = device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
            label: Some("present"),
            bind_group_layouts: &[Some(&layout)],
            immediate_size: 0,
        });
        let pipeline = device.create_render_pipeline(&wgpu::RenderPipelineDescriptor {
            label: Some("present"),
            layout: Some(&pipeline_layout),
            vertex: wgpu::VertexState {
                module: &module,
                entry_point: Some("vs_present"),
                compilation_options: Default::default(),
                buffers: &[],
            },
            primitive: wgpu::PrimitiveState::default(),
            depth_stencil: None,
            multisample: wgpu::MultisampleState::default(),
            fragment: Some(wgpu::FragmentState {
                module: &module,
                entry_point: Some("fs_present"),
                compilation_options: Default::default(),
                targets: &[Some(target_format.into())],
            }),
            multiview_mask: None,
            cache: None,
        });
        let block = device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("present settings"),
            size: size_of::<uniforms::Present>() as u64,
            usage: wgpu::BufferUsages::UNIFORM | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        Self { pipeline, layout, block, target_encodes_srgb: target_format.is_srgb() }
    }

    /// Attachments for pictures of `size` pixels.
    pub fn targets(&self, device: &wgpu::Device, size: [u32; 2]) -> Targets {
        let attachment = |label: &str, format: wgpu::TextureFormat, sample_count: u32, usage: wgpu::TextureUsages| {
            device
                .create_texture(&wgpu::TextureDescriptor {
                    label: Some(label),
                    size: wgpu::Extent3d { width: size[0], height: size[1], depth_or_array_layers: 1 },
                    mip_level_count: 1,
                    sample_count,
                    dimension: wgpu::TextureDimension::D2,
                    format,
                    usage: usage | wgpu::TextureUsages::RENDER_ATTACHMENT,
                    view_formats: &[],
                })
                .create_view(&wgpu::TextureViewDescriptor::default())
        };
        let samples = attachment("scene samples", SCENE_FORMAT, SAMPLES, wgpu::TextureUsages::empty());
        let scene = attachment("scene", SCENE_FORMAT, 1, wgpu::TextureUsages::TEXTURE_BINDING);
        let depth = attachment("scene depth", DEPTH_FORMAT, SAMPLES, wgpu::TextureUsages::empty());
        let group = device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some("present"),
            layout: &self.layout,
            entries: &[entry(0, self.block.as_entire_binding()), entry(1, wgpu::BindingResource::TextureView(&scene))],
        });
        // 8 bytes a sample of colour, 4 of depth, 8 for the resolved pixel.
        let bytes = u64::from(size[0]) * u64::from(size[1]) * (u64::from(SAMPLES) * 12 + 8);
        Targets { size, samples, scene, depth, group, bytes }
    }

    /// Records the pass.
    pub fn draw(&self, encoder: &mut wgpu::CommandEncoder, targets: &Targets, target: &wgpu::TextureView) {
        let mut pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
            label: Some("present"),
            color_attachments: &[Some(wgpu::RenderPassColorAttachment {
                view: target,
                depth_slice: None,
                resolve_target: None,
                ops: wgpu::Operations { load: wgpu::LoadOp::Clear(wgpu::Color::BLACK), store: wgpu::StoreOp::Store },
            })],
            depth_stencil_attachment: None,
            timestamp_writes: None,
            occlusion_query_set: None,
            multiview_mask: None,
        });
        pass.set_pipeline(&self.pipeline);
        pass.set_bind_group(0, &targets.group, &[]);
        pass.draw(0..3, 0..1);
    }
}
