//! Textures to draw pictures into.

/// A texture to draw one picture into: one level, one layer, one sample a pixel. `read` is what is done with the picture then.
pub fn picture_texture(
    device: &wgpu::Device,
    label: &str,
    [width, height]: [u32; 2],
    format: wgpu::TextureFormat,
    read: wgpu::TextureUsages,
) -> wgpu::Texture {
    device.create_texture(&wgpu::TextureDescriptor {
        label: Some(label),
        size: wgpu::Extent3d { width, height, depth_or_array_layers: 1 },
        mip_level_count: 1,
        sample_count: 1,
        dimension: wgpu::TextureDimension::D2,
        format,
        usage: read | wgpu::TextureUsages::RENDER_ATTACHMENT,
        view_formats: &[],
    })
}
