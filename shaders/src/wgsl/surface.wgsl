// Vertex stage and maps that all parts of the character share.
//!include frame
//!include skinning
//!include wrinkles

struct Material {
    // Linear RGB and alpha; multiplies the albedo map.
    base_color: vec4<f32>,
    // Largest slope of the normal map.
    normal_scale: f32,
    // Multiplies the roughness map.
    roughness: f32,
    // How much of the occlusion map counts, 0 to 1.
    occlusion_strength: f32,
    // 1: blue of the surface map is the strength of highlights; 0: it is 1 everywhere.
    has_intensity: f32,
}

// Poses whose maps the code can read, one bit each.
override POSES: u32 = 255u;

// What the triangles of a draw call have in common.
struct Region {
    // Poses that can wrinkle them, one bit each; the maps of the others are not read. WebGL2 binds no fewer than 16 bytes.
    @size(16) poses: u32,
}

@group(1) @binding(3) var wrinkle_maps: texture_2d_array<f32>;
@group(1) @binding(4) var wrinkle_sampler: sampler;

// What shows in this frame. Zone i is component i % 4 of vec4 i / 4, as in the masks.
struct WrinkleWeights {
    // How strongly each zone's wrinkles show, times the map's largest slope (difference maps: as it is).
    wrinkled: array<vec4<f32>, 2>,
    // How far each zone is stretched, times the largest slope of that map.
    stretched: array<vec4<f32>, 2>,
    // One bit for each pose that shows anywhere.
    active_poses: u32,
}

@group(1) @binding(7) var zone_masks: texture_2d_array<f32>;
// Partial derivatives: wrinkles, then what stretching takes away.
@group(1) @binding(8) var zone_maps: texture_2d_array<f32>;
// Wrinkled less neutral unit normal.
@group(1) @binding(9) var zone_difference: texture_2d<f32>;
@group(1) @binding(10) var<uniform> wrinkle_weights: WrinkleWeights;

// Change of haemoglobin since rest: code 128 is none, the others reach frame.blood.x.
@group(1) @binding(11) var blood_map: texture_2d<f32>;

@group(2) @binding(0) var<uniform> material: Material;
@group(2) @binding(1) var albedo_map: texture_2d<f32>;
@group(2) @binding(2) var normal_map: texture_2d<f32>;
// Red: ambient occlusion. Green: roughness. Blue: strength of highlights, see the material.
@group(2) @binding(3) var surface_map: texture_2d<f32>;
@group(2) @binding(4) var map_sampler: sampler;
@group(2) @binding(5) var<uniform> region: Region;

struct Varyings {
    // Invariant: neighbouring regions of the face are drawn by different pipelines and must meet.
    @builtin(position) @invariant clip: vec4<f32>,
    @location(0) world: vec3<f32>,
    // Unit per vertex, not renormalised per fragment: tangent spaces of bakers are read that way.
    @location(1) normal: vec3<f32>,
    @location(2) tangent: vec4<f32>,
    @location(3) uv: vec2<f32>,
    // Where the vertex is at rest, head space.
    @location(4) rest: vec3<f32>,
    @location(5) influences_0_3: vec4<f32>,
    @location(6) influences_4_7: vec4<f32>,
}

fn vary(in: VertexIn) -> Varyings {
    let deformed = deform(in);
    var out: Varyings;
    out.clip = frame.clip_from_world * vec4<f32>(deformed.position, 1.0);
    out.world = deformed.position;
    out.normal = deformed.normal;
    out.tangent = vec4<f32>(deformed.tangent, in.tangent.w);
    out.uv = in.uv;
    out.rest = in.position;
    return out;
}

@vertex
fn vs_wrinkled(in: VertexIn) -> Varyings {
    var out = vary(in);
    out.influences_0_3 = influences(in, 0u);
    if NUM_POSES > 4u {
        out.influences_4_7 = influences(in, 1u);
    }
    return out;
}

@vertex
fn vs_bare(in: VertexIn) -> Varyings {
    return vary(in);
}

fn world_from_tangent(in: Varyings, normal: vec3<f32>) -> vec3<f32> {
    let bitangent = in.tangent.w * cross(in.normal, in.tangent.xyz);
    return normalize(in.tangent.xyz * normal.x + bitangent * normal.y + in.normal * normal.z);
}

fn base_slope(uv: vec2<f32>) -> vec2<f32> {
    return slope_of(textureSample(normal_map, map_sampler, uv).xy, material.normal_scale);
}

fn bare_normal(in: Varyings) -> vec3<f32> {
    return world_from_tangent(in, normal_of(base_slope(in.uv)));
}

fn influence(in: Varyings, pose: u32) -> f32 {
    if pose < 4u {
        return in.influences_0_3[pose];
    }
    return in.influences_4_7[pose - 4u];
}

// Codes as a unorm texture gives them, -1 to 1 with code 128 at zero; no clamp: the bake writes no code 0.
fn signed_code(texel: vec4<f32>) -> vec4<f32> {
    return texel * (255.0 / 127.0) - 128.0 / 127.0;
}

// Shares of the eight zones at a place. Masks are coarse and soft: their smaller versions are never wanted, nor the time it takes
// to choose among them.
fn masks_of(uv: vec2<f32>) -> array<vec4<f32>, 2> {
    return array<vec4<f32>, 2>(textureSampleLevel(zone_masks, wrinkle_sampler, uv, 0, 0.0), textureSampleLevel(zone_masks, wrinkle_sampler, uv, 1, 0.0));
}

fn zone_amount(masks: array<vec4<f32>, 2>, weights: array<vec4<f32>, 2>) -> f32 {
    return dot(masks[0], weights[0]) + dot(masks[1], weights[1]);
}

fn zone_slope(uv: vec2<f32>) -> vec2<f32> {
    let masks = masks_of(uv);
    var slope = signed_code(textureSample(zone_maps, wrinkle_sampler, uv, 0)).xy * zone_amount(masks, wrinkle_weights.wrinkled);
    if ZONES_STRETCH == 1u {
        slope += signed_code(textureSample(zone_maps, wrinkle_sampler, uv, 1)).xy * zone_amount(masks, wrinkle_weights.stretched);
    }
    return slope;
}

fn wrinkled_normal(in: Varyings) -> vec3<f32> {
    var blend = begin_blend(base_slope(in.uv));
    for (var pose = 0u; pose < NUM_POSES; pose += 1u) {
        // The same all over the region: a device skips what it need not read.
        if ((POSES & region.poses & wrinkle_weights.active_poses) & (1u << pose)) == 0u {
            continue;
        }
        let map = slope_of(textureSample(wrinkle_maps, wrinkle_sampler, in.uv, pose).xy, pose_table.scales[pose / 4u][pose % 4u]);
        blend = add_wrinkle(blend, map, pose_table.contains_neutral[pose / 4u][pose % 4u], influence(in, pose));
    }
    if ZONES == 1u && BLEND == 0u {
        blend.slope += zone_slope(in.uv);
        return world_from_tangent(in, end_blend(blend));
    }
    var normal = end_blend(blend);
    if ZONES == 2u {
        let difference = signed_code(textureSample(zone_difference, wrinkle_sampler, in.uv)).xyz * zone_amount(masks_of(in.uv), wrinkle_weights.wrinkled);
        normal = with_zones(normal, vec2<f32>(0.0), difference);
    } else if ZONES != 0u {
        normal = with_zones(normal, zone_slope(in.uv), vec3<f32>(0.0));
    }
    return world_from_tangent(in, normal);
}

fn albedo_of(uv: vec2<f32>) -> vec4<f32> {
    return textureSample(albedo_map, map_sampler, uv) * material.base_color;
}

struct Finish {
    occlusion: f32,
    roughness: f32,
    // Multiplies highlights: how oily skin is, apart from how rough.
    intensity: f32,
}

// Code 128 of a unorm texture is exactly 1, the most is nearly 2.
fn intensity_of(code: f32, has_intensity: f32) -> f32 {
    return mix(1.0, code * (255.0 / 128.0), has_intensity);
}

fn finish_of(uv: vec2<f32>) -> Finish {
    let texel = textureSample(surface_map, map_sampler, uv);
    let occlusion = mix(1.0, texel.x, material.occlusion_strength);
    return Finish(occlusion, material.roughness * texel.y, intensity_of(texel.z, material.has_intensity));
}
