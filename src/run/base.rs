//! A scene that photos are added to, with the record of its run.
use super::record::{self, RunRecord};
use crate::files;
use crate::format::{colmap, scene_dir, scene_photos};
use crate::photo::{self, Photo};
use crate::pose::KnownPhotos;
use crate::progress::Progress;
use crate::scene::{Camera, LanguageField, PointCloud, Seen, Splats, World};
use crate::{Error, Result};
use std::path::Path;

/// Remedy in errors: scenes that `--add` accepts.
const ADDABLE: &str = "--add takes a scene that splatvk run wrote";

/// Reads the record of a scene, and refuses scenes that photos cannot be added to.
pub fn record_of(scene: &Path) -> Result<RunRecord> {
    let record = record::read(scene, ADDABLE)?;
    let file = scene.join("run.json");
    if record.config.plan.inputs.splats.is_some() {
        return Err(Error::input(format!(
            "{}: made by splatvk label; photos that join a scene train its splats, and those of another program stay as they are: label \
             the file again with all photos",
            scene.join("run.json").display()
        )));
    }
    let plan = &record.config.plan.config;
    match plan.language.as_ref().and_then(|l| l.method).map(|m| m.name) {
        Some("sparselgs" | "lift") => Ok(record),
        Some(method) => Err(Error::input(format!(
            "{}: made with --method {method}; photos can be added to scenes of --method sparselgs or lift",
            file.display()
        ))),
        None => Err(Error::input(format!(
            "{}: the scene has no language; {ADDABLE}, for splatvk train give all photos at once",
            file.display()
        ))),
    }
}

/// A scene that photos are added to.
#[derive(Clone, Debug)]
pub struct BaseScene {
    /// Photos with their cameras.
    pub known: KnownPhotos,
    /// All splats.
    pub splats: Splats,
    /// Blending weight of the splats in the photos; empty for scenes of earlier versions.
    pub seen: Seen,
    /// Direction up and scale.
    pub world: World,
    /// Codes and features.
    pub field: LanguageField,
    /// Surface points.
    pub points: PointCloud,
    /// Checksums of all this, for [`crate::pipeline::Stage::settings`].
    pub identity: String,
}

impl BaseScene {
    /// Reads a scene directory that `splatvk run` wrote, without its edits: the new photos may show
    /// more of deleted things.
    pub fn open(path: &Path) -> Result<BaseScene> {
        let record = record_of(path)?;
        let photos = scene_photos::load(path)?;
        let scene = scene_dir::load_unedited(path)?;
        let field = scene.language.ok_or_else(|| {
            Error::input(format!("{}: the scene has no language; make it with splatvk run", path.display()))
        })?;
        if photos.len() != scene.cameras.len() {
            return Err(Error::input(format!(
                "{}: {} photos and {} cameras; the scene is damaged, run again",
                path.display(),
                photos.len(),
                scene.cameras.len()
            )));
        }
        let cameras = scene.cameras.into_iter().zip(&photos);
        let cameras = cameras.map(|(camera, photo)| Camera { name: file_name(photo), ..camera }).collect();
        let fitted = photos.iter().map(|p| record.fitted(&p.stem)).collect();
        let points = colmap::read_points(&path.join("cameras/colmap"))?;
        Ok(BaseScene {
            identity: identity(path)?,
            known: KnownPhotos { photos, cameras, fitted },
            splats: scene.splats,
            seen: scene.seen,
            world: scene.world,
            field,
            points,
        })
    }

    /// Photos that are not in the scene yet; warns about the others and drops them.
    pub fn without_known(&self, new: Vec<Photo>, progress: &dyn Progress) -> Result<Vec<Photo>> {
        let is_known = |p: &Photo| self.known.photos.iter().any(|k| is_same(k, p));
        let (known, new): (Vec<Photo>, Vec<Photo>) = new.into_iter().partition(is_known);
        let names: Vec<&str> = known.iter().map(|p| p.stem.as_str()).collect();
        let verb = if names.len() == 1 { "is" } else { "are" };
        let notice = format!("{} {verb} in the scene already", files::listed(&names));
        match (known.is_empty(), new.is_empty()) {
            (true, _) => Ok(new),
            (false, true) => Err(Error::input(format!("{notice}; give photos that are not"))),
            (false, false) => {
                progress.warn(&format!("{notice} and left out"));
                Ok(new)
            }
        }
    }

    /// Refuses names that the scene already has.
    pub fn check(&self, new: &[Photo]) -> Result<()> {
        let all: Vec<Photo> = self.known.photos.iter().chain(new).cloned().collect();
        // Lens and light were taken out of the scene's photos, so the name identifies a photo.
        let is_known = |p: &&Photo| self.known.photos.iter().any(|k| k.stem == p.stem);
        if let Some(again) = new.iter().find(is_known) {
            return Err(Error::input(format!(
                "{}: a photo of the name \"{}\" is in the scene already; leave it out, or rename it if it is another one",
                again.path.display(),
                again.stem
            )));
        }
        photo::check_set(&all)
    }
}

/// Name of a photo's file; its stem if it has none.
fn file_name(photo: &Photo) -> String {
    photo.path.file_name().map_or_else(|| photo.stem.clone(), |n| n.to_string_lossy().into())
}

/// Whether name and content of two photos agree.
fn is_same(a: &Photo, b: &Photo) -> bool {
    a.stem == b.stem && luma_correlation(a, b) > SAME
}

/// Side of the compared thumbnails, pixels: lens and light, which were taken out of one of them,
/// change little at this size.
const COMPARED: usize = 24;
/// Luma correlation from which two photos of one name are the same photo. On `breakfast` a photo
/// and itself through a lens (k1 −0.12, k2 0.03) and gains of 0.6 to 0.75 reach 0.994, different
/// photos at most 0.51.
const SAME: f64 = 0.95;

/// Pearson correlation of the photos' luma thumbnails.
fn luma_correlation(a: &Photo, b: &Photo) -> f64 {
    correlation(&luma_thumbnail(a), &luma_thumbnail(b))
}

/// Pearson correlation of two lists of one length.
pub(super) fn correlation(a: &[f32], b: &[f32]) -> f64 {
    let (ma, mb) = (mean(a), mean(b));
    let (mut ab, mut aa, mut bb) = (0.0, 0.0, 0.0);
    for (x, y) in a.iter().zip(b) {
        let (x, y) = (f64::from(*x) - ma, f64::from(*y) - mb);
        (ab, aa, bb) = (ab + x * y, aa + x * x, bb + y * y);
    }
    ab / (aa * bb).sqrt().max(f64::MIN_POSITIVE)
}

fn luma_thumbnail(photo: &Photo) -> Vec<f32> {
    photo.image.resized_by_area(COMPARED, COMPARED).luma().data
}

fn mean(values: &[f32]) -> f64 {
    values.iter().copied().map(f64::from).sum::<f64>() / values.len() as f64
}

fn identity(path: &Path) -> Result<String> {
    let mut sums = Vec::new();
    for file in
        ["point_cloud.ply", "run.json", "scene.json", "cameras/transforms.json", "language/features.npz"]
    {
        let file = path.join(file);
        sums.push(files::content_hash(&file).map_err(Error::io(&file))?);
    }
    Ok(sums.join(" "))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::Lens;

    #[test]
    fn known_photos_are_recognised_after_correction() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/breakfast/images");
        let photos = [0, 1, 2, 3].map(|k| photo::load(&folder.join(format!("train_0{k}.jpg"))).unwrap());
        let camera = Camera {
            name: "a".into(),
            width: 640,
            height: 480,
            fx: 656.0,
            fy: 656.0,
            cx: 320.0,
            cy: 240.0,
            pose: crate::scene::Pose::IDENTITY,
        };
        // The scene's copy: without lens distortion, darker, with another white balance.
        let as_in_scene = |p: &Photo| {
            let mut p = p.clone();
            p.straighten(Lens::radial(-0.12, 0.03), &camera);
            p.image.data.iter_mut().for_each(|c| *c = [0.6 * c[0], 0.7 * c[1], 0.75 * c[2]]);
            p
        };
        for (i, a) in photos.iter().enumerate() {
            for (j, b) in photos.iter().enumerate() {
                let correlation = luma_correlation(&as_in_scene(a), b);
                println!("{i} {j} {correlation:.3}");
                assert_eq!(correlation > SAME, i == j, "{i} {j}");
            }
        }
    }
}
