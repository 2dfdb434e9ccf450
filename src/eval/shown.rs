//! Scores of a view over the surfaces that photos show: opacity, and colours that no photo has.
use super::Rendered;
use crate::scene::{Camera, Image, RgbImage};
use glam::{DVec2, DVec3};
use rayon::prelude::*;
use serde::Serialize;

/// Relative difference of depth below which two views show the same surface; true depth agrees
/// across views to 0.1 %, rendered depth to about 1 %.
const SAME_SURFACE: f64 = 0.01;
/// Half width of the window around a point's place in a photo, share of the photo's width.
const WINDOW: f64 = 0.015;
/// Difference from the range of a window beyond which a colour is foreign to it. Shading and the
/// interpolation of pixels stay below a tenth.
const FOREIGN: f32 = 0.1;
/// Minimum opacity of a pixel that has a colour.
const COLOURED: f32 = 0.1;

/// Opacity and colours of a view.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct ShownScore {
    /// Share of the pixels whose surface a photo shows. The next three are over these pixels.
    pub shown: f64,
    /// Share with alpha < 0.5.
    pub alpha_below_50: f64,
    /// Share with alpha < 0.9.
    pub alpha_below_90: f64,
    /// Share with alpha < 0.99.
    pub alpha_below_99: f64,
    /// Share of all pixels with alpha < 0.9.
    pub transparent: f64,
    /// Share of all pixels with a colour that no photo has near their point.
    pub confetti: f64,
}

/// A photo, or the scene from its camera, in the frame of the views that are scored.
#[derive(Debug)]
pub struct PhotoView {
    camera: Camera,
    /// Camera z, 0 = unknown.
    depth: Image<f32>,
    /// Least and greatest [`opponent`] values in the window around each pixel.
    range: Vec<Range>,
}

impl PhotoView {
    /// `rgb` and `depth` (camera z, 0 = unknown) have the size of the camera.
    pub fn new(camera: Camera, rgb: &RgbImage, depth: Image<f32>) -> PhotoView {
        let radius = (WINDOW * rgb.width as f64).ceil() as usize;
        let range = window_range(rgb, radius);
        PhotoView { camera, depth, range }
    }

    /// Index of the pixel that contains a point, and the camera z of the point.
    fn pixel(&self, point: DVec3) -> Option<(usize, f64)> {
        let (DVec2 { x, y }, z) = self.camera.project(point);
        let (width, height) = (self.camera.width as usize, self.camera.height as usize);
        let inside = z > 0.0 && x >= 0.0 && y >= 0.0 && x < width as f64 && y < height as f64;
        inside.then(|| (y as usize * width + x as usize, z))
    }

    /// Whether the photo shows the surface at a point.
    fn shows(&self, point: DVec3) -> bool {
        let Some((index, z)) = self.pixel(point) else { return false };
        let depth = f64::from(self.depth.data[index]);
        depth > 0.0 && (depth / z - 1.0).abs() < SAME_SURFACE
    }

    /// Whether the photo has a colour near a point; `None` where the point is outside of it.
    fn has(&self, point: DVec3, colour: [f32; 3]) -> Option<bool> {
        let (index, _) = self.pixel(point)?;
        let value = opponent(colour);
        let near = |k: usize| {
            let [least, most] = self.range[index][k];
            value[k] > least - FOREIGN && value[k] < most + FOREIGN
        };
        Some((0..3).all(near))
    }
}

/// Luma and two colour differences: a saturated colour lies outside of the range of grey ones.
fn opponent([r, g, b]: [f32; 3]) -> [f32; 3] {
    [(r + g + b) / 3.0, r - g, b - g]
}

/// Least and greatest [`opponent`] values per channel.
type Range = [[f32; 2]; 3];

/// Ranges over the square of 2 `radius` + 1 pixels around each pixel.
fn window_range(rgb: &RgbImage, radius: usize) -> Vec<Range> {
    let (width, height) = (rgb.width, rgb.height);
    let widen = |range: &mut Range, value: &Range| {
        for (a, v) in range.iter_mut().zip(value) {
            *a = [a[0].min(v[0]), a[1].max(v[1])];
        }
    };
    let single: Vec<Range> = rgb.data.iter().map(|c| opponent(*c).map(|v| [v, v])).collect();
    let around = |k: usize, count: usize| k.saturating_sub(radius)..(k + radius + 1).min(count);
    let mut rows = single.clone();
    rows.par_chunks_mut(width.max(1)).zip(single.par_chunks(width.max(1))).for_each(|(out, row)| {
        for (x, range) in out.iter_mut().enumerate() {
            row[around(x, width)].iter().for_each(|value| widen(range, value));
        }
    });
    let mut out = rows.clone();
    out.par_chunks_mut(width.max(1)).enumerate().for_each(|(y, line)| {
        for other in around(y, height) {
            line.iter_mut().zip(&rows[other * width..]).for_each(|(range, value)| widen(range, value));
        }
    });
    out
}

/// Pixels of a view whose surface one of the photos shows. `depth` is camera z in the units of the
/// photos, 0 = unknown; unknown pixels are shown by none.
pub fn shown_pixels(camera: &Camera, depth: &Image<f32>, photos: &[PhotoView]) -> Vec<bool> {
    pixels(camera, depth, |_, point| photos.iter().any(|p| p.shows(point)))
}

/// Value of `of` for every pixel with depth, from its index and its point; `false` without.
fn pixels(camera: &Camera, depth: &Image<f32>, of: impl Fn(usize, DVec3) -> bool + Sync) -> Vec<bool> {
    let centre = |i: usize| DVec2::new((i % depth.width) as f64 + 0.5, (i / depth.width) as f64 + 0.5);
    let value = |(i, z): (usize, &f32)| *z > 0.0 && of(i, camera.unproject(centre(i), f64::from(*z)));
    depth.data.par_iter().enumerate().map(value).collect()
}

/// Scores a view; its depth is in the units of the photos. `shown` are [`shown_pixels`].
pub fn shown_score(camera: &Camera, view: &Rendered, shown: &[bool], photos: &[PhotoView]) -> ShownScore {
    let alpha = &view.alpha.data;
    let total = alpha.len().max(1) as f64;
    let count = shown.iter().filter(|s| **s).count();
    let below = |limit: f32| {
        let low = alpha.iter().zip(shown).filter(|(a, s)| **s && **a < limit).count();
        low as f64 / count.max(1) as f64
    };
    let is_foreign = |i: usize, point: DVec3| {
        if alpha[i] < COLOURED {
            return false;
        }
        // Without the black behind it.
        let colour = view.rgb.data[i].map(|c| (c / alpha[i]).clamp(0.0, 1.0));
        let answers: Vec<bool> = photos.iter().filter_map(|p| p.has(point, colour)).collect();
        !answers.is_empty() && !answers.contains(&true)
    };
    let foreign = pixels(camera, &view.depth, is_foreign).into_iter().filter(|f| *f).count();
    ShownScore {
        shown: count as f64 / total,
        alpha_below_50: below(0.5),
        alpha_below_90: below(0.9),
        alpha_below_99: below(0.99),
        transparent: alpha.iter().filter(|a| **a < 0.9).count() as f64 / total,
        confetti: foreign as f64 / total,
    }
}

/// A view over white instead of black.
pub fn on_white(view: &Rendered) -> RgbImage {
    let over = |(c, a): (&[f32; 3], &f32)| c.map(|v| v + (1.0 - a));
    RgbImage { data: view.rgb.data.iter().zip(&view.alpha.data).map(over).collect(), ..view.rgb }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::Pose;

    const WIDTH: usize = 40;
    const HEIGHT: usize = 30;

    fn camera(x: f64) -> Camera {
        Camera {
            name: "a".into(),
            width: WIDTH as u32,
            height: HEIGHT as u32,
            fx: 40.0,
            fy: 40.0,
            cx: 20.0,
            cy: 15.0,
            pose: Pose { translation: DVec3::new(-x, 0.0, 0.0), ..Pose::IDENTITY },
        }
    }

    fn image(colour: impl Fn(usize, usize) -> [f32; 3]) -> RgbImage {
        let data = (0..WIDTH * HEIGHT).map(|i| colour(i % WIDTH, i / WIDTH)).collect();
        RgbImage { width: WIDTH, height: HEIGHT, data }
    }

    #[test]
    fn only_surfaces_in_photos_are_shown() {
        // A wall at depth 2; the view stands 0.5 to the right, that is 10 pixels.
        let wall = Image::filled(WIDTH, HEIGHT, 2.0f32);
        let photos = [PhotoView::new(camera(0.0), &image(|_, _| [0.5; 3]), wall.clone())];
        let shown = shown_pixels(&camera(0.5), &wall, &photos);
        for (i, shown) in shown.iter().enumerate() {
            assert_eq!(*shown, i % WIDTH < WIDTH - 10, "{i}");
        }
        // Another surface at the same pixels is not the one of the photo.
        let nearer = Image::filled(WIDTH, HEIGHT, 1.9f32);
        assert!(!shown_pixels(&camera(0.0), &nearer, &photos).contains(&true));
        let unknown = Image::filled(WIDTH, HEIGHT, 0.0f32);
        assert!(!shown_pixels(&camera(0.0), &unknown, &photos).contains(&true));
    }

    #[test]
    fn opacity_and_foreign_colours_are_counted() {
        let wall = Image::filled(WIDTH, HEIGHT, 2.0f32);
        // Black and white stripes: every grey is within their range, a saturated red is not.
        let stripes = image(|x, _| [(x % 2) as f32; 3]);
        let photos = [PhotoView::new(camera(0.0), &stripes, wall.clone())];
        let mut alpha = Image::filled(WIDTH, HEIGHT, 1.0f32);
        for x in 0..WIDTH {
            (alpha.data[x], alpha.data[WIDTH + x]) = (0.95, 0.3);
        }
        let rgb = image(|x, y| match (x, y) {
            (_, 1) => [0.15; 3],
            (0..10, 5) => [0.9, 0.1, 0.1],
            _ => [0.5; 3],
        });
        let view = Rendered { rgb, filled: None, alpha, depth: wall.clone() };
        let shown = shown_pixels(&camera(0.0), &wall, &photos);
        let score = shown_score(&camera(0.0), &view, &shown, &photos);
        let row = 1.0 / HEIGHT as f64;
        let near = |a: f64, b: f64| (a - b).abs() < 1e-9;
        assert!(near(score.shown, 1.0) && near(score.alpha_below_50, row), "{score:?}");
        assert!(near(score.alpha_below_90, row) && near(score.alpha_below_99, 2.0 * row), "{score:?}");
        assert!(near(score.transparent, row) && near(score.confetti, row / 4.0), "{score:?}");
        let white = on_white(&view);
        assert!((white.at(0, 1)[0] - 0.85).abs() < 1e-6 && white.at(20, 5) == [0.5; 3]);
    }
}
