//! Blocked dense Cholesky factorisation: the systems here have a few thousand unknowns, where the unblocked one of nalgebra
//! is bound by memory.
use nalgebra::{DMatrix, DVector};

/// Side of a block: three of them in f64 fit the second-level cache.
const BLOCK: usize = 96;

/// Solves `A x = b` for a symmetric positive definite matrix of which the lower triangle is given (and overwritten).
/// `None` when it is not positive definite.
pub(super) fn solve(mut a: DMatrix<f64>, b: &DVector<f64>) -> Option<DVector<f64>> {
    let n = a.nrows();
    let mut k = 0;
    while k < n {
        let m = BLOCK.min(n - k);
        let lower = a.view((k, k), (m, m)).clone_owned().cholesky()?.l();
        a.view_mut((k, k), (m, m)).copy_from(&lower);
        let rest = n - k - m;
        if rest > 0 {
            // Panel: P ← P L⁻ᵀ, that is L Pᵀ = (old P)ᵀ.
            let mut panel = a.view((k + m, k), (rest, m)).transpose();
            if !lower.solve_lower_triangular_mut(&mut panel) {
                return None;
            }
            let panel_t = panel;
            let panel = panel_t.transpose();
            a.view_mut((k + m, k), (rest, m)).copy_from(&panel);
            // Trailing matrix, lower block columns only.
            let mut c = 0;
            while c < rest {
                let w = BLOCK.min(rest - c);
                a.view_mut((k + m + c, k + m + c), (rest - c, w)).gemm(
                    -1.0,
                    &panel.rows(c, rest - c),
                    &panel_t.columns(c, w),
                    1.0,
                );
                c += w;
            }
        }
        k += m;
    }
    let mut x = b.clone();
    (a.solve_lower_triangular_mut(&mut x) && a.tr_solve_lower_triangular_mut(&mut x)).then_some(x)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Random;

    #[test]
    fn agrees_with_the_unblocked_factorisation_across_block_edges() {
        let mut rng = Random::new(2);
        for n in [1, 95, 96, 97, 300] {
            let j = DMatrix::from_fn(n + 5, n, |_, _| rng.normal());
            let a = j.transpose() * &j;
            let b = DVector::from_fn(n, |_, _| rng.normal());
            let x = solve(a.clone(), &b).unwrap();
            assert!((&a * &x - &b).norm() < 1e-8 * b.norm().max(1.0) * a.norm(), "{n}");
        }
        let mut bad = DMatrix::<f64>::identity(200, 200);
        bad[(150, 150)] = -1.0;
        assert!(solve(bad, &DVector::zeros(200)).is_none());
    }
}
