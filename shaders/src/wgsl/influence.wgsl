// How strongly reference poses show, over a grey face. Writes display values, not light.
//!include surface

// Poses in their own hues where all are shown; any of them alone runs from blue over green to red.
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

@fragment
fn fs_influence(in: Varyings) -> Shaded {
    let view = normalize(frame.eye.xyz - in.world);
    let grey = 0.18 + 0.52 * clamp(dot(normalize(in.normal), view), 0.0, 1.0);
    var num_shown = 0.0;
    var total = 0.0;
    var hue = vec3<f32>(0.0);
    for (var pose = 0u; pose < NUM_POSES; pose += 1u) {
        let is_shown = frame.shown_poses[pose / 4u][pose % 4u];
        let value = influence(in, pose) * is_shown;
        num_shown += is_shown;
        total += value;
        hue += HUES[pose] * value;
    }
    let colour = select(hue / max(total, 1e-4), heat(total), num_shown < 1.5);
    let cover = clamp(total * 1.4, 0.0, 1.0);
    return display(mix(vec3<f32>(grey), colour * (0.45 + 0.55 * grey / 0.7), cover));
}
