//! Conversion of colours to sRGB by ICC profiles: phones write Display P3, cameras Adobe RGB, and
//! one scene may mix them. Colours outside sRGB are clamped to its boundary.
use crate::files::guarded;
use image::{DynamicImage, ImageBuffer, Pixel};
use moxcms::{
    Chromaticity, ColorPrimaries, ColorProfile, DataColorSpace, Layout, ToneReprCurve, TransformExecutor,
    TransformOptions, XyY,
};
use rayon::prelude::*;
use std::sync::Arc;

/// Largest change of a colour by a profile that counts as sRGB, in steps of 8 bits; tables of other
/// makers differ by one.
const SAME: u8 = 1;
/// Levels per channel of the colours in that test.
const PROBES: [u8; 6] = [0, 51, 102, 153, 204, 255];
/// Pixels per task of a thread.
const CHUNK: usize = 1 << 16;

/// Converts an image to sRGB. A profile that is damaged, or does not fit the image's channels (CMYK
/// JPEGs are decoded to RGB), changes nothing, with a note: metadata must not cost the photo.
pub(super) fn to_srgb(image: DynamicImage, icc: &[u8], notes: &mut Vec<String>) -> DynamicImage {
    let Ok(profile) = ColorProfile::new_from_slice(icc) else {
        notes.push("its ICC profile is damaged and not used".to_owned());
        return image;
    };
    if fits(&image, &profile) {
        return by_profile(image, &profile);
    }
    notes.push(format!(
        "its ICC profile ({:?}) does not describe its pixels and is not used",
        profile.color_space
    ));
    image
}

fn fits(image: &DynamicImage, profile: &ColorProfile) -> bool {
    match profile.color_space {
        DataColorSpace::Rgb => !is_grey(image),
        DataColorSpace::Gray => is_grey(image),
        _ => false,
    }
}

fn is_grey(image: &DynamicImage) -> bool {
    !image.color().has_color()
}

/// Converts an image to sRGB by a profile of its channels; a grey image with a colour profile is
/// unchanged.
pub(super) fn by_profile(image: DynamicImage, profile: &ColorProfile) -> DynamicImage {
    if !fits(&image, profile) || is_srgb(profile) {
        return image;
    }
    converted(&image, profile).unwrap_or(image)
}

/// Exponents of PNG for the curve of sRGB or of television, which FFmpeg writes as 1 / 1.961.
const SRGB_GAMMA: std::ops::Range<f64> = 0.42..0.53;

/// Converts an image to sRGB by an exponent from light to stored numbers, and x and y of white,
/// red, green and blue, as PNG states them.
pub(super) fn by_numbers(
    image: DynamicImage,
    gamma: Option<f64>,
    chromaticities: Option<[f64; 8]>,
) -> DynamicImage {
    let mut profile = ColorProfile::new_srgb();
    if let Some([wx, wy, rx, ry, gx, gy, bx, by]) = chromaticities {
        let point = |x: f64, y: f64| Chromaticity { x: x as f32, y: y as f32 };
        let primaries = ColorPrimaries { red: point(rx, ry), green: point(gx, gy), blue: point(bx, by) };
        let curves = (profile.red_trc.clone(), profile.green_trc.clone(), profile.blue_trc.clone());
        profile.update_rgb_colorimetry(XyY { x: wx, y: wy, yb: 1.0 }, primaries);
        (profile.red_trc, profile.green_trc, profile.blue_trc) = curves;
        if !profile.transform_matrix(&ColorProfile::new_srgb()).v.as_flattened().iter().all(|v| v.is_finite())
        {
            return image;
        }
    }
    match gamma.filter(|g| !SRGB_GAMMA.contains(g)) {
        Some(g) if is_grey(&image) => by_profile(image, &ColorProfile::new_gray_with_gamma((1.0 / g) as f32)),
        Some(g) => by_profile(image, &with_gamma(profile, (1.0 / g) as f32)),
        None => by_profile(image, &profile),
    }
}

/// The profile with power functions as its curves.
pub(super) fn with_gamma(mut profile: ColorProfile, gamma: f32) -> ColorProfile {
    let curve = Some(ToneReprCurve::Parametric(vec![gamma]));
    (profile.red_trc, profile.green_trc, profile.blue_trc) = (curve.clone(), curve.clone(), curve);
    profile.cicp = None;
    profile
}

fn converted(image: &DynamicImage, profile: &ColorProfile) -> Option<DynamicImage> {
    let srgb = ColorProfile::new_srgb();
    let with8 = |a, b| profile.create_transform_8bit(a, &srgb, b, TransformOptions::default()).ok();
    let with16 = |a, b| profile.create_transform_16bit(a, &srgb, b, TransformOptions::default()).ok();
    use DynamicImage::*;
    use Layout::{Gray, GrayAlpha, Rgb, Rgba};
    Some(match image {
        ImageRgb8(i) => ImageRgb8(by(i, with8(Rgb, Rgb)?)?),
        ImageRgba8(i) => ImageRgba8(by(i, with8(Rgba, Rgba)?)?),
        ImageRgb16(i) => ImageRgb16(by(i, with16(Rgb, Rgb)?)?),
        ImageRgba16(i) => ImageRgba16(by(i, with16(Rgba, Rgba)?)?),
        ImageLuma8(i) => ImageRgb8(by(i, with8(Gray, Rgb)?)?),
        ImageLumaA8(i) => ImageRgba8(by(i, with8(GrayAlpha, Rgba)?)?),
        ImageLuma16(i) => ImageRgb16(by(i, with16(Gray, Rgb)?)?),
        ImageLumaA16(i) => ImageRgba16(by(i, with16(GrayAlpha, Rgba)?)?),
        // Floating-point files contain linear light by convention, whatever their metadata state.
        _ => return None,
    })
}

type Image<P> = ImageBuffer<P, Vec<<P as Pixel>::Subpixel>>;
type Transform<T> = Arc<dyn TransformExecutor<T> + Send + Sync>;

/// Transforms every pixel.
fn by<T, P, Q>(image: &Image<P>, transform: Transform<T>) -> Option<Image<Q>>
where
    T: Copy + Default + Send + Sync,
    P: Pixel<Subpixel = T>,
    Q: Pixel<Subpixel = T>,
{
    let (from, to) = (usize::from(P::CHANNEL_COUNT), usize::from(Q::CHANNEL_COUNT));
    let mut data = vec![T::default(); image.as_raw().len() / from * to];
    let chunks = image.as_raw().par_chunks(CHUNK * from).zip(data.par_chunks_mut(CHUNK * to));
    // Each thread needs a guard of its own.
    chunks.map(|(from, to)| guarded(|| transform.transform(from, to).ok()).ok()?).collect::<Option<()>>()?;
    ImageBuffer::from_raw(image.width(), image.height(), data)
}

/// Whether a profile changes no colour visibly.
fn is_srgb(profile: &ColorProfile) -> bool {
    let grey = profile.color_space == DataColorSpace::Gray;
    let levels = || PROBES.iter().copied();
    let probes: Vec<[u8; 3]> = match grey {
        true => (0..=255).map(|v| [v; 3]).collect(),
        false => {
            levels().flat_map(|r| levels().flat_map(move |g| levels().map(move |b| [r, g, b]))).collect()
        }
    };
    let channels = |c: &[u8; 3]| c[..if grey { 1 } else { 3 }].to_vec();
    let flat: Vec<u8> = probes.iter().flat_map(channels).collect();
    let layout = if grey { Layout::Gray } else { Layout::Rgb };
    let srgb = ColorProfile::new_srgb();
    let Ok(transform) =
        profile.create_transform_8bit(layout, &srgb, Layout::Rgb, TransformOptions::default())
    else {
        return false;
    };
    let mut out = vec![0; 3 * probes.len()];
    transform.transform(&flat, &mut out).is_ok()
        && out.iter().zip(probes.as_flattened()).all(|(a, b)| a.abs_diff(*b) <= SAME)
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use image::{Luma, LumaA};

    /// Display P3, as phones embed it.
    pub fn display_p3() -> Vec<u8> {
        ColorProfile::new_display_p3().encode().unwrap()
    }

    fn one(image: DynamicImage, icc: &[u8]) -> [u8; 3] {
        to_srgb(image, icc, &mut Vec::new()).to_rgb8().get_pixel(0, 0).0
    }

    fn rgb(c: [u8; 3]) -> DynamicImage {
        image::RgbImage::from_pixel(2, 2, image::Rgb(c)).into()
    }

    #[test]
    fn wide_profiles_become_srgb() {
        let made = one(rgb([128, 64, 191]), &display_p3());
        // By the matrices of IEC 61966-2-1 and SMPTE EG 432-1 in double precision.
        let near = |a: [u8; 3], b: [u8; 3]| (0..3).all(|k| a[k].abs_diff(b[k]) <= 1);
        assert!(near(made, expected_p3([128, 64, 191])), "{made:?} {:?}", expected_p3([128, 64, 191]));
        assert!(near(one(rgb([90; 3]), &display_p3()), [90; 3]), "greys stay what they are");
        assert_eq!(one(rgb([0, 255, 0]), &display_p3()), [0, 255, 0], "outside sRGB: on its border");
        let adobe = ColorProfile::new_adobe_rgb().encode().unwrap();
        let made = one(rgb([100, 150, 100]), &adobe);
        assert!(made[0] < 75 && made[1].abs_diff(151) <= 2, "less red: {made:?}");
        let deep =
            image::ImageBuffer::<image::Rgb<u16>, _>::from_pixel(2, 2, image::Rgb([32896, 16448, 49087]));
        let made = to_srgb(deep.into(), &display_p3(), &mut Vec::new()).to_rgb8().get_pixel(0, 0).0;
        assert!(near(made, expected_p3([128, 64, 191])), "{made:?}");
    }

    fn expected_p3(c: [u8; 3]) -> [u8; 3] {
        use crate::scene::{to_linear, to_srgb};
        let linear = c.map(|v| f64::from(to_linear(f32::from(v) / 255.0)));
        // Display P3 to sRGB, both with D65.
        let rows = [
            [1.224_940_2, -0.224_940_2, 0.0],
            [-0.042_056_9, 1.042_056_9, 0.0],
            [-0.019_637_6, -0.078_636_5, 1.098_274_1],
        ];
        rows.map(|r| {
            let v: f64 = (0..3).map(|k| r[k] * linear[k]).sum();
            (to_srgb(v.clamp(0.0, 1.0) as f32) * 255.0).round() as u8
        })
    }

    #[test]
    fn srgb_or_damaged_profile_changes_nothing() {
        let picture: DynamicImage =
            image::RgbImage::from_fn(16, 16, |x, y| image::Rgb([x as u8 * 16, y as u8 * 16, 99])).into();
        let cmyk = {
            let mut p = display_p3();
            p[16..20].copy_from_slice(b"CMYK");
            p
        };
        for icc in [ColorProfile::new_srgb().encode().unwrap(), Vec::new(), b"no profile".to_vec(), cmyk] {
            assert_eq!(to_srgb(picture.clone(), &icc, &mut Vec::new()), picture);
        }
        let whole = display_p3();
        for cut in 0..whole.len() {
            let _ = to_srgb(rgb([128, 64, 191]), &whole[..cut], &mut Vec::new());
        }
    }

    #[test]
    fn grey_gamma_becomes_srgb() {
        let dark = ColorProfile::new_gray_with_gamma(1.8).encode().unwrap();
        let grey = ImageBuffer::<Luma<u8>, _>::from_pixel(2, 2, Luma([128]));
        // 0.502 ^ 1.8 is 0.289 of linear light, which is 0.575 in sRGB.
        let made = one(grey.into(), &dark);
        assert!(made.iter().all(|v| v.abs_diff(147) <= 1), "{made:?}");
        let with_alpha = ImageBuffer::<LumaA<u8>, _>::from_pixel(2, 2, LumaA([128, 51]));
        let made = to_srgb(with_alpha.into(), &dark, &mut Vec::new()).to_rgba8().get_pixel(1, 1).0;
        assert!(made[0].abs_diff(147) <= 1 && made[3] == 51, "{made:?}");
        assert_eq!(one(rgb([128; 3]), &dark), [128; 3], "a profile of grey says nothing of colours");
    }
}
