// Highlights are added to the scattered light, then exposure, filmic curve, grain: from linear light to an encoded picture
// with its luma in alpha.
//!include fullscreen
//!include encoding

struct Tone {
    // Multiplies the light before the curve.
    exposure: f32,
    // Standard deviation of the grain in the middle tones, display values.
    grain: f32,
    // Changes from frame to frame.
    seed: u32,
    // What is shown: see the constants.
    shown: u32,
}

const SHOW_ALL: u32 = 0u;
// Display values already (normals, heat maps): they pass as they are.
const SHOW_RAW: u32 = 1u;
const SHOW_DIFFUSE: u32 = 2u;
const SHOW_SPECULAR: u32 = 3u;
// What scattering changed, about a middle grey.
const SHOW_SCATTERING: u32 = 4u;

@group(0) @binding(0) var<uniform> tone: Tone;
// As drawn, and after scattering.
@group(0) @binding(1) var unscattered: texture_2d<f32>;
@group(0) @binding(2) var diffuse: texture_2d<f32>;
@group(0) @binding(3) var specular: texture_2d<f32>;

// Hable's curve (filmicworlds.com, 2010), exposure bias 2 inside, white point 11.2.
fn hable(x: vec3<f32>) -> vec3<f32> {
    return (x * (0.15 * x + 0.05) + 0.004) / (x * (0.15 * x + 0.50) + 0.06) - 0.0666666667;
}

fn filmic(light: vec3<f32>) -> vec3<f32> {
    return clamp(hable(2.0 * tone.exposure * light) / hable(vec3<f32>(11.2)), vec3<f32>(0.0), vec3<f32>(1.0));
}

fn hash(value: u32) -> u32 {
    // PCG (Jarzynski and Olano 2020).
    let state = value * 747796405u + 2891336453u;
    let word = ((state >> ((state >> 28u) + 4u)) ^ state) * 277803737u;
    return (word >> 22u) ^ word;
}

// Noise of mean 0 and standard deviation 1, triangular.
fn noise(texel: vec2<i32>) -> f32 {
    let a = hash(u32(texel.x) + hash(u32(texel.y) + hash(tone.seed)));
    let b = hash(a);
    return (f32(a >> 8u) + f32(b >> 8u)) / 16777216.0 * 2.4494897 - 2.4494897;
}

@fragment
fn fs_tone(@builtin(position) at: vec4<f32>) -> @location(0) vec4<f32> {
    let texel = vec2<i32>(at.xy);
    let base = max(textureLoad(diffuse, texel, 0).rgb, vec3<f32>(0.0));
    let shine = max(textureLoad(specular, texel, 0).rgb, vec3<f32>(0.0));
    var encoded: vec3<f32>;
    if tone.shown == SHOW_RAW {
        encoded = clamp(base, vec3<f32>(0.0), vec3<f32>(1.0));
    } else if tone.shown == SHOW_SCATTERING {
        let change = base - max(textureLoad(unscattered, texel, 0).rgb, vec3<f32>(0.0));
        encoded = clamp(0.5 + 4.0 * tone.exposure * change, vec3<f32>(0.0), vec3<f32>(1.0));
    } else {
        let light = select(base, vec3<f32>(0.0), tone.shown == SHOW_SPECULAR) + select(shine, vec3<f32>(0.0), tone.shown == SHOW_DIFFUSE);
        encoded = srgb_from_linear(filmic(light));
        let luma = dot(encoded, LUMA);
        // Film has most grain in its middle tones.
        encoded = clamp(encoded + tone.grain * 4.0 * luma * (1.0 - luma) * noise(texel), vec3<f32>(0.0), vec3<f32>(1.0));
    }
    return vec4<f32>(encoded, dot(encoded, LUMA));
}
