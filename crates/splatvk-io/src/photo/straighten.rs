//! Undistortion: resampling of photos to a pinhole.
use crate::scene::{Camera, Image, Lens, RgbImage};
use glam::DVec2;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// Distortion and the pinhole of the undistorted picture: same size, focal length and principal
/// point.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Straightening {
    /// Distortion to remove.
    pub lens: Lens,
    /// Focal length along x, pixels.
    pub focal: f64,
    /// Focal length along y over that along x.
    #[serde(default = "square")]
    pub aspect: f64,
    /// Principal point, pixels.
    pub centre: DVec2,
}

/// Default for scenes of earlier versions.
fn square() -> f64 {
    1.0
}

impl Straightening {
    /// Undistortion of a picture to the pinhole `camera`.
    pub fn new(lens: Lens, camera: &Camera) -> Straightening {
        let centre = DVec2::new(camera.cx, camera.cy);
        Straightening { lens, focal: camera.fx, aspect: camera.fy / camera.fx, centre }
    }

    /// Distorted position of position `p` in the undistorted picture, pixels.
    pub fn source(&self, p: DVec2) -> DVec2 {
        let focal = DVec2::new(self.focal, self.focal * self.aspect);
        self.lens.distort((p - self.centre) / focal) * focal + self.centre
    }

    /// Undistortion of the picture at another size.
    fn resized(&self, scale: f64) -> Straightening {
        Straightening { focal: self.focal * scale, centre: self.centre * scale, ..*self }
    }

    /// The undistorted picture, by cubic interpolation (Catmull–Rom); positions outside the photo
    /// take the nearest pixels.
    pub fn image(&self, image: &RgbImage) -> RgbImage {
        let size = (image.width, image.height);
        let data = resampled(size, |x, y| image.at(x, y), |p| self.source(p));
        RgbImage { width: size.0, height: size.1, data }
    }

    /// Like [`Straightening::image`], for one channel.
    pub fn plane(&self, plane: &Image<f32>) -> Image<f32> {
        let size = (plane.width, plane.height);
        let data = resampled(size, |x, y| [plane.at(x, y)], |p| self.source(p));
        Image { width: size.0, height: size.1, data: data.into_iter().map(|[v]| v).collect() }
    }

    /// Like [`Straightening::plane`], for a larger version of the picture, whose own width is
    /// `width`.
    pub(super) fn larger(&self, plane: &Image<f32>, width: usize) -> Image<f32> {
        self.resized(plane.width as f64 / width as f64).plane(plane)
    }
}

/// An image whose pixel at `p` is sampled at `source(p)`.
fn resampled<const N: usize>(
    (w, h): (usize, usize),
    at: impl Fn(usize, usize) -> [f32; N] + Sync,
    source: impl Fn(DVec2) -> DVec2 + Sync,
) -> Vec<[f32; N]> {
    let mut data = vec![[0f32; N]; w * h];
    data.par_chunks_mut(w.max(1)).enumerate().for_each(|(y, line)| {
        for (x, out) in line.iter_mut().enumerate() {
            *out = cubic((w, h), &at, source(DVec2::new(x as f64 + 0.5, y as f64 + 0.5)));
        }
    });
    data
}

/// Catmull–Rom weights of four neighbours at a fraction between the middle two.
fn weights(t: f32) -> [f32; 4] {
    let (t2, t3) = (t * t, t * t * t);
    [
        0.5 * (-t3 + 2.0 * t2 - t),
        0.5 * (3.0 * t3 - 5.0 * t2 + 2.0),
        0.5 * (-3.0 * t3 + 4.0 * t2 + t),
        0.5 * (t3 - t2),
    ]
}

/// Value at a continuous position, clamped to the range of the four nearest pixels, so that edges
/// do not ring.
fn cubic<const N: usize>(
    (w, h): (usize, usize),
    at: &impl Fn(usize, usize) -> [f32; N],
    p: DVec2,
) -> [f32; N] {
    let (w, h) = (w as i64, h as i64);
    let (u, v) = ((p.x - 0.5).clamp(0.0, (w - 1) as f64), (p.y - 0.5).clamp(0.0, (h - 1) as f64));
    let (i, j) = (u as i64, v as i64);
    let (wx, wy) = (weights((u - i as f64) as f32), weights((v - j as f64) as f32));
    let (mut sum, mut low, mut high) = ([0f32; N], [f32::INFINITY; N], [f32::NEG_INFINITY; N]);
    for (dy, b) in wy.iter().enumerate() {
        let y = (j + dy as i64 - 1).clamp(0, h - 1) as usize;
        for (dx, a) in wx.iter().enumerate() {
            let c = at((i + dx as i64 - 1).clamp(0, w - 1) as usize, y);
            for k in 0..N {
                sum[k] += a * b * c[k];
                if (1..3).contains(&dx) && (1..3).contains(&dy) {
                    low[k] = low[k].min(c[k]);
                    high[k] = high[k].max(c[k]);
                }
            }
        }
    }
    std::array::from_fn(|k| sum[k].clamp(low[k], high[k]))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn straightening_restores_distorted_pattern() {
        let (w, h, focal, lens) = (160, 120, 140.0, Lens::radial(-0.12, 0.03));
        let centre = DVec2::new(81.0, 58.5);
        // A smooth pattern of ideal positions, and its distorted photo.
        let pattern = |x: DVec2| {
            let (u, v) = (x.x * focal, x.y * focal);
            [(0.15 * u).sin() as f32, (0.12 * v).sin() as f32, (0.08 * (u + v)).cos() as f32]
                .map(|c| 0.5 + 0.4 * c)
        };
        let position = |k: usize| (DVec2::new((k % w) as f64 + 0.5, (k / w) as f64 + 0.5) - centre) / focal;
        let data = (0..w * h).map(|k| pattern(lens.undistort(position(k)))).collect();
        let photo = RgbImage { width: w, height: h, data };
        let out = Straightening { lens, focal, aspect: 1.0, centre }.image(&photo);
        let mut worst = 0f32;
        for y in 2..h - 2 {
            for x in 2..w - 2 {
                let (got, want) = (out.at(x, y), pattern(position(y * w + x)));
                worst = (0..3).map(|k| (got[k] - want[k]).abs()).fold(worst, f32::max);
            }
        }
        // The clamp to the neighbours' range costs up to a quarter of the curvature at crests:
        // 0.15²/8 · 0.4.
        assert!(worst < 2e-3, "{worst}");
    }
}
