// A clear film: it adds highlights to what lies under it and hides nothing.
//!include surface
//!include lighting

const F0: f32 = 0.03;
const ROUGHNESS: f32 = 0.08;

@fragment
fn fs_bare(in: Varyings) -> Shaded {
    let normal = normalize(in.normal);
    let view = normalize(frame.eye.xyz - in.world);
    let film = studio_reflection(reflect(-view, normal)) * ambient_fresnel(F0, ROUGHNESS, clamp(dot(normal, view), 0.0, 1.0));
    return shaded(in.world, vec3<f32>(0.0), min(film, vec3<f32>(BRIGHTEST)), 0.0);
}
