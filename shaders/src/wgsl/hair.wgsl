// Brows and lashes: thin, matt, their alpha becomes coverage.
//!include surface
//!include lighting

@fragment
fn fs_bare(in: Varyings, @builtin(front_facing) is_front: bool) -> @location(0) vec4<f32> {
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
    let sheen = frame.lights[0].radiance.rgb * visible * highlight(normal, view, frame.lights[0].direction.xyz, 0.55, 0.04) * 0.3;
    return vec4<f32>(min(albedo.rgb * light_in + sheen, vec3<f32>(BRIGHTEST)), albedo.a);
}
