// Expression shapes, linear-blend skinning with normals that follow both, and the vertex influences of Dutreve et al. 2009, 5.2.

// Reference poses of the character, at most 8.
override NUM_POSES: u32 = 4u;

// Joint matrices, three rows each: entry i below the number of bones is bone i's.
struct Palette {
    rows: array<vec4<f32>, 576>,
}

// Influences I_ik, bone-major: one vec4 a bone for up to four poses, else two.
struct Coefficients {
    bones: array<vec4<f32>, 128>,
}

// What never changes about the reference poses.
struct PoseTable {
    // 1 where the pose moves the bone, laid out as Coefficients.
    moved: array<vec4<f32>, 128>,
    // Largest slope of each pose's wrinkle map.
    scales: array<vec4<f32>, 2>,
    // 1 where the map also contains the pores of the neutral map.
    contains_neutral: array<vec4<f32>, 2>,
    num_bones: u32,
    // Weight from which wrinkles stop fading, in (0, 1]; 1 is the paper's plain sum.
    falloff: f32,
}

@group(1) @binding(0) var<uniform> palette: Palette;
@group(1) @binding(1) var<uniform> coefficients: Coefficients;
@group(1) @binding(2) var<uniform> pose_table: PoseTable;

// Weights of the expression shapes.
struct MorphWeights {
    // In ARKit's order, four a vector.
    shapes: array<vec4<f32>, 13>,
    // 0: no shape moves anything, the deltas are not read.
    is_active: u32,
}

// Three texels an entry, entries side by side: displacement and number of its shape, then how the displacement changes
// along tangent and bitangent.
@group(1) @binding(5) var morph_deltas: texture_2d<f32>;
@group(1) @binding(6) var<uniform> morph_weights: MorphWeights;

struct VertexIn {
    @location(0) position: vec3<f32>,
    @location(1) normal: vec3<f32>,
    @location(2) tangent: vec4<f32>,
    @location(3) uv: vec2<f32>,
    @location(4) joints: vec4<u32>,
    @location(5) weights: vec4<f32>,
    @location(6) gradients_1_2: vec4<f32>,
    @location(7) gradient_3: vec2<f32>,
    // First entry in the deltas and number of entries.
    @location(8) morphs: vec2<u32>,
}

struct Deformed {
    position: vec3<f32>,
    normal: vec3<f32>,
    tangent: vec3<f32>,
}

fn transform(joint: u32, v: vec4<f32>) -> vec3<f32> {
    let row = joint * 3u;
    return vec3<f32>(dot(palette.rows[row], v), dot(palette.rows[row + 1u], v), dot(palette.rows[row + 2u], v));
}

// A vertex of the neutral mesh after the expression shapes: where it is, and what its tangent and bitangent have become,
// neither unit nor orthogonal.
struct Morphed {
    position: vec3<f32>,
    tangent: vec3<f32>,
    bitangent: vec3<f32>,
}

fn morph(in: VertexIn) -> Morphed {
    var out = Morphed(in.position, in.tangent.xyz, cross(in.normal, in.tangent.xyz));
    if morph_weights.is_active == 0u {
        return out;
    }
    let per_row = textureDimensions(morph_deltas).x / 3u;
    for (var entry = in.morphs.x; entry < in.morphs.x + in.morphs.y; entry += 1u) {
        let at = vec2<i32>(i32(entry % per_row) * 3, i32(entry / per_row));
        let delta = textureLoad(morph_deltas, at, 0);
        let shape = u32(delta.w);
        let weight = morph_weights.shapes[shape / 4u][shape % 4u];
        if weight != 0.0 {
            out.position += weight * delta.xyz;
            out.tangent += weight * textureLoad(morph_deltas, at + vec2<i32>(1, 0), 0).xyz;
            out.bitangent += weight * textureLoad(morph_deltas, at + vec2<i32>(2, 0), 0).xyz;
        }
    }
    return out;
}

// F = sum w_i A_i + sum (M_i v)(grad w_i)^T. With t, b, n orthonormal, cof(F) n = cof(F)(t x b) = F t x F b.
// The gradients sum to zero, so M_0 v is taken off the other three and weight 0's own gradient is not needed.
// With shapes v, t and b are the morphed ones: the chain rule leaves the rest as it is.
fn deform(in: VertexIn) -> Deformed {
    let morphed = morph(in);
    let v = vec4<f32>(morphed.position, 1.0);
    let t = vec4<f32>(morphed.tangent, 0.0);
    let bitangent = vec4<f32>(morphed.bitangent, 0.0);
    let moved_0 = transform(in.joints.x, v);
    let moved_1 = transform(in.joints.y, v);
    let moved_2 = transform(in.joints.z, v);
    let moved_3 = transform(in.joints.w, v);
    let w = in.weights;
    var out: Deformed;
    out.position = moved_0 * w.x + moved_1 * w.y + moved_2 * w.z + moved_3 * w.w;
    let apart_1 = moved_1 - moved_0;
    let apart_2 = moved_2 - moved_0;
    let apart_3 = moved_3 - moved_0;
    let f_t = transform(in.joints.x, t) * w.x + transform(in.joints.y, t) * w.y + transform(in.joints.z, t) * w.z + transform(in.joints.w, t) * w.w
        + apart_1 * in.gradients_1_2.x + apart_2 * in.gradients_1_2.z + apart_3 * in.gradient_3.x;
    let f_b = transform(in.joints.x, bitangent) * w.x + transform(in.joints.y, bitangent) * w.y + transform(in.joints.z, bitangent) * w.z + transform(in.joints.w, bitangent) * w.w
        + apart_1 * in.gradients_1_2.y + apart_2 * in.gradients_1_2.w + apart_3 * in.gradient_3.y;
    let across = cross(f_t, f_b);
    out.normal = across * inverseSqrt(max(dot(across, across), 1e-30));
    let along = f_t - out.normal * dot(f_t, out.normal);
    out.tangent = along * inverseSqrt(max(dot(along, along), 1e-30));
    return out;
}

// Four influences of a vertex: sum of weights times coefficients, divided by max(W, falloff) where W is the weight of
// the bones that the pose moves. `half` is 0 for poses 0 to 3, 1 for poses 4 to 7.
fn influences(in: VertexIn, half: u32) -> vec4<f32> {
    var sum = vec4<f32>(0.0);
    var moved = vec4<f32>(0.0);
    let stride = select(1u, 2u, NUM_POSES > 4u);
    for (var slot = 0u; slot < 4u; slot += 1u) {
        let joint = in.joints[slot];
        if joint < pose_table.num_bones {
            let at = joint * stride + half;
            sum += in.weights[slot] * coefficients.bones[at];
            moved += in.weights[slot] * pose_table.moved[at];
        }
    }
    let falloff = vec4<f32>(pose_table.falloff);
    return select(sum, sum / max(moved, falloff), falloff < vec4<f32>(1.0));
}
