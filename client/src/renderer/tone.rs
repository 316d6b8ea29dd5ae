//! Diffuse light and highlights become one encoded picture.

use super::fullscreen::{self, filtered_picture};
use super::layouts::uniform;
use super::uniforms;
use super::upload::entry;

/// Encoded colour and its luma.
pub const FORMAT: wgpu::TextureFormat = wgpu::TextureFormat::Rgba8Unorm;

/// The pass.
#[derive(Debug)]
pub struct Tone {
    pub pipeline: wgpu::RenderPipeline,
    layout: wgpu::BindGroupLayout,
    pub block: wgpu::Buffer,
}

/// What of the light is shown; numbers as in `tone.wgsl`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u32)]
pub enum Shown {
    /// All of it.
    All = 0,
    /// Display values, as they are.
    Raw = 1,
    /// What came out of the skin.
    Diffuse = 2,
    /// Highlights.
    Specular = 3,
    /// What scattering changed, about a middle grey.
    Scattering = 4,
}

impl Tone {
    pub fn new(device: &wgpu::Device) -> Self {
        let layout = device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor {
            label: Some("tone"),
            entries: &[
                uniform(0, wgpu::ShaderStages::FRAGMENT, size_of::<uniforms::Tone>()),
                filtered_picture(1),
                filtered_picture(2),
                filtered_picture(3),
            ],
        });
        let pipeline = fullscreen::pipeline(device, "tone", rhytid_shaders::TONE, "fs_tone", &layout, FORMAT);
        Self { pipeline, layout, block: fullscreen::block(device, "tone settings", size_of::<uniforms::Tone>()) }
    }

    /// The group for one set of pictures: as drawn, after scattering, highlights.
    pub fn group(&self, device: &wgpu::Device, pictures: [&wgpu::TextureView; 3]) -> wgpu::BindGroup {
        let [drawn, scattered, specular] = pictures.map(wgpu::BindingResource::TextureView);
        device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some("tone"),
            layout: &self.layout,
            entries: &[entry(0, self.block.as_entire_binding()), entry(1, drawn), entry(2, scattered), entry(3, specular)],
        })
    }
}
