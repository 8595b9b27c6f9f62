//! Small dense linear systems and least squares for fits with a few unknowns.

/// Maximum number of steps of [`least_squares`].
const STEPS: usize = 80;

/// Solves `matrix x = right` by Gaussian elimination with pivoting; `None` if the matrix is singular.
pub(super) fn solve<const N: usize>(mut matrix: [[f64; N]; N], mut right: [f64; N]) -> Option<[f64; N]> {
    for column in 0..N {
        let pivot =
            (column..N).max_by(|&a, &b| matrix[a][column].abs().total_cmp(&matrix[b][column].abs()))?;
        let usable = matrix[pivot][column].abs() > 1e-300;
        if !usable {
            return None;
        }
        matrix.swap(column, pivot);
        right.swap(column, pivot);
        for row in (0..N).filter(|&row| row != column) {
            let factor = matrix[row][column] / matrix[column][column];
            (column..N).for_each(|k| matrix[row][k] -= factor * matrix[column][k]);
            right[row] -= factor * right[column];
        }
    }
    Some(std::array::from_fn(|k| right[k] / matrix[k][k]))
}

/// The minimum of a sum of squares within bounds, and the diagonal of the inverse Hessian there (`None` if it
/// is singular).
pub(super) struct Least<const N: usize> {
    pub(super) at: [f64; N],
    pub(super) cost: f64,
    pub(super) covariance: Option<[f64; N]>,
}

/// Levenberg-Marquardt from `start`, with derivatives by central differences; each unknown stays within its
/// `bounds`.
///
/// `residuals` appends to an empty vector, always the same number. Unknowns are of order 1.
pub(super) fn least_squares<const N: usize>(
    start: [f64; N],
    bounds: [[f64; 2]; N],
    residuals: impl Fn(&[f64; N], &mut Vec<f64>),
) -> Least<N> {
    let at = |x: &[f64; N]| {
        let mut found = Vec::new();
        residuals(x, &mut found);
        found
    };
    let cost_of = |r: &[f64]| r.iter().map(|r| r * r).sum::<f64>();
    let normal = |x: &[f64; N], now: &[f64]| {
        let by: [Vec<f64>; N] = std::array::from_fn(|k| {
            let moved = |by: f64| {
                let mut x = *x;
                x[k] += by;
                at(&x)
            };
            let (above, below) = (moved(1e-5), moved(-1e-5));
            above.iter().zip(&below).map(|(a, b)| (a - b) / 2e-5).collect()
        });
        let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        let hessian: [[f64; N]; N] = std::array::from_fn(|j| std::array::from_fn(|k| dot(&by[j], &by[k])));
        let gradient: [f64; N] = std::array::from_fn(|k| dot(&by[k], now));
        (hessian, gradient)
    };
    let clamped =
        |x: [f64; N]| -> [f64; N] { std::array::from_fn(|k| x[k].clamp(bounds[k][0], bounds[k][1])) };
    let mut x = clamped(start);
    let mut now = at(&x);
    let mut cost = cost_of(&now);
    let mut damping = 1e-2;
    for _ in 0..STEPS {
        let (hessian, gradient) = normal(&x, &now);
        let before = cost;
        while damping < 1e8 {
            let mut damped = hessian;
            (0..N).for_each(|k| damped[k][k] += damping * (hessian[k][k] + 1e-9) + 1e-12);
            let step = solve(damped, gradient).unwrap_or([0.0; N]);
            let tried = clamped(std::array::from_fn(|k| x[k] - step[k].clamp(-1.0, 1.0)));
            let there = at(&tried);
            if cost_of(&there) < cost {
                (x, cost, now) = (tried, cost_of(&there), there);
                damping = (damping / 4.0).max(1e-9);
                break;
            }
            damping *= 4.0;
        }
        if before - cost <= 1e-10 * before {
            break;
        }
    }
    let (hessian, _) = normal(&x, &now);
    let column = |k: usize| solve(hessian, std::array::from_fn(|j| if j == k { 1.0 } else { 0.0 }));
    let columns: Option<Vec<[f64; N]>> = (0..N).map(column).collect();
    Least { at: x, cost, covariance: columns.map(|columns| std::array::from_fn(|k| columns[k][k])) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn regular_system_is_solved_and_singular_one_refused() {
        let found = solve([[0.0, 2.0, 1.0], [1.0, -1.0, 0.0], [3.0, 0.0, -2.0]], [5.0, -1.0, -3.0]);
        let x = found.expect("regular");
        let expected = [3.0 / 7.0, 10.0 / 7.0, 15.0 / 7.0];
        assert!(x.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-12), "{x:?}");
        assert_eq!(solve([[1.0, 2.0], [2.0, 4.0]], [1.0, 2.0]), None);
    }

    #[test]
    fn exponential_is_fitted_within_bounds_with_variances() {
        let seen: Vec<(f64, f64)> =
            (0..40).map(|k| f64::from(k) * 0.1).map(|t| (t, 3.0 * (-0.7 * t).exp())).collect();
        let fit = |bounds| {
            least_squares([0.5, 0.1], bounds, |x, out| {
                out.extend(seen.iter().map(|(t, y)| (x[0].exp() * (-x[1] * t).exp() - y) / 0.1));
            })
        };
        let free = fit([[-5.0, 5.0]; 2]);
        assert!((free.at[0] - 3.0_f64.ln()).abs() < 1e-6 && (free.at[1] - 0.7).abs() < 1e-6, "{:?}", free.at);
        assert!(free.cost < 1e-8);
        let variances = free.covariance.expect("both are determined");
        assert!(variances.iter().all(|v| (1e-6..0.1).contains(v)), "{variances:?}");
        assert!((fit([[-5.0, 5.0], [0.0, 0.5]]).at[1] - 0.5).abs() < 1e-9, "a bound holds");
    }
}
