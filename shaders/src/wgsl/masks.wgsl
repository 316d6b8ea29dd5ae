// Where wrinkles may show: the zones' masks (Jimenez et al. 2011), or the skinning weights that Dutreve et al. 2009, 5.2, use
// as masks. Over a grey face. Writes display values, not light.
//!include surface
//!include hues

@fragment
fn fs_zones(in: Varyings) -> Shaded {
    var num_shown = 0.0;
    var total = 0.0;
    var hue = vec3<f32>(0.0);
    // Only skin has the masks' part of the texture.
    if ZONES != 0u {
        let masks = masks_of(in.uv);
        for (var zone = 0u; zone < 8u; zone += 1u) {
            let is_shown = frame.shown_poses[zone / 4u][zone % 4u];
            let value = masks[zone / 4u][zone % 4u] * is_shown;
            num_shown += is_shown;
            total += value;
            hue += HUES[zone] * value;
        }
    }
    let colour = select(hue / max(total, 1e-4), heat(total), num_shown < 1.5);
    return over_grey(in.normal, in.world, colour, total * 1.4);
}

// Red, green and blue: hues of the bones by their weights; the fourth: weight of all bones, the rest is the head's.
@vertex
fn vs_bones(in: VertexIn) -> Varyings {
    var out = vary(in);
    for (var slot = 0u; slot < 4u; slot += 1u) {
        let joint = in.joints[slot];
        if joint < pose_table.num_bones {
            out.influences_0_3 += in.weights[slot] * vec4<f32>(hue_of(joint), 1.0);
        }
    }
    return out;
}

@fragment
fn fs_bones(in: Varyings) -> Shaded {
    let total = in.influences_0_3.w;
    return over_grey(in.normal, in.world, in.influences_0_3.xyz / max(total, 1e-4), total);
}
