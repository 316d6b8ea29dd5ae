// Skin: light that enters and comes out again is written apart from what its oil reflects, and scattered afterwards.
//!include surface
//!include lighting

// Reflectance at normal incidence of the skin's oil (index 1.4).
const F0: f32 = 0.028;
// Share of the oil's smoother lobe, and how much smoother it is. Tuned by eye.
const OILY_SHARE: f32 = 0.45;
const OILY_ROUGHNESS: f32 = 0.62;

// Optical density a unit of haemoglobin adds to red, green and blue (Tsumura and others 1999).
const HAEMOGLOBIN: vec3<f32> = vec3<f32>(0.2988, 0.6838, 0.6657);
// The view of blood is fully red or cyan at this change, optical density.
const BLOOD_SHOWN: f32 = 0.25;

// Haemoglobin more than at rest, optical density.
fn blood_change(uv: vec2<f32>) -> f32 {
    return (textureSample(blood_map, wrinkle_sampler, uv).r * (255.0 / 127.0) - 128.0 / 127.0) * frame.blood.x;
}

// Linear RGB of skin that holds `change` more haemoglobin (Jimenez and others 2010, without their table).
fn with_blood(albedo: vec3<f32>, change: f32) -> vec3<f32> {
    return albedo * exp(-change * HAEMOGLOBIN);
}

// Lids are thin, but what shines through them goes on into the ball they lie on: 0 on the lids, 1 off them.
fn off_the_eyes(rest: vec3<f32>) -> f32 {
    let eyes = &frame.eyeballs;
    let far = min(distance(rest, (*eyes)[0].xyz) / (*eyes)[0].w, distance(rest, (*eyes)[1].xyz) / (*eyes)[1].w);
    return smoothstep(1.3, 2.4, far);
}

fn shade(in: Varyings, normal: vec3<f32>) -> Shaded {
    let blood = blood_change(in.uv);
    let albedo = with_blood(albedo_of(in.uv).rgb, blood);
    let finish = finish_of(in.uv);
    let smooth_normal = normalize(in.normal);
    let view = normalize(frame.eye.xyz - in.world);
    let roughness = roughness_seen_from_afar(clamp(finish.roughness * frame.skin.z, 0.2, 1.0), normal);
    let slope = roughness * roughness;
    let in_mouth = mouth_light(in.rest);
    let occlusion = finish.occlusion * in_mouth;
    let visible = key_visibility(in.world, smooth_normal);

    var light_in = ambient_irradiance(normal) * coloured_occlusion(occlusion, albedo);
    var specular = vec3<f32>(0.0);
    for (var i = 0u; i < 4u; i += 1u) {
        let light = frame.lights[i].direction.xyz;
        let arriving = frame.lights[i].radiance.rgb * in_mouth * select(finish.occlusion, visible, i == 0u);
        light_in += arriving * max(dot(normal, light), 0.0);
        let oily = highlight(normal, view, light, slope * OILY_ROUGHNESS * OILY_ROUGHNESS, F0);
        let dry = highlight(normal, view, light, slope, F0);
        // The oil lies over the same rough skin: both lobes are hidden alike.
        let seen = masking(view, light, slope);
        // Rims outline by their diffuse light; their highlights would look like sweat.
        specular += arriving * (mix(dry, oily, OILY_SHARE) * seen) * select(1.0, 0.2, i > 1u);
    }
    let key = frame.lights[0];
    let behind = clamp(0.3 - dot(smooth_normal, key.direction.xyz), 0.0, 1.0);
    var through = vec3<f32>(0.0);
    if behind > 0.0 && frame.skin.w > 0.0 {
        let flesh = 1000.0 * thickness(in.world, smooth_normal) * frame.skin.x;
        through = key.radiance.rgb * transmittance(flesh) * (behind * occlusion * frame.skin.w * off_the_eyes(in.rest));
    }
    if frame.shown.x == SHOW_TRANSLUCENCY {
        return Shaded(vec4<f32>(0.0, 0.0, 0.0, 2.0), vec4<f32>(albedo * through, depth_of(in.world)));
    }
    let n_dot_v = clamp(dot(normal, view), 0.0, 1.0);
    let reflected = reflect(-view, normal);
    // What lies below the horizon of the smooth surface is skin, not the room.
    let horizon = clamp(1.0 + 1.3 * dot(reflected, smooth_normal), 0.0, 1.0);
    specular += room_reflection(reflected, roughness) * ambient_fresnel(F0, roughness, n_dot_v) * occlusion * occlusion * horizon * horizon;
    let diffuse = albedo * (light_in + through);
    if frame.shown.x == SHOW_BLOOD {
        let grey = grey_of(diffuse);
        let hue = select(vec3<f32>(0.0, 0.75, 0.85), vec3<f32>(0.95, 0.10, 0.05), blood > 0.0);
        return display(mix(grey, hue * (0.4 + grey), clamp(abs(blood) / BLOOD_SHOWN, 0.0, 1.0)));
    }
    return shaded(in.world, min(diffuse, vec3<f32>(BRIGHTEST)), min(specular * (frame.skin.y * finish.intensity), vec3<f32>(BRIGHTEST)), in_mouth);
}

@fragment
fn fs_wrinkled(in: Varyings) -> Shaded {
    return shade(in, wrinkled_normal(in));
}

@fragment
fn fs_bare(in: Varyings) -> Shaded {
    return shade(in, bare_normal(in));
}
