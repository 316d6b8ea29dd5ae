//! Pictures without a window.

use super::{DrawSettings, RenderFrame, Renderer};
use crate::asset::CharacterAsset;
use image::RgbaImage;

/// Why nothing could be drawn.
#[derive(Debug, thiserror::Error)]
pub enum RenderError {
    /// The machine offers nothing to draw with.
    #[error("no GPU adapter found ({0}); on Debian or Ubuntu `apt install mesa-vulkan-drivers` gives a software one")]
    NoAdapter(String),
    /// The adapter gives no device with what WebGL2 guarantees.
    #[error("the GPU adapter {adapter:?} gives no device: {problem}")]
    NoDevice {
        /// Its name.
        adapter: String,
        /// What it said.
        problem: String,
    },
    /// A picture larger than the device can draw, or empty.
    #[error("picture size {got:?} is not possible, expected 1 to {most} pixels a side")]
    Size {
        /// What was asked for.
        got: [u32; 2],
        /// Largest side.
        most: u32,
    },
    /// The device was lost or ran out of memory.
    #[error("reading the picture back failed: {0}")]
    ReadBack(String),
}

/// A device without a surface, and one character on it.
#[derive(Debug)]
pub struct Headless {
    adapter: wgpu::AdapterInfo,
    device: wgpu::Device,
    queue: wgpu::Queue,
    renderer: Renderer,
}

/// What pictures are drawn into: sRGB-encoded by the hardware, as a window's surface mostly is.
const FORMAT: wgpu::TextureFormat = wgpu::TextureFormat::Rgba8UnormSrgb;

impl Headless {
    /// Opens the default adapter (`WGPU_ADAPTER_NAME` and `WGPU_BACKEND` choose another) and uploads the character.
    pub fn new(asset: &CharacterAsset) -> Result<Self, RenderError> {
        let (adapter, device, queue) = pollster::block_on(open_device())?;
        let renderer = Renderer::new(&device, &queue, asset, FORMAT);
        Ok(Self { adapter, device, queue, renderer })
    }

    /// What draws.
    pub fn adapter(&self) -> &wgpu::AdapterInfo {
        &self.adapter
    }

    /// The device, for who draws more than pictures.
    pub fn device(&self) -> (&wgpu::Device, &wgpu::Queue) {
        (&self.device, &self.queue)
    }

    /// Draws one picture and waits for it.
    pub fn render(&mut self, size: [u32; 2], settings: &DrawSettings, frame: &RenderFrame) -> Result<RgbaImage, RenderError> {
        let most = self.device.limits().max_texture_dimension_2d;
        if size.iter().any(|&side| side == 0 || side > most) {
            return Err(RenderError::Size { got: size, most });
        }
        let extent = wgpu::Extent3d { width: size[0], height: size[1], depth_or_array_layers: 1 };
        let target = self.device.create_texture(&wgpu::TextureDescriptor {
            label: Some("headless picture"),
            size: extent,
            mip_level_count: 1,
            sample_count: 1,
            dimension: wgpu::TextureDimension::D2,
            format: FORMAT,
            usage: wgpu::TextureUsages::RENDER_ATTACHMENT | wgpu::TextureUsages::COPY_SRC,
            view_formats: &[],
        });
        let row_bytes = (size[0] * 4).next_multiple_of(wgpu::COPY_BYTES_PER_ROW_ALIGNMENT);
        let buffer = self.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("headless read-back"),
            size: u64::from(row_bytes) * u64::from(size[1]),
            usage: wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        let mut encoder = self.device.create_command_encoder(&wgpu::CommandEncoderDescriptor { label: Some("headless frame") });
        let view = target.create_view(&wgpu::TextureViewDescriptor::default());
        self.renderer.draw(&self.device, &self.queue, &mut encoder, &view, size, settings, frame);
        encoder.copy_texture_to_buffer(
            target.as_image_copy(),
            wgpu::TexelCopyBufferInfo {
                buffer: &buffer,
                layout: wgpu::TexelCopyBufferLayout { offset: 0, bytes_per_row: Some(row_bytes), rows_per_image: None },
            },
            extent,
        );
        self.queue.submit([encoder.finish()]);
        let (sender, receiver) = std::sync::mpsc::channel();
        // The receiver lives until the answer is there or the device is gone.
        buffer.map_async(wgpu::MapMode::Read, .., move |result| drop(sender.send(result)));
        self.device.poll(wgpu::PollType::wait_indefinitely()).map_err(|error| RenderError::ReadBack(error.to_string()))?;
        receiver
            .recv()
            .map_err(|error| RenderError::ReadBack(error.to_string()))?
            .map_err(|error| RenderError::ReadBack(error.to_string()))?;
        let mapped = buffer.get_mapped_range(..).map_err(|error| RenderError::ReadBack(error.to_string()))?;
        let texels = mapped.chunks_exact(row_bytes as usize).flat_map(|row| &row[..size[0] as usize * 4]).copied().collect();
        RgbaImage::from_raw(size[0], size[1], texels).ok_or_else(|| RenderError::ReadBack("the picture came back too short".into()))
    }
}

async fn open_device() -> Result<(wgpu::AdapterInfo, wgpu::Device, wgpu::Queue), RenderError> {
    let instance = wgpu::Instance::new(wgpu::InstanceDescriptor::new_without_display_handle_from_env());
    let adapter = wgpu::util::initialize_adapter_from_env_or_default(&instance, None)
        .await
        .map_err(|error| RenderError::NoAdapter(error.to_string()))?;
    let info = adapter.get_info();
    let (device, queue) = adapter
        .request_device(&wgpu::DeviceDescriptor {
            label: Some("rhytid headless"),
            required_limits: required_limits(&adapter),
            ..Default::default()
        })
        .await
        .map_err(|error| RenderError::NoDevice { adapter: info.name.clone(), problem: error.to_string() })?;
    Ok((info, device, queue))
}

/// What WebGL2 guarantees, with textures as large as the adapter has them.
pub fn required_limits(adapter: &wgpu::Adapter) -> wgpu::Limits {
    wgpu::Limits::downlevel_webgl2_defaults().using_resolution(adapter.limits())
}
