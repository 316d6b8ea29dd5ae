// A dark grey studio wall, a little lighter behind the head.
//!include output

struct Varyings {
    @builtin(position) clip: vec4<f32>,
    // -1 to 1 across the picture, +Y up.
    @location(0) at: vec2<f32>,
}

@vertex
fn vs_background(@builtin(vertex_index) index: u32) -> Varyings {
    // One triangle larger than the picture.
    let at = vec2<f32>(f32(index & 1u) * 4.0 - 1.0, f32(index >> 1u) * 4.0 - 1.0);
    return Varyings(vec4<f32>(at, 1.0, 1.0), at);
}

@fragment
fn fs_background(in: Varyings) -> Shaded {
    let distance = length((in.at - vec2<f32>(0.0, 0.1)) * vec2<f32>(0.85, 0.75));
    let light = mix(0.115, 0.030, smoothstep(0.0, 1.35, distance));
    return Shaded(vec4<f32>(0.0, 0.0, 0.0, 1.0), vec4<f32>(vec3<f32>(0.96, 0.99, 1.04) * light, FAR));
}
