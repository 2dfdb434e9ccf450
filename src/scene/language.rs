//! Language of a scene: features of the splats per level, and the codebooks that map them to embeddings.
use super::Plane;
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
    /// From the indices that loops count with.
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
/// (docs/method.md#codebook).
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
    /// `argmax_k F·c_k` (docs/method.md#decoding-codes); ties take the lowest k; `None` without codes.
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
    /// The bijection.
    pub codebook: Codebook,
    /// [N, d] raw splat features (the renderer's semantic channels), splat order of the scene.
    pub features: Vec<f32>,
    /// Per training view: code index per pixel, −1 = none. Training targets; empty in a loaded scene.
    pub targets: Vec<Plane<i32>>,
}

/// All levels (index as in [`LEVEL_NAMES`]); a level without masks has an empty codebook.
#[derive(Clone, Debug, PartialEq, Default, Serialize, Deserialize)]
pub struct LanguageField {
    /// Three levels.
    pub levels: Vec<LevelField>,
    /// Identifies the embedding space, for example `words/efficientnet-lite+minilm` or `dir:oracle`.
    pub space: String,
}

impl LanguageField {
    /// The field of the given rows of a scene's `splats`, in their order.
    pub fn picked(self, rows: &[usize], splats: usize) -> LanguageField {
        let level = |l: LevelField| {
            let width = l.features.len() / splats.max(1);
            let row = |i: &usize| &l.features[i * width..(i + 1) * width];
            LevelField { features: rows.iter().flat_map(row).copied().collect(), ..l }
        };
        LanguageField { levels: self.levels.into_iter().map(level).collect(), ..self }
    }
}
