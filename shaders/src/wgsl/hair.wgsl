// Brows and lashes: thin, matt, their alpha becomes coverage.
//!include surface
//!include lighting

// Metres.
const HAIR_STAND_OFF: f32 = 0.05;

@fragment
fn fs_bare(in: Varyings, @builtin(front_facing) is_front: bool) -> Shaded {
    let albedo = albedo_of(in.uv);
    let normal = normalize(select(-in.normal, in.normal, is_front));
    let view = normalize(frame.eye.xyz - in.world);
    let visible = key_visibility(in.world, normal);
    var light_in = ambient_irradiance(normal);
    for (var i = 0u; i < 4u; i += 1u) {
        let arriving = frame.lights[i].radiance.rgb * select(1.0, visible, i == 0u);
        // A fibre has no side that is wholly dark.
        light_in += arriving * max((dot(normal, frame.lights[i].direction.xyz) + 0.5) / 2.25, 0.0);
    }
    let sheen = frame.lights[0].radiance.rgb * visible * highlight(normal, view, frame.lights[0].direction.xyz, 0.30, 0.04) * 0.3;
    var out = shaded(in.world, min(albedo.rgb * light_in, vec3<f32>(BRIGHTEST)), sheen, 0.0);
    out.specular.a = albedo.a;
    // A pixel that is partly hair seems to stand off: scattering neither blurs it nor takes its darkness into the skin.
    out.diffuse.a -= HAIR_STAND_OFF;
    return out;
}
