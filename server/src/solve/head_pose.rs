//! Head pose from points that expressions do not move, and the way back from a ray to head space.
//!
//! The camera's frame is x right, y down, z away from the camera; head space is metres, +Y up, +Z out of the face. A
//! point `X` of the head is seen along `(R X + t).xy / (R X + t).z`.

use super::error::SolveError;
use super::linear::solve_positive;
use super::rotation;
use glam::{DMat3, DQuat, DVec2, DVec3};

/// Gauss–Newton steps at most; from one frame to the next two or three are enough.
const MOST_STEPS: usize = 12;
/// Steps at most without an earlier pose.
const MOST_FIRST_STEPS: usize = 40;
/// A step below this, radians or fraction of the distance, ends the search: five micrometres on the face.
const SMALL_STEP: f64 = 5e-5;
/// Residuals beyond this fraction of the interocular distance lose weight.
const SOFT_RESIDUAL: f64 = 0.02;
/// The cosine below which a plane of the face is seen too much from the side for a ray to meet it surely: 70 degrees.
const LEAST_FACING: f64 = 0.35;
/// Rays that spread less than this (root mean square) are one ray.
const LEAST_SPREAD: f64 = 1e-9;
/// Points whose spread across their longest extent is below this fraction of the interocular distance (root mean square)
/// lie on a line, about which a head could turn unseen: the bridge of a nose does, a whole nose does not.
const LEAST_WIDTH: f64 = 0.05;

/// Rigid pose, `camera_from_head`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pose {
    /// Unit quaternion.
    pub rotation: DQuat,
    /// Metres.
    pub translation: DVec3,
}

impl Pose {
    /// The rotation as a matrix.
    pub fn matrix(&self) -> DMat3 {
        rotation::to_matrix(self.rotation)
    }
}

/// A similarity of the plane: `p -> scale * rotation(angle) * p + shift`, with `linear = scale * (cos, sin)`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Similarity {
    pub(super) linear: DVec2,
    pub(super) shift: DVec2,
}

impl Similarity {
    /// Weighted least squares of `targets` on `sources` (Umeyama 1991; in the plane a division of complex numbers).
    /// `None` where the sources lie in one place.
    pub(super) fn fit(pairs: impl Iterator<Item = (DVec2, DVec2, f64)> + Clone) -> Option<Self> {
        let (mut weights, mut mean_source, mut mean_target) = (0.0, DVec2::ZERO, DVec2::ZERO);
        for (source, target, weight) in pairs.clone() {
            weights += weight;
            mean_source += source * weight;
            mean_target += target * weight;
        }
        mean_source /= weights;
        mean_target /= weights;
        let (mut product, mut square) = (DVec2::ZERO, 0.0);
        for (source, target, weight) in pairs {
            let (x, y) = (source - mean_source, target - mean_target);
            product += DVec2::new(x.x * y.x + x.y * y.y, x.x * y.y - x.y * y.x) * weight;
            square += x.length_squared() * weight;
        }
        let linear = product / square;
        (square > 0.0 && linear.is_finite() && mean_target.is_finite())
            .then(|| Self { linear, shift: mean_target - multiply(linear, mean_source) })
    }
}

/// Product of complex numbers.
fn multiply(a: DVec2, b: DVec2) -> DVec2 {
    DVec2::new(a.x * b.x - a.y * b.y, a.x * b.y + a.y * b.x)
}

/// Where a pose shows the point.
pub(super) fn project(rotation: &DMat3, translation: DVec3, point: DVec3) -> DVec2 {
    let p = *rotation * point + translation;
    DVec2::new(p.x, p.y) / p.z
}

/// The point of head space on `ray` at the depth `z` of head space: what the performer's motion within the face's own
/// plane has become. Beyond 70 degrees the ray is cut short instead of running off to the side.
pub fn lift(rotation: &DMat3, translation: DVec3, ray: DVec2, z: f64) -> DVec3 {
    let head_from_camera = rotation.transpose();
    let direction = head_from_camera * DVec3::new(ray.x, ray.y, 1.0);
    let camera = head_from_camera * translation;
    let distance = (z + camera.z) / direction.z.min(-LEAST_FACING);
    direction * distance - camera
}

/// As [`lift`], with the shift in x and y for each metre of depth.
pub(super) fn lift_with_slope(rotation: &DMat3, translation: DVec3, ray: DVec2, z: f64) -> (DVec3, DVec2) {
    (lift(rotation, translation, ray, z), slope(&rotation.transpose(), ray))
}

/// The shift in x and y of head space along a ray for each metre of depth.
pub(super) fn slope(head_from_camera: &DMat3, ray: DVec2) -> DVec2 {
    let direction = *head_from_camera * DVec3::new(ray.x, ray.y, 1.0);
    DVec2::new(direction.x, direction.y) / direction.z.min(-LEAST_FACING)
}

/// True unless the weighted points lie (nearly) on one line, so that a pose can be found from them.
pub(super) fn spans(model: &[DVec3], weights: &[(usize, f64)], unit: f64) -> bool {
    let total: f64 = weights.iter().map(|&(_, weight)| weight).sum();
    let mean = weights.iter().map(|&(i, weight)| model[i] * weight).sum::<DVec3>() / total;
    let (mut xx, mut yy, mut zz, mut xy, mut yz, mut zx) = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0);
    for &(i, weight) in weights {
        let (d, share) = (model[i] - mean, weight / total);
        xx += d.x * d.x * share;
        yy += d.y * d.y * share;
        zz += d.z * d.z * share;
        xy += d.x * d.y * share;
        yz += d.y * d.z * share;
        zx += d.z * d.x * share;
    }
    // The principal minors sum to the eigenvalues' products in pairs: over the trace, nearly the second largest of them.
    let pairs = (xx * yy - xy * xy) + (yy * zz - yz * yz) + (zz * xx - zx * zx);
    let least = LEAST_WIDTH * unit;
    weights.len() >= 4 && pairs > least * least * (xx + yy + zz)
}

/// Weighted root mean square distance of the rays from their mean.
pub(super) fn spread(rays: &[DVec2], weights: &[(usize, f64)]) -> f64 {
    let total: f64 = weights.iter().map(|&(_, weight)| weight).sum();
    let mean = weights.iter().map(|&(i, weight)| rays[i] * weight).sum::<DVec2>() / total;
    (weights.iter().map(|&(i, weight)| (rays[i] - mean).length_squared() * weight).sum::<f64>() / total).sqrt()
}

/// What is said of rays that are one.
pub(super) const ONE_PLACE: SolveError =
    SolveError::NoFaceShape { problem: "they lie in one place, expected a face of at least a few pixels" };

fn check_spread(rays: &[DVec2], weights: &[(usize, f64)]) -> Result<(), SolveError> {
    // A NaN is not above it.
    if spread(rays, weights) > LEAST_SPREAD { Ok(()) } else { Err(ONE_PLACE) }
}

/// A rough pose from a similarity: a face seen from the front at the distance its size suggests.
pub(super) fn frontal_pose(model: &[DVec3], rays: &[DVec2], weights: &[(usize, f64)]) -> Result<Pose, SolveError> {
    check_spread(rays, weights)?;
    let pairs = weights.iter().map(|&(i, weight)| (DVec2::new(model[i].x, -model[i].y), rays[i], weight));
    let total: f64 = weights.iter().map(|&(_, weight)| weight).sum();
    let Some(similarity) = Similarity::fit(pairs).filter(|fit| fit.linear.length() > 1e-3) else {
        return Err(SolveError::NoFaceShape { problem: "no size and roll fits them" });
    };
    let scale = similarity.linear.length();
    let distance = 1.0 / scale;
    let mean_z = weights.iter().map(|&(i, weight)| model[i].z * weight).sum::<f64>() / total;
    let roll = libm::atan2(similarity.linear.y, similarity.linear.x);
    // Half a turn about the camera's x takes head space (y up, z near) to the camera's frame (y down, z away).
    let rotation = rotation::from_vector(DVec3::new(0.0, 0.0, roll)) * DQuat::from_xyzw(1.0, 0.0, 0.0, 0.0);
    Ok(Pose { rotation, translation: DVec3::new(similarity.shift.x * distance, similarity.shift.y * distance, distance + mean_z) })
}

/// A pose and how well it explains the stable points.
#[derive(Debug, Clone, Copy)]
pub struct Fit {
    /// The pose.
    pub pose: Pose,
    /// Weighted root-mean-square reprojection error, fraction of the interocular distance.
    pub error: f64,
}

/// Perspective pose of `model` from `rays` by damped Gauss–Newton with soft outliers, starting from `guess`.
/// `weights` names the stable points; `unit` is the interocular distance in metres.
pub fn refine(guess: Option<Pose>, model: &[DVec3], rays: &[DVec2], weights: &[(usize, f64)], unit: f64) -> Result<Fit, SolveError> {
    let (mut pose, most_steps) = match guess {
        Some(pose) => {
            check_spread(rays, weights)?;
            (pose, MOST_STEPS)
        }
        None => (frontal_pose(model, rays, weights)?, MOST_FIRST_STEPS),
    };
    let mut damping = 1e-6;
    let points = Points { model, rays, weights, unit };
    let mut system = System::at(&pose, &points, f64::INFINITY, true);
    if system.nearest <= 0.0 {
        return Err(SolveError::NoFaceShape { problem: "they are so large that the head would reach behind the camera" });
    }
    for _ in 0..most_steps {
        let Some(step) = system.step(damping) else { break };
        let turn = rotation::from_vector(DVec3::new(step[0], step[1], step[2]));
        let trial =
            Pose { rotation: (turn * pose.rotation).normalize(), translation: pose.translation + DVec3::new(step[3], step[4], step[5]) };
        let size = step[0].abs().max(step[1].abs()).max(step[2].abs())
            + step[3].abs().max(step[4].abs()).max(step[5].abs()) / pose.translation.z.abs();
        // Nobody steps on from the last one.
        let is_last = size < SMALL_STEP;
        let trial_system = System::at(&trial, &points, system.cost, !is_last);
        // The soft weights let a step raise the plain cost a little while it leaves an outlier behind.
        if trial_system.cost <= system.cost * 1.05 + 1e-18 && trial_system.nearest > 0.0 {
            (pose, system) = (trial, trial_system);
            damping = (damping * 0.1).max(1e-9);
            if is_last {
                break;
            }
        } else {
            damping = (damping * 100.0).max(1e-4);
            if damping > 1e6 {
                break;
            }
        }
    }
    let error = system.cost.sqrt() * pose.translation.z.abs() / unit;
    if !(pose.translation.is_finite() && pose.rotation.is_finite() && error.is_finite()) {
        return Err(SolveError::NoFaceShape { problem: "no head pose fits them" });
    }
    Ok(Fit { pose, error })
}

/// What a pose is to explain: `weights` names the stable points of `model` and their `rays`; `unit` is the interocular distance, metres.
struct Points<'a> {
    model: &'a [DVec3],
    rays: &'a [DVec2],
    weights: &'a [(usize, f64)],
    unit: f64,
}

/// Normal equations of one Gauss–Newton step: rotation vector, then translation.
struct System {
    /// Lower triangle.
    a: [[f64; 6]; 6],
    b: [f64; 6],
    /// Weighted mean square of the residuals, in rays.
    cost: f64,
    /// Distance of the nearest point before the camera, metres.
    nearest: f64,
}

impl System {
    /// `last_cost` is that of the pose before: while the whole pose is off, every residual is large and none an outlier. Without
    /// equations, it has cost and distance alone.
    fn at(pose: &Pose, points: &Points<'_>, last_cost: f64, with_equations: bool) -> Self {
        let &Points { model, rays, weights, unit } = points;
        let matrix = pose.matrix();
        let soft = (SOFT_RESIDUAL * unit / pose.translation.z).max(2.0 * last_cost.sqrt());
        let per_soft_square = 1.0 / (soft * soft);
        let (mut a, mut b, mut sum, mut total, mut nearest) = ([[0.0; 6]; 6], [0.0; 6], 0.0, 0.0, f64::INFINITY);
        for &(i, weight) in weights {
            let turned = matrix * model[i];
            let p = turned + pose.translation;
            // A NaN is carried on by the cost.
            nearest = p.z.min(nearest);
            let per_z = 1.0 / p.z;
            let (x, y) = (p.x * per_z, p.y * per_z);
            let residual = rays[i] - DVec2::new(x, y);
            let square = residual.length_squared();
            sum += square * weight;
            total += weight;
            if !with_equations {
                continue;
            }
            let weight = weight / (1.0 + square * per_soft_square);
            let by_shift = [DVec3::new(per_z, 0.0, -x * per_z), DVec3::new(0.0, per_z, -y * per_z)];
            for (gradient, residual) in by_shift.into_iter().zip([residual.x, residual.y]) {
                let by_turn = turned.cross(gradient);
                let row = [by_turn.x, by_turn.y, by_turn.z, gradient.x, gradient.y, gradient.z];
                for r in 0..6 {
                    let scaled = row[r] * weight;
                    b[r] += scaled * residual;
                    for c in 0..=r {
                        a[r][c] += scaled * row[c];
                    }
                }
            }
        }
        Self { a, b, cost: sum / total, nearest }
    }

    fn step(&self, damping: f64) -> Option<[f64; 6]> {
        let (mut a, mut b) = (self.a, self.b);
        for r in 0..6 {
            a[r][r] *= 1.0 + damping;
        }
        // The factorisation reads the lower triangle only.
        solve_positive(&mut a, &mut b).then_some(b)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn assert_near(got: DVec2, want: [f64; 2]) {
        assert!((got - DVec2::from(want)).abs().max_element() < 1e-9, "got {got}, expected {want:?}");
    }

    fn fit(sources: &[[f64; 2]], targets: &[DVec2]) -> Similarity {
        Similarity::fit(sources.iter().zip(targets).map(|(s, t)| (DVec2::from(*s), *t, 1.0))).expect("regular")
    }

    #[test]
    fn similarity_is_least_squares_with_scale() {
        // Umeyama's own example; its reflection is resolved towards a rotation.
        let found = fit(&[[0.0, 0.0], [1.0, 0.0], [0.0, 2.0]], &[DVec2::ZERO, DVec2::new(-1.0, 0.0), DVec2::new(0.0, 2.0)]);
        let c = found.linear.length();
        assert!((c - 0.721110255).abs() < 1e-9, "{c}");
        assert_near(found.linear / c, [0.8320502943, -0.5547001962]);
        assert_near(found.shift, [-0.8, 0.4]);
    }

    #[test]
    fn similarity_averages_noise() {
        let sources = [[0.0, 0.0], [2.0, 0.0], [2.0, 1.0], [0.0, 1.0]];
        let noise = [[0.1, 0.0], [0.0, 0.1], [-0.1, 0.0], [0.0, -0.1]];
        let linear = DVec2::new(libm::cos(30.0_f64.to_radians()), libm::sin(30.0_f64.to_radians())) * 1.5;
        let targets: Vec<DVec2> =
            sources.iter().zip(noise).map(|(s, n)| multiply(linear, DVec2::from(*s)) + DVec2::new(3.0, -1.0) + DVec2::from(n)).collect();
        let found = fit(&sources, &targets);
        assert!((found.linear.length() - 1.4803092337).abs() < 1e-9);
        assert!((libm::atan2(found.linear.y, found.linear.x).to_degrees() - 33.1739666254).abs() < 1e-9);
        assert_near(found.shift, [3.09, -1.03]);
    }

    #[test]
    fn lift_puts_the_residual_into_head_space() {
        let angle = 20.0_f64.to_radians();
        let (s, c) = (libm::sin(angle), libm::cos(angle));
        // This vector's head faces away from the camera, so its face is the side at negative facing: turned half round.
        let rotation = DMat3::from_cols(DVec3::new(c, 0.0, -s), DVec3::Y, DVec3::new(s, 0.0, c));
        let half_turn = DMat3::from_cols(DVec3::X, -DVec3::Y, -DVec3::Z);
        let translation = DVec3::new(5.0, -3.0, 600.0);
        let uv = DVec2::new(337.14779599, 262.97757876);
        let seen = project(&rotation, translation, DVec3::new(10.0, 20.0, -5.0)) * 800.0 + DVec2::new(320.0, 240.0);
        assert!(seen.distance(uv) < 1e-7, "{seen}");
        let ray = (uv - DVec2::new(0.0, 6.0) - DVec2::new(320.0, 240.0)) / 800.0;
        let lifted = lift(&(rotation * half_turn), translation, ray, 5.0);
        let expected = half_turn * DVec3::new(10.0, 15.56088998, -5.0);
        assert!(lifted.distance(expected) < 1e-7, "{lifted}");
    }

    /// A rough face: eye corners, bridge, nostrils, chin, lower lip, brows (metres).
    const FACE: [DVec3; 11] = [
        DVec3::new(-0.045, 0.0, 0.0),
        DVec3::new(-0.016, 0.0, 0.006),
        DVec3::new(0.016, 0.0, 0.006),
        DVec3::new(0.045, 0.0, 0.0),
        DVec3::new(0.0, -0.005, 0.022),
        DVec3::new(0.0, -0.035, 0.04),
        DVec3::new(0.0, -0.045, 0.025),
        DVec3::new(0.0, -0.105, 0.02),
        DVec3::new(0.0, -0.075, 0.028),
        DVec3::new(-0.03, 0.02, 0.015),
        DVec3::new(0.03, 0.02, 0.015),
    ];
    const STABLE: [(usize, f64); 7] = [(0, 1.0), (1, 1.0), (2, 1.0), (3, 1.0), (4, 1.0), (5, 1.0), (6, 1.0)];

    fn facing(pitch: f64, yaw: f64) -> Pose {
        let rotation = DQuat::from_xyzw(1.0, 0.0, 0.0, 0.0) * rotation::from_pitch_yaw(pitch, yaw);
        Pose { rotation, translation: DVec3::new(0.02, -0.03, 0.6) }
    }

    fn seen(pose: &Pose) -> Vec<DVec2> {
        let matrix = pose.matrix();
        FACE.iter().map(|&p| project(&matrix, pose.translation, p)).collect()
    }

    #[test]
    fn pose_is_found_from_nothing_and_from_far() {
        for (pitch, yaw) in [(0.0, 0.0), (0.4, 0.2), (-0.4, -0.6), (0.1, 0.9)] {
            let truth = facing(pitch, yaw);
            for guess in [None, Some(facing(0.0, 0.0)), Some(facing(-0.3, 0.3))] {
                let found = refine(guess, &FACE, &seen(&truth), &STABLE, 0.09).expect("a face");
                let off = rotation::to_vector(found.pose.rotation * truth.rotation.inverse()).length();
                assert!(off < 1e-5 && found.error < 1e-5, "pitch {pitch} yaw {yaw} guess {guess:?}: {off} rad, error {}", found.error);
            }
        }
    }

    #[test]
    fn stable_points_keep_the_expression_that_all_points_eat() {
        // The chin falls 20 mm, the lower lip 12 mm, the brows stay.
        let mut moved = FACE;
        moved[7].y -= 0.020;
        moved[8].y -= 0.012;
        let flat = |p: &DVec3| DVec2::new(p.x, p.y);
        let residual = |weights: &[(usize, f64)]| {
            let fit = Similarity::fit(weights.iter().map(|&(i, w)| (flat(&moved[i]), flat(&FACE[i]), w))).expect("regular");
            [7, 8, 9].map(|i| multiply(fit.linear, flat(&moved[i])).y + fit.shift.y - FACE[i].y)
        };
        let all: Vec<(usize, f64)> = (0..FACE.len()).map(|i| (i, 1.0)).collect();
        let ([chin, lip, brow], [chin_all, lip_all, brow_all]) = (residual(&STABLE), residual(&all));
        assert!((chin + 0.020).abs() < 1e-12 && (lip + 0.012).abs() < 1e-12 && brow.abs() < 1e-12);
        assert!(chin_all > -0.016 && lip_all > -0.009 && brow_all.abs() > 0.0003, "{chin_all} {lip_all} {brow_all}");
    }

    #[test]
    fn one_stray_point_hardly_turns_the_head() {
        let truth = facing(0.1, 0.2);
        let mut rays = seen(&truth);
        rays[6].y += 0.02;
        let found = refine(Some(facing(0.0, 0.1)), &FACE, &rays, &STABLE, 0.09).expect("a face");
        let plain = {
            let mut rays_used = rays.clone();
            rays_used[6] = seen(&truth)[6];
            refine(Some(facing(0.0, 0.1)), &FACE, &rays_used, &STABLE, 0.09).expect("a face")
        };
        let off = rotation::to_vector(found.pose.rotation * plain.pose.rotation.inverse()).length();
        assert!(off < 0.15, "{off}");
    }

    #[test]
    fn points_in_one_place_are_no_face() {
        let rays = vec![DVec2::new(0.1, 0.1); FACE.len()];
        assert!(matches!(refine(None, &FACE, &rays, &STABLE, 0.09), Err(SolveError::NoFaceShape { .. })));
    }
}
