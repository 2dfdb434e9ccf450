//! Assignment of masks to photos.
use super::candidate::Candidate;
use super::kind::stem;
use super::mask::Mask;
use crate::progress::Progress;
use crate::{Error, Result};
use std::path::{Path, PathBuf};

/// Sources of masks.
#[derive(Clone, Debug, Default)]
pub struct MaskChoice {
    /// Folder of masks, instead of one beside the folder of photos.
    pub folder: Option<PathBuf>,
    /// Masks that a camera file names, by the name of the frame.
    pub named: Vec<(String, PathBuf)>,
}

impl MaskChoice {
    /// Mask of the frame with the photo's path, or else of the only frame with its stem.
    fn named_for(&self, photo: &Path) -> Option<&PathBuf> {
        let own = photo.file_name()?.to_string_lossy();
        let whole = self.named.iter().find(|(frame, _)| photo.ends_with(frame.trim_start_matches("./")));
        let mut alike = self.named.iter().filter(|(frame, _)| stem(frame) == stem(&own));
        let only = alike.next().filter(|_| alike.next().is_none());
        whole.or(only).map(|(_, mask)| mask)
    }
}

/// Assigns masks to photos and reports which photos have one.
pub fn assign(photos: &mut [Candidate], choice: &MaskChoice, progress: &dyn Progress) -> Result<()> {
    if let Some(folder) = choice.folder.as_ref().filter(|f| !f.is_dir()) {
        return Err(Error::input(format!(
            "{}: is not a folder; give one with a mask per photo",
            folder.display()
        )));
    }
    let mut unmatched: Option<PathBuf> = None;
    for photo in photos.iter_mut().filter(|p| p.is_file()) {
        photo.mask = choice.named_for(&photo.path).cloned();
        if photo.mask.is_some() {
            continue;
        }
        let beside = choice.folder.clone().or_else(|| folder_beside(&photo.path));
        let Some(folder) = beside else { continue };
        photo.mask = in_folder(&folder, &photo.path);
        match &photo.mask {
            Some(mask) if choice.folder.is_none() && Mask::read(mask)?.is_labels => {
                progress.warn(&format!(
                    "{} in {}: has more than black and one other value, so it is not used as a mask of {}; --photo-masks with that folder \
                     uses all that is not black",
                    file_name(mask),
                    file_name(&folder),
                    photo.name()
                ));
                photo.mask = None;
            }
            Some(_) => {}
            None => unmatched = Some(folder),
        }
    }
    report(photos, choice, unmatched, progress)
}

fn report(
    photos: &[Candidate],
    choice: &MaskChoice,
    unmatched: Option<PathBuf>,
    progress: &dyn Progress,
) -> Result<()> {
    let with = photos.iter().filter(|p| p.mask.is_some()).count();
    let Some(folder) = unmatched else {
        if with > 0 && choice.folder.is_none() && choice.named.is_empty() {
            progress.warn(&format!("the masks beside {with} photos are used: what is black there is not"));
        }
        return Ok(());
    };
    // Warnings are stored in scenes, which are passed on: a folder that the user did not type is
    // named without its parents.
    let named = match &choice.folder {
        Some(typed) => typed.display().to_string(),
        None => file_name(&folder),
    };
    let example =
        photos.iter().find(|p| p.is_file() && p.mask.is_none()).map(Candidate::name).unwrap_or_default();
    if with == 0 {
        let expected = format!("{}.png or {example}.png", stem(&example));
        let text = format!("{named}: no mask is named as a photo ({expected})");
        return match choice.folder {
            Some(_) => Err(Error::input(format!("{text}; rename them"))),
            None => {
                progress.warn(&format!("{text}; none is used"));
                Ok(())
            }
        };
    }
    let without: Vec<String> = photos.iter().filter(|p| p.mask.is_none()).map(Candidate::name).collect();
    progress.warn(&format!(
        "{named}: masks of {with} of {} photos are used; there is none for {}, all of whose pixels are used",
        photos.len(),
        without.join(", ")
    ));
    Ok(())
}

fn file_name(path: &Path) -> String {
    path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default()
}

/// Folder of images that contains a photo directly or further below, and the path from it to the
/// photo's folder.
fn image_folder(photo: &Path) -> Option<(&Path, &Path)> {
    let folder = photo.parent()?;
    let is_images = |f: &&Path| {
        let name = f.file_name().and_then(|n| n.to_str()).unwrap_or("");
        name.starts_with("images") || name == "input"
    };
    let root = folder.ancestors().take(DEEPEST).find(is_images)?;
    Some((root, folder.strip_prefix(root).ok()?))
}

/// Folders between a photo and `images`: one per camera of a rig, and one of the camera itself.
const DEEPEST: usize = 3;

/// Mask folder of a photo: `masks` beside `images`, `masks_2` beside `images_2`. Beside the ground
/// truth of `splatlab generate` it contains labels, and is ignored.
fn folder_beside(photo: &Path) -> Option<PathBuf> {
    let (images, _) = image_folder(photo)?;
    let name = images.file_name()?.to_str()?;
    let root = images.parent()?;
    let there = [root.join(name.replacen("images", "masks", 1)), root.join("masks")];
    there.into_iter().find(|m| m != images && m.is_dir() && !root.join("ground_truth.json").exists())
}

/// Mask file of a photo: `x.jpg.png` (COLMAP), or `x` with its own extension (nerfstudio); for a
/// photo in a camera's folder, in the folder of the same name if there is one.
fn in_folder(folder: &Path, photo: &Path) -> Option<PathBuf> {
    let below = image_folder(photo).map(|(_, below)| folder.join(below)).filter(|f| f.is_dir());
    let folder = below.unwrap_or_else(|| folder.to_path_buf());
    let name = photo.file_name()?.to_string_lossy();
    let (name, own) = (&*name, stem(&name));
    let names = [name, own]
        .into_iter()
        .flat_map(|n| ["png", "jpg", "jpeg", "PNG", "JPG"].map(|e| format!("{n}.{e}")));
    names.map(|n| folder.join(n)).find(|p| p.is_file())
}
