//! Draws a character with wgpu: no storage buffers, no compute, within WebGL2's limits.

mod anatomy;
mod background;
mod blood;
mod camera;
mod coefficients;
mod deformation;
mod device;
mod environment;
mod frame;
mod fullscreen;
#[cfg(not(target_arch = "wasm32"))]
mod headless;
mod layouts;
mod map_pool;
mod model;
mod picture_texture;
mod pipelines;
mod present;
#[cfg(not(target_arch = "wasm32"))]
mod read_back;
mod regions;
pub mod scattering;
mod shadow;
mod studio;
mod targets;
mod timing;
mod tone;
pub mod uniforms;
mod upload;
mod view;
mod zones;

pub use camera::Camera;
use coefficients::active_poses;
pub use coefficients::{bone_major, moves_bone, pose_table};
pub use deformation::{Deformation, DeformationError};
pub use device::{optional_features, required_limits};
pub use frame::RenderFrame;
#[cfg(not(target_arch = "wasm32"))]
pub use headless::{AdapterChoice, Headless, RenderError};
pub use map_pool::MapPool;
#[cfg(not(target_arch = "wasm32"))]
pub use picture_texture::picture_texture;
pub use pipelines::VERTEX_LAYOUT;
#[cfg(not(target_arch = "wasm32"))]
pub(crate) use read_back::read_back;
pub use studio::{Studio, StudioError};
pub use timing::{Pass, PassTimer};
pub use view::{BlendError, BlendMode, NameError, Term, ViewError, ViewMode, WrinkleSystem, ZoneBlend};

use crate::asset::{CharacterAsset, Surface};
use anatomy::{Lids, Mouth, eyeballs, gazes};
use glam::Vec3;
use layouts::Layouts;
use model::Model;
use pipelines::{Key, Look, Pipelines, Wire};
use present::Presenter;
use rhytid_shared::Character;
use rhytid_shared::character::Side;
use scattering::{Lens, Scattering};
use shadow::Shadow;
use std::sync::Arc;
use targets::Targets;
use tone::{Shown, Tone};
use upload::Uploader;

/// What one drawing shows and how; changes nothing in the renderer.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DrawSettings {
    /// Where from.
    pub camera: Camera,
    /// What.
    pub view: ViewMode,
    /// What deforms the face.
    pub deform: Deformation,
    /// How wrinkle maps become normals.
    pub blend: BlendMode,
    /// Off: every influence counts as 0, but the pipeline with the wrinkle code draws.
    pub wrinkles: bool,
    /// Whose wrinkles are drawn.
    pub system: WrinkleSystem,
    /// How the zones' wrinkles are blended.
    pub zone_blend: ZoneBlend,
    /// Multiplies the light before the tone map; 1 is the studio's own.
    pub exposure: f32,
    /// Set-up of lights.
    pub studio: Studio,
    /// Turn of the key light about +Y from where the set-up has it, radians.
    pub key_turn: f32,
    /// How skin takes light.
    pub skin: SkinSettings,
    /// Standard deviation of film grain in the middle tones, 0 to 0.1 of the display's range.
    pub grain: f32,
    /// Edges are smoothed after the tone map.
    pub is_smoothed: bool,
    /// No wall is drawn; the picture's alpha is how much of each pixel is covered, its colour is multiplied with that.
    pub is_transparent: bool,
}

/// How skin takes light. Each is 1 for human skin unless it says otherwise.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SkinSettings {
    /// How far light spreads under the skin; 0 leaves the scattering out.
    pub scattering: f32,
    /// How much light shines through thin flesh.
    pub translucency: f32,
    /// Strength of highlights.
    pub gloss: f32,
    /// Multiplies the roughness of the map.
    pub roughness: f32,
    /// How strongly its colour follows the face; 0 leaves it as it is at rest.
    pub blood: f32,
}

impl Default for SkinSettings {
    fn default() -> Self {
        Self { scattering: 1.0, translucency: 1.0, gloss: 1.0, roughness: 1.0, blood: 1.0 }
    }
}

impl DrawSettings {
    /// Beauty with wrinkles through `camera`.
    pub fn new(camera: Camera) -> Self {
        Self {
            camera,
            view: ViewMode::Beauty,
            deform: Deformation::Bones,
            blend: BlendMode::PartialDerivatives,
            wrinkles: true,
            system: WrinkleSystem::default(),
            zone_blend: ZoneBlend::default(),
            exposure: 1.0,
            studio: Studio::default(),
            key_turn: 0.0,
            skin: SkinSettings::default(),
            grain: 0.0,
            is_smoothed: true,
            is_transparent: false,
        }
    }
}

/// A character on a device, and all that draws it.
#[derive(Debug)]
pub struct Renderer {
    model: Model,
    layouts: Layouts,
    pipelines: Pipelines,
    background: wgpu::RenderPipeline,
    shadow: Shadow,
    environment: wgpu::Texture,
    /// What the environment's texture holds, and its irradiance.
    lit_by: Option<(Studio, [Vec3; 9])>,
    scattering: Scattering,
    tone: Tone,
    frame_block: wgpu::Buffer,
    frame_group: wgpu::BindGroup,
    frame_group_unlit: wgpu::BindGroup,
    presenter: Presenter,
    targets: Option<Targets>,
    /// Some zone of the picture being drawn is stretched.
    is_stretched: bool,
    /// Of the picture being drawn, pixels.
    height: u32,
    /// Pictures so far: the grain changes with it.
    num_drawn: u32,
    /// Draw calls of the last picture.
    num_draws: u32,
    target_format: wgpu::TextureFormat,
}

/// Metres from one furrow of the forehead to the next: where they cover less than a few pixels, wrinkles fade.
const FURROW_WAVELENGTH: f32 = 0.006;
/// How fast light dies in flesh, 1/mm: a translucency of 0.92, where the 0.83 of the demonstration of Jimenez and others
/// (2010) comes to 0.935 per mm. Tuned by eye on ears against the light.
const FLESH_PER_MM: f32 = 0.935 * (1.0 - 0.92) / (1.0 - 0.83);

impl Renderer {
    /// Uploads `asset` for pictures of `target_format` (any 8-bit RGBA or BGRA format,
    /// with or without sRGB encoding); maps that a character of the device's `pool` has are shared with it.
    /// Pipelines are built as views first need them.
    pub fn new(
        device: &wgpu::Device,
        queue: &wgpu::Queue,
        pool: &MapPool,
        asset: &CharacterAsset,
        target_format: wgpu::TextureFormat,
    ) -> Self {
        let layouts = Layouts::new(device);
        let model = Model::new(&mut Uploader::new(device, queue, pool), &layouts, asset);
        let frame_block = frame_block(device);
        let shadow = Shadow::new(device, &layouts);
        let environment = environment_texture(device);
        let frame_group = device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some("frame"),
            layout: &layouts.frame,
            entries: &[
                upload::entry(0, frame_block.as_entire_binding()),
                upload::entry(1, wgpu::BindingResource::TextureView(&shadow.map)),
                upload::entry(2, wgpu::BindingResource::Sampler(&shadow.sampler)),
                upload::entry(3, wgpu::BindingResource::TextureView(&shadow.depth_in_metres)),
                upload::entry(4, wgpu::BindingResource::TextureView(&environment.create_view(&wgpu::TextureViewDescriptor::default()))),
                upload::entry(5, wgpu::BindingResource::Sampler(&fullscreen::sampler(device))),
            ],
        });
        let frame_group_unlit = device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some("frame without shadow map"),
            layout: &layouts.frame_unlit,
            entries: &[upload::entry(0, frame_block.as_entire_binding())],
        });
        Self {
            pipelines: Pipelines::new(&layouts, asset.character.num_poses()),
            model,
            layouts,
            background: background::pipeline(device),
            shadow,
            environment,
            lit_by: None,
            scattering: Scattering::new(device),
            tone: Tone::new(device),
            frame_block,
            frame_group,
            frame_group_unlit,
            presenter: Presenter::new(device, target_format),
            targets: None,
            is_stretched: false,
            height: 1,
            num_drawn: 0,
            num_draws: 0,
            target_format,
        }
    }

    /// Draws another character from now on. What draws it stays, and so do maps that both have.
    pub fn change_character(&mut self, device: &wgpu::Device, queue: &wgpu::Queue, pool: &MapPool, asset: &CharacterAsset) {
        let model = Model::new(&mut Uploader::new(device, queue, pool), &self.layouts, asset);
        if model.character.num_poses() != self.model.character.num_poses() {
            self.pipelines = Pipelines::new(&self.layouts, model.character.num_poses());
        }
        self.model = model;
    }

    /// Records the drawing of `frame` into `target`, which is `size` pixels large and is overwritten.
    ///
    /// Submit what was recorded before the next call: a frame's uniforms are written to the queue here.
    /// A frame that does not fit the character ([`RenderFrame::fits`]) is drawn as the character at rest. With a `timer`
    /// each pass is stamped.
    #[allow(clippy::too_many_arguments, reason = "the four wgpu handles come with every call of this kind")]
    pub fn draw(
        &mut self,
        device: &wgpu::Device,
        queue: &wgpu::Queue,
        encoder: &mut wgpu::CommandEncoder,
        target: &wgpu::TextureView,
        size: [u32; 2],
        settings: &DrawSettings,
        frame: &RenderFrame,
        timer: Option<&PassTimer>,
    ) {
        let stamps = |pass: Pass| timer.map(|timer| timer.writes(pass));
        self.num_draws = 0;
        let size = size.map(|side| side.max(1));
        self.height = size[1];
        let targets = match self.targets.take() {
            Some(targets) if targets.size == size => targets,
            _ => Targets::new(device, size, &self.scattering, &self.tone, &self.presenter),
        };
        self.write_uniforms(queue, size, settings, frame);
        self.draw_shadow(encoder, stamps(Pass::Shadow));
        self.draw_scene(device, encoder, &targets, settings, stamps(Pass::Scene));
        let is_scattered = settings.view.is_lit() && settings.skin.scattering > 0.0;
        if is_scattered {
            self.scattering.draw(encoder, &targets, [stamps(Pass::ScatterAcross), stamps(Pass::ScatterUp)]);
            self.num_draws += 2;
        }
        let tone_group = if is_scattered { &targets.tone_scattered } else { &targets.tone_plain };
        fullscreen::draw(encoder, Pass::Tone, &self.tone.pipeline, tone_group, &targets.picture, stamps(Pass::Tone));
        fullscreen::draw(encoder, Pass::Present, &self.presenter.pipeline, &targets.present_group, target, stamps(Pass::Present));
        self.num_draws += 2;
        self.targets = Some(targets);
    }

    /// Format of the pictures.
    pub fn target_format(&self) -> wgpu::TextureFormat {
        self.target_format
    }

    /// The character drawn.
    pub fn character(&self) -> &Arc<Character> {
        &self.model.character
    }

    /// Bytes of the zones' masks and of their wrinkle map.
    pub fn zone_bytes(&self) -> u64 {
        self.model.group.zone_bytes
    }

    /// Draw calls of the last picture.
    pub fn num_draws(&self) -> u32 {
        self.num_draws
    }

    /// Bytes of buffers and textures this renderer uses on the device, shared ones included.
    pub fn gpu_bytes(&self) -> u64 {
        self.model.bytes
            + self.shadow.bytes
            + size_of::<uniforms::Frame>() as u64
            + self.targets.as_ref().map_or(0, |targets| targets.bytes)
    }

    /// Of those, bytes of maps that another character on the device uses as well.
    pub fn shared_bytes(&self) -> u64 {
        self.model.maps.iter().filter(|map| Arc::strong_count(map) > 1).map(|map| map.bytes).sum()
    }

    fn write_uniforms(&mut self, queue: &wgpu::Queue, size: [u32; 2], settings: &DrawSettings, frame: &RenderFrame) {
        if self.lit_by.is_none_or(|(studio, _)| studio != settings.studio) {
            self.light(queue, settings.studio);
        }
        let character = &*self.model.character;
        let at_rest;
        let frame = if frame.fits(character) {
            frame
        } else {
            at_rest = RenderFrame::at_rest(character);
            &at_rest
        };
        // The view of what shapes do shows what they do.
        let deform = if settings.view == ViewMode::ShapeDeltas { Deformation::Shapes } else { settings.deform };
        let weights = deform.weights_of(frame).filter(|_| self.model.has_shapes);
        let matrices = match weights {
            Some(_) => self.model.palette.model_from_unposed(character, frame),
            None => self.model.palette.model_from_rest(character, frame),
        };
        let rows: Vec<[[f32; 4]; 3]> = matrices.iter().map(uniforms::rows_of).collect();
        queue.write_buffer(&self.model.group.morph_weights, 0, bytemuck::bytes_of(&uniforms::MorphWeights::new(weights)));
        queue.write_buffer(&self.model.group.palette, 0, bytemuck::cast_slice(&rows));

        let (num_bones, num_poses) = (character.num_bones(), character.num_poses());
        let mut coefficients = bone_major(&frame.influences, num_bones, num_poses);
        // Wrinkles narrower than a few pixels would only glitter.
        let fade = settings.camera.wrinkle_fade(FURROW_WAVELENGTH, size[1]) * f32::from(u8::from(settings.wrinkles));
        coefficients.iter_mut().flatten().for_each(|coefficient| *coefficient *= fade);
        let mut weights: uniforms::WrinkleWeights = bytemuck::Zeroable::zeroed();
        if let Some(scales) = &self.model.zone_scales {
            let fade = settings.camera.wrinkle_fade(scales.wavelength, size[1]) * f32::from(u8::from(settings.wrinkles));
            weights = scales.weights(frame, settings.zone_blend, fade);
            self.is_stretched = weights.stretched != [[0.0; 4]; 2];
        }
        weights.active_poses = active_poses(&frame.influences, num_bones);
        queue.write_buffer(&self.model.group.wrinkle_weights, 0, bytemuck::bytes_of(&weights));
        if let Some(blood) = &mut self.model.blood
            && blood.mix(frame)
        {
            upload::write_blood(queue, &self.model.group.blood, blood.codes());
        }
        queue.write_buffer(&self.model.group.coefficients, 0, bytemuck::cast_slice(&coefficients));
        queue.write_buffer(&self.frame_block, 0, bytemuck::bytes_of(&self.frame_uniforms(size, settings, frame)));

        let lens = Lens { aspect: size[0] as f32 / size[1] as f32, fovy: settings.camera.fovy, distance: settings.camera.distance };
        self.scattering.write(queue, lens, settings.skin.scattering);
        let shown = match settings.view {
            view if !view.is_lit() => Shown::Raw,
            ViewMode::Term(Term::Diffuse) => Shown::Diffuse,
            ViewMode::Term(Term::Specular) => Shown::Specular,
            ViewMode::Term(Term::Scattering) => Shown::Scattering,
            _ => Shown::All,
        };
        self.num_drawn = self.num_drawn.wrapping_add(1);
        let tone = uniforms::Tone { exposure: settings.exposure, grain: settings.grain, seed: self.num_drawn, shown: shown as u32 };
        queue.write_buffer(&self.tone.block, 0, bytemuck::bytes_of(&tone));
        let present = uniforms::Present {
            target_encodes_srgb: u32::from(self.presenter.target_encodes_srgb),
            is_split: u32::from(settings.view == ViewMode::Split),
            is_smoothed: u32::from(settings.is_smoothed && settings.view.is_lit()),
            is_transparent: u32::from(settings.is_transparent),
        };
        queue.write_buffer(&self.presenter.block, 0, bytemuck::bytes_of(&present));
    }

    /// Whether bones' and zones' wrinkles are drawn: those asked for that the character has and that are near enough.
    fn systems(&self, settings: &DrawSettings) -> (bool, bool) {
        let has_maps = self.model.character.poses.iter().any(|pose| pose.map.is_some());
        let height = self.height;
        let is_near = |wavelength: f32| settings.camera.wrinkle_fade(wavelength, height) > 0.0;
        let zones = self.model.zone_scales.as_ref().filter(|scales| is_near(scales.wavelength));
        let (bones, zones) = (has_maps && is_near(FURROW_WAVELENGTH), zones.is_some_and(|scales| scales.has(settings.zone_blend)));
        match settings.system {
            WrinkleSystem::Own => (bones, zones && !has_maps),
            WrinkleSystem::Bones => (bones, false),
            WrinkleSystem::Zones => (false, zones),
            WrinkleSystem::Both => (bones, zones),
        }
    }

    /// Fills the environment for a set-up.
    fn light(&mut self, queue: &wgpu::Queue, studio: Studio) {
        for (level, texels) in environment::levels(studio).iter().enumerate() {
            let side = environment::SIDE >> level;
            queue.write_texture(
                wgpu::TexelCopyTextureInfo {
                    texture: &self.environment,
                    mip_level: level as u32,
                    origin: wgpu::Origin3d::ZERO,
                    aspect: wgpu::TextureAspect::All,
                },
                texels,
                wgpu::TexelCopyBufferLayout { offset: 0, bytes_per_row: Some(8 * side), rows_per_image: None },
                wgpu::Extent3d { width: side, height: side, depth_or_array_layers: 1 },
            );
        }
        self.lit_by = Some((studio, environment::irradiance(studio)));
    }

    fn frame_uniforms(&self, size: [u32; 2], settings: &DrawSettings, frame: &RenderFrame) -> uniforms::Frame {
        let character = &*self.model.character;
        // The bust stays while the head travels: a sphere that holds both.
        let travel = frame.head.position;
        let (centre, radius) = (self.model.bounds.centre + travel * 0.5, self.model.bounds.radius + travel.length() * 0.5);
        let head_from_world = character.head_motion(&frame.head).inverse();
        let mouth = Mouth::new(character, frame);
        let lids = [Side::Left, Side::Right].map(|side| Lids::new(character, frame, side));
        let shown = |k: usize| match settings.view {
            ViewMode::Influence(None) | ViewMode::Masks(None) => 1.0,
            ViewMode::Influence(Some(only)) | ViewMode::Masks(Some(only)) if only == k => 1.0,
            _ => 0.0,
        };
        let eye = settings.camera.eye();
        let (mirrored, mirrored_gain) = settings.studio.mirrored();
        uniforms::Frame {
            clip_from_world: settings.camera.clip_from_world(size[0] as f32 / size[1] as f32).to_cols_array_2d(),
            shadow_from_world: settings.studio.shadow_from_world(settings.key_turn, centre, radius).to_cols_array_2d(),
            head_from_world: uniforms::rows_of(&head_from_world),
            eye: eye.extend(2.0 * radius / shadow::SIDE as f32).to_array(),
            forward: (settings.camera.target - eye).normalize_or(Vec3::NEG_Z).extend(settings.camera.distance).to_array(),
            light_depth: settings.studio.light_depth(settings.key_turn, centre).to_array(),
            lights: settings.studio.lights(settings.key_turn),
            irradiance: self.lit_by.map_or([Vec3::ZERO; 9], |(_, irradiance)| irradiance).map(|e| e.extend(0.0).to_array()),
            mouth: mouth.middle.extend(mouth.half_width).to_array(),
            mouth_shape: [mouth.light_reach(), mouth.corner_depth, 0.0, 0.0],
            eyeballs: eyeballs(character),
            lid_corners: [lids[0].corners, lids[1].corners],
            lid_arches: [lids[0].upper, lids[0].lower, lids[1].upper, lids[1].lower],
            gazes: gazes(character, frame),
            skin: [FLESH_PER_MM, settings.skin.gloss, settings.skin.roughness, settings.skin.translucency],
            blood: [self.model.blood.as_ref().map_or(0.0, |blood| blood::RANGE * blood.strength() * settings.skin.blood), 0.0, 0.0, 0.0],
            picture: [2.0 * (0.5 * settings.camera.fovy).tan() / size[1] as f32, mirrored_gain, 0.0, 0.0],
            shown: [shown_term(settings.view), mirrored, 0, 0],
            shown_poses: [[shown(0), shown(1), shown(2), shown(3)], [shown(4), shown(5), shown(6), shown(7)]],
        }
    }

    fn draw_shadow(&mut self, encoder: &mut wgpu::CommandEncoder, stamps: Option<wgpu::RenderPassTimestampWrites<'_>>) {
        let mut pass = self.shadow.begin(encoder, stamps);
        pass.set_bind_group(0, &self.frame_group_unlit, &[]);
        pass.set_bind_group(1, &self.model.group.group, &[]);
        for primitive in self.model.primitives.iter().filter(|primitive| !matches!(primitive.surface, Surface::Wet | Surface::Hair)) {
            pass.set_vertex_buffer(0, primitive.vertices.slice(..));
            pass.set_index_buffer(primitive.indices.slice(..), wgpu::IndexFormat::Uint32);
            pass.draw_indexed(0..primitive.num_indices, 0, 0..1);
            self.num_draws += 1;
        }
    }

    fn draw_scene(
        &mut self,
        device: &wgpu::Device,
        encoder: &mut wgpu::CommandEncoder,
        targets: &Targets,
        settings: &DrawSettings,
        stamps: Option<wgpu::RenderPassTimestampWrites<'_>>,
    ) {
        let mut pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
            label: Some("scene"),
            color_attachments: &[
                (&targets.specular_samples, &targets.specular, 1.0),
                (&targets.diffuse_samples, &targets.diffuse, background::FAR),
            ]
            .map(|(samples, resolved, a)| {
                Some(wgpu::RenderPassColorAttachment {
                    view: samples,
                    depth_slice: None,
                    resolve_target: Some(resolved),
                    ops: wgpu::Operations {
                        load: wgpu::LoadOp::Clear(wgpu::Color { r: 0.0, g: 0.0, b: 0.0, a }),
                        store: wgpu::StoreOp::Discard,
                    },
                })
            }),
            depth_stencil_attachment: Some(wgpu::RenderPassDepthStencilAttachment {
                view: &targets.depth,
                depth_ops: Some(wgpu::Operations { load: wgpu::LoadOp::Clear(1.0), store: wgpu::StoreOp::Discard }),
                stencil_ops: None,
            }),
            timestamp_writes: stamps,
            occlusion_query_set: None,
            multiview_mask: None,
        });
        let stand_off = pipelines::STRAND_STAND_OFF;
        pass.set_blend_constant(wgpu::Color { r: stand_off, g: stand_off, b: stand_off, a: stand_off });
        if !settings.is_transparent {
            pass.set_pipeline(&self.background);
            pass.draw(0..3, 0..1);
            self.num_draws += 1;
        }
        let blend = Look::blend_index(settings.blend);
        match settings.view {
            ViewMode::Beauty | ViewMode::Term(_) => self.draw_primitives(device, &mut pass, settings, Look::Wrinkled(blend)),
            ViewMode::Bare => self.draw_primitives(device, &mut pass, settings, Look::Bare),
            ViewMode::Influence(_) => self.draw_primitives(device, &mut pass, settings, Look::Influence),
            ViewMode::Normals => self.draw_primitives(device, &mut pass, settings, Look::Normals(blend)),
            ViewMode::Masks(_) => self.draw_primitives(device, &mut pass, settings, Look::ZoneMasks),
            ViewMode::BoneMasks => self.draw_primitives(device, &mut pass, settings, Look::BoneMasks),
            ViewMode::ShapeDeltas => self.draw_primitives(device, &mut pass, settings, Look::Deltas),
            ViewMode::Wireframe => self.draw_wireframe(device, &mut pass),
            ViewMode::Split => {
                let [width, height] = targets.size;
                let middle = width / 2;
                if middle > 0 {
                    pass.set_scissor_rect(0, 0, middle, height);
                    self.draw_primitives(device, &mut pass, settings, Look::Wrinkled(blend));
                }
                pass.set_scissor_rect(middle, 0, width - middle, height);
                self.draw_primitives(device, &mut pass, settings, Look::Bare);
            }
        }
    }

    fn draw_primitives(&mut self, device: &wgpu::Device, pass: &mut wgpu::RenderPass<'_>, settings: &DrawSettings, look: Look) {
        pass.set_bind_group(0, &self.frame_group, &[]);
        pass.set_bind_group(1, &self.model.group.group, &[]);
        let is_lit = matches!(look, Look::Wrinkled(_) | Look::Bare);
        let (has_bones, has_zones) = self.systems(settings);
        // A map that nothing shows is not read.
        let has_stretch = self.is_stretched;
        let zones = match look {
            // Masks are there whatever is drawn with them.
            Look::ZoneMasks => (1, false),
            _ => (if has_zones { settings.zone_blend.number() } else { 0 }, has_stretch),
        };
        // What adds to or covers the rest comes last.
        let rank = |surface: Surface| match surface {
            Surface::Hair => 1,
            Surface::Wet => 2,
            _ => 0,
        };
        for at in 0..3 {
            for primitive in self.model.primitives.iter().filter(|primitive| rank(primitive.surface) == at) {
                if primitive.surface == Surface::Wet && !is_lit {
                    continue;
                }
                pass.set_vertex_buffer(0, primitive.vertices.slice(..));
                pass.set_index_buffer(primitive.indices.slice(..), wgpu::IndexFormat::Uint32);
                for (region, offset) in primitive.regions.iter().zip((0..).step_by(primitive.region_stride as usize)) {
                    let has_poses = has_bones && region.poses != 0;
                    let key = Key::new(
                        look,
                        primitive.surface,
                        primitive.is_double_sided,
                        primitive.alpha,
                        has_poses,
                        if region.has_zones { zones } else { (0, false) },
                    );
                    pass.set_bind_group(2, &primitive.material, &[offset]);
                    pass.set_pipeline(self.pipelines.surface(device, key));
                    pass.draw_indexed(region.indices.clone(), 0, 0..1);
                    self.num_draws += 1;
                }
            }
        }
    }

    fn draw_wireframe(&mut self, device: &wgpu::Device, pass: &mut wgpu::RenderPass<'_>) {
        pass.set_bind_group(0, &self.frame_group_unlit, &[]);
        pass.set_bind_group(1, &self.model.group.group, &[]);
        pass.set_pipeline(self.pipelines.wire(device, Wire::Body));
        for primitive in &self.model.primitives {
            pass.set_vertex_buffer(0, primitive.vertices.slice(..));
            pass.set_index_buffer(primitive.indices.slice(..), wgpu::IndexFormat::Uint32);
            pass.draw_indexed(0..primitive.num_indices, 0, 0..1);
        }
        pass.set_pipeline(self.pipelines.wire(device, Wire::Edges));
        for primitive in &self.model.primitives {
            pass.set_vertex_buffer(0, primitive.vertices.slice(..));
            pass.set_index_buffer(primitive.edges.slice(..), wgpu::IndexFormat::Uint32);
            pass.draw_indexed(0..primitive.num_edge_indices, 0, 0..1);
            self.num_draws += 2;
        }
    }
}

/// `shown` in `frame.wgsl`.
fn shown_term(view: ViewMode) -> u32 {
    match view {
        ViewMode::Term(Term::Translucency) => 1,
        ViewMode::Term(Term::Blood) => 2,
        _ => 0,
    }
}

fn frame_block(device: &wgpu::Device) -> wgpu::Buffer {
    device.create_buffer(&wgpu::BufferDescriptor {
        label: Some("frame"),
        size: size_of::<uniforms::Frame>() as u64,
        usage: wgpu::BufferUsages::UNIFORM | wgpu::BufferUsages::COPY_DST,
        mapped_at_creation: false,
    })
}

fn environment_texture(device: &wgpu::Device) -> wgpu::Texture {
    device.create_texture(&wgpu::TextureDescriptor {
        label: Some("environment"),
        size: wgpu::Extent3d { width: environment::SIDE, height: environment::SIDE, depth_or_array_layers: 1 },
        mip_level_count: environment::NUM_LEVELS,
        sample_count: 1,
        dimension: wgpu::TextureDimension::D2,
        format: environment::FORMAT,
        usage: wgpu::TextureUsages::TEXTURE_BINDING | wgpu::TextureUsages::COPY_DST,
        view_formats: &[],
    })
}
