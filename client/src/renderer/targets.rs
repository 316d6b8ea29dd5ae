//! The attachments that depend on the picture's size.

use super::pipelines::{DEPTH_FORMAT, SAMPLES, SCENE_FORMAT};
use super::present::Presenter;
use super::scattering::Scattering;
use super::tone::{self, Tone};

/// Attachments of one size and the groups that read them.
#[derive(Debug)]
pub struct Targets {
    pub size: [u32; 2],
    /// Several samples a pixel: highlights, light out of the skin, depth.
    pub specular_samples: wgpu::TextureView,
    pub diffuse_samples: wgpu::TextureView,
    pub depth: wgpu::TextureView,
    /// The first two resolved.
    pub specular: wgpu::TextureView,
    pub diffuse: wgpu::TextureView,
    /// Scattered across, then also up.
    pub scratch: wgpu::TextureView,
    pub scattered: wgpu::TextureView,
    /// Encoded.
    pub picture: wgpu::TextureView,
    pub scatter_groups: [wgpu::BindGroup; 2],
    /// With scattering and without.
    pub tone_scattered: wgpu::BindGroup,
    pub tone_plain: wgpu::BindGroup,
    pub present_group: wgpu::BindGroup,
    /// Bytes of all of them.
    pub bytes: u64,
}

impl Targets {
    /// Attachments for pictures of `size` pixels.
    pub fn new(device: &wgpu::Device, size: [u32; 2], scattering: &Scattering, tone: &Tone, presenter: &Presenter) -> Self {
        let mut bytes = 0;
        let mut attachment = |label: &str, format: wgpu::TextureFormat, sample_count: u32| {
            let texel = u64::from(format.block_copy_size(Some(wgpu::TextureAspect::All)).unwrap_or(4));
            bytes += u64::from(size[0]) * u64::from(size[1]) * u64::from(sample_count) * texel;
            let read = if sample_count == 1 { wgpu::TextureUsages::TEXTURE_BINDING } else { wgpu::TextureUsages::empty() };
            device
                .create_texture(&wgpu::TextureDescriptor {
                    label: Some(label),
                    size: wgpu::Extent3d { width: size[0], height: size[1], depth_or_array_layers: 1 },
                    mip_level_count: 1,
                    sample_count,
                    dimension: wgpu::TextureDimension::D2,
                    format,
                    usage: read | wgpu::TextureUsages::RENDER_ATTACHMENT,
                    view_formats: &[],
                })
                .create_view(&wgpu::TextureViewDescriptor::default())
        };
        let specular_samples = attachment("specular samples", SCENE_FORMAT, SAMPLES);
        let diffuse_samples = attachment("diffuse samples", SCENE_FORMAT, SAMPLES);
        let depth = attachment("scene depth", DEPTH_FORMAT, SAMPLES);
        let specular = attachment("specular", SCENE_FORMAT, 1);
        let diffuse = attachment("diffuse", SCENE_FORMAT, 1);
        let scratch = attachment("scattered across", SCENE_FORMAT, 1);
        let scattered = attachment("scattered", SCENE_FORMAT, 1);
        let picture = attachment("encoded picture", tone::FORMAT, 1);
        Self {
            size,
            scatter_groups: scattering.groups(device, [&diffuse, &scratch], &specular),
            tone_scattered: tone.group(device, [&diffuse, &scattered, &specular]),
            tone_plain: tone.group(device, [&diffuse, &diffuse, &specular]),
            present_group: presenter.group(device, &picture, &diffuse),
            specular_samples,
            diffuse_samples,
            depth,
            specular,
            diffuse,
            scratch,
            scattered,
            picture,
            bytes,
        }
    }
}
