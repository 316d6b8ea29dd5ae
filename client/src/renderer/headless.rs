//! Pictures without a window.

use super::device::{optional_features, required_limits};
use super::picture_texture::picture_texture;
use super::read_back::read_back;
use super::{DrawSettings, MapPool, Pass, PassTimer, RenderFrame, Renderer};
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
    /// The device has not the memory for a picture of this size.
    #[error("a picture of {}x{} pixels needs more memory than the GPU adapter gives", got[0], got[1])]
    OutOfMemory {
        /// What was asked for.
        got: [u32; 2],
    },
    /// A mistake in what was drawn.
    #[error("the GPU device refuses the picture: {0}")]
    Invalid(String),
    /// The device was lost.
    #[error("reading the picture back failed: {0}")]
    ReadBack(String),
}

/// Which adapter draws.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum AdapterChoice {
    /// What the machine offers first.
    Default,
    /// A software one, which draws the same on every machine but for its version.
    Software,
}

/// A device without a surface, and one character on it.
#[derive(Debug)]
pub struct Headless {
    adapter: wgpu::AdapterInfo,
    device: wgpu::Device,
    queue: wgpu::Queue,
    pool: MapPool,
    renderer: Renderer,
}

/// What pictures are drawn into: sRGB-encoded by the hardware, as a window's surface mostly is.
const FORMAT: wgpu::TextureFormat = wgpu::TextureFormat::Rgba8UnormSrgb;

impl Headless {
    /// Opens the default adapter (`WGPU_ADAPTER_NAME` and `WGPU_BACKEND` choose another) and uploads the character.
    pub fn new(asset: &CharacterAsset) -> Result<Self, RenderError> {
        Self::on(asset, AdapterChoice::Default)
    }

    /// Opens the adapter asked for and uploads the character.
    pub fn on(asset: &CharacterAsset, choice: AdapterChoice) -> Result<Self, RenderError> {
        let (adapter, device, queue) = pollster::block_on(open_device(choice))?;
        let pool = MapPool::new();
        let renderer = Renderer::new(&device, &queue, &pool, asset, FORMAT);
        Ok(Self { adapter, device, queue, pool, renderer })
    }

    /// Another character on the same device; maps that both have are there once.
    pub fn beside(&self, asset: &CharacterAsset) -> Self {
        let renderer = Renderer::new(&self.device, &self.queue, &self.pool, asset, FORMAT);
        Self { adapter: self.adapter.clone(), device: self.device.clone(), queue: self.queue.clone(), pool: self.pool.clone(), renderer }
    }

    /// What draws.
    pub fn adapter(&self) -> &wgpu::AdapterInfo {
        &self.adapter
    }

    /// The device, for who draws more than pictures.
    pub fn device(&self) -> (&wgpu::Device, &wgpu::Queue) {
        (&self.device, &self.queue)
    }

    /// The maps of all characters on the device.
    pub fn pool(&self) -> &MapPool {
        &self.pool
    }

    /// Draws one picture and waits for it.
    pub fn render(&mut self, size: [u32; 2], settings: &DrawSettings, frame: &RenderFrame) -> Result<RgbaImage, RenderError> {
        // Without scopes wgpu's own handler would end the program. What uses a texture there was no memory for is invalid, too.
        let consequences = self.device.push_error_scope(wgpu::ErrorFilter::Validation);
        let memory = self.device.push_error_scope(wgpu::ErrorFilter::OutOfMemory);
        let target = self.target(size)?;
        let encoder = self.record(&target, size, settings, frame, None);
        if pollster::block_on(memory.pop()).is_some() {
            return Err(RenderError::OutOfMemory { got: size });
        }
        if let Some(error) = pollster::block_on(consequences.pop()) {
            return Err(RenderError::Invalid(error.to_string()));
        }
        read_back(&self.device, &self.queue, encoder, &target, size)
    }

    /// Draws one picture, waits for it and drops it: for who measures drawing.
    pub fn draw_only(&mut self, size: [u32; 2], settings: &DrawSettings, frame: &RenderFrame) -> Result<(), RenderError> {
        let target = self.target(size)?;
        let encoder = self.record(&target, size, settings, frame, None);
        self.queue.submit([encoder.finish()]);
        self.wait()
    }

    /// Draws one picture and gives the milliseconds each pass took on the device, in the order of [`Pass::ALL`]; `None`
    /// where it has no time stamps.
    pub fn pass_times(
        &mut self,
        size: [u32; 2],
        settings: &DrawSettings,
        frame: &RenderFrame,
    ) -> Result<Option<[f64; Pass::ALL.len()]>, RenderError> {
        let Some(timer) = PassTimer::new(&self.device, &self.queue) else { return Ok(None) };
        let target = self.target(size)?;
        let mut encoder = self.record(&target, size, settings, frame, Some(&timer));
        let buffer = timer.resolve(&self.device, &mut encoder);
        self.queue.submit([encoder.finish()]);
        let (sender, receiver) = std::sync::mpsc::channel();
        buffer.map_async(wgpu::MapMode::Read, .., move |result| {
            // Whoever waited has gone if this fails.
            let _ = sender.send(result);
        });
        self.wait()?;
        let mapped = receiver.recv().map_err(|error| error.to_string()).and_then(|result| result.map_err(|error| error.to_string()));
        mapped.map_err(RenderError::ReadBack)?;
        let range = buffer.get_mapped_range(..).map_err(|error| RenderError::ReadBack(error.to_string()))?;
        let stamps: Vec<u64> = bytemuck::pod_collect_to_vec(&range);
        Ok(Some(timer.milliseconds(&stamps)))
    }

    /// Bytes of the zones' masks and of their wrinkle map.
    pub fn zone_bytes(&self) -> u64 {
        self.renderer.zone_bytes()
    }

    /// Draw calls of the last picture.
    pub fn num_draws(&self) -> u32 {
        self.renderer.num_draws()
    }

    /// Bytes of buffers and textures the renderer uses on the device, shared ones included.
    pub fn gpu_bytes(&self) -> u64 {
        self.renderer.gpu_bytes()
    }

    /// Of those, bytes of maps that another character on the device uses as well.
    pub fn shared_bytes(&self) -> u64 {
        self.renderer.shared_bytes()
    }

    fn target(&self, size: [u32; 2]) -> Result<wgpu::Texture, RenderError> {
        let most = self.device.limits().max_texture_dimension_2d;
        if size.iter().any(|&side| side == 0 || side > most) {
            return Err(RenderError::Size { got: size, most });
        }
        Ok(picture_texture(&self.device, "headless picture", size, FORMAT, wgpu::TextureUsages::COPY_SRC))
    }

    fn record(
        &mut self,
        target: &wgpu::Texture,
        size: [u32; 2],
        settings: &DrawSettings,
        frame: &RenderFrame,
        timer: Option<&PassTimer>,
    ) -> wgpu::CommandEncoder {
        let mut encoder = self.device.create_command_encoder(&wgpu::CommandEncoderDescriptor { label: Some("headless frame") });
        let view = target.create_view(&wgpu::TextureViewDescriptor::default());
        self.renderer.draw(&self.device, &self.queue, &mut encoder, &view, size, settings, frame, timer);
        encoder
    }

    fn wait(&self) -> Result<(), RenderError> {
        self.device.poll(wgpu::PollType::wait_indefinitely()).map(drop).map_err(|error| RenderError::ReadBack(error.to_string()))
    }
}

async fn open_device(choice: AdapterChoice) -> Result<(wgpu::AdapterInfo, wgpu::Device, wgpu::Queue), RenderError> {
    let instance = wgpu::Instance::new(wgpu::InstanceDescriptor::new_without_display_handle_from_env());
    let adapter = match choice {
        AdapterChoice::Default => wgpu::util::initialize_adapter_from_env_or_default(&instance, None).await,
        AdapterChoice::Software => {
            instance.request_adapter(&wgpu::RequestAdapterOptions { force_fallback_adapter: true, ..Default::default() }).await
        }
    }
    .map_err(|error| RenderError::NoAdapter(error.to_string()))?;
    let info = adapter.get_info();
    let (device, queue) = adapter
        .request_device(&wgpu::DeviceDescriptor {
            label: Some("rhytid headless"),
            required_features: optional_features(&adapter) | (adapter.features() & wgpu::Features::TIMESTAMP_QUERY),
            required_limits: required_limits(&adapter),
            ..Default::default()
        })
        .await
        .map_err(|error| RenderError::NoDevice { adapter: info.name.clone(), problem: error.to_string() })?;
    Ok((info, device, queue))
}
