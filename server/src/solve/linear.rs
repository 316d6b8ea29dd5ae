//! Small dense linear algebra with a fixed order of operations, so that every machine gets the same bits.

/// LU factors of a square matrix with partial pivoting.
pub(super) struct Lu {
    size: usize,
    /// Row-major; below the diagonal L (unit diagonal not stored), on and above it U.
    factors: Vec<f64>,
    /// Row that stands at each place after pivoting.
    row_of: Vec<usize>,
}

impl Lu {
    /// Factors `matrix`, row-major, `size * size`. `None` where it is singular to the last bit or not finite.
    pub(super) fn factor(mut matrix: Vec<f64>, size: usize) -> Option<Self> {
        debug_assert_eq!(matrix.len(), size * size);
        let mut row_of: Vec<usize> = (0..size).collect();
        for column in 0..size {
            let mut pivot = column;
            for row in column + 1..size {
                if matrix[row * size + column].abs() > matrix[pivot * size + column].abs() {
                    pivot = row;
                }
            }
            let largest = matrix[pivot * size + column];
            if largest == 0.0 || !largest.is_finite() {
                return None;
            }
            if pivot != column {
                row_of.swap(pivot, column);
                for at in 0..size {
                    matrix.swap(pivot * size + at, column * size + at);
                }
            }
            for row in column + 1..size {
                let factor = matrix[row * size + column] / largest;
                matrix[row * size + column] = factor;
                if factor != 0.0 {
                    for at in column + 1..size {
                        matrix[row * size + at] -= factor * matrix[column * size + at];
                    }
                }
            }
        }
        Some(Self { size, factors: matrix, row_of })
    }

    /// Smallest pivot over the largest: a cheap sign of bad conditioning.
    pub(super) fn pivot_ratio(&self) -> f64 {
        let (mut least, mut most) = (f64::INFINITY, 0.0_f64);
        for at in 0..self.size {
            let pivot = self.factors[at * self.size + at].abs();
            least = least.min(pivot);
            most = most.max(pivot);
        }
        if self.size == 0 { 1.0 } else { least / most }
    }

    /// The solution for one right-hand side.
    pub(super) fn solve(&self, right: &[f64]) -> Vec<f64> {
        let size = self.size;
        let mut x: Vec<f64> = self.row_of.iter().map(|&row| right[row]).collect();
        for row in 1..size {
            for at in 0..row {
                x[row] -= self.factors[row * size + at] * x[at];
            }
        }
        for row in (0..size).rev() {
            for at in row + 1..size {
                x[row] -= self.factors[row * size + at] * x[at];
            }
            x[row] /= self.factors[row * size + row];
        }
        x
    }

    /// 1-norm of the inverse. `size` solves: for use at load only.
    pub(super) fn inverse_norm(&self) -> f64 {
        let mut unit = vec![0.0; self.size];
        let mut norm = 0.0_f64;
        for column in 0..self.size {
            unit[column] = 1.0;
            norm = norm.max(self.solve(&unit).iter().map(|value| value.abs()).sum());
            unit[column] = 0.0;
        }
        norm
    }
}

/// Solves the symmetric positive definite `a x = b` of size `N` in place by Cholesky. False where `a` is not that.
pub(super) fn solve_positive<const N: usize>(a: &mut [[f64; N]; N], b: &mut [f64; N]) -> bool {
    for column in 0..N {
        for row in column..N {
            let mut sum = a[row][column];
            for at in 0..column {
                sum -= a[row][at] * a[column][at];
            }
            if row == column {
                if sum.is_nan() || sum <= 0.0 {
                    return false;
                }
                a[column][column] = sum.sqrt();
            } else {
                a[row][column] = sum / a[column][column];
            }
        }
    }
    for row in 0..N {
        for at in 0..row {
            b[row] -= a[row][at] * b[at];
        }
        b[row] /= a[row][row];
    }
    for row in (0..N).rev() {
        for at in row + 1..N {
            b[row] -= a[at][row] * b[at];
        }
        b[row] /= a[row][row];
    }
    true
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lu_solves_what_needs_pivoting() {
        let lu = Lu::factor(vec![0.0, 2.0, 1.0, 1.0, 0.0, 3.0, 4.0, 1.0, 0.0], 3).expect("regular");
        let x = lu.solve(&[7.0, 10.0, 6.0]);
        for (got, want) in x.iter().zip([1.0, 2.0, 3.0]) {
            assert!((got - want).abs() < 1e-12, "{x:?}");
        }
        // The first column of the inverse is (-3, 12, 1) / 25, its largest.
        assert!((lu.inverse_norm() - 16.0 / 25.0).abs() < 1e-12, "{}", lu.inverse_norm());
    }

    #[test]
    fn singular_matrices_are_seen() {
        assert!(Lu::factor(vec![1.0, 2.0, 2.0, 4.0], 2).is_none());
        assert!(Lu::factor(vec![f64::NAN, 2.0, 2.0, 4.0], 2).is_none());
        let nearly = Lu::factor(vec![1.0, 2.0, 2.0, 4.0 + 1e-13], 2).expect("not exactly singular");
        assert!(nearly.pivot_ratio() < 1e-12);
    }

    #[test]
    fn cholesky_solves_and_refuses() {
        let (mut a, mut b) = ([[4.0, 2.0], [2.0, 3.0]], [8.0, 8.0]);
        assert!(solve_positive(&mut a, &mut b));
        assert!((b[0] - 1.0).abs() < 1e-12 && (b[1] - 2.0).abs() < 1e-12);
        assert!(!solve_positive(&mut [[1.0, 2.0], [2.0, 1.0]], &mut [1.0, 1.0]));
    }
}
