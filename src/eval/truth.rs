//! Ground-truth folders: `ground_truth.json`, photos, `masks/<stem>.png`, `depth/<stem>.npz`.
use crate::format::npy;
use crate::photo::{self, stem};
use crate::scene::{Camera, Image, Lens, Pose, RgbImage};
use crate::{Error, Result, files};
use glam::{DMat3, DVec3};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Role of a frame for the scene.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[non_exhaustive]
pub enum Split {
    /// Photos that the scene was made from.
    Train,
    /// Held-out photos.
    Test,
    /// Held-out photos beside the others.
    Out,
}

impl Split {
    /// Name in the ground truth.
    pub fn name(self) -> &'static str {
        match self {
            Split::Train => "train",
            Split::Test => "test",
            Split::Out => "out",
        }
    }
}

/// One known view.
#[derive(Clone, Debug, PartialEq)]
pub struct TruthFrame {
    /// Photo, relative to the folder.
    pub file: String,
    /// File name without extension.
    pub stem: String,
    /// Role of the frame.
    pub split: Split,
    /// Intrinsics and pose in the true world.
    pub camera: Camera,
    /// Radial distortion of the photo, if the set states it; [`TruthFrame::camera`] excludes it.
    pub lens: Option<Lens>,
}

impl TruthFrame {
    /// Refuses a file of another size than the frame's.
    fn fits(&self, path: &Path, (width, height): (u32, u32)) -> Result<()> {
        let (w, h) = (self.camera.width, self.camera.height);
        if (width, height) == (w, h) {
            return Ok(());
        }
        Err(Error::input(format!(
            "{}: {width} × {height} pixels, the frame has {w} × {h}; give one of its size, or correct ground_truth.json",
            path.display()
        )))
    }
}

/// Labels of frames in another layout than `masks/<stem>.png`.
pub trait ObjectMaps: std::fmt::Debug + Send + Sync {
    /// Object index per pixel of a frame, [H, W] at the label's own size; `None` for a frame
    /// without labels.
    fn objects(&self, stem: &str) -> Result<Option<Image<u32>>>;
}

/// A ground-truth folder.
#[derive(Clone, Debug)]
pub struct GroundTruth {
    /// Path of the folder.
    pub folder: PathBuf,
    /// Object index → phrase; empty when the set has no labels.
    pub labels: BTreeMap<u32, String>,
    /// Unit vector against gravity, if the set states it.
    pub up: Option<DVec3>,
    /// All views.
    pub frames: Vec<TruthFrame>,
    /// Labels of another layout than `masks/<stem>.png`.
    pub maps: Option<Arc<dyn ObjectMaps>>,
}

#[derive(Deserialize)]
struct File {
    width: u32,
    height: u32,
    #[serde(default)]
    labels: BTreeMap<u32, String>,
    #[serde(default)]
    up: Option<DVec3>,
    frames: Vec<FileFrame>,
}

#[derive(Deserialize)]
struct FileFrame {
    file: String,
    split: Split,
    fx: f64,
    fy: f64,
    cx: f64,
    cy: f64,
    world_to_camera: [[f64; 4]; 4],
    #[serde(default)]
    lens: Option<Lens>,
}

impl FileFrame {
    fn read(self, (width, height): (u32, u32)) -> Result<TruthFrame, String> {
        let FileFrame { file, split, fx, fy, cx, cy, world_to_camera: m, lens } = self;
        let column = |c: usize| DVec3::new(m[0][c], m[1][c], m[2][c]);
        let rotation = DMat3::from_cols(column(0), column(1), column(2));
        let pose = Pose { rotation, translation: column(3) };
        let camera = Camera { name: file.clone(), width, height, fx, fy, cx, cy, pose };
        // The matrix stays as written: scores are finer than its printed digits.
        camera.clone().checked()?;
        Ok(TruthFrame { stem: stem(&file).to_string(), file, split, camera, lens })
    }
}

impl GroundTruth {
    /// Reads `ground_truth.json` of a folder.
    pub fn read(folder: &Path) -> Result<Self> {
        let path = folder.join("ground_truth.json");
        let file: File = files::read_json(&path, "a folder with ground truth has that file")?;
        let size = (file.width, file.height);
        let frames = file.frames.into_iter().map(|f| f.read(size)).collect::<Result<_, String>>();
        let frames = frames.map_err(|e| Error::input(format!("{}: {e}; correct it", path.display())))?;
        let up = file.up.map(DVec3::normalize_or_zero);
        Ok(GroundTruth { folder: folder.to_path_buf(), labels: file.labels, up, frames, maps: None })
    }

    /// Validates the files before any work: photos, masks and depth at the size of their frames,
    /// and with `masks`, if the set has labels, a mask for every frame. Returns a warning for
    /// labels without any mask.
    pub fn check(&self, masks: bool) -> Result<Option<String>> {
        let labelled = self.maps.is_none() && !self.labels.is_empty();
        let mut missing = Vec::new();
        for frame in &self.frames {
            let photo = self.folder.join(&frame.file);
            frame.fits(&photo, photo::dimensions(&photo)?)?;
            let mask = self.mask_path(frame);
            if labelled && mask.exists() {
                frame.fits(&mask, photo::dimensions(&mask)?)?;
            } else if labelled {
                missing.push(mask);
            }
            if let Some(depth) = self.depth(frame)? {
                frame.fits(&self.depth_path(frame), (depth.width as u32, depth.height as u32))?;
            }
        }
        match missing.first() {
            Some(_) if masks && missing.len() == self.frames.len() => Ok(Some(format!(
                "{}: {} labels and no masks; answers are not scored",
                self.folder.display(),
                self.labels.len()
            ))),
            Some(mask) if masks => Err(Error::input(format!(
                "{}: the mask is missing; restore it, or take the labels out of ground_truth.json to score without masks",
                mask.display()
            ))),
            _ => Ok(None),
        }
    }

    fn mask_path(&self, frame: &TruthFrame) -> PathBuf {
        self.folder.join("masks").join(format!("{}.png", frame.stem))
    }

    fn depth_path(&self, frame: &TruthFrame) -> PathBuf {
        self.folder.join("depth").join(format!("{}.npz", frame.stem))
    }

    /// The photo of a frame.
    pub fn image(&self, frame: &TruthFrame) -> Result<RgbImage> {
        let path = self.folder.join(&frame.file);
        let image = open(&path)?.to_rgb8();
        let data = image.pixels().map(|p| p.0.map(|v| v as f32 / 255.0)).collect();
        Ok(RgbImage { width: image.width() as usize, height: image.height() as usize, data })
    }

    /// Object index per pixel, if the set has masks; masks of another layout are resampled to the
    /// frame's size.
    pub fn objects(&self, frame: &TruthFrame) -> Result<Option<Image<u32>>> {
        if let Some(maps) = &self.maps {
            let (width, height) = (frame.camera.width as usize, frame.camera.height as usize);
            return Ok(maps.objects(&frame.stem)?.map(|plane| resampled(&plane, width, height)));
        }
        let path = self.mask_path(frame);
        if self.labels.is_empty() || !path.exists() {
            return Ok(None);
        }
        let image = open(&path)?.to_luma8();
        let data = image.pixels().map(|p| p.0[0] as u32).collect();
        Ok(Some(Image { width: image.width() as usize, height: image.height() as usize, data }))
    }

    /// Camera z per pixel, 0 = unknown, if the set has depth.
    pub fn depth(&self, frame: &TruthFrame) -> Result<Option<Image<f32>>> {
        let path = self.depth_path(frame);
        if !path.exists() {
            return Ok(None);
        }
        let arrays = npy::read_npz(&path)?;
        match arrays.get("depth") {
            Some(a) if a.shape.len() == 2 => {
                Ok(Some(Image { width: a.shape[1], height: a.shape[0], data: a.to_f32() }))
            }
            _ => Err(Error::input(format!("{}: no HxW array named depth", path.display()))),
        }
    }

    /// Mean over frames of their mean known depth; without depth, the largest distance of a camera
    /// from their centroid.
    pub fn mean_depth(&self, frames: &[&TruthFrame]) -> Result<f64> {
        let mut means = Vec::new();
        for frame in frames {
            let Some(depth) = self.depth(frame)? else { continue };
            let known: Vec<f64> = depth.data.iter().filter(|&&z| z > 0.0).map(|&z| z as f64).collect();
            if !known.is_empty() {
                means.push(known.iter().sum::<f64>() / known.len() as f64);
            }
        }
        if !means.is_empty() {
            return Ok(means.iter().sum::<f64>() / means.len() as f64);
        }
        let centres: Vec<DVec3> = frames.iter().map(|f| f.camera.pose.centre()).collect();
        let mean = centres.iter().sum::<DVec3>() / centres.len().max(1) as f64;
        Ok(centres.iter().map(|c| (*c - mean).length()).fold(0.0, f64::max).max(f64::MIN_POSITIVE))
    }
}

/// Resamples by nearest pixel.
fn resampled(plane: &Image<u32>, width: usize, height: usize) -> Image<u32> {
    if (plane.width, plane.height) == (width, height) || plane.data.is_empty() {
        return plane.clone();
    }
    let pixel = |p: usize| {
        let (x, y) = (p % width, p / width);
        plane.at(nearest_index(x, width, plane.width), nearest_index(y, height, plane.height))
    };
    Image { width, height, data: (0..width * height).map(pixel).collect() }
}

/// Index along an axis of `from` pixels under the centre of pixel `k` of `to`.
fn nearest_index(k: usize, to: usize, from: usize) -> usize {
    ((2 * k + 1) * from / (2 * to)).min(from - 1)
}

fn open(path: &Path) -> Result<image::DynamicImage> {
    photo::stored_pixels(path)
}
