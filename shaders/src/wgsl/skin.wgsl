// Skin. Light bleeds further in red than in blue, so red sees a smoother surface and wraps further round it.
//!include surface
//!include lighting

// How much of the fine normal each colour loses, and how far each wraps past the terminator. Tuned by eye.
const SMOOTHED: vec3<f32> = vec3<f32>(0.34, 0.15, 0.08);
const WRAP: vec3<f32> = vec3<f32>(0.17, 0.09, 0.065);
// Reflectance at normal incidence of the skin's oil (index 1.4).
const F0: f32 = 0.028;

fn diffuse(normal: vec3<f32>, smooth_normal: vec3<f32>, light: vec3<f32>) -> vec3<f32> {
    let n_dot_l = mix(vec3<f32>(dot(normal, light)), vec3<f32>(dot(smooth_normal, light)), SMOOTHED);
    let wrapped = max((n_dot_l + WRAP) / (1.0 + WRAP), vec3<f32>(0.0));
    // Light that wraps is light that is missing elsewhere. The terminator has no edge.
    let toe = smoothstep(0.0, 0.35, wrapped.g + 0.12);
    return wrapped * mix(0.45, 1.0, toe) / (1.0 + 0.5 * WRAP);
}

fn shade(in: Varyings, normal: vec3<f32>) -> vec4<f32> {
    let albedo = albedo_of(in.uv).rgb;
    let finish = finish_of(in.uv);
    let smooth_normal = normalize(in.normal);
    let view = normalize(frame.eye.xyz - in.world);
    let roughness = roughness_seen_from_afar(clamp(finish.roughness, 0.2, 1.0), normal);
    let in_mouth = mouth_light(in.rest);
    let occlusion = finish.occlusion * in_mouth;

    let visible = key_visibility(in.world, smooth_normal);
    // Light that enters beside a shadow's edge comes out under it, red the most.
    let key_light = vec3<f32>(mix(visible, sqrt(visible), 0.25), mix(visible, sqrt(visible), 0.06), visible);

    var diffuse_light = ambient_irradiance(mix(normal, smooth_normal, 0.4)) * occlusion;
    var specular = vec3<f32>(0.0);
    for (var i = 0u; i < 4u; i += 1u) {
        let light = frame.lights[i].direction.xyz;
        var arriving = frame.lights[i].radiance.rgb * in_mouth;
        if i == 0u {
            arriving *= key_light;
        } else {
            arriving *= finish.occlusion;
        }
        diffuse_light += arriving * diffuse(normal, smooth_normal, light);
        let oily = highlight(normal, view, light, roughness * 0.62, F0);
        let dry = highlight(normal, view, light, roughness, F0);
        // Rims outline by their diffuse light; their highlights would look like sweat.
        specular += arriving * mix(dry, oily, 0.22) * select(1.0, 0.2, i > 1u);
    }
    let n_dot_v = clamp(dot(normal, view), 0.0, 1.0);
    let reflected = reflect(-view, normal);
    specular += room_reflection(reflected) * ambient_fresnel(F0, roughness, n_dot_v) * occlusion * occlusion ;
    return vec4<f32>(min(albedo * diffuse_light + specular, vec3<f32>(BRIGHTEST)), 1.0);
}

@fragment
fn fs_wrinkled(in: Varyings) -> @location(0) vec4<f32> {
    return shade(in, wrinkled_normal(in));
}

@fragment
fn fs_bare(in: Varyings) -> @location(0) vec4<f32> {
    return shade(in, bare_normal(in));
}
