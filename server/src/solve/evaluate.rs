//! Pose evaluation: how strongly each reference pose shows at each bone ([D09] 5.1 and 5.2).
//!
//! For bone `i` and pose `k`, with `R` rest, `P` reference and `J` the bone now, all in head space: `u = P - R`,
//! `d = J - R`, influence = `clamp(dot(d, u) / dot(u, u), 0, 1)`. The printed formula divides by `|u|`, which would give
//! it the unit of a length; the orthogonal projection the text speaks of needs the square. Groups average what has been
//! clamped.

use super::linear::solve_positive;
use glam::Vec3;
use rhytid_shared::Character;
use rhytid_shared::character::{GroupDegenerate, Mode};
use rhytid_shared::limits::MAX_POSES;

/// A segment shorter than this fraction of the interocular distance moves nothing.
const DEGENERATE: f32 = 1e-5;
/// Below this fraction of the product of squared lengths two segments count as parallel.
const PARALLEL: f64 = 1e-6;

/// What of a character the evaluation needs.
#[derive(Debug, Clone)]
pub struct Evaluator {
    num_bones: usize,
    num_poses: usize,
    rest: Vec<Vec3>,
    /// `u / dot(u, u)`, pose-major, zero where degenerate.
    scaled_segments: Vec<Vec3>,
    /// `u`, pose-major, zero where degenerate.
    segments: Vec<Vec3>,
    groups: Vec<Vec<usize>>,
    mode: Mode,
    group_degenerate: GroupDegenerate,
}

impl Evaluator {
    /// Takes rest, poses, groups and modes of a character.
    pub fn new(character: &Character) -> Self {
        let shortest = DEGENERATE * character.interocular();
        let rest: Vec<Vec3> = character.bones.iter().map(|bone| bone.rest).collect();
        let mut segments = Vec::with_capacity(character.num_poses() * rest.len());
        for pose in &character.poses {
            segments.extend(pose.points.iter().zip(&rest).map(|(reference, rest)| {
                let u = *reference - *rest;
                if u.length_squared() <= shortest * shortest { Vec3::ZERO } else { u }
            }));
        }
        let scaled_segments = segments.iter().map(|u| if *u == Vec3::ZERO { Vec3::ZERO } else { *u / u.length_squared() }).collect();
        Self {
            num_bones: rest.len(),
            num_poses: character.num_poses(),
            rest,
            scaled_segments,
            segments,
            groups: character.groups.clone(),
            mode: character.mode,
            group_degenerate: character.group_degenerate,
        }
    }

    /// Writes the influences at `points`, pose-major. A point that is not finite keeps the coefficients it had.
    pub fn evaluate(&self, points: &[Vec3], influences: &mut [f32]) {
        match self.mode {
            Mode::Independent => self.project_each(points, influences),
            Mode::Joint => self.project_jointly(points, influences),
        }
        self.average_groups(influences);
    }

    fn is_degenerate(&self, pose: usize, bone: usize) -> bool {
        self.segments[pose * self.num_bones + bone] == Vec3::ZERO
    }

    fn project_each(&self, points: &[Vec3], influences: &mut [f32]) {
        for k in 0..self.num_poses {
            let row = k * self.num_bones;
            for i in 0..self.num_bones {
                let along = (points[i] - self.rest[i]).dot(self.scaled_segments[row + i]);
                if along.is_finite() {
                    influences[row + i] = along.clamp(0.0, 1.0);
                }
            }
        }
    }

    /// Non-negative least squares of the displacement on all the bone's segments, so that poses whose segments are not
    /// orthogonal do not count the same motion twice.
    fn project_jointly(&self, points: &[Vec3], influences: &mut [f32]) {
        for i in 0..self.num_bones {
            let d = (points[i] - self.rest[i]).as_dvec3();
            if !d.is_finite() {
                continue;
            }
            let mut poses = [0; MAX_POSES];
            let mut num = 0;
            for k in 0..self.num_poses {
                influences[k * self.num_bones + i] = 0.0;
                if !self.is_degenerate(k, i) {
                    poses[num] = k;
                    num += 1;
                }
            }
            let mut gram = [[0.0; MAX_POSES]; MAX_POSES];
            let mut along = [0.0; MAX_POSES];
            for a in 0..num {
                let u = self.segments[poses[a] * self.num_bones + i].as_dvec3();
                along[a] = u.dot(d);
                for b in 0..num {
                    gram[a][b] = u.dot(self.segments[poses[b] * self.num_bones + i].as_dvec3());
                }
            }
            let shares = match num {
                2 => two_shares(gram[0][0], gram[0][1], gram[1][1], along[0], along[1]),
                _ => non_negative_least_squares(&gram, &along, num),
            };
            for a in 0..num {
                influences[poses[a] * self.num_bones + i] = (shares[a] as f32).clamp(0.0, 1.0);
            }
        }
    }

    fn average_groups(&self, influences: &mut [f32]) {
        for k in 0..self.num_poses {
            let row = &mut influences[k * self.num_bones..(k + 1) * self.num_bones];
            for group in &self.groups {
                let (mut sum, mut count) = (0.0_f32, 0_usize);
                for &i in group {
                    let counts = match self.group_degenerate {
                        GroupDegenerate::Exclude => self.segments[k * self.num_bones + i] != Vec3::ZERO,
                        GroupDegenerate::Zero => true,
                    };
                    if counts {
                        sum += row[i];
                        count += 1;
                    }
                }
                let mean = if count == 0 { 0.0 } else { sum / count as f32 };
                for &i in group {
                    row[i] = mean;
                }
            }
        }
    }
}

/// Closed form for two segments.
fn two_shares(g11: f64, g12: f64, g22: f64, c1: f64, c2: f64) -> [f64; MAX_POSES] {
    let mut shares = [0.0; MAX_POSES];
    let (alone1, alone2) = ((c1 / g11).max(0.0), (c2 / g22).max(0.0));
    let det = g11 * g22 - g12 * g12;
    let (a1, a2) = if det < PARALLEL * g11 * g22 {
        (alone1, alone2)
    } else {
        let (a1, a2) = ((g22 * c1 - g12 * c2) / det, (g11 * c2 - g12 * c1) / det);
        if a1 >= 0.0 && a2 >= 0.0 {
            (a1, a2)
        } else if alone1 * c1 >= alone2 * c2 {
            (alone1, 0.0)
        } else {
            (0.0, alone2)
        }
    };
    shares[0] = a1;
    shares[1] = a2;
    shares
}

/// Lawson and Hanson's active-set method on the normal equations of `num` segments. Segments that depend on those
/// already chosen (more than three always do) are passed over.
fn non_negative_least_squares(gram: &[[f64; MAX_POSES]; MAX_POSES], along: &[f64; MAX_POSES], num: usize) -> [f64; MAX_POSES] {
    let mut shares = [0.0; MAX_POSES];
    let mut is_chosen = [false; MAX_POSES];
    let mut is_barred = [false; MAX_POSES];
    // Each round adds a segment or bars one; more rounds than this cannot be useful with eight.
    for _ in 0..3 * MAX_POSES {
        let mut best: Option<(usize, f64)> = None;
        for a in (0..num).filter(|&a| !is_chosen[a] && !is_barred[a]) {
            let gradient = (0..num).fold(along[a], |sum, b| sum - gram[a][b] * shares[b]);
            if gradient > 1e-9 * gram[a][a] && best.is_none_or(|(_, most)| gradient > most) {
                best = Some((a, gradient));
            }
        }
        let Some((entering, _)) = best else { break };
        is_chosen[entering] = true;
        loop {
            let Some(trial) = solve_chosen(gram, along, &is_chosen, num) else {
                is_chosen[entering] = false;
                is_barred[entering] = true;
                break;
            };
            // The farthest step towards the trial that keeps every share at or above zero.
            let mut step = 1.0_f64;
            for a in (0..num).filter(|&a| is_chosen[a] && trial[a] <= 0.0) {
                step = step.min(shares[a] / (shares[a] - trial[a]));
            }
            for a in 0..num {
                if is_chosen[a] {
                    shares[a] += step * (trial[a] - shares[a]);
                    if trial[a] <= 0.0 && shares[a] <= 1e-12 {
                        shares[a] = 0.0;
                        is_chosen[a] = false;
                    }
                }
            }
            if step >= 1.0 || !is_chosen.contains(&true) {
                break;
            }
        }
    }
    shares
}

/// Least squares on the chosen segments alone; `None` where they depend on each other.
fn solve_chosen(
    gram: &[[f64; MAX_POSES]; MAX_POSES],
    along: &[f64; MAX_POSES],
    is_chosen: &[bool; MAX_POSES],
    num: usize,
) -> Option<[f64; MAX_POSES]> {
    let (mut a, mut b) = ([[0.0; MAX_POSES]; MAX_POSES], [0.0; MAX_POSES]);
    for row in 0..MAX_POSES {
        if row < num && is_chosen[row] {
            for column in 0..num {
                if is_chosen[column] {
                    a[row][column] = gram[row][column];
                }
            }
            b[row] = along[row];
        } else {
            a[row][row] = 1.0;
        }
    }
    let factored_is_regular = solve_positive(&mut a, &mut b);
    let is_independent = (0..num).all(|row| !is_chosen[row] || a[row][row] * a[row][row] > PARALLEL * gram[row][row]);
    (factored_is_regular && is_independent).then_some(b)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// An evaluator for bones at `rest` and poses given as displacements.
    fn evaluator(rest: &[[f32; 3]], poses: &[Vec<[f32; 3]>], mode: Mode) -> Evaluator {
        let segments: Vec<Vec3> = poses.iter().flatten().map(|u| Vec3::from(*u)).collect();
        Evaluator {
            num_bones: rest.len(),
            num_poses: poses.len(),
            rest: rest.iter().map(|r| Vec3::from(*r)).collect(),
            scaled_segments: segments.iter().map(|u| if *u == Vec3::ZERO { *u } else { *u / u.length_squared() }).collect(),
            segments,
            groups: Vec::new(),
            mode,
            group_degenerate: GroupDegenerate::Exclude,
        }
    }

    fn influences(evaluator: &Evaluator, displacements: &[[f32; 3]]) -> Vec<f32> {
        let points: Vec<Vec3> = evaluator.rest.iter().zip(displacements).map(|(rest, d)| *rest + Vec3::from(*d)).collect();
        let mut out = vec![0.0; evaluator.num_poses * evaluator.num_bones];
        evaluator.evaluate(&points, &mut out);
        out
    }

    fn assert_near(got: &[f32], want: &[f32]) {
        assert_eq!(got.len(), want.len());
        for (a, b) in got.iter().zip(want) {
            assert!((a - b).abs() < 1e-5, "got {got:?}, expected {want:?}");
        }
    }

    #[test]
    fn projection_is_linear_and_clamped() {
        let one = evaluator(&[[0.0; 3]], &[vec![[0.0, 2.0, 0.0]]], Mode::Independent);
        assert_near(&influences(&one, &[[0.0, 1.0, 0.0]]), &[0.5]);
        assert_near(&influences(&one, &[[0.0, 2.6, 0.1]]), &[1.0]);
        assert_near(&influences(&one, &[[0.0, -0.5, 0.1]]), &[0.0]);
        let elsewhere = evaluator(&[[1.0, 2.0, 3.0]], &[vec![[0.5, 0.0, 0.5]]], Mode::Independent);
        assert_near(&influences(&elsewhere, &[[0.2, 0.9, 0.1]]), &[0.3]);
    }

    #[test]
    fn a_reference_pose_in_metres_reaches_one() {
        // The printed formula, which divides by the length alone, would give 0.012.
        let brow = evaluator(&[[0.0; 3]], &[vec![[0.0, 0.012, 0.0]]], Mode::Independent);
        assert_near(&influences(&brow, &[[0.0, 0.012, 0.0]]), &[1.0]);
    }

    #[test]
    fn a_turning_bone_is_linear_in_its_angle_at_its_driver_point() {
        let arm = glam::DVec3::new(0.0, -0.08, 0.08);
        let swing = |degrees: f64| {
            let turn = super::super::rotation::from_pitch_yaw(degrees.to_radians(), 0.0);
            (super::super::rotation::rotate(turn, arm) - arm).as_vec3().to_array()
        };
        assert_near(&swing(20.0), &[0.0, -0.0225370211, -0.0321862018]);
        let jaw = evaluator(&[[0.0, -0.10, 0.02]], &[vec![swing(20.0)]], Mode::Independent);
        for (degrees, want) in [(5.0, 0.2490450406), (10.0, 0.5), (15.0, 0.7509549594), (25.0, 1.0)] {
            assert_near(&influences(&jaw, &[swing(degrees)]), &[want]);
        }
    }

    #[test]
    fn groups_average_what_has_been_clamped() {
        let pose = vec![[0.0, 1.0, 0.0]; 3];
        let mut three = evaluator(&[[0.0; 3]; 3], &[pose], Mode::Independent);
        three.groups = vec![vec![0, 1, 2]];
        let moved = [[0.0, 1.6, 0.0], [0.0, -0.4, 0.0], [0.0, 0.3, 0.0]];
        assert_near(&influences(&three, &moved), &[0.433333333; 3]);

        // The second member (as the vector counts, from zero at -0.4 here) does not move in the pose.
        let mut with_still = evaluator(&[[0.0; 3]; 3], &[vec![[0.0, 1.0, 0.0], [0.0; 3], [0.0, 1.0, 0.0]]], Mode::Independent);
        with_still.groups = vec![vec![0, 1, 2]];
        assert_near(&influences(&with_still, &moved), &[0.65; 3]);
        with_still.group_degenerate = GroupDegenerate::Zero;
        assert_near(&influences(&with_still, &moved), &[0.433333333; 3]);
    }

    #[test]
    fn a_group_no_pose_moves_is_zero() {
        let mut still = evaluator(&[[0.0; 3]; 2], &[vec![[0.0; 3]; 2]], Mode::Independent);
        still.groups = vec![vec![0, 1]];
        assert_near(&influences(&still, &[[0.0, 1.0, 0.0]; 2]), &[0.0; 2]);
    }

    #[test]
    fn joint_mode_counts_a_motion_once() {
        let poses = [vec![[0.0, 1.0, 0.0]], vec![[0.6, 0.8, 0.0]]];
        let independent = evaluator(&[[0.0; 3]], &poses, Mode::Independent);
        let joint = evaluator(&[[0.0; 3]], &poses, Mode::Joint);
        for (d, alone, together) in [
            ([0.0, 1.0, 0.0], [1.0, 0.8], [1.0, 0.0]),
            ([0.3, 0.9, 0.0], [0.9, 0.9], [0.5, 0.5]),
            ([-0.2, 0.9, 0.0], [0.9, 0.6], [0.9, 0.0]),
            ([0.6, 0.3, 0.0], [0.3, 0.6], [0.0, 0.6]),
        ] {
            assert_near(&influences(&independent, &[d]), &alone);
            assert_near(&influences(&joint, &[d]), &together);
        }
    }

    #[test]
    fn parallel_poses_fall_back_to_independent() {
        let joint = evaluator(&[[0.0; 3]], &[vec![[0.0, 1.0, 0.0]], vec![[0.0, 2.0, 0.0]]], Mode::Joint);
        assert_near(&influences(&joint, &[[0.0, 1.0, 0.0]]), &[1.0, 0.5]);
    }

    #[test]
    fn joint_mode_is_least_squares_for_more_poses() {
        let units = [[1.0, 0.2, 0.0], [0.1, 1.0, 0.3], [-0.2, 0.3, 0.9], [0.5, 0.5, 0.5]];
        let poses: Vec<Vec<[f32; 3]>> = units.iter().map(|u| vec![*u]).collect();
        let four = evaluator(&[[0.0; 3]], &poses, Mode::Joint);
        let three = evaluator(&[[0.0; 3]], &poses[..3], Mode::Joint);
        for d in [[0.3, 0.4, 0.2], [0.5, -0.2, 0.1], [-0.3, 0.6, 0.4], [0.1, 0.1, -0.5]] {
            for (evaluator, num) in [(&three, 3), (&four, 4)] {
                let shares = influences(evaluator, &[d]);
                let left = (0..num).fold(Vec3::from(d), |left, k| left - Vec3::from(units[k]) * shares[k]);
                for k in 0..num {
                    // Karush, Kuhn, Tucker: no pose would still help, and those in use are used up.
                    let gradient = left.dot(Vec3::from(units[k]));
                    assert!(gradient < 1e-5 && (shares[k] == 0.0 || gradient.abs() < 1e-5), "{d:?}: {shares:?}, pose {k}: {gradient}");
                }
            }
        }
    }

    #[test]
    fn a_point_that_is_no_number_keeps_its_coefficient() {
        for mode in [Mode::Independent, Mode::Joint] {
            let one = evaluator(&[[0.0; 3]], &[vec![[0.0, 2.0, 0.0]]], mode);
            let mut out = vec![0.25];
            one.evaluate(&[Vec3::new(0.0, f32::NAN, 0.0)], &mut out);
            assert_eq!(out, [0.25]);
        }
    }

    #[test]
    fn the_whole_of_a_face_is_evaluated() {
        let rest = [[-0.03, 0.05, 0.09], [0.03, 0.05, 0.09], [0.0, -0.08, 0.1]];
        let up = vec![[0.0, 0.010, 0.0], [0.0, 0.010, 0.0], [0.0; 3]];
        let frown = vec![[0.004, -0.006, 0.0], [-0.004, -0.006, 0.0], [0.0, -0.02, -0.004]];
        let mut face = evaluator(&rest, &[up, frown], Mode::Independent);
        let moved = [[0.001, 0.006, 0.0], [0.0, 0.012, 0.001], [0.0, -0.01, 0.0]];
        assert_near(&influences(&face, &moved), &[0.6, 1.0, 0.0, 0.0, 0.0, 0.4807692308]);
        face.groups = vec![vec![0, 1]];
        let grouped = influences(&face, &moved);
        assert_near(&grouped, &[0.8, 0.8, 0.0, 0.0, 0.0, 0.4807692308]);
        let bytes: Vec<u8> = grouped.iter().map(|value| (value * 255.0 + 0.5).floor() as u8).collect();
        assert_eq!(bytes, [204, 204, 0, 0, 0, 123]);
    }
}
