//! Uniform blocks as they are copied to the device. WGSL owns the layouts; the asserts hold these to them.

use crate::asset::Palette;
use glam::Affine3A;
use rhytid_shaders::assert_layout;
use rhytid_shared::NUM_ARKIT_SHAPES;
use rhytid_shared::limits::{MAX_BONES, MAX_POSES};

/// Vec4s a bone in the largest layout.
const MAX_POSE_VECTORS: usize = MAX_POSES / 4;

/// A light of the studio.
#[repr(C)]
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
pub struct Light {
    /// Unit vector towards the light, world space.
    pub direction: [f32; 4],
    /// Linear RGB.
    pub radiance: [f32; 4],
}
assert_layout!(Light, light, { direction: DIRECTION, radiance: RADIANCE });

/// Group 0.
#[repr(C)]
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
pub struct Frame {
    /// World to clip space of the picture.
    pub clip_from_world: [[f32; 4]; 4],
    /// World to clip space of the shadow map.
    pub shadow_from_world: [[f32; 4]; 4],
    /// World to head space, three rows.
    pub head_from_world: [[f32; 4]; 3],
    /// Camera, world space; w: metres a shadow texel covers.
    pub eye: [f32; 4],
    /// Unit vector the camera looks along; w: metres to its target.
    pub forward: [f32; 4],
    /// Row that gives metres along the key light.
    pub light_depth: [f32; 4],
    /// Key, fill, two rims.
    pub lights: [Light; 4],
    /// Light from all round, spherical harmonics, linear RGB.
    pub irradiance: [[f32; 4]; 9],
    /// Middle of the inner lips, head space; w: half the mouth's width.
    pub mouth: [f32; 4],
    /// How deep light reaches into the mouth, how far its corners lie behind its middle, in units of half its width.
    pub mouth_shape: [f32; 4],
    /// Centres, head space, left and right; w: radius.
    pub eyeballs: [[f32; 4]; 2],
    /// Where the lids meet, from the centre of each ball, in radii: x and y of the corner of lower x, then of the other.
    pub lid_corners: [[f32; 4]; 2],
    /// How high the lids' edges arch over the line between the corners, in radii: upper and lower, left eye and right.
    pub lid_arches: [f32; 4],
    /// Where the eyes look, world space.
    pub gazes: [[f32; 4]; 2],
    /// How fast light dies in flesh (1/mm), highlights, roughness, how much light leaks through: all multipliers.
    pub skin: [f32; 4],
    /// x: largest change of haemoglobin the codes of the map of blood reach, optical density.
    pub blood: [f32; 4],
    /// x: metres a pixel covers at a metre. y: how much brighter than its light the box is that wet mirrors show.
    pub picture: [f32; 4],
    /// 1 for each pose or zone that views of influences and masks show.
    pub shown_poses: [[f32; 4]; MAX_POSE_VECTORS],
    /// x: 1 shows only what shines through, 2 only the blood. y: the light that wet mirrors show.
    pub shown: [u32; 4],
}
assert_layout!(Frame, frame, {
    clip_from_world: CLIP_FROM_WORLD,
    shadow_from_world: SHADOW_FROM_WORLD,
    head_from_world: HEAD_FROM_WORLD,
    eye: EYE,
    forward: FORWARD,
    light_depth: LIGHT_DEPTH,
    lights: LIGHTS,
    irradiance: IRRADIANCE,
    mouth: MOUTH,
    mouth_shape: MOUTH_SHAPE,
    eyeballs: EYEBALLS,
    lid_corners: LID_CORNERS,
    lid_arches: LID_ARCHES,
    gazes: GAZES,
    skin: SKIN,
    blood: BLOOD,
    picture: PICTURE,
    shown_poses: SHOWN_POSES,
    shown: SHOWN,
});

/// Joint matrices, three rows each.
pub type PaletteRows = [[[f32; 4]; 3]; Palette::CAPACITY];
const _: () = assert!(size_of::<PaletteRows>() == rhytid_shaders::layout::palette::SIZE);

/// Influences, bone-major.
pub type CoefficientVectors = [[f32; 4]; MAX_BONES * MAX_POSE_VECTORS];
const _: () = assert!(size_of::<CoefficientVectors>() == rhytid_shaders::layout::coefficients::SIZE);

/// What never changes about the reference poses.
#[repr(C)]
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
pub struct PoseTable {
    /// 1 where a pose moves a bone, bone-major.
    pub moved: CoefficientVectors,
    /// Largest slope of each pose's map.
    pub scales: [[f32; 4]; MAX_POSE_VECTORS],
    /// 1 where a map contains the pores.
    pub contains_neutral: [[f32; 4]; MAX_POSE_VECTORS],
    /// Bones.
    pub num_bones: u32,
    /// Weight from which wrinkles stop fading, in (0, 1].
    pub falloff: f32,
    /// Fills the block up.
    pub padding: [u32; 2],
}
assert_layout!(PoseTable, pose_table, {
    moved: MOVED,
    scales: SCALES,
    contains_neutral: CONTAINS_NEUTRAL,
    num_bones: NUM_BONES,
    falloff: FALLOFF,
});

/// Weights of the expression shapes.
#[repr(C)]
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
pub struct MorphWeights {
    /// In the order of [`rhytid_shared::ARKIT_NAMES`].
    pub shapes: [f32; NUM_ARKIT_SHAPES],
    /// 0: no shape moves anything.
    pub is_active: u32,
    /// Fills the block up.
    pub padding: [u32; 3],
}
assert_layout!(MorphWeights, morph_weights, { shapes: SHAPES, is_active: IS_ACTIVE });

impl MorphWeights {
    /// Those of a frame; all 0 where the bones deform it.
    pub fn new(weights: Option<&[f32; NUM_ARKIT_SHAPES]>) -> Self {
        let shapes = weights.copied().unwrap_or([0.0; NUM_ARKIT_SHAPES]);
        Self { is_active: u32::from(shapes.iter().any(|weight| *weight != 0.0)), shapes, padding: [0; 3] }
    }
}

/// What of the wrinkles shows in a frame: zone weights, four a vec4 as in the masks, and which poses do.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
pub struct WrinkleWeights {
    /// How strongly each zone's wrinkles show, times the map's largest slope.
    pub wrinkled: [[f32; 4]; 2],
    /// How far each zone is stretched, times the largest slope of that map.
    pub stretched: [[f32; 4]; 2],
    /// One bit for each pose that shows anywhere.
    pub active_poses: u32,
    /// Fills the block up.
    pub padding: [u32; 3],
}
assert_layout!(WrinkleWeights, wrinkle_weights, { wrinkled: WRINKLED, stretched: STRETCHED, active_poses: ACTIVE_POSES });

/// What the triangles of a draw call have in common.
#[repr(C)]
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
pub struct Region {
    /// One bit for each pose that can wrinkle them.
    pub poses: u32,
    /// Fills the block up.
    pub padding: [u32; 3],
}
assert_layout!(Region, region, { poses: POSES });

/// Group 2.
#[repr(C)]
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
pub struct Material {
    /// Linear RGB and alpha; multiplies the albedo map.
    pub base_color: [f32; 4],
    /// Largest slope of the normal map.
    pub normal_scale: f32,
    /// Multiplies the roughness map.
    pub roughness: f32,
    /// How much of the occlusion map counts, 0 to 1.
    pub occlusion_strength: f32,
    /// 1: the map's blue is the strength of highlights.
    pub has_intensity: f32,
}
assert_layout!(Material, material, {
    base_color: BASE_COLOR,
    normal_scale: NORMAL_SCALE,
    roughness: ROUGHNESS,
    occlusion_strength: OCCLUSION_STRENGTH,
    has_intensity: HAS_INTENSITY,
});

/// Group 0 of the scattering draws.
#[repr(C)]
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
pub struct Scatter {
    /// Weights by colour, offset in mm.
    pub kernel: [[f32; 4]; 25],
    /// Part of the picture a millimetre covers at a metre, along the direction.
    pub uv_per_mm_at_metre: [f32; 2],
    /// Metres from the camera at which the stored depth is zero.
    pub depth_origin: f32,
    /// Share given back by metre of difference in depth.
    pub rejection: f32,
    /// Samples used.
    pub num_samples: u32,
    /// Fills the block up.
    pub padding: [u32; 3],
}
assert_layout!(Scatter, scatter, {
    kernel: KERNEL,
    uv_per_mm_at_metre: UV_PER_MM_AT_METRE,
    depth_origin: DEPTH_ORIGIN,
    rejection: REJECTION,
    num_samples: NUM_SAMPLES,
});

/// Group 0 of the tone pass.
#[repr(C)]
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
pub struct Tone {
    /// Multiplies the light before the tone curve.
    pub exposure: f32,
    /// Standard deviation of the film grain, display values.
    pub grain: f32,
    /// Of the grain.
    pub seed: u32,
    /// What is shown.
    pub shown: u32,
}
assert_layout!(Tone, tone, { exposure: EXPOSURE, grain: GRAIN, seed: SEED, shown: SHOWN });

/// Group 0 of the last pass.
#[repr(C)]
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
pub struct Present {
    /// 1: the target's format encodes sRGB.
    pub target_encodes_srgb: u32,
    /// 1: a line parts the halves.
    pub is_split: u32,
    /// 1: edges are smoothed.
    pub is_smoothed: u32,
    /// 1: alpha is coverage, else 1.
    pub is_transparent: u32,
}
assert_layout!(Present, present, {
    target_encodes_srgb: TARGET_ENCODES_SRGB,
    is_split: IS_SPLIT,
    is_smoothed: IS_SMOOTHED,
    is_transparent: IS_TRANSPARENT,
});

/// The three rows of `target_from_source`.
pub fn rows_of(transform: &Affine3A) -> [[f32; 4]; 3] {
    let (m, t) = (transform.matrix3, transform.translation);
    [0, 1, 2].map(|row| [m.x_axis[row], m.y_axis[row], m.z_axis[row], t[row]])
}
