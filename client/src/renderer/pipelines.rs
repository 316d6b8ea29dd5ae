//! Builds pipelines. They never change once built; what changes per frame is an argument.

use super::layouts::Layouts;
use super::upload::Primitive;
use super::view::BlendMode;
use crate::asset::{Alpha, Surface, Vertex};
use std::collections::BTreeMap;

/// The scene is linear light until it is presented.
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
    /// Poses whose maps are read, one bit each.
    pub poses: u8,
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

/// All pipelines that draw a character's triangles.
#[derive(Debug)]
pub struct Pipelines {
    surfaces: BTreeMap<Key, wgpu::RenderPipeline>,
    /// The dark body under the edges.
    pub wire_body: wgpu::RenderPipeline,
    pub wire_edges: wgpu::RenderPipeline,
}

impl Pipelines {
    /// Pipelines for parts with these surfaces; `num_poses` becomes a constant of the shaders.
    pub fn new(device: &wgpu::Device, layouts: &Layouts, num_poses: usize, primitives: &[Primitive]) -> Self {
        let module = |label: &str, source: &str| {
            device
                .create_shader_module(wgpu::ShaderModuleDescriptor { label: Some(label), source: wgpu::ShaderSource::Wgsl(source.into()) })
        };
        let modules = [
            (ShaderKind::Skin, module("skin", rhytid_shaders::SKIN)),
            (ShaderKind::Eye, module("eye", rhytid_shaders::EYE)),
            (ShaderKind::Wet, module("wet", rhytid_shaders::WET)),
            (ShaderKind::Plain, module("plain", rhytid_shaders::PLAIN)),
            (ShaderKind::Hair, module("hair", rhytid_shaders::HAIR)),
        ];
        let influence = module("influence", rhytid_shaders::INFLUENCE);
        let normals = module("normals", rhytid_shaders::NORMALS);
        let mut surfaces = BTreeMap::new();
        let blends = 0..BlendMode::ALL.len();
        let looks: Vec<Look> =
            [Look::Bare, Look::Influence].into_iter().chain(blends.clone().map(Look::Wrinkled)).chain(blends.map(Look::Normals)).collect();
        for primitive in primitives {
            for (look, region) in looks.iter().flat_map(|&look| primitive.regions.iter().map(move |region| (look, region))) {
                let key = Key::new(look, primitive.surface, primitive.is_double_sided, primitive.alpha, region.poses);
                surfaces.entry(key).or_insert_with(|| {
                    let own = modules.iter().find(|(kind, _)| *kind == key.shader).map_or(&normals, |(_, module)| module);
                    let (module, vertex_entry, fragment_entry) = match key.look {
                        Look::Wrinkled(_) => (own, "vs_wrinkled", "fs_wrinkled"),
                        Look::Bare => (own, "vs_bare", "fs_bare"),
                        Look::Influence => (&influence, "vs_wrinkled", "fs_influence"),
                        Look::Normals(_) => (&normals, "vs_wrinkled", "fs_wrinkled"),
                    };
                    let blend = match key.look {
                        Look::Wrinkled(blend) | Look::Normals(blend) => blend,
                        Look::Bare | Look::Influence => 0,
                    };
                    let constants = [("NUM_POSES", num_poses as f64), ("BLEND", blend as f64), ("POSES", f64::from(key.poses))];
                    scene_pipeline(
                        device,
                        &SceneParts {
                            label: &format!("{:?} {:?}", key.shader, key.look),
                            layout: &layouts.surface,
                            module,
                            vertex_entry,
                            fragment_entry,
                            constants: &constants,
                            topology: wgpu::PrimitiveTopology::TriangleList,
                            cull_mode: (!key.is_double_sided).then_some(wgpu::Face::Back),
                            is_film: key.shader == ShaderKind::Wet,
                            alpha_to_coverage: key.has_coverage,
                        },
                    )
                });
            }
        }
        let wireframe = module("wireframe", rhytid_shaders::WIREFRAME);
        let wire = |vertex_entry, fragment_entry, topology| {
            scene_pipeline(
                device,
                &SceneParts {
                    label: fragment_entry,
                    layout: &layouts.geometry,
                    module: &wireframe,
                    vertex_entry,
                    fragment_entry,
                    constants: &[],
                    topology,
                    cull_mode: None,
                    is_film: false,
                    alpha_to_coverage: false,
                },
            )
        };
        let wire_body = wire("vs_body", "fs_body", wgpu::PrimitiveTopology::TriangleList);
        let wire_edges = wire("vs_edges", "fs_edges", wgpu::PrimitiveTopology::LineList);
        Self { surfaces, wire_body, wire_edges }
    }

    /// The pipeline of a part.
    pub fn surface(&self, key: Key) -> Option<&wgpu::RenderPipeline> {
        self.surfaces.get(&key)
    }
}

impl Key {
    /// What no pose can wrinkle, and all that is not skin, is drawn bare when the face is drawn with wrinkles.
    pub fn new(look: Look, surface: Surface, is_double_sided: bool, alpha: Alpha, poses: u8) -> Self {
        let shader = ShaderKind::from(surface);
        let look = match look {
            Look::Wrinkled(_) if shader != ShaderKind::Skin || poses == 0 => Look::Bare,
            look => look,
        };
        let is_lit = matches!(look, Look::Wrinkled(_) | Look::Bare);
        Self {
            look,
            shader: if is_lit { shader } else { ShaderKind::Plain },
            is_double_sided,
            has_coverage: is_lit && alpha == Alpha::Coverage && shader == ShaderKind::Hair,
            poses: if matches!(look, Look::Wrinkled(_) | Look::Normals(_)) { poses } else { 0 },
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
    /// Adds its light to what lies under it.
    is_film: bool,
    alpha_to_coverage: bool,
}

fn scene_pipeline(device: &wgpu::Device, parts: &SceneParts<'_>) -> wgpu::RenderPipeline {
    let options = wgpu::PipelineCompilationOptions { constants: parts.constants, ..Default::default() };
    let over = wgpu::BlendComponent {
        src_factor: wgpu::BlendFactor::One,
        dst_factor: wgpu::BlendFactor::OneMinusSrcAlpha,
        operation: wgpu::BlendOperation::Add,
    };
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
            depth_write_enabled: Some(!parts.is_film),
            depth_compare: Some(wgpu::CompareFunction::LessEqual),
            stencil: wgpu::StencilState::default(),
            bias: wgpu::DepthBiasState::default(),
        }),
        multisample: wgpu::MultisampleState { count: SAMPLES, mask: !0, alpha_to_coverage_enabled: parts.alpha_to_coverage },
        fragment: Some(wgpu::FragmentState {
            module: parts.module,
            entry_point: Some(parts.fragment_entry),
            compilation_options: options,
            targets: &[Some(wgpu::ColorTargetState {
                format: SCENE_FORMAT,
                blend: parts.is_film.then_some(wgpu::BlendState { color: over, alpha: over }),
                write_mask: wgpu::ColorWrites::ALL,
            })],
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
    ],
};

const fn attribute(shader_location: u32, offset: usize, format: wgpu::VertexFormat) -> wgpu::VertexAttribute {
    wgpu::VertexAttribute { format, offset: offset as u64, shader_location }
}
