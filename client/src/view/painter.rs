//! Puts an egui picture on a texture.

use egui_wgpu::{RendererOptions, ScreenDescriptor};

/// egui's renderer on one device, for targets of one format.
pub(crate) struct Painter {
    renderer: egui_wgpu::Renderer,
}

impl Painter {
    /// For targets of `format`.
    pub(crate) fn new(device: &wgpu::Device, format: wgpu::TextureFormat) -> Self {
        Self { renderer: egui_wgpu::Renderer::new(device, format, RendererOptions::default()) }
    }

    /// Makes `texture` (format `Rgba8Unorm`, encoded for the screen) known to egui, under `id` where it has one already.
    pub(crate) fn register(&mut self, device: &wgpu::Device, texture: &wgpu::TextureView, id: Option<egui::TextureId>) -> egui::TextureId {
        match id {
            None => self.renderer.register_native_texture(device, texture, wgpu::FilterMode::Linear),
            Some(id) => {
                self.renderer.update_egui_texture_from_wgpu_texture(device, texture, wgpu::FilterMode::Linear, id);
                id
            }
        }
    }

    /// Uploads egui's new textures. Every output needs this, drawn or not.
    pub(crate) fn upload(&mut self, device: &wgpu::Device, queue: &wgpu::Queue, textures: &mut egui::TexturesDelta) {
        for (id, deltas) in std::mem::take(&mut textures.set) {
            for delta in &deltas {
                self.renderer.update_texture(device, queue, id, delta);
            }
        }
    }

    /// Frees textures egui no longer uses, once what used them is submitted.
    pub(crate) fn free(&mut self, mut textures: egui::TexturesDelta) {
        for id in std::mem::take(&mut textures.free) {
            self.renderer.free_texture(&id);
        }
    }

    /// Records the drawing of `primitives` over `target`, which is cleared to black and `size` pixels large.
    #[allow(clippy::too_many_arguments, reason = "the wgpu handles come with every call of this kind")]
    pub(crate) fn paint(
        &mut self,
        device: &wgpu::Device,
        queue: &wgpu::Queue,
        encoder: &mut wgpu::CommandEncoder,
        target: &wgpu::TextureView,
        size: [u32; 2],
        pixels_per_point: f32,
        primitives: &[egui::ClippedPrimitive],
    ) {
        let screen = ScreenDescriptor { size_in_pixels: size, pixels_per_point };
        let from_callbacks = self.renderer.update_buffers(device, queue, encoder, primitives, &screen);
        debug_assert!(from_callbacks.is_empty(), "nothing here paints by callback");
        let pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
            label: Some("panel"),
            color_attachments: &[Some(wgpu::RenderPassColorAttachment {
                view: target,
                depth_slice: None,
                resolve_target: None,
                ops: wgpu::Operations { load: wgpu::LoadOp::Clear(wgpu::Color::BLACK), store: wgpu::StoreOp::Store },
            })],
            depth_stencil_attachment: None,
            timestamp_writes: None,
            occlusion_query_set: None,
            multiview_mask: None,
        });
        self.renderer.render(&mut pass.forget_lifetime(), primitives, &screen);
    }
}
