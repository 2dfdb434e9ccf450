//! Bars beside the picture that photos have in common: letterboxes, frames of instant photos, the
//! surface of a phone around a photo, captions and banners. They stand still in the frame, so they
//! are cut off; what is left is the photo.
//!
//! Thin plain borders of a single photo, as of scans, are those of [`super::border`].
use super::border::PlainBorder;
use super::read::{Photo, SMALLEST_SIDE};
use crate::scene::RgbImage;
use rayon::prelude::*;
use std::collections::HashMap;

/// Largest difference of a colour among the photos within a bar, and within a plain bar of one
/// photo: of compression.
const SAME: f32 = 0.05;
/// Share of the pixels of a line of a bar that are so.
const BAR: f64 = 0.95;
/// Share below which a line belongs to the picture: its first lines are full of the scene, where a
/// wall or sky that looks the same in all photos ends at things of the scene, one after the other.
const PICTURE: f64 = 0.3;
/// Lines, share of the shorter side, in which the bar ends: compression smears its edge over a
/// block.
const EDGE: f64 = 0.02;
/// A bar that is thinner, share of the shorter side, is an uneven border at most.
const THINNEST: f64 = 0.015;
/// Least share of the file that the picture fills: a landscape photo on a tall phone has a quarter.
const LEAST_PICTURE: f64 = 0.1;

/// Bars of a photo that were cut off.
pub(super) struct Bars {
    /// Index of the photo.
    pub(super) photo: usize,
    /// Working pixels of the whole file.
    pub(super) depth: PlainBorder,
}

impl Bars {
    /// Longer side of the picture between them, working pixels.
    pub(super) fn picture_long_side(&self, photo: &Photo) -> f64 {
        let PlainBorder { left, top, right, bottom } = self.depth;
        (photo.image.width - left - right).max(photo.image.height - top - bottom) as f64
    }
}

/// The bars of every photo that has some: those that stand still in all photos of one size, else
/// those of plain colour.
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

/// Bars that all photos, of one size, have in common; none of a single one. Pixels that a mask or
/// transparency leaves out are none of theirs: they have been dealt with.
fn common(photos: &[&Photo]) -> PlainBorder {
    let [first, _, ..] = photos else { return PlainBorder::default() };
    let (w, h) = (first.image.width, first.image.height);
    let images: Vec<&RgbImage> = photos.iter().map(|p| &p.image).collect();
    let same = |i: usize| {
        let alike = (0..3).all(|c| {
            let values = images.iter().map(|image| image.data[i][c]);
            let (low, high) =
                values.fold((f32::INFINITY, f32::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)));
            high - low <= SAME
        });
        alike && photos.iter().all(|p| p.uses(i))
    };
    let still: Vec<bool> = (0..w * h).into_par_iter().map(same).collect();
    let found = around((w, h), &|x, y| still[y * w + x]);
    let ends = |depth: usize, across: usize, at: &(dyn Fn(usize, usize) -> usize + Sync)| {
        let all = images.par_iter().all(|image| ends_at(depth, across, &|d, i| image.data[at(d, i)]));
        if all { depth } else { 0 }
    };
    let bars = PlainBorder {
        left: ends(found.left, h, &|d, i| i * w + d),
        top: ends(found.top, w, &|d, i| d * w + i),
        right: ends(found.right, h, &|d, i| i * w + w - 1 - d),
        bottom: ends(found.bottom, w, &|d, i| (h - 1 - d) * w + i),
    };
    enough(bars, (w, h))
}

/// Whether the line behind a bar differs from those of the bar in this photo, too: what is the same
/// in all photos only as far as the shallowest of several skies is no bar.
fn ends_at(depth: usize, across: usize, at: &dyn Fn(usize, usize) -> [f32; 3]) -> bool {
    let alike =
        |i: &usize| at(3 * depth / 4, *i).iter().zip(at(depth, *i)).all(|(a, b)| (a - b).abs() <= SAME);
    ((0..across).filter(alike).count() as f64) < BAR * across as f64
}

/// Bars of one colour on two opposite sides of one photo. One side alone may be a sky that is burnt
/// out.
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
    // The colour of a corner is that of its bars.
    let PlainBorder { left, top, right, bottom } = bars(0, 0);
    let both = |a: usize, b: usize| if a > 0 && b > 0 { (a, b) } else { (0, 0) };
    let ((left, right), (top, bottom)) = (both(left, right), both(top, bottom));
    enough(PlainBorder { left, top, right, bottom }, (w, h))
}

/// Nothing where too little picture would be left.
fn enough(bars: PlainBorder, (w, h): (usize, usize)) -> PlainBorder {
    let (wide, high) = (w.saturating_sub(bars.left + bars.right), h.saturating_sub(bars.top + bars.bottom));
    let share = (wide * high) as f64 / (w * h) as f64;
    if wide.min(high) < SMALLEST_SIDE || share < LEAST_PICTURE { PlainBorder::default() } else { bars }
}

/// Lines on each side of a frame that are of a bar; `of_bar` says so of a pixel.
fn around((w, h): (usize, usize), of_bar: &dyn Fn(usize, usize) -> bool) -> PlainBorder {
    let mut bars = PlainBorder::default();
    // A second time without the ends of the lines, which belong to the bars of the other sides.
    for _ in 0..2 {
        let (columns, rows) = (bars.left..w - bars.right, bars.top..h - bars.bottom);
        let share = |line: &mut dyn Iterator<Item = bool>| {
            let (n, set) = line.fold((0usize, 0usize), |(n, set), b| (n + 1, set + usize::from(b)));
            set as f64 / n.max(1) as f64
        };
        let row = |y: usize| share(&mut columns.clone().map(|x| of_bar(x, y)));
        let column = |x: usize| share(&mut rows.clone().map(|y| of_bar(x, y)));
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

/// Lines of a bar from one side, by the share of each that is of it; 0 where it does not end at a
/// straight edge.
fn depth(lines: usize, shorter: f64, share: &dyn Fn(usize) -> f64) -> usize {
    let Some(end) = (0..lines).find(|d| share(*d) < BAR) else { return 0 };
    let edge = (EDGE * shorter).ceil() as usize;
    match (end..lines.min(end + edge + 1)).find(|d| share(*d) < PICTURE) {
        // The first line of the picture has a part of the bar in it.
        Some(first) if end as f64 >= THINNEST * shorter => first + 1,
        _ => 0,
    }
}

/// Warning about bars that were cut off.
pub(super) fn message(photos: &[Photo], bars: &[Bars]) -> Option<String> {
    let share = |b: &Bars| {
        let image = &photos[b.photo].image;
        let (w, h) = (image.width, image.height);
        let picture = (w - b.depth.left - b.depth.right) * (h - b.depth.top - b.depth.bottom);
        1.0 - picture as f64 / (w * h) as f64
    };
    let most = bars.iter().map(share).max_by(f64::total_cmp)?;
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

    /// A photo of a busy scene, another one for each seed.
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
    fn a_letterbox_of_one_photo_is_found() {
        let boxed = |_, y: usize| (!(26..94).contains(&y)).then_some([0.0; 3]);
        let photos = [photo(1, boxed), photo(2, |_, _| None)];
        let found = find(&photos);
        assert_eq!(found.len(), 1);
        assert_eq!(found[0].depth, PlainBorder { top: 27, bottom: 27, ..PlainBorder::default() });
    }

    #[test]
    fn masked_bars_are_left_to_the_mask() {
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
    fn skies_and_plain_walls_are_no_bars() {
        // Burnt out above roofs; a wall that objects of several heights stand before; the same
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
    fn a_cut_photo_keeps_its_place_in_the_file() {
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
        // The bar on the left is one on the right of the mirrored file.
        assert_eq!(cut.original_camera(&camera).cx, 70.0);
        assert!(!photo(1, |_, _| None).is_cut() && photo(1, |_, _| None).off_middle() == 0.0);
    }
}
