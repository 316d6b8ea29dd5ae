// From linear light to the picture: exposure, filmic curve, sRGB where the target does not encode by itself.

struct Present {
    exposure: f32,
    // 1: the scene holds display values already (normals, heat maps); they pass as they are.
    is_display_ready: u32,
    // 1: the target's format encodes sRGB.
    target_encodes_srgb: u32,
    // 1: a line down the middle parts the two halves.
    is_split: u32,
}

@group(0) @binding(0) var<uniform> present: Present;
@group(0) @binding(1) var scene: texture_2d<f32>;

// Hable's curve (filmicworlds.com, 2010), exposure bias 2 inside, white point 11.2.
fn hable(x: vec3<f32>) -> vec3<f32> {
    return (x * (0.15 * x + 0.05) + 0.004) / (x * (0.15 * x + 0.50) + 0.06) - 0.0666666667;
}

fn srgb_from_linear(linear: vec3<f32>) -> vec3<f32> {
    return select(1.055 * pow(linear, vec3<f32>(1.0 / 2.4)) - 0.055, linear * 12.92, linear <= vec3<f32>(0.0031308));
}

fn linear_from_srgb(encoded: vec3<f32>) -> vec3<f32> {
    return select(pow((encoded + 0.055) / 1.055, vec3<f32>(2.4)), encoded / 12.92, encoded <= vec3<f32>(0.04045));
}

@vertex
fn vs_present(@builtin(vertex_index) index: u32) -> @builtin(position) vec4<f32> {
    return vec4<f32>(f32(index & 1u) * 4.0 - 1.0, f32(index >> 1u) * 4.0 - 1.0, 0.0, 1.0);
}

@fragment
fn fs_present(@builtin(position) at: vec4<f32>) -> @location(0) vec4<f32> {
    let texel = vec2<i32>(at.xy);
    let light = max(textureLoad(scene, texel, 0).rgb, vec3<f32>(0.0));
    var linear: vec3<f32>;
    var encoded: vec3<f32>;
    if present.is_display_ready == 1u {
        encoded = clamp(light, vec3<f32>(0.0), vec3<f32>(1.0));
        linear = linear_from_srgb(encoded);
    } else {
        linear = clamp(hable(2.0 * present.exposure * light) / hable(vec3<f32>(11.2)), vec3<f32>(0.0), vec3<f32>(1.0));
        encoded = srgb_from_linear(linear);
    }
    if present.is_split == 1u && texel.x == i32(textureDimensions(scene).x / 2u) {
        linear = vec3<f32>(0.9);
        encoded = vec3<f32>(0.95);
    }
    return vec4<f32>(select(encoded, linear, present.target_encodes_srgb == 1u), 1.0);
}
