//! The photos of a run: found, chosen, and read at working size.
use super::base::BaseScene;
use super::plan::RunPlan;
use crate::format::{CameraFile, cameras};
use crate::gpu::Device;
use crate::photo::{self, Candidate, MaskChoice, Photo};
use crate::pose::choose::{self, Choice};
use crate::progress::Progress;
use crate::{Error, Result, files};
use std::path::{Path, PathBuf};

/// Reads the photos of a plan, as many as requested; with `known` cameras only photos that have
/// one.
pub(super) fn load(
    plan: &RunPlan,
    known: Option<&CameraFile>,
    device: &Device,
    max_size: usize,
    progress: &dyn Progress,
) -> Result<(Vec<Photo>, Option<Choice>)> {
    let posed = known.map(|known| with_cameras(plan, known, progress)).transpose()?.flatten();
    let has_cameras = posed.is_some();
    let mut files = match posed {
        Some(files) => files,
        None => photo::gather(&plan.inputs.photos, progress)?,
    };
    if has_cameras {
        photo::assign_masks(&mut files, &masks(plan)?, progress)?;
    }
    let views = match plan.inputs.views {
        None if plan.config.language.is_none() => {
            let fitting = plan.config.most_photos(device, &photo::sizes_of(&files), max_size);
            let most = if has_cameras { fitting } else { photo::DEFAULT_VIEWS_WITHOUT_LANGUAGE };
            // Where not even two fit, the check below states the reason.
            Some(files.len().min(most.max(2)))
        }
        views => views,
    };
    let wanted = photo::photo_count(files.len(), views)?;
    let mut choice = None;
    if wanted < files.len() {
        let (chosen, made) = choose::choose(&files, wanted, progress)?;
        // A set of posed photos has more than the scene, which the record must state.
        if has_cameras {
            progress.warn(&made.message())
        } else {
            progress.inform(&made.message())
        }
        files = chosen.into_iter().map(|i| files[i].clone()).collect();
        choice = Some(made);
    }
    if !has_cameras {
        photo::assign_masks(&mut files, &masks(plan)?, progress)?;
    }
    plan.config.check_budget(device, &photo::sizes_of(&files), max_size)?;
    Ok((photo::load_each(&files, max_size, progress)?, choice))
}

/// Reads all named photos that join a scene.
pub(super) fn joining(
    plan: &RunPlan,
    base: &BaseScene,
    device: &Device,
    max_size: usize,
    progress: &dyn Progress,
) -> Result<Vec<Photo>> {
    let found = photo::find(&plan.inputs.photos)?;
    if let Some(video) = found.videos.first() {
        return Err(Error::input(format!(
            "{}: a video; --add takes photos, for a video make a scene of its own",
            video.display()
        )));
    }
    found.warnings().iter().for_each(|w| progress.warn(w));
    found.photos.iter().try_for_each(|p| photo::check_name(p))?;
    let mut files: Vec<Candidate> = found.photos.iter().map(|p| Candidate::file(p)).collect();
    photo::assign_masks(&mut files, &masks(plan)?, progress)?;
    // The default size is that of the scene's photos: finer ones would be shown no better.
    let sides = base.known.photos.iter().map(|p| p.image.width.max(p.image.height));
    let max_size = plan.config.training.max_size.or(sides.max()).unwrap_or(max_size);
    let sizes = base.known.photos.iter().map(|p| (p.image.width, p.image.height));
    let sizes: Vec<_> = sizes.chain(photo::sizes_of(&files)).collect();
    plan.config.check_budget(device, &sizes, max_size)?;
    progress.begin("photos", files.len() as u64);
    let mut photos = Vec::with_capacity(files.len());
    for file in &files {
        progress.check()?;
        photos.push(file.load(max_size, progress)?);
        progress.step(photos.len() as u64, "");
    }
    progress.end();
    photo::cut_bars(&mut photos, progress);
    let mut photos = base.without_known(photos, progress)?;
    photo::settle(&mut photos, &base.known.photos, progress);
    base.check(&photos)?;
    Ok(photos)
}

/// The file of `--init cameras:FILE`.
pub(super) fn camera_file(plan: &RunPlan) -> Option<&Path> {
    let init = &plan.config.geometry.init;
    init.argument.as_deref().filter(|_| init.name == "cameras")
}

/// Origin of the masks of the photos.
pub(super) fn masks(plan: &RunPlan) -> Result<MaskChoice> {
    cameras::masks(plan.inputs.photo_masks.as_deref(), camera_file(plan))
}

/// Photos with a camera in the input folder and in the folders below it that names of cameras
/// contain; `None` for videos, whose frames get names when they are read.
pub(super) fn with_cameras(
    plan: &RunPlan,
    known: &CameraFile,
    progress: &dyn Progress,
) -> Result<Option<Vec<Candidate>>> {
    let inputs = &plan.inputs.photos;
    let names: Vec<&str> = known.cameras.iter().map(|c| c.camera.name.as_str()).collect();
    let found = match inputs.as_slice() {
        [folder] if folder.is_dir() => photo::find_named(folder, &names)?,
        several => photo::find(several)?,
    };
    if !found.videos.is_empty() {
        return Ok(None);
    }
    found.warnings().iter().for_each(|w| progress.warn(w));
    let paths: Vec<String> = found.photos.iter().map(|p| p.to_string_lossy().into_owned()).collect();
    let file = camera_file(plan).unwrap_or(Path::new("")).display();
    let own = photo::join(&paths, &names).map_err(|e| Error::input(format!("{file}: {e}")))?;
    let (with, without): (Vec<_>, Vec<_>) = found.photos.iter().zip(own).partition(|(_, own)| own.is_some());
    let listing = |list: &[(&PathBuf, Option<usize>)]| {
        files::listed(&list.iter().map(|(p, _)| relative_path(p, inputs)).collect::<Vec<_>>())
    };
    if with.len() < 2 {
        return Err(Error::input(format!(
            "{}: {} of {} photos have a camera in {}, at least 2 are needed; the photos are {}, the cameras {}",
            files::listed(&inputs.iter().map(|p| p.display().to_string()).collect::<Vec<_>>()),
            with.len(),
            found.photos.len(),
            file,
            listing(&found.photos.iter().map(|p| (p, None)).collect::<Vec<_>>()),
            files::listed(&names)
        )));
    }
    if !without.is_empty() {
        progress.warn(&format!(
            "{} photos have no camera and are left out: {}",
            without.len(),
            listing(&without)
        ));
    }
    let paths: Vec<String> = with.iter().map(|(p, _)| p.to_string_lossy().into_owned()).collect();
    let stems = photo::stems_apart(&paths);
    let files = with.iter().zip(&stems).map(|((path, _), stem)| Candidate::named(path, stem));
    Ok(Some(files.collect()))
}

/// A path relative to its input folder.
fn relative_path(path: &Path, inputs: &[PathBuf]) -> String {
    let below = inputs.iter().find_map(|folder| path.strip_prefix(folder).ok());
    below.filter(|p| !p.as_os_str().is_empty()).unwrap_or(path).display().to_string()
}
