//! Three cuts of the merge tree: each takes, along every branch, the region that survives longest.
//!
//! A fixed threshold cuts plain and printed things at different depths. What people call a thing is instead a node
//! that forms early and is absorbed late, so level l is the set of disjoint nodes with the largest total persistence
//! (the excess-of-mass rule of HDBSCAN, Campello et al. 2013), m the best such set strictly inside l's nodes, s inside
//! m's.
use super::options::{Cues, GraphOptions};
use super::tree::Tree;
use crate::language::{LevelMasks, ViewMasks};
use crate::scene::Plane;
use std::collections::BTreeMap;

/// No mask.
const NONE: usize = usize::MAX;

pub(super) fn cut(tree: &Tree, cues: &Cues, options: &GraphOptions) -> ViewMasks {
    let total = cues.labels.data.len() as f32;
    let roots: Vec<usize> = (0..tree.nodes.len()).filter(|&n| tree.nodes[n].parent == NONE).collect();
    let mut levels = Vec::new();
    // the whole image is no thing: level l starts inside it
    let mut starts: Vec<usize> = roots.iter().flat_map(|&r| inside(tree, r)).collect();
    for factor in [16.0, 4.0, 1.0] {
        let min_area = options.min_mask * factor * total;
        let mut chosen = most_persistent(tree, &starts, min_area, options);
        if chosen.is_empty() {
            // nothing stands out: the image is one thing
            chosen.clone_from(&roots);
        }
        starts = chosen.iter().flat_map(|&n| parts(tree, n, min_area / 4.0)).collect();
        levels.push(paint(tree, cues, &chosen));
    }
    levels.reverse();
    ViewMasks { levels }
}

/// The two halves of a node; none for a leaf.
fn inside(tree: &Tree, node: usize) -> Vec<usize> {
    tree.nodes[node].children.map_or(Vec::new(), |(a, b)| vec![a, b])
}

/// The branches that a finer level may show inside `node`: both sides of the first split, from the top, whose smaller
/// side could be a mask itself. What is trimmed off above that split is not a part but a ragged edge.
fn parts(tree: &Tree, node: usize, min_area: f32) -> Vec<usize> {
    let mut n = node;
    while let Some((a, b)) = tree.nodes[n].children {
        let (large, small) =
            if tree.nodes[a].region.area >= tree.nodes[b].region.area { (a, b) } else { (b, a) };
        if tree.nodes[small].region.area >= min_area {
            return vec![large, small];
        }
        n = large;
    }
    // a thing without parts is its own part
    vec![node]
}

/// Height at which the region was essentially complete: gaining or losing a share `same` of its area does not make it
/// another region.
fn birth(tree: &Tree, node: usize, same: f32) -> f32 {
    let limit = (1.0 - same) * tree.nodes[node].region.area;
    let mut n = node;
    while let Some((a, b)) = tree.nodes[n].children {
        let larger = if tree.nodes[a].region.area >= tree.nodes[b].region.area { a } else { b };
        if tree.nodes[larger].region.area < limit {
            break;
        }
        n = larger;
    }
    tree.nodes[n].height
}

/// Height at which the region became part of something else.
fn death(tree: &Tree, node: usize, same: f32) -> f32 {
    let limit = tree.nodes[node].region.area * (1.0 + same);
    let mut n = node;
    while tree.nodes[n].parent != NONE && tree.nodes[n].region.area <= limit {
        n = tree.nodes[n].parent;
    }
    tree.nodes[n].height
}

/// Disjoint nodes at or below `starts` with the largest total score.
fn most_persistent(tree: &Tree, starts: &[usize], min_area: f32, options: &GraphOptions) -> Vec<usize> {
    let score = |n: usize| {
        let node = &tree.nodes[n];
        if node.region.area < min_area || node.parent == NONE {
            return 0.0;
        }
        let birth = birth(tree, n, options.same).max(options.floor);
        let death = death(tree, n, options.same).max(options.floor);
        let r = &node.region;
        let contour = r.contour / (r.perimeter - r.frame).max(1.0);
        (death / birth).ln().powf(options.life_power)
            * contour.powf(options.contour_power)
            * node.region.area.powf(options.area_power)
    };
    // children precede parents: one pass from the leaves up
    let mut best = vec![0.0f32; tree.nodes.len()];
    let mut own = vec![false; tree.nodes.len()];
    for n in 0..tree.nodes.len() {
        let below = tree.nodes[n].children.map_or(0.0, |(a, b)| best[a] + best[b]);
        let here = score(n);
        own[n] = here > 0.0 && here >= below;
        best[n] = here.max(below);
    }
    let mut chosen = Vec::new();
    let mut stack: Vec<usize> = starts.to_vec();
    while let Some(n) = stack.pop() {
        if own[n] {
            chosen.push(n);
        } else if best[n] > 0.0 {
            stack.extend(inside(tree, n));
        }
    }
    chosen.sort_unstable();
    chosen
}

/// The chosen nodes as a label map; what none of them covers joins the neighbour it shares the longest border with.
fn paint(tree: &Tree, cues: &Cues, chosen: &[usize]) -> LevelMasks {
    let mut mask_of = vec![NONE; tree.leaves];
    for (mask, &node) in chosen.iter().enumerate() {
        let mut stack = vec![node];
        while let Some(n) = stack.pop() {
            if n < tree.leaves {
                mask_of[n] = mask;
            }
            stack.extend(inside(tree, n));
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
    let value = |&l: &i32| if mask_of[l as usize] == NONE { -1 } else { mask_of[l as usize] as i32 };
    let (width, height) = (cues.labels.width, cues.labels.height);
    let labels = Plane { width, height, data: cues.labels.data.iter().map(value).collect() };
    LevelMasks { labels, quality: vec![1.0; chosen.len()], ..LevelMasks::default() }
}

/// Border length between superpixels.
fn leaf_borders(cues: &Cues) -> Vec<BTreeMap<usize, u32>> {
    let labels = &cues.labels;
    let mut out = vec![BTreeMap::new(); cues.count];
    let mut join = |p: usize, q: usize| {
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
                join(p, p + 1);
            }
            if y + 1 < labels.height {
                join(p, p + labels.width);
            }
        }
    }
    out
}
