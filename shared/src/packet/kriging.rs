//! What a bone probably does, given the bones before it and the shape of the face: only the rest is sent.
//!
//! Skin moves together, and so do the two halves of a face. Displacements are taken as samples of a random field whose
//! covariance falls with the distance at rest, to the point itself and to its mirror image ("kriging", Matheron 1963); both
//! ends factor the same matrix and so expect the same. Skin also slides along the face: depth follows from the other two.
//! Sums run in a fixed order in plain arithmetic (and `libm`), so both ends get the same bits on every machine.

use glam::Vec3;

/// Distance over which skin moves alike, metres. This and the next two were tuned on tracker feeds.
const REACH: f64 = 0.1;
/// How much the other half of the face tells.
const MIRROR: f64 = 0.8;
/// Variance of a bone's own motion.
const OWN: f64 = 0.02;
/// Neighbours within this distance shape the face around a bone, metres.
const PATCH: f64 = 0.03;
/// Keeps slopes of lonely bones at 0, metres squared; and curvatures, metres to the fourth.
const RIDGE: [f64; 5] = [1e-5, 1e-5, 1e-7, 1e-7, 1e-7];

/// Which half of a mirrored pair moves which way.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Symmetry {
    /// Left and right move alike (up and down, out of the face).
    Even,
    /// Left and right move oppositely (sideways).
    Odd,
}

/// Expects each of `n` values from those before it.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Expectation {
    /// Lower triangle of the covariance's Cholesky factor, `n` columns of `n`: a value is told to all behind it at once.
    columns: Vec<f32>,
    num: usize,
}

impl Expectation {
    /// For values at `points` (rest positions, metres).
    pub fn new(points: &[Vec3], symmetry: Symmetry) -> Self {
        let num = points.len();
        let sign = match symmetry {
            Symmetry::Even => MIRROR,
            Symmetry::Odd => -MIRROR,
        };
        let covariance = |a: usize, b: usize| {
            let mirrored = points[b] * Vec3::new(-1.0, 1.0, 1.0);
            let near = |other: Vec3| libm::exp(-distance(points[a], other) / REACH);
            near(points[b]) + sign * near(mirrored) + if a == b { OWN } else { 0.0 }
        };
        let mut factor = vec![0.0f64; num * num];
        for row in 0..num {
            for column in 0..=row {
                let mut sum = covariance(row, column);
                for k in 0..column {
                    sum -= factor[row * num + k] * factor[column * num + k];
                }
                // The field with its own noise is positive definite; points that coincide keep at least half of it.
                factor[row * num + column] = if row == column { sum.max(OWN / 2.0).sqrt() } else { sum / factor[column * num + column] };
            }
        }
        let columns = (0..num).flat_map(|column| (0..num).map(move |row| (row, column)));
        Self { columns: columns.map(|(row, column)| factor[row * num + column] as f32).collect(), num }
    }

    /// Tells that value `index` is `value`, in their order. `expected` is what each is expected to be, at first 0: those behind change.
    pub fn tell(&self, index: usize, value: f32, expected: &mut [f32]) {
        let column = &self.columns[index * self.num..][..self.num];
        let whitened = (value - expected[index]) / column[index];
        for (expected, weight) in expected[..self.num].iter_mut().zip(column).skip(index + 1) {
            *expected += weight * whitened;
        }
    }
}

/// How depth changes with x and y on the face around each point: a quadric through the points near it.
pub(super) fn slopes(points: &[Vec3]) -> Vec<[f32; 2]> {
    points.iter().map(|centre| slope(*centre, points)).collect()
}

fn slope(centre: Vec3, points: &[Vec3]) -> [f32; 2] {
    // Normal equations of 5 coefficients: x, y, x², y², xy.
    let mut matrix = [[0.0f64; 6]; 5];
    for (i, ridge) in RIDGE.iter().enumerate() {
        matrix[i][i] = *ridge;
    }
    for point in points {
        let [x, y, z] = (*point - centre).to_array().map(f64::from);
        let far = distance(*point, centre) / PATCH;
        let weight = libm::exp(-far * far);
        let terms = [x, y, x * x, y * y, x * y];
        for i in 0..5 {
            for k in 0..5 {
                matrix[i][k] += weight * terms[i] * terms[k];
            }
            matrix[i][5] += weight * terms[i] * z;
        }
    }
    // Gaussian elimination; the ridge keeps every pivot above 0.
    for pivot in 0..5 {
        for row in pivot + 1..5 {
            let share = matrix[row][pivot] / matrix[pivot][pivot];
            for column in pivot..6 {
                matrix[row][column] -= share * matrix[pivot][column];
            }
        }
    }
    let mut solution = [0.0f64; 5];
    for row in (0..5).rev() {
        let known: f64 = (row + 1..5).map(|column| matrix[row][column] * solution[column]).sum();
        solution[row] = (matrix[row][5] - known) / matrix[row][row];
    }
    [solution[0], solution[1]].map(|slope| slope.clamp(-2.0, 2.0) as f32)
}

fn distance(a: Vec3, b: Vec3) -> f64 {
    let [x, y, z] = [a.x - b.x, a.y - b.y, a.z - b.z].map(f64::from);
    (x * x + y * y + z * z).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    const FOUR: [Vec3; 4] =
        [Vec3::new(0.03, 0.05, 0.09), Vec3::new(-0.03, 0.05, 0.09), Vec3::new(0.031, 0.05, 0.09), Vec3::new(0.0, -0.1, 0.09)];

    fn expectations(symmetry: Symmetry, values: [f32; 4]) -> [f32; 4] {
        let field = Expectation::new(&FOUR, symmetry);
        let mut expected = [0.0f32; 4];
        for (i, value) in values.into_iter().enumerate() {
            field.tell(i, value, &mut expected);
        }
        expected
    }

    #[test]
    fn neighbours_and_mirror_images_tell_and_the_first_is_unknown() {
        let even = expectations(Symmetry::Even, [10.0, 10.0, 10.0, 0.0]);
        assert_eq!(even[0], 0.0);
        assert!(even[1] > 7.0 && even[1] < 10.0, "the mirror image is expected to move alike: {even:?}");
        assert!(even[2] > 9.0 && even[2] < 10.5, "a neighbour a millimetre away, too: {even:?}");
        assert!(even[3].abs() < 6.0, "far away little is known: {even:?}");
        let odd = expectations(Symmetry::Odd, [10.0, -10.0, 10.0, 0.0]);
        assert!(odd[1] < -4.0, "sideways the mirror image moves the other way: {odd:?}");
    }

    #[test]
    fn points_in_one_place_are_no_trouble() {
        let field = Expectation::new(&[Vec3::splat(0.05); 64], Symmetry::Odd);
        let mut expected = [0.0f32; 64];
        for i in 0..64 {
            assert!(expected[i].is_finite() && expected[i].abs() < 20.0, "{expected:?}");
            field.tell(i, 10.0, &mut expected);
        }
    }

    #[test]
    fn a_slanted_plane_has_its_slope() {
        let points: Vec<Vec3> = (0..25)
            .map(|i| {
                let (x, y) = ((i % 5) as f32 * 0.01, (i / 5) as f32 * 0.01);
                Vec3::new(x, y, 0.5 * x - 0.25 * y)
            })
            .collect();
        for [x, y] in slopes(&points) {
            assert!((x - 0.5).abs() < 0.03 && (y + 0.25).abs() < 0.03, "{x} {y}");
        }
        assert_eq!(slopes(&[Vec3::ONE]), [[0.0, 0.0]]);
    }
}
