//! The window's GPU side: surface, device, renderer, panel.

use super::WindowError;
use super::look;
use super::painter::Painter;
use super::panel::{self, Scene};
use super::switches::Switches;
use crate::asset::CharacterAsset;
use crate::renderer::{MapPool, RenderError, RenderFrame, Renderer, optional_features, picture_texture, read_back, required_limits};
use image::RgbaImage;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use winit::event::WindowEvent;
use winit::event_loop::ActiveEventLoop;
use winit::window::{Fullscreen, Window};

/// The face is drawn into this, then put into the window by egui, which wants it so.
const FACE_FORMAT: wgpu::TextureFormat = wgpu::TextureFormat::Rgba8Unorm;

/// Everything that goes with one window.
pub(super) struct GpuWindow {
    // Before the window: what is declared first is dropped first.
    surface: wgpu::Surface<'static>,
    window: Arc<Window>,
    instance: wgpu::Instance,
    surface_config: wgpu::SurfaceConfiguration,
    /// The window has an area; a minimised one may have none.
    has_area: bool,
    /// The picture being drawn is not of the kind the surface likes best: it wants to be configured after it.
    is_suboptimal: bool,
    /// Set by wgpu when the device is gone: a driver that was updated or crashed, a GPU that was unplugged.
    is_lost: Arc<AtomicBool>,
    adapter_name: String,
    is_software: bool,
    device: wgpu::Device,
    queue: wgpu::Queue,
    pool: MapPool,
    renderer: Renderer,
    face: FaceTexture,
    egui: egui_winit::State,
    painter: Painter,
}

struct FaceTexture {
    view: wgpu::TextureView,
    size: [u32; 2],
    id: egui::TextureId,
}

/// What there is to draw into.
#[derive(Debug)]
pub(super) enum Canvas {
    /// The next picture of the window.
    Ready(wgpu::SurfaceTexture),
    /// The surface had changed or was not ready; ask again.
    Again,
    /// Nobody can see the window now.
    Hidden,
    /// The device is gone, and with it everything but the window.
    DeviceLost,
}

impl GpuWindow {
    /// Opens a surface on `window`, which must have no other, and uploads the character.
    pub(super) fn new(event_loop: &ActiveEventLoop, window: Arc<Window>, asset: &CharacterAsset) -> Result<Self, WindowError> {
        let display = Box::new(event_loop.owned_display_handle());
        let instance = wgpu::Instance::new(wgpu::InstanceDescriptor::new_with_display_handle_from_env(display));
        let surface = instance.create_surface(Arc::clone(&window)).map_err(|error| WindowError::Surface(error.to_string()))?;
        let adapter = pollster::block_on(wgpu::util::initialize_adapter_from_env_or_default(&instance, Some(&surface)))
            .map_err(|error| RenderError::NoAdapter(error.to_string()))?;
        let info = adapter.get_info();
        let descriptor = wgpu::DeviceDescriptor {
            label: Some("rhytid window"),
            required_features: optional_features(&adapter),
            required_limits: required_limits(&adapter),
            ..Default::default()
        };
        let (device, queue) = pollster::block_on(adapter.request_device(&descriptor))
            .map_err(|error| RenderError::NoDevice { adapter: info.name.clone(), problem: error.to_string() })?;

        let is_lost = watch(&device);

        let size = window.inner_size();
        let mut surface_config = surface
            .get_default_config(&adapter, size.width.max(1), size.height.max(1))
            .ok_or_else(|| WindowError::Surface(format!("adapter {:?} cannot draw to this display", info.name)))?;
        // egui blends encoded colours; a format that does not encode by itself spares it the way there and back.
        let formats = surface.get_capabilities(&adapter).formats;
        if let Some(&format) =
            formats.iter().find(|format| matches!(format, wgpu::TextureFormat::Bgra8Unorm | wgpu::TextureFormat::Rgba8Unorm))
        {
            surface_config.format = format;
        }
        surface_config.present_mode = wgpu::PresentMode::AutoVsync;
        surface_config.desired_maximum_frame_latency = 2;
        surface.configure(&device, &surface_config);
        tracing::info!(adapter = info.name, backend = %info.backend, format = ?surface_config.format, "drawing in a window");

        let context = egui::Context::default();
        look::apply(&context);
        let egui = egui_winit::State::new(
            context,
            egui::ViewportId::ROOT,
            event_loop,
            Some(window.scale_factor() as f32),
            None,
            Some(device.limits().max_texture_dimension_2d as usize),
        );
        let mut painter = Painter::new(&device, surface_config.format);
        let pool = MapPool::new();
        let renderer = Renderer::new(&device, &queue, &pool, asset, FACE_FORMAT);
        let face = FaceTexture::new(&device, &mut painter, [1, 1], None);
        Ok(Self {
            surface,
            window,
            instance,
            surface_config,
            has_area: size.width > 0 && size.height > 0,
            is_suboptimal: false,
            is_lost,
            is_software: info.device_type == wgpu::DeviceType::Cpu,
            adapter_name: info.name,
            device,
            queue,
            pool,
            renderer,
            face,
            egui,
            painter,
        })
    }

    /// The window alone; everything on the device is dropped.
    pub(super) fn into_window(self) -> Arc<Window> {
        self.window
    }

    /// Bytes of the zones' masks and of their wrinkle map.
    pub(super) fn zone_bytes(&self) -> u64 {
        self.renderer.zone_bytes()
    }

    /// The window itself.
    pub(super) fn window(&self) -> &Window {
        &self.window
    }

    /// Lets egui have an event; true where the picture changes by it.
    pub(super) fn on_event(&mut self, event: &WindowEvent) -> bool {
        self.egui.on_window_event(&self.window, event).repaint
    }

    /// Follows the window's size.
    pub(super) fn resize(&mut self, width: u32, height: u32) {
        self.has_area = width > 0 && height > 0;
        if !self.has_area {
            return;
        }
        let most = self.device.limits().max_texture_dimension_2d;
        (self.surface_config.width, self.surface_config.height) = (width.min(most), height.min(most));
        self.surface.configure(&self.device, &self.surface_config);
    }

    /// Draws another character from now on.
    pub(super) fn change_character(&mut self, asset: &CharacterAsset) {
        self.renderer.change_character(&self.device, &self.queue, &self.pool, asset);
    }

    /// What draws.
    pub(super) fn adapter_name(&self) -> &str {
        &self.adapter_name
    }

    /// egui's name of the face's picture.
    pub(super) fn face_id(&self) -> egui::TextureId {
        self.face.id
    }

    /// True while egui still animates something.
    pub(super) fn is_panel_moving(&self) -> bool {
        self.egui.egui_ctx().has_requested_repaint()
    }

    /// Waits until there is something to draw into. What is drawn shall be sampled after this: the wait may take a whole
    /// picture's time.
    pub(super) fn acquire(&mut self) -> Result<Canvas, WindowError> {
        if self.is_lost.load(Ordering::SeqCst) {
            return Ok(Canvas::DeviceLost);
        }
        if !self.has_area {
            return Ok(Canvas::Hidden);
        }
        match self.surface.get_current_texture() {
            wgpu::CurrentSurfaceTexture::Success(texture) => Ok(Canvas::Ready(texture)),
            wgpu::CurrentSurfaceTexture::Suboptimal(texture) => {
                self.is_suboptimal = true;
                Ok(Canvas::Ready(texture))
            }
            wgpu::CurrentSurfaceTexture::Outdated => {
                self.surface.configure(&self.device, &self.surface_config);
                Ok(Canvas::Again)
            }
            wgpu::CurrentSurfaceTexture::Lost => {
                self.surface =
                    self.instance.create_surface(Arc::clone(&self.window)).map_err(|error| WindowError::Surface(error.to_string()))?;
                self.surface.configure(&self.device, &self.surface_config);
                Ok(Canvas::Again)
            }
            wgpu::CurrentSurfaceTexture::Timeout => Ok(Canvas::Again),
            wgpu::CurrentSurfaceTexture::Occluded => Ok(Canvas::Hidden),
            wgpu::CurrentSurfaceTexture::Validation if self.is_just_lost() => Ok(Canvas::DeviceLost),
            wgpu::CurrentSurfaceTexture::Validation => Err(WindowError::Surface("the surface gave no picture to draw into".into())),
        }
    }

    /// A device that is lost between two pictures gives no canvas first, and says why when it is asked for its news.
    fn is_just_lost(&self) -> bool {
        let news = self.device.poll(wgpu::PollType::Poll);
        news.is_err() || self.is_lost.load(Ordering::SeqCst)
    }

    /// Lays out and draws one picture of the window into `canvas`, and shows it.
    pub(super) fn draw(&mut self, canvas: wgpu::SurfaceTexture, scene: &Scene<'_>, switches: &mut Switches) {
        let (primitives, pixels_per_point, freed) = self.lay_out(scene, switches);
        let view = canvas.texture.create_view(&wgpu::TextureViewDescriptor::default());
        let encoder = self.record(&view, &primitives, pixels_per_point, scene.frame, switches);
        self.queue.submit([encoder.finish()]);
        self.painter.free(freed);
        self.window.pre_present_notify();
        self.queue.present(canvas);
        if std::mem::take(&mut self.is_suboptimal) {
            self.surface.configure(&self.device, &self.surface_config);
        }
    }

    /// Draws the window's picture and returns it instead of showing it.
    pub(super) fn screenshot(&mut self, scene: &Scene<'_>, switches: &mut Switches) -> Result<RgbaImage, WindowError> {
        let (primitives, pixels_per_point, freed) = self.lay_out(scene, switches);
        let size = [self.surface_config.width, self.surface_config.height];
        let texture = picture_texture(&self.device, "screenshot", size, self.surface_config.format, wgpu::TextureUsages::COPY_SRC);
        let view = texture.create_view(&wgpu::TextureViewDescriptor::default());
        let encoder = self.record(&view, &primitives, pixels_per_point, scene.frame, switches);
        let mut picture = read_back(&self.device, &self.queue, encoder, &texture, size)?;
        self.painter.free(freed);
        if matches!(self.surface_config.format, wgpu::TextureFormat::Bgra8Unorm | wgpu::TextureFormat::Bgra8UnormSrgb) {
            picture.pixels_mut().for_each(|pixel| pixel.0.swap(0, 2));
        }
        // What lies behind the window does not belong to it.
        picture.pixels_mut().for_each(|pixel| pixel.0[3] = 255);
        Ok(picture)
    }

    fn lay_out(&mut self, scene: &Scene<'_>, switches: &mut Switches) -> (Vec<egui::ClippedPrimitive>, f32, egui::TexturesDelta) {
        let was_full_screen = switches.is_full_screen;
        let input = self.egui.take_egui_input(&self.window);
        let context = self.egui.egui_ctx().clone();
        let mut face_rect = egui::Rect::ZERO;
        let mut output = context.run_ui(input, |ui| face_rect = panel::show(ui, scene, switches));
        self.egui.handle_platform_output(&self.window, output.platform_output);
        if switches.is_full_screen != was_full_screen {
            self.window.set_fullscreen(switches.is_full_screen.then_some(Fullscreen::Borderless(None)));
        }
        let most = self.device.limits().max_texture_dimension_2d;
        let pixels = |points: f32| ((points * output.pixels_per_point).round() as u32).clamp(1, most);
        // A processor that draws has the time for a quarter of the pixels.
        let share = if self.is_software { 0.5 } else { 1.0 };
        let face_size = [pixels(face_rect.width() * share), pixels(face_rect.height() * share)];
        if self.face.size != face_size {
            self.face = FaceTexture::new(&self.device, &mut self.painter, face_size, Some(self.face.id));
        }
        self.painter.upload(&self.device, &self.queue, &mut output.textures_delta);
        (context.tessellate(output.shapes, output.pixels_per_point), output.pixels_per_point, output.textures_delta)
    }

    fn record(
        &mut self,
        target: &wgpu::TextureView,
        primitives: &[egui::ClippedPrimitive],
        pixels_per_point: f32,
        frame: &RenderFrame,
        switches: &Switches,
    ) -> wgpu::CommandEncoder {
        let mut encoder = self.device.create_command_encoder(&wgpu::CommandEncoderDescriptor { label: Some("window") });
        self.renderer.draw(&self.device, &self.queue, &mut encoder, &self.face.view, self.face.size, &switches.draw, frame, None);
        let size = [self.surface_config.width, self.surface_config.height];
        self.painter.paint(&self.device, &self.queue, &mut encoder, target, size, pixels_per_point, primitives);
        encoder
    }
}

/// Says in the log what wgpu complains of (its own handler would end the program), and sets the flag returned when the
/// device is gone.
fn watch(device: &wgpu::Device) -> Arc<AtomicBool> {
    let has_complained = AtomicBool::new(false);
    device.on_uncaptured_error(Arc::new(move |error: wgpu::Error| {
        // What is wrong with one picture is wrong with the next.
        if has_complained.swap(true, Ordering::SeqCst) {
            tracing::debug!(%error, "wgpu");
        } else {
            tracing::error!(%error, "wgpu");
        }
    }));
    let is_lost = Arc::new(AtomicBool::new(false));
    let flag = Arc::clone(&is_lost);
    device.set_device_lost_callback(move |reason, message| {
        tracing::warn!(?reason, message, "the GPU device is gone");
        flag.store(true, Ordering::SeqCst);
    });
    is_lost
}

impl FaceTexture {
    fn new(device: &wgpu::Device, painter: &mut Painter, size: [u32; 2], id: Option<egui::TextureId>) -> Self {
        let texture = picture_texture(device, "face in the window", size, FACE_FORMAT, wgpu::TextureUsages::TEXTURE_BINDING);
        let view = texture.create_view(&wgpu::TextureViewDescriptor::default());
        let id = painter.register(device, &view, id);
        Self { view, size, id }
    }
}
