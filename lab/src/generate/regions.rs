//! Masks and features made from ground truth, with injected errors as segmenters and encoders make
//! them.
use crate::{Error, Result};
use glam::{DVec2, DVec3};
use splatvk::eval::{BACKGROUND_LABELS, GroundTruth, TruthFrame};
use splatvk::format::create_folder;
use splatvk::format::npy::{self, NpyArray};
use splatvk::infer::things;
use splatvk::language::{LevelMasks, ViewMasks};
use splatvk::math::Random;
use splatvk::photo::stem;
use splatvk::query::presence::Alternatives;
use splatvk::query::{CANONICAL_PHRASES, TextQuery};
use splatvk::scene::{Camera, Image};
use splatvk_test_support::embedding::{DIM, PHRASE_SHARE, region_feature, text_embedding};
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// Rates of injected errors of masks and features, per (view, object, level).
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct InjectedErrors {
    /// Seed of the errors.
    pub seed: u64,
    /// Rate of masks of levels m and l that are cut in two; each piece has a feature of its own.
    pub split: f64,
    /// Rate of objects of level l that the mask of a neighbour includes.
    pub merge: f64,
    /// Rate of masks with the feature of another object.
    pub wrong: f64,
    /// Length of the random part of every feature, next to a common part of length 1.
    pub noise: f64,
    /// Whether all views and levels have the same errors, as of one segmenter and encoder that see
    /// the same thing.
    pub alike: bool,
}

impl InjectedErrors {
    /// Exact masks and features.
    pub const NONE: InjectedErrors =
        InjectedErrors { seed: 0, split: 0.0, merge: 0.0, wrong: 0.0, noise: 0.0, alike: false };

    /// Rates that `ablate` injects: every fifth mask is cut and every fifth feature wrong, about as
    /// often as for SAM and CLIP between distant views in the paper's figures.
    pub fn default_rates(seed: u64) -> InjectedErrors {
        InjectedErrors { seed, split: 0.2, merge: 0.05, wrong: 0.2, noise: 0.35, alike: false }
    }
}

/// Masks with features per view, and exact features per object.
#[derive(Clone, Debug, Default)]
pub struct Regions {
    /// Masks of each frame, three levels.
    pub masks: Vec<ViewMasks>,
    /// Object index → exact feature of the whole object.
    pub embeddings: BTreeMap<u32, Vec<f32>>,
}

/// Contents of photos: label and depth of every pixel. Parts of objects need depth; without
/// it every object is one part.
pub struct Shown<'a> {
    /// Label → phrase.
    pub labels: &'a BTreeMap<u32, String>,
    /// Camera of each photo.
    pub cameras: &'a [Camera],
    /// Labels per photo.
    pub objects: &'a [Image<u32>],
    /// Depth per photo, 0 = unknown.
    pub depths: &'a [Option<Image<f32>>],
}

/// A query in this space; its alternatives are the same thing in other colours, as of any encoder.
pub fn query(text: &str) -> TextQuery {
    let colours = things::recoloured(text).iter().flat_map(|t| text_embedding(t)).collect();
    TextQuery {
        text: text.to_owned(),
        embedding: text_embedding(text),
        canonicals: CANONICAL_PHRASES.iter().flat_map(|c| text_embedding(c)).collect(),
        alternatives: Alternatives { colours, ..Alternatives::default() },
        ..Default::default()
    }
}

/// Makes regions for frames of a ground truth that has masks. Parts of objects need depth; without
/// it every object is one part.
pub fn regions(truth: &GroundTruth, frames: &[&TruthFrame], flaws: &InjectedErrors) -> Result<Regions> {
    let mut objects = Vec::new();
    for frame in frames {
        objects.push(truth.objects(frame)?.ok_or_else(|| {
            Error::input(format!(
                "{}: no masks/{}.png to make regions from",
                truth.folder.display(),
                frame.stem
            ))
        })?);
    }
    let depths = frames.iter().map(|frame| truth.depth(frame)).collect::<Result<Vec<_>>>()?;
    let cameras: Vec<Camera> = frames.iter().map(|frame| frame.camera.clone()).collect();
    let shown = Shown { labels: &truth.labels, cameras: &cameras, objects: &objects, depths: &depths };
    Ok(shown.regions(flaws))
}

impl Shown<'_> {
    /// Makes regions with injected errors.
    pub fn regions(&self, flaws: &InjectedErrors) -> Regions {
        let mut random = Random::new(flaws.seed ^ 0x7265_6769);
        let names: Vec<&str> = self.labels.values().map(String::as_str).collect();
        let mut masks = Vec::new();
        for (objects, parts) in self.objects.iter().zip(&self.parts()) {
            let mut view = ViewMasks::default();
            for level in 0..3 {
                let made = level_masks(self.labels, &names, objects, parts, level, flaws, &mut random);
                view.levels.push(made);
            }
            masks.push(view);
        }
        let exact = |phrase: &String| region_feature(phrase, PHRASE_SHARE, &[], 0.0, &mut Random::new(0));
        Regions { masks, embeddings: self.labels.iter().map(|(&k, phrase)| (k, exact(phrase))).collect() }
    }

    /// Per level and photo the number of the object's part that a pixel shows; parts of different
    /// objects have different numbers.
    pub fn part_numbers(&self) -> [Vec<Image<u32>>; 3] {
        let parts = self.parts();
        [4, 2, 1].map(|kinds| {
            let numbers = self.objects.iter().zip(&parts).map(|(objects, parts)| {
                let number = |(label, part): (&u32, &u8)| 4 * label + u32::from(*part) % kinds;
                let data = objects.data.iter().zip(parts).map(number).collect();
                Image { width: objects.width, height: objects.height, data }
            });
            numbers.collect()
        })
    }

    /// Quarter of its object, 0 to 3, for every pixel of every photo. The signs along the object's
    /// two longest axes in space define it, so that all views agree.
    fn parts(&self) -> Vec<Vec<u8>> {
        let mut points: BTreeMap<u32, Vec<DVec3>> = BTreeMap::new();
        let mut positions = Vec::new();
        for ((camera, depth), objects) in self.cameras.iter().zip(self.depths).zip(self.objects) {
            let unproject = |p: usize| {
                let z = depth.as_ref().map_or(0.0, |d| d.data[p]);
                let pixel = DVec2::new((p % objects.width) as f64 + 0.5, (p / objects.width) as f64 + 0.5);
                (z > 0.0).then(|| camera.unproject(pixel, f64::from(z)))
            };
            let view: Vec<Option<DVec3>> = (0..objects.data.len()).map(unproject).collect();
            for (x, &label) in view.iter().zip(&objects.data) {
                points.entry(label).or_default().extend(x);
            }
            positions.push(view);
        }
        let axes: BTreeMap<u32, (DVec3, [DVec3; 2])> =
            points.into_iter().filter_map(|(label, points)| Some((label, principal(&points)?))).collect();
        let view_quarters = |(positions, objects): (&Vec<Option<DVec3>>, &Image<u32>)| {
            positions.iter().zip(&objects.data).map(|(x, label)| quarter(*x, axes.get(label))).collect()
        };
        positions.iter().zip(self.objects).map(view_quarters).collect()
    }
}

/// Quarter of an object, 0 to 3, in which a point lies; 0 where either is unknown.
fn quarter(point: Option<DVec3>, object: Option<&(DVec3, [DVec3; 2])>) -> u8 {
    let (Some(x), Some((centre, axes))) = (point, object) else { return 0 };
    let side = |k: usize| u8::from(axes[k].dot(x - *centre) > 0.0);
    side(0) + 2 * side(1)
}

/// Mean and the two principal directions of largest extent; `None` for fewer than 3 points.
fn principal(points: &[DVec3]) -> Option<(DVec3, [DVec3; 2])> {
    let n = points.len() as f64;
    if points.len() < 3 {
        return None;
    }
    let centre = points.iter().sum::<DVec3>() / n;
    let mut covariance = nalgebra::Matrix3::<f64>::zeros();
    for p in points {
        let d = *p - centre;
        let v = nalgebra::Vector3::new(d.x, d.y, d.z);
        covariance += v * v.transpose() / n;
    }
    let eigen = nalgebra::SymmetricEigen::new(covariance);
    let mut order = [0, 1, 2];
    order.sort_by(|&a, &b| eigen.eigenvalues[b].total_cmp(&eigen.eigenvalues[a]));
    let axis = |k: usize| {
        let v = eigen.eigenvectors.column(order[k]);
        let v = DVec3::new(v[0], v[1], v[2]);
        // The solver's sign is arbitrary.
        if v.dot(DVec3::new(1.0, 0.1, 0.01)) < 0.0 { -v } else { v }
    };
    Some((centre, [axis(0), axis(1)]))
}

/// Masks of one level: quarters, halves or whole objects, with injected errors.
fn level_masks(
    labels: &BTreeMap<u32, String>,
    names: &[&str],
    objects: &Image<u32>,
    parts: &[u8],
    level: usize,
    flaws: &InjectedErrors,
    random: &mut Random,
) -> LevelMasks {
    let mut out =
        LevelMasks { labels: Image::filled(objects.width, objects.height, -1), ..LevelMasks::default() };
    // Errors that are alike are drawn anew for every view and level, from one seed.
    let mut own = Random::new(flaws.seed ^ 0x616c_696b);
    let swallowed = swallowed(labels, objects, level, flaws, if flaws.alike { &mut own } else { random });
    for (&label, phrase) in labels {
        let pixels: Vec<usize> = (0..objects.data.len()).filter(|&p| objects.data[p] == label).collect();
        // Drawn also for hidden objects: visibility in one view must not change errors in others.
        let errors = if flaws.alike { &mut own } else { &mut *random };
        let (cut, mistaken) = (errors.uniform() < flaws.split, errors.uniform() < flaws.wrong);
        let other = names[errors.below(names.len())];
        let background = BACKGROUND_LABELS.contains(&phrase.as_str());
        let shown = if mistaken && !background { other } else { phrase.as_str() };
        let kinds = if background || level == 2 { 1 } else { [4, 2][level] };
        let mut groups: Vec<Vec<usize>> = vec![Vec::new(); kinds];
        for p in pixels {
            groups[parts[p] as usize % kinds].push(p);
        }
        for (k, group) in groups.into_iter().enumerate() {
            if cut && level > 0 && !background {
                for (half, piece) in halves(&group, objects.width).into_iter().enumerate() {
                    let piece_name = format!("piece {phrase} {k} {half} {}", random.bits());
                    let own = [(piece_name.as_str(), 0.6)];
                    let f = region_feature(shown, 0.55 * PHRASE_SHARE, &own, flaws.noise as f32, random);
                    push(&mut out, &piece, f);
                }
                continue;
            }
            let part = format!("part {phrase} {level} {k}");
            let own: &[(&str, f32)] = &[(part.as_str(), [0.5, 0.35, 0.0][level])];
            let share = if kinds == 1 { PHRASE_SHARE } else { [0.65, 0.8][level] * PHRASE_SHARE };
            let own = if kinds == 1 { &[][..] } else { own };
            push(&mut out, &group, region_feature(shown, share, own, flaws.noise as f32, random));
        }
    }
    for (gone, host) in swallowed {
        let find = |label: u32| objects.data.iter().position(|&o| o == label).map(|p| out.labels.data[p]);
        if let (Some(from), Some(to)) = (find(gone), find(host)) {
            out.labels.data.iter_mut().filter(|l| **l == from).for_each(|l| *l = to);
        }
    }
    compacted(out)
}

/// Pairs (object, neighbour whose mask includes it) of level l.
fn swallowed(
    labels: &BTreeMap<u32, String>,
    objects: &Image<u32>,
    level: usize,
    flaws: &InjectedErrors,
    random: &mut Random,
) -> Vec<(u32, u32)> {
    let mut out = Vec::new();
    for (&label, phrase) in labels {
        if random.uniform() >= flaws.merge || level < 2 || BACKGROUND_LABELS.contains(&phrase.as_str()) {
            continue;
        }
        let mut touching: BTreeMap<u32, usize> = BTreeMap::new();
        for p in 0..objects.data.len() - objects.width {
            for q in [p + 1, p + objects.width] {
                let (a, b) = (objects.data[p], objects.data[q]);
                if a != b && (a == label || b == label) {
                    *touching.entry(if a == label { b } else { a }).or_default() += 1;
                }
            }
        }
        let solid = |k: &u32| labels.get(k).is_some_and(|p| !BACKGROUND_LABELS.contains(&p.as_str()));
        let host = touching.into_iter().filter(|(k, _)| solid(k)).max_by_key(|(_, n)| *n);
        out.extend(host.map(|(host, _)| (label, host)));
    }
    out
}

/// Splits pixels at the median of their coordinate along the longer side of their bounding box.
fn halves(pixels: &[usize], width: usize) -> [Vec<usize>; 2] {
    let (xs, ys): (Vec<usize>, Vec<usize>) = pixels.iter().map(|p| (p % width, p / width)).unzip();
    let span = |v: &[usize]| v.iter().max().unwrap_or(&0) - v.iter().min().unwrap_or(&0);
    let along = if span(&xs) >= span(&ys) { &xs } else { &ys };
    let mut sorted = along.clone();
    sorted.sort_unstable();
    let middle = sorted.get(sorted.len() / 2).copied().unwrap_or(0);
    let pick = |low: bool| {
        pixels.iter().zip(along).filter(|(_, v)| (**v < middle) == low).map(|(p, _)| *p).collect()
    };
    [pick(true), pick(false)]
}

/// Adds a mask with its feature; nothing without pixels.
fn push(out: &mut LevelMasks, pixels: &[usize], feature: Vec<f32>) {
    if pixels.is_empty() {
        return;
    }
    let id = out.quality.len() as i32;
    pixels.iter().for_each(|&p| out.labels.data[p] = id);
    out.quality.push(1.0);
    out.features.extend(feature);
}

/// Removes masks below the minimum size, which includes those that a neighbour has swallowed.
fn compacted(masks: LevelMasks) -> LevelMasks {
    let mut area = vec![0usize; masks.quality.len()];
    masks.labels.data.iter().filter(|&&l| l >= 0).for_each(|&l| area[l as usize] += 1);
    let mut out = LevelMasks::default();
    let mut index = vec![-1; area.len()];
    for (k, _) in area.iter().enumerate().filter(|(_, n)| **n >= splatvk::language::dir::MIN_MASK_PIXELS) {
        index[k] = out.quality.len() as i32;
        out.quality.push(masks.quality[k]);
        out.features.extend_from_slice(&masks.features[k * DIM..(k + 1) * DIM]);
    }
    let data = masks.labels.data.iter().map(|&l| if l < 0 { -1 } else { index[l as usize] }).collect();
    out.labels = Image { data, ..masks.labels };
    out
}

/// Stride over the other things that a query is compared with: the table of texts holds every
/// fourth, a megabyte.
const OTHERS_EVERY: usize = 4;

/// Writes regions as a `dir:` folder, with the embeddings of `phrases` and of other things to
/// compare them with.
pub fn write(folder: &Path, frames: &[&TruthFrame], regions: &Regions, phrases: &[String]) -> Result<()> {
    create_folder(folder)?;
    for (frame, view) in frames.iter().zip(&regions.masks) {
        let name = stem(&frame.file);
        let (mut labels, mut features, mut first) = (Vec::new(), Vec::new(), 0);
        for level in &view.levels {
            labels.extend(level.labels.data.iter().map(|&l| if l < 0 { -1 } else { l + first }));
            features.extend_from_slice(&level.features);
            first += level.quality.len() as i32;
        }
        let size = (view.levels[0].labels.height, view.levels[0].labels.width);
        let labels = NpyArray::i32(&[view.levels.len(), size.0, size.1], labels);
        npy::write(folder.join(format!("{name}_s.npy")), &labels)?;
        npy::write(folder.join(format!("{name}_f.npy")), &NpyArray::f32(&[first as usize, DIM], features))?;
    }
    let other_things =
        things::forms().flat_map(|form| things::of_form(form).into_iter().step_by(OTHERS_EVERY));
    let recoloured = phrases.iter().flat_map(|p| things::recoloured(p));
    let others: BTreeSet<String> = other_things.chain(recoloured).collect();
    let new = others.iter().filter(|o| !phrases.contains(o));
    let texts: Vec<&str> = phrases.iter().chain(new).map(String::as_str).chain(CANONICAL_PHRASES).collect();
    let rows: Vec<NpyArray> = texts.iter().map(|t| NpyArray::f32(&[DIM], text_embedding(t))).collect();
    let table: Vec<(&str, &NpyArray)> = texts.iter().copied().zip(&rows).collect();
    npy::write_npz(folder.join("text_embeddings.npz"), &table)
}

#[cfg(test)]
mod tests {
    use super::*;
    use splatvk::eval::Split;
    use splatvk::math::dot_f32 as dot;

    fn breakfast() -> GroundTruth {
        GroundTruth::read(Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../tests/data/breakfast"))).unwrap()
    }

    #[test]
    fn synthetic_cosines_match_crops_and_phrases() {
        let mut random = Random::new(1000);
        let mut crop = |phrase: &str| region_feature(phrase, PHRASE_SHARE, &[], 0.35, &mut random);
        let (a, b, c) = (crop("blue mug"), crop("blue mug"), crop("lemon"));
        assert!((0.85..0.96).contains(&dot(&a, &b)), "same object {}", dot(&a, &b));
        assert!((0.55..0.75).contains(&dot(&a, &c)), "two objects {}", dot(&a, &c));
        let (right, wrong) = (dot(&a, &text_embedding("blue mug")), dot(&a, &text_embedding("green book")));
        assert!(right > 0.18 && right < 0.35 && wrong < 0.12, "{right} {wrong}");
        // Phrases that share a word are similar.
        let [can, book, mug] = ["red can", "red book", "blue mug"].map(text_embedding);
        assert!(dot(&can, &book) > dot(&can, &mug) + 0.03);
    }

    #[test]
    fn exact_regions_agree_between_views() {
        let truth = breakfast();
        let frames: Vec<&TruthFrame> = truth.frames.iter().filter(|f| f.split == Split::Train).collect();
        let made = regions(&truth, &frames, &InjectedErrors::NONE).unwrap();
        for (frame, view) in frames.iter().zip(&made.masks) {
            let objects = truth.objects(frame).unwrap().unwrap();
            let whole = &view.levels[2];
            for (p, &l) in whole.labels.data.iter().enumerate() {
                let expected = made.embeddings.get(&objects.data[p]);
                let feature = usize::try_from(l).ok().map(|l| &whole.features[l * DIM..(l + 1) * DIM]);
                if let (Some(e), Some(f)) = (expected, feature) {
                    assert!(dot(e, f) > 0.999);
                }
            }
            assert!(view.levels[0].quality.len() > view.levels[1].quality.len());
            assert!(view.levels[1].quality.len() > whole.quality.len());
        }
        // Equal features of two views' finest masks mean the same part.
        let rows = |v: usize| made.masks[v].levels[0].features.chunks_exact(DIM);
        let matched = rows(0).filter(|a| rows(1).any(|b| dot(a, b) > 0.999)).count();
        assert!(matched > 20, "{matched}");
    }

    #[test]
    fn injected_errors_follow_rates_and_seed() {
        let truth = breakfast();
        let frames: Vec<&TruthFrame> = truth.frames.iter().filter(|f| f.split != Split::Out).collect();
        let mask_count = |flaws: &InjectedErrors| -> usize {
            let made = regions(&truth, &frames, flaws).unwrap();
            made.masks.iter().map(|v| v.levels[2].quality.len()).sum()
        };
        let exact = mask_count(&InjectedErrors::NONE);
        let split = mask_count(&InjectedErrors { split: 0.5, seed: 1000, ..InjectedErrors::NONE });
        let merged = mask_count(&InjectedErrors { merge: 0.5, seed: 1000, ..InjectedErrors::NONE });
        // 12 views of 8 objects: 48 more, ± 3 σ of 96 draws
        assert!((split - exact) > 33 && (split - exact) < 63, "{exact} {split}");
        assert!(merged + 5 < exact, "{exact} {merged}");
        let (a, b) = (InjectedErrors::default_rates(1001), InjectedErrors::default_rates(1002));
        let features =
            |f: &InjectedErrors| regions(&truth, &frames, f).unwrap().masks[0].levels[2].features.clone();
        assert_eq!(features(&a), features(&a));
        assert_ne!(features(&a), features(&b));
    }

    #[test]
    fn write_reads_back() {
        let truth = breakfast();
        let frames: Vec<&TruthFrame> = truth.frames.iter().take(2).collect();
        let made = regions(&truth, &frames, &InjectedErrors::default_rates(1003)).unwrap();
        let dir = tempfile::tempdir().unwrap();
        let phrases: Vec<String> = truth.labels.values().cloned().collect();
        write(dir.path(), &frames, &made, &phrases).unwrap();
        for (frame, view) in frames.iter().zip(&made.masks) {
            let photo = splatvk::photo::load(&truth.folder.join(&frame.file)).unwrap();
            let read = splatvk::language::dir::read_view(dir.path(), &photo, true).unwrap();
            for (a, b) in read.levels.iter().zip(&view.levels) {
                assert_eq!(a.labels, b.labels);
                assert!(a.features.iter().zip(&b.features).all(|(x, y)| (x - y).abs() < 1e-6));
            }
        }
        let texts =
            splatvk::language::dir::TextEmbeddings::read(&dir.path().join("text_embeddings.npz")).unwrap();
        assert!(texts.get("lemon").is_some() && texts.get("texture").is_some());
    }
}
