// World-space normals as colours. Writes display values, not light.
//!include surface

@fragment
fn fs_wrinkled(in: Varyings) -> @location(0) vec4<f32> {
    return vec4<f32>(wrinkled_normal(in) * 0.5 + 0.5, 1.0);
}

@fragment
fn fs_bare(in: Varyings) -> @location(0) vec4<f32> {
    return vec4<f32>(bare_normal(in) * 0.5 + 0.5, 1.0);
}
