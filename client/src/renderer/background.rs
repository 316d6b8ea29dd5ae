//! The studio wall behind everything.

use super::pipelines::{DEPTH_FORMAT, SAMPLES, SCENE_FORMAT};

/// Depth of what lies behind everything, metres behind the camera's target: `FAR` in `output.wgsl`.
pub const FAR: f64 = 8.0;

/// The pipeline; it draws three vertices and needs nothing bound.
pub fn pipeline(device: &wgpu::Device) -> wgpu::RenderPipeline {
    let module = device.create_shader_module(wgpu::ShaderModuleDescriptor {
        label: Some("background"),
        source: wgpu::ShaderSource::Wgsl(rhytid_shaders::BACKGROUND.into()),
    });
    let layout = device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
        label: Some("background"),
        bind_group_layouts: &[],
        immediate_size: 0,
    });
    device.create_render_pipeline(&wgpu::RenderPipelineDescriptor {
        label: Some("background"),
        layout: Some(&layout),
        vertex: wgpu::VertexState {
            module: &module,
            entry_point: Some("vs_background"),
            compilation_options: Default::default(),
            buffers: &[],
        },
        primitive: wgpu::PrimitiveState::default(),
        depth_stencil: Some(wgpu::DepthStencilState {
            format: DEPTH_FORMAT,
            depth_write_enabled: Some(false),
            depth_compare: Some(wgpu::CompareFunction::LessEqual),
            stencil: wgpu::StencilState::default(),
            bias: wgpu::DepthBiasState::default(),
        }),
        multisample: wgpu::MultisampleState { count: SAMPLES, mask: !0, alpha_to_coverage_enabled: false },
        fragment: Some(wgpu::FragmentState {
            module: &module,
            entry_point: Some("fs_background"),
            compilation_options: Default::default(),
            targets: &[Some(SCENE_FORMAT.into()), Some(SCENE_FORMAT.into())],
        }),
        multiview_mask: None,
        cache: None,
    })
}
