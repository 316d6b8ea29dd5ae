// Eyeballs: a matt white with its iris under a wet, sharp film.
//!include surface
//!include lighting

const F0: f32 = 0.03;
const FILM_ROUGHNESS: f32 = 0.09;

// The lids shade the ball along their edge: it is darkest under the upper one.
fn lid_light(head: vec3<f32>) -> f32 {
    let left = frame.eyeballs[0];
    let right = frame.eyeballs[1];
    let ball = select(right, left, distance(head, left.xyz) < distance(head, right.xyz));
    let offset = (head - ball.xyz) / ball.w;
    let upper = smoothstep(0.10, 0.55, offset.y);
    let lower = smoothstep(-0.22, -0.60, offset.y);
    let corner = smoothstep(0.45, 0.95, abs(offset.x));
    return (1.0 - 0.62 * upper) * (1.0 - 0.35 * lower) * (1.0 - 0.40 * corner);
}

fn shade(in: Varyings) -> vec4<f32> {
    let albedo = albedo_of(in.uv).rgb;
    let normal = normalize(in.normal);
    let view = normalize(frame.eye.xyz - in.world);
    let occlusion = lid_light(head_from_world(in.world));
    let visible = key_visibility(in.world, normal);

    var light_in = ambient_irradiance(normal) * occlusion;
    var film = vec3<f32>(0.0);
    for (var i = 0u; i < 4u; i += 1u) {
        let light = frame.lights[i].direction.xyz;
        let arriving = frame.lights[i].radiance.rgb * occlusion * select(1.0, visible, i == 0u);
        // The white lets light through, so it turns dark late.
        light_in += arriving * max((dot(normal, light) + 0.2) / 1.44, 0.0);
        if i > 1u {
            // Key and fill are seen in the film as soft boxes.
            film += arriving * highlight(normal, view, light, FILM_ROUGHNESS, F0) * 0.25;
        }
    }
    let reflected = reflect(-view, normal);
    film += studio_reflection(reflected) * ambient_fresnel(F0, FILM_ROUGHNESS, clamp(dot(normal, view), 0.0, 1.0)) * mix(0.3, 1.0, occlusion);
    return vec4<f32>(min(albedo * light_in + film, vec3<f32>(BRIGHTEST)), 1.0);
}

@fragment
fn fs_bare(in: Varyings) -> @location(0) vec4<f32> {
    return shade(in);
}
