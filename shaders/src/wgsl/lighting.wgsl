// The studio: one soft key light that casts a shadow, a fill, two rims, and light from all round. Linear RGB throughout.

@group(0) @binding(1) var shadow_map: texture_depth_2d;
@group(0) @binding(2) var shadow_sampler: sampler_comparison;

const PI: f32 = 3.14159265;
// Weights of four taps across the edge of a shadow.
const TENT: array<f32, 4> = array<f32, 4>(0.125, 0.375, 0.375, 0.125);
// Highlights brighter than this, before exposure, would only make edges crawl when samples are averaged.
const BRIGHTEST: f32 = 6.0;

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

// Light from all round that reaches a diffuse surface.
fn ambient_irradiance(normal: vec3<f32>) -> vec3<f32> {
    let up = normal.y * 0.5 + 0.5;
    return mix(frame.ground.rgb, frame.sky.rgb, up * up * (3.0 - 2.0 * up));
}

// What a rough mirror shows of the room; the lights' own highlights are added light by light.
fn room_reflection(direction: vec3<f32>) -> vec3<f32> {
    return ambient_irradiance(direction) * 0.8;
}

// What a wet, sharp mirror shows: the room, and the key and fill as the soft boxes they are.
fn studio_reflection(direction: vec3<f32>) -> vec3<f32> {
    let key_box = 1.0 - smoothstep(0.020, 0.032, 1.0 - dot(direction, frame.lights[0].direction.xyz));
    let fill_box = 1.0 - smoothstep(0.015, 0.045, 1.0 - dot(direction, frame.lights[1].direction.xyz));
    return room_reflection(direction) * 0.5 + frame.lights[0].radiance.rgb * key_box * 9.0 + frame.lights[1].radiance.rgb * fill_box * 4.0;
}

// Trowbridge-Reitz distribution.
fn distribution(n_dot_h: f32, roughness: f32) -> f32 {
    let alpha = roughness * roughness;
    let a2 = alpha * alpha;
    let d = n_dot_h * n_dot_h * (a2 - 1.0) + 1.0;
    return a2 / (PI * d * d);
}

fn fresnel(f0: f32, v_dot_h: f32) -> f32 {
    return f0 + (1.0 - f0) * pow(1.0 - v_dot_h, 5.0);
}

// Highlight of one light, times N.L: D F / (4 (L.H)^2), Kelemen and Szirmay-Kalos 2001.
fn highlight(normal: vec3<f32>, view: vec3<f32>, light: vec3<f32>, roughness: f32, f0: f32) -> f32 {
    let n_dot_l = dot(normal, light);
    if n_dot_l <= 0.0 {
        return 0.0;
    }
    let halfway = normalize(light + view);
    let n_dot_h = clamp(dot(normal, halfway), 0.0, 1.0);
    let l_dot_h = clamp(dot(light, halfway), 0.0, 1.0);
    return n_dot_l * distribution(n_dot_h, roughness) * fresnel(f0, l_dot_h) / (4.0 * max(l_dot_h * l_dot_h, 0.06)) * PI;
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
