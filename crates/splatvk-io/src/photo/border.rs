//! Plain borders around photos: scans, rectified and letterboxed pictures. They do not move with
//! the scene, so they are neither matched nor trained on: the nearest pixels of the picture replace
//! them.
use crate::scene::RgbImage;
use serde::{Deserialize, Serialize};

/// Number of border lines on each side, pixels.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct PlainBorder {
    /// Columns on the left.
    pub left: usize,
    /// Rows at the top.
    pub top: usize,
    /// Columns on the right.
    pub right: usize,
    /// Rows at the bottom.
    pub bottom: usize,
}

/// Deepest border, share of the shorter side: deeper plain white or black is scene (sky, a studio
/// background).
const DEEPEST_SHARE: f64 = 0.08;
/// Share of plain pixels in an outermost line of a border …
const PLAIN: f64 = 0.9;
/// … and share below which a line belongs to the picture (bright windows may touch the border,
/// uneven edges leave steps in it).
const PICTURE: f64 = 0.3;
/// Lines of the picture into which resampling and JPEG mix the border.
const MIXED: usize = 1;

impl PlainBorder {
    /// The white or black border of a picture. Opposite sides have one or neither: a bright sky has
    /// no counterpart below.
    pub fn of(image: &RgbImage) -> PlainBorder {
        // Compression leaves a few grey levels of ringing on saturated pixels.
        let white = |c: [f32; 3]| c.iter().all(|v| *v > 0.95);
        let black = |c: [f32; 3]| c.iter().all(|v| *v < 0.02);
        let (a, b) = (PlainBorder::plain(image, white), PlainBorder::plain(image, black));
        if a == PlainBorder::default() { b } else { a }
    }

    fn plain(image: &RgbImage, plain: impl Fn([f32; 3]) -> bool) -> PlainBorder {
        let (w, h) = (image.width, image.height);
        let deepest = ((w.min(h) as f64 * DEEPEST_SHARE) as usize).min(w.min(h) / 4);
        // The ends of a line belong to the other sides of the border.
        let share = |across: usize, at: &dyn Fn(usize) -> [f32; 3]| {
            let inner = deepest..across - deepest;
            inner.clone().filter(|&i| plain(at(i))).count() as f64 / inner.len().max(1) as f64
        };
        let depth = |across: usize, at: &dyn Fn(usize, usize) -> [f32; 3]| {
            if share(across, &|i| at(0, i)) < PLAIN {
                return 0;
            }
            let first = (1..=deepest).find(|&d| share(across, &|i| at(d, i)) < PICTURE);
            first.map_or(0, |d| d + MIXED)
        };
        let border = PlainBorder {
            left: depth(h, &|d, i| image.at(d, i)),
            right: depth(h, &|d, i| image.at(w - 1 - d, i)),
            top: depth(w, &|d, i| image.at(i, d)),
            bottom: depth(w, &|d, i| image.at(i, h - 1 - d)),
        };
        let both_or_none = |a: usize, b: usize| if a > 0 && b > 0 { (a, b) } else { (0, 0) };
        let ((left, right), (top, bottom)) =
            (both_or_none(border.left, border.right), both_or_none(border.top, border.bottom));
        PlainBorder { left, top, right, bottom }
    }

    /// Whether there is no border.
    pub fn is_none(&self) -> bool {
        *self == PlainBorder::default()
    }

    /// Whether a pixel of a picture of this size is on the border.
    pub fn covers(&self, x: usize, y: usize, width: usize, height: usize) -> bool {
        x < self.left || y < self.top || x + self.right >= width || y + self.bottom >= height
    }

    /// Replaces the border by the nearest pixels of the picture.
    pub fn continue_picture(&self, image: &mut RgbImage) {
        if self.is_none() {
            return;
        }
        let (w, h) = (image.width, image.height);
        for y in 0..h {
            for x in 0..w {
                if self.covers(x, y, w, h) {
                    let nearest = image
                        .at(x.clamp(self.left, w - 1 - self.right), y.clamp(self.top, h - 1 - self.bottom));
                    image.data[y * w + x] = nearest;
                }
            }
        }
    }

    /// The picture without its border.
    pub fn crop(&self, image: &RgbImage) -> RgbImage {
        let rows = self.top..image.height - self.bottom;
        let row = |y: usize| &image.data[y * image.width + self.left..(y + 1) * image.width - self.right];
        let data: Vec<[f32; 3]> = rows.clone().flat_map(|y| row(y).iter().copied()).collect();
        RgbImage { width: image.width - self.left - self.right, height: rows.len(), data }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn picture(f: impl Fn(usize, usize) -> [f32; 3]) -> RgbImage {
        let data = (0..120 * 100).map(|k| f(k % 120, k / 120)).collect();
        RgbImage { width: 120, height: 100, data }
    }

    fn scene(x: usize, y: usize) -> [f32; 3] {
        [x as f32 / 240.0 + 0.2, y as f32 / 200.0 + 0.2, 0.5]
    }

    #[test]
    fn uneven_white_border_is_filled() {
        let border = |x: usize, y: usize| x < 4 + y / 60 || y < 3 || x >= 115 || y >= 98;
        let mut image = picture(|x, y| if border(x, y) { [1.0; 3] } else { scene(x, y) });
        let found = PlainBorder::of(&image);
        assert_eq!(found, PlainBorder { left: 6, top: 4, right: 6, bottom: 3 });
        let inside = found.crop(&image);
        assert_eq!((inside.width, inside.height), (108, 93));
        assert_eq!(inside.at(0, 0), scene(6, 4));
        found.continue_picture(&mut image);
        assert_eq!(image.at(0, 50), scene(6, 50));
        assert_eq!(image.at(119, 99), scene(113, 96));
        assert_eq!(image.at(60, 60), scene(60, 60));
        assert!(image.data.iter().all(|c| c[2] == 0.5));
    }

    #[test]
    fn letterbox_is_border_bright_scene_not() {
        let bars = picture(|x, y| if !(7..93).contains(&y) { [0.0; 3] } else { scene(x, y) });
        assert_eq!(PlainBorder::of(&bars), PlainBorder { top: 8, bottom: 8, ..PlainBorder::default() });
        let sky = picture(|x, y| if y < 6 { [1.0; 3] } else { scene(x, y) });
        assert!(PlainBorder::of(&sky).is_none());
        let studio = picture(|x, y| if (40..80).contains(&x) && y > 30 { scene(x, y) } else { [1.0; 3] });
        assert!(PlainBorder::of(&studio).is_none());
        assert!(PlainBorder::of(&picture(scene)).is_none());
        assert!(PlainBorder::of(&picture(|_, _| [1.0; 3])).is_none());
    }
}
