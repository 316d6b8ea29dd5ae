//! The key light's shadow map, and how far its light has come.

use super::layouts::Layouts;
use super::picture_texture::picture_texture;
use super::pipelines::VERTEX_LAYOUT;

/// Texels a side: a third of a millimetre on a head.
pub const SIDE: u32 = 1024;
const FORMAT: wgpu::TextureFormat = wgpu::TextureFormat::Depth32Float;
/// A depth map that is compared cannot also be read on WebGL2: metres along the light have a map of their own. Half floats
/// within 0.25 m of the middle are true to 0.12 mm.
const DEPTH_IN_METRES: wgpu::TextureFormat = wgpu::TextureFormat::R16Float;
/// Behind everything.
const FAR: wgpu::Color = wgpu::Color { r: 8.0, g: 0.0, b: 0.0, a: 1.0 };

/// Pipeline, map and sampler.
#[derive(Debug)]
pub struct Shadow {
    pub pipeline: wgpu::RenderPipeline,
    pub map: wgpu::TextureView,
    /// Metres along the key light.
    pub depth_in_metres: wgpu::TextureView,
    pub sampler: wgpu::Sampler,
    /// Bytes of both maps.
    pub bytes: u64,
}

impl Shadow {
    pub fn new(device: &wgpu::Device, layouts: &Layouts) -> Self {
        let module = device.create_shader_module(wgpu::ShaderModuleDescriptor {
            label: Some("shadow"),
            source: wgpu::ShaderSource::Wgsl(rhytid_shaders::SHADOW.into()),
        });
        let pipeline = device.create_render_pipeline(&wgpu::RenderPipelineDescriptor {
            label: Some("shadow"),
            layout: Some(&layouts.geometry),
            vertex: wgpu::VertexState {
                module: &module,
                entry_point: Some("vs_shadow"),
                compilation_options: Default::default(),
                buffers: &[Some(VERTEX_LAYOUT)],
            },
            // Lids and nose wings are thin and open behind: both sides stop light.
            primitive: wgpu::PrimitiveState::default(),
            depth_stencil: Some(wgpu::DepthStencilState {
                format: FORMAT,
                depth_write_enabled: Some(true),
                depth_compare: Some(wgpu::CompareFunction::Less),
                stencil: wgpu::StencilState::default(),
                bias: wgpu::DepthBiasState { constant: 2, slope_scale: 2.0, clamp: 0.0 },
            }),
            multisample: wgpu::MultisampleState::default(),
            fragment: Some(wgpu::FragmentState {
                module: &module,
                entry_point: Some("fs_shadow"),
                compilation_options: Default::default(),
                targets: &[Some(DEPTH_IN_METRES.into())],
            }),
            multiview_mask: None,
            cache: None,
        });
        let texture = |label: &str, format: wgpu::TextureFormat| {
            picture_texture(device, label, [SIDE; 2], format, wgpu::TextureUsages::TEXTURE_BINDING)
                .create_view(&wgpu::TextureViewDescriptor::default())
        };
        let sampler = device.create_sampler(&wgpu::SamplerDescriptor {
            label: Some("shadow sampler"),
            mag_filter: wgpu::FilterMode::Linear,
            min_filter: wgpu::FilterMode::Linear,
            compare: Some(wgpu::CompareFunction::LessEqual),
            ..Default::default()
        });
        Self {
            pipeline,
            map: texture("shadow map", FORMAT),
            depth_in_metres: texture("depth along the key light", DEPTH_IN_METRES),
            sampler,
            bytes: u64::from(SIDE) * u64::from(SIDE) * 6,
        }
    }

    /// Begins the pass that draws the map.
    pub fn begin<'a>(
        &self,
        encoder: &'a mut wgpu::CommandEncoder,
        stamps: Option<wgpu::RenderPassTimestampWrites<'_>>,
    ) -> wgpu::RenderPass<'a> {
        let mut pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
            label: Some("shadow"),
            color_attachments: &[Some(wgpu::RenderPassColorAttachment {
                view: &self.depth_in_metres,
                depth_slice: None,
                resolve_target: None,
                ops: wgpu::Operations { load: wgpu::LoadOp::Clear(FAR), store: wgpu::StoreOp::Store },
            })],
            depth_stencil_attachment: Some(wgpu::RenderPassDepthStencilAttachment {
                view: &self.map,
                depth_ops: Some(wgpu::Operations { load: wgpu::LoadOp::Clear(1.0), store: wgpu::StoreOp::Store }),
                stencil_ops: None,
            }),
            timestamp_writes: stamps,
            occlusion_query_set: None,
            multiview_mask: None,
        });
        pass.set_pipeline(&self.pipeline);
        pass
    }
}
