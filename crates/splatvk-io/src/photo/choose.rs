//! Selection of photo files in folders, and their number in a run.
use super::kind::{READ, begins_as_photo, is_foreign_name, is_photo_name, is_raw_name, is_video_name};
use super::twins;
use crate::error::words;
use crate::{Error, Result, files};
use std::path::{Component, Path, PathBuf};

/// Default number of views of a scene with language where more photos are given
/// (docs/internals/method.md#choice-of-photos).
pub const DEFAULT_VIEWS: usize = 4;

/// Default number of views of a scene without language whose cameras are unknown.
pub const DEFAULT_VIEWS_WITHOUT_LANGUAGE: usize = 16;

/// Photos of the inputs, and ignored files of the folders.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct FoundFiles {
    /// Sorted by file name.
    pub photos: Vec<PathBuf>,
    /// Videos that were named, or that are the only usable files in the folders.
    pub videos: Vec<PathBuf>,
    /// Ignored files in the folders: videos beside photos, and images of unsupported formats.
    pub ignored: Vec<PathBuf>,
    /// Files that contain the same photo as another file: (used, left out).
    pub twins: Vec<(PathBuf, PathBuf)>,
    /// `images` folders of data sets, whose photos are used where the folder itself has none.
    pub inside: Vec<PathBuf>,
}

/// Lists the photos of files and folders (without their subfolders, except `images` of a folder
/// without photos of its own), sorted by file name, one of each where a camera wrote it in two
/// formats. A named file must exist; its content is checked when it is read.
pub fn find(inputs: &[PathBuf]) -> Result<FoundFiles> {
    let mut found = FoundFiles::default();
    for input in inputs {
        let kind = std::fs::metadata(input).map_err(|e| {
            Error::input(format!(
                "{}: {}; give photo files or a folder of photos",
                input.display(),
                words(&e)
            ))
        })?;
        if kind.is_dir() {
            list_or_below(input, &mut found)?;
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
    found.twins = twins::leave_out(&mut found.photos);
    if found.photos.is_empty() && found.videos.is_empty() { Err(nothing(inputs, &found)) } else { Ok(found) }
}

/// Finds photos in a folder and in those folders below it (and below its `images`) that the names
/// of cameras contain.
pub fn find_named(root: &Path, names: &[&str]) -> Result<FoundFiles> {
    let mut folders: Vec<PathBuf> = names.iter().filter_map(|name| folder_of(name)).collect();
    folders.sort();
    folders.dedup();
    let below = folders.iter().flat_map(|f| [root.join(f), root.join("images").join(f)]);
    let mut all = vec![root.to_path_buf()];
    all.extend(below.filter(|folder| folder.is_dir()));
    all.retain(|folder| count_photos(folder).is_some());
    if all.is_empty() { find(&[root.to_path_buf()]) } else { find(&all) }
}

/// Folders of a name; `None` where they are absolute or lead upwards.
fn folder_of(name: &str) -> Option<PathBuf> {
    let name = name.replace('\\', "/");
    let folder = Path::new(&name).parent()?;
    let inside = |part: Component| matches!(part, Component::Normal(_) | Component::CurDir);
    (!folder.as_os_str().is_empty() && folder.components().all(inside)).then(|| folder.to_path_buf())
}

impl FoundFiles {
    /// Warnings about files of the folders that are not used, a line each.
    pub fn warnings(&self) -> Vec<String> {
        let show = |list: &[&PathBuf]| {
            files::listed(&list.iter().map(|p| p.display().to_string()).collect::<Vec<_>>())
        };
        let developed = |raw: &&PathBuf| {
            self.photos.iter().any(|p| p.parent() == raw.parent() && p.file_stem() == raw.file_stem())
        };
        let (raw, other): (Vec<&PathBuf>, Vec<&PathBuf>) = self.ignored.iter().partition(|p| is_raw_name(p));
        let (beside, raw): (Vec<&PathBuf>, Vec<&PathBuf>) = raw.into_iter().partition(developed);
        let mut all = Vec::new();
        if !self.inside.is_empty() {
            all.push(format!("the photos are those in {}", show(&self.inside.iter().collect::<Vec<_>>())));
        }
        if !raw.is_empty() {
            all.push(format!(
                "camera raw files are not read: {}; develop them to JPEG or 16-bit TIFF",
                show(&raw)
            ));
        }
        if !beside.is_empty() {
            all.push(format!("camera raw files are not read, the photos beside them are: {}", show(&beside)));
        }
        if !other.is_empty() {
            all.push(format!("not a photo that can be read, ignored: {}", show(&other)));
        }
        if !self.twins.is_empty() {
            let name = |p: &Path| p.file_name().unwrap_or_default().to_string_lossy().into_owned();
            let pairs: Vec<String> =
                self.twins.iter().map(|(a, b)| format!("{} for {}", name(a), name(b))).collect();
            all.push(format!(
                "photos in two formats are used once, the file with more pixels, else the JPEG: {}",
                files::listed(&pairs)
            ));
        }
        all
    }
}

/// Error for inputs without photos.
fn nothing(inputs: &[PathBuf], found: &FoundFiles) -> Error {
    let place = inputs.iter().map(|p| p.display().to_string()).collect::<Vec<_>>().join(", ");
    let below: Vec<String> = inputs
        .iter()
        .flat_map(|input| folders_with_photos(input))
        .map(|(folder, count)| format!("{} ({count})", folder.display()))
        .collect();
    Error::input(match found.ignored.first() {
        _ if !below.is_empty() => {
            format!(
                "{place}: no photos in the folder itself; they are in {}: give one of these",
                files::listed(&below)
            )
        }
        None => {
            format!("{place}: no photos; give a folder with 2 or more photos ({READ}), or a video")
        }
        Some(raw) if is_raw_name(raw) => {
            format!(
                "{}: a camera raw file, and there are no photos beside it; develop it to JPEG or 16-bit TIFF",
                raw.display()
            )
        }
        Some(other) => format!(
            "{}: this kind of image is not read and there are no photos beside it; save the photos as JPEG or PNG",
            other.display()
        ),
    })
}

fn list_or_below(folder: &Path, found: &mut FoundFiles) -> Result<()> {
    let mut own = FoundFiles::default();
    list(folder, &mut own)?;
    let images = folder.join("images");
    if own.photos.is_empty() && !own.ignored.iter().any(|p| is_video_name(p)) && images.is_dir() {
        let mut below = FoundFiles::default();
        list(&images, &mut below)?;
        if !below.photos.is_empty() {
            below.ignored.append(&mut own.ignored);
            own = FoundFiles { inside: vec![images], ..below };
        }
    }
    found.photos.append(&mut own.photos);
    found.ignored.append(&mut own.ignored);
    found.inside.append(&mut own.inside);
    Ok(())
}

fn subfolders(folder: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten().map(|e| e.path());
    let mut all: Vec<PathBuf> = entries.filter(|p| !is_hidden(p) && p.is_dir()).collect();
    all.sort();
    all
}

/// Folders up to two levels below one that contain photos, with their number.
fn folders_with_photos(folder: &Path) -> Vec<(PathBuf, usize)> {
    let first = subfolders(folder);
    let all = first.iter().flat_map(|sub| [vec![sub.clone()], subfolders(sub)].concat());
    all.filter_map(|sub| count_photos(&sub).map(|count| (sub, count))).collect()
}

/// Number of photos directly in a folder; `None` without any.
fn count_photos(folder: &Path) -> Option<usize> {
    let mut found = FoundFiles::default();
    list(folder, &mut found).ok()?;
    (!found.photos.is_empty()).then_some(found.photos.len())
}

fn is_hidden(path: &Path) -> bool {
    path.file_name().is_some_and(|n| n.to_string_lossy().starts_with('.'))
}

fn list(folder: &Path, found: &mut FoundFiles) -> Result<()> {
    for entry in std::fs::read_dir(folder).map_err(Error::io(folder))? {
        let path = entry.map_err(Error::io(folder))?.path();
        if is_hidden(&path) || path.is_dir() {
            continue;
        }
        if is_photo_name(&path) {
            found.photos.push(path);
        } else if is_video_name(&path) || is_foreign_name(&path) || begins_as_photo(&path) {
            found.ignored.push(path);
        }
    }
    Ok(())
}

/// Indices of `views` of `count` frames: `linspace(0, count − 1, views)` truncated to whole numbers
/// (docs/internals/method.md#choice-of-photos).
pub fn spread(count: usize, views: usize) -> Vec<usize> {
    (0..views).map(|i| if views > 1 { i * (count - 1) / (views - 1) } else { 0 }).collect()
}

/// Number of photos that a run uses, of `count`. `views` is the number that the user requested.
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
    fn find_searches_subfolders_of_data_sets() {
        let root = tempfile::tempdir().unwrap();
        let path_of = |name: &str| root.path().join(name);
        let put = |name: &str| {
            std::fs::create_dir_all(path_of(name).parent().unwrap()).unwrap();
            std::fs::write(path_of(name), b"photo").unwrap();
        };
        let inputs = [root.path().to_path_buf()];
        put("shoot/cam1/1.jpg");
        put("shoot/cam2/1.jpg");
        put("shoot/cam2/2.jpg");
        let e = find(&inputs).unwrap_err().to_string();
        assert!(e.contains("cam1 (1)") && e.contains("cam2 (2)") && e.contains("give one of these"), "{e}");
        // The cameras name two subfolders, one of which does not exist.
        let names = ["cam2/1.jpg", "cam9/1.jpg", "../outside/1.jpg", "/etc/1.jpg"];
        let found = find_named(&path_of("shoot"), &names).unwrap();
        assert_eq!(found.photos, [path_of("shoot/cam2/1.jpg"), path_of("shoot/cam2/2.jpg")]);
        // A data set: scaled copies and masks lie beside the photos.
        for folder in ["images", "images_2", "masks"] {
            put(&format!("{folder}/1.jpg"));
        }
        let found = find(&inputs).unwrap();
        assert_eq!((found.photos, found.inside), (vec![path_of("images/1.jpg")], vec![path_of("images")]));
        assert_eq!(find_named(root.path(), &["1.jpg"]).unwrap().photos, [path_of("images/1.jpg")]);
        put("own.jpg");
        assert_eq!(find(&inputs).unwrap().photos, [path_of("own.jpg")]);
    }

    #[test]
    fn find_reports_unsupported_images() {
        let root = tempfile::tempdir().unwrap();
        let path_of = |name: &str| root.path().join(name);
        let inputs = [root.path().to_path_buf()];
        std::fs::write(path_of("notes.txt"), b"words").unwrap();
        std::fs::write(path_of("a.3FR"), b"raw").unwrap();
        let e = find(&inputs).unwrap_err().to_string();
        assert!(e.contains("a.3FR: a camera raw file") && e.contains("develop it"), "{e}");
        std::fs::write(path_of("b.jpg"), b"photo").unwrap();
        std::fs::write(path_of("IMG_1"), b"\xff\xd8\xff\xe0\0\x10JFIF\0\x01\x01\0\0").unwrap();
        let warnings = find(&inputs).unwrap().warnings();
        assert!(warnings.len() == 2 && warnings[0].contains("a.3FR; develop"), "{warnings:?}");
        assert!(warnings[1].contains("IMG_1"), "{warnings:?}");
        // The one-line error of a single photo contains it, too.
        let e = super::super::gather(&inputs, &crate::progress::Silent).unwrap_err().to_string();
        assert!(e.contains("only one photo") && e.contains("a.3FR"), "{e}");
    }

    #[test]
    fn view_counts_are_checked() {
        assert_eq!(photo_count(20, None).unwrap(), DEFAULT_VIEWS);
        assert_eq!(photo_count(3, None).unwrap(), 3);
        assert_eq!(photo_count(20, Some(6)).unwrap(), 6);
        assert_eq!(photo_count(400, Some(300)).unwrap(), 300);
        for (n, views) in [(3, 4), (3, 1), (3, 0)] {
            let e = photo_count(n, Some(views)).unwrap_err();
            assert!(e.exit_code() == 2 && e.to_string().starts_with(&format!("--views {views}:")), "{e}");
        }
    }
}
