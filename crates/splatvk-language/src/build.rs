//! From masks with features to components, codebooks and training targets.
use super::ViewMasks;
use super::align::{self, AlignOptions, Alignment, Component, PairLinks, links_from_depth};
use super::codebook::{self, CodeEntry, EncodedLevel, autoencoder, quantise, unreduced};
use crate::progress::Progress;
use crate::scene::{Camera, DepthMap, Image, LanguageField, LevelField, MaskId};
use crate::{Error, Result};
use serde::{Deserialize, Serialize};

/// Method that reduces embeddings to the codes of splats.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "lowercase")]
#[non_exhaustive]
pub enum Reducer {
    /// One code per distinct embedding, bound to it (docs/internals/method.md#codebook).
    Bijection,
    /// A scene autoencoder to three dimensions and back, as LangSplat; `feature_dim` is then 3.
    Autoencoder {
        /// Smallest number of training steps; with the features of a few photos, the published 100
        /// epochs are few steps.
        least_steps: usize,
    },
    /// At most 128 mean features, as LEGaussians; codes initialise an index head.
    Quantised,
    /// None: embeddings in an orthonormal basis of their span; `feature_dim` is not used.
    Unreduced,
}

/// How the features of a component's masks become the embedding of its code.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Pooling {
    /// The feature of the medoid, a unit vector.
    Medoid,
    /// The mean, shorter the less the masks agree and the fewer they are: a classifier errs in a
    /// different way in each photo.
    Agreement,
}

/// Options of [`build`].
#[derive(Clone, Debug, PartialEq)]
pub struct BuildOptions {
    /// Alignment thresholds.
    pub align: AlignOptions,
    /// Reduction of embeddings to codes.
    pub reducer: Reducer,
    /// d, the length of the codes that splats carry.
    pub feature_dim: usize,
    /// Embedding of a code.
    pub pooling: Pooling,
    /// Identifies the embedding space, for [`LanguageField::space`].
    pub space: String,
    /// Seed of the code layout.
    pub seed: u64,
}

impl Default for BuildOptions {
    fn default() -> Self {
        // 16: codes of up to 200 things stay ghost-free at borders, where 3 gives 95 % ghosts
        // (docs/internals/method.md#code-length)
        BuildOptions {
            align: AlignOptions::default(),
            reducer: Reducer::Bijection,
            feature_dim: 16,
            pooling: Pooling::Medoid,
            space: String::new(),
            seed: 0,
        }
    }
}

/// Result of [`build`].
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[non_exhaustive]
pub struct Language {
    /// Codebooks and training targets; splat features are empty until training fills them.
    pub field: LanguageField,
    /// Aligned masks, components and accepted edges.
    pub alignment: Alignment,
}

/// Aligns the masks of all views and encodes the things they form.
///
/// `masks`, `cameras` and `depths` have one entry per view, all at the view's working resolution;
/// `matched` holds the dense matches of step 1 ([`super::matcher`]), once per unordered pair.
pub fn build(
    masks: &[ViewMasks],
    cameras: &[Camera],
    depths: &[DepthMap],
    matched: &[PairLinks],
    options: &BuildOptions,
    progress: &dyn Progress,
) -> Result<Language> {
    check_sizes(masks, cameras, depths)?;
    let views = masks.len();
    let pairs: Vec<(usize, usize)> = (0..views).flat_map(|i| (i + 1..views).map(move |j| (i, j))).collect();
    progress.begin("align", pairs.len() as u64 + 2);
    let mut projected = Vec::with_capacity(pairs.len());
    for (k, &(i, j)) in pairs.iter().enumerate() {
        progress.check()?;
        projected.push(links_from_depth(i, j, (&cameras[i], &cameras[j]), (&depths[i], &depths[j])));
        progress.step(k as u64 + 1, "");
    }
    let alignment = align::align(masks, matched, &projected, &options.align)?;
    progress.step(pairs.len() as u64 + 1, "");
    progress.check()?;
    let field = encode(&alignment, options, progress)?;
    progress.end();
    Ok(Language { field, alignment })
}

fn check_sizes(masks: &[ViewMasks], cameras: &[Camera], depths: &[DepthMap]) -> Result<()> {
    if masks.len() != cameras.len() || masks.len() != depths.len() {
        return Err(Error::work(format!(
            "language: {} mask sets for {} cameras and {} depth maps",
            masks.len(),
            cameras.len(),
            depths.len()
        )));
    }
    for (t, ((view, camera), depth)) in masks.iter().zip(cameras).zip(depths).enumerate() {
        let size = (camera.width as usize, camera.height as usize);
        let depth_size = (depth.depth.width, depth.depth.height);
        for level in &view.levels {
            if (level.labels.width, level.labels.height) != size || depth_size != size {
                return Err(Error::work(format!(
                    "language: view {t} is {}x{}, its masks {}x{}, its depth {}x{}",
                    size.0, size.1, level.labels.width, level.labels.height, depth_size.0, depth_size.1
                )));
            }
        }
    }
    Ok(())
}

/// One codebook per level from the components, and the code index of every pixel.
fn encode(alignment: &Alignment, options: &BuildOptions, progress: &dyn Progress) -> Result<LanguageField> {
    let mut field = LanguageField { levels: Vec::new(), space: options.space.clone() };
    let entries: Vec<Vec<CodeEntry>> =
        (0..alignment.components.len()).map(|l| entries(alignment, l, options.pooling)).collect();
    let built = match options.reducer {
        Reducer::Bijection => {
            let encode = |e: &Vec<CodeEntry>| codebook::build(e, options.feature_dim, options.seed);
            entries.iter().map(encode).collect::<Result<Vec<EncodedLevel>>>()?
        }
        Reducer::Quantised => {
            let encode = |e: &Vec<CodeEntry>| quantise::build(e, options.feature_dim, options.seed);
            entries.iter().map(encode).collect()
        }
        Reducer::Autoencoder { least_steps } => {
            autoencoder::build(&entries, least_steps, options.seed, progress)?.0
        }
        Reducer::Unreduced => unreduced::build(&entries),
    };
    for (level, (components, built)) in alignment.components.iter().zip(built).enumerate() {
        if built.codebook.is_empty() {
            progress
                .warn(&format!("no masks at level {}: it is not trained", crate::scene::LEVEL_NAMES[level]));
        }
        let mut code_of: Vec<Vec<i32>> =
            alignment.views.iter().map(|v| vec![-1; v.levels[level].quality.len()]).collect();
        for (component, &code) in components.iter().zip(&built.code_of) {
            for m in &component.members {
                code_of[m.view as usize][m.mask as usize] = code as i32;
            }
        }
        let targets = alignment.views.iter().zip(&code_of).map(|(view, codes)| {
            let labels = &view.levels[level].labels;
            let data = labels.data.iter().map(|&l| if l < 0 { -1 } else { codes[l as usize] }).collect();
            Image { width: labels.width, height: labels.height, data }
        });
        let targets = targets.collect();
        field.levels.push(LevelField { codebook: built.codebook, targets, ..LevelField::default() });
    }
    Ok(field)
}

/// Embedding, weight and members of every component of a level.
fn entries(alignment: &Alignment, level: usize, pooling: Pooling) -> Vec<CodeEntry> {
    let components = alignment.components[level].iter();
    let entries = components.map(|c| CodeEntry {
        embedding: pooled_feature(alignment, level, c, pooling),
        weight: c.weight,
        members: c.members.clone(),
    });
    entries.collect()
}

/// Masks without a feature that are added to the mean of [`Pooling::Agreement`].
const DOUBT: f32 = 0.5;

/// Feature of a component, [D].
pub(super) fn pooled_feature(
    alignment: &Alignment,
    level: usize,
    c: &Component,
    pooling: Pooling,
) -> Vec<f32> {
    let feature = |mask: &MaskId| {
        let masks = &alignment.views[mask.view as usize].levels[level];
        let dim = masks.features.len() / masks.quality.len().max(1);
        &masks.features[mask.mask as usize * dim..][..dim]
    };
    match pooling {
        Pooling::Medoid => feature(&c.medoid).to_vec(),
        Pooling::Agreement => {
            let mut mean = vec![0.0; feature(&c.medoid).len()];
            let weight = 1.0 / (c.members.len() as f32 + DOUBT);
            for member in &c.members {
                mean.iter_mut().zip(feature(member)).for_each(|(m, v)| *m += weight * v);
            }
            mean
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::LevelMasks;

    /// One mask per view, with these features of two numbers, that form one component.
    fn component(features: &[[f32; 2]]) -> (Alignment, Component) {
        let view = |f: &[f32; 2]| {
            let level = LevelMasks { quality: vec![1.0], features: f.to_vec(), ..LevelMasks::default() };
            ViewMasks { levels: vec![level] }
        };
        let members: Vec<MaskId> = (0..features.len()).map(|v| MaskId::new(v, 0)).collect();
        let component = Component { medoid: members[0], members, weight: 1.0 };
        (Alignment { views: features.iter().map(view).collect(), ..Alignment::default() }, component)
    }

    #[test]
    fn agreement_of_views_makes_features_long() {
        let pooled = |features: &[[f32; 2]], pooling| {
            let (alignment, component) = component(features);
            pooled_feature(&alignment, 0, &component, pooling)
        };
        let (a, b) = ([1.0, 0.0], [0.0, 1.0]);
        assert_eq!(pooled(&[a, b], Pooling::Medoid), a);
        let length = |features: &[[f32; 2]]| {
            let pooled = pooled(features, Pooling::Agreement);
            pooled.iter().map(|v| v * v).sum::<f32>().sqrt()
        };
        let (alone, agreed, split) = (length(&[a]), length(&[a; 4]), length(&[a, b, a, b]));
        assert!((alone - 1.0 / 1.5).abs() < 1e-6 && (agreed - 4.0 / 4.5).abs() < 1e-6, "{alone} {agreed}");
        assert!(split < 0.71 * agreed, "{split}");
    }
}
