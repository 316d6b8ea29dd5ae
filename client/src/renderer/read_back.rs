//! From the device back into memory.

use super::RenderError;
use image::RgbaImage;

/// Submits `encoder`, then copies `texture` (four bytes a texel, usage `COPY_SRC`), whose size is `size`. The channels come
/// as the format has them.
pub(crate) fn read_back(
    device: &wgpu::Device,
    queue: &wgpu::Queue,
    mut encoder: wgpu::CommandEncoder,
    texture: &wgpu::Texture,
    size: [u32; 2],
) -> Result<RgbaImage, RenderError> {
    let row_bytes = (size[0] * 4).next_multiple_of(wgpu::COPY_BYTES_PER_ROW_ALIGNMENT);
    let buffer = device.create_buffer(&wgpu::BufferDescriptor {
        label: Some("read-back"),
        size: u64::from(row_bytes) * u64::from(size[1]),
        usage: wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST,
        mapped_at_creation: false,
    });
    encoder.copy_texture_to_buffer(
        texture.as_image_copy(),
        wgpu::TexelCopyBufferInfo {
            buffer: &buffer,
            layout: wgpu::TexelCopyBufferLayout { offset: 0, bytes_per_row: Some(row_bytes), rows_per_image: None },
        },
        wgpu::Extent3d { width: size[0], height: size[1], depth_or_array_layers: 1 },
    );
    queue.submit([encoder.finish()]);
    let problem = |error: &dyn std::fmt::Display| RenderError::ReadBack(error.to_string());
    let (sender, receiver) = std::sync::mpsc::channel();
    // The receiver lives until the answer is there or the device is gone.
    buffer.map_async(wgpu::MapMode::Read, .., move |result| drop(sender.send(result)));
    device.poll(wgpu::PollType::wait_indefinitely()).map_err(|error| problem(&error))?;
    receiver.recv().map_err(|error| problem(&error))?.map_err(|error| problem(&error))?;
    let mapped = buffer.get_mapped_range(..).map_err(|error| problem(&error))?;
    let texels = mapped.chunks_exact(row_bytes as usize).flat_map(|row| &row[..size[0] as usize * 4]).copied().collect();
    RgbaImage::from_raw(size[0], size[1], texels).ok_or_else(|| RenderError::ReadBack("the picture came back too short".into()))
}
