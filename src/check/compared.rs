//! Results of comparisons.
use crate::pass::close::{Tolerance, compare};

/// Result of one comparison: a mismatch as text, or an [`crate::Error`] of the device; both are
/// wrong results.
pub(super) type Found = crate::Result<Result<String, String>>;

/// Compares arrays: their distance, or the element that exceeds its bound.
pub(super) fn close(
    what: &str,
    actual: &[f32],
    reference: &[f64],
    tolerance: &Tolerance,
) -> Result<f64, String> {
    compare(actual, reference, tolerance).map(|d| d.relative_l2).map_err(|e| format!("{what}: {e}"))
}

/// Largest of several distances of [`close`], as text.
pub(super) fn worst(all: impl IntoIterator<Item = Result<f64, String>>) -> Result<String, String> {
    let mut worst = 0.0f64;
    for distance in all {
        worst = worst.max(distance?);
    }
    Ok(format!("relative L2 error {worst:.1e}"))
}

/// Compares arrays to the last bit.
pub(super) fn equal<T: PartialEq + std::fmt::Debug>(
    what: &str,
    actual: &[T],
    reference: &[T],
) -> Result<String, String> {
    if actual.len() != reference.len() {
        return Err(format!("{what}: {} elements against {}", actual.len(), reference.len()));
    }
    match actual.iter().zip(reference).position(|(a, b)| a != b) {
        None => Ok(format!("{} equal", actual.len())),
        Some(i) => Err(format!("{what}: element {i} is {:?}, should be {:?}", actual[i], reference[i])),
    }
}

/// Repeats a check for several cases; returns the first mismatch, or the last result.
pub(super) fn each<T>(cases: impl IntoIterator<Item = T>, mut check: impl FnMut(T) -> Found) -> Found {
    let mut result = Ok(String::new());
    for case in cases {
        result = check(case)?;
        if result.is_err() {
            break;
        }
    }
    Ok(result)
}
