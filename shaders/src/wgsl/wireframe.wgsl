// Edges over a dark body. Writes display values, not light.
//!include frame
//!include skinning

struct Varyings {
    @builtin(position) clip: vec4<f32>,
    @location(0) facing: f32,
}

fn vary(in: VertexIn) -> Varyings {
    let deformed = deform(in);
    let facing = dot(deformed.normal, normalize(frame.eye.xyz - deformed.position));
    return Varyings(frame.clip_from_world * vec4<f32>(deformed.position, 1.0), facing);
}

@vertex
fn vs_body(in: VertexIn) -> Varyings {
    return vary(in);
}

@vertex
fn vs_edges(in: VertexIn) -> Varyings {
    var out = vary(in);
    // Lines take no depth bias, so they are brought nearer by a hair here.
    out.clip.z -= 1e-4 * out.clip.w;
    return out;
}

@fragment
fn fs_body(in: Varyings) -> Shaded {
    return display(vec3<f32>(0.10, 0.11, 0.13) * (0.5 + 0.5 * clamp(in.facing, 0.0, 1.0)));
}

@fragment
fn fs_edges(in: Varyings) -> Shaded {
    return display(vec3<f32>(0.45, 0.80, 0.95) * (0.35 + 0.65 * clamp(in.facing, 0.0, 1.0)));
}
