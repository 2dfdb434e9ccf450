//! Photos that a phone or camera wrote in two formats.
use super::header;
use super::join::plain_name;
use super::kind::{is_camera_format, is_jpeg_name, stem};
use std::cmp::Reverse;
use std::collections::BTreeMap;
use std::path::PathBuf;

/// Keeps one file of each photo: of those with the same folder and stem the one with most pixels,
/// on a tie the JPEG. Returns pairs of the kept file and a removed one.
pub(super) fn leave_out(photos: &mut Vec<PathBuf>) -> Vec<(PathBuf, PathBuf)> {
    let mut groups: BTreeMap<(Option<PathBuf>, String), Vec<PathBuf>> = BTreeMap::new();
    for photo in photos.iter().filter(|p| is_camera_format(p)) {
        let name = photo.file_name().unwrap_or_default().to_string_lossy();
        let key = (photo.parent().map(PathBuf::from), plain_name(stem(&name)));
        groups.entry(key).or_default().push(photo.clone());
    }
    let mut twins = Vec::new();
    for mut group in groups.into_values().filter(|g| g.len() > 1) {
        group.sort_by_cached_key(|p| (Reverse(header::pixels(p)), !is_jpeg_name(p), p.clone()));
        let best = group.remove(0);
        photos.retain(|p| !group.contains(p));
        twins.extend(group.into_iter().map(|left| (best.clone(), left)));
    }
    twins
}

#[cfg(test)]
mod tests {
    use super::super::choose::find;

    #[test]
    fn photos_in_two_formats_count_once() {
        let folder = tempfile::tempdir().unwrap();
        let path_of = |name: &str| folder.path().join(name);
        let data = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/data");
        for k in 0..2 {
            std::fs::copy(
                data.join(format!("breakfast/images/train_0{k}.jpg")),
                path_of(&format!("IMG_{k}.JPG")),
            )
            .unwrap();
        }
        // Smaller than the JPEG, larger, a raw file, and a raw file without a photo.
        std::fs::copy(data.join("photos/turned.heic"), path_of("IMG_0.HEIC")).unwrap();
        image::RgbImage::new(1280, 960).save(path_of("IMG_1.tif")).unwrap();
        std::fs::write(path_of("IMG_0.CR2"), "raw").unwrap();
        std::fs::write(path_of("IMG_9.NEF"), "raw").unwrap();
        let found = find(&[folder.path().to_path_buf()]).unwrap();
        assert_eq!(found.photos, [path_of("IMG_0.JPG"), path_of("IMG_1.tif")]);
        assert_eq!(
            found.twins,
            [(path_of("IMG_0.JPG"), path_of("IMG_0.HEIC")), (path_of("IMG_1.tif"), path_of("IMG_1.JPG"))]
        );
        let warnings = found.warnings().join("; ");
        for words in ["IMG_0.JPG for IMG_0.HEIC", "IMG_9.NEF; develop", "the photos beside them are: "] {
            assert!(warnings.contains(words), "{warnings}");
        }
    }
}
