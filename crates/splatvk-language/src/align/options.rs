//! Options of the alignment, and the pairs that it accepts.
use crate::scene::MaskId;
use serde::{Deserialize, Serialize};

/// Measure of the area share of a target mask (docs/internals/method.md#pixel-matching).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub enum AreaScore {
    /// Share of the target's own pixels whose reverse match lands in the source: independent of
    /// image scale.
    Coverage,
    /// Matched source pixels over target pixels, at most 1: the paper's ratio.
    Paper,
    /// Share of the target's pixels at whose position the source view has a match of any mask: the
    /// score of step 1 in the authors' code, which ignores motion. Step 3 uses the paper's ratio.
    SamePlace,
}

/// Thresholds of the alignment; the defaults are explained in docs/internals/method.md#alignment.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct AlignOptions {
    /// Acceptance threshold of step 1.
    pub tau1: f64,
    /// Acceptance threshold of step 3.
    pub tau2: f64,
    /// Weight of the features' likeness; the area share has 1 − λ.
    pub lambda: f64,
    /// Measure of the area share.
    pub area: AreaScore,
    /// Matched pixels needed, as a share of the image ([`AlignOptions::min_matches`]).
    pub min_match_share: f64,
    /// Whether the cosine of two masks counts by its rank among those of different masks of one
    /// view, so that the constants hold for every encoder (docs/internals/method.md#likeness).
    pub ranked: bool,
    /// Share of a mask's matches that must fall into the fusion target.
    pub containment: f64,
    /// Share of the fusion target that the masks to be fused must cover together.
    pub fusion_cover: f64,
    /// Whether the other views vote on a fusion.
    pub votes: bool,
    /// Masks above this share of the image are background and never a fusion target.
    pub background_share: f64,
    /// Run step 1 (dense matches).
    pub matching: bool,
    /// Run step 2 (fusion; levels m and l only).
    pub fusion: bool,
    /// Run step 3 (reprojection).
    pub reprojection: bool,
    /// In step 3, masks must be each other's best partner.
    pub mutual: bool,
}

impl Default for AlignOptions {
    fn default() -> Self {
        AlignOptions::DEFAULT
    }
}

impl AlignOptions {
    /// Default thresholds.
    pub const DEFAULT: AlignOptions = AlignOptions {
        tau1: 0.5,
        tau2: 0.5,
        lambda: 0.3,
        area: AreaScore::Coverage,
        min_match_share: 2.05e-4,
        ranked: true,
        containment: 0.6,
        fusion_cover: 0.5,
        votes: true,
        background_share: 0.6,
        matching: true,
        fusion: true,
        reprojection: true,
        mutual: true,
    };

    /// Smallest number of matched pixels for which a pair of masks is scored: 150 at 0.73
    /// megapixels, at least 32.
    pub fn min_matches(&self, pixels: usize) -> u32 {
        ((self.min_match_share * pixels as f64).round() as u32).max(32)
    }
}

/// An accepted pair of masks.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Edge {
    /// 1 dense matching, 2 dense matching after fusion, 3 reprojection.
    pub step: u8,
    /// Source view and mask.
    pub from: MaskId,
    /// Target view and mask.
    pub to: MaskId,
    /// Area share of the target.
    pub area: f64,
    /// Likeness of the features: the rank of their cosine, or the cosine, at least 0.
    pub lang: f64,
    /// λ·lang + (1 − λ)·area.
    pub score: f64,
}

/// Two masks of a view that fusion joined. Stored as `[view, kept, absorbed]`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(from = "(u32, u32, u32)", into = "(u32, u32, u32)")]
pub struct Fusion {
    /// View index.
    pub view: u32,
    /// The mask that remains.
    pub kept: u32,
    /// The mask whose pixels it takes over.
    pub absorbed: u32,
}

impl From<(u32, u32, u32)> for Fusion {
    fn from((view, kept, absorbed): (u32, u32, u32)) -> Fusion {
        Fusion { view, kept, absorbed }
    }
}

impl From<Fusion> for (u32, u32, u32) {
    fn from(f: Fusion) -> (u32, u32, u32) {
        (f.view, f.kept, f.absorbed)
    }
}
