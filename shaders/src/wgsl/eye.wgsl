// Eyeballs: a white and an iris seen through a clear cornea, under a wet, sharp film.
//!include surface
//!include lighting

const F0: f32 = 0.03;
const FILM_SLOPE: f32 = 0.0081;
// Index of the cornea and what lies behind it.
const CORNEA_INDEX: f32 = 1.336;
// Radius of the iris and depth of its plane below the top of the cornea, in radii of the ball (human: 6 mm and 3.5 mm of 12).
const IRIS_RADIUS: f32 = 0.50;
const IRIS_PLANE: f32 = 0.80;

struct Eye {
    // Unit vector it looks along, and its centre, world space; radius in metres.
    gaze: vec3<f32>,
    centre: vec3<f32>,
    radius: f32,
}

fn nearest_eye(head: vec3<f32>) -> u32 {
    return select(1u, 0u, distance(head, frame.eyeballs[0].xyz) < distance(head, frame.eyeballs[1].xyz));
}

// The lids shade the ball along their edges, wherever these are just now: it is darkest under the upper one, which stands
// off further and whose lashes shade it as well, and in the corners.
fn lid_light(offset: vec3<f32>, which: u32) -> f32 {
    let corners = frame.lid_corners[which];
    let arches = select(frame.lid_arches.zw, frame.lid_arches.xy, which == 0u);
    let t = clamp((offset.x - corners.x) / max(corners.z - corners.x, 1e-3), 0.0, 1.0);
    let edges = mix(corners.y, corners.w, t) + arches * (4.0 * t * (1.0 - t));
    let below_upper = edges.x - offset.y;
    let upper = smoothstep(0.40, -0.14, below_upper);
    let at_upper = smoothstep(0.13, 0.0, below_upper);
    let lower = smoothstep(0.30, -0.08, offset.y - edges.y);
    let corner = smoothstep(0.38, 0.90, abs(offset.x));
    return (1.0 - 0.66 * upper) * (1.0 - 0.38 * at_upper) * (1.0 - 0.35 * lower) * (1.0 - 0.50 * corner);
}

// Light that the lids let through has come off skin: it is the warmer the less of it there is.
fn lid_colour(occlusion: f32) -> vec3<f32> {
    return pow(vec3<f32>(occlusion), vec3<f32>(0.82, 1.06, 1.22));
}

// Where the iris that is seen through the cornea at `in` lies in the map: the ray is refracted and cut with the plane of
// the iris; the derivatives of position and map on the picture carry the way over into the map.
fn uv_behind_cornea(in: Varyings, normal: vec3<f32>, view: vec3<f32>, gaze: vec3<f32>, centre: vec3<f32>, radius: f32) -> vec2<f32> {
    let du = dpdx(in.uv);
    let dv = dpdy(in.uv);
    let dp = dpdx(in.world);
    let dq = dpdy(in.world);
    let along = dot(in.world - centre, gaze) / radius;
    let across = length(in.world - centre - gaze * along * radius) / radius;
    let inside = refract(-view, normal, 1.0 / CORNEA_INDEX);
    let way = inside * max((along - IRIS_PLANE) * radius / max(-dot(inside, gaze), 0.2), 0.0);
    let moved = way - gaze * dot(way, gaze);
    // Least squares of the way in the directions of the picture.
    let a = dot(dp, dp);
    let b = dot(dp, dq);
    let c = dot(dq, dq);
    let e = vec2<f32>(dot(dp, moved), dot(dq, moved));
    let det = max(a * c - b * b, 1e-20);
    let s = vec2<f32>(c * e.x - b * e.y, a * e.y - b * e.x) / det;
    let shift = du * s.x + dv * s.y;
    return in.uv + shift * (1.0 - smoothstep(0.85 * IRIS_RADIUS, 1.05 * IRIS_RADIUS, across));
}

@fragment
fn fs_bare(in: Varyings) -> Shaded {
    let normal = normalize(in.normal);
    let view = normalize(frame.eye.xyz - in.world);
    let head = head_from_world(in.world);
    let which = nearest_eye(head);
    let ball = frame.eyeballs[which];
    let gaze = frame.gazes[which].xyz;
    let offset = (head - ball.xyz) / ball.w;
    // The head only turns and travels: the ball's centre in the world follows from where this point is in both.
    let turned = offset * ball.w;
    let centre = in.world - vec3<f32>(
        frame.head_from_world[0].x * turned.x + frame.head_from_world[1].x * turned.y + frame.head_from_world[2].x * turned.z,
        frame.head_from_world[0].y * turned.x + frame.head_from_world[1].y * turned.y + frame.head_from_world[2].y * turned.z,
        frame.head_from_world[0].z * turned.x + frame.head_from_world[1].z * turned.y + frame.head_from_world[2].z * turned.z,
    );
    let uv = uv_behind_cornea(in, normal, view, gaze, centre, ball.w);
    let occlusion = lid_light(offset, which);
    let shade = lid_colour(occlusion);
    let visible = key_visibility(in.world, normal);
    let albedo = albedo_of(uv).rgb;

    // The iris is a bowl that faces the light the cornea gathers on it: lit from across, it glows opposite to the light.
    let from_axis = in.world - centre - gaze * dot(in.world - centre, gaze);
    let is_iris = 1.0 - smoothstep(0.88 * IRIS_RADIUS, 1.02 * IRIS_RADIUS, length(from_axis) / ball.w);
    let matt = normalize(mix(normal, gaze - from_axis / ball.w * 0.9, is_iris));

    var light_in = ambient_irradiance(normal) * shade;
    var film = vec3<f32>(0.0);
    for (var i = 0u; i < 4u; i += 1u) {
        let light = frame.lights[i].direction.xyz;
        let arriving = frame.lights[i].radiance.rgb * shade * select(1.0, visible, i == 0u);
        // The white lets light through, so it turns dark late.
        light_in += arriving * max((dot(matt, light) + 0.2) / 1.44, 0.0);
        if i > 1u {
            film += arriving * highlight(normal, view, light, FILM_SLOPE, F0) * 0.25;
        }
    }
    let reflected = reflect(-view, normal);
    film += studio_reflection(reflected) * ambient_fresnel(F0, 0.09, clamp(dot(normal, view), 0.0, 1.0)) * mix(0.3, 1.0, occlusion);
    // The white scatters as skin does, the iris is seen as it is.
    return shaded(in.world, min(albedo * light_in, vec3<f32>(BRIGHTEST)), min(film, vec3<f32>(BRIGHTEST)), 0.35 * (1.0 - is_iris));
}
