//! The canvas's GPU side: surface, device, renderer.

use crate::asset::CharacterAsset;
use crate::renderer::{DrawSettings, MapPool, RenderFrame, Renderer, required_limits};
use rhytid_shared::Character;
use std::sync::{Arc, Mutex, PoisonError};

/// Why a canvas cannot be drawn into.
#[derive(Debug, thiserror::Error)]
pub(super) enum CanvasError {
    #[error("backend {0:?} is unknown, expected auto, webgpu or webgl")]
    Backend(String),
    #[error("this browser draws neither with WebGPU nor with WebGL2 ({0})")]
    NoAdapter(String),
    #[error("the graphics adapter gives no device: {0}")]
    NoDevice(String),
    #[error("the canvas cannot be drawn into: {0}")]
    Surface(String),
    #[error("the graphics device is gone: {0}")]
    Lost(String),
}

/// Everything that goes with one canvas.
pub(super) struct Canvas {
    surface: wgpu::Surface<'static>,
    config: wgpu::SurfaceConfiguration,
    /// What the surface's pictures are seen as by what is drawn.
    view_format: wgpu::TextureFormat,
    device: wgpu::Device,
    queue: wgpu::Queue,
    adapter: String,
    backend: &'static str,
    pool: MapPool,
    renderer: Option<Renderer>,
    /// Set when the device is gone or something drawn was refused.
    failure: Arc<Mutex<Option<String>>>,
}

impl Canvas {
    pub async fn open(canvas: web_sys::HtmlCanvasElement, backend: &str, is_transparent: bool) -> Result<Self, CanvasError> {
        let backends = match backend {
            "auto" => wgpu::Backends::BROWSER_WEBGPU | wgpu::Backends::GL,
            "webgpu" => wgpu::Backends::BROWSER_WEBGPU,
            "webgl" => wgpu::Backends::GL,
            other => return Err(CanvasError::Backend(other.into())),
        };
        let (width, height) = (canvas.width().max(1), canvas.height().max(1));
        let descriptor = wgpu::InstanceDescriptor { backends, ..wgpu::InstanceDescriptor::new_without_display_handle() };
        // A browser may have WebGPU's objects but no adapter behind them: then WebGL2 draws.
        let instance = wgpu::util::new_instance_with_webgpu_detection(descriptor).await;
        let surface =
            instance.create_surface(wgpu::SurfaceTarget::Canvas(canvas)).map_err(|error| CanvasError::Surface(error.to_string()))?;
        let adapter = instance
            .request_adapter(&wgpu::RequestAdapterOptions { compatible_surface: Some(&surface), ..Default::default() })
            .await
            .map_err(|error| CanvasError::NoAdapter(error.to_string()))?;
        let info = adapter.get_info();
        let (device, queue) = adapter
            .request_device(&wgpu::DeviceDescriptor {
                label: Some("rhytid canvas"),
                // Compressing the masks would take a browser longer than all the rest together.
                required_features: wgpu::Features::empty(),
                required_limits: required_limits(&adapter),
                ..Default::default()
            })
            .await
            .map_err(|error| CanvasError::NoDevice(error.to_string()))?;
        let failure = Arc::new(Mutex::new(None));
        let note = {
            let failure = failure.clone();
            move |problem: String| {
                // The first says most.
                failure.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(problem);
            }
        };
        device.set_device_lost_callback({
            let note = note.clone();
            move |_, why| note(why)
        });
        device.on_uncaptured_error(Arc::new(move |error| note(error.to_string())));
        let capabilities = surface.get_capabilities(&adapter);
        let mut config = surface
            .get_default_config(&adapter, width, height)
            .ok_or_else(|| CanvasError::Surface("the adapter cannot draw to it".into()))?;
        // The last pass encodes by itself where the format does not.
        if let Some(&format) = capabilities.formats.iter().find(|format| !format.is_srgb()) {
            config.format = format;
        }
        config.alpha_mode = if is_transparent && capabilities.alpha_modes.contains(&wgpu::CompositeAlphaMode::PreMultiplied) {
            wgpu::CompositeAlphaMode::PreMultiplied
        } else if capabilities.alpha_modes.contains(&wgpu::CompositeAlphaMode::Opaque) {
            wgpu::CompositeAlphaMode::Opaque
        } else {
            capabilities.alpha_modes[0]
        };
        surface.configure(&device, &config);
        Ok(Self {
            view_format: config.format,
            surface,
            config,
            device,
            queue,
            adapter: info.name,
            backend: if info.backend == wgpu::Backend::BrowserWebGpu { "WebGPU" } else { "WebGL2" },
            pool: MapPool::new(),
            renderer: None,
            failure,
        })
    }

    pub fn backend(&self) -> &'static str {
        self.backend
    }

    pub fn adapter(&self) -> &str {
        &self.adapter
    }

    pub fn failure(&self) -> Option<String> {
        self.failure.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    pub fn character(&self) -> Option<Arc<Character>> {
        self.renderer.as_ref().map(|renderer| renderer.character().clone())
    }

    pub fn gpu_bytes(&self) -> u64 {
        self.renderer.as_ref().map_or(0, Renderer::gpu_bytes)
    }

    pub fn height(&self) -> u32 {
        self.config.height
    }

    /// Draws `asset` from now on.
    pub fn upload(&mut self, asset: &CharacterAsset) {
        match &mut self.renderer {
            Some(renderer) => renderer.change_character(&self.device, &self.queue, &self.pool, asset),
            None => self.renderer = Some(Renderer::new(&self.device, &self.queue, &self.pool, asset, self.view_format)),
        }
    }

    /// Draws a small picture that nobody sees: a browser compiles what draws while the page goes on, and only once it is used.
    pub fn rehearse(&mut self, settings: &DrawSettings, frame: &RenderFrame) {
        let Some(renderer) = &mut self.renderer else { return };
        let side = 16;
        let picture = self.device.create_texture(&wgpu::TextureDescriptor {
            label: Some("rehearsal"),
            size: wgpu::Extent3d { width: side, height: side, depth_or_array_layers: 1 },
            mip_level_count: 1,
            sample_count: 1,
            dimension: wgpu::TextureDimension::D2,
            format: self.view_format,
            usage: wgpu::TextureUsages::RENDER_ATTACHMENT,
            view_formats: &[],
        });
        let view = picture.create_view(&wgpu::TextureViewDescriptor::default());
        let mut encoder = self.device.create_command_encoder(&wgpu::CommandEncoderDescriptor { label: Some("rehearsal") });
        renderer.draw(&self.device, &self.queue, &mut encoder, &view, [side; 2], settings, frame, None);
        self.queue.submit([encoder.finish()]);
    }

    pub fn resize(&mut self, width: u32, height: u32) {
        let most = self.device.limits().max_texture_dimension_2d;
        let size = (width.clamp(1, most), height.clamp(1, most));
        if size != (self.config.width, self.config.height) {
            (self.config.width, self.config.height) = size;
            self.surface.configure(&self.device, &self.config);
        }
    }

    /// Draws one picture; false where the browser has none to draw into now.
    pub fn draw(&mut self, settings: &DrawSettings, frame: &RenderFrame) -> Result<bool, CanvasError> {
        if let Some(problem) = self.failure() {
            return Err(CanvasError::Lost(problem));
        }
        let Some(renderer) = &mut self.renderer else { return Ok(false) };
        let picture = match self.surface.get_current_texture() {
            wgpu::CurrentSurfaceTexture::Success(picture) | wgpu::CurrentSurfaceTexture::Suboptimal(picture) => picture,
            wgpu::CurrentSurfaceTexture::Outdated | wgpu::CurrentSurfaceTexture::Lost => {
                self.surface.configure(&self.device, &self.config);
                return Ok(false);
            }
            _ => return Ok(false),
        };
        let view = picture.texture.create_view(&wgpu::TextureViewDescriptor::default());
        let mut encoder = self.device.create_command_encoder(&wgpu::CommandEncoderDescriptor { label: Some("canvas frame") });
        let size = [self.config.width, self.config.height];
        renderer.draw(&self.device, &self.queue, &mut encoder, &view, size, settings, frame, None);
        self.queue.submit([encoder.finish()]);
        self.queue.present(picture);
        Ok(true)
    }
}
