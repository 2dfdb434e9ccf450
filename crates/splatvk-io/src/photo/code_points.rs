//! Conversion of colours to sRGB by the code points of ITU-T H.273 in video, AVIF, HEIF and PNG.
//! Pictures of high dynamic range (PQ and HLG, ITU-R BT.2100) become linear light in which diffuse
//! white, 203 cd/m² (ITU-R BT.2408), is 1; brighter values exceed 1.
use super::profile;
use image::{DynamicImage, ImageBuffer, Rgb, Rgba};
use moxcms::{CicpColorPrimaries, CicpProfile, ColorProfile, MatrixCoefficients, TransferCharacteristics};
use rayon::prelude::*;

/// Primaries, transfer, matrix, full range.
pub(super) type CodePoints = [u16; 4];

/// Transfer function.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Transfer {
    /// Curve of sRGB, also used for that of television, as cameras and players do.
    Srgb,
    /// Power function with this exponent.
    Gamma(f32),
    Pq,
    Hlg,
}

/// Luminance of diffuse white, cd/m² (ITU-R BT.2408).
const WHITE: f64 = 203.0;

/// Signal of diffuse white in HLG (ITU-R BT.2408).
const HLG_WHITE: f64 = 0.75;

impl Transfer {
    fn of(number: u16) -> Option<Transfer> {
        Some(match number {
            // Unspecified, and 0 of files that state nothing.
            0 | 2 => Transfer::Srgb,
            1 | 6 | 11..=15 => Transfer::Srgb,
            4 => Transfer::Gamma(2.2),
            5 => Transfer::Gamma(2.8),
            8 => Transfer::Gamma(1.0),
            16 => Transfer::Pq,
            17 => Transfer::Gamma(2.6),
            18 => Transfer::Hlg,
            _ => return None,
        })
    }

    fn is_hdr(self) -> bool {
        matches!(self, Transfer::Pq | Transfer::Hlg)
    }

    /// Light of a signal in [0, 1]; diffuse white is 1. HLG yields scene light, without the
    /// rendering for a display, as photos in sRGB have none either.
    fn light(self, signal: f64) -> f64 {
        match self {
            Transfer::Pq => pq_luminance(signal) / WHITE,
            Transfer::Hlg => hlg_light(signal) / hlg_light(HLG_WHITE),
            Transfer::Gamma(g) => signal.powf(f64::from(g)),
            Transfer::Srgb => f64::from(crate::scene::to_linear(signal as f32)),
        }
    }
}

/// Luminance of a PQ signal, cd/m² (SMPTE ST 2084).
fn pq_luminance(signal: f64) -> f64 {
    const M1: f64 = 0.159_301_757_812_5;
    const M2: f64 = 78.84375;
    const C1: f64 = 0.8359375;
    const C2: f64 = 18.8515625;
    const C3: f64 = 18.6875;
    let root = signal.powf(1.0 / M2);
    10_000.0 * ((root - C1).max(0.0) / (C2 - C3 * root)).powf(1.0 / M1)
}

/// Scene light of an HLG signal, 1 at full signal (ARIB STD-B67).
fn hlg_light(signal: f64) -> f64 {
    const A: f64 = 0.178_832_77;
    const B: f64 = 1.0 - 4.0 * A;
    const C: f64 = 0.559_910_73;
    if signal <= 0.5 { signal * signal / 3.0 } else { (((signal - C) / A).exp() + B) / 12.0 }
}

/// Converts to sRGB, or to linear light with the primaries of sRGB for high dynamic range; unknown
/// code points are noted and replaced by those of sRGB.
pub(super) fn to_srgb(image: DynamicImage, code: CodePoints, notes: &mut Vec<String>) -> DynamicImage {
    let [primaries, transfer, ..] = code;
    let transfer = Transfer::of(transfer).unwrap_or_else(|| {
        notes.push(format!(
            "states transfer {transfer} of ITU-T H.273, which is not known; read as that of sRGB"
        ));
        Transfer::Srgb
    });
    let stated = match primaries {
        // Unspecified: BT.2100 defines no others.
        0 | 2 if transfer.is_hdr() => 9,
        0 | 2 => 1,
        p => p,
    };
    let profile = profile_of(stated).unwrap_or_else(|| {
        notes.push(format!(
            "states primaries {stated} of ITU-T H.273, which are not known; read as those of sRGB"
        ));
        ColorProfile::new_srgb()
    });
    if transfer.is_hdr() {
        return linear(image, transfer, &profile);
    }
    let profile = match transfer {
        Transfer::Gamma(g) => profile::with_gamma(profile, g),
        _ => profile,
    };
    profile::by_profile(image, &profile)
}

/// Code points that an ICC profile states beside its curves, if they are of high dynamic range.
pub(super) fn of_hdr_profile(icc: &[u8]) -> Option<CodePoints> {
    let stated = ColorProfile::new_from_slice(icc).ok()?.cicp?;
    let code = [stated.color_primaries as u16, stated.transfer_characteristics as u16, 0, 1];
    is_hdr(code).then_some(code)
}

/// Profile with these primaries and the curve of sRGB.
fn profile_of(primaries: u16) -> Option<ColorProfile> {
    // 10 is XYZ itself, the others are reserved.
    if !matches!(primaries, 1 | 4..=9 | 11 | 12 | 22) {
        return None;
    }
    let mut profile = ColorProfile::new_srgb();
    let (red, green, blue) = (profile.red_trc.clone(), profile.green_trc.clone(), profile.blue_trc.clone());
    profile.update_rgb_colorimetry_from_cicp(CicpProfile {
        color_primaries: CicpColorPrimaries::try_from(primaries as u8).ok()?,
        transfer_characteristics: TransferCharacteristics::Srgb,
        matrix_coefficients: MatrixCoefficients::Identity,
        full_range: true,
    });
    (profile.red_trc, profile.green_trc, profile.blue_trc) = (red, green, blue);
    // A stated transfer would take precedence over the curves.
    profile.cicp = None;
    Some(profile)
}

/// Converts to linear light with the primaries of sRGB, floating point; negative components are
/// clamped to 0.
fn linear(image: DynamicImage, transfer: Transfer, profile: &ColorProfile) -> DynamicImage {
    let table: Vec<f32> = (0..=u16::MAX).map(|v| transfer.light(f64::from(v) / 65535.0) as f32).collect();
    let m = profile.transform_matrix(&ColorProfile::new_srgb()).v.map(|row| row.map(|v| v as f32));
    let light = |c: &[u16]| {
        let c = [0, 1, 2].map(|k| table[usize::from(c[k])]);
        m.map(|row| (row[0] * c[0] + row[1] * c[1] + row[2] * c[2]).max(0.0))
    };
    let (width, height) = (image.width(), image.height());
    if image.color().has_alpha() {
        let data: Vec<f32> = image
            .into_rgba16()
            .as_raw()
            .par_chunks(4)
            .flat_map_iter(|c| {
                let [r, g, b] = light(c);
                [r, g, b, f32::from(c[3]) / 65535.0]
            })
            .collect();
        let made = ImageBuffer::<Rgba<f32>, _>::from_raw(width, height, data);
        return made.unwrap_or_default().into();
    }
    let data: Vec<f32> = image.into_rgb16().as_raw().par_chunks(3).flat_map_iter(light).collect();
    let made = ImageBuffer::<Rgb<f32>, _>::from_raw(width, height, data);
    made.unwrap_or_default().into()
}

/// Number of a transfer by its name in ffprobe; `None` for unknown names.
pub(super) fn transfer_of_name(name: &str) -> Option<u16> {
    Some(match name {
        "" | "unknown" | "unspecified" | "reserved" => 2,
        "bt709" => 1,
        "bt470m" | "gamma22" => 4,
        "bt470bg" | "gamma28" => 5,
        "smpte170m" => 6,
        "linear" => 8,
        "iec61966-2-4" => 11,
        "bt1361e" => 12,
        "iec61966-2-1" => 13,
        "bt2020-10" => 14,
        "bt2020-12" => 15,
        "smpte2084" => 16,
        "smpte428" => 17,
        "arib-std-b67" => 18,
        _ => return None,
    })
}

/// Number of primaries by their name in ffprobe; `None` for unknown names.
pub(super) fn primaries_of_name(name: &str) -> Option<u16> {
    Some(match name {
        "" | "unknown" | "unspecified" | "reserved" => 2,
        "bt709" => 1,
        "bt470m" => 4,
        "bt470bg" => 5,
        "smpte170m" => 6,
        "smpte240m" => 7,
        "film" => 8,
        "bt2020" => 9,
        "smpte431" => 11,
        "smpte432" => 12,
        "ebu3213" => 22,
        _ => return None,
    })
}

/// Whether 8 bits per channel are too few for the transfer.
pub(super) fn is_hdr(code: CodePoints) -> bool {
    Transfer::of(code[1]).is_some_and(Transfer::is_hdr)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::to_linear;

    #[test]
    fn diffuse_white_of_hdr_is_one() {
        // 203 cd/m² is signal 0.5806 in PQ and 0.75 in HLG (ITU-R BT.2408, table 1).
        assert!((Transfer::Pq.light(0.5806) - 1.0).abs() < 1e-3);
        assert!((Transfer::Hlg.light(0.75) - 1.0).abs() < 1e-12);
        assert!((pq_luminance(1.0) - 10_000.0).abs() < 1e-6 && pq_luminance(0.0) == 0.0);
        assert!((hlg_light(1.0) - 1.0).abs() < 1e-6);
    }

    /// Linear light of a 16-bit pixel with these code points.
    fn one(c: [f64; 3], code: CodePoints) -> [f32; 3] {
        let stored = Rgb(c.map(|v| (v * 65535.0).round() as u16));
        let image = ImageBuffer::<Rgb<u16>, _>::from_pixel(2, 2, stored);
        let mut notes = Vec::new();
        match to_srgb(image.into(), code, &mut notes) {
            DynamicImage::ImageRgb32F(i) => i.get_pixel(1, 1).0,
            other => other.to_rgb32f().get_pixel(1, 1).0.map(to_linear),
        }
    }

    /// PQ signal of a light, by bisection.
    fn pq(light: f64) -> f64 {
        let (mut low, mut high) = (0.0, 1.0);
        for _ in 0..60 {
            let middle = 0.5 * (low + high);
            if Transfer::Pq.light(middle) < light { low = middle } else { high = middle }
        }
        low
    }

    /// HLG signal of a light.
    fn hlg(light: f64) -> f64 {
        let e: f64 = light * hlg_light(0.75);
        if e <= 1.0 / 12.0 {
            (3.0 * e).sqrt()
        } else {
            0.17883277 * (12.0 * e - 0.28466892).ln() + 0.55991073
        }
    }

    fn near(a: [f32; 3], b: [f32; 3]) {
        assert!((0..3).all(|k| (a[k] - b[k]).abs() < 2e-3), "{a:?}, expected {b:?}");
    }

    #[test]
    fn wide_primaries_become_those_of_srgb() {
        // BT.709 to BT.2020 by ITU-R BT.2087, and P3 with D65 as the inverse of the matrix in
        // profile.rs.
        let colour = [0.5f64, 0.2, 0.1];
        let by = |m: [[f64; 3]; 3]| m.map(|r| (0..3).map(|k| r[k] * colour[k]).sum::<f64>());
        let in_2020 = by([[0.6274, 0.3293, 0.0433], [0.0691, 0.9195, 0.0114], [0.0164, 0.088, 0.8956]]);
        let expected = colour.map(|v| v as f32);
        near(one(in_2020.map(pq), [9, 16, 9, 1]), expected);
        near(one(in_2020.map(pq), [2, 16, 9, 1]), expected);
        near(one(in_2020.map(hlg), [9, 18, 9, 1]), expected);
        let srgb = |l: f64| f64::from(crate::scene::to_srgb(l as f32));
        near(one(in_2020.map(srgb), [9, 13, 0, 1]), expected);
        let in_p3 = by([[0.8225, 0.1774, 0.0], [0.0332, 0.9669, 0.0], [0.0171, 0.0724, 0.9108]]);
        near(one(in_p3.map(srgb), [12, 13, 0, 1]), expected);
        near(one(colour.map(|v: f64| v.powf(1.0 / 2.2)), [1, 4, 0, 1]), expected);
        near(one(colour, [1, 8, 0, 1]), expected);
        near(one(colour.map(srgb), [1, 13, 0, 1]), expected);
        near(one(colour.map(srgb), [2, 2, 2, 1]), expected);
    }

    #[test]
    fn unknown_numbers_are_noted() {
        let image = || DynamicImage::from(image::RgbImage::from_pixel(2, 2, Rgb([90, 100, 110])));
        let mut notes = Vec::new();
        assert_eq!(to_srgb(image(), [10, 9, 0, 1], &mut notes), image());
        assert!(notes[0].contains("transfer 9") && notes[1].contains("primaries 10"), "{notes:?}");
    }
}
