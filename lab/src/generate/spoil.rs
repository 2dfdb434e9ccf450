//! Faulty photo sets, of which no correct scene or only part of one can be made. A run must refuse
//! them, warn of the photo, or be correct all the same (docs/internals/trust.md#photo-sets).
use super::{to_linear, to_srgb};
use rayon::prelude::*;
use serde::Serialize;
use splatvk::math::Random;
use splatvk::scene::{Camera, RgbImage};

/// Standard deviation of defocus over the width: details of a hundredth of the picture are lost.
const DEFOCUS: f64 = 0.01;
/// Stops of over-exposure: everything brighter than an eighth of white is clipped.
const OVEREXPOSURE: f64 = 3.0;

/// Fault of a photo set.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Spoil {
    /// All photos have the pose of the first one, as from a tripod.
    Identical,
    /// One photo is mirrored left to right.
    Mirrored,
    /// One object stands elsewhere in one photo.
    Moving,
    /// One photo is out of focus.
    Defocused,
    /// One photo is over-exposed by three stops.
    Overexposed,
    /// One photo is black.
    Black,
    /// Every surface carries one small tile again and again.
    Repeated,
    /// All photos are taken from one place.
    Rotation,
    /// The second half of the photos shows another scene.
    TwoScenes,
    /// Photos of two cameras whose files state each other's focal length.
    SwappedExif,
    /// Every other photo is cut out of a larger one, off its middle.
    Cropped,
    /// A half-transparent text is tiled over every photo.
    Watermark,
    /// Bars with text at the top and bottom of every photo.
    Caption,
    /// A banner over the lower 15 % of every photo.
    Banner,
    /// Black bars at the top and bottom of every photo.
    Letterbox,
    /// A white frame over the borders of every photo.
    Frame,
    /// The surface of a phone above and below every photo.
    Screenshot,
    /// The bonnet of a car in the lower part of every photo.
    Bonnet,
}

impl Spoil {
    /// All variants with their names and help texts.
    pub const ALL: [(Spoil, &str, &str); 18] = [
        (Spoil::Identical, "identical", "Every photo shows what the first one does; their noise differs"),
        (Spoil::Mirrored, "mirrored", "The second photo is mirrored left to right"),
        (Spoil::Moving, "moving", "One object stands elsewhere in the second photo"),
        (Spoil::Defocused, "defocused", "The second photo is out of focus by a hundredth of its width"),
        (Spoil::Overexposed, "overexposed", "The second photo is over-exposed by three stops"),
        (Spoil::Black, "black", "The second photo is black"),
        (Spoil::Repeated, "repeated", "Every surface carries one small tile again and again"),
        (Spoil::Rotation, "rotation", "All photos are taken from one place, turned by --baseline"),
        (Spoil::TwoScenes, "two-scenes", "The second half of the photos shows another scene"),
        (Spoil::SwappedExif, "swapped-exif", "Two cameras whose files state each other's focal length"),
        (
            Spoil::Cropped,
            "cropped",
            "Every other photo is cut out of one up to 1.6 times as large, off its middle",
        ),
        (Spoil::Watermark, "watermark", "A half-transparent text is tiled over every photo"),
        (Spoil::Caption, "caption", "Bars with text at the top and bottom of every photo"),
        (Spoil::Banner, "banner", "A banner over the lower 15 % of every photo"),
        (Spoil::Letterbox, "letterbox", "Black bars over an eighth of every photo at the top and bottom"),
        (Spoil::Frame, "frame", "A white frame over the borders of every photo"),
        (
            Spoil::Screenshot,
            "screenshot",
            "The surface of a phone over a quarter of every photo above and below",
        ),
        (Spoil::Bonnet, "bonnet", "The bonnet of a car in the lower part of every photo"),
    ];

    /// Applies the faults of a single picture; the other variants leave it unchanged.
    pub(super) fn spoil_picture(self, image: &mut RgbImage) {
        let width = image.width;
        match self {
            Spoil::Mirrored => image.data.chunks_mut(width).for_each(<[_]>::reverse),
            Spoil::Defocused => *image = blurred(image, DEFOCUS * width as f64),
            Spoil::Overexposed => {
                let brighter =
                    |v: f32| to_srgb((to_linear(f64::from(v)) * OVEREXPOSURE.exp2()).min(1.0)) as f32;
                image.data.par_iter_mut().for_each(|c| *c = c.map(brighter));
            }
            Spoil::Black => image.data.fill([0.0; 3]),
            _ => {}
        }
    }
}

/// Range of the size of the whole photo over that of the part cut out of it.
const WHOLE: (f64, f64) = (1.25, 1.6);
/// Smallest offset of the part from the middle, share of the largest one that fits.
const OFF: f64 = 0.6;

/// Changes a camera to that of a photo with the same number of pixels, cut out of a larger one.
pub(super) fn crop(camera: &mut Camera, seed: u64) {
    let mut random = Random::new(seed ^ 0xc20);
    let whole = WHOLE.0 + (WHOLE.1 - WHOLE.0) * random.uniform();
    let mut offset = || {
        let share = OFF + (1.0 - OFF) * random.uniform();
        0.5 * (whole - 1.0) * if random.uniform() < 0.5 { -share } else { share }
    };
    camera.cx += offset() * f64::from(camera.width);
    camera.cy += offset() * f64::from(camera.height);
    (camera.fx, camera.fy) = (camera.fx * whole, camera.fy * whole);
}

/// Gaussian blur with a standard deviation in pixels.
fn blurred(image: &RgbImage, sigma: f64) -> RgbImage {
    let flat: Vec<f32> = image.data.iter().flatten().copied().collect();
    let Some(buffer) =
        image::ImageBuffer::<image::Rgb<f32>, _>::from_raw(image.width as u32, image.height as u32, flat)
    else {
        return image.clone();
    };
    let data = image::imageops::blur(&buffer, sigma as f32).pixels().map(|p| p.0).collect();
    RgbImage { data, ..image.clone() }
}
