//! Uniform blocks as they are copied to the device. WGSL owns the layouts; the asserts hold these to them.

use crate::asset::Palette;
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
    pub clip_from_world: [[f32; 4]; 4],
    pub shadow_from_world: [[f32; 4]; 4],
    pub head_from_world: [[f32; 4]; 3],
    pub eye: [f32; 4],
    pub lights: [Light; 4],
    pub sky: [f32; 4],
    pub ground: [f32; 4],
    pub mouth: [f32; 4],
    pub eyeballs: [[f32; 4]; 2],
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
    pub moved: CoefficientVectors,
    pub scales: [[f32; 4]; MAX_POSE_VECTORS],
    pub contains_neutral: [[f32; 4]; MAX_POSE_VECTORS],
    pub num_bones: u32,
    pub falloff: f32,
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
    pub base_color: [f32; 4],
    pub normal_scale: f32,
    pub roughness: f32,
    pub occlusion_strength: f32,
    pub padding: u32,
}
assert_layout!(Material, material, { base_color: BASE_COLOR, normal_scale: NORMAL_SCALE, roughness: ROUGHNESS, occlusion_strength: OCCLUSION_STRENGTH });

/// Group 0 of the last pass.
#[repr(C)]
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
pub struct Present {
    pub exposure: f32,
    pub is_display_ready: u32,
    pub target_encodes_srgb: u32,
    pub is_split: u32,
}
assert_layout!(Present, present, {
    exposure: EXPOSURE,
    is_display_ready: IS_DISPLAY_READY,
    target_encodes_srgb: TARGET_ENCODES_SRGB,
    is_split: IS_SPLIT,
});
