// How strongly reference poses show, over a grey face. Writes display values, not light.
//!include surface
//!include hues

@fragment
fn fs_influence(in: Varyings) -> Shaded {
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
    return over_grey(in.normal, in.world, colour, total * 1.4);
}
