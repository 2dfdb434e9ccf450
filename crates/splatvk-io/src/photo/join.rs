//! Assignment of a file's cameras to photos: the one rule for it.
use super::kind::stem;
use std::collections::HashMap;
use unicode_normalization::UnicodeNormalization;

/// A name in normal form for comparison: folders separated by "/", composed letters (macOS
/// decomposes accents), no surrounding blanks.
pub fn plain_name(name: &str) -> String {
    let composed: String = name.trim().nfc().collect();
    let parts = composed.split(['/', '\\']).filter(|p| !p.is_empty() && *p != ".");
    parts.collect::<Vec<_>>().join("/")
}

struct Name {
    folders: Vec<String>,
    file: String,
    stem: String,
}

impl Name {
    fn new(name: &str) -> Name {
        let mut parts: Vec<String> = plain_name(name).split('/').map(str::to_owned).collect();
        let file = parts.pop().unwrap_or_default();
        Name { stem: stem(&file).to_owned(), folders: parts, file }
    }

    /// Number of equal folders, counted from the last one.
    fn shared_folders(&self, folders: &[String]) -> usize {
        self.folders.iter().rev().zip(folders.iter().rev()).take_while(|(a, b)| a == b).count()
    }

    /// Agreement of the file names: 4 equal, 3 except the case of the extension, 2 except the
    /// extension, 1 except the case; 0 = different.
    fn agreement(&self, other: &Name) -> u8 {
        if self.file == other.file {
            4
        } else if self.stem != other.stem {
            u8::from(self.key() == other.key())
        } else if self.file.eq_ignore_ascii_case(&other.file) {
            3
        } else {
            2
        }
    }

    fn key(&self) -> String {
        self.stem.to_lowercase()
    }

    /// The stem, prefixed by its last `count` folders.
    fn stem_with_folders(&self, count: usize) -> String {
        let skipped = self.folders.len().saturating_sub(count);
        let front = self.folders[skipped..].iter().filter(|f| *f != "..");
        front.chain([&self.stem]).cloned().collect::<Vec<_>>().join("_")
    }
}

/// Index of the camera of every photo, by the path of the photo and the camera's name in the file;
/// `None` where no camera fits. Of several, the one whose folders agree with the photo's path
/// furthest back from the file name, then the one whose file name agrees best. Where camera names
/// contain the photo's own folder, cameras of other folders do not fit.
///
/// # Errors
/// Two cameras that fit a photo equally, or two photos that fit a camera equally; the text names
/// them.
pub fn join(photos: &[impl AsRef<str>], cameras: &[impl AsRef<str>]) -> Result<Vec<Option<usize>>, String> {
    let keys: Vec<Name> = cameras.iter().map(|c| Name::new(c.as_ref())).collect();
    let mut by_stem: HashMap<String, Vec<usize>> = HashMap::new();
    keys.iter().enumerate().for_each(|(k, key)| by_stem.entry(key.key()).or_default().push(k));
    let mut folders: Vec<&[String]> = keys.iter().map(|k| k.folders.as_slice()).collect();
    folders.sort_unstable();
    folders.dedup();
    let best_fit = |photo: &Name| -> Result<Option<Fit>, [usize; 2]> {
        let own = folders.iter().map(|f| photo.shared_folders(f)).max().unwrap_or(0);
        let is_eligible =
            |k: &usize| keys[*k].folders.is_empty() || photo.shared_folders(&keys[*k].folders) == own;
        let mut fits: Vec<Fit> = by_stem
            .get(&photo.key())
            .into_iter()
            .flatten()
            .filter(|k| is_eligible(k))
            .map(|&camera| Fit {
                how: (photo.shared_folders(&keys[camera].folders), photo.agreement(&keys[camera])),
                camera,
            })
            .collect();
        fits.sort_by(|a, b| b.how.cmp(&a.how).then(a.camera.cmp(&b.camera)));
        match fits.as_slice() {
            [a, b, ..] if a.how == b.how => Err([a.camera, b.camera]),
            _ => Ok(fits.into_iter().next()),
        }
    };
    let mut found: Vec<Option<Fit>> = Vec::with_capacity(photos.len());
    for photo in photos {
        let fit = best_fit(&Name::new(photo.as_ref())).map_err(|[a, b]| {
            format!(
                "{}: the cameras {:?} and {:?} both may be its own; give the photos in folders of the names that the camera file \
                 has, or rename one",
                photo.as_ref(),
                cameras[a].as_ref(),
                cameras[b].as_ref()
            )
        })?;
        found.push(fit);
    }
    // A camera has one photo: the one that fits better.
    for j in 0..found.len() {
        for i in 0..j {
            let (Some(a), Some(b)) = (found[i], found[j]) else { continue };
            if a.camera == b.camera {
                match a.how.cmp(&b.how) {
                    std::cmp::Ordering::Less => found[i] = None,
                    std::cmp::Ordering::Greater => found[j] = None,
                    std::cmp::Ordering::Equal => {
                        return Err(format!(
                            "{} and {}: the camera {:?} may be that of either; leave one out or rename it",
                            photos[i].as_ref(),
                            photos[j].as_ref(),
                            cameras[a.camera].as_ref()
                        ));
                    }
                }
            }
        }
    }
    Ok(found.into_iter().map(|fit| fit.map(|f| f.camera)).collect())
}

/// A camera that may belong to a photo, and its fit: shared folders, then the agreement of the file
/// names.
#[derive(Clone, Copy)]
struct Fit {
    how: (usize, u8),
    camera: usize,
}

/// A unique name for each file: its stem, prefixed by as many folders as needed.
pub fn stems_apart(names: &[impl AsRef<str>]) -> Vec<String> {
    let all: Vec<Name> = names.iter().map(|n| Name::new(n.as_ref())).collect();
    let mut stems: Vec<String> = all.iter().map(|n| n.stem.clone()).collect();
    let deepest = all.iter().map(|n| n.folders.len()).max().unwrap_or(0);
    for folders in 1..=deepest {
        let mut count: HashMap<&str, usize> = HashMap::new();
        stems.iter().for_each(|s| *count.entry(s).or_default() += 1);
        let twice: Vec<bool> = stems.iter().map(|s| count[s.as_str()] > 1).collect();
        if !twice.contains(&true) {
            break;
        }
        for ((stem, name), twice) in stems.iter_mut().zip(&all).zip(twice) {
            if twice {
                *stem = name.stem_with_folders(folders);
            }
        }
    }
    stems
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn join_matches_path_and_name() {
        let rig = ["cam1/0001.jpg", "cam2/0001.jpg", "cam2/0002.jpg"];
        assert_eq!(join(&["/data/rig/cam2/0001.jpg"], &rig), Ok(vec![Some(1)]));
        assert_eq!(join(&["cam1/0001.png", "cam2\\0001.JPG"], &rig), Ok(vec![Some(0), Some(1)]));
        // The cameras contain this folder: a photo of it gets no camera of another folder.
        assert_eq!(join(&["x/cam1/0002.jpg"], &rig), Ok(vec![None]));
        // Otherwise a unique name is sufficient.
        assert_eq!(join(&["small/0002.jpg"], &rig), Ok(vec![Some(2)]));
        assert_eq!(join(&["images/a.jpg"], &["a.jpg", "images/b.jpg"]), Ok(vec![Some(0)]));
        // The longer of two paths that both end the photo's path.
        assert_eq!(join(&["r/left/images/a.jpg"], &["images/a.jpg", "left/images/a.jpg"]), Ok(vec![Some(1)]));
        let e = join(&["small/0001.jpg"], &rig).unwrap_err();
        assert!(
            e.contains("small/0001.jpg") && e.contains("cam1/0001.jpg") && e.contains("cam2/0001.jpg"),
            "{e}"
        );
        let e = join(&["a/0001.jpg", "b/0001.jpg"], &["0001.jpg"]).unwrap_err();
        assert!(e.contains("a/0001.jpg") && e.contains("b/0001.jpg"), "{e}");
        assert_eq!(join(&["cam1/0001.jpg", "cam9/0001.jpg"], &["cam1/0001.jpg"]), Ok(vec![Some(0), None]));
    }

    #[test]
    fn names_agree_beyond_their_spelling() {
        let camera = |photo: &str, cameras: &[&str]| join(&[photo], cameras).map(|found| found[0]);
        for (photo, name) in [
            ("a.JPG", "a.jpg"),
            ("a.png", "a.jpg"),
            ("IMG_1.jpg", "img_1.JPG"),
            ("r_0.png", "./train/r_0"),
            // The same letter, composed and decomposed.
            ("cafe\u{301}.jpg", "caf\u{e9}.jpg"),
        ] {
            assert_eq!(camera(photo, &[name]), Ok(Some(0)), "{photo} {name}");
        }
        assert_eq!(camera("a.jpg", &["a.png", "a.JPG", "a.jpg"]), Ok(Some(2)));
        assert!(camera("a.heic", &["a.png", "a.jpg"]).is_err());
        assert_eq!(camera("b.jpg", &["a.jpg"]), Ok(None));
    }

    #[test]
    fn stems_apart_adds_folders() {
        assert_eq!(stems_apart(&["x/a.jpg", "y/b.jpg"]), ["a", "b"]);
        assert_eq!(stems_apart(&["r/cam1/1.jpg", "r/cam2/1.jpg", "2.jpg"]), ["cam1_1", "cam2_1", "2"]);
        assert_eq!(stems_apart(&["l/images/1.jpg", "r/images/1.jpg"]), ["l_images_1", "r_images_1"]);
    }
}
