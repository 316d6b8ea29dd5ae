// Smooths what is left of jagged edges and glitter (after the idea of Lottes' FXAA: find an edge by its luma, walk along
// it to its ends, shift the sample across it by the coverage that follows), then encodes for the target.
//!include fullscreen
//!include encoding

struct Present {
    // 1: the target's format encodes sRGB.
    target_encodes_srgb: u32,
    // 1: a line parts the halves.
    is_split: u32,
    // 1: edges are smoothed.
    is_smoothed: u32,
    // 1: alpha is how much of the pixel is covered, else 1.
    is_transparent: u32,
}

// Metres behind the camera's target: what is drawn is nearer than the first, what is behind everything is at the second.
const BEHIND_HEAD: f32 = 1.0;
const BEHIND_ALL: f32 = 8.0;

// Contrast below which nothing is done: a part of the brightest luma around, and an absolute one. Tuned by eye.
const LEAST_CONTRAST: f32 = 0.125;
const LEAST_LUMA: f32 = 0.035;
// How much of a single bright pixel is spread, 0 to 1: more would eat pores.
const SPREAD: f32 = 0.5;
// Steps along an edge, pixels.
const STEPS: array<f32, 8> = array<f32, 8>(1.0, 1.0, 1.0, 1.5, 2.0, 2.0, 2.0, 4.0);

@group(0) @binding(0) var<uniform> present: Present;
// Encoded colour, luma in alpha.
@group(0) @binding(1) var picture: texture_2d<f32>;
@group(0) @binding(2) var linear_sampler: sampler;
// Alpha: metres behind the camera's target, the mean of a pixel's samples.
@group(0) @binding(3) var diffuse: texture_2d<f32>;

fn luma_at(uv: vec2<f32>) -> f32 {
    return textureSampleLevel(picture, linear_sampler, uv, 0.0).a;
}

// Where the colour of the pixel at `at` is best taken from.
fn smoothed_uv(at: vec2<f32>) -> vec2<f32> {
    let pixel = 1.0 / vec2<f32>(textureDimensions(picture));
    let uv = at * pixel;
    let m = luma_at(uv);
    let n = luma_at(uv + vec2<f32>(0.0, -pixel.y));
    let s = luma_at(uv + vec2<f32>(0.0, pixel.y));
    let w = luma_at(uv + vec2<f32>(-pixel.x, 0.0));
    let e = luma_at(uv + vec2<f32>(pixel.x, 0.0));
    let brightest = max(max(max(n, s), max(w, e)), m);
    let range = brightest - min(min(min(n, s), min(w, e)), m);
    if range < max(LEAST_LUMA, brightest * LEAST_CONTRAST) {
        return uv;
    }
    let nw = luma_at(uv - pixel);
    let se = luma_at(uv + pixel);
    let ne = luma_at(uv + vec2<f32>(pixel.x, -pixel.y));
    let sw = luma_at(uv + vec2<f32>(-pixel.x, pixel.y));
    let around = (2.0 * (n + s + w + e) + nw + ne + sw + se) / 12.0;
    let speck = smoothstep(0.0, 1.0, clamp(abs(around - m) / range, 0.0, 1.0));
    let spread = speck * speck * SPREAD;

    let is_flat = abs(nw + sw - 2.0 * w) + 2.0 * abs(n + s - 2.0 * m) + abs(ne + se - 2.0 * e)
        <= abs(nw + ne - 2.0 * n) + 2.0 * abs(w + e - 2.0 * m) + abs(sw + se - 2.0 * s);
    // Across the edge to its steeper side, and along it.
    let before = select(n, w, is_flat);
    let after = select(s, e, is_flat);
    let is_before = abs(before - m) >= abs(after - m);
    let side = select(1.0, -1.0, is_before);
    let across = select(vec2<f32>(0.0, pixel.y), vec2<f32>(pixel.x, 0.0), is_flat) * side;
    let along = select(vec2<f32>(pixel.x, 0.0), vec2<f32>(0.0, pixel.y), is_flat);
    let other = select(after, before, is_before);
    let edge_luma = 0.5 * (m + other);
    let least_change = 0.25 * abs(m - other);

    let on_edge = uv + across * 0.5;
    var ends = array<f32, 2>(0.0, 0.0);
    var change = array<f32, 2>(0.0, 0.0);
    for (var way = 0u; way < 2u; way += 1u) {
        let towards = along * select(1.0, -1.0, way == 1u);
        for (var i = 0u; i < 8u; i += 1u) {
            ends[way] += STEPS[i];
            change[way] = luma_at(on_edge + towards * ends[way]) - edge_luma;
            if abs(change[way]) >= least_change {
                break;
            }
        }
    }
    let nearer = select(0u, 1u, ends[1] < ends[0]);
    // The edge ends on this pixel's side only if the luma there lies on the other side of the edge's own.
    let is_covered = (change[nearer] >= 0.0) != (m - edge_luma >= 0.0);
    let coverage = select(0.0, 0.5 - ends[nearer] / (ends[0] + ends[1]), is_covered);
    return uv + across * max(coverage, spread);
}

@fragment
fn fs_present(@builtin(position) at: vec4<f32>) -> @location(0) vec4<f32> {
    var uv = at.xy / vec2<f32>(textureDimensions(picture));
    if present.is_smoothed == 1u {
        uv = smoothed_uv(at.xy);
    }
    var encoded = textureSampleLevel(picture, linear_sampler, uv, 0.0).rgb;
    if present.is_split == 1u && i32(at.x) == i32(textureDimensions(picture).x / 2u) {
        encoded = vec3<f32>(0.95);
    }
    var covered = 1.0;
    if present.is_transparent == 1u {
        let depth = textureSampleLevel(diffuse, linear_sampler, uv, 0.0).a;
        covered = clamp((BEHIND_ALL - depth) / (BEHIND_ALL - BEHIND_HEAD), 0.0, 1.0);
    }
    return vec4<f32>(select(encoded, linear_from_srgb(encoded), present.target_encodes_srgb == 1u), covered);
}
