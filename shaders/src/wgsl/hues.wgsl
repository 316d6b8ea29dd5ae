// False colours over a grey face.

// Poses or zones in their own hues where all are shown; any of them alone runs from blue over green to red.
const HUES: array<vec3<f32>, 8> = array<vec3<f32>, 8>(
    vec3<f32>(0.95, 0.30, 0.15),
    vec3<f32>(0.15, 0.50, 0.95),
    vec3<f32>(0.95, 0.80, 0.10),
    vec3<f32>(0.35, 0.85, 0.30),
    vec3<f32>(0.80, 0.30, 0.90),
    vec3<f32>(0.10, 0.85, 0.85),
    vec3<f32>(0.95, 0.55, 0.70),
    vec3<f32>(0.60, 0.45, 0.25),
);

fn heat(value: f32) -> vec3<f32> {
    let x = clamp(value, 0.0, 1.0);
    return clamp(vec3<f32>(2.0 * x - 0.6, 1.15 - abs(2.4 * x - 1.2), 1.1 - 2.4 * x), vec3<f32>(0.0), vec3<f32>(1.0));
}

// The hue of number `i` of many: neighbours lie a golden angle apart.
fn hue_of(i: u32) -> vec3<f32> {
    let turn = fract(f32(i) * 0.61803399 + 0.02);
    return 0.15 + 0.8 * clamp(abs(fract(vec3<f32>(turn) + vec3<f32>(0.0, 2.0 / 3.0, 1.0 / 3.0)) * 6.0 - 3.0) - 1.0, vec3<f32>(0.0), vec3<f32>(1.0));
}

// `cover` of a colour over a face of grey, display values.
fn over_grey(normal: vec3<f32>, world: vec3<f32>, colour: vec3<f32>, cover: f32) -> Shaded {
    let view = normalize(frame.eye.xyz - world);
    let grey = 0.18 + 0.52 * clamp(dot(normalize(normal), view), 0.0, 1.0);
    return display(mix(vec3<f32>(grey), colour * (0.45 + 0.55 * grey / 0.7), clamp(cover, 0.0, 1.0)));
}
