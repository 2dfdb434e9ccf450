//! Degrees of spherical harmonics in files.
use crate::scene::sh_coefficients;

/// SH degree for a number of `f_rest` columns, and the coefficients per channel in the file; adds a
/// note where some are not read.
pub(super) fn sh_degree(columns: usize, notes: &mut Vec<String>) -> Result<(u32, usize), String> {
    let degree = (0..=4).find(|&d| 3 * (sh_coefficients(d) - 1) == columns).ok_or_else(|| {
        format!("its {columns} f_rest columns fit no SH degree (0, 9, 24, 45 or 72 do); export it with one of them")
    })?;
    notes.extend((degree > MOST_DEGREE).then(|| beyond_degree(degree)));
    Ok((degree.min(MOST_DEGREE), columns / 3))
}

/// Highest SH degree that is rendered.
pub(super) const MOST_DEGREE: u32 = 3;

/// Note on coefficients beyond [`MOST_DEGREE`].
pub(super) fn beyond_degree(degree: u32) -> String {
    format!("its SH degree is {degree}: band {degree} is left out, {MOST_DEGREE} bands are read")
}
