//! Precomputed masks and features, `dir:DIR` (the layout that LangSplat-style preprocessing
//! writes).
//!
//! Per photo: `<stem>_s.npy`, int or float, 4×H×W (default, s, m, l) or 3×H×W (s, m, l), each value
//! a row of `<stem>_f.npy` (N×D) or −1. `text_embeddings.npz` maps phrases to D-vectors of the same
//! space.
use super::{LevelMasks, ViewMasks};
use crate::format::npy::{self, NpyData};
use crate::photo::Photo;
use crate::scene::{Affine, Image};
use crate::{Error, Result};
use glam::DVec2;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Masks below this many pixels are dropped: LangSplat's own clean-up leaves none smaller, and
/// fewer pixels carry no reliable feature (docs/internals/method.md#label-maps).
pub const MIN_MASK_PIXELS: usize = 32;

/// Vectors shorter than this have no direction (docs/internals/method.md#region-features).
const MIN_NORM: f32 = 1e-6;

/// Reads the masks of one photo, at its working resolution; with their features when
/// `with_features`.
///
/// The label map may have the photo's working size or its original (upright) size.
pub fn read_view(dir: &Path, photo: &Photo, with_features: bool) -> Result<ViewMasks> {
    let path = dir.join(format!("{}_s.npy", photo.stem));
    let (levels, height, width) = read_labels(&path, photo)?;
    let working = (photo.image.width, photo.image.height);
    let original = (photo.original_size.0 as usize, photo.original_size.1 as usize);
    if (width, height) != working && (width, height) != original {
        return Err(Error::input(format!(
            "{}: label map is {width}x{height}, the photo {}x{} (working size {}x{}); make masks at one of these sizes",
            path.display(),
            original.0,
            original.1,
            working.0,
            working.1
        )));
    }
    let features = if with_features { Some(read_features(dir, photo)?) } else { None };
    let mut out = ViewMasks::default();
    for labels in levels {
        let labels = Image { width, height, data: labels };
        let labels = to_working(labels, photo);
        out.levels.push(compact(labels, features.as_ref(), &path)?);
    }
    Ok(out)
}

/// Reads the masks of a folder photo by photo and checks that all features have one length.
pub struct DirMasks<'a> {
    dir: &'a Path,
    with_features: bool,
    /// Length of the first features, and the stem of their photo.
    first: Option<(usize, String)>,
}

impl<'a> DirMasks<'a> {
    /// Creates a reader; no file is read yet.
    pub fn new(dir: &'a Path, with_features: bool) -> Self {
        DirMasks { dir, with_features, first: None }
    }

    /// Reads the next photo ([`read_view`]); features of another length are an error.
    pub fn read(&mut self, photo: &Photo) -> Result<ViewMasks> {
        let view = read_view(self.dir, photo, self.with_features)?;
        let found = view.levels.iter().find_map(|l| l.features.len().checked_div(l.quality.len()));
        if let Some(dim) = found.filter(|_| self.with_features) {
            let (first, stem) = self.first.get_or_insert_with(|| (dim, photo.stem.clone()));
            if *first != dim {
                return Err(Error::input(format!(
                    "{}: features of length {dim}, those of {stem}_f.npy have {first}; make all with one network",
                    self.dir.join(format!("{}_f.npy", photo.stem)).display()
                )));
            }
        }
        Ok(view)
    }
}

/// The last three maps of the file as row indices: (levels, H, W).
fn read_labels(path: &Path, photo: &Photo) -> Result<(Vec<Vec<i32>>, usize, usize)> {
    if !path.exists() {
        return Err(Error::input(format!(
            "{}: missing; dir: masks need one <stem>_s.npy per photo, here for {}",
            path.display(),
            photo.path.display()
        )));
    }
    let array = npy::read(path)?;
    let [count @ (3 | 4), height, width] = array.shape[..] else {
        return Err(Error::input(format!(
            "{}: shape {:?}, expected 4xHxW or 3xHxW label maps",
            path.display(),
            array.shape
        )));
    };
    let float = matches!(array.data, NpyData::F16(_) | NpyData::F32(_) | NpyData::F64(_));
    if float && array.to_f32().iter().any(|v| !v.is_finite() || v.fract() != 0.0) {
        return Err(Error::input(format!("{}: a label is not a whole number", path.display())));
    }
    let values = array.to_i32();
    let size = width * height;
    let levels = (count - 3..count).map(|k| values[k * size..(k + 1) * size].to_vec()).collect();
    Ok((levels, height, width))
}

/// Rows of unit vectors.
struct FeatureRows {
    dim: usize,
    rows: Vec<f32>,
    path: PathBuf,
}

fn read_features(dir: &Path, photo: &Photo) -> Result<FeatureRows> {
    let path = dir.join(format!("{}_f.npy", photo.stem));
    if !path.exists() {
        return Err(Error::input(format!(
            "{}: missing; dir: features need one <stem>_f.npy (NxD) per photo",
            path.display()
        )));
    }
    let array = npy::read(&path)?;
    let [_, dim] = array.shape[..] else {
        return Err(Error::input(format!("{}: shape {:?}, expected NxD", path.display(), array.shape)));
    };
    let mut rows = array.to_f32();
    if rows.iter().any(|v| !v.is_finite()) {
        return Err(Error::input(format!("{}: holds values that are not finite", path.display())));
    }
    normalise_rows(&mut rows, dim);
    Ok(FeatureRows { dim, rows, path })
}

/// Scales every row to unit length; rows without a direction become zero.
pub fn normalise_rows(rows: &mut [f32], dim: usize) {
    for row in rows.chunks_exact_mut(dim.max(1)) {
        let norm = row.iter().map(|v| v * v).sum::<f32>().sqrt();
        let scale = if norm < MIN_NORM { 0.0 } else { 1.0 / norm };
        row.iter_mut().for_each(|v| *v *= scale);
    }
}

/// Resamples labels of the original or the working size to the photo's image: nearest pixels,
/// through the photo's affine map and the removed distortion.
fn to_working(labels: Image<i32>, photo: &Photo) -> Image<i32> {
    let (width, height) = (photo.image.width, photo.image.height);
    let same = (labels.width, labels.height) == (width, height);
    if same && photo.straightened.is_none() {
        return labels;
    }
    let mut out = Image::filled(width, height, -1);
    let back = if same { Affine::IDENTITY } else { photo.to_working.inverse() };
    for y in 0..height {
        for x in 0..width {
            let seen = photo.source(DVec2::new(x as f64 + 0.5, y as f64 + 0.5));
            let [u, v] = back.apply(seen.to_array());
            if u >= 0.0 && v >= 0.0 && (u as usize) < labels.width && (v as usize) < labels.height {
                out.data[y * width + x] = labels.at(u as usize, v as usize);
            }
        }
    }
    out
}

/// Global rows → compact per-level indices; regions that are too small or have no feature become
/// holes.
fn compact(labels: Image<i32>, features: Option<&FeatureRows>, path: &Path) -> Result<LevelMasks> {
    let mut area: BTreeMap<i32, usize> = BTreeMap::new();
    for &l in labels.data.iter().filter(|&&l| l >= 0) {
        *area.entry(l).or_default() += 1;
    }
    let mut out = LevelMasks::default();
    let mut index: BTreeMap<i32, i32> = BTreeMap::new();
    for (&row, &pixels) in &area {
        if pixels < MIN_MASK_PIXELS {
            continue;
        }
        if let Some(f) = features {
            let at = row as usize * f.dim;
            let Some(vector) = f.rows.get(at..at + f.dim) else {
                return Err(Error::input(format!(
                    "{}: label {row} has no row in {} ({} rows)",
                    path.display(),
                    f.path.display(),
                    f.rows.len() / f.dim.max(1)
                )));
            };
            if vector.iter().all(|&v| v == 0.0) {
                continue;
            }
            out.features.extend_from_slice(vector);
        }
        index.insert(row, out.quality.len() as i32);
        out.quality.push(1.0);
    }
    let data = labels.data.iter().map(|l| index.get(l).copied().unwrap_or(-1)).collect();
    out.labels = Image { width: labels.width, height: labels.height, data };
    Ok(out)
}

/// Unit vectors of phrases, read from `text_embeddings.npz`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TextEmbeddings {
    /// D.
    pub dim: usize,
    entries: BTreeMap<String, Vec<f32>>,
}

impl TextEmbeddings {
    /// Reads `text_embeddings.npz` (phrase → D float32).
    pub fn read(path: &Path) -> Result<Self> {
        if !path.exists() {
            return Err(Error::missing(format!(
                "{}: missing; put phrase -> vector arrays there, or query with a text model of the same space",
                path.display()
            )));
        }
        let mut out = TextEmbeddings::default();
        for (phrase, array) in npy::read_npz(path)? {
            let mut vector = array.to_f32();
            if out.dim == 0 {
                out.dim = vector.len();
            }
            if vector.is_empty() || vector.len() != out.dim {
                return Err(Error::input(format!(
                    "{}: '{phrase}' has {} values, others have {}",
                    path.display(),
                    vector.len(),
                    out.dim
                )));
            }
            if vector.iter().any(|v| !v.is_finite()) {
                return Err(Error::input(format!(
                    "{}: '{phrase}' holds values that are not finite; make its embedding again",
                    path.display()
                )));
            }
            normalise_rows(&mut vector, out.dim);
            out.entries.insert(key(&phrase), vector);
        }
        Ok(out)
    }
    /// The unit vector of a phrase; case and surrounding blanks do not matter.
    pub fn get(&self, phrase: &str) -> Option<&[f32]> {
        self.entries.get(&key(phrase)).map(Vec::as_slice)
    }
    /// Every phrase and its unit vector.
    pub fn iter(&self) -> impl Iterator<Item = (&str, &[f32])> {
        self.entries.iter().map(|(phrase, vector)| (phrase.as_str(), vector.as_slice()))
    }
    /// [texts.len(), D] unit rows; an unknown phrase is an error that lists known ones.
    pub fn embed(&self, texts: &[&str]) -> Result<Vec<f32>> {
        let mut out = Vec::with_capacity(texts.len() * self.dim);
        for text in texts {
            let vector = self.get(text).ok_or_else(|| {
                let known: Vec<&str> = self.entries.keys().map(String::as_str).take(20).collect();
                Error::input(format!(
                    "no text embedding for '{text}' in text_embeddings.npz (it has: {})",
                    known.join(", ")
                ))
            })?;
            out.extend_from_slice(vector);
        }
        Ok(out)
    }
}

fn key(phrase: &str) -> String {
    phrase.trim().to_lowercase()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::format::npy::NpyArray;
    use crate::scene::{Affine, RgbImage};

    fn photo(width: usize, height: usize, original: (u32, u32)) -> Photo {
        let image = RgbImage { width, height, data: vec![[0.5; 3]; width * height] };
        let scale = [width as f64 / original.0 as f64, height as f64 / original.1 as f64];
        Photo {
            path: "in/a.jpg".into(),
            original_size: original,
            to_working: Affine { scale, offset: [0.0; 2] },
            ..splatvk_test_support::toys::photo("a", image)
        }
    }

    /// Left half row 2, right half row 5 at every level of a 4-map file, plus one pixel of row 1;
    /// its first map, which is not a level, is empty.
    fn write_case(dir: &Path, width: usize, height: usize) {
        let mut labels = Vec::new();
        for map in 0..4 {
            for y in 0..height {
                for x in 0..width {
                    let lone = x == 0 && y == 0;
                    let label = if lone { 1.0 } else { [2.0, 5.0][usize::from(2 * x >= width)] };
                    labels.push(if map == 0 { -1.0 } else { label });
                }
            }
        }
        npy::write(dir.join("a_s.npy"), &NpyArray::f32(&[4, height, width], labels)).unwrap();
        let mut rows = vec![1.0; 6 * 3];
        rows[2 * 3..3 * 3].copy_from_slice(&[3.0, 0.0, 4.0]);
        rows[5 * 3..6 * 3].copy_from_slice(&[0.0, 0.0, 0.0]);
        npy::write(dir.join("a_f.npy"), &NpyArray::f32(&[6, 3], rows)).unwrap();
    }

    #[test]
    fn labels_follow_removed_distortion() {
        let mut seen = photo(200, 100, (200, 100));
        let lens = crate::scene::Lens::radial(-0.3, 0.0);
        seen.straightened = Some(crate::photo::Straightening {
            lens,
            focal: 150.0,
            aspect: 1.0,
            centre: DVec2::new(100.0, 50.0),
        });
        let columns = (0..200 * 100).map(|k| k % 200).collect();
        let labels = to_working(Image { width: 200, height: 100, data: columns }, &seen);
        // r = 0.6 is imaged at 0.6 (1 − 0.3 · 0.36) = 0.5352, 80.28 pixels from the centre instead
        // of 90.
        assert_eq!((labels.at(190, 50), labels.at(100, 50)), (180, 100));
    }

    #[test]
    fn read_view_compacts_and_normalises() {
        let dir = tempfile::tempdir().unwrap();
        write_case(dir.path(), 16, 10);
        let view = read_view(dir.path(), &photo(16, 10, (16, 10)), true).unwrap();
        assert_eq!(view.levels.len(), 3);
        let level = &view.levels[0];
        // row 5 has no direction and row 1 one pixel: both are holes
        assert_eq!(level.features, [0.6, 0.0, 0.8]);
        assert_eq!((level.labels.at(0, 0), level.labels.at(1, 0), level.labels.at(15, 9)), (-1, 0, -1));
        // without features both halves stay
        let bare = read_view(dir.path(), &photo(16, 10, (16, 10)), false).unwrap();
        assert_eq!(bare.levels[2].quality.len(), 2);
        assert_eq!(bare.levels[2].labels.at(15, 9), 1);
        // masks made at the original size follow the photo's resize
        let half = read_view(dir.path(), &photo(12, 8, (16, 10)), false).unwrap();
        assert_eq!((half.levels[0].labels.at(5, 4), half.levels[0].labels.at(6, 4)), (0, 1));
    }

    #[test]
    fn read_refuses_mixed_lengths_and_nan() {
        let dir = tempfile::tempdir().unwrap();
        write_case(dir.path(), 16, 10);
        for kind in ["s", "f"] {
            std::fs::copy(dir.path().join(format!("a_{kind}.npy")), dir.path().join(format!("b_{kind}.npy")))
                .unwrap();
        }
        let other = Photo { stem: "b".into(), ..photo(16, 10, (16, 10)) };
        let read_both = || {
            let mut masks = DirMasks::new(dir.path(), true);
            masks.read(&photo(16, 10, (16, 10))).and_then(|_| masks.read(&other)).map_err(|e| e.to_string())
        };
        assert!(read_both().is_ok());
        npy::write(dir.path().join("b_f.npy"), &NpyArray::f32(&[6, 4], vec![1.0; 24])).unwrap();
        let e = read_both().unwrap_err();
        assert!(e.contains("b_f.npy: features of length 4, those of a_f.npy have 3"), "{e}");
        let table = dir.path().join("text_embeddings.npz");
        npy::write_npz(&table, &[("mug", &NpyArray::f32(&[2], vec![1.0, f32::NAN]))]).unwrap();
        assert!(TextEmbeddings::read(&table).unwrap_err().to_string().contains("'mug' holds values"));
    }

    #[test]
    fn read_view_errors_state_reason() {
        let dir = tempfile::tempdir().unwrap();
        let message = |p: &Photo, f: bool| read_view(dir.path(), p, f).unwrap_err().to_string();
        assert!(message(&photo(8, 8, (8, 8)), true).contains("a_s.npy: missing"));
        write_case(dir.path(), 16, 10);
        let text = message(&photo(8, 8, (9, 9)), true);
        assert!(text.contains("16x10") && text.contains("9x9") && text.contains("8x8"), "{text}");
        npy::write(dir.path().join("a_f.npy"), &NpyArray::f32(&[2, 3], vec![1.0; 6])).unwrap();
        assert!(message(&photo(16, 10, (16, 10)), true).contains("label 2 has no row"));
        std::fs::remove_file(dir.path().join("a_f.npy")).unwrap();
        assert!(message(&photo(16, 10, (16, 10)), true).contains("a_f.npy: missing"));
        npy::write(dir.path().join("a_s.npy"), &NpyArray::f32(&[10, 16], vec![0.0; 160])).unwrap();
        assert!(message(&photo(16, 10, (16, 10)), false).contains("[10, 16]"));
        npy::write(dir.path().join("a_s.npy"), &NpyArray::f32(&[3, 8, 8], vec![0.5; 192])).unwrap();
        assert!(message(&photo(8, 8, (8, 8)), false).contains("whole number"));
    }

    #[test]
    fn text_embeddings_ignore_case() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("text_embeddings.npz");
        assert!(TextEmbeddings::read(&path).unwrap_err().to_string().contains("missing"));
        let (a, b) = (NpyArray::f32(&[2], vec![0.0, 5.0]), NpyArray::f32(&[2], vec![1.0, 0.0]));
        npy::write_npz(&path, &[("Blue mug", &a), ("object", &b)]).unwrap();
        let text = TextEmbeddings::read(&path).unwrap();
        assert_eq!(text.embed(&["object", " blue MUG"]).unwrap(), [1.0, 0.0, 0.0, 1.0]);
        assert!(text.embed(&["spoon"]).unwrap_err().to_string().contains("blue mug, object"));
        npy::write_npz(&path, &[("x", &a), ("y", &NpyArray::f32(&[3], vec![1.0; 3]))]).unwrap();
        assert!(TextEmbeddings::read(&path).unwrap_err().to_string().contains("'y' has 3 values"));
    }
}
