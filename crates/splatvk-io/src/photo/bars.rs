//! Bars beside the picture that photos have in common: letterboxes, frames of instant photos, the
//! surface of a phone around a photo, captions and banners. They stand still in the frame and are
//! cut off.
//!
//! Thin plain borders of a single photo, as of scans, are handled by [`super::border`].
use super::border::PlainBorder;
use super::read::{Photo, SMALLEST_SIDE};
use crate::scene::RgbImage;
use rayon::prelude::*;
use std::collections::HashMap;

/// Largest difference of a colour between the photos within a bar, and within a plain bar of one
/// photo: compression.
const SAME: f32 = 0.05;
/// Smallest share of such pixels in a line of a bar.
const BAR: f64 = 0.95;
/// Share below which a line belongs to the picture: where a wall or sky that looks the same in all
/// photos ends, the share falls gradually, object by object.
const PICTURE: f64 = 0.3;
/// Largest width of a bar's edge, share of the shorter side: compression smears it over a block.
const EDGE: f64 = 0.02;
/// Smallest bar, share of the shorter side; a thinner one is an uneven border.
const THINNEST: f64 = 0.015;
/// Smallest share of the file that the picture fills: a landscape photo on a tall phone fills a
/// quarter.
const LEAST_PICTURE: f64 = 0.1;

/// Bars of a photo.
pub(super) struct Bars {
    /// Index of the photo.
    pub(super) photo: usize,
    /// Depths on each side, working pixels of the whole file.
    pub(super) depth: PlainBorder,
}

impl Bars {
    /// Longer side of the picture between the bars, working pixels.
    pub(super) fn picture_long_side(&self, photo: &Photo) -> f64 {
        let PlainBorder { left, top, right, bottom } = self.depth;
        (photo.image.width - left - right).max(photo.image.height - top - bottom) as f64
    }

    /// Share of the bars in the area of the photo's image.
    fn share(&self, image: &RgbImage) -> f64 {
        let (w, h) = (image.width, image.height);
        let picture = (w - self.depth.left - self.depth.right) * (h - self.depth.top - self.depth.bottom);
        1.0 - picture as f64 / (w * h) as f64
    }
}

/// Bars of every photo that has some: those that stand still in all photos of one size, else those
/// of plain colour.
pub(super) fn find(photos: &[Photo]) -> Vec<Bars> {
    let size = |p: &Photo| (p.image.width, p.image.height);
    let mut of_size: HashMap<(usize, usize), PlainBorder> = HashMap::new();
    let mut found = Vec::new();
    for (photo, own) in photos.iter().enumerate() {
        let common = *of_size.entry(size(own)).or_insert_with(|| {
            let alike: Vec<&Photo> = photos.iter().filter(|p| size(p) == size(own)).collect();
            common(&alike)
        });
        let depth = if common.is_none() { plain(own) } else { common };
        if !depth.is_none() {
            found.push(Bars { photo, depth });
        }
    }
    found
}

/// Bars that all photos, of one size, have in common; none for a single photo. Pixels that a mask
/// or transparency excludes do not count as bars.
fn common(photos: &[&Photo]) -> PlainBorder {
    let [first, _, ..] = photos else { return PlainBorder::default() };
    let (w, h) = (first.image.width, first.image.height);
    let images: Vec<&RgbImage> = photos.iter().map(|p| &p.image).collect();
    let is_constant = |i: usize| {
        let alike = (0..3).all(|c| {
            let values = images.iter().map(|image| image.data[i][c]);
            let (low, high) =
                values.fold((f32::INFINITY, f32::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)));
            high - low <= SAME
        });
        alike && photos.iter().all(|p| p.uses(i))
    };
    let still: Vec<bool> = (0..w * h).into_par_iter().map(is_constant).collect();
    let found = around((w, h), &|x, y| still[y * w + x]);
    let confirmed = |depth: usize, across: usize, at: &(dyn Fn(usize, usize) -> usize + Sync)| {
        let all = images.par_iter().all(|image| ends_at(depth, across, &|d, i| image.data[at(d, i)]));
        if all { depth } else { 0 }
    };
    let bars = PlainBorder {
        left: confirmed(found.left, h, &|d, i| i * w + d),
        top: confirmed(found.top, w, &|d, i| d * w + i),
        right: confirmed(found.right, h, &|d, i| i * w + w - 1 - d),
        bottom: confirmed(found.bottom, w, &|d, i| (h - 1 - d) * w + i),
    };
    or_none_if_small(bars, (w, h))
}

/// Whether the line after a bar differs from the lines of the bar in this photo, too: a sky equals
/// in all photos only down to the shallowest one, and is no bar.
fn ends_at(depth: usize, across: usize, at: &dyn Fn(usize, usize) -> [f32; 3]) -> bool {
    let alike =
        |i: &usize| at(3 * depth / 4, *i).iter().zip(at(depth, *i)).all(|(a, b)| (a - b).abs() <= SAME);
    ((0..across).filter(alike).count() as f64) < BAR * across as f64
}

/// Bars of one colour on two opposite sides of one photo. One side alone may be an overexposed sky.
fn plain(photo: &Photo) -> PlainBorder {
    let image = &photo.image;
    let (w, h) = (image.width, image.height);
    let bars = |x: usize, y: usize| {
        let colour = image.at(x, y);
        let alike =
            |x: usize, y: usize| image.at(x, y).iter().zip(colour).all(|(a, b)| (a - b).abs() <= 0.5 * SAME);
        let of_bar = |x: usize, y: usize| alike(x, y) && photo.uses(y * w + x);
        around((w, h), &of_bar)
    };
    // The corner has the colour of its bars.
    let PlainBorder { left, top, right, bottom } = bars(0, 0);
    let both = |a: usize, b: usize| if a > 0 && b > 0 { (a, b) } else { (0, 0) };
    let ((left, right), (top, bottom)) = (both(left, right), both(top, bottom));
    or_none_if_small(PlainBorder { left, top, right, bottom }, (w, h))
}

/// The bars, or none where too little picture would remain.
fn or_none_if_small(bars: PlainBorder, (w, h): (usize, usize)) -> PlainBorder {
    let (wide, high) = (w.saturating_sub(bars.left + bars.right), h.saturating_sub(bars.top + bars.bottom));
    let share = (wide * high) as f64 / (w * h) as f64;
    if wide.min(high) < SMALLEST_SIDE || share < LEAST_PICTURE { PlainBorder::default() } else { bars }
}

/// Number of bar lines on each side of a frame; `of_bar` classifies a pixel.
fn around((w, h): (usize, usize), of_bar: &dyn Fn(usize, usize) -> bool) -> PlainBorder {
    let mut bars = PlainBorder::default();
    // The second pass leaves out the ends of the lines, which belong to the bars of the other
    // sides.
    for _ in 0..2 {
        let (columns, rows) = (bars.left..w - bars.right, bars.top..h - bars.bottom);
        let row = |y: usize| share_of_true(columns.clone().map(|x| of_bar(x, y)));
        let column = |x: usize| share_of_true(rows.clone().map(|y| of_bar(x, y)));
        let shorter = w.min(h) as f64;
        let found = PlainBorder {
            left: depth(w, shorter, &column),
            top: depth(h, shorter, &row),
            right: depth(w, shorter, &|d| column(w - 1 - d)),
            bottom: depth(h, shorter, &|d| row(h - 1 - d)),
        };
        let inside = |a: usize, b: usize, n: usize| if a + b < n { (a, b) } else { (0, 0) };
        let (left, right) = inside(found.left, found.right, w);
        let (top, bottom) = inside(found.top, found.bottom, h);
        bars = PlainBorder { left, top, right, bottom };
    }
    bars
}

fn share_of_true(line: impl Iterator<Item = bool>) -> f64 {
    let (n, set) = line.fold((0usize, 0usize), |(n, set), b| (n + 1, set + usize::from(b)));
    set as f64 / n.max(1) as f64
}

/// Lines of a bar from one side, by the share of bar pixels in each; 0 where it does not end at a
/// straight edge.
fn depth(lines: usize, shorter: f64, share: &dyn Fn(usize) -> f64) -> usize {
    let Some(end) = (0..lines).find(|d| share(*d) < BAR) else { return 0 };
    let edge = (EDGE * shorter).ceil() as usize;
    match (end..lines.min(end + edge + 1)).find(|d| share(*d) < PICTURE) {
        // The first line of the picture contains a part of the bar.
        Some(first) if end as f64 >= THINNEST * shorter => first + 1,
        _ => 0,
    }
}

/// Warning about bars that were cut off.
pub(super) fn message(photos: &[Photo], bars: &[Bars]) -> Option<String> {
    let most = bars.iter().map(|b| b.share(&photos[b.photo].image)).max_by(f64::total_cmp)?;
    let sides = |of: fn(&PlainBorder) -> usize, name: &'static str| {
        bars.iter().any(|b| of(&b.depth) > 0).then_some(name)
    };
    let sides = [
        sides(|b| b.left, "left"),
        sides(|b| b.top, "top"),
        sides(|b| b.right, "right"),
        sides(|b| b.bottom, "bottom"),
    ];
    let sides: Vec<&str> = sides.into_iter().flatten().collect();
    let names: Vec<&str> = bars.iter().map(|b| photos[b.photo].stem.as_str()).collect();
    let which = if names.len() == photos.len() { "every photo".to_owned() } else { names.join(", ") };
    Some(format!(
        "bars beside the picture ({}; {:.0} % of the frame) stand still in {which} and are cut off; photos without frame, caption \
         and banner serve better",
        sides.join(", "),
        100.0 * most
    ))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{Camera, Coverage, Image, Pose};

    const SIZE: (usize, usize) = (160, 120);

    /// A photo of a busy scene, different for each seed.
    fn photo(seed: usize, over: impl Fn(usize, usize) -> Option<[f32; 3]>) -> Photo {
        let scene = |x: usize, y: usize| {
            let wave = |k: usize| {
                ((x + 37 * seed) as f32 / (3 + k) as f32).sin() * ((y + 11 * seed) as f32 / 5.0).cos()
            };
            [0, 1, 2].map(|k| 0.5 + 0.35 * wave(k))
        };
        let (w, h) = SIZE;
        let pixel = |i: usize| over(i % w, i / w).unwrap_or_else(|| scene(i % w, i / w));
        let image = RgbImage { width: w, height: h, data: (0..w * h).map(pixel).collect() };
        super::super::from_pixels(format!("{seed}.png").as_ref(), &image, None, 160).unwrap()
    }

    fn depths(photos: &[Photo]) -> Vec<PlainBorder> {
        find(photos).into_iter().map(|b| b.depth).collect()
    }

    #[test]
    fn bars_in_every_photo_are_found() {
        // A caption of two colours with letters in it at the top, a plain bar on the left.
        let caption = |x: usize, y: usize| match (x, y) {
            (_, 0..16) => Some([0.2 + 0.6 * ((x / 3 + y / 4) % 2) as f32; 3]),
            (0..20, _) => Some([0.1, 0.4, 0.2]),
            _ => None,
        };
        let photos = [1, 2, 3].map(|seed| photo(seed, caption));
        let bars = PlainBorder { left: 21, top: 17, right: 0, bottom: 0 };
        assert_eq!(depths(&photos), [bars; 3]);
        let text = message(&photos, &find(&photos)).unwrap();
        assert!(
            text.starts_with(
                "bars beside the picture (left, top; 25 % of the frame) stand still in every photo"
            ),
            "{text}"
        );
        assert!(find(&[1, 2, 3].map(|seed| photo(seed, |_, _| None))).is_empty());
    }

    #[test]
    fn letterbox_of_one_photo_is_found() {
        let boxed = |_, y: usize| (!(26..94).contains(&y)).then_some([0.0; 3]);
        let photos = [photo(1, boxed), photo(2, |_, _| None)];
        let found = find(&photos);
        assert_eq!(found.len(), 1);
        assert_eq!(found[0].depth, PlainBorder { top: 27, bottom: 27, ..PlainBorder::default() });
    }

    #[test]
    fn masked_bars_are_ignored() {
        let boxed = |_, y: usize| (!(26..94).contains(&y)).then_some([0.0; 3]);
        let mut photos = [1, 2].map(|seed| photo(seed, boxed));
        assert_eq!(find(&photos).len(), 2);
        let (width, height) = SIZE;
        let bars = (0..width * height).map(|i| !(26..94).contains(&(i / width))).collect();
        let hidden = Image { width, height, data: bars };
        photos.iter_mut().for_each(|p| p.coverage = Some(Coverage::without(None, &hidden)));
        assert!(find(&photos).is_empty());
    }

    #[test]
    fn skies_and_walls_are_no_bars() {
        // An overexposed sky above roofs; a wall behind objects of several heights; the same
        // picture twice.
        let sky = |seed: usize| photo(seed, move |x, y| (y < 40 + 10 * (x / 40) + seed).then_some([1.0; 3]));
        let wall = |seed| photo(seed, |x, y| (y < 30 + (x * 7 % 53)).then_some([0.6, 0.6, 0.5]));
        let one_side = |seed| photo(seed, move |_, y| (y < 20 + 9 * seed).then_some([1.0; 3]));
        for of in [&sky as &dyn Fn(usize) -> Photo, &wall, &one_side] {
            assert!(find(&[1, 2, 3].map(of)).is_empty());
        }
        assert!(find(&[photo(1, |_, _| None), photo(1, |_, _| None)]).is_empty());
    }

    #[test]
    fn cut_photo_keeps_original_camera() {
        let mut cut = photo(1, |_, _| None);
        let bars = PlainBorder { left: 20, top: 10, right: 0, bottom: 30 };
        let hidden =
            Image { width: 160, height: 120, data: (0..160 * 120).map(|i| i == 160 * 12 + 25).collect() };
        cut.coverage = Some(Coverage::without(None, &hidden));
        cut.cut(bars);
        assert!(
            !cut.uses(2 * 140 + 5) && cut.coverage.as_ref().is_some_and(|c| c.share.data.len() == 140 * 80)
        );
        assert!(cut.is_cut() && (cut.image.width, cut.image.height) == (140, 80));
        assert_eq!(cut.image.at(0, 0), photo(1, |_, _| None).image.at(20, 10));
        assert_eq!(cut.picture_size(), [140.0, 80.0]);
        // The middle is 10 px to the right and 10 px up.
        assert!((cut.off_middle() - 200f64.sqrt()).abs() < 1e-9);
        let camera = Camera {
            name: String::new(),
            width: 140,
            height: 80,
            fx: 150.0,
            fy: 150.0,
            cx: 70.0,
            cy: 40.0,
            pose: Pose::IDENTITY,
        };
        let whole = cut.original_camera(&camera);
        assert_eq!((whole.width, whole.height, whole.cx, whole.cy), (160, 120, 90.0, 50.0));
        cut.unmirror();
        assert_eq!(cut.image.at(0, 0), photo(1, |_, _| None).image.at(159, 10));
        // The bar on the left is on the right of the mirrored file.
        assert_eq!(cut.original_camera(&camera).cx, 70.0);
        assert!(!photo(1, |_, _| None).is_cut() && photo(1, |_, _| None).off_middle() == 0.0);
    }
}
