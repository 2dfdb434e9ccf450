//! Three-step semantic alignment (docs/internals/method.md#alignment): finds the masks of different
//! views that show one thing.
//!
//! Step 1 scores mask pairs by dense matches, step 2 fuses masks that one view splits and another
//! keeps whole, step 3 re-scores by reprojection through depth and poses. Accepted pairs are
//! undirected edges; connected components, built under constraints, become the things of the scene.
//! Everything is integer counting or f64 sums in a fixed order, so the result depends neither on
//! the thread count nor on the order of the views.
mod components;
mod links;
mod options;
mod score;

#[cfg(test)]
mod tests;

pub use components::Component;
pub use links::{PairLinks, links_from_depth, links_from_overlay, links_from_warps};
pub use options::{AlignOptions, AreaScore, Edge, Fusion};

use super::ViewMasks;
use crate::{Error, Result};
use serde::{Deserialize, Serialize};

/// Statistics of the alignment of one level, for run.json.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[non_exhaustive]
pub struct LevelReport {
    /// Accepted edges, best first.
    pub edges: Vec<Edge>,
    /// Fused masks.
    pub fused: Vec<Fusion>,
    /// Masks before alignment.
    pub masks: usize,
    /// Things after alignment.
    pub components: usize,
    /// Mean cosine over the accepted edges.
    pub mean_cosine: f64,
}

/// Result of the alignment: masks with fused labels, and per level the things they form.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Alignment {
    /// The input masks; fused masks carry the smallest id of their set (absorbed ids have no pixel
    /// left).
    pub views: Vec<ViewMasks>,
    /// Per level.
    pub components: Vec<Vec<Component>>,
    /// Per level.
    pub report: Vec<LevelReport>,
}

/// Aligns the masks of all views. `matched` holds the dense matches of step 1, `projected` the
/// reprojections of step 3, each at most once per unordered pair of views; both may be empty.
pub fn align(
    views: &[ViewMasks],
    matched: &[PairLinks],
    projected: &[PairLinks],
    options: &AlignOptions,
) -> Result<Alignment> {
    check(views)?;
    let mut out = Alignment { views: views.to_vec(), ..Alignment::default() };
    for level in 0..views.iter().map(|v| v.levels.len()).max().unwrap_or(0) {
        let mut state = score::LevelState::new(&out.views, level, options.ranked);
        let masks = state.areas.iter().flatten().filter(|&&a| a > 0).count();
        let matched = if options.matching { matched } else { &[] };
        let projected = if options.reprojection { projected } else { &[] };
        let mut table = score::match_proposals(&state, matched, options, 1);
        let mut fused = Vec::new();
        // the finest level is never fused: its masks are subparts, and fusing them would make it
        // another level
        if options.fusion && level > 0 {
            fused = score::fuse(&mut state, matched, options);
            if !fused.is_empty() {
                table = score::match_proposals(&state, matched, options, 2);
                score::mark_unfused(&mut table, &fused);
            }
        }
        score::add_reprojections(&mut table, &state, projected, options);
        let edges = score::undirected(table);
        let components = components::build(&state, &edges);
        let cosines: f64 = edges.iter().map(|e| state.cosine(e.from, e.to).max(0.0)).sum();
        out.report.push(LevelReport {
            masks,
            components: components.len(),
            mean_cosine: if edges.is_empty() { 0.0 } else { cosines / edges.len() as f64 },
            edges,
            fused,
        });
        out.components.push(components);
        state.store(&mut out.views, level);
    }
    Ok(out)
}

fn check(views: &[ViewMasks]) -> Result<()> {
    let levels = views.first().map_or(0, |v| v.levels.len());
    let mut dim = 0;
    for (t, view) in views.iter().enumerate() {
        if view.levels.len() != levels {
            return Err(Error::work(format!(
                "view {t} has {} mask levels, view 0 has {levels}",
                view.levels.len()
            )));
        }
        for level in &view.levels {
            let count = level.quality.len();
            if count == 0 {
                continue;
            }
            let d = level.features.len() / count;
            if d == 0 || level.features.len() != count * d || (dim != 0 && d != dim) {
                return Err(Error::work(format!(
                    "view {t}: {} feature values for {count} masks of a {dim}-dimensional space",
                    level.features.len()
                )));
            }
            dim = d;
            if level.labels.data.iter().any(|&l| l >= count as i32) {
                return Err(Error::work(format!("view {t}: a label exceeds the {count} masks")));
            }
        }
    }
    Ok(())
}
