//! Detection of blurred photos: out of focus, or moved during the exposure.
use super::sift;
use crate::photo::Photo;
use crate::progress::Progress;
use crate::scene::{Image, RgbImage};
use rayon::prelude::*;

/// Long side at which sharpness is measured, pixels: near the working resolution, so that blur
/// there shows here.
pub(super) const SIDE: usize = 1000;
/// Sharpness below this share of the median is blur. A photo in focus keeps 0.68 under a Gaussian
/// of 0.7 px at that scale, 0.53 under 1 px and 0.36 under 1.5 px; among photos in focus of one
/// place, content alone gives shares down to 0.7.
pub(super) const BLURRED: f64 = 0.6;

/// Warns of photos that are far less sharp than the others: splats trained on them become as
/// blurred, and their matches are less exact.
pub(super) fn warn_of_blur(photos: &[Photo], progress: &dyn Progress) {
    let all: Vec<f64> = photos.par_iter().map(|p| measure(&reduced_to(&p.image, SIDE))).collect();
    for (v, photo) in photos.iter().enumerate() {
        let mut others: Vec<f64> = all.iter().enumerate().filter(|(o, _)| *o != v).map(|(_, s)| *s).collect();
        let Some(usual) = crate::math::median(&mut others) else { continue };
        let share = all[v] / usual.max(1e-9);
        if share < BLURRED {
            progress.warn(&format!(
                "{} is blurred: it shows {:.0} % of the fine detail that the other photos show; leave it out, or take it again",
                photo.stem,
                100.0 * share
            ));
        }
    }
}

/// The image, reduced to a long side of `side` if it is larger.
fn reduced_to(image: &RgbImage, side: usize) -> std::borrow::Cow<'_, RgbImage> {
    let long = image.width.max(image.height);
    if long <= side {
        return std::borrow::Cow::Borrowed(image);
    }
    let to = |n: usize| (n * side).div_ceil(long);
    std::borrow::Cow::Owned(image.resized_by_area(to(image.width), to(image.height)))
}

/// Sharpness: the gradient energy that a slight blur removes, over the energy that it leaves. As a
/// ratio within one photo it is independent of contrast and exposure.
pub(super) fn measure(image: &RgbImage) -> f64 {
    let fine = image.luma();
    // The two blurs are three quarters of an octave apart; the first suppresses noise of single
    // pixels.
    let (a, b) = (sift::blurred(&fine, 0.7), sift::blurred(&fine, 1.4));
    let (before, after) = (gradient_energy(&a), gradient_energy(&b));
    (before - after).max(0.0) / after.max(1e-12)
}

/// Sum of the squared forward differences.
fn gradient_energy(p: &Image<f32>) -> f64 {
    (0..(p.height - 1) * p.width)
        .filter(|i| i % p.width + 1 < p.width)
        .map(|i| {
            let (dx, dy) = (p.data[i + 1] - p.data[i], p.data[i + p.width] - p.data[i]);
            (dx * dx + dy * dy) as f64
        })
        .sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::progress::{Recorded, Silent};
    use crate::testing;

    #[test]
    fn warn_of_blur_ignores_photo_size() {
        let mut random = crate::math::Random::new(1005);
        let noise: Vec<[f32; 3]> = (0..1000 * 64).map(|_| [random.uniform() as f32; 3]).collect();
        // Every pixel repeated `times` × `times` times: pixel by pixel that has less fine detail.
        let photo = |times: usize| {
            let (width, height) = (1000 * times, 64 * times);
            let from = |k: usize| k / width / times * 1000 + k % width / times;
            let data = (0..width * height).map(|k| noise[from(k)]).collect();
            let image = RgbImage { width, height, data };
            crate::photo::from_pixels("a.png".as_ref(), &image, None, width).unwrap()
        };
        let recorded = Recorded::new(&Silent);
        warn_of_blur(&[photo(1), photo(2)], &recorded);
        assert!(recorded.warnings().is_empty(), "{:?}", recorded.warnings());
    }

    #[test]
    fn warn_of_blur_names_defocused_photo() {
        let mut photos = testing::train(&testing::folder()).photos;
        let warned = |photos: &[Photo]| {
            let recorded = Recorded::new(&Silent);
            warn_of_blur(photos, &recorded);
            recorded.warnings()
        };
        assert!(warned(&photos).is_empty());
        let image = &mut photos[2].image;
        for c in 0..3 {
            let channel = Image {
                width: image.width,
                height: image.height,
                data: image.data.iter().map(|p| p[c]).collect(),
            };
            let blurred = sift::blurred(&channel, 3.0);
            image.data.iter_mut().zip(&blurred.data).for_each(|(p, v)| p[c] = *v);
        }
        let all = warned(&photos);
        assert!(all.len() == 1 && all[0].starts_with("train_02 is blurred: it shows "), "{all:?}");
        assert!(warned(&photos[2..3]).is_empty(), "one photo has nothing to be compared with");
    }
}
