//! Photos → cameras → depth and points.
use super::shared;
use super::shared::keypoints;
use crate::fit::{Preset, Trained};
use crate::format::CameraFile;
use crate::infer::installed::Installed;
use crate::infer::pairs;
use crate::pass::plane_sweep::DevicePlaneSweep;
use crate::photo::Photo;
use crate::pipeline::{Codec, Context, Lane, Output, Stage, kept};
use crate::pose::choose::{LeftOut, Reason};
use crate::pose::stereo::StereoOptions;
use crate::pose::{self, Geometry, SparseModel, pointmap, upright};
use crate::scene::{DepthPrior, Up};
use crate::{Error, Result};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

/// Source of cameras.
pub enum CameraOrigin {
    /// Structure from motion.
    Sfm,
    /// Known cameras, joined to the photos by name.
    Known(CameraFile),
    /// Pointmaps and depth of a network; structure from motion if an untrained network gives no
    /// geometry.
    Network(Installed),
    /// Given cameras and points.
    GivenGeometry(Geometry),
}

/// Photos without lens distortion and in one light, as all later stages take them, with the
/// geometry known so far.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct PlacedPhotos {
    /// Registered photos.
    pub photos: Vec<Photo>,
    /// Photos that could not be registered reliably.
    pub left_out: Vec<LeftOut>,
    /// Geometry known so far.
    pub known: KnownGeometry,
}

/// Geometry that the first stage passes on.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub enum KnownGeometry {
    /// Cameras and sparse points, and the method that found them; without depth.
    Sparse(SparseModel, String),
    /// Cameras, depth and points, from a network or given.
    Complete(Geometry),
}

/// Finds cameras and registers photos.
pub struct Cameras {
    photos: Vec<Photo>,
    source: CameraOrigin,
    seed: u64,
    settings: String,
}

impl Cameras {
    /// Prepares the stage for `photos`; `seed` draws the samples of RANSAC.
    pub fn new(photos: Vec<Photo>, source: CameraOrigin, seed: u64) -> Result<Cameras> {
        let source_identity = match &source {
            CameraOrigin::Sfm => "sfm".to_owned(),
            CameraOrigin::Known(file) => format!("{file:?}"),
            CameraOrigin::Network(model) => shared::identity(model)?,
            CameraOrigin::GivenGeometry(geometry) => format!("{geometry:?}"),
        };
        let photo_identities: Vec<String> = photos.par_iter().map(identity).collect();
        // Given cameras use no seed: runs that differ in the seed alone share this stage.
        let used_seed = matches!(source, CameraOrigin::Sfm | CameraOrigin::Network(_)).then_some(seed);
        let settings = format!("{source_identity} {photo_identities:?} {used_seed:?}");
        Ok(Cameras { photos, source, seed, settings })
    }
}

/// Text that identifies everything that stages read of a photo.
pub(super) fn identity(photo: &Photo) -> String {
    let mut digest = Sha256::new();
    digest.update(bytemuck::cast_slice::<_, u8>(&photo.image.data));
    if let Some(fine) = &photo.fine {
        digest.update(bytemuck::cast_slice::<_, u8>(&fine.data));
    }
    let outside = photo.coverage.as_ref().map(|coverage| {
        digest.update(bytemuck::cast_slice::<_, u8>(&coverage.share.data));
        coverage.outside
    });
    let pixels = crate::files::hex(&digest.finalize());
    let Photo {
        path, image, border, original_size, turn, to_working, exif_focal, camera_model, gravity, ..
    } = photo;
    let size = (image.width, image.height);
    format!(
        "{path:?} {size:?} {border:?} {original_size:?} {turn:?} {to_working:?} {exif_focal:?} {camera_model:?} {gravity:?} {outside:?} {pixels}"
    )
}

impl Stage for Cameras {
    const NAME: &'static str = "cameras";
    const LANE: Lane = Lane::Device;
    type Inputs = ();
    type Output = PlacedPhotos;

    fn settings(&self) -> String {
        self.settings.clone()
    }

    fn codec() -> Option<Codec<PlacedPhotos>> {
        kept()
    }

    fn run(self, (): (), context: &Context) -> Result<PlacedPhotos> {
        let (progress, photos) = (context.progress, self.photos);
        let known = match &self.source {
            CameraOrigin::Network(model) => {
                let maps = pairs::pointmaps(model, &photos, progress)?;
                match pointmap::reconstruct(maps, self.seed, progress) {
                    Ok(found) => return Ok(network_photos(&model.name, photos, found)),
                    Err(Error::Cancelled) => return Err(Error::Cancelled),
                    Err(error) if model.untrained() => progress.warn(&format!(
                        "{}: no geometry in untrained pointmaps ({error}); cameras from sfm",
                        model.name
                    )),
                    Err(error) => return Err(error),
                }
                None
            }
            CameraOrigin::GivenGeometry(geometry) => {
                let known = KnownGeometry::Complete(geometry.clone());
                return Ok(PlacedPhotos { photos, left_out: Vec::new(), known });
            }
            CameraOrigin::Sfm => None,
            CameraOrigin::Known(file) => {
                file.warnings.iter().for_each(|w| progress.warn(w));
                Some(file.cameras.as_slice())
            }
        };
        let pose::SolvedCameras { photos, model, left_out, method } =
            pose::place(photos, known, &mut keypoints(context.registry)?, self.seed, progress)?;
        Ok(PlacedPhotos { photos, left_out, known: KnownGeometry::Sparse(model, method) })
    }
}

/// Photos that a network's geometry registers.
fn network_photos(model: &str, photos: Vec<Photo>, found: pointmap::Reconstruction) -> PlacedPhotos {
    let mut left_out = Vec::new();
    let mut kept = Vec::new();
    for (view, photo) in photos.into_iter().enumerate() {
        if found.left_out.contains(&view) {
            left_out.push(LeftOut { photo: photo.stem, reason: Reason::NoOverlap });
        } else {
            kept.push(photo);
        }
    }
    let method = format!("{model} {}", found.geometry.method);
    let geometry = without_unused(found.geometry, &kept);
    let known = KnownGeometry::Complete(Geometry { method, ..geometry });
    PlacedPhotos { photos: kept, left_out, known }
}

/// Removes depth and points of pixels that the photos do not use.
fn without_unused(mut geometry: Geometry, photos: &[Photo]) -> Geometry {
    for (depth, photo) in geometry.depths.iter_mut().zip(photos).filter(|(_, p)| p.coverage.is_some()) {
        depth.keep(|i| photo.uses(i));
    }
    let rows: Vec<usize> =
        (0..geometry.points.len()).filter(|&i| is_used_point(&geometry, photos, i)).collect();
    geometry.points = geometry.points.picked(&rows);
    geometry
}

/// Whether a point projects to a used pixel of its photo.
fn is_used_point(geometry: &Geometry, photos: &[Photo], point: usize) -> bool {
    let view = geometry.points.view[point] as usize;
    let (Some(photo), Some(camera)) = (photos.get(view), geometry.cameras.get(view)) else { return true };
    let (pixel, _) = camera.project(glam::DVec3::from(geometry.points.positions[point].map(f64::from)));
    let (w, h) = (photo.image.width, photo.image.height);
    photo.uses(pixel_index(pixel.y, h) * w + pixel_index(pixel.x, w))
}

fn pixel_index(position: f64, size: usize) -> usize {
    (position.max(0.0) as usize).min(size - 1)
}

/// Depth maps and points by stereo, unless a network has given them.
pub struct DenseDepth {
    /// Trade-off of time and quality.
    pub preset: Preset,
    /// Seed of the planes that stereo tries.
    pub seed: u64,
}

impl Stage for DenseDepth {
    const NAME: &'static str = "depth";
    const LANE: Lane = Lane::Device;
    type Inputs = (Output<PlacedPhotos>, Output<Vec<Option<DepthPrior>>>);
    type Output = Geometry;

    fn settings(&self) -> String {
        format!("{:?}", StereoOptions::preset(self.preset).seeded(self.seed))
    }

    fn codec() -> Option<Codec<Geometry>> {
        kept()
    }

    fn run(
        self,
        (placed, priors): (&PlacedPhotos, &Vec<Option<DepthPrior>>),
        context: &Context,
    ) -> Result<Geometry> {
        match placed.known.clone() {
            KnownGeometry::Complete(geometry) => Ok(geometry),
            KnownGeometry::Sparse(model, method) => {
                let options = StereoOptions::preset(self.preset).seeded(self.seed);
                let sweep = DevicePlaneSweep::new(context.device);
                pose::dense(&sweep, &placed.photos, priors, model, method, &options, context.progress)
            }
        }
    }
}

/// The direction up.
pub struct Upright;

impl Stage for Upright {
    const NAME: &'static str = "upright";
    const LANE: Lane = Lane::Processor;
    type Inputs = (Output<PlacedPhotos>, Output<Geometry>, Output<Trained>);
    type Output = Option<Up>;

    fn settings(&self) -> String {
        String::new()
    }

    fn run(
        self,
        (placed, geometry, trained): (&PlacedPhotos, &Geometry, &Trained),
        _: &Context,
    ) -> Result<Option<Up>> {
        let images: Vec<_> = placed.photos.iter().map(|p| &p.image).collect();
        let gravity: Vec<_> = placed.photos.iter().map(|p| p.gravity).collect();
        Ok(upright::up(&images, &trained.cameras, &geometry.points, &gravity))
    }
}
