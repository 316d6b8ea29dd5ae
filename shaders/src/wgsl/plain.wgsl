// Everything that is neither skin nor eye nor hair: teeth, gums, tongue, cloth.
//!include surface
//!include lighting

const F0: f32 = 0.04;
// Enamel and gums are turbid: a little of the light bleeds.
const SCATTERING: f32 = 0.4;

fn shade(in: Varyings, normal: vec3<f32>) -> Shaded {
    let albedo = albedo_of(in.uv).rgb;
    let finish = finish_of(in.uv);
    let view = normalize(frame.eye.xyz - in.world);
    let roughness = roughness_seen_from_afar(clamp(finish.roughness, 0.15, 1.0), normal);
    let in_mouth = mouth_light(in.rest);
    let occlusion = finish.occlusion * in_mouth;
    let visible = key_visibility(in.world, normalize(in.normal));
    var light_in = ambient_irradiance(normal) * coloured_occlusion(occlusion, albedo);
    var specular = vec3<f32>(0.0);
    for (var i = 0u; i < 4u; i += 1u) {
        let light = frame.lights[i].direction.xyz;
        let arriving = frame.lights[i].radiance.rgb * occlusion * select(1.0, visible, i == 0u);
        light_in += arriving * max((dot(normal, light) + 0.1) / 1.21, 0.0);
        specular += arriving * highlight(normal, view, light, roughness * roughness, F0) * masking(view, light, roughness * roughness);
    }
    let reflected = room_reflection(reflect(-view, normal), roughness);
    specular += reflected * ambient_fresnel(F0, roughness, clamp(dot(normal, view), 0.0, 1.0)) * occlusion * visible;
    return shaded(in.world, min(albedo * light_in, vec3<f32>(BRIGHTEST)), min(specular, vec3<f32>(BRIGHTEST)), SCATTERING);
}

@fragment
fn fs_bare(in: Varyings) -> Shaded {
    return shade(in, bare_normal(in));
}
