//! Three cuts of the merge tree.
//!
//! A fixed threshold cuts plain and printed things at different depths. Things are instead nodes
//! with a clear outline: a level is the set of disjoint nodes with the largest total score (the
//! rule by which HDBSCAN chooses clusters, Campello et al. 2013). Each level is cut independently
//! of the others.
use super::options::{Cues, GraphOptions};
use super::tree::Tree;
use crate::scene::Image;
use crate::{LevelMasks, ViewMasks};
use std::collections::BTreeMap;

/// No mask.
const NONE: usize = usize::MAX;

pub(super) fn cut(tree: &Tree, cues: &Cues, options: &GraphOptions) -> ViewMasks {
    let total = cues.labels.data.len() as f32;
    let roots: Vec<usize> = (0..tree.nodes.len()).filter(|&n| tree.nodes[n].parent == NONE).collect();
    // the whole image is not a candidate
    let starts: Vec<usize> = roots.iter().flat_map(|&r| children_of(tree, r)).collect();
    let cut_level = |(&power, &share): (&f32, &f32)| {
        let mut chosen = best_nodes(tree, &starts, share * total, |n| score(tree, n, power, options));
        if chosen.is_empty() {
            // without any outline the image is one mask
            chosen.clone_from(&roots);
        }
        paint(tree, cues, &chosen)
    };
    ViewMasks { levels: options.area_powers.iter().zip(&options.min_masks).map(cut_level).collect() }
}

/// The two halves of a node; none for a leaf.
fn children_of(tree: &Tree, node: usize) -> Vec<usize> {
    tree.nodes[node].children.map_or(Vec::new(), |(a, b)| vec![a, b])
}

/// Strength of a node's outline, weighted by its size. The range of costs over which a node
/// persists, as in HDBSCAN, adds nothing: see `docs/internals/method.md#graph-masks`.
fn score(tree: &Tree, node: usize, area_power: f32, options: &GraphOptions) -> f32 {
    let r = &tree.nodes[node].region;
    let contour = r.contour / (r.perimeter - r.frame).max(1.0);
    contour.powf(options.contour_power) * r.area.powf(area_power)
}

/// Disjoint nodes of at least `min_area` at or below `starts` with the largest total score.
fn best_nodes(tree: &Tree, starts: &[usize], min_area: f32, score: impl Fn(usize) -> f32) -> Vec<usize> {
    // children precede parents: one pass from the leaves up
    let mut best = vec![0.0f32; tree.nodes.len()];
    let mut own = vec![false; tree.nodes.len()];
    for n in 0..tree.nodes.len() {
        let below = tree.nodes[n].children.map_or(0.0, |(a, b)| best[a] + best[b]);
        let here = if tree.nodes[n].region.area >= min_area { score(n) } else { 0.0 };
        own[n] = here > 0.0 && here >= below;
        best[n] = here.max(below);
    }
    let mut chosen = Vec::new();
    let mut stack: Vec<usize> = starts.to_vec();
    while let Some(n) = stack.pop() {
        if own[n] {
            chosen.push(n);
        } else if best[n] > 0.0 {
            stack.extend(children_of(tree, n));
        }
    }
    chosen.sort_unstable();
    chosen
}

/// Paints the chosen nodes into a label map; an uncovered superpixel joins the neighbour with the
/// longest common border.
fn paint(tree: &Tree, cues: &Cues, chosen: &[usize]) -> LevelMasks {
    let mut mask_of = vec![NONE; tree.leaves];
    for (mask, &node) in chosen.iter().enumerate() {
        let mut stack = vec![node];
        while let Some(n) = stack.pop() {
            if n < tree.leaves {
                mask_of[n] = mask;
            }
            stack.extend(children_of(tree, n));
        }
    }
    let borders = leaf_borders(cues);
    // every round assigns at least one leaf, or none is reachable
    loop {
        let open: Vec<usize> = (0..tree.leaves).filter(|&l| mask_of[l] == NONE).collect();
        let mut found: Vec<(usize, usize)> = Vec::new();
        for &leaf in &open {
            let mut share: BTreeMap<usize, u32> = BTreeMap::new();
            for (&other, &length) in &borders[leaf] {
                if mask_of[other] != NONE {
                    *share.entry(mask_of[other]).or_default() += length;
                }
            }
            if let Some((&mask, _)) = share.iter().max_by_key(|(m, n)| (**n, std::cmp::Reverse(**m))) {
                found.push((leaf, mask));
            }
        }
        if found.is_empty() {
            break;
        }
        for (leaf, mask) in found {
            mask_of[leaf] = mask;
        }
    }
    let label = |&l: &i32| if mask_of[l as usize] == NONE { -1 } else { mask_of[l as usize] as i32 };
    let (width, height) = (cues.labels.width, cues.labels.height);
    let labels = Image { width, height, data: cues.labels.data.iter().map(label).collect() };
    LevelMasks { labels, quality: vec![1.0; chosen.len()], ..LevelMasks::default() }
}

/// Border length between superpixels.
fn leaf_borders(cues: &Cues) -> Vec<BTreeMap<usize, u32>> {
    let labels = &cues.labels;
    let mut out = vec![BTreeMap::new(); cues.count];
    let mut add_border = |p: usize, q: usize| {
        let (a, b) = (labels.data[p] as usize, labels.data[q] as usize);
        if a != b {
            *out[a].entry(b).or_insert(0) += 1;
            *out[b].entry(a).or_insert(0) += 1;
        }
    };
    for y in 0..labels.height {
        for x in 0..labels.width {
            let p = y * labels.width + x;
            if x + 1 < labels.width {
                add_border(p, p + 1);
            }
            if y + 1 < labels.height {
                add_border(p, p + labels.width);
            }
        }
    }
    out
}
