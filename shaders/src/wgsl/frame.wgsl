// What is the same for every draw of a frame. World space is the character's model space: metres, +Y up, +Z out of the face.
//!include output

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
    // Unit vector the camera looks along; w: metres to its target.
    forward: vec4<f32>,
    // dot with (world, 1): metres behind the middle of the shadow map's range, along the key light.
    light_depth: vec4<f32>,
    // Key (it alone casts shadows), fill, two rims.
    lights: array<Light, 4>,
    // Light from all round on a white surface, nine coefficients of spherical harmonics, linear RGB.
    irradiance: array<vec4<f32>, 9>,
    // Middle of the inner lips in head space; w: half the mouth's width.
    mouth: vec4<f32>,
    // x: how deep light reaches into the mouth. y: how far its corners lie behind its middle. In units of mouth.w.
    mouth_shape: vec4<f32>,
    // Centres of the eyeballs in head space, left and right; w: radius.
    eyeballs: array<vec4<f32>, 2>,
    // Where the lids meet, from the centre of each ball in head space, in radii: x and y of the one of lower x, then of the other.
    lid_corners: array<vec4<f32>, 2>,
    // How high their edges arch over the line between the corners just now, in radii: upper and lower of the left eye, of the right.
    lid_arches: vec4<f32>,
    // Where they look: unit vectors, world space.
    gazes: array<vec4<f32>, 2>,
    // x: 1/mm, how fast light dies in the flesh (see transmittance). y: strength of highlights. z: roughness, multiplied.
    // w: how much light leaks through.
    skin: vec4<f32>,
    // x: largest change of haemoglobin the codes of the map of blood reach, optical density; 0 where the colour stays.
    blood: vec4<f32>,
    // x: metres a pixel covers at a metre. y: how much brighter than its light the box is that wet mirrors show.
    picture: vec4<f32>,
    // Views of influences and masks: 1 for each pose or zone shown.
    shown_poses: array<vec4<f32>, 2>,
    // x: see the constants. y: the light that wet mirrors show.
    shown: vec4<u32>,
}

// Only what shines through flesh is shown.
const SHOW_TRANSLUCENCY: u32 = 1u;
// Where blood comes and goes, over a grey face: display values.
const SHOW_BLOOD: u32 = 2u;

@group(0) @binding(0) var<uniform> frame: Frame;

fn head_from_world(world: vec3<f32>) -> vec3<f32> {
    let p = vec4<f32>(world, 1.0);
    return vec3<f32>(dot(frame.head_from_world[0], p), dot(frame.head_from_world[1], p), dot(frame.head_from_world[2], p));
}

// Metres behind the camera's target.
fn depth_of(world: vec3<f32>) -> f32 {
    return dot(world - frame.eye.xyz, frame.forward.xyz) - frame.forward.w;
}

// `scattering` is how much light bleeds sideways, 0 to 1.
fn shaded(world: vec3<f32>, diffuse: vec3<f32>, specular: vec3<f32>, scattering: f32) -> Shaded {
    if frame.shown.x == SHOW_TRANSLUCENCY {
        return Shaded(vec4<f32>(0.0, 0.0, 0.0, 1.0), vec4<f32>(0.0, 0.0, 0.0, depth_of(world)));
    }
    if frame.shown.x == SHOW_BLOOD {
        return display(grey_of(diffuse));
    }
    return Shaded(vec4<f32>(specular, 1.0 + scattering), vec4<f32>(diffuse, depth_of(world)));
}

// A grey to lay false colours over, display value.
fn grey_of(light: vec3<f32>) -> vec3<f32> {
    let luma = dot(max(light, vec3<f32>(0.0)), vec3<f32>(0.2126, 0.7152, 0.0722));
    return vec3<f32>(0.72 * sqrt(luma / (0.35 + luma)));
}

// Display values: they pass through all that follows as they are.
fn display(colour: vec3<f32>) -> Shaded {
    return Shaded(vec4<f32>(0.0, 0.0, 0.0, 1.0), vec4<f32>(colour, 0.0));
}
