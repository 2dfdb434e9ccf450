//! Language of a scene: features of the splats per level, and the codebooks that map them to
//! embeddings.
use super::code_mix::{self, CodeMix};
use super::{Image, Splats};
use serde::{Deserialize, Serialize};

/// A mask of a view. Stored as the pair `[view, mask]`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(from = "(u32, u32)", into = "(u32, u32)")]
pub struct MaskId {
    /// View index.
    pub view: u32,
    /// Index of the mask within its view and level.
    pub mask: u32,
}

impl MaskId {
    /// From indices of loops.
    pub fn new(view: usize, mask: usize) -> MaskId {
        MaskId { view: view as u32, mask: mask as u32 }
    }
}

impl From<(u32, u32)> for MaskId {
    fn from((view, mask): (u32, u32)) -> MaskId {
        MaskId { view, mask }
    }
}

impl From<MaskId> for (u32, u32) {
    fn from(id: MaskId) -> (u32, u32) {
        (id.view, id.mask)
    }
}

/// Level names, finest first: subpart, part, whole (internal level index 0, 1, 2).
pub const LEVEL_NAMES: [&str; 3] = ["s", "m", "l"];

/// The bijection of one level: K distinct unit vectors of the text/image space and their unit codes
/// (docs/internals/method.md#codebook).
#[derive(Clone, Debug, PartialEq, Default, Serialize, Deserialize)]
pub struct Codebook {
    /// Width D of the embedding space (512 for CLIP B/16).
    pub embedding_dim: usize,
    /// Width d of the codes that splats carry.
    pub code_dim: usize,
    /// [K, D] unit rows.
    pub embeddings: Vec<f32>,
    /// [K, d] unit rows.
    pub codes: Vec<f32>,
    /// [K] pixel area behind each code.
    pub weights: Vec<f32>,
    /// Masks behind each code.
    pub members: Vec<Vec<MaskId>>,
    /// Smallest distance between two codes.
    pub min_chord: f32,
}

impl Codebook {
    /// Number of codes K.
    pub fn len(&self) -> usize {
        self.embeddings.len().checked_div(self.embedding_dim).unwrap_or(0)
    }
    /// True without codes.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
    /// Index of the nearest code, `argmax_k F·c_k` (docs/internals/method.md#decoding-codes); ties
    /// take the lowest k; `None` without codes.
    pub fn decode(&self, feature: &[f32]) -> Option<usize> {
        let mut best: Option<(f32, usize)> = None;
        for (k, code) in self.codes.chunks_exact(self.code_dim.max(1)).enumerate() {
            let dot: f32 = feature.iter().zip(code).map(|(a, b)| a * b).sum();
            if best.is_none_or(|(d, _)| dot > d) {
                best = Some((dot, k));
            }
        }
        best.map(|(_, k)| k)
    }
}

/// One level of the language field.
#[derive(Clone, Debug, PartialEq, Default, Serialize, Deserialize)]
pub struct LevelField {
    /// The bijection between embeddings and codes.
    pub codebook: Codebook,
    /// [N, d] splat features as rendered (the renderer's semantic channels), splat order of the
    /// scene.
    pub features: Vec<f32>,
    /// [N] stored mixes of codes from which the features follow; empty where features are no mixes.
    pub mixes: Vec<CodeMix>,
    /// [N] agreement of the photos on the thing of a splat, in 0..1
    /// (docs/internals/method.md#reliability); empty where unknown.
    pub reliability: Vec<f32>,
    /// Per training view: code index per pixel, −1 = none. Training targets; empty in a loaded
    /// scene.
    pub targets: Vec<Image<i32>>,
    /// Splats that the features were trained on, where the level has a model of its own; `None` =
    /// the splats of the scene. Same number and order as in the scene.
    pub splats: Option<Splats>,
}

impl LevelField {
    /// Splats that carry the features, in a scene whose own splats are `shared`.
    pub fn carrier<'a>(&'a self, shared: &'a Splats) -> &'a Splats {
        self.splats.as_ref().unwrap_or(shared)
    }

    /// Stores features [N, d] as they are rendered.
    pub fn set_numbers(&mut self, features: Vec<f32>) {
        (self.features, self.mixes) = (features, Vec::new());
    }

    /// Stores features [N, d] of any length: as unit mixes of two codes, or unchanged where a mix
    /// cannot index the codes.
    pub fn set_features(&mut self, features: Vec<f32>) {
        self.set_mixes(code_mix::mixes(&features, &self.codebook.codes, self.codebook.code_dim));
        if self.mixes.is_empty() {
            self.features = features;
        }
    }

    /// Stores mixes of the level's codes.
    pub fn set_mixes(&mut self, mixes: Vec<CodeMix>) {
        self.features = code_mix::features(&mixes, &self.codebook.codes, self.codebook.code_dim);
        self.mixes = mixes;
    }

    /// The given rows, in their order, of a level with `splats` splats.
    fn picked(self, rows: &[usize], splats: usize) -> LevelField {
        let width = self.features.len() / splats.max(1);
        let row = |i: &usize| &self.features[i * width..(i + 1) * width];
        LevelField {
            features: rows.iter().flat_map(row).copied().collect(),
            mixes: rows.iter().filter_map(|&i| self.mixes.get(i)).copied().collect(),
            reliability: rows.iter().filter_map(|&i| self.reliability.get(i)).copied().collect(),
            splats: self.splats.as_ref().map(|own| own.picked(rows)),
            ..self
        }
    }
}

impl LevelField {
    /// The level with `more` splats without features after its `splats`.
    fn extended(mut self, more: &Splats, splats: usize) -> LevelField {
        let width = self.features.len() / splats.max(1);
        self.features.resize(self.features.len() + width * more.len(), 0.0);
        if !self.mixes.is_empty() {
            let none = self.codebook.len() as u16;
            let no_feature = CodeMix { first: none, second: none, share: 0 };
            self.mixes.resize(self.mixes.len() + more.len(), no_feature);
        }
        if !self.reliability.is_empty() {
            self.reliability.resize(self.reliability.len() + more.len(), 0.0);
        }
        if let Some(own) = &mut self.splats {
            own.append_raised(more.clone());
        }
        self
    }
}

/// All levels (index as in [`LEVEL_NAMES`]); a level without masks has an empty codebook.
#[derive(Clone, Debug, PartialEq, Default, Serialize, Deserialize)]
pub struct LanguageField {
    /// Three levels.
    pub levels: Vec<LevelField>,
    /// Identifies the embedding space, for example `words/efficientnet-lite+minilm` or
    /// `dir:oracle`.
    pub space: String,
}

impl LanguageField {
    /// The field of a scene of `splats` after `more` splats without language are appended.
    pub fn extended(self, more: &Splats, splats: usize) -> LanguageField {
        LanguageField { levels: self.levels.into_iter().map(|l| l.extended(more, splats)).collect(), ..self }
    }

    /// The field of the given rows of a scene's `splats`, in their order.
    pub fn picked(self, rows: &[usize], splats: usize) -> LanguageField {
        LanguageField { levels: self.levels.into_iter().map(|l| l.picked(rows, splats)).collect(), ..self }
    }
}
