//! Weighted PCA with whitening, the start of the code layout
//! (docs/internals/method.md#code-construction, step 3).
use crate::{Error, Result};
use nalgebra::{DMatrix, SymmetricEigen};

/// Projects K unit rows of length D onto the top `dim` weighted principal directions, whitens and
/// normalises them. Directions beyond the rank of the data are left zero. [K, dim], f64.
pub(super) fn project(rows: &[f32], weights: &[f64], d: usize, dim: usize) -> Result<Vec<f64>> {
    let count = weights.len();
    let total: f64 = weights.iter().sum();
    let mean: Vec<f64> = (0..d)
        .map(|c| (0..count).map(|k| weights[k] * rows[k * d + c] as f64).sum::<f64>() / total)
        .collect();
    let centred = DMatrix::from_fn(count, d, |k, c| rows[k * d + c] as f64 - mean[c]);
    let scaled = DMatrix::from_fn(count, d, |k, c| centred[(k, c)] * (weights[k] / total).sqrt());
    // the smaller of the two Gram matrices has the same non-zero spectrum
    let wide = count <= d;
    let gram = if wide { &scaled * scaled.transpose() } else { scaled.transpose() * &scaled };
    let eigen = SymmetricEigen::try_new(gram, 1e-12, 0)
        .ok_or_else(|| Error::work("codebook: the principal directions of the features did not converge"))?;
    let mut order: Vec<usize> = (0..eigen.eigenvalues.len()).collect();
    order.sort_by(|&a, &b| eigen.eigenvalues[b].total_cmp(&eigen.eigenvalues[a]).then(a.cmp(&b)));
    let largest = order.first().map_or(0.0, |&k| eigen.eigenvalues[k]);
    let mut out = vec![0.0; count * dim];
    for (axis, &k) in order.iter().take(dim).enumerate() {
        let value = eigen.eigenvalues[k];
        // below this the direction is rounding noise of the f32 features
        if value <= 1e-10 * largest {
            break;
        }
        let vector = eigen.eigenvectors.column(k).into_owned();
        let mut direction = if wide { scaled.transpose() * vector } else { vector };
        direction /= direction.norm();
        let strongest = direction.iter().fold(0.0f64, |m, &v| if v.abs() > m.abs() { v } else { m });
        let sign = strongest.signum() / (value.sqrt() + 1e-6);
        let projected = &centred * direction;
        for row in 0..count {
            out[row * dim + axis] = projected[row] * sign;
        }
    }
    Ok(out)
}
