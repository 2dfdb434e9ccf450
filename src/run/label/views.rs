//! Views in which splats of another program get language: their photos, or renders of them.
use super::coverage::{Shown, most_covering};
use super::synthesize::{self, TRIED_SIDE, compared, likely_up};
use crate::format::scene_dir::Scene;
use crate::format::{CameraFile, cameras, scene_photos};
use crate::pass::renderer::{RenderedFrame, Renderer};
use crate::photo::{self, Candidate, Photo};
use crate::pose;
use crate::progress::Progress;
use crate::run::base::correlation;
use crate::run::photos;
use crate::run::plan::RunPlan;
use crate::scene::{Camera, Coverage, Image};
use crate::{Error, Result};
use std::path::Path;

/// Number of photos that are used by default.
pub(super) const PHOTOS: usize = 16;
/// Number of views that are rendered by default where there are no photos.
pub(super) const RENDERS: usize = 24;
/// Photos or cameras that are compared; of more, evenly spread ones.
const MOST_COMPARED: usize = 96;

/// Source of the views.
pub(super) enum ViewSource {
    /// Photos with their cameras.
    Photos(CameraFile),
    /// The photos of a scene directory.
    Scene,
    /// Renders from given cameras.
    Cameras(Vec<Camera>),
    /// Renders from cameras in free space.
    Synthesized(usize),
}

impl ViewSource {
    /// The source that a plan asks for, or else the best one that the scene has.
    pub(super) fn of(plan: &RunPlan, scene: &Scene) -> Result<ViewSource> {
        let inputs = &plan.inputs;
        let cameras = photos::camera_file(plan);
        match (inputs.photos.is_empty(), cameras, inputs.synthesize) {
            (_, _, Some(count)) => Ok(ViewSource::Synthesized(count)),
            (false, Some(file), None) => Ok(ViewSource::Photos(cameras::read_file(file)?)),
            (false, None, None) => Err(Error::input(
                "--images: the photos need cameras in the coordinates of the splats, those of their training; add --cameras FILE, \
                 or leave --images out for views that are rendered from the splats",
            )),
            (true, Some(file), None) => Ok(ViewSource::Cameras(cameras::read(file)?)),
            (true, None, None) if scene.cameras.is_empty() => Ok(ViewSource::Synthesized(RENDERS)),
            (true, None, None) => Ok(ViewSource::Scene),
        }
    }

    /// Whether the pictures of the views are photos.
    pub(super) fn shows_photos(&self) -> bool {
        matches!(self, ViewSource::Photos(_) | ViewSource::Scene)
    }

    /// Description for run.json.
    pub(super) fn method(&self) -> &'static str {
        match self {
            ViewSource::Photos(_) => "given splats, photos with given cameras",
            ViewSource::Scene => "given splats, photos of the scene",
            ViewSource::Cameras(_) => "given splats, renders from given cameras",
            ViewSource::Synthesized(_) => "given splats, renders from cameras in free space",
        }
    }
}

/// Pictures with their cameras, and the splats from there.
pub(super) struct Views {
    pub(super) photos: Vec<Photo>,
    pub(super) cameras: Vec<Camera>,
    pub(super) frames: Vec<RenderedFrame>,
}

impl Views {
    /// Chooses, reads or renders the views of a source.
    pub(super) fn new(
        source: &ViewSource,
        plan: &RunPlan,
        scene: &Scene,
        renderer: &mut Renderer,
        max_size: usize,
        progress: &dyn Progress,
    ) -> Result<Views> {
        let (photos, cameras) = match source {
            ViewSource::Photos(known) => given_photos(plan, known, renderer, max_size, progress)?,
            ViewSource::Scene => {
                let photos = scene_photos::load(&scene.path).map_err(|e| {
                    Error::input(format!("{e}; or let it render its own views: --synthesize {RENDERS}"))
                })?;
                (photos, scene.cameras.clone())
            }
            ViewSource::Cameras(cameras) => {
                let wanted = plan.inputs.views.unwrap_or(RENDERS);
                let spread = photo::spread(cameras.len(), cameras.len().min(MOST_COMPARED));
                let compared: Vec<Camera> = spread.iter().map(|k| cameras[*k].clone()).collect();
                let chosen = chosen(renderer, &compared, wanted, progress)?;
                let largest = |c: &Camera| sized(c, max_size.min(c.width.max(c.height) as usize));
                (Vec::new(), chosen.iter().map(|k| largest(&compared[*k])).collect())
            }
            ViewSource::Synthesized(count) => {
                let up = scene.world.up.as_ref().map_or_else(|| likely_up(&scene.splats), |up| up.direction);
                (Vec::new(), synthesize::cameras(renderer, &scene.splats, up, *count, progress)?)
            }
        };
        progress.begin("render", cameras.len() as u64);
        let mut frames = Vec::with_capacity(cameras.len());
        for camera in &cameras {
            progress.check()?;
            frames.push(renderer.render(camera)?);
            progress.step(frames.len() as u64, &camera.name);
        }
        progress.end();
        let photos = match source.shows_photos() {
            true => photos,
            false => cameras.iter().zip(&frames).map(|(c, f)| picture(c, f)).collect(),
        };
        let views = Views { photos, cameras, frames };
        if source.shows_photos() {
            views.check_photos()?;
        }
        Ok(views)
    }

    /// Refuses photos that show something else than the splats.
    fn check_photos(&self) -> Result<()> {
        let of_frames: Vec<Vec<f32>> = self.frames.iter().map(|f| thumbnail(&f.rgb.luma())).collect();
        let of_photos: Vec<Vec<f32>> = self.photos.iter().map(|p| thumbnail(&p.target().luma())).collect();
        let count = self.photos.len();
        let pairs = (0..count).flat_map(|i| (0..count).map(move |j| (i, j)));
        let (mut own, mut other) = (Vec::new(), Vec::new());
        for (i, j) in pairs {
            let correlation = correlation(&of_frames[i], &of_photos[j]);
            if i == j { own.push(correlation) } else { other.push(correlation) }
        }
        let mean = |list: &[f64]| list.iter().sum::<f64>() / list.len().max(1) as f64;
        let (own, other) = (mean(&own), mean(&other));
        if own >= ALIKE || own >= other + NEARER {
            return Ok(());
        }
        Err(Error::input(format!(
            "the splats do not show these photos: from their cameras they look no more like them than like each other (correlation \
             {own:.2}, with the other photos {other:.2}); give the cameras of the training, in its coordinates, or leave --images \
             out for views that are rendered from the splats"
        )))
    }
}

/// Correlation of thumbnails from which a render shows a photo, whatever the others are.
const ALIKE: f64 = 0.8;
/// Excess of the correlation with the own photo over that with the others.
const NEARER: f64 = 0.1;
/// Side of the thumbnails, pixels.
const THUMBNAIL: usize = 24;

fn thumbnail(luma: &Image<f32>) -> Vec<f32> {
    let at = |k: usize, cells: usize, side: usize| (2 * k + 1) * side / (2 * cells);
    let pixels = (0..THUMBNAIL).flat_map(|y| (0..THUMBNAIL).map(move |x| (x, y)));
    let (w, h) = (luma.width, luma.height);
    pixels.map(|(x, y)| luma.data[at(y, THUMBNAIL, h) * w + at(x, THUMBNAIL, w)]).collect()
}

/// The camera at a size of at most `side` pixels on the longer side.
fn sized(camera: &Camera, side: usize) -> Camera {
    let (width, height) = photo::working_size(camera.width as usize, camera.height as usize, side);
    camera.resized(width as u32, height as u32)
}

/// Photos with cameras: those that together show most of the splats, read and undistorted.
fn given_photos(
    plan: &RunPlan,
    known: &CameraFile,
    renderer: &mut Renderer,
    max_size: usize,
    progress: &dyn Progress,
) -> Result<(Vec<Photo>, Vec<Camera>)> {
    known.warnings.iter().for_each(|w| progress.warn(w));
    let found = photos::with_cameras(plan, known, progress)?.ok_or_else(|| {
        Error::input("--images: a video; its frames have no cameras, give the folder of the photos")
    })?;
    let wanted = plan.inputs.views.unwrap_or(PHOTOS);
    let compared = photo::spread(found.len(), found.len().min(MOST_COMPARED));
    let paths: Vec<String> = compared.iter().map(|k| found[*k].path.to_string_lossy().into_owned()).collect();
    let names: Vec<&str> = known.cameras.iter().map(|c| c.camera.name.as_str()).collect();
    let own = photo::join(&paths, &names).map_err(Error::input)?;
    let pairs = compared.iter().zip(own).filter_map(|(k, own)| Some((*k, own?)));
    let (candidates, cameras): (Vec<usize>, Vec<Camera>) =
        pairs.map(|(k, own)| (k, known.cameras[own].camera.clone())).unzip();
    let mut chosen = chosen(renderer, &cameras, wanted.max(2), progress)?;
    if chosen.len() < 2 {
        return Err(Error::input(
            "the cameras look past the splats: fewer than two show any; are both in the same coordinates? Without --images and \
             --cameras views are rendered from the splats",
        ));
    }
    if chosen.len() < found.len() {
        progress.inform(&format!("{} of {} photos together show the splats", chosen.len(), found.len()));
    }
    chosen.sort_unstable();
    let mut files: Vec<Candidate> = chosen.iter().map(|k| found[candidates[*k]].clone()).collect();
    photo::assign_masks(&mut files, &photos::masks(plan)?, progress)?;
    let mut photos = photo::load_each(&files, max_size, progress)?;
    let cameras = pose::assign(&mut photos, &known.cameras, progress)?;
    Ok((photos, cameras))
}

/// Rows of the cameras that together show most of the splats, at most `wanted`.
fn chosen(
    renderer: &mut Renderer,
    cameras: &[Camera],
    wanted: usize,
    progress: &dyn Progress,
) -> Result<Vec<usize>> {
    if cameras.len() <= wanted {
        return Ok((0..cameras.len()).collect());
    }
    progress.begin("views", cameras.len() as u64);
    let mut shown: Vec<Shown> = Vec::with_capacity(cameras.len());
    for camera in cameras {
        progress.check()?;
        shown.push(compared(renderer.weights(&sized(camera, TRIED_SIDE as usize))?, 1.0));
        progress.step(shown.len() as u64, "");
    }
    progress.end();
    Ok(most_covering(&shown, wanted, 0.0))
}

/// Least alpha of a pixel that counts as seen.
const OPAQUE: f32 = 0.5;

/// A render as a photo; pixels that show nothing are not used.
fn picture(camera: &Camera, frame: &RenderedFrame) -> Photo {
    let mut image = frame.rgb.clone();
    image.data.iter_mut().for_each(|c| *c = c.map(|v| v.clamp(0.0, 1.0)));
    let hidden: Vec<bool> = frame.alpha.data.iter().map(|a| *a < OPAQUE).collect();
    image.fill_from_used(|i| !hidden[i]);
    let hidden = Image { width: image.width, height: image.height, data: hidden };
    let coverage = hidden.data.contains(&true).then(|| Coverage::without(None, &hidden));
    Photo { coverage, ..photo::of_image(Path::new(&camera.name), image) }
}
