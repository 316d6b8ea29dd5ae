// Depth of the character as the key light sees it.
//!include frame
//!include skinning

@vertex
fn vs_shadow(in: VertexIn) -> @builtin(position) vec4<f32> {
    return frame.shadow_from_world * vec4<f32>(deform(in).position, 1.0);
}
