//! sRGB transfer function (IEC 61966-2-1), continued above 1 by the same formula: colours of high
//! dynamic range keep their order and survive a round trip, while values up to 1 are as in an 8-bit
//! photo.

/// Encoded value to linear light; an odd function, so that negative values survive, too.
pub fn to_linear(v: f32) -> f32 {
    let a = v.abs();
    let linear = if a <= 0.04045 { a / 12.92 } else { ((a + 0.055) / 1.055).powf(2.4) };
    linear.copysign(v)
}

/// Linear light to the encoded value.
pub fn to_srgb(v: f32) -> f32 {
    let a = v.abs();
    let encoded = if a <= 0.003_130_8 { 12.92 * a } else { 1.055 * a.powf(1.0 / 2.4) - 0.055 };
    encoded.copysign(v)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn srgb_transfer_inverts_beyond_one() {
        // IEC 61966-2-1: mid grey 0.5 is 0.21404 linear.
        assert!((to_linear(0.5) - 0.214_041).abs() < 1e-5);
        assert!((to_linear(1.0) - 1.0).abs() < 1e-6 && (to_srgb(1.0) - 1.0).abs() < 1e-6);
        for k in -50..400 {
            let v = k as f32 * 0.01;
            // A few f32 roundings of a power.
            assert!((to_srgb(to_linear(v)) - v).abs() < 2e-6 * v.abs().max(1.0), "{v}");
        }
        assert!((1..400).all(|k| to_linear(k as f32 * 0.01) > to_linear((k - 1) as f32 * 0.01)));
    }
}
