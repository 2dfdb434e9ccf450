//! A scene that more photos are added to: what it is, and what it was made with.
use super::record::{self, RunRecord};
use crate::files;
use crate::format::{colmap, scene_dir, scene_photos};
use crate::photo::{self, Photo};
use crate::pose::KnownPhotos;
use crate::progress::Progress;
use crate::scene::{Camera, LanguageField, PointCloud, Seen, Splats, World};
use crate::{Error, Result};
use std::path::Path;

/// What `--add` takes, for errors.
const ADDABLE: &str = "--add takes a scene that splatvk run wrote";

/// The record of a scene that photos can be added to.
pub fn record_of(scene: &Path) -> Result<RunRecord> {
    let record = record::read(scene, ADDABLE)?;
    let file = scene.join("run.json");
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

/// A scene that goes on.
#[derive(Clone, Debug)]
pub struct BaseScene {
    /// Its photos with their cameras.
    pub known: KnownPhotos,
    /// Its splats, all of them.
    pub splats: Splats,
    /// What the photos show of them; nothing in scenes of earlier versions.
    pub seen: Seen,
    /// How it lies in the world.
    pub world: World,
    /// Codes and features.
    pub field: LanguageField,
    /// Points of its surfaces.
    pub points: PointCloud,
    /// A checksum of all this, for [`crate::pipeline::Stage::settings`].
    pub identity: String,
}

impl BaseScene {
    /// Reads a scene directory that `splatvk run` wrote.
    pub fn open(path: &Path) -> Result<BaseScene> {
        let record = record_of(path)?;
        let photos = scene_photos::load(path)?;
        let scene = scene_dir::load(path)?;
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
        let named = |(camera, photo): (Camera, &Photo)| {
            let name =
                photo.path.file_name().map_or_else(|| photo.stem.clone(), |n| n.to_string_lossy().into());
            Camera { name, ..camera }
        };
        let cameras = scene.cameras.into_iter().zip(&photos).map(named).collect();
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

    /// The photos that are not in the scene yet; those that are go with a warning.
    pub fn without_its_own(&self, new: Vec<Photo>, progress: &dyn Progress) -> Result<Vec<Photo>> {
        let known = |p: &Photo| self.known.photos.iter().any(|k| k.stem == p.stem && likeness(k, p) > SAME);
        let (there, new): (Vec<Photo>, Vec<Photo>) = new.into_iter().partition(known);
        let names: Vec<&str> = there.iter().map(|p| p.stem.as_str()).collect();
        let words = if names.len() == 1 { "is" } else { "are" };
        let said = format!("{} {words} in the scene already", files::listed(&names));
        match (there.is_empty(), new.is_empty()) {
            (true, _) => Ok(new),
            (false, true) => Err(Error::input(format!("{said}; give photos that are not"))),
            (false, false) => {
                progress.warn(&format!("{said} and left out"));
                Ok(new)
            }
        }
    }

    /// Refuses photos that cannot be added: too many, or under a name that the scene has.
    pub fn check(&self, new: &[Photo]) -> Result<()> {
        let all: Vec<Photo> = self.known.photos.iter().chain(new).cloned().collect();
        if all.len() > photo::MAX_VIEWS {
            return Err(Error::input(format!(
                "{} photos in the scene and {} more; a scene has at most {}",
                self.known.photos.len(),
                new.len(),
                photo::MAX_VIEWS
            )));
        }
        // Those of the scene have lost their lens and their light: what tells that a photo is the
        // same is its name.
        let known = |p: &Photo| self.known.photos.iter().any(|k| k.stem == p.stem);
        if let Some(again) = new.iter().find(|p| known(p)) {
            return Err(Error::input(format!(
                "{}: a photo of the name \"{}\" is in the scene already; leave it out, or rename it if it is another one",
                again.path.display(),
                again.stem
            )));
        }
        photo::check_set(&all)
    }
}

/// Side of the pictures that are compared: lens and light, which were taken out of one of them,
/// change little at this size.
const COMPARED: usize = 24;
/// Correlation of their brightness from which two photos of one name are one photo. On `breakfast`
/// a photo and itself through a lens (k1 −0.12, k2 0.03) and gains of 0.6 to 0.75 reach 0.994,
/// different photos at most 0.51.
const SAME: f64 = 0.95;

fn likeness(a: &Photo, b: &Photo) -> f64 {
    let small = |p: &Photo| p.image.resized_by_area(COMPARED, COMPARED).luma().data;
    let (a, b) = (small(a), small(b));
    let mean = |v: &[f32]| v.iter().copied().map(f64::from).sum::<f64>() / v.len() as f64;
    let (ma, mb) = (mean(&a), mean(&b));
    let (mut ab, mut aa, mut bb) = (0.0, 0.0, 0.0);
    for (x, y) in a.iter().zip(&b) {
        let (x, y) = (f64::from(*x) - ma, f64::from(*y) - mb);
        (ab, aa, bb) = (ab + x * y, aa + x * x, bb + y * y);
    }
    ab / (aa * bb).sqrt().max(f64::MIN_POSITIVE)
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
    fn photos_of_the_scene_are_known_again() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/breakfast/images");
        let read = |k: usize| photo::load(&folder.join(format!("train_0{k}.jpg"))).unwrap();
        let photos = [0, 1, 2, 3].map(read);
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
        // As a scene keeps it: without lens, darker and with another white.
        let kept = |p: &Photo| {
            let mut p = p.clone();
            p.straighten(Lens::radial(-0.12, 0.03), &camera);
            p.image.data.iter_mut().for_each(|c| *c = [0.6 * c[0], 0.7 * c[1], 0.75 * c[2]]);
            p
        };
        for (i, a) in photos.iter().enumerate() {
            for (j, b) in photos.iter().enumerate() {
                println!("{i} {j} {:.3}", likeness(&kept(a), b));
                assert_eq!(likeness(&kept(a), b) > SAME, i == j, "{i} {j}");
            }
        }
    }
}
