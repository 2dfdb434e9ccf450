//! Queries answered by a network that finds a text in the photos (SAM 3) instead of by the scene's
//! language: its masks of all photos are lifted onto the splats
//! (docs/use/models.md#a-network-that-looks-at-the-photos).
use super::answer::{self, Answers};
use super::view::BlendedValues;
use crate::files;
use crate::fit::{PhotoMasks, lift_masks};
use crate::format::scene_dir::Scene;
use crate::format::scene_photos;
use crate::gpu::Device;
use crate::infer::concepts::{Concepts, Detections};
use crate::pass::RenderedFrame;
use crate::pass::renderer::Renderer;
use crate::photo::{self, Photo};
use crate::progress::Progress;
use crate::query::QueryResult;
use crate::query::highlight::Highlight;
use crate::query::instances::Places;
use crate::query::phrasing::Reading;
use crate::query::presence::Presence;
use crate::query::select::Selection;
use crate::scene::resize::Kernel;
use crate::scene::{Camera, Image, LanguageField, Splats};
use crate::{Error, Result};
use serde::Serialize;
use serde_json::{Value, json};
use std::path::Path;

/// Least value of a selected splat, and of a pixel of a mask: more of it lies inside the masks of
/// the photos than outside.
const INSIDE: f32 = 0.5;

/// Least IoU of the network's mask of a photo and the lifted one that counts as agreement.
const AGREES: f64 = 0.5;

/// Largest relative difference of the aspect ratios of a photo and its camera: rounding to whole
/// pixels.
const SAME_ASPECT: f64 = 0.01;

/// Findings of a network in the photos of a scene.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ConceptFindings {
    /// Name of the network.
    pub network: String,
    /// One per photo.
    pub photos: Vec<PhotoFinding>,
}

/// Findings of a network in one photo.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PhotoFinding {
    /// Stem of the photo.
    pub photo: String,
    /// Scores of the instances, best first.
    pub instances: Vec<f32>,
    /// Best score of all candidates, 0 to 1.
    pub score: f32,
    /// IoU of the network's mask and the one that the splats show from the photo's camera; `None`
    /// where both are empty.
    pub iou: Option<f64>,
}

impl ConceptFindings {
    /// Number of photos with an instance.
    pub fn found(&self) -> usize {
        self.photos.iter().filter(|p| !p.instances.is_empty()).count()
    }

    /// Stems of the photos in which the network and the splats disagree.
    pub fn disagreeing(&self) -> Vec<&str> {
        let apart = self.photos.iter().filter(|p| p.iou.is_some_and(|iou| iou < AGREES));
        apart.map(|p| p.photo.as_str()).collect()
    }

    /// Note for the user.
    pub fn note(&self) -> String {
        let (network, found, all) = (&self.network, self.found(), self.photos.len());
        let note = format!("{network} finds it in {found} of {all} photos");
        match self.disagreeing().as_slice() {
            [] => note,
            apart => {
                format!("{note}; the splats show another mask than {network} in {}", files::listed(apart))
            }
        }
    }

    /// Record of the findings, as in `query --json`.
    pub fn record(&self) -> Value {
        json!({
            "network": self.network, "found": self.found(), "disagreeing": self.disagreeing(), "photos": self.photos,
        })
    }

    /// Mean IoU over the photos; `None` if all masks are empty.
    fn agreement(&self) -> Option<f64> {
        let known: Vec<f64> = self.photos.iter().filter_map(|p| p.iou).collect();
        (!known.is_empty()).then(|| known.iter().sum::<f64>() / known.len() as f64)
    }
}

/// A text after the network looked at all photos.
struct Lifted {
    text: String,
    /// [N] value of every splat, in 0..1.
    values: Vec<f32>,
    findings: ConceptFindings,
}

/// A scene on the device with the lifted masks of some texts.
pub struct ConceptScene {
    device: Device,
    splats: Splats,
    places: Places,
    texts: Vec<Lifted>,
    renderer: Renderer,
    cameras: Vec<Camera>,
    frames: Vec<RenderedFrame>,
}

impl ConceptScene {
    /// Asks the network for `texts` in every photo, and lifts its masks onto the splats. Every
    /// photo has a camera of its size.
    pub fn open(
        device: &Device,
        splats: Splats,
        (cameras, photos): (&[Camera], &[Photo]),
        network: &mut Concepts,
        texts: &[String],
        progress: &dyn Progress,
    ) -> Result<ConceptScene> {
        let asked: Vec<&str> = texts.iter().map(String::as_str).collect();
        progress.begin("concepts", photos.len() as u64);
        let (mut masks, mut found) = (Vec::with_capacity(photos.len()), Vec::with_capacity(photos.len()));
        for (done, photo) in photos.iter().enumerate() {
            progress.check()?;
            let detections = network.find(&photo.image, &asked)?;
            let (width, height) = (photo.image.width, photo.image.height);
            masks.push(detections.iter().map(|d| d.mask(width, height)).collect::<Vec<_>>());
            found.push(detections.iter().map(|d| finding(&photo.stem, d)).collect::<Vec<_>>());
            progress.step(done as u64 + 1, &photo.stem);
        }
        progress.end();
        let of_photos: Vec<PhotoMasks> = masks
            .iter()
            .zip(photos)
            .map(|(masks, photo)| PhotoMasks { masks, coverage: photo.coverage.as_ref() })
            .collect();
        let lifted = lift_masks(device, cameras, &splats, &of_photos, progress)?;
        let mut all = Vec::with_capacity(texts.len());
        for (k, (text, values)) in texts.iter().zip(lifted).enumerate() {
            let mut shown = BlendedValues::new(device, &splats, &values)?;
            let mut photos: Vec<PhotoFinding> = found.iter().map(|f| f[k].clone()).collect();
            for ((finding, camera), masks) in photos.iter_mut().zip(cameras).zip(&masks) {
                progress.check()?;
                finding.iou = iou(&shown.view(camera)?, &masks[k]);
            }
            let findings = ConceptFindings { network: network.name().to_owned(), photos };
            all.push(Lifted { text: text.clone(), values, findings });
        }
        Ok(ConceptScene {
            device: device.clone(),
            places: Places::of(&splats, &LanguageField::default()),
            renderer: Renderer::new(device, &splats, &[], 0)?,
            splats,
            texts: all,
            cameras: Vec::new(),
            frames: Vec::new(),
        })
    }

    /// Renders the cameras of later queries.
    pub fn set_views(&mut self, cameras: &[Camera]) -> Result<()> {
        self.frames = cameras.iter().map(|c| self.renderer.render(c)).collect::<Result<_>>()?;
        self.cameras = cameras.to_vec();
        Ok(())
    }

    /// The frames of the last [`ConceptScene::set_views`].
    pub fn frames(&self) -> &[RenderedFrame] {
        &self.frames
    }

    /// The scene's splats.
    pub fn splats(&self) -> &Splats {
        &self.splats
    }

    /// Answers one of the texts of [`ConceptScene::open`] in every frame.
    pub fn ask(&self, text: &str) -> Result<Answers> {
        let Some(lifted) = self.texts.iter().find(|t| t.text == text) else {
            return Err(Error::work(format!("text {text:?} was not looked for in the photos")));
        };
        let is_present = lifted.findings.found() > 0;
        let mut selection = Selection::default();
        if is_present {
            selection.splats = (0..lifted.values.len()).filter(|&i| lifted.values[i] >= INSIDE).collect();
        }
        selection.found = !selection.splats.is_empty();
        selection.score = lifted.values.iter().copied().fold(0.0, f32::max);
        let mut shown = BlendedValues::new(&self.device, &self.splats, &lifted.values)?;
        let mut views = Vec::with_capacity(self.cameras.len());
        for camera in &self.cameras {
            let mut view = QueryResult::of_values(shown.view(camera)?, INSIDE);
            if !selection.found || !view.found {
                view.mark_not_found();
            }
            views.push(view);
        }
        let frames: Vec<&RenderedFrame> = self.frames.iter().collect();
        let (instances, view_reliability) =
            answer::things(&self.places, &selection, (&self.cameras, &frames));
        Ok(Answers {
            text: text.to_owned(),
            reading: Reading::default(),
            views,
            presence: Some(if is_present { Presence::Found } else { Presence::Absent }),
            p_value: None,
            reliability: if is_present { lifted.findings.agreement() } else { None },
            view_reliability,
            selection,
            instances,
            highlight: Highlight::default(),
            published: false,
            concepts: Some(lifted.findings.clone()),
        })
    }
}

fn finding(photo: &str, found: &Detections) -> PhotoFinding {
    let instances = found.instances.iter().map(|i| i.score).collect();
    PhotoFinding { photo: photo.to_owned(), instances, score: found.best, iou: None }
}

/// IoU of the pixels with at least [`INSIDE`] and a mask; `None` where both are empty.
fn iou(values: &Image<f32>, mask: &Image<bool>) -> Option<f64> {
    let pairs = values.data.iter().zip(&mask.data);
    let (mut both, mut either) = (0usize, 0usize);
    for (shown, masked) in pairs.map(|(v, m)| (*v >= INSIDE, *m)) {
        both += usize::from(shown && masked);
        either += usize::from(shown || masked);
    }
    (either > 0).then(|| both as f64 / either as f64)
}

/// The photos of a scene, each with its camera: those of the scene directory, or the files of a
/// folder that are named like `cameras`.
pub fn photos(
    scene: &Scene,
    cameras: &[Camera],
    folder: Option<&Path>,
    progress: &dyn Progress,
) -> Result<(Vec<Camera>, Vec<Photo>)> {
    if let Some(folder) = folder {
        return named_photos(cameras, folder, progress);
    }
    if scene.path.is_file() {
        return Err(Error::input(format!(
            "{}: a file of Gaussians has no photos, which --concepts asks the network about; add --photos DIR",
            scene.path.display()
        )));
    }
    let photos = scene_photos::load(&scene.path).map_err(|e| {
        Error::input(format!("{e}; or give the folder of its undistorted photos: --photos DIR"))
    })?;
    if photos.len() != scene.cameras.len() {
        return Err(Error::input(format!(
            "{}: {} cameras and {} photos; the scene is damaged, run again",
            scene.path.display(),
            scene.cameras.len(),
            photos.len()
        )));
    }
    Ok((scene.cameras.clone(), photos))
}

/// Photos of a folder with the names of cameras, at the sizes of the cameras.
fn named_photos(
    cameras: &[Camera],
    folder: &Path,
    progress: &dyn Progress,
) -> Result<(Vec<Camera>, Vec<Photo>)> {
    let names: Vec<&str> = cameras.iter().map(|c| c.name.as_str()).collect();
    let files = photo::find_named(folder, &names)?.photos;
    let paths: Vec<String> = files.iter().map(|p| p.to_string_lossy().into_owned()).collect();
    let own = photo::join(&paths, &names).map_err(|e| Error::input(format!("{}: {e}", folder.display())))?;
    let mut found: Vec<(usize, &Path)> =
        own.iter().zip(&files).filter_map(|(camera, file)| Some(((*camera)?, file.as_path()))).collect();
    found.sort();
    if found.is_empty() {
        return Err(Error::input(format!(
            "{}: no photo has the name of a camera of the scene ({})",
            folder.display(),
            files::listed(&names)
        )));
    }
    if found.len() < cameras.len() {
        progress.warn(&format!(
            "{} of {} cameras have no photo there",
            cameras.len() - found.len(),
            cameras.len()
        ));
    }
    let photos = found.iter().map(|(k, file)| sized_photo(file, &cameras[*k])).collect::<Result<_>>()?;
    Ok((found.iter().map(|(k, _)| cameras[*k].clone()).collect(), photos))
}

/// A photo at the size of its camera.
fn sized_photo(file: &Path, camera: &Camera) -> Result<Photo> {
    let mut photo = photo::load(file)?;
    let (width, height) = (camera.width as usize, camera.height as usize);
    let aspect = (photo.image.width * height) as f64 / (photo.image.height * width) as f64;
    if (aspect - 1.0).abs() > SAME_ASPECT {
        return Err(Error::input(format!(
            "{}: {} × {} pixels, its camera has {width} × {height}; give the undistorted, uncropped photo",
            file.display(),
            photo.image.width,
            photo.image.height
        )));
    }
    photo.image = photo.image.resized(width, height, Kernel::Triangle);
    photo.coverage = None;
    Ok(photo)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn finding(photo: &str, instances: &[f32], iou: Option<f64>) -> PhotoFinding {
        PhotoFinding { photo: photo.into(), instances: instances.to_vec(), score: 0.4, iou }
    }

    #[test]
    fn note_names_disagreeing_photos() {
        let photos =
            vec![finding("a", &[0.9], Some(0.8)), finding("b", &[], Some(0.2)), finding("c", &[], None)];
        let findings = ConceptFindings { network: "sam3".into(), photos };
        assert_eq!(
            (findings.found(), findings.disagreeing(), findings.agreement()),
            (1, vec!["b"], Some(0.5))
        );
        assert_eq!(
            findings.note(),
            "sam3 finds it in 1 of 3 photos; the splats show another mask than sam3 in b"
        );
    }

    #[test]
    fn iou_of_masks() {
        let values = Image { width: 4, height: 1, data: vec![0.9, 0.5, 0.4, 0.0] };
        let mask = |data: [bool; 4]| Image { width: 4, height: 1, data: data.to_vec() };
        assert_eq!(iou(&values, &mask([true, false, true, false])), Some(1.0 / 3.0));
        assert_eq!(iou(&Image::filled(4, 1, 0.0), &mask([false; 4])), None);
    }
}
