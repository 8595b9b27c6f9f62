//! Symmetric systems with three unknowns, for fits that may leave some undetermined.

/// Rows of a symmetric matrix.
pub(super) type Matrix = [[f64; 3]; 3];

/// Solves `matrix x = right` by Gaussian elimination with pivoting; 0 for an undetermined unknown.
pub(super) fn solve(mut matrix: Matrix, mut right: [f64; 3]) -> [f64; 3] {
    let mut row_of = [None; 3];
    let mut used = [false; 3];
    for column in 0..3 {
        let free = (0..3).filter(|&row| !used[row]);
        let Some(pivot) = free.max_by(|&a, &b| matrix[a][column].abs().total_cmp(&matrix[b][column].abs()))
        else {
            break;
        };
        let head = matrix[pivot][column];
        let usable = head.abs() > 1e-300;
        if !usable {
            continue;
        }
        (used[pivot], row_of[column]) = (true, Some(pivot));
        for row in (0..3).filter(|&row| row != pivot) {
            let factor = matrix[row][column] / head;
            (0..3).for_each(|k| matrix[row][k] -= factor * matrix[pivot][k]);
            right[row] -= factor * right[pivot];
        }
    }
    std::array::from_fn(|column| row_of[column].map_or(0.0, |row| right[row] / matrix[row][column]))
}

/// Variances of three parameters of order 1 with the information matrix `hessian`. Each is the larger of two
/// estimates: the inverse of `hessian`, and the sandwich with `scatter`, the sum of outer products of the
/// clusters' gradients.
///
/// A weak prior (standard deviation 10) covers undetermined parameters. Such a parameter gets a variance near
/// 100 and does not affect the others.
pub(super) fn covariance(mut hessian: Matrix, scatter: Matrix) -> [f64; 3] {
    const PRIOR: f64 = 0.01;
    (0..3).for_each(|k| hessian[k][k] += PRIOR);
    // Scaled to a unit diagonal, since the information can differ by ten orders of magnitude.
    let scale = [0, 1, 2].map(|k| hessian[k][k].sqrt());
    let scaled = |matrix: &Matrix| -> Matrix {
        std::array::from_fn(|j| std::array::from_fn(|k| matrix[j][k] / (scale[j] * scale[k])))
    };
    let (bread, filling) = (scaled(&hessian), scaled(&scatter));
    let column = |k: usize| solve(bread, std::array::from_fn(|j| if j == k { 1.0 } else { 0.0 }));
    let inverse = [column(0), column(1), column(2)];
    std::array::from_fn(|k| {
        let row = inverse[k];
        let sandwich: f64 = (0..3)
            .flat_map(|i| (0..3).map(move |j| (i, j)))
            .map(|(i, j)| row[i] * filling[i][j] * row[j])
            .sum();
        sandwich.max(row[k]).max(0.0) / (scale[k] * scale[k])
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn undetermined_unknowns_of_a_system_are_zero() {
        let matrix = [[0.0, 2.0, 1.0], [2.0, 1.0, 0.0], [1.0, 0.0, 3.0]];
        let x = [0.5, -1.0, 2.0];
        let right = std::array::from_fn(|j| (0..3).map(|k| matrix[j][k] * x[k]).sum());
        let found = solve(matrix, right);
        assert!(found.iter().zip(x).all(|(a, b)| (a - b).abs() < 1e-12), "{found:?}");
        assert_eq!(solve([[4.0, 0.0, 0.0], [0.0; 3], [0.0, 0.0, 2.0]], [2.0, 0.0, 3.0]), [0.5, 0.0, 1.5]);
    }

    #[test]
    fn undetermined_parameter_does_not_affect_other_variances() {
        let hessian = [[1e8, 0.0, 2e3], [0.0; 3], [2e3, 0.0, 1e4]];
        let variance = covariance(hessian, [[0.0; 3]; 3]);
        assert!((variance[1] - 100.0).abs() < 1e-9);
        assert!(
            (variance[0] * 1e8 - 1.0).abs() < 0.01 && (variance[2] * 1e4 - 1.0).abs() < 0.01,
            "{variance:?}"
        );
        // Cluster gradients with four times the expected scatter.
        let variance = covariance(hessian, hessian.map(|row| row.map(|value| 4.0 * value)));
        assert!((variance[0] * 1e8 - 4.0).abs() < 0.01, "{variance:?}");
    }
}
