// Depth of the character as the key light sees it: once for comparing, once in metres.
//!include frame
//!include skinning

struct Varyings {
    @builtin(position) clip: vec4<f32>,
    @location(0) depth: f32,
}

@vertex
fn vs_shadow(in: VertexIn) -> Varyings {
    let world = vec4<f32>(deform(in).position, 1.0);
    return Varyings(frame.shadow_from_world * world, dot(frame.light_depth, world));
}

@fragment
fn fs_shadow(in: Varyings) -> @location(0) vec4<f32> {
    return vec4<f32>(in.depth, 0.0, 0.0, 1.0);
}
