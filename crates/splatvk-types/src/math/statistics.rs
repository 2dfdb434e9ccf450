//! Order statistics.

/// Middle value (upper of the two for an even count); `None` when empty. Reorders the slice.
pub fn median(values: &mut [f64]) -> Option<f64> {
    quantile(values, 0.5)
}

/// The value below which a fraction `q` lies; `None` when empty. Reorders the slice.
pub fn quantile(values: &mut [f64], q: f64) -> Option<f64> {
    if values.is_empty() {
        return None;
    }
    let k = ((values.len() as f64 * q) as usize).min(values.len() - 1);
    Some(*values.select_nth_unstable_by(k, f64::total_cmp).1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn median_of_even_count_is_upper() {
        assert_eq!(median(&mut [3.0, 1.0, 2.0]), Some(2.0));
        assert_eq!(median(&mut [4.0, 1.0, 3.0, 2.0]), Some(3.0));
        assert_eq!(median(&mut []), None);
        assert_eq!(quantile(&mut [5.0, 4.0, 3.0, 2.0, 1.0], 0.2), Some(2.0));
        assert_eq!(quantile(&mut [5.0, 4.0], 1.0), Some(5.0));
    }
}
