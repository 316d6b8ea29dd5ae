//! Builds pipelines. They never change once built; what changes per frame is an argument.

use super::layouts::Layouts;
use super::view::BlendMode;
use crate::asset::{Alpha, Surface, Vertex};
use std::collections::BTreeMap;

/// The scene is linear light until the tone pass: highlights in one attachment, what came out of surfaces in another.
pub const SCENE_FORMAT: wgpu::TextureFormat = wgpu::TextureFormat::Rgba16Float;
pub const DEPTH_FORMAT: wgpu::TextureFormat = wgpu::TextureFormat::Depth32Float;
/// Samples a pixel of the scene: what every device offers.
pub const SAMPLES: u32 = 4;

/// What a part of the character is drawn as.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Look {
    /// With wrinkles, blended by this mode (an index into [`BlendMode::ALL`]).
    Wrinkled(usize),
    /// By the code without wrinkles.
    Bare,
    /// Heat map.
    Influence,
    /// Normals with wrinkles, blended by this mode.
    Normals(usize),
    /// Masks of the zones.
    ZoneMasks,
    /// Skinning weights of the bones.
    BoneMasks,
    /// How far shapes move.
    Deltas,
}

impl Look {
    /// The blend mode's number as the shader knows it.
    pub fn blend_index(mode: BlendMode) -> usize {
        BlendMode::ALL.iter().position(|known| *known == mode).unwrap_or_default()
    }
}

/// What decides a pipeline.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Key {
    pub look: Look,
    pub shader: ShaderKind,
    pub is_double_sided: bool,
    pub has_coverage: bool,
    /// Maps of poses are read: those that the region names.
    pub has_poses: bool,
    /// How zones are blended, as the shader counts it; 0 for none.
    pub zones: u8,
    /// Stretched zones have a map.
    pub has_stretch: bool,
}

/// The pass that draws a surface.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum ShaderKind {
    Skin,
    Eye,
    Wet,
    Plain,
    Hair,
}

impl From<Surface> for ShaderKind {
    fn from(surface: Surface) -> Self {
        match surface {
            Surface::Skin => Self::Skin,
            Surface::Eye => Self::Eye,
            Surface::Wet => Self::Wet,
            Surface::Mouth | Surface::Cloth => Self::Plain,
            Surface::Hair => Self::Hair,
        }
    }
}

/// Pipelines for a character's triangles, each built when it first draws: a character has dozens of them, a picture
/// needs ten.
#[derive(Debug)]
pub struct Pipelines {
    surface_layout: wgpu::PipelineLayout,
    geometry_layout: wgpu::PipelineLayout,
    /// A constant of the shaders.
    num_poses: usize,
    modules: BTreeMap<Pass, wgpu::ShaderModule>,
    surfaces: BTreeMap<Key, wgpu::RenderPipeline>,
    wires: BTreeMap<Wire, wgpu::RenderPipeline>,
}

/// Source of a module.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Pass {
    Surface(ShaderKind),
    Influence,
    Normals,
    Masks,
    Deltas,
    Wireframe,
}

/// The two halves of the wireframe view.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Wire {
    /// The dark body under the edges.
    Body,
    Edges,
}

impl Pass {
    fn source(self) -> &'static str {
        match self {
            Self::Surface(ShaderKind::Skin) => rhytid_shaders::SKIN,
            Self::Surface(ShaderKind::Eye) => rhytid_shaders::EYE,
            Self::Surface(ShaderKind::Wet) => rhytid_shaders::WET,
            Self::Surface(ShaderKind::Plain) => rhytid_shaders::PLAIN,
            Self::Surface(ShaderKind::Hair) => rhytid_shaders::HAIR,
            Self::Influence => rhytid_shaders::INFLUENCE,
            Self::Normals => rhytid_shaders::NORMALS,
            Self::Masks => rhytid_shaders::MASKS,
            Self::Deltas => rhytid_shaders::DELTAS,
            Self::Wireframe => rhytid_shaders::WIREFRAME,
        }
    }
}

impl Pipelines {
    /// None yet; `num_poses` becomes a constant of the shaders.
    pub fn new(layouts: &Layouts, num_poses: usize) -> Self {
        Self {
            surface_layout: layouts.surface.clone(),
            geometry_layout: layouts.geometry.clone(),
            num_poses,
            modules: BTreeMap::new(),
            surfaces: BTreeMap::new(),
            wires: BTreeMap::new(),
        }
    }

    /// The pipeline of a part; its first call builds it.
    pub fn surface(&mut self, device: &wgpu::Device, key: Key) -> &wgpu::RenderPipeline {
        self.surfaces.entry(key).or_insert_with(|| {
            let (pass, vertex_entry, fragment_entry, blend) = match key.look {
                Look::Wrinkled(blend) => (Pass::Surface(key.shader), "vs_wrinkled", "fs_wrinkled", blend),
                Look::Bare if key.is_strand() => (Pass::Surface(key.shader), "vs_strand", "fs_strand", 0),
                Look::Bare => (Pass::Surface(key.shader), "vs_bare", "fs_bare", 0),
                Look::Influence => (Pass::Influence, "vs_wrinkled", "fs_influence", 0),
                Look::Normals(blend) => (Pass::Normals, "vs_wrinkled", "fs_wrinkled", blend),
                Look::ZoneMasks => (Pass::Masks, "vs_bare", "fs_zones", 0),
                Look::BoneMasks => (Pass::Masks, "vs_bones", "fs_bones", 0),
                Look::Deltas => (Pass::Deltas, "vs_deltas", "fs_deltas", 0),
            };
            let constants = [
                ("NUM_POSES", self.num_poses as f64),
                ("BLEND", blend as f64),
                ("POSES", if key.has_poses { f64::from(u8::MAX) } else { 0.0 }),
                ("ZONES", f64::from(key.zones)),
                ("ZONES_STRETCH", f64::from(u8::from(key.has_stretch))),
            ];
            scene_pipeline(
                device,
                &SceneParts {
                    label: &format!("{:?} {:?}", key.shader, key.look),
                    layout: &self.surface_layout,
                    module: module(&mut self.modules, device, pass),
                    vertex_entry,
                    fragment_entry,
                    constants: &constants,
                    topology: wgpu::PrimitiveTopology::TriangleList,
                    cull_mode: (!key.is_double_sided).then_some(wgpu::Face::Back),
                    mixing: match key.shader {
                        ShaderKind::Wet => Mixing::Film,
                        ShaderKind::Hair if key.is_strand() => Mixing::Strand,
                        _ => Mixing::None,
                    },
                    alpha_to_coverage: key.has_coverage,
                },
            )
        })
    }

    /// A pipeline of the wireframe view; its first call builds it.
    pub fn wire(&mut self, device: &wgpu::Device, wire: Wire) -> &wgpu::RenderPipeline {
        self.wires.entry(wire).or_insert_with(|| {
            let (vertex_entry, fragment_entry, topology) = match wire {
                Wire::Body => ("vs_body", "fs_body", wgpu::PrimitiveTopology::TriangleList),
                Wire::Edges => ("vs_edges", "fs_edges", wgpu::PrimitiveTopology::LineList),
            };
            scene_pipeline(
                device,
                &SceneParts {
                    label: fragment_entry,
                    layout: &self.geometry_layout,
                    module: module(&mut self.modules, device, Pass::Wireframe),
                    vertex_entry,
                    fragment_entry,
                    constants: &[],
                    topology,
                    cull_mode: None,
                    mixing: Mixing::None,
                    alpha_to_coverage: false,
                },
            )
        })
    }
}

fn module<'a>(modules: &'a mut BTreeMap<Pass, wgpu::ShaderModule>, device: &wgpu::Device, pass: Pass) -> &'a wgpu::ShaderModule {
    modules.entry(pass).or_insert_with(|| {
        device.create_shader_module(wgpu::ShaderModuleDescriptor {
            label: Some(&format!("{pass:?}")),
            source: wgpu::ShaderSource::Wgsl(pass.source().into()),
        })
    })
}

impl Key {
    /// Hair of its own geometry, seen from both sides, rather than of a picture's alpha or a solid.
    fn is_strand(self) -> bool {
        self.look == Look::Bare && self.shader == ShaderKind::Hair && self.is_double_sided && !self.has_coverage
    }

    /// What no pose can wrinkle, and all that is not skin, is drawn bare when the face is drawn with wrinkles.
    pub fn new(
        look: Look,
        surface: Surface,
        is_double_sided: bool,
        alpha: Alpha,
        has_poses: bool,
        (zones, has_stretch): (u8, bool),
    ) -> Self {
        let shader = ShaderKind::from(surface);
        let look = match look {
            Look::Wrinkled(_) if shader != ShaderKind::Skin || (!has_poses && zones == 0) => Look::Bare,
            look => look,
        };
        let is_lit = matches!(look, Look::Wrinkled(_) | Look::Bare);
        let is_wrinkled = matches!(look, Look::Wrinkled(_) | Look::Normals(_)) && shader == ShaderKind::Skin;
        let zones = if is_wrinkled || (look == Look::ZoneMasks && shader == ShaderKind::Skin) { zones } else { 0 };
        Self {
            zones,
            has_stretch: zones != 0 && has_stretch,
            look,
            shader: if is_lit { shader } else { ShaderKind::Plain },
            is_double_sided,
            has_coverage: is_lit && alpha == Alpha::Coverage && shader == ShaderKind::Hair,
            has_poses: is_wrinkled && has_poses,
        }
    }
}

/// What becomes of what lies under a surface.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Mixing {
    /// It is covered.
    None,
    /// It stays, highlights are added to its own. WebGL2 blends all attachments alike: a film's light from below is 0, and all
    /// alphas stay.
    Film,
    /// It is covered by the share that alpha says; strands in any order, they are alike. Its own alphas (depth, scattering) stay but for that share of
    /// [`STRAND_STAND_OFF`]: scattering neither blurs the strand nor takes its darkness into the skin.
    Strand,
}

/// Metres strands seem to stand off the skin.
pub const STRAND_STAND_OFF: f64 = 0.05;

impl Mixing {
    fn blend(self) -> Option<wgpu::BlendState> {
        use wgpu::{BlendComponent, BlendFactor, BlendOperation};
        let of = |src_factor, dst_factor, operation| BlendComponent { src_factor, dst_factor, operation };
        match self {
            Self::None => None,
            Self::Film => {
                let sum = of(BlendFactor::One, BlendFactor::One, BlendOperation::Add);
                let kept = of(BlendFactor::Zero, BlendFactor::One, BlendOperation::Add);
                Some(wgpu::BlendState { color: sum, alpha: kept })
            }
            Self::Strand => Some(wgpu::BlendState {
                color: of(BlendFactor::SrcAlpha, BlendFactor::OneMinusSrcAlpha, BlendOperation::Add),
                alpha: of(BlendFactor::Constant, BlendFactor::One, BlendOperation::ReverseSubtract),
            }),
        }
    }
}

struct SceneParts<'a> {
    label: &'a str,
    layout: &'a wgpu::PipelineLayout,
    module: &'a wgpu::ShaderModule,
    vertex_entry: &'a str,
    fragment_entry: &'a str,
    constants: &'a [(&'a str, f64)],
    topology: wgpu::PrimitiveTopology,
    cull_mode: Option<wgpu::Face>,
    mixing: Mixing,
    alpha_to_coverage: bool,
}

fn scene_pipeline(device: &wgpu::Device, parts: &SceneParts<'_>) -> wgpu::RenderPipeline {
    let options = wgpu::PipelineCompilationOptions { constants: parts.constants, ..Default::default() };
    let target = Some(wgpu::ColorTargetState { format: SCENE_FORMAT, blend: parts.mixing.blend(), write_mask: wgpu::ColorWrites::ALL });
    device.create_render_pipeline(&wgpu::RenderPipelineDescriptor {
        label: Some(parts.label),
        layout: Some(parts.layout),
        vertex: wgpu::VertexState {
            module: parts.module,
            entry_point: Some(parts.vertex_entry),
            compilation_options: options.clone(),
            buffers: &[Some(VERTEX_LAYOUT)],
        },
        primitive: wgpu::PrimitiveState { topology: parts.topology, cull_mode: parts.cull_mode, ..Default::default() },
        depth_stencil: Some(wgpu::DepthStencilState {
            format: DEPTH_FORMAT,
            depth_write_enabled: Some(parts.mixing == Mixing::None),
            depth_compare: Some(wgpu::CompareFunction::LessEqual),
            stencil: wgpu::StencilState::default(),
            bias: wgpu::DepthBiasState::default(),
        }),
        multisample: wgpu::MultisampleState { count: SAMPLES, mask: !0, alpha_to_coverage_enabled: parts.alpha_to_coverage },
        fragment: Some(wgpu::FragmentState {
            module: parts.module,
            entry_point: Some(parts.fragment_entry),
            compilation_options: options,
            targets: &[target.clone(), target],
        }),
        multiview_mask: None,
        cache: None,
    })
}

/// [`Vertex`] as the vertex stages read it.
pub const VERTEX_LAYOUT: wgpu::VertexBufferLayout<'static> = wgpu::VertexBufferLayout {
    array_stride: size_of::<Vertex>() as u64,
    step_mode: wgpu::VertexStepMode::Vertex,
    attributes: &[
        attribute(0, std::mem::offset_of!(Vertex, position), wgpu::VertexFormat::Float32x3),
        attribute(1, std::mem::offset_of!(Vertex, normal), wgpu::VertexFormat::Float32x3),
        attribute(2, std::mem::offset_of!(Vertex, tangent), wgpu::VertexFormat::Float32x4),
        attribute(3, std::mem::offset_of!(Vertex, uv), wgpu::VertexFormat::Float32x2),
        attribute(4, std::mem::offset_of!(Vertex, joints), wgpu::VertexFormat::Uint8x4),
        attribute(5, std::mem::offset_of!(Vertex, weights), wgpu::VertexFormat::Float32x4),
        attribute(6, std::mem::offset_of!(Vertex, gradients), wgpu::VertexFormat::Float32x4),
        attribute(7, std::mem::offset_of!(Vertex, gradients) + 16, wgpu::VertexFormat::Float32x2),
        attribute(8, std::mem::offset_of!(Vertex, morphs), wgpu::VertexFormat::Uint32x2),
    ],
};

const fn attribute(shader_location: u32, offset: usize, format: wgpu::VertexFormat) -> wgpu::VertexAttribute {
    wgpu::VertexAttribute { format, offset: offset as u64, shader_location }
}
