// The studio: a soft key light that casts a shadow, a fill, two rims, and light from all round. Linear RGB throughout.

@group(0) @binding(1) var shadow_map: texture_depth_2d;
@group(0) @binding(2) var shadow_sampler: sampler_comparison;
// Metres along the key light at which it first meets the character, behind the middle of the map's range.
@group(0) @binding(3) var light_depth_map: texture_2d<f32>;
// What lies all round, octahedral; the rougher the mirror, the higher the level.
@group(0) @binding(4) var environment: texture_2d<f32>;
@group(0) @binding(5) var smooth_sampler: sampler;

const PI: f32 = 3.14159265;
// Weights of four taps across the edge of a shadow.
const TENT: array<f32, 4> = array<f32, 4>(0.125, 0.375, 0.375, 0.125);
// Highlights brighter than this, before exposure, would only make edges crawl when samples are averaged.
const BRIGHTEST: f32 = 6.0;
// Margin of the octahedral map on each side: bilinear taps of its smallest level stay inside.
const MARGIN: f32 = 0.0625;
// Level of the environment for roughness 1.
const ROUGHEST_LEVEL: f32 = 4.0;

// 1 where the key light arrives, 0 in its shadow. Sixteen taps, each a bilinear comparison, weighted as a tent.
fn key_visibility(world: vec3<f32>, normal: vec3<f32>) -> f32 {
    let texel_metres = frame.eye.w;
    let facing = clamp(dot(normal, frame.lights[0].direction.xyz), 0.0, 1.0);
    // Moved off the surface by more the more it leans away, so that it does not shade itself.
    let lifted = world + normal * texel_metres * (1.5 + 4.0 * (1.0 - facing));
    let clip = frame.shadow_from_world * vec4<f32>(lifted, 1.0);
    let uv = clip.xy * vec2<f32>(0.5, -0.5) + 0.5;
    let texel = 1.0 / vec2<f32>(textureDimensions(shadow_map));
    var sum = 0.0;
    for (var y = 0; y < 4; y += 1) {
        for (var x = 0; x < 4; x += 1) {
            let weight = TENT[x] * TENT[y];
            let offset = (vec2<f32>(f32(x), f32(y)) - 1.5) * 2.4;
            sum += weight * textureSampleCompareLevel(shadow_map, shadow_sampler, uv + offset * texel, clip.z);
        }
    }
    return sum;
}

// Metres of flesh the key light has crossed when it comes out at `world` (Jimenez, Whelan and others 2010).
fn thickness(world: vec3<f32>, normal: vec3<f32>) -> f32 {
    // From a little inside, so that the edge of the map does not shine.
    let inside = vec4<f32>(world - normal * 0.0008, 1.0);
    let clip = frame.shadow_from_world * inside;
    let entered = textureSampleLevel(light_depth_map, smooth_sampler, clip.xy * vec2<f32>(0.5, -0.5) + 0.5, 0.0).r;
    return max(dot(frame.light_depth, inside) - entered, 0.0);
}

// What is left of white light behind `d` mm of skin: d'Eon and Luebke's six Gaussians as Jimenez and others 2010 sum them.
fn transmittance(d: f32) -> vec3<f32> {
    let dd = -d * d;
    return vec3<f32>(0.233, 0.455, 0.649) * exp(dd / 0.0064) + vec3<f32>(0.100, 0.336, 0.344) * exp(dd / 0.0484)
        + vec3<f32>(0.118, 0.198, 0.0) * exp(dd / 0.187) + vec3<f32>(0.113, 0.007, 0.007) * exp(dd / 0.567)
        + vec3<f32>(0.358, 0.004, 0.0) * exp(dd / 1.99) + vec3<f32>(0.078, 0.0, 0.0) * exp(dd / 7.41);
}

// Light from all round on a white surface: spherical harmonics up to order two, already convolved with the cosine
// (Ramamoorthi and Hanrahan 2001).
fn ambient_irradiance(n: vec3<f32>) -> vec3<f32> {
    let e = &frame.irradiance;
    let sum = (*e)[0].rgb + (*e)[1].rgb * n.y + (*e)[2].rgb * n.z + (*e)[3].rgb * n.x
        + (*e)[4].rgb * (n.x * n.y) + (*e)[5].rgb * (n.y * n.z) + (*e)[6].rgb * (3.0 * n.z * n.z - 1.0)
        + (*e)[7].rgb * (n.x * n.z) + (*e)[8].rgb * (n.x * n.x - n.y * n.y);
    return max(sum, vec3<f32>(0.0));
}

// Occlusion of a coloured surface: light that bounces in a crease takes its colour, so no shadow is grey
// (Jimenez, Wu, Pesce and Jarabo 2016, the fit to many bounces).
fn coloured_occlusion(occlusion: f32, albedo: vec3<f32>) -> vec3<f32> {
    let a = 2.0404 * albedo - 0.3324;
    let b = -4.7951 * albedo + 0.6417;
    let c = 2.7552 * albedo + 0.6903;
    return max(vec3<f32>(occlusion), ((occlusion * a + b) * occlusion + c) * occlusion);
}

fn octahedral(direction: vec3<f32>) -> vec2<f32> {
    let d = direction / (abs(direction.x) + abs(direction.y) + abs(direction.z));
    let folded = (1.0 - abs(d.yx)) * select(vec2<f32>(-1.0), vec2<f32>(1.0), d.xy >= vec2<f32>(0.0));
    return select(d.xy, folded, d.z < 0.0);
}

// What a mirror of `roughness` shows of the room; the lights' own highlights are added light by light.
fn room_reflection(direction: vec3<f32>, roughness: f32) -> vec3<f32> {
    let uv = octahedral(direction) * (0.5 - MARGIN) + 0.5;
    return textureSampleLevel(environment, smooth_sampler, uv, roughness * ROUGHEST_LEVEL).rgb;
}

// What a wet, sharp mirror shows: the room, and one light of the set-up as the soft box it is.
fn studio_reflection(direction: vec3<f32>) -> vec3<f32> {
    let light = frame.lights[frame.shown.y];
    let box = 1.0 - smoothstep(0.016, 0.026, 1.0 - dot(direction, light.direction.xyz));
    return room_reflection(direction, 0.0) + light.radiance.rgb * (box * frame.picture.y);
}

fn fresnel(f0: f32, v_dot_h: f32) -> f32 {
    return f0 + (1.0 - f0) * pow(1.0 - v_dot_h, 5.0);
}

// Highlight of one light, times N.L: Kelemen and Szirmay-Kalos 2001 with Beckmann's distribution, normalised (the form
// of d'Eon and Luebke 2007 divided by pi; times pi, since `radiance` is what a white surface reflects).
// `slope` is the root mean square slope of the microfacets, about the square of a roughness.
fn highlight(normal: vec3<f32>, view: vec3<f32>, light: vec3<f32>, slope: f32, f0: f32) -> f32 {
    let n_dot_l = dot(normal, light);
    if n_dot_l <= 0.0 {
        return 0.0;
    }
    let sum = light + view;
    let h2 = max(dot(sum, sum), 1e-4);
    let halfway = sum * inverseSqrt(h2);
    let x2 = clamp(dot(normal, halfway) * dot(normal, halfway), 1e-4, 1.0);
    let m2 = slope * slope;
    let beckmann = exp((x2 - 1.0) / (x2 * m2)) / (m2 * x2 * x2);
    return n_dot_l * beckmann * fresnel(f0, clamp(dot(view, halfway), 0.0, 1.0)) / h2;
}

// What microfacets hide from each other of a highlight: Kelemen's approximation forgets it and grows without limit towards
// light from behind, so rough hair would shine like metal there. Lazarov's 2011 remedy, with the slope for his k squared.
fn masking(view: vec3<f32>, light: vec3<f32>, slope: f32) -> f32 {
    let sum = light + view;
    let h2 = max(dot(sum, sum), 1e-4);
    return h2 / mix(h2, 4.0, clamp(slope, 0.0, 1.0));
}

// Fresnel of light from all round, with roughness holding it back at grazing angles (Karis 2014, mobile fit).
fn ambient_fresnel(f0: f32, roughness: f32, n_dot_v: f32) -> f32 {
    let r = vec4<f32>(-1.0, -0.0275, -0.572, 0.022) * roughness + vec4<f32>(1.0, 0.0425, 1.04, -0.04);
    let a004 = min(r.x * r.x, exp2(-9.28 * n_dot_v)) * r.x + r.y;
    return f0 * (-1.04 * a004 + r.z) + 1.04 * a004 + r.w;
}

// A normal that turns within a pixel is a rougher surface seen from afar (Kaplanyan and others 2016; Tokuyoshi 2017).
fn roughness_seen_from_afar(roughness: f32, normal: vec3<f32>) -> f32 {
    let du = dpdx(normal);
    let dv = dpdy(normal);
    let variance = min(0.25 * (dot(du, du) + dot(dv, dv)), 0.18);
    let alpha = roughness * roughness;
    return sqrt(sqrt(clamp(alpha * alpha + variance, 0.0, 1.0)));
}

// Inside the mouth it is the darker the deeper: 1 at the lips, towards 0 behind the teeth; light reaches further the
// wider the mouth is open.
fn mouth_light(rest: vec3<f32>) -> f32 {
    let half_width = frame.mouth.w;
    let offset = (rest - frame.mouth.xyz) / half_width;
    // The lips curve back towards their corners.
    let depth = -offset.z - offset.x * offset.x * frame.mouth_shape.y;
    // The deeper, the wider the cavity: at the lips it is no wider than their opening.
    let width = min(0.85 + 0.5 * depth, 1.15);
    let height = min(0.12 + 0.75 * depth, 0.75);
    let inside = (1.0 - smoothstep(width, width + 0.15, abs(offset.x))) * (1.0 - smoothstep(height, height + 0.15, abs(offset.y)));
    let is_mouth = inside * (1.0 - smoothstep(2.2, 2.6, depth));
    return 1.0 - 0.98 * is_mouth * smoothstep(0.10, frame.mouth_shape.x, depth);
}
