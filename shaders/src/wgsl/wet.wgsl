// A clear film: it adds highlights to what lies under it and hides nothing.
//!include surface
//!include lighting

const F0: f32 = 0.03;
const ROUGHNESS: f32 = 0.08;
// Root mean square slopes of the water along and across its line. Along it the lid's edge, the mouths of its glands and the
// lashes' roots make it wavy; across it curves within a fraction of a pixel. Tuned by eye.
const SLOPES: vec2<f32> = vec2<f32>(0.42, 0.12);
// Eyes are seen through a few such waves at once: highlights are this much brighter than a smooth surface of that slope.
const GLITTER: f32 = 3.0;

// Highlight of one light on water that is wavier along its line than across it, times N.L: the distribution of Trowbridge
// and Reitz with two slopes (Burley 2012), in the units of `highlight`.
fn line_highlight(in: Varyings, normal: vec3<f32>, view: vec3<f32>, light: vec3<f32>) -> f32 {
    let n_dot_l = max(dot(normal, light), 0.0);
    let sum = light + view;
    let h2 = max(dot(sum, sum), 1e-4);
    let halfway = sum * inverseSqrt(h2);
    let along = normalize(in.tangent.xyz - normal * dot(in.tangent.xyz, normal));
    let across = cross(normal, along);
    let h = vec3<f32>(dot(halfway, along) / SLOPES.x, dot(halfway, across) / SLOPES.y, dot(halfway, normal));
    let d = max(dot(h, h), 1e-3);
    return n_dot_l * fresnel(F0, clamp(dot(view, halfway), 0.0, 1.0)) / (SLOPES.x * SLOPES.y * d * d * h2);
}

@fragment
fn fs_bare(in: Varyings) -> Shaded {
    let normal = normalize(in.normal);
    let view = normalize(frame.eye.xyz - in.world);
    var film = studio_reflection(reflect(-view, normal)) * ambient_fresnel(F0, ROUGHNESS, clamp(dot(normal, view), 0.0, 1.0));
    let visible = key_visibility(in.world, normal);
    for (var i = 0u; i < 4u; i += 1u) {
        let light = frame.lights[i];
        film += light.radiance.rgb * (GLITTER * line_highlight(in, normal, view, light.direction.xyz) * select(1.0, visible, i == 0u));
    }
    return shaded(in.world, vec3<f32>(0.0), min(film, vec3<f32>(BRIGHTEST)), 0.0);
}
