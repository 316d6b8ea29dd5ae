// What is the same for every draw of a frame. World space is the character's model space: metres, +Y up, +Z out of the face.

struct Light {
    // Unit vector towards the light, world space.
    direction: vec4<f32>,
    // Linear RGB; a white surface that faces the light reflects this much.
    radiance: vec4<f32>,
}

struct Frame {
    clip_from_world: mat4x4<f32>,
    // Clip space of the key light's shadow map.
    shadow_from_world: mat4x4<f32>,
    // Takes world space back to the head at neutral: three rows.
    head_from_world: array<vec4<f32>, 3>,
    // World space; w: metres a shadow texel covers.
    eye: vec4<f32>,
    // Key (it alone casts shadows), fill, two rims.
    lights: array<Light, 4>,
    // Irradiance from above and from below, linear RGB.
    sky: vec4<f32>,
    ground: vec4<f32>,
    // Middle of the inner lips in head space; w: half the mouth's width.
    mouth: vec4<f32>,
    // x: how deep light reaches into the mouth. y: how far its corners lie behind its middle. In units of mouth.w.
    mouth_shape: vec4<f32>,
    // Centres of the eyeballs in head space, left and right; w: radius.
    eyeballs: array<vec4<f32>, 2>,
    // Influence view: 1 for each pose shown.
    shown_poses: array<vec4<f32>, 2>,
}

@group(0) @binding(0) var<uniform> frame: Frame;

fn head_from_world(world: vec3<f32>) -> vec3<f32> {
    let p = vec4<f32>(world, 1.0);
    return vec3<f32>(dot(frame.head_from_world[0], p), dot(frame.head_from_world[1], p), dot(frame.head_from_world[2], p));
}
