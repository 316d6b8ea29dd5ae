//! Radial-basis regression from the performer's face to the character's: [D09]'s retargeting.
//!
//! `F(p) = sum_j W_j phi_j(|p - p_j|) + c_0 + C p` with the multiquadric `phi_j(r) = sqrt(r^2 + s_j^2)` and `s_j` the
//! distance to the nearest other centre: stiff where points crowd, soft where they are sparse. The affine tail makes any
//! affine map from performer to character exact. Sources are centred and scaled to unit root-mean-square first, which
//! keeps the system's condition number near 1e3.

use super::linear::Lu;
use glam::{DVec2, DVec3, Vec3};

/// Centres are evaluated in rows of this many: partial sums that any vector unit can hold.
const LANES: usize = 8;
/// Centres whose distances are computed before they are summed; a multiple of the lanes.
const BLOCK: usize = 64;
/// Below this ratio of pivots a system counts as singular.
const WORST_PIVOT_RATIO: f64 = 1e-12;
/// Centres closer than this fraction of the set's size are one point.
const DUPLICATE: f64 = 1e-6;

/// Centres in structure-of-arrays order, filled up with weightless ones to whole rows.
#[derive(Debug, Clone, Default)]
struct Centres {
    x: Vec<f32>,
    y: Vec<f32>,
    shape_squared: Vec<f32>,
    weight: [Vec<f32>; 3],
}

/// A fitted map from the plane to space.
#[derive(Debug, Clone)]
pub struct Regression {
    centres: Centres,
    /// Columns: constant, x, y (in scaled coordinates).
    affine: [Vec3; 3],
    centre: DVec2,
    /// Scaled units for each source unit.
    scale: f64,
}

/// Why no map could be fitted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FitError {
    /// Fewer than three different points, or all on one line.
    Degenerate,
    /// A ridge below zero walks into singularities of the multiquadric: it is conditionally negative definite.
    NegativeRidge,
}

impl Regression {
    /// Fits `targets[j]` at `sources[j]`. `ridge` is subtracted from the kernel's diagonal, in units of the scaled
    /// coordinates: the positive multiquadric is conditionally *negative* definite, so smoothing takes `K - ridge I`.
    pub fn fit(sources: &[DVec2], targets: &[DVec3], ridge: f64) -> Result<Self, FitError> {
        debug_assert_eq!(sources.len(), targets.len());
        if ridge.is_nan() || ridge < 0.0 {
            return Err(FitError::NegativeRidge);
        }
        let centre = sources.iter().copied().sum::<DVec2>() / sources.len().max(1) as f64;
        let mean_square = sources.iter().map(|p| (*p - centre).length_squared()).sum::<f64>() / sources.len().max(1) as f64;
        let rms = mean_square.sqrt();
        if rms.is_nan() || rms <= 0.0 || !rms.is_finite() {
            return Err(FitError::Degenerate);
        }
        let scale = 1.0 / rms;
        let mut points: Vec<DVec2> = Vec::with_capacity(sources.len());
        let mut values: Vec<DVec3> = Vec::with_capacity(sources.len());
        for (&source, &target) in sources.iter().zip(targets) {
            let point = (source - centre) * scale;
            if points.iter().all(|other| other.distance(point) > DUPLICATE) {
                points.push(point);
                values.push(target);
            }
        }
        if points.len() < 3 || !spans_plane(&points) {
            return Err(FitError::Degenerate);
        }
        let nearest: Vec<f64> = (0..points.len())
            .map(|j| (0..points.len()).filter(|&i| i != j).map(|i| points[i].distance(points[j])).fold(f64::INFINITY, f64::min))
            .collect();
        let mean = nearest.iter().sum::<f64>() / nearest.len() as f64;
        // Variable shape first; it has no guarantee, so the classical kernels stand behind it.
        for shapes in [nearest, vec![mean; points.len()], vec![0.0; points.len()]] {
            if let Some((weights, affine)) = solve_system(&points, &values, &shapes, ridge) {
                return Ok(Self { centres: Centres::new(&points, &shapes, &weights), affine, centre, scale });
            }
        }
        Err(FitError::Degenerate)
    }

    /// `F(p)`, metres.
    pub fn value(&self, p: DVec2) -> Vec3 {
        let (x, y) = self.scaled(p);
        let Centres { x: centre_x, y: centre_y, shape_squared, weight } = &self.centres;
        let mut sums = [0.0_f32; 3];
        // Distances first, then the sums: apart, both are loops that compilers turn into vector code.
        let mut phi = [0.0_f32; BLOCK];
        for start in (0..centre_x.len()).step_by(BLOCK) {
            let num = BLOCK.min(centre_x.len() - start);
            let phi = &mut phi[..num];
            let (centre_x, centre_y) = (&centre_x[start..start + num], &centre_y[start..start + num]);
            let shape_squared = &shape_squared[start..start + num];
            for j in 0..num {
                let (dx, dy) = (x - centre_x[j], y - centre_y[j]);
                phi[j] = (dx * dx + dy * dy + shape_squared[j]).sqrt();
            }
            for axis in 0..3 {
                sums[axis] += dot(&weight[axis][start..start + num], phi);
            }
        }
        self.affine[0] + self.affine[1] * x + self.affine[2] * y + Vec3::from(sums)
    }

    /// `dF/dx` and `dF/dy` at `p`: metres for each source unit.
    pub fn slope(&self, p: DVec2) -> [Vec3; 2] {
        let (x, y) = self.scaled(p);
        let centres = &self.centres;
        let mut along = [Vec3::ZERO; 2];
        for j in 0..centres.x.len() {
            let d = [x - centres.x[j], y - centres.y[j]];
            let phi = (d[0] * d[0] + d[1] * d[1] + centres.shape_squared[j]).sqrt();
            // At a centre of the linear kernel the slope is undefined; its mean over directions is zero.
            if phi > 0.0 {
                let weight = Vec3::new(centres.weight[0][j], centres.weight[1][j], centres.weight[2][j]);
                along[0] += weight * (d[0] / phi);
                along[1] += weight * (d[1] / phi);
            }
        }
        let scale = self.scale as f32;
        [(self.affine[1] + along[0]) * scale, (self.affine[2] + along[1]) * scale]
    }

    fn scaled(&self, p: DVec2) -> (f32, f32) {
        let p = (p - self.centre) * self.scale;
        (p.x as f32, p.y as f32)
    }
}

/// Dot product with eight partial sums, added up as a tree.
fn dot(a: &[f32], b: &[f32]) -> f32 {
    let mut lanes = [0.0_f32; LANES];
    for (a, b) in a.chunks_exact(LANES).zip(b.chunks_exact(LANES)) {
        for lane in 0..LANES {
            lanes[lane] += a[lane] * b[lane];
        }
    }
    ((lanes[0] + lanes[4]) + (lanes[2] + lanes[6])) + ((lanes[1] + lanes[5]) + (lanes[3] + lanes[7]))
}

/// True unless all points lie (nearly) on one line: the smaller principal spread must be above a millionth.
fn spans_plane(points: &[DVec2]) -> bool {
    let mean = points.iter().copied().sum::<DVec2>() / points.len() as f64;
    let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
    for p in points {
        let d = *p - mean;
        xx += d.x * d.x;
        xy += d.x * d.y;
        yy += d.y * d.y;
    }
    xx * yy - xy * xy > 1e-9 * (xx + yy) * (xx + yy)
}

/// Weights of the centres and the affine columns, or `None` where the system is close to singular.
fn solve_system(points: &[DVec2], values: &[DVec3], shapes: &[f64], ridge: f64) -> Option<(Vec<DVec3>, [Vec3; 3])> {
    let num = points.len();
    let size = num + 3;
    let mut matrix = vec![0.0; size * size];
    for i in 0..num {
        for j in 0..num {
            matrix[i * size + j] = (points[i].distance_squared(points[j]) + shapes[j] * shapes[j]).sqrt();
        }
        matrix[i * size + i] -= ridge;
        for (at, value) in [1.0, points[i].x, points[i].y].into_iter().enumerate() {
            matrix[i * size + num + at] = value;
            matrix[(num + at) * size + i] = value;
        }
    }
    let lu = Lu::factor(matrix, size)?;
    if lu.pivot_ratio() < WORST_PIVOT_RATIO {
        return None;
    }
    let axes = [0, 1, 2].map(|axis| {
        let mut right: Vec<f64> = values.iter().map(|value| value[axis]).collect();
        right.resize(size, 0.0);
        lu.solve(&right)
    });
    if axes.iter().flatten().any(|value| !value.is_finite()) {
        return None;
    }
    let at = |row: usize| DVec3::new(axes[0][row], axes[1][row], axes[2][row]);
    Some(((0..num).map(at).collect(), [num, num + 1, num + 2].map(|row| at(row).as_vec3())))
}

impl Centres {
    fn new(points: &[DVec2], shapes: &[f64], weights: &[DVec3]) -> Self {
        let filled = |values: &mut dyn Iterator<Item = f64>| -> Vec<f32> {
            let mut values: Vec<f32> = values.map(|value| value as f32).collect();
            values.resize(points.len().next_multiple_of(LANES), 0.0);
            values
        };
        Self {
            x: filled(&mut points.iter().map(|p| p.x)),
            y: filled(&mut points.iter().map(|p| p.y)),
            shape_squared: filled(&mut shapes.iter().map(|s| s * s)),
            weight: [0, 1, 2].map(|axis| filled(&mut weights.iter().map(|w| w[axis]))),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SOURCES: [DVec2; 5] =
        [DVec2::new(0.0, 0.0), DVec2::new(1.0, 0.0), DVec2::new(0.0, 1.0), DVec2::new(1.0, 1.0), DVec2::new(0.5, 0.4)];
    const TARGETS: [DVec3; 5] = [
        DVec3::new(0.0, 0.0, 0.0),
        DVec3::new(2.0, 0.0, 0.1),
        DVec3::new(0.0, 1.5, 0.1),
        DVec3::new(2.0, 1.5, 0.2),
        DVec3::new(1.0, 0.7, 0.6),
    ];

    fn assert_near(got: Vec3, want: [f32; 3], tolerance: f32) {
        assert!((got - Vec3::from(want)).abs().max_element() < tolerance, "got {got}, expected {want:?}");
    }

    #[test]
    fn interpolates_between_centres_with_variable_shape() {
        let map = Regression::fit(&SOURCES, &TARGETS, 0.0).expect("regular");
        for (source, target) in SOURCES.iter().zip(TARGETS) {
            assert_near(map.value(*source), target.as_vec3().into(), 1e-5);
        }
        assert_near(map.value(DVec2::new(0.6, 0.5)), [1.2, 0.8473787665, 0.606631709], 1e-5);
        assert_near(map.value(DVec2::new(0.05, 0.0)), [0.1, 0.0070600052, 0.0410060268], 1e-5);
        assert_near(map.value(DVec2::new(2.0, 2.0)), [4.0, 2.8837442433, -0.1929043594], 2e-5);
    }

    #[test]
    fn affine_tail_carries_translations_exactly() {
        let map = Regression::fit(&SOURCES, &TARGETS, 0.0).expect("regular");
        for source in SOURCES {
            let moved = map.value(source + DVec2::new(0.1, 0.0)) - map.value(source);
            assert!((moved.x - 0.2).abs() < 1e-5, "{moved}");
        }
    }

    #[test]
    fn ridge_is_subtracted_from_the_diagonal() {
        // The vector's ridge of 0.01 is in source units; the fit takes it in unit-RMS coordinates.
        let centre = SOURCES.iter().copied().sum::<DVec2>() / 5.0;
        let rms = (SOURCES.iter().map(|p| (*p - centre).length_squared()).sum::<f64>() / 5.0).sqrt();
        let map = Regression::fit(&SOURCES, &TARGETS, 0.01 / rms).expect("regular");
        let worst = SOURCES.iter().zip(TARGETS).map(|(p, q)| (map.value(*p).as_dvec3() - q).abs().max_element()).fold(0.0, f64::max);
        assert!((worst - 0.0372718866).abs() < 1e-5, "{worst}");
        let delta = map.value(DVec2::new(0.6, 0.5)) - map.value(DVec2::new(0.5, 0.4));
        assert_near(delta, [0.2, 0.1475470567, 0.0074899889], 1e-5);
        assert_eq!(Regression::fit(&SOURCES, &TARGETS, -0.1).err(), Some(FitError::NegativeRidge));
    }

    #[test]
    fn slope_is_the_derivative_of_the_value() {
        let map = Regression::fit(&SOURCES, &TARGETS, 0.0).expect("regular");
        let (p, step) = (DVec2::new(0.3, 0.7), 1e-3);
        let slope = map.slope(p);
        for (axis, unit) in [DVec2::X, DVec2::Y].into_iter().enumerate() {
            let numeric = (map.value(p + unit * step) - map.value(p - unit * step)) / (2.0 * step as f32);
            assert!((numeric - slope[axis]).abs().max_element() < 2e-3, "{numeric} {}", slope[axis]);
        }
    }

    #[test]
    fn points_on_a_line_are_refused_and_duplicates_merged() {
        let line: Vec<DVec2> = (0..5).map(|i| DVec2::new(f64::from(i), 2.0 * f64::from(i))).collect();
        assert_eq!(Regression::fit(&line, &TARGETS, 0.0).err(), Some(FitError::Degenerate));
        let (mut sources, mut targets) = (SOURCES.to_vec(), TARGETS.to_vec());
        sources.push(SOURCES[4]);
        targets.push(TARGETS[4]);
        let map = Regression::fit(&sources, &targets, 0.0).expect("the duplicate is one point");
        assert_near(map.value(SOURCES[4]), [1.0, 0.7, 0.6], 1e-5);
    }
}
