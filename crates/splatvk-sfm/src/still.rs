//! Detection of overlays: watermarks, captions, logos or a bonnet, which stand still in the frame
//! while the scene moves. They are no part of the scene, and their corners match perfectly in all
//! photos, as if no camera had moved (colmap#2539).
//!
//! Gradients of an overlay, even of a half-transparent one, are equal in all photos (Dekel et al.
//! 2017, "On the effectiveness of visible watermarks"); those of the scene move.
use super::sift::blurred;
use super::two_view::{fundamental, sampson};
use crate::photo::Photo;
use crate::scene::{Camera, Image, Outside, RgbImage};
use glam::DVec2;
use rayon::prelude::*;
use std::collections::HashMap;

/// Long side at which photos are compared, pixels. The lengths below are in these pixels.
const SIDE: usize = 640;
/// Standard deviation of the blur before the gradient: noise and compression are finer.
const SMOOTH: f32 = 1.0;
/// Standard deviation of the window in which gradients are compared: about a letter of a caption.
const WINDOW: f32 = 4.0;
/// Root mean square gradient, full white per pixel, below which a window has no texture: noise has
/// half of it.
const TEXTURE: f32 = 0.004;
/// Least correlation of the gradients of an overlay in each pair of photos compared. On tuning sets
/// without overlays no region of [`LEAST_AREA`] reaches it together with [`PEAK`], photos 3° apart
/// included.
const ALIKE: f32 = 0.7;
/// Least correlation of pixels that extend an overlay: strokes before a busy scene.
const JOINED: f32 = 0.5;
/// Least excess of the correlation over that with one photo shifted by [`ASIDE`] in any direction.
/// A straight edge along the motion of the camera also stands still, but correlates as well when
/// shifted along itself.
const PEAK: f32 = 0.2;
/// Shift for [`PEAK`], pixels.
const ASIDE: f64 = 4.0;
/// Smallest area of an overlay, share of the picture: a date of ten small digits has five times
/// that.
const LEAST_AREA: f64 = 0.0005;
/// Share of the textured windows above which the photos themselves are equal, as from a tripod.
const SAME_PHOTOS: f64 = 0.85;
/// Largest difference between equal colours of different photos, due to compression.
const SAME_COLOUR: f32 = 0.05;

/// Marks the overlay that all photos of one size share. Photos with a transparent background have
/// none.
pub fn mark(photos: &mut [Photo]) {
    let empty = |p: &Photo| p.coverage.as_ref().is_some_and(|c| c.outside == Outside::Empty);
    if photos.iter().any(empty) {
        return;
    }
    let found = overlays(photos.iter().map(|p| &p.image));
    photos.iter_mut().zip(found).for_each(|(photo, hidden)| photo.set_overlay(hidden));
}

/// Overlay per image, from all images of its size.
pub(super) fn overlays<'a>(images: impl Iterator<Item = &'a RgbImage>) -> Vec<Option<Image<bool>>> {
    let images: Vec<&RgbImage> = images.collect();
    let size = |i: &RgbImage| (i.width, i.height);
    let mut of_size: HashMap<(usize, usize), Option<Image<bool>>> = HashMap::new();
    for image in &images {
        of_size.entry(size(image)).or_insert_with(|| {
            let group: Vec<&RgbImage> = images.iter().copied().filter(|i| size(i) == size(image)).collect();
            overlay(&group)
        });
    }
    images.iter().map(|image| of_size[&size(image)].clone()).collect()
}

/// Largest distance of a static pixel from its epipolar line, share of the long side, at which the
/// cameras explain it.
const EXPLAINED: f64 = 3.0 / 640.0;
/// Most pixels tested per region.
const TRIED: usize = 200;

/// Removes regions that the cameras explain from the overlays: a point that all cameras look at,
/// and distant surfaces while the camera does not rotate, also stand still. Returns whether any was
/// removed.
pub(super) fn clear_scene(photos: &mut [Photo], cameras: &[Camera]) -> bool {
    let mut cleared = false;
    for first in 0..photos.len() {
        let hidden = |v: usize| photos[v].overlay.as_ref().map(|o| &o.hidden);
        let Some(mask) = hidden(first).cloned() else { continue };
        let group: Vec<usize> = (first..photos.len()).filter(|v| hidden(*v) == Some(&mask)).collect();
        let (labels, count) = components(&mask.data, mask.width);
        let mut kept = mask.clone();
        for label in 1..count {
            let pixels: Vec<usize> = (0..labels.len()).filter(|i| labels[*i] == label).collect();
            let tried = pixels.iter().step_by(pixels.len().div_ceil(TRIED));
            let all = tried.clone().count();
            let at = |i: usize| DVec2::new((i % mask.width) as f64 + 0.5, (i / mask.width) as f64 + 0.5);
            if 2 * tried.filter(|i| is_explained(cameras, &group, at(**i))).count() > all {
                pixels.iter().for_each(|i| kept.data[*i] = false);
                cleared = true;
            }
        }
        if kept != mask {
            let left = kept.data.contains(&true).then_some(kept);
            group.iter().for_each(|v| photos[*v].set_overlay(left.clone()));
        }
    }
    cleared
}

/// Whether one scene point can project to the same `pixel` of all cameras in `group`.
fn is_explained(cameras: &[Camera], group: &[usize], pixel: DVec2) -> bool {
    let focal = |c: &Camera| 0.5 * (c.fx + c.fy);
    group.len() > 1
        && neighbours(group.len()).all(|(i, j)| {
            let (a, b) = (&cameras[group[i]], &cameras[group[j]]);
            let f = fundamental(&b.pose.compose(&a.pose.inverse()), focal(a), focal(b));
            let limit = EXPLAINED * f64::from(a.width.max(a.height));
            sampson(&f, pixel - DVec2::new(a.cx, a.cy), pixel - DVec2::new(b.cx, b.cy)) < limit * limit
        })
}

/// Overlay in words: its share of the frame and its position; `None` without one.
pub fn description(photos: &[Photo]) -> Option<String> {
    let mask = &photos.iter().find_map(|p| p.overlay.as_ref())?.hidden;
    let (w, h) = (mask.width, mask.height);
    let set: Vec<usize> = (0..w * h).filter(|i| mask.data[*i]).collect();
    let share = set.len() as f64 / (w * h) as f64;
    // The central nine tenths of its pixels, without specks elsewhere.
    let spread = |along: &dyn Fn(usize) -> f64| {
        let mut all: Vec<f64> = set.iter().map(|i| along(*i)).collect();
        all.sort_by(f64::total_cmp);
        (all[all.len() / 20], all[(all.len() - 1) * 19 / 20])
    };
    let across = half_of_range(spread(&|i| (i % w) as f64 / w as f64), "left", "right");
    let down = half_of_range(spread(&|i| (i / w) as f64 / h as f64), "top", "bottom");
    let place = match (down, across) {
        (Some(down), Some(across)) => format!("at the {down} {across}"),
        (Some(one), None) | (None, Some(one)) => format!("at the {one}"),
        (None, None) => "across the picture".to_owned(),
    };
    Some(format!(
        "a watermark, a caption or something fixed to the camera, on {:.0} % of the frame {place}",
        (100.0 * share).max(1.0)
    ))
}

/// Name of the half of [0, 1] that contains a range; `None` across the middle.
fn half_of_range((from, to): (f64, f64), low: &'static str, high: &'static str) -> Option<&'static str> {
    match () {
        () if to < 0.5 => Some(low),
        () if from > 0.5 => Some(high),
        () => None,
    }
}

/// Mask of the overlay that all `images`, of one size, share; at that size. `None` without one.
fn overlay(images: &[&RgbImage]) -> Option<Image<bool>> {
    let first = images.first().filter(|_| images.len() > 1)?;
    let (w, h) = (first.width, first.height);
    let scale = (SIDE as f64 / w.max(h) as f64).min(1.0);
    let to = |n: usize| ((n as f64 * scale).round() as usize).max(1);
    let small: Vec<RgbImage> = images.par_iter().map(|i| i.resized_by_area(to(w), to(h))).collect();
    let gradients: Vec<Gradients> = small.par_iter().map(|i| Gradients::of(&i.luma())).collect();
    let least_correlation = least_correlation(&gradients)?;
    let textured = least_correlation.iter().filter(|c| c.is_some()).count();
    let least = (LEAST_AREA * least_correlation.len() as f64) as usize;
    let wide: Vec<bool> = least_correlation.iter().map(|c| c.is_some_and(|c| c > JOINED)).collect();
    let sure = peaks(&gradients, &least_correlation);
    let (labels, count) = components(&wide, to(w));
    let mut seeds = vec![0usize; count];
    let marked = labels.iter().zip(&sure).filter(|(_, s)| **s);
    marked.for_each(|(label, _)| seeds[*label] += 1);
    let mut mask: Vec<bool> =
        labels.iter().zip(&wide).map(|(label, wide)| *wide && seeds[*label] >= least).collect();
    let share = mask.iter().filter(|m| **m).count() as f64 / textured.max(1) as f64;
    if !mask.contains(&true) || share > SAME_PHOTOS {
        return None;
    }
    fill_enclosed(&mut mask, &small, to(w));
    let at = |i: usize| {
        let (x, y) = ((i % w) as f64 * scale, (i / w) as f64 * scale);
        mask[(y as usize).min(to(h) - 1) * to(w) + (x as usize).min(to(w) - 1)]
    };
    Some(Image { width: w, height: h, data: (0..w * h).map(at).collect() })
}

/// Gradients of a photo, and their mean square in the window around each pixel.
struct Gradients {
    x: Image<f32>,
    y: Image<f32>,
    energy: Image<f32>,
}

impl Gradients {
    fn of(luma: &Image<f32>) -> Gradients {
        let smooth = blurred(luma, SMOOTH);
        let (w, h) = (smooth.width, smooth.height);
        let along = |step: &dyn Fn(usize, usize) -> f32| {
            let data = (0..w * h).map(|i| step(i % w, i / w)).collect();
            Image { width: w, height: h, data }
        };
        let across =
            |x: usize, y: usize| 0.5 * (smooth.at((x + 1).min(w - 1), y) - smooth.at(x.max(1) - 1, y));
        let down = |x: usize, y: usize| 0.5 * (smooth.at(x, (y + 1).min(h - 1)) - smooth.at(x, y.max(1) - 1));
        let (x, y) = (along(&across), along(&down));
        let square = x.data.iter().zip(&y.data).map(|(a, b)| a * a + b * b).collect();
        let energy = blurred(&Image { width: w, height: h, data: square }, WINDOW);
        Gradients { x, y, energy }
    }

    /// Windowed correlation with the gradients of another photo that is shifted by whole pixels;
    /// `None` where either has no texture.
    fn correlation(&self, other: &Gradients, (dx, dy): (i64, i64)) -> Vec<Option<f32>> {
        let (w, h) = (self.x.width as i64, self.x.height as i64);
        let moved = |i: usize| {
            let (x, y) = (i as i64 % w + dx, i as i64 / w + dy);
            (y.clamp(0, h - 1) * w + x.clamp(0, w - 1)) as usize
        };
        let product = |i: usize| {
            let o = moved(i);
            self.x.data[i] * other.x.data[o] + self.y.data[i] * other.y.data[o]
        };
        let data = (0..self.x.data.len()).map(product).collect();
        let product = blurred(&Image { width: self.x.width, height: self.x.height, data }, WINDOW);
        let relative = |(i, p): (usize, &f32)| {
            let (own, others) = (self.energy.data[i], other.energy.data[moved(i)]);
            (own.min(others) > TEXTURE * TEXTURE).then(|| p / (own * others).sqrt())
        };
        product.data.iter().enumerate().map(relative).collect()
    }
}

/// Pairs of photos that are compared: each with the next, the last with the first.
fn neighbours(count: usize) -> impl Iterator<Item = (usize, usize)> {
    let last = (count > 2).then_some((count - 1, 0));
    (1..count).map(|i| (i - 1, i)).chain(last)
}

/// Least correlation per pixel over the pairs compared, `None` where a photo has no texture. `None`
/// altogether if too few pixels exceed [`ALIKE`].
fn least_correlation(photos: &[Gradients]) -> Option<Vec<Option<f32>>> {
    let mut least: Option<Vec<Option<f32>>> = None;
    for (i, j) in neighbours(photos.len()) {
        let both = photos[i].correlation(&photos[j], (0, 0));
        let least = match &mut least {
            None => least.insert(both),
            Some(least) => {
                let pairs = least.iter_mut().zip(&both);
                pairs.for_each(|(l, b)| *l = l.zip(*b).map(|(l, b)| l.min(b)));
                least
            }
        };
        let alike = least.iter().filter(|c| c.is_some_and(|c| c > ALIKE)).count();
        if (alike as f64) < LEAST_AREA * least.len() as f64 {
            return None;
        }
    }
    least
}

/// Pixels whose correlation exceeds [`ALIKE`] and peaks at zero shift in all pairs compared.
fn peaks(photos: &[Gradients], correlation: &[Option<f32>]) -> Vec<bool> {
    let mut sure: Vec<bool> = correlation.iter().map(|c| c.is_some_and(|c| c > ALIKE)).collect();
    for (i, j) in neighbours(photos.len()) {
        let here = photos[i].correlation(&photos[j], (0, 0));
        let shifts: Vec<(i64, i64)> = (0..8)
            .map(|k| {
                let (s, c) = (f64::from(k) * std::f64::consts::FRAC_PI_4).sin_cos();
                ((ASIDE * c).round() as i64, (ASIDE * s).round() as i64)
            })
            .collect();
        let aside: Vec<Vec<Option<f32>>> =
            shifts.into_par_iter().map(|s| photos[i].correlation(&photos[j], s)).collect();
        for (k, sure) in sure.iter_mut().enumerate() {
            let around = aside.iter().filter_map(|a| a[k]).fold(f32::NEG_INFINITY, f32::max);
            *sure &= here[k].is_some_and(|c| c - around > PEAK);
        }
    }
    sure
}

/// Connected component of each set pixel, from 1 (0 where unset), and the number of labels with 0.
fn components(set: &[bool], width: usize) -> (Vec<usize>, usize) {
    let (mut labels, mut count, mut stack) = (vec![0; set.len()], 1, Vec::new());
    for start in 0..set.len() {
        if !set[start] || labels[start] > 0 {
            continue;
        }
        labels[start] = count;
        stack.push(start);
        while let Some(i) = stack.pop() {
            for n in around(i, width, set.len()).filter(|n| set[*n]) {
                if labels[n] == 0 {
                    labels[n] = count;
                    stack.push(n);
                }
            }
        }
        count += 1;
    }
    (labels, count)
}

/// Indices of the pixels left, right, above and below.
fn around(i: usize, width: usize, pixels: usize) -> impl Iterator<Item = usize> {
    let x = i % width;
    let sides = [
        (x > 0).then(|| i - 1),
        (x + 1 < width).then_some(i + 1),
        i.checked_sub(width),
        (i + width < pixels).then_some(i + width),
    ];
    sides.into_iter().flatten()
}

/// Adds regions that have one colour in all photos and are enclosed by the overlay: the ground of a
/// sign between its letters.
fn fill_enclosed(mask: &mut [bool], images: &[RgbImage], width: usize) {
    let plain: Vec<bool> =
        (0..mask.len()).into_par_iter().map(|i| !mask[i] && has_one_colour(images, i)).collect();
    let (labels, count) = components(&plain, width);
    // Pixel sides of each region next to the overlay, and next to other pixels.
    let mut sides = vec![(0usize, 0usize); count];
    for (i, label) in labels.iter().enumerate().filter(|l| *l.1 > 0) {
        for n in around(i, width, mask.len()).filter(|n| labels[*n] != *label) {
            if mask[n] { sides[*label].0 += 1 } else { sides[*label].1 += 1 }
        }
    }
    for (m, label) in mask.iter_mut().zip(&labels) {
        let (within, beyond) = sides[*label];
        *m |= *label > 0 && within > ENCLOSED * beyond;
    }
}

fn has_one_colour(images: &[RgbImage], i: usize) -> bool {
    (0..3).all(|c| {
        let values = images.iter().map(|image| image.data[i][c]);
        let (low, high) = values.fold((f32::INFINITY, f32::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)));
        high - low < SAME_COLOUR
    })
}

/// Least ratio of an enclosed region's outline next to the overlay to the rest of its outline.
const ENCLOSED: usize = 9;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::Pose;
    use crate::testing;
    use glam::DVec3;

    fn breakfast() -> Vec<Photo> {
        testing::train(&testing::folder()).photos
    }

    #[test]
    fn mark_finds_no_overlay_in_breakfast() {
        let mut photos = breakfast();
        mark(&mut photos);
        assert!(photos.iter().all(|p| p.overlay.is_none()) && description(&photos).is_none());
        for pair in photos.chunks_mut(2) {
            mark(pair);
            assert!(pair.iter().all(|p| p.overlay.is_none()));
        }
    }

    #[test]
    fn clear_scene_removes_explained_regions() {
        let mut photos = breakfast();
        let (w, h) = (photos[0].image.width, photos[0].image.height);
        // Three cameras around one point, the middle of each photo; a second region is in a corner.
        let place = |k: f64| {
            let turn = Pose::exp(DVec3::ZERO, DVec3::new(0.1 * k * k, 0.3 * k, 0.0));
            Pose { rotation: turn.rotation, translation: DVec3::new(0.0, 0.0, 4.0) }
        };
        let camera = testing::train(&testing::folder()).cameras[0].clone();
        let (cx, cy) = (0.5 * w as f64, 0.5 * h as f64);
        let cameras = [-1.0, 0.0, 1.0].map(|k| Camera { pose: place(k), cx, cy, ..camera.clone() });
        photos.truncate(3);
        let square = |i: usize, x: usize, y: usize| (i % w).abs_diff(x) < 4 && (i / w).abs_diff(y) < 4;
        let mask = |i: usize| square(i, w / 2, h / 2) || square(i, 60, 60);
        let mask = Image { width: w, height: h, data: (0..w * h).map(mask).collect() };
        photos.iter_mut().for_each(|p| p.set_overlay(Some(mask.clone())));
        assert!(clear_scene(&mut photos, &cameras));
        for photo in &photos {
            assert!(photo.uses(h / 2 * w + w / 2) && !photo.uses(60 * w + 60));
        }
        assert!(!clear_scene(&mut photos, &cameras));
    }
}
