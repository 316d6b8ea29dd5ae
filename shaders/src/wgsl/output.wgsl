// What the scene passes write.

// Depth of what lies behind everything, metres behind the camera's target.
const FAR: f32 = 8.0;

struct Shaded {
    // Highlights, linear RGB. Alpha: 1 + how much the surface scatters; below 1 it is coverage, where that counts.
    @location(0) specular: vec4<f32>,
    // Light that came out of the surface, linear RGB (or display values, see the views). Alpha: metres behind the target.
    @location(1) diffuse: vec4<f32>,
}
