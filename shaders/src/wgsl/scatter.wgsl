// Separable subsurface scattering in screen space, one direction a draw (Jimenez, Zsolnai and others 2011; after the
// screen-space method of Jimenez, Sundstedt and Gutierrez 2009). Works on linear light before any highlight is added.
//!include fullscreen

struct Scatter {
    // rgb: weights, w: offset in mm along the direction. The middle comes first.
    kernel: array<vec4<f32>, 25>,
    // Part of the picture that a millimetre covers at a metre from the camera, along the direction.
    uv_per_mm_at_metre: vec2<f32>,
    // Metres from the camera at which the stored depth is zero.
    depth_origin: f32,
    // Share of the middle's colour a metre of difference in depth gives back, so that light does not leak over edges.
    rejection: f32,
    num_samples: u32,
}

@group(0) @binding(0) var<uniform> scatter: Scatter;
// Light that came out of the skin; alpha: metres behind the depth origin.
@group(0) @binding(1) var diffuse: texture_2d<f32>;
// Alpha: 1 + how much the surface scatters.
@group(0) @binding(2) var specular: texture_2d<f32>;
@group(0) @binding(3) var linear_sampler: sampler;

@fragment
fn fs_scatter(@builtin(position) at: vec4<f32>) -> @location(0) vec4<f32> {
    let texel = vec2<i32>(at.xy);
    let middle = textureLoad(diffuse, texel, 0);
    let strength = max(textureLoad(specular, texel, 0).a - 1.0, 0.0);
    if strength <= 0.0 {
        return middle;
    }
    let uv = at.xy / vec2<f32>(textureDimensions(diffuse));
    let step = scatter.uv_per_mm_at_metre * strength / max(middle.a + scatter.depth_origin, 0.01);
    var sum = scatter.kernel[0].rgb * middle.rgb;
    for (var i = 1u; i < scatter.num_samples; i += 1u) {
        let tap = scatter.kernel[i];
        let there = textureSampleLevel(diffuse, linear_sampler, uv + step * tap.w, 0.0);
        let apart = clamp(abs(there.a - middle.a) * scatter.rejection, 0.0, 1.0);
        sum += tap.rgb * mix(there.rgb, middle.rgb, apart);
    }
    return vec4<f32>(sum, middle.a);
}
