//! Which files are the photos, and which of them the run uses.
use super::kind::{READ, is_foreign_name, is_photo_name, is_video_name};
use crate::{Error, Result};
use std::path::{Path, PathBuf};

/// Largest number of views: the pair count grows with its square, and the method is made for a few photos.
pub const MOST_VIEWS: usize = 16;

/// Views used when more photos are given and `--views` is not (ALGORITHMS 0.6).
pub const DEFAULT_VIEWS: usize = 4;

/// The photos behind the inputs and what was left out of the folders.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Found {
    /// Sorted by file name.
    pub photos: Vec<PathBuf>,
    /// Videos and images of other kinds in the folders, which nothing reads.
    pub ignored: Vec<PathBuf>,
}

/// Lists the photos of files and folders (not their subfolders), sorted by file name. A file that is named must exist; its
/// content is judged when it is read.
pub fn find(inputs: &[PathBuf]) -> Result<Found> {
    let mut found = Found::default();
    for input in inputs {
        let kind = std::fs::metadata(input).map_err(|e| {
            Error::input(format!("{}: {e}; give photo files or a folder of photos", input.display()))
        })?;
        if kind.is_dir() {
            list(input, &mut found)?;
        } else if is_video_name(input) {
            return Err(Error::input(format!(
                "{}: {}",
                input.display(),
                "is a video; take 3 or 4 still photos, or save frames of it as JPEG"
            )));
        } else {
            found.photos.push(input.clone());
        }
    }
    let key = |p: &PathBuf| (p.file_name().map(|n| n.to_os_string()), p.clone());
    found.photos.sort_by_key(key);
    found.photos.dedup();
    found.ignored.sort_by_key(key);
    let place = inputs.iter().map(|p| p.display().to_string()).collect::<Vec<_>>().join(", ");
    match (found.photos.as_slice(), found.ignored.first()) {
        ([], None) => Err(Error::input(format!(
            "{place}: no photos; give a folder with 2 to {MOST_VIEWS} photos ({READ})"
        ))),
        ([], Some(v)) if is_video_name(v) => Err(Error::input(format!(
            "{}: this is a video and there are no photos beside it; take 3 or 4 still photos, or save frames as JPEG",
            v.display()
        ))),
        ([], Some(other)) => Err(Error::input(format!(
            "{}: this kind of image is not read and there are no photos beside it; save the photos as JPEG or PNG",
            other.display()
        ))),
        ([one], _) if !is_video_name(one) => Err(Error::input(format!(
            "{}: only one photo; at least 2 are needed, 3 or 4 work best",
            one.display()
        ))),
        _ => Ok(found),
    }
}

fn list(folder: &Path, found: &mut Found) -> Result<()> {
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

/// Indices of `views` of `count` photos: `linspace(0, count − 1, views)` truncated to whole numbers (ALGORITHMS 0.6).
pub fn spread(count: usize, views: usize) -> Vec<usize> {
    (0..views).map(|i| if views > 1 { i * (count - 1) / (views - 1) } else { 0 }).collect()
}

/// The photos that a run uses. `views` is what the user asked for.
pub fn choose(photos: &[PathBuf], views: Option<usize>) -> Result<Vec<PathBuf>> {
    let count = photos.len();
    let wanted = views.unwrap_or(count.min(DEFAULT_VIEWS));
    if wanted < 2 {
        return Err(Error::input(format!("--views {wanted}: at least 2 views are needed, 3 or 4 work best")));
    }
    if wanted > count {
        return Err(Error::input(format!(
            "--views {wanted}: only {count} photos were given; add photos or lower --views"
        )));
    }
    if wanted > MOST_VIEWS {
        return Err(Error::input(format!(
            "--views {wanted}: at most {MOST_VIEWS} views are supported; lower --views"
        )));
    }
    Ok(spread(count, wanted).into_iter().map(|i| photos[i].clone()).collect())
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
        let photos: Vec<PathBuf> = (0..20).map(|i| format!("{i:02}.jpg").into()).collect();
        assert_eq!(choose(&photos, None).unwrap().len(), DEFAULT_VIEWS);
        assert_eq!(choose(&photos[..3], None).unwrap().len(), 3);
        for (n, views) in [(3, 4), (3, 1), (3, 0), (20, 17)] {
            let e = choose(&photos[..n], Some(views)).unwrap_err();
            assert!(e.exit_code() == 2 && e.to_string().starts_with(&format!("--views {views}:")), "{e}");
        }
    }
}
