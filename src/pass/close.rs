//! Comparison of computed with reference numbers, for tests and [`crate::check`]: a bound on the
//! whole array, a bound on every element, and a budget of outliers, for elements where a threshold
//! decides differently.
use std::fmt;

/// Bounds of [`compare`].
#[derive(Clone, Copy, Debug)]
pub struct Tolerance {
    /// ‖a − b‖₂ ≤ `relative_l2` · ‖b‖₂, taken over the elements within their own bound.
    pub relative_l2: f64,
    /// Bound of an element: |a − b| ≤ `absolute` + `relative` · |b|.
    pub absolute: f64,
    /// Relative part of the bound of an element.
    pub relative: f64,
    /// Largest share of elements outside their bound.
    pub outliers: f64,
    /// Bound of these outliers, in multiples of the bound of an element.
    pub outlier_factor: f64,
}

/// Tolerance of images (docs/internals/method.md#tolerances). One side may count a contribution at
/// the α threshold of 1/255 that the other skips, up to 1/255 of a channel value; at most 2 pixels
/// in 10 000 may differ by that.
pub const IMAGE: Tolerance =
    Tolerance { relative_l2: 1e-4, absolute: 1e-4, relative: 1e-5, outliers: 2e-4, outlier_factor: 200.0 };

/// Tolerance of one class of gradients: relative L2 error 1e-3
/// (docs/internals/method.md#tolerances; measured 4e-7 to 4e-6). Elements are sums of many terms of
/// both signs, so each is also allowed 2e-3 of the root mean square of the class. A contribution at
/// the α threshold that one side counts and the other skips may push 2 % of the elements of a small
/// class beyond that.
pub fn gradient_tolerance(reference: &[f64]) -> Tolerance {
    let rms = (reference.iter().map(|x| x * x).sum::<f64>() / reference.len().max(1) as f64).sqrt();
    Tolerance {
        relative_l2: 1e-3,
        absolute: 2e-3 * rms + 1e-9,
        relative: 2e-3,
        outliers: 0.02,
        outlier_factor: 50.0,
    }
}

/// Distance of two arrays.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Distance {
    /// ‖a − b‖₂ / ‖b‖₂ over inliers.
    pub relative_l2: f64,
    /// Largest |a − b|, outliers included.
    pub worst: f64,
    /// Index of that element.
    pub worst_at: usize,
    /// Elements outside their bound.
    pub outliers: usize,
    /// Number of elements.
    pub count: usize,
}

impl fmt::Display for Distance {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(
            f,
            "relative L2 {:.2e}, worst |a-b| {:.2e} at {}, {} of {} outside their bound",
            self.relative_l2, self.worst, self.worst_at, self.outliers, self.count
        )
    }
}

/// Compares `actual` with `reference`.
///
/// # Errors
/// Names the bound that was exceeded. A number that is not finite, in either array, is always an
/// error.
pub fn compare(actual: &[f32], reference: &[f64], tolerance: &Tolerance) -> Result<Distance, String> {
    if actual.len() != reference.len() {
        return Err(format!("{} elements against {}", actual.len(), reference.len()));
    }
    let mut d = Distance { count: actual.len(), ..Distance::default() };
    let (mut error2, mut norm2) = (0.0, 0.0);
    for (i, (&a, &b)) in actual.iter().zip(reference).enumerate() {
        let a = f64::from(a);
        if !a.is_finite() || !b.is_finite() {
            return Err(format!("element {i} is not finite: {a} against {b}"));
        }
        let error = (a - b).abs();
        if error > d.worst {
            (d.worst, d.worst_at) = (error, i);
        }
        let bound = tolerance.absolute + tolerance.relative * b.abs();
        norm2 += b * b;
        if error <= bound {
            error2 += error * error;
            continue;
        }
        d.outliers += 1;
        if error > tolerance.outlier_factor * bound {
            return Err(format!(
                "element {i}: {a} against {b}, {:.1} times its bound {bound:.2e}",
                error / bound
            ));
        }
    }
    // An all-zero reference has no scale: only the bounds of the elements count.
    d.relative_l2 = if norm2 > 0.0 { (error2 / norm2).sqrt() } else { 0.0 };
    if d.outliers as f64 > tolerance.outliers * d.count as f64 {
        return Err(format!("too many outliers: {d}"));
    }
    if d.relative_l2 > tolerance.relative_l2 {
        return Err(format!("too far as a whole: {d}"));
    }
    Ok(d)
}

#[cfg(test)]
mod tests {
    use super::*;

    const STRICT: Tolerance =
        Tolerance { relative_l2: 1e-3, absolute: 1e-6, relative: 1e-3, outliers: 0.0, outlier_factor: 1.0 };

    #[test]
    fn compare_equal_arrays_reports_zero() {
        let d = compare(&[1.0, -2.0], &[1.0, -2.0], &STRICT).unwrap();
        assert_eq!((d.outliers, d.worst, d.relative_l2), (0, 0.0, 0.0));
    }

    #[test]
    fn compare_each_exceeded_bound_fails() {
        assert!(compare(&[1.0], &[1.0, 2.0], &STRICT).is_err(), "length");
        assert!(compare(&[f32::NAN], &[1.0], &STRICT).is_err(), "NaN");
        assert!(compare(&[f32::INFINITY], &[f64::INFINITY], &STRICT).is_err(), "infinite");
        assert!(compare(&[1.01], &[1.0], &STRICT).is_err(), "element");
        let loose = Tolerance { relative: 0.1, ..STRICT };
        assert!(compare(&[1.01], &[1.0], &loose).unwrap_err().contains("whole"), "L2");
        let wrong_sign = compare(&[-1.0], &[1.0], &loose);
        assert!(wrong_sign.is_err(), "sign");
    }

    #[test]
    fn compare_outliers_over_budget_fail() {
        let budget = Tolerance { outliers: 0.25, outlier_factor: 100.0, ..STRICT };
        let reference = [1.0; 8];
        let mut actual = [1.0f32; 8];
        actual[0] = 1.01;
        actual[1] = 1.01;
        assert_eq!(compare(&actual, &reference, &budget).unwrap().outliers, 2);
        actual[2] = 1.01;
        assert!(compare(&actual, &reference, &budget).is_err(), "three of eight is more than a quarter");
        actual[2] = 1.0;
        actual[1] = 2.0;
        assert!(compare(&actual, &reference, &budget).is_err(), "an outlier has a bound too");
    }
}
