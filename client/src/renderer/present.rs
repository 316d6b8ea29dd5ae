//! The last pass: smooths edges and encodes for the target.

use super::fullscreen::{self, filtered_picture};
use super::layouts::uniform;
use super::uniforms;
use super::upload::entry;

/// The pass.
#[derive(Debug)]
pub struct Presenter {
    pub pipeline: wgpu::RenderPipeline,
    layout: wgpu::BindGroupLayout,
    pub block: wgpu::Buffer,
    /// Whether the target's format encodes sRGB by itself.
    pub target_encodes_srgb: bool,
}

impl Presenter {
    pub fn new(device: &wgpu::Device, target_format: wgpu::TextureFormat) -> Self {
        let layout = device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor {
            label: Some("present"),
            entries: &[
                uniform(0, wgpu::ShaderStages::FRAGMENT, size_of::<uniforms::Present>()),
                filtered_picture(1),
                fullscreen::filtering_sampler(2),
                filtered_picture(3),
            ],
        });
        let pipeline = fullscreen::pipeline(device, "present", rhytid_shaders::PRESENT, "fs_present", &layout, target_format);
        let block = fullscreen::block(device, "present settings", size_of::<uniforms::Present>());
        Self { pipeline, layout, block, target_encodes_srgb: target_format.is_srgb() }
    }

    /// The group for one encoded picture and the light with the depth it was made of.
    pub fn group(&self, device: &wgpu::Device, picture: &wgpu::TextureView, diffuse: &wgpu::TextureView) -> wgpu::BindGroup {
        let sampler = fullscreen::sampler(device);
        device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some("present"),
            layout: &self.layout,
            entries: &[
                entry(0, self.block.as_entire_binding()),
                entry(1, wgpu::BindingResource::TextureView(picture)),
                entry(2, wgpu::BindingResource::Sampler(&sampler)),
                entry(3, wgpu::BindingResource::TextureView(diffuse)),
            ],
        })
    }
}
