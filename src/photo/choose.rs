//! Which files are the photos, and how many of them the run uses.
use super::kind::{READ, is_foreign_name, is_photo_name, is_video_name};
use crate::{Error, Result};
use std::path::{Path, PathBuf};

/// Largest number of views: the pair count grows with its square, and the method is made for a few photos.
pub const MAX_VIEWS: usize = 16;

/// Views used when more photos are given and `--views` is not (docs/method.md#choice-of-photos).
pub const DEFAULT_VIEWS: usize = 4;

/// The photos behind the inputs and what was left out of the folders.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct FoundFiles {
    /// Sorted by file name.
    pub photos: Vec<PathBuf>,
    /// Videos that were named, or that are all there is in the folders.
    pub videos: Vec<PathBuf>,
    /// Videos beside photos and images of other kinds in the folders, which nothing reads.
    pub ignored: Vec<PathBuf>,
}

/// Lists the photos of files and folders (not their subfolders), sorted by file name. A file that is named must exist; its
/// content is judged when it is read.
pub fn find(inputs: &[PathBuf]) -> Result<FoundFiles> {
    let mut found = FoundFiles::default();
    for input in inputs {
        let kind = std::fs::metadata(input).map_err(|e| {
            Error::input(format!("{}: {e}; give photo files or a folder of photos", input.display()))
        })?;
        if kind.is_dir() {
            list(input, &mut found)?;
        } else if is_video_name(input) {
            found.videos.push(input.clone());
        } else {
            found.photos.push(input.clone());
        }
    }
    if found.photos.is_empty() && found.videos.is_empty() {
        (found.videos, found.ignored) = found.ignored.into_iter().partition(|p| is_video_name(p));
    }
    let key = |p: &PathBuf| (p.file_name().map(|n| n.to_os_string()), p.clone());
    for list in [&mut found.photos, &mut found.videos, &mut found.ignored] {
        list.sort_by_key(key);
        list.dedup();
    }
    let place = inputs.iter().map(|p| p.display().to_string()).collect::<Vec<_>>().join(", ");
    match (found.photos.is_empty() && found.videos.is_empty(), found.ignored.first()) {
        (true, None) => Err(Error::input(format!(
            "{place}: no photos; give a folder with 2 to {MAX_VIEWS} photos ({READ}), or a video"
        ))),
        (true, Some(other)) => Err(Error::input(format!(
            "{}: this kind of image is not read and there are no photos beside it; save the photos as JPEG or PNG",
            other.display()
        ))),
        _ => Ok(found),
    }
}

fn list(folder: &Path, found: &mut FoundFiles) -> Result<()> {
    for entry in std::fs::read_dir(folder).map_err(Error::io(folder))? {
        let path = entry.map_err(Error::io(folder))?.path();
        let hidden = path.file_name().is_some_and(|n| n.to_string_lossy().starts_with('.'));
        if hidden || path.is_dir() {
            continue;
        }
        if is_photo_name(&path) {
            found.photos.push(path);
        } else if is_video_name(&path) || is_foreign_name(&path) {
            found.ignored.push(path);
        }
    }
    Ok(())
}

/// Indices of `views` of `count` frames: `linspace(0, count − 1, views)` truncated to whole numbers
/// (docs/method.md#choice-of-photos).
pub fn spread(count: usize, views: usize) -> Vec<usize> {
    (0..views).map(|i| if views > 1 { i * (count - 1) / (views - 1) } else { 0 }).collect()
}

/// How many of `count` photos a run uses. `views` is what the user asked for.
pub fn photo_count(count: usize, views: Option<usize>) -> Result<usize> {
    let wanted = views.unwrap_or(count.min(DEFAULT_VIEWS));
    if wanted < 2 {
        return Err(Error::input(format!("--views {wanted}: at least 2 views are needed, 3 or 4 work best")));
    }
    if wanted > count {
        return Err(Error::input(format!(
            "--views {wanted}: only {count} photos were given; add photos or lower --views"
        )));
    }
    if wanted > MAX_VIEWS {
        return Err(Error::input(format!(
            "--views {wanted}: at most {MAX_VIEWS} views are supported; lower --views"
        )));
    }
    Ok(wanted)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spread_is_a_truncated_linspace() {
        assert_eq!(spread(4, 4), [0, 1, 2, 3]);
        assert_eq!(spread(12, 4), [0, 3, 7, 11]);
        assert_eq!(spread(10, 3), [0, 4, 9]);
        for count in 2..40 {
            for views in 2..=count {
                let s = spread(count, views);
                assert!(
                    s.windows(2).all(|p| p[0] < p[1]) && s[views - 1] == count - 1,
                    "{count} {views}: {s:?}"
                );
            }
        }
    }

    #[test]
    fn view_counts_are_checked() {
        assert_eq!(photo_count(20, None).unwrap(), DEFAULT_VIEWS);
        assert_eq!(photo_count(3, None).unwrap(), 3);
        assert_eq!(photo_count(20, Some(6)).unwrap(), 6);
        for (n, views) in [(3, 4), (3, 1), (3, 0), (20, 17)] {
            let e = photo_count(n, Some(views)).unwrap_err();
            assert!(e.exit_code() == 2 && e.to_string().starts_with(&format!("--views {views}:")), "{e}");
        }
    }
}
