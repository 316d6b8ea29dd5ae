// World-space normals as colours. Writes display values, not light.
//!include surface

@fragment
fn fs_wrinkled(in: Varyings) -> Shaded {
    return display(wrinkled_normal(in) * 0.5 + 0.5);
}

@fragment
fn fs_bare(in: Varyings) -> Shaded {
    return display(bare_normal(in) * 0.5 + 0.5);
}
