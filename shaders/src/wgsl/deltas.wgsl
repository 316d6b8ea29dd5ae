// How far the expression shapes move the face, over a grey face. Writes display values, not light.
//!include surface
//!include hues

// Metres that are shown as the hottest: twice as far as most shapes go, half of what a jaw does.
const HOTTEST: f32 = 0.012;

@vertex
fn vs_deltas(in: VertexIn) -> Varyings {
    var out = vary(in);
    out.influences_0_3.x = distance(morph(in).position, in.position);
    return out;
}

@fragment
fn fs_deltas(in: Varyings) -> Shaded {
    let share = in.influences_0_3.x / HOTTEST;
    return over_grey(in.normal, in.world, heat(share), share * 8.0);
}
