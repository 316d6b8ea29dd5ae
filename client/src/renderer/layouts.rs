//! Bind group layouts by how often a group changes: 0 frame, 1 character, 2 material.

use super::uniforms;

/// The layouts all passes share.
#[derive(Debug)]
pub struct Layouts {
    /// Group 0 with the shadow maps and what lies all round.
    pub frame: wgpu::BindGroupLayout,
    /// Group 0 without it: for the pass that draws the shadow map.
    pub frame_unlit: wgpu::BindGroupLayout,
    /// Group 1.
    pub character: wgpu::BindGroupLayout,
    /// Group 2.
    pub material: wgpu::BindGroupLayout,
    /// Groups 0 (with shadow map), 1 and 2.
    pub surface: wgpu::PipelineLayout,
    /// Groups 0 (without shadow map) and 1.
    pub geometry: wgpu::PipelineLayout,
}

impl Layouts {
    pub fn new(device: &wgpu::Device) -> Self {
        use wgpu::ShaderStages as Stages;
        let group = |label: &str, entries: &[wgpu::BindGroupLayoutEntry]| {
            device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor { label: Some(label), entries })
        };
        let filtered = wgpu::TextureSampleType::Float { filterable: true };
        let sampler = wgpu::BindingType::Sampler(wgpu::SamplerBindingType::Filtering);
        let frame_block = uniform(0, Stages::VERTEX_FRAGMENT, size_of::<uniforms::Frame>());
        let frame = group(
            "frame",
            &[
                frame_block,
                binding(1, Stages::FRAGMENT, texture(wgpu::TextureSampleType::Depth, wgpu::TextureViewDimension::D2)),
                binding(2, Stages::FRAGMENT, wgpu::BindingType::Sampler(wgpu::SamplerBindingType::Comparison)),
                binding(3, Stages::FRAGMENT, texture(filtered, wgpu::TextureViewDimension::D2)),
                binding(4, Stages::FRAGMENT, texture(filtered, wgpu::TextureViewDimension::D2)),
                binding(5, Stages::FRAGMENT, sampler),
            ],
        );
        let frame_unlit = group("frame without shadow map", &[frame_block]);
        let character = group(
            "character",
            &[
                uniform(0, Stages::VERTEX, size_of::<uniforms::PaletteRows>()),
                uniform(1, Stages::VERTEX, size_of::<uniforms::CoefficientVectors>()),
                uniform(2, Stages::VERTEX_FRAGMENT, size_of::<uniforms::PoseTable>()),
                binding(3, Stages::FRAGMENT, texture(filtered, wgpu::TextureViewDimension::D2Array)),
                binding(4, Stages::FRAGMENT, sampler),
                binding(5, Stages::VERTEX, texture(wgpu::TextureSampleType::Float { filterable: false }, wgpu::TextureViewDimension::D2)),
                uniform(6, Stages::VERTEX, size_of::<uniforms::MorphWeights>()),
                binding(7, Stages::FRAGMENT, texture(filtered, wgpu::TextureViewDimension::D2Array)),
                binding(8, Stages::FRAGMENT, texture(filtered, wgpu::TextureViewDimension::D2Array)),
                binding(9, Stages::FRAGMENT, texture(filtered, wgpu::TextureViewDimension::D2)),
                uniform(10, Stages::FRAGMENT, size_of::<uniforms::WrinkleWeights>()),
                binding(11, Stages::FRAGMENT, texture(filtered, wgpu::TextureViewDimension::D2)),
            ],
        );
        let map = |at| binding(at, Stages::FRAGMENT, texture(filtered, wgpu::TextureViewDimension::D2));
        let material = group(
            "material",
            &[
                uniform(0, Stages::FRAGMENT, size_of::<uniforms::Material>()),
                map(1),
                map(2),
                map(3),
                binding(4, Stages::FRAGMENT, sampler),
                chosen_uniform(5, Stages::FRAGMENT, size_of::<uniforms::Region>()),
            ],
        );
        let pipeline = |label: &str, groups: &[Option<&wgpu::BindGroupLayout>]| {
            device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
                label: Some(label),
                bind_group_layouts: groups,
                immediate_size: 0,
            })
        };
        let surface = pipeline("surface", &[Some(&frame), Some(&character), Some(&material)]);
        let geometry = pipeline("geometry", &[Some(&frame_unlit), Some(&character)]);
        Self { frame, frame_unlit, character, material, surface, geometry }
    }
}

/// A uniform block of `size` bytes.
pub fn uniform(at: u32, visibility: wgpu::ShaderStages, size: usize) -> wgpu::BindGroupLayoutEntry {
    binding(at, visibility, uniform_block(size, false))
}

/// One of several uniform blocks of `size` bytes in a buffer; the draw call says which.
fn chosen_uniform(at: u32, visibility: wgpu::ShaderStages, size: usize) -> wgpu::BindGroupLayoutEntry {
    binding(at, visibility, uniform_block(size, true))
}

fn uniform_block(size: usize, has_dynamic_offset: bool) -> wgpu::BindingType {
    wgpu::BindingType::Buffer {
        ty: wgpu::BufferBindingType::Uniform,
        has_dynamic_offset,
        min_binding_size: std::num::NonZeroU64::new(size as u64),
    }
}

/// A texture read one sample a texel.
pub fn texture(sample_type: wgpu::TextureSampleType, view_dimension: wgpu::TextureViewDimension) -> wgpu::BindingType {
    wgpu::BindingType::Texture { sample_type, view_dimension, multisampled: false }
}

/// One entry of a layout.
pub fn binding(at: u32, visibility: wgpu::ShaderStages, ty: wgpu::BindingType) -> wgpu::BindGroupLayoutEntry {
    wgpu::BindGroupLayoutEntry { binding: at, visibility, ty, count: None }
}
