// Everything that is neither skin nor eye nor hair: teeth, gums, tongue, cloth.
//!include surface
//!include lighting

const F0: f32 = 0.04;

fn shade(in: Varyings, normal: vec3<f32>) -> vec4<f32> {
    let albedo = albedo_of(in.uv).rgb;
    let finish = finish_of(in.uv);
    let view = normalize(frame.eye.xyz - in.world);
    let roughness = roughness_seen_from_afar(clamp(finish.roughness, 0.15, 1.0), normal);
    let in_mouth = mouth_light(in.rest);
    let occlusion = finish.occlusion * in_mouth;
    let visible = key_visibility(in.world, normalize(in.normal));
    var light_in = ambient_irradiance(normal) * occlusion;
    var specular = vec3<f32>(0.0);
    for (var i = 0u; i < 4u; i += 1u) {
        let light = frame.lights[i].direction.xyz;
        let arriving = frame.lights[i].radiance.rgb * occlusion * select(1.0, visible, i == 0u);
        light_in += arriving * max((dot(normal, light) + 0.1) / 1.21, 0.0);
        specular += arriving * highlight(normal, view, light, roughness, F0);
    }
    specular += room_reflection(reflect(-view, normal)) * ambient_fresnel(F0, roughness, clamp(dot(normal, view), 0.0, 1.0)) * occlusion * visible;
    return vec4<f32>(min(albedo * light_in + specular, vec3<f32>(BRIGHTEST)), 1.0);
}

@fragment
fn fs_bare(in: Varyings) -> @location(0) vec4<f32> {
    return shade(in, bare_normal(in));
}
