// Brows and lashes: thin, matt. Strands have their own geometry and are blended; on cards alpha becomes coverage.
//!include surface
//!include lighting

// Metres.
const HAIR_STAND_OFF: f32 = 0.05;
// Pixels a strand is widened by on each side: one thinner than a pixel would fall between its samples here and there, and
// crawl when the head turns. What it is wider than it should be it lets through.
const WIDENED: f32 = 0.35;

// Strands have u across: 0 and 1 at their borders, a half at their tip.
@vertex
fn vs_strand(in: VertexIn) -> Varyings {
    var out = vary(in);
    let towards = frame.eye.xyz - out.world;
    let distance = length(towards);
    let view = towards / distance;
    let across = out.tangent.xyz - view * dot(out.tangent.xyz, view);
    out.world += across / max(length(across), 0.3) * (2.0 * in.uv.x - 1.0) * WIDENED * frame.picture.x * distance;
    out.clip = frame.clip_from_world * vec4<f32>(out.world, 1.0);
    return out;
}

// Share of a strand's width that is hair. More than its true width counts: lashes lie over others of their row, and what the
// pixel takes off their contrast is given back. Tuned by eye.
fn strand_cover(u: f32) -> f32 {
    let pixels = 1.0 / max(length(vec2<f32>(dpdx(u), dpdy(u))), 1e-4);
    return clamp(1.0 - 1.3 * WIDENED / pixels, 0.25, 1.0);
}

// Alphas as `shaded` gives them.
fn shade(in: Varyings, is_front: bool, albedo: vec3<f32>) -> Shaded {
    let normal = normalize(select(-in.normal, in.normal, is_front));
    let view = normalize(frame.eye.xyz - in.world);
    let visible = key_visibility(in.world, normal);
    var light_in = ambient_irradiance(normal);
    for (var i = 0u; i < 4u; i += 1u) {
        let arriving = frame.lights[i].radiance.rgb * select(1.0, visible, i == 0u);
        // A fibre has no side that is wholly dark.
        light_in += arriving * max((dot(normal, frame.lights[i].direction.xyz) + 0.5) / 2.25, 0.0);
    }
    let key = frame.lights[0].direction.xyz;
    let sheen = frame.lights[0].radiance.rgb * visible * highlight(normal, view, key, 0.30, 0.04) * masking(view, key, 0.30) * 0.3;
    return shaded(in.world, min(albedo * light_in, vec3<f32>(BRIGHTEST)), sheen, 0.0);
}

@fragment
fn fs_strand(in: Varyings, @builtin(front_facing) is_front: bool) -> Shaded {
    let cover = strand_cover(in.uv.x);
    let albedo = albedo_of(in.uv);
    var out = shade(in, is_front, albedo.rgb);
    out.specular.a = cover * albedo.a;
    out.diffuse.a = cover * albedo.a;
    return out;
}

@fragment
fn fs_bare(in: Varyings, @builtin(front_facing) is_front: bool) -> Shaded {
    let albedo = albedo_of(in.uv);
    var out = shade(in, is_front, albedo.rgb);
    out.specular.a = albedo.a;
    // A pixel that is partly hair seems to stand off: scattering neither blurs it nor takes its darkness into the skin.
    out.diffuse.a -= HAIR_STAND_OFF;
    return out;
}
