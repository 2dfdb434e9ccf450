//! Maps masks of new photos to the codes of an existing scene
//! (docs/internals/method.md#photos-added-later).
//!
//! Codes are rendered from the camera of a new photo. The alignment that joins masks of two photos
//! then joins the photo's masks with the rendered codes.
use super::align::{self, Alignment, Component, PairLinks, links_from_depth, links_from_overlay};
use super::build::{BuildOptions, Language, Pooling, pooled_feature};
use super::codebook::{self, CodeEntry};
use super::dir::normalise_rows;
use super::{LevelMasks, ViewMasks};
use crate::progress::Progress;
use crate::scene::{Camera, DepthMap, Image, LanguageField, LevelField, MaskId};
use crate::{Error, Result};
use std::collections::BTreeMap;

/// Tolerance of the relative depth difference between two views of one surface, as in the alignment
/// (docs/internals/method.md#reprojection).
const SAME_SURFACE: f32 = 0.05;

/// Share of pixels without a surface or code of the scene from which an unmatched component is a
/// new thing. Below it, a second code would contradict the scene's answer for most of the pixels.
const MOSTLY_NEW: f64 = 0.5;

/// Rendering of a scene from the camera of a new photo, and the depth measured in the photo.
pub struct SceneView<'a> {
    /// Camera of the photo.
    pub camera: Camera,
    /// Per level the rendered codes, −1 = none.
    pub codes: Vec<Image<i32>>,
    /// Rendered depth, world units; 0 = nothing.
    pub depth: Image<f32>,
    /// Depth measured in the photo.
    pub measured: &'a DepthMap,
}

impl SceneView<'_> {
    /// Whether each pixel of the photo shows a surface of the scene.
    fn shared_surface(&self) -> Vec<bool> {
        let depths = self.depth.data.iter().zip(&self.measured.depth.data);
        depths.map(|(r, m)| *r > 0.0 && *m > 0.0 && (r / m - 1.0).abs() < SAME_SURFACE).collect()
    }

    /// The rendered codes as masks, each with the embedding of its code.
    fn masks(&self, field: &LanguageField) -> ViewMasks {
        let levels = self.codes.iter().zip(&field.levels).map(|(labels, level)| {
            let mut features = level.codebook.embeddings.clone();
            // Those of [`Pooling::Agreement`] are shorter.
            normalise_rows(&mut features, level.codebook.embedding_dim);
            let quality = vec![1.0; level.codebook.len()];
            LevelMasks { labels: labels.clone(), quality, features, ..LevelMasks::default() }
        });
        ViewMasks { levels: levels.collect() }
    }
}

/// Extends the field of a scene by new photos; `masks` has one entry per view of `new`. `known`
/// holds the codes of the scene's own photos. These and all existing codes stay unchanged. Splat
/// features are empty until training fills them.
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
    let same: Vec<Vec<bool>> = new.iter().map(SceneView::shared_surface).collect();
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
        let state =
            Level { level, field: own, new, same: &same, alignment: &alignment, pooling: options.pooling };
        let (codebook, mut targets) = state.join(known.len(), options)?;
        let mut all: Vec<Image<i32>> = known.iter().map(|codes| codes[level].clone()).collect();
        all.append(&mut targets);
        out.levels.push(LevelField { codebook, targets: all, ..LevelField::default() });
    }
    progress.end();
    Ok(Language { field: out, alignment })
}

/// One level of a joint alignment: views below `new.len()` are renderings of the scene, the others
/// are the photos.
struct Level<'a> {
    level: usize,
    field: &'a LevelField,
    new: &'a [SceneView<'a>],
    same: &'a [Vec<bool>],
    alignment: &'a Alignment,
    pooling: Pooling,
}

impl Level<'_> {
    fn labels(&self, view: usize) -> &Image<i32> {
        &self.alignment.views[view].levels[self.level].labels
    }

    /// Returns the extended codebook, and per new photo the code of every pixel.
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
            let code = self.existing_code(component);
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
        // Per mask of a photo: its code, and the rendered mask of its view that it is joined with.
        let mut of_mask: BTreeMap<MaskId, (i32, Option<u32>)> = BTreeMap::new();
        for ((component, old), entry) in components.iter().zip(&old_of).zip(&entry_of) {
            let code = old.or(entry.map(|e| joined.code_of[e])).map_or(-1, |c| c as i32);
            for member in component.members.iter().filter(|m| m.view as usize >= n) {
                let rendered = component.members.iter().find(|m| m.view as usize + n == member.view as usize);
                of_mask.insert(*member, (code, rendered.map(|m| m.mask)));
                if let Some(old) = old {
                    let global = MaskId { view: member.view - n as u32 + known as u32, mask: member.mask };
                    codebook.members[*old as usize].push(global);
                }
            }
        }
        for (k, target) in targets.iter_mut().enumerate() {
            let (codes, scene) = (&self.new[k].codes[self.level], self.labels(k));
            for (p, label) in target.data.iter_mut().enumerate().filter(|(_, l)| **l >= 0) {
                let joined = of_mask.get(&MaskId::new(n + k, *label as usize));
                let (code, rendered) = joined.copied().unwrap_or((-1, None));
                let shown = if self.same[k][p] { codes.data[p] } else { -1 };
                // Rendered codes that alignment fused under one mask of the photo stay separate
                // (there is no fusion on the finest level). Unmatched masks keep the rendered
                // codes.
                let stays = shown >= 0 && (code < 0 || rendered.is_some_and(|r| r as i32 == scene.data[p]));
                *label = if stays { shown } else { code };
            }
        }
        Ok((codebook, targets))
    }

    /// Existing code of a component: of several, the one with the most pixels.
    fn existing_code(&self, component: &Component) -> Option<u32> {
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

    /// Share of a component's photo pixels that show no surface or no code of the scene.
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
        let global = |m: &MaskId| MaskId { view: m.view - n + known as u32, mask: m.mask };
        CodeEntry {
            embedding: pooled_feature(self.alignment, self.level, component, self.pooling),
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

    /// Two things of axes 0 and 1 on every level.
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
    fn join_adds_codes_for_new_things() {
        // The rendering shows two things, left and right of column 12, and nothing from column 24
        // on.
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
        // Masks of the photo: 0 the left thing, 1 the right one, 2 a new thing beyond, 3 a spot
        // within the left thing with another feature.
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
    fn join_keeps_codes_under_merged_mask() {
        let mut old = field();
        // Similar enough for fusion.
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
