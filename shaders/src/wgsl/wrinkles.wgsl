// Wrinkle maps blended in tangent space. Slopes are partial derivatives p = n.xy / n.z.

// 0: sum of partial derivatives. 1: weighted mean of whole normals. 2: Whiteout of base and blended wrinkles.
override BLEND: u32 = 0u;

// How wrinkle zones are blended over that (Jimenez et al. 2011). 0: there are none. 1: their partial derivatives are added.
// 2: differences of normals are added. 3: Whiteout of what is there and the zones' wrinkles (Oat 2007).
override ZONES: u32 = 0u;
// 1: stretched zones have a map of their own.
override ZONES_STRETCH: u32 = 0u;

fn normal_of(slope: vec2<f32>) -> vec3<f32> {
    return normalize(vec3<f32>(slope, 1.0));
}

// Codes as a unorm texture gives them; code 128 is exactly flat.
fn slope_of(texel: vec2<f32>, scale: f32) -> vec2<f32> {
    return max((texel * 255.0 - 128.0) / 127.0, vec2<f32>(-1.0)) * scale;
}

// Whiteout (Oat 2007): what Dutreve et al. 2009, 5.3, print.
fn whiteout(base: vec3<f32>, detail: vec3<f32>) -> vec3<f32> {
    return normalize(vec3<f32>(base.xy + detail.xy, base.z * detail.z));
}

// The zones' wrinkles over a normal in tangent space: `slope` is theirs, `difference` what they add to a unit normal.
fn with_zones(normal: vec3<f32>, slope: vec2<f32>, difference: vec3<f32>) -> vec3<f32> {
    if ZONES == 2u {
        return normalize(normal + difference);
    } else if ZONES == 3u {
        return whiteout(normal, normal_of(slope));
    }
    return normal_of(normal.xy / max(normal.z, 0.02) + slope);
}

// Gathers one map after the other. `slope` and `normal` are sums weighted by influence.
struct Blend {
    base: vec2<f32>,
    slope: vec2<f32>,
    normal: vec3<f32>,
    total: f32,
}

fn begin_blend(base: vec2<f32>) -> Blend {
    return Blend(base, vec2<f32>(0.0), vec3<f32>(0.0), 0.0);
}

// `map` is the pose's own slope; `contains_neutral` is 1 where it has the base in it already.
fn add_wrinkle(blend: Blend, map: vec2<f32>, contains_neutral: f32, influence: f32) -> Blend {
    var out = blend;
    let delta = map - blend.base * contains_neutral;
    if BLEND == 0u {
        out.slope += influence * delta;
    } else if BLEND == 1u {
        out.normal += influence * normal_of(blend.base + delta);
    } else {
        out.normal += influence * normal_of(delta);
    }
    out.total += influence;
    return out;
}

// The tangent-space normal. The rest weight is taken here, per fragment.
fn end_blend(blend: Blend) -> vec3<f32> {
    let rest = max(0.0, 1.0 - blend.total);
    if BLEND == 0u {
        return normal_of(blend.base + blend.slope);
    } else if BLEND == 1u {
        return normalize(rest * normal_of(blend.base) + blend.normal);
    }
    return whiteout(normal_of(blend.base), normalize(vec3<f32>(0.0, 0.0, rest) + blend.normal));
}
