//! Uniform blocks as they are copied to the device. WGSL owns the layouts; the asserts hold these to them.

use crate::asset::Palette;
use glam::Affine3A;
use rhytid_shaders::assert_layout;
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
    /// Key, fill, two rims.
    pub lights: [Light; 4],
    /// Irradiance from above, linear RGB.
    pub sky: [f32; 4],
    /// Irradiance from below, linear RGB.
    pub ground: [f32; 4],
    /// Middle of the inner lips, head space; w: half the mouth's width.
    pub mouth: [f32; 4],
    /// How deep light reaches into the mouth, how far its corners lie behind its middle, in units of half its width.
    pub mouth_shape: [f32; 4],
    /// Centres, head space, left and right; w: radius.
    pub eyeballs: [[f32; 4]; 2],
    /// 1 for each pose the influence view shows.
    pub shown_poses: [[f32; 4]; MAX_POSE_VECTORS],
}
assert_layout!(Frame, frame, {
    clip_from_world: CLIP_FROM_WORLD,
    shadow_from_world: SHADOW_FROM_WORLD,
    head_from_world: HEAD_FROM_WORLD,
    eye: EYE,
    lights: LIGHTS,
    sky: SKY,
    ground: GROUND,
    mouth: MOUTH,
    mouth_shape: MOUTH_SHAPE,
    eyeballs: EYEBALLS,
    shown_poses: SHOWN_POSES,
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
    /// Fills the block up.
    pub padding: u32,
}
assert_layout!(Material, material, { base_color: BASE_COLOR, normal_scale: NORMAL_SCALE, roughness: ROUGHNESS, occlusion_strength: OCCLUSION_STRENGTH });

/// Group 0 of the last pass.
#[repr(C)]
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
pub struct Present {
    /// Multiplies the light before the tone curve.
    pub exposure: f32,
    /// 1: the scene holds display values.
    pub is_display_ready: u32,
    /// 1: the target's format encodes sRGB.
    pub target_encodes_srgb: u32,
    /// 1: a line parts the halves.
    pub is_split: u32,
}
assert_layout!(Present, present, {
    exposure: EXPOSURE,
    is_display_ready: IS_DISPLAY_READY,
    target_encodes_srgb: TARGET_ENCODES_SRGB,
    is_split: IS_SPLIT,
});

/// The three rows of `target_from_source`.
pub fn rows_of(transform: &Affine3A) -> [[f32; 4]; 3] {
    let (m, t) = (transform.matrix3, transform.translation);
    [0, 1, 2].map(|row| [m.x_axis[row], m.y_axis[row], m.z_axis[row], t[row]])
}
