//! Masks of used pixels, in the convention of COLMAP and nerfstudio: black is not used.
use super::decode::{self, Decoded, is_sideways, stored_position};
use super::kind::{FileKind, kind};
use crate::{Error, Result, files};
use image::ImageFormat;
use image::metadata::Orientation;
use rayon::prelude::*;
use std::path::{Path, PathBuf};

/// A decoded mask.
pub(super) struct Mask {
    path: PathBuf,
    /// Pixels.
    size: (usize, usize),
    /// [H, W].
    used: Vec<bool>,
    /// Whether it has several values beside black: instance labels rather than a mask.
    pub is_labels: bool,
}

/// Threshold of JPEG masks, whose black is not exact.
const JPEG_BLACK: f32 = 0.5;

/// Largest relative difference of equal aspects: sizes are whole numbers.
const SAME_ASPECT: f64 = 0.01;

impl Mask {
    /// Reads a mask file.
    pub fn read(path: &Path) -> Result<Mask> {
        let bytes = files::read(path).map_err(|e| Error::input(e.to_string()))?;
        let least = match kind(&bytes, path) {
            FileKind::Image(ImageFormat::Jpeg) => JPEG_BLACK,
            _ => 0.0,
        };
        let decoded = decode::decode(bytes, path, None)?;
        let (w, h) = decoded.size;
        let value = |i: usize| {
            let (colour, alpha) = decoded.at(i % w, i / w);
            colour.iter().fold(0f32, |a, b| a.max(*b)) * alpha
        };
        let values: Vec<f32> = (0..w * h).into_par_iter().map(value).collect();
        let mut levels: Vec<f32> = values.iter().copied().filter(|v| *v > 0.0).collect();
        levels.sort_by(f32::total_cmp);
        levels.dedup();
        // Soft edges of one thing have many levels, but few pixels at them.
        let most = levels.last().copied().unwrap_or(0.0);
        let between = values.iter().filter(|v| **v > 0.1 * most && **v < 0.9 * most).count();
        let is_labels = levels.len() > 1 && 20 * between > w * h;
        let used = values.iter().map(|v| *v > least).collect();
        Ok(Mask { path: path.to_path_buf(), size: (w, h), used, is_labels })
    }

    /// Whether upright pixels of a photo are used. The mask may have another size of the same
    /// aspect, and the orientation of the photo or of its file.
    pub fn on(
        &self,
        photo: &Path,
        decoded: &Decoded,
    ) -> Result<impl Fn(usize, usize) -> bool + Sync + use<'_>> {
        let (size, orientation) = (decoded.size, decoded.orientation);
        let aspect = |(w, h): (usize, usize)| w as f64 / h as f64;
        let alike = |other: (usize, usize)| (aspect(self.size) / aspect(other) - 1.0).abs() <= SAME_ASPECT;
        let orientation = match orientation {
            _ if alike(size) => Orientation::NoTransforms,
            sideways if is_sideways(sideways) && alike((size.1, size.0)) => sideways,
            _ => {
                return Err(Error::input(format!(
                    "{}: its mask {} is {} × {}, the photo {} × {}: the aspects differ; make the mask of the photo's size",
                    photo.display(),
                    self.path.display(),
                    self.size.0,
                    self.size.1,
                    size.0,
                    size.1
                )));
            }
        };
        let stored = if is_sideways(orientation) { (size.1, size.0) } else { size };
        Ok(move |x, y| {
            let (x, y) = stored_position(orientation, stored, (x, y));
            let scaled = |v: usize, from: usize, to: usize| (2 * v + 1) * to / (2 * from);
            self.used[scaled(y, stored.1, self.size.1) * self.size.0 + scaled(x, stored.0, self.size.0)]
        })
    }
}
