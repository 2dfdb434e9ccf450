//! Masks of photos that join a scene, under the codes that it has
//! (docs/internals/method.md#photos-added-later).
//!
//! A scene seen from the camera of a new photo shows its things where the photo shows them: the
//! same alignment that joins masks of two photos joins the photo's masks with the codes that are
//! rendered there.
use super::align::{self, Alignment, Component, PairLinks, links_from_depth, links_from_overlay};
use super::build::{BuildOptions, Language};
use super::codebook::{self, CodeEntry};
use super::{LevelMasks, ViewMasks};
use crate::progress::Progress;
use crate::scene::{Camera, DepthMap, Image, LanguageField, LevelField, MaskId};
use crate::{Error, Result};
use std::collections::BTreeMap;

/// Relative difference in depth that two views of one surface may have, as in the other alignment
/// steps (docs/internals/method.md#reprojection).
const SAME_SURFACE: f32 = 0.05;

/// Share of a mask that stands on surfaces the scene does not have, from which on a mask that is
/// none of its things is a new one. Below, the scene has an answer for most of it already, which a
/// second one would only contradict.
const MOSTLY_NEW: f64 = 0.5;

/// A scene from the camera of a new photo, and what was measured in that photo.
pub struct SceneView<'a> {
    /// Its camera.
    pub camera: Camera,
    /// Per level the codes that the scene shows, −1 = none.
    pub codes: Vec<Image<i32>>,
    /// As the scene renders it, world units; 0 = nothing.
    pub depth: Image<f32>,
    /// As it was measured in the photo.
    pub measured: &'a DepthMap,
}

impl SceneView<'_> {
    /// Pixels in which the photo shows a surface of the scene.
    fn same(&self) -> Vec<bool> {
        let both = self.depth.data.iter().zip(&self.measured.depth.data);
        both.map(|(r, m)| *r > 0.0 && *m > 0.0 && (r / m - 1.0).abs() < SAME_SURFACE).collect()
    }

    /// The scene as if its codes were masks of a photo, each with the embedding of its code.
    fn masks(&self, field: &LanguageField) -> ViewMasks {
        let level = |(labels, level): (&Image<i32>, &LevelField)| LevelMasks {
            labels: labels.clone(),
            quality: vec![1.0; level.codebook.len()],
            features: level.codebook.embeddings.clone(),
            ..LevelMasks::default()
        };
        ViewMasks { levels: self.codes.iter().zip(&field.levels).map(level).collect() }
    }
}

/// The field of a scene that `masks` of new photos join, one entry per view of `new`. `known` are
/// the codes of the scene's own photos: they stay, and so does every code. Splat features are empty
/// until training fills them.
pub fn join(
    field: &LanguageField,
    known: Vec<Vec<Image<i32>>>,
    new: &[SceneView],
    masks: &[ViewMasks],
    options: &BuildOptions,
    progress: &dyn Progress,
) -> Result<Language> {
    let n = new.len();
    if masks.len() != n || masks.iter().any(|m| m.levels.len() != field.levels.len()) {
        return Err(Error::work(format!("language: masks of {} photos for {n} new ones", masks.len())));
    }
    progress.begin("align", 2);
    let same: Vec<Vec<bool>> = new.iter().map(SceneView::same).collect();
    let mut views: Vec<ViewMasks> = new.iter().map(|v| v.masks(field)).collect();
    views.extend_from_slice(masks);
    let overlay: Vec<PairLinks> = (0..n).map(|k| links_from_overlay(k, n + k, &same[k])).collect();
    let mut projected = overlay.clone();
    for (i, a) in new.iter().enumerate() {
        for (j, b) in new.iter().enumerate().skip(i + 1) {
            let (cameras, depths) = ((&a.camera, &b.camera), (a.measured, b.measured));
            projected.push(links_from_depth(n + i, n + j, cameras, depths));
        }
    }
    let alignment = align::align(&views, &overlay, &projected, &options.align)?;
    progress.step(1, "");
    progress.check()?;
    let mut out = LanguageField { levels: Vec::new(), space: field.space.clone() };
    for (level, own) in field.levels.iter().enumerate() {
        let state = Level { level, field: own, new, same: &same, alignment: &alignment };
        let (codebook, mut targets) = state.join(known.len(), options)?;
        let mut all: Vec<Image<i32>> = known.iter().map(|codes| codes[level].clone()).collect();
        all.append(&mut targets);
        out.levels.push(LevelField { codebook, targets: all, ..LevelField::default() });
    }
    progress.end();
    Ok(Language { field: out, alignment })
}

/// One level of a joint alignment: views below `new.len()` are the scene's, the others those of the
/// photos.
struct Level<'a> {
    level: usize,
    field: &'a LevelField,
    new: &'a [SceneView<'a>],
    same: &'a [Vec<bool>],
    alignment: &'a Alignment,
}

impl Level<'_> {
    fn labels(&self, view: usize) -> &Image<i32> {
        &self.alignment.views[view].levels[self.level].labels
    }

    /// The codebook with what is new, and per new photo the code of every pixel.
    fn join(
        &self,
        known: usize,
        options: &BuildOptions,
    ) -> Result<(crate::scene::Codebook, Vec<Image<i32>>)> {
        let n = self.new.len();
        let components = &self.alignment.components[self.level];
        let mut entries: Vec<CodeEntry> = Vec::new();
        let mut entry_of: Vec<Option<usize>> = Vec::new();
        let mut old_of: Vec<Option<u32>> = Vec::new();
        for component in components {
            let code = self.code(component);
            old_of.push(code);
            let is_new = code.is_none() && self.new_share(component) >= MOSTLY_NEW;
            entry_of.push(is_new.then_some(entries.len()));
            if is_new {
                entries.push(self.entry(component, known));
            }
        }
        let joined = codebook::append(&self.field.codebook, &entries, options.feature_dim, options.seed)?;
        let mut codebook = joined.codebook;
        let mut targets: Vec<Image<i32>> = (0..n).map(|k| self.labels(n + k).clone()).collect();
        // Per photo and mask: its code, and the mask of the scene that it is.
        let mut of_mask: BTreeMap<MaskId, (i32, Option<u32>)> = BTreeMap::new();
        for ((component, old), entry) in components.iter().zip(&old_of).zip(&entry_of) {
            let code = old.or(entry.map(|e| joined.code_of[e])).map_or(-1, |c| c as i32);
            for member in component.members.iter().filter(|m| m.view as usize >= n) {
                let twin = component.members.iter().find(|m| m.view as usize + n == member.view as usize);
                of_mask.insert(*member, (code, twin.map(|m| m.mask)));
                if let Some(old) = old {
                    let global = MaskId { view: member.view - n as u32 + known as u32, mask: member.mask };
                    codebook.members[*old as usize].push(global);
                }
            }
        }
        for (k, target) in targets.iter_mut().enumerate() {
            let (codes, scene) = (&self.new[k].codes[self.level], self.labels(k));
            for (p, label) in target.data.iter_mut().enumerate().filter(|(_, l)| **l >= 0) {
                let own = of_mask.get(&MaskId::new(n + k, *label as usize));
                let (code, twin) = own.copied().unwrap_or((-1, None));
                let shown = if self.same[k][p] { codes.data[p] } else { -1 };
                // Several things of the scene that the photo shows as one stay several where
                // alignment has fused them, which it does not on the finest level; what matched
                // nothing stays what it was.
                let stays = shown >= 0 && (code < 0 || twin.is_some_and(|t| t as i32 == scene.data[p]));
                *label = if stays { shown } else { code };
            }
        }
        Ok((codebook, targets))
    }

    /// The code of the scene that a component is: of several, the one with most pixels.
    fn code(&self, component: &Component) -> Option<u32> {
        let mut pixels: BTreeMap<u32, usize> = BTreeMap::new();
        for m in component.members.iter().filter(|m| (m.view as usize) < self.new.len()) {
            let labels = &self.labels(m.view as usize).data;
            *pixels.entry(m.mask).or_default() += labels.iter().filter(|l| **l == m.mask as i32).count();
        }
        pixels
            .into_iter()
            .max_by_key(|(code, count)| (*count, std::cmp::Reverse(*code)))
            .map(|(code, _)| code)
    }

    /// Share of the pixels of a component of new masks that the scene has nothing for.
    fn new_share(&self, component: &Component) -> f64 {
        let n = self.new.len();
        let (mut fresh, mut all) = (0usize, 0usize);
        for m in component.members.iter().filter(|m| m.view as usize >= n) {
            let k = m.view as usize - n;
            let codes = &self.new[k].codes[self.level].data;
            for (p, _) in self.labels(n + k).data.iter().enumerate().filter(|(_, l)| **l == m.mask as i32) {
                all += 1;
                fresh += usize::from(!self.same[k][p] || codes[p] < 0);
            }
        }
        fresh as f64 / all.max(1) as f64
    }

    fn entry(&self, component: &Component, known: usize) -> CodeEntry {
        let n = self.new.len() as u32;
        let masks = &self.alignment.views[component.medoid.view as usize].levels[self.level];
        let dim = masks.features.len() / masks.quality.len().max(1);
        let at = component.medoid.mask as usize * dim;
        let global = |m: &MaskId| MaskId { view: m.view - n + known as u32, mask: m.mask };
        CodeEntry {
            embedding: masks.features[at..at + dim].to_vec(),
            weight: component.weight,
            members: component.members.iter().filter(|m| m.view >= n).map(global).collect(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::progress::Silent;
    use crate::scene::{Codebook, LEVEL_NAMES, Pose};

    const SIZE: (usize, usize) = (32, 16);

    fn plane<T>(of: impl Fn(usize, usize) -> T) -> Image<T> {
        let data = (0..SIZE.0 * SIZE.1).map(|p| of(p % SIZE.0, p / SIZE.0)).collect();
        Image { width: SIZE.0, height: SIZE.1, data }
    }

    fn axis(k: usize) -> [f32; 4] {
        std::array::from_fn(|i| if i == k { 1.0 } else { 0.0 })
    }

    /// Two things of axes 0 and 1, left and right of column 12, on every level.
    fn field() -> LanguageField {
        let codebook = Codebook {
            embedding_dim: 4,
            code_dim: 4,
            embeddings: [axis(0), axis(1)].concat(),
            codes: [axis(2), axis(3)].concat(),
            weights: vec![10.0; 2],
            members: vec![vec![MaskId::new(0, 0)], vec![MaskId::new(0, 1)]],
            min_chord: 2f32.sqrt(),
        };
        let level = LevelField { codebook, ..LevelField::default() };
        LanguageField { levels: vec![level; LEVEL_NAMES.len()], space: "test".into() }
    }

    fn camera() -> Camera {
        Camera {
            name: String::new(),
            width: SIZE.0 as u32,
            height: SIZE.1 as u32,
            fx: 30.0,
            fy: 30.0,
            cx: 16.0,
            cy: 8.0,
            pose: Pose::IDENTITY,
        }
    }

    #[test]
    fn known_things_keep_their_codes_and_only_new_ones_get_one() {
        // The scene shows its two things up to column 24 and nothing beyond.
        let code = |x: usize| {
            if x < 12 {
                0
            } else if x < 24 {
                1
            } else {
                -1
            }
        };
        let codes = vec![plane(|x, _| code(x)); 3];
        let measured = DepthMap { depth: plane(|_, _| 2.0), confidence: plane(|_, _| 0.9) };
        let depth = plane(|x, _| if x < 24 { 2.0 } else { 0.0 });
        // The photo: mask 0 is the left thing, 1 the right one, 2 something new beyond; 3 is a spot
        // within the left thing that resembles nothing there.
        let mask = |x: usize, y: usize| match x {
            0..4 if y < 8 => 3,
            0..12 => 0,
            12..24 => 1,
            _ => 2,
        };
        let masks = LevelMasks {
            labels: plane(mask),
            quality: vec![1.0; 4],
            features: [axis(0), axis(1), axis(2), axis(3)].concat(),
            ..LevelMasks::default()
        };
        let new = [SceneView { camera: camera(), codes: codes.clone(), depth, measured: &measured }];
        let masks = [ViewMasks { levels: vec![masks; 3] }];
        let options = BuildOptions { feature_dim: 4, ..BuildOptions::default() };
        let old = field();
        let joined = join(&old, vec![codes.clone()], &new, &masks, &options, &Silent).unwrap();
        for (level, before) in joined.field.levels.iter().zip(&old.levels) {
            let (book, was) = (&level.codebook, &before.codebook);
            assert_eq!(
                (book.len(), &book.codes[..8], &book.embeddings[..8]),
                (3, &was.codes[..], &was.embeddings[..])
            );
            assert_eq!(book.embeddings[8..], axis(2));
            assert_eq!(level.targets[0], codes[0]);
            let expected = plane(|x, _| if x < 24 { code(x) } else { 2 });
            assert_eq!(level.targets[1], expected);
            assert_eq!(book.members[0], [MaskId::new(0, 0), MaskId::new(1, 0)]);
            assert_eq!(book.members[2], [MaskId::new(1, 2)]);
        }
    }

    #[test]
    fn things_that_a_scene_tells_apart_stay_apart_under_one_mask_of_the_photo() {
        let mut old = field();
        // Alike enough to be parts of one thing.
        let alike = [0.8, 0.6, 0.0, 0.0];
        old.levels.iter_mut().for_each(|l| l.codebook.embeddings[4..].copy_from_slice(&alike));
        let code = |x: usize| i32::from(x >= 12);
        let codes = vec![plane(|x, _| code(x)); 3];
        let measured = DepthMap { depth: plane(|_, _| 2.0), confidence: plane(|_, _| 0.9) };
        let depth = plane(|_, _| 2.0);
        let new = [SceneView { camera: camera(), codes: codes.clone(), depth, measured: &measured }];
        let labels = plane(|x, _| if (6..18).contains(&x) { 0 } else { -1 });
        let features = axis(0).to_vec();
        let masks = LevelMasks { labels, quality: vec![1.0], features, ..LevelMasks::default() };
        let masks = [ViewMasks { levels: vec![masks; 3] }];
        let options = BuildOptions { feature_dim: 4, ..BuildOptions::default() };
        let joined = join(&old, vec![codes], &new, &masks, &options, &Silent).unwrap();
        let expected = plane(|x, _| if (6..18).contains(&x) { code(x) } else { -1 });
        // Masks of the finest level are never fused.
        for level in &joined.field.levels[1..] {
            assert_eq!((level.codebook.len(), &level.targets[1]), (2, &expected));
        }
    }
}
