//! Reader of one photo.
use super::border::PlainBorder;
use super::decode::{self, Decoded};
use super::kind::stem;
use super::light::Light;
use super::mask::Mask;
use super::overlay::Overlay;
use super::straighten::Straightening;
use super::turn::Turn;
use crate::scene::resize;
use crate::scene::{Affine, Camera, Coverage, Image, Lens, Outside, RgbImage};
use crate::{Error, Result, files};
use glam::{DVec2, DVec3};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Longest side of a working image on a GPU, pixels: the limit of the reference implementation of
/// Gaussian splatting (Kerbl et al. 2023 scale wider photos down to it). A portrait keeps as many
/// pixels as the same photo in landscape.
pub const MAX_SIZE: usize = 1600;

/// Longest side of a working image on a CPU device, pixels: photos of 4:3 then have 1.56 times the
/// pixels of 640 × 480, which keeps a run within twice its time (docs/internals/performance.md).
pub const MAX_SIZE_CPU: usize = 800;

/// Default for the longest side on a device.
pub fn default_max_size(is_cpu: bool) -> usize {
    if is_cpu { MAX_SIZE_CPU } else { MAX_SIZE }
}

/// Smallest side of a usable photo, pixels: feature networks work at 1/8 resolution, and below 8 ×
/// 8 cells nothing can be matched.
pub const SMALLEST_SIDE: usize = 64;

/// One decoded photo at working resolution, upright.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Photo {
    /// Path of the file.
    pub path: PathBuf,
    /// [`stem`] of the file: the key that joins masks, cameras and renders.
    pub stem: String,
    /// Upright pixels at working resolution; a plain border is filled with the nearest pixels of
    /// the picture.
    pub image: RgbImage,
    /// White or black border around the picture, working pixels.
    pub border: PlainBorder,
    /// Upright size of the file, pixels.
    pub original_size: (u32, u32),
    /// Rotation and mirroring from the stored pixels of the file to upright ones.
    #[serde(default)]
    pub turn: Turn,
    /// Original (upright) pixels → working pixels.
    pub to_working: Affine,
    /// Focal length from EXIF in working pixels, if the file states it.
    pub exif_focal: Option<f64>,
    /// Luma of the photo at a higher resolution than the working image, for measuring positions;
    /// `None` where the file has no more pixels.
    #[serde(skip)]
    pub fine: Option<Arc<Image<f32>>>,
    /// Number of pixels of the file with values that are not finite; they are read as black.
    pub lost_pixels: usize,
    /// Used pixels; `None` = all. In `image`, unused pixels continue the used ones smoothly, except
    /// under overlays.
    #[serde(default)]
    pub coverage: Option<Coverage>,
    /// Whether `coverage` includes a mask.
    #[serde(skip)]
    pub masked: bool,
    /// Notes on parts of the file that are not used, with the reason, for warnings.
    #[serde(skip)]
    pub notes: Vec<String>,
    /// Distortion that was removed from the image.
    pub straightened: Option<Straightening>,
    /// Camera make and model from EXIF: photos that share it may share one focal length.
    pub camera_model: Option<String>,
    /// Unit vector of gravity in camera axes (x right, y down, z forward), if the phone recorded
    /// it.
    pub gravity: Option<DVec3>,
    /// Exposure, white balance and vignetting that were removed from `image`.
    pub light: Light,
    /// Pixels excluded from `coverage` during the estimation of cameras.
    #[serde(skip)]
    pub overlay: Option<Overlay>,
}

impl Photo {
    /// Undistorts the working image and [`Photo::fine`]; `camera` is the pinhole of the result, at
    /// the working resolution.
    pub fn straighten(&mut self, lens: Lens, camera: &Camera) {
        if !lens.is_none() {
            let how = Straightening::new(lens, camera);
            self.image = how.image(&self.image);
            self.fine = self.fine.take().map(|fine| Arc::new(how.larger(&fine, self.image.width)));
            if let Some(coverage) = &mut self.coverage {
                coverage.share = how.plane(&coverage.share);
            }
            self.straightened = Some(how);
        }
    }

    /// Mirrors the photo, as if the orientation of the file had no mirroring.
    pub fn unmirror(&mut self) {
        fn flipped<T: Copy>(data: &mut [T], width: usize) {
            data.chunks_exact_mut(width.max(1)).for_each(<[T]>::reverse);
        }
        flipped(&mut self.image.data, self.image.width);
        if let Some(fine) = &mut self.fine {
            let width = fine.width;
            flipped(&mut Arc::make_mut(fine).data, width);
        }
        if let Some(Coverage { share, .. }) = &mut self.coverage {
            flipped(&mut share.data, share.width);
        }
        let PlainBorder { left, right, .. } = self.border;
        self.border = PlainBorder { left: right, right: left, ..self.border };
        self.to_working = self.mirrored_to_working();
        self.turn.mirrored = false;
    }

    /// [`Photo::to_working`] of the mirrored photo: cut bars are on the other side.
    pub fn mirrored_to_working(&self) -> Affine {
        let mut map = self.to_working;
        if self.is_cut() {
            let whole = map.scale[0] * f64::from(self.original_size.0);
            map.offset[0] = self.image.width as f64 - whole - map.offset[0];
        }
        map
    }

    /// Target of renders.
    pub fn target(&self) -> RgbImage {
        self.coverage.as_ref().map_or_else(|| self.image.clone(), |c| c.target(&self.image))
    }

    /// Whether a working pixel is used.
    pub fn uses(&self, index: usize) -> bool {
        self.coverage.as_ref().is_none_or(|c| c.uses(index))
    }

    /// Excludes `hidden` from [`Photo::coverage`], in place of the previous overlay.
    pub fn set_overlay(&mut self, hidden: Option<Image<bool>>) {
        let before = match self.overlay.take() {
            Some(overlay) => overlay.before,
            None => self.coverage.take(),
        };
        match hidden {
            None => self.coverage = before,
            Some(hidden) => {
                self.coverage = Some(Coverage::without(before.as_ref(), &hidden));
                self.overlay = Some(Overlay { hidden, before });
            }
        }
    }

    /// Cuts off the bars beside the picture, `bars` working pixels on each side.
    pub fn cut(&mut self, bars: PlainBorder) {
        let (w, h) = (self.image.width, self.image.height);
        self.image = bars.crop(&self.image);
        if let Some(coverage) = &mut self.coverage {
            let (width, height) = (self.image.width, self.image.height);
            coverage.share = coverage.share.cropped((bars.left, bars.top), (width, height));
        }
        self.fine = self.fine.take().map(|fine| {
            let rescaled = |n: usize, side: usize, of: usize| (n * side + of / 2) / of;
            let (x, y) = (rescaled(bars.left, fine.width, w), rescaled(bars.top, fine.height, h));
            let width = rescaled(self.image.width, fine.width, w).min(fine.width - x);
            let height = rescaled(self.image.height, fine.height, h).min(fine.height - y);
            Arc::new(fine.cropped((x, y), (width, height)))
        });
        let less = |border: usize, bar: usize| border.saturating_sub(bar);
        self.border = PlainBorder {
            left: less(self.border.left, bars.left),
            top: less(self.border.top, bars.top),
            right: less(self.border.right, bars.right),
            bottom: less(self.border.bottom, bars.bottom),
        };
        self.to_working = self.to_working.then(&Affine::crop(bars.left as f64, bars.top as f64));
    }

    /// Whether bars were cut off.
    pub fn is_cut(&self) -> bool {
        self.picture_size() != [self.original_size.0, self.original_size.1].map(f64::from)
    }

    /// Width and height of the picture without its bars, pixels of the file.
    pub fn picture_size(&self) -> [f64; 2] {
        let whole = [self.original_size.0, self.original_size.1].map(f64::from);
        let shown = [self.image.width, self.image.height].map(|n| n as f64);
        let full = [0, 1].map(|k| (whole[k] * self.to_working.scale[k]).round());
        if shown == full { whole } else { [0, 1].map(|k| shown[k] / self.to_working.scale[k]) }
    }

    /// Distance between the centres of the picture and of the file, pixels of the file. Bars may be
    /// drawn over a photo, or surround a complete one: the principal point is near one of the two.
    pub fn off_middle(&self) -> f64 {
        let middle = [self.image.width, self.image.height].map(|n| 0.5 * n as f64);
        let [x, y] = self.to_working.inverse().apply(middle);
        match self.is_cut() {
            true => {
                (x - 0.5 * f64::from(self.original_size.0)).hypot(y - 0.5 * f64::from(self.original_size.1))
            }
            false => 0.0,
        }
    }

    /// Working pixels per original pixel.
    pub fn zoom(&self) -> f64 {
        0.5 * (self.to_working.scale[0] + self.to_working.scale[1])
    }

    /// Focal length from EXIF, original pixels.
    pub fn original_focal(&self) -> Option<f64> {
        self.exif_focal.map(|f| f / self.to_working.scale[1])
    }

    /// Distortion that was removed from the image.
    pub fn lens(&self) -> Lens {
        self.straightened.map_or(Lens::NONE, |s| s.lens)
    }

    /// Position in the distorted photo, at the working resolution, of position `p` in the image.
    pub fn source(&self, p: DVec2) -> DVec2 {
        self.straightened.map_or(p, |s| s.source(p))
    }

    /// Camera of the original file for a camera of the working image: with its size, pixels and
    /// name; distorted by [`Photo::lens`].
    pub fn original_camera(&self, camera: &Camera) -> Camera {
        let name = self.path.file_name().map_or_else(|| self.stem.clone(), |n| n.to_string_lossy().into());
        Camera { name, ..self.to_working.inverse().camera(camera, self.original_size) }
    }
}

/// Reads a photo by [`load_at`] with [`MAX_SIZE`].
pub fn load(path: &Path) -> Result<Photo> {
    load_at(path, MAX_SIZE)
}

/// Reads one photo: EXIF orientation applied, transparency as [`Photo::coverage`], scaled down to
/// `max_size` pixels along its longer side if it is larger.
pub fn load_at(path: &Path, max_size: usize) -> Result<Photo> {
    from_bytes(path, read(path)?, max_size)
}

pub(super) fn read(path: &Path) -> Result<Vec<u8>> {
    files::read(path).map_err(|e| Error::input(e.to_string()))
}

/// Like [`load_at`], for an image file in memory; `name` stands for its path.
pub fn from_bytes(name: &Path, bytes: Vec<u8>, max_size: usize) -> Result<Photo> {
    of_decoded(name, decode::decode(bytes, name, None)?, None, max_size)
}

/// A photo of decoded pixels, with an optional mask.
pub(super) fn of_decoded(
    name: &Path,
    mut decoded: Decoded,
    mask: Option<&Mask>,
    max_size: usize,
) -> Result<Photo> {
    if let Some(lens) = &decoded.lens.fisheye {
        return Err(Error::input(format!(
            "{}: taken with a fisheye lens ({lens}), which radial distortion does not describe; make it rectilinear first, \
             with the camera maker's program or darktable's lens correction",
            name.display()
        )));
    }
    let mask = mask.map(|mask| mask.on(name, &decoded)).transpose()?;
    let masked = |x: usize, y: usize| mask.as_ref().is_none_or(|m| m(x, y));
    let photo = if mask.is_none() && !decoded.is_transparent() {
        working(name, decoded.size, max_size, |x, y| decoded.at(x, y).0)?
    } else {
        partly_used(name, decoded.size, max_size, mask.is_some(), |x, y| {
            let (colour, alpha) = decoded.at(x, y);
            (colour, if masked(x, y) { alpha } else { 0.0 })
        })?
    };
    // The two scales differ by the rounding of the size only.
    let exif_focal = decoded.lens.focal.map(|f| f * photo.to_working.scale[1]);
    let notes = std::mem::take(&mut decoded.notes);
    let lens = &decoded.lens;
    let (camera_model, gravity) = (lens.camera_model.clone(), lens.gravity);
    let (turn, lost_pixels) = (Turn::from(decoded.orientation), decoded.not_finite());
    Ok(Photo { exif_focal, camera_model, gravity, lost_pixels, turn, notes, ..photo })
}

/// A photo of upright sRGB pixels in [0, 1]; `focal` in these pixels, if known.
pub fn from_pixels(name: &Path, image: &RgbImage, focal: Option<f64>, max_size: usize) -> Result<Photo> {
    if image.data.len() != image.width * image.height {
        return Err(Error::input(format!(
            "{}: {} pixels do not make {} × {}",
            name.display(),
            image.data.len(),
            image.width,
            image.height
        )));
    }
    let photo = working(name, (image.width, image.height), max_size, |x, y| image.at(x, y))?;
    Ok(Photo { exif_focal: focal.map(|f| f * photo.to_working.scale[1]), ..photo })
}

/// Like [`from_pixels`], with the used pixels `used`, [H, W].
pub fn from_used_pixels(
    name: &Path,
    image: &RgbImage,
    used: &Image<bool>,
    focal: Option<f64>,
    max_size: usize,
) -> Result<Photo> {
    let size = (image.width, image.height);
    if image.data.len() != size.0 * size.1
        || (used.width, used.height, used.data.len()) != (size.0, size.1, image.data.len())
    {
        return Err(Error::input(format!("{}: pixels and mask are of two sizes", name.display())));
    }
    let pixel = |x: usize, y: usize| (image.at(x, y), if used.at(x, y) { 1.0 } else { 0.0 });
    let photo = partly_used(name, size, max_size, true, pixel)?;
    Ok(Photo { exif_focal: focal.map(|f| f * photo.to_working.scale[1]), ..photo })
}

/// Upright pixels at working resolution, without lens data.
fn working(
    name: &Path,
    size: (usize, usize),
    max_size: usize,
    at: impl Fn(usize, usize) -> [f32; 3] + Sync,
) -> Result<Photo> {
    check_size(name, size)?;
    let working = working_size(size.0, size.1, max_size);
    let mut image = resize::area_average(size, working, &at);
    let fine = fine_size(size, working).map(|fine| Arc::new(resize::area_average(size, fine, &at).luma()));
    let border = PlainBorder::of(&image);
    border.continue_picture(&mut image);
    Ok(Photo { border, fine, ..bare(name, size, image) })
}

/// Like [`working`], for pixels with used shares: unused pixels have no part in the averages.
fn partly_used(
    name: &Path,
    size: (usize, usize),
    max_size: usize,
    masked: bool,
    at: impl Fn(usize, usize) -> ([f32; 3], f32) + Sync,
) -> Result<Photo> {
    check_size(name, size)?;
    let (image, share) = resize::area_average_of_used(size, working_size(size.0, size.1, max_size), &at);
    let used = share.data.iter().filter(|s| **s > 0.0).count();
    if used < SMALLEST_SIDE * SMALLEST_SIDE / 4 {
        let what = if masked { "its mask leaves" } else { "its transparency leaves" };
        return Err(Error::input(format!(
            "{}: {what} {used} of {} pixels; white parts of a mask are used, black ones are not: invert it, or leave it out",
            name.display(),
            share.data.len()
        )));
    }
    let fine = fine_size(size, (image.width, image.height));
    let fine = fine.map(|fine| Arc::new(resize::area_average_of_used(size, fine, &at).0.luma()));
    // Transparent pixels of one photo are unknown until all photos of the set have some.
    let coverage = Some(Coverage { share, outside: Outside::Unknown });
    Ok(Photo { coverage, masked, fine, ..bare(name, size, image) })
}

/// A photo whose file is its working image, without metadata.
pub fn of_image(name: &Path, image: RgbImage) -> Photo {
    bare(name, (image.width, image.height), image)
}

/// A photo of a working image, without metadata.
fn bare(name: &Path, (w, h): (usize, usize), image: RgbImage) -> Photo {
    let working = (image.width as u32, image.height as u32);
    Photo {
        path: name.to_path_buf(),
        stem: stem(&name.to_string_lossy()).to_string(),
        image,
        border: PlainBorder::default(),
        original_size: (w as u32, h as u32),
        turn: Turn::default(),
        to_working: Affine::resize((w as u32, h as u32), working),
        exif_focal: None,
        fine: None,
        lost_pixels: 0,
        coverage: None,
        masked: false,
        notes: Vec::new(),
        straightened: None,
        camera_model: None,
        gravity: None,
        light: Light::NONE,
        overlay: None,
    }
}

pub(super) fn check_size(name: &Path, (w, h): (usize, usize)) -> Result<()> {
    if w.min(h) < SMALLEST_SIDE {
        return Err(Error::input(format!(
            "{}: {w} × {h} pixels are too few; each side needs at least {SMALLEST_SIDE}",
            name.display()
        )));
    }
    Ok(())
}

/// Longest side of [`Photo::fine`], pixels.
const FINE: usize = 3072;
/// Smallest ratio of its width to that of the working image; below, it adds no detail.
const MIN_GAIN: f64 = 1.25;

fn fine_size((w, h): (usize, usize), working: (usize, usize)) -> Option<(usize, usize)> {
    let share = (FINE as f64 / w.max(h) as f64).min(1.0);
    let size = ((w as f64 * share).round() as usize, (h as f64 * share).round() as usize);
    (size.0 as f64 > MIN_GAIN * working.0 as f64).then_some(size)
}

/// Working (width, height) of a photo: the longer side is capped, the other one rounded. Never
/// larger than the photo, and the shorter side is never below [`SMALLEST_SIDE`], which networks
/// need of panoramas.
pub fn working_size(w: usize, h: usize, max_size: usize) -> (usize, usize) {
    let (long, short) = (w.max(h), w.min(h));
    let floor = (SMALLEST_SIDE * long).div_ceil(short.max(1));
    let target = max_size.max(floor);
    if long <= target {
        return (w, h);
    }
    let scaled = |side: usize| ((side * target + long / 2) / long).max(1);
    (scaled(w), scaled(h))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cleared_overlays_leave_the_mask() {
        let (width, height) = (64, 64);
        let image = RgbImage { width, height, data: vec![[0.5; 3]; width * height] };
        let mut photo = from_pixels("a.png".as_ref(), &image, None, 64).unwrap();
        let plane = |of: &dyn Fn(usize) -> bool| Image {
            width,
            height,
            data: (0..width * height).map(|i| of(i % width)).collect::<Vec<bool>>(),
        };
        let used = |photo: &Photo| [2, 12, 40].map(|i| photo.uses(i));
        photo.set_overlay(Some(plane(&|x| x < 10)));
        assert_eq!(used(&photo), [false, true, true]);
        photo.set_overlay(None);
        assert_eq!((photo.coverage.clone(), used(&photo)), (None, [true; 3]));
        // With a mask whose left part the overlay covers.
        let mask = Coverage::without(None, &plane(&|x| (5..20).contains(&x)));
        photo.coverage = Some(mask.clone());
        photo.set_overlay(Some(plane(&|x| x < 10)));
        assert_eq!(used(&photo), [false, false, true]);
        assert!(photo.coverage.as_ref().is_some_and(|c| c.outside == Outside::Unknown));
        photo.set_overlay(Some(plane(&|x| x == 40)));
        assert_eq!(used(&photo), [true, false, false]);
        photo.set_overlay(None);
        assert_eq!(photo.coverage, Some(mask));
    }
}
