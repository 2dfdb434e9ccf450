//! Proposals, fusion and reprojection scores of one level (docs/internals/method.md#alignment).
use super::super::ViewMasks;
use super::links::{Links, PairLinks};
use super::{AlignOptions, AreaScore, Edge, Fusion};
use crate::math::dot;
use crate::scene::{Image, MaskId};
use std::collections::{BTreeMap, BTreeSet};

/// The masks of one level over all views, with the labels that fusion may change.
pub(super) struct LevelState {
    pub labels: Vec<Image<i32>>,
    /// [view][mask · D] unit rows.
    pub features: Vec<Vec<f32>>,
    pub quality: Vec<Vec<f32>>,
    /// [view][mask] visible pixels; 0 for a mask that fusion absorbed.
    pub areas: Vec<Vec<u32>>,
    /// Cosines of different masks of one view, ascending; empty where the cosine itself counts.
    different: Vec<f64>,
}

/// Fewest pairs of masks of one view whose cosines make a scale.
const LEAST_PAIRS: usize = 12;
/// Most pairs per view.
const MOST_PAIRS: usize = 4096;

impl LevelState {
    pub fn new(views: &[ViewMasks], level: usize, ranked: bool) -> Self {
        let levels: Vec<_> = views.iter().map(|v| v.levels[level].clone()).collect();
        let mut state = LevelState {
            areas: Vec::new(),
            different: Vec::new(),
            labels: levels.iter().map(|l| l.labels.clone()).collect(),
            quality: levels.iter().map(|l| l.quality.clone()).collect(),
            features: levels.into_iter().map(|l| l.features).collect(),
        };
        state.areas = (0..views.len()).map(|t| state.count_areas(t)).collect();
        if ranked {
            state.different = state.cosines_within_views();
        }
        state
    }
    /// Cosines of different masks of one view, ascending; none if there are too few.
    fn cosines_within_views(&self) -> Vec<f64> {
        let mut cosines = Vec::new();
        for (view, areas) in self.areas.iter().enumerate() {
            let count = areas.len();
            let step = (count * count.saturating_sub(1) / 2).div_ceil(MOST_PAIRS).max(1);
            let pairs = (0..count).flat_map(|a| (a + 1..count).map(move |b| (a, b))).step_by(step);
            let visible = pairs.filter(|(a, b)| areas[*a] > 0 && areas[*b] > 0);
            cosines.extend(visible.map(|(a, b)| self.cosine(MaskId::new(view, a), MaskId::new(view, b))));
        }
        if cosines.len() < LEAST_PAIRS {
            return Vec::new();
        }
        cosines.sort_unstable_by(f64::total_cmp);
        cosines
    }
    /// Likeness of two masks, in 0..1: the share of the pairs of different masks of one view that
    /// are less alike, or the cosine where these are too few.
    pub fn likeness(&self, a: MaskId, b: MaskId) -> f64 {
        let cosine = self.cosine(a, b);
        if self.different.is_empty() {
            return cosine.max(0.0);
        }
        let below = self.different.partition_point(|c| *c < cosine);
        let up_to = self.different.partition_point(|c| *c <= cosine);
        0.5 * (below + up_to) as f64 / self.different.len() as f64
    }
    fn count_areas(&self, view: usize) -> Vec<u32> {
        let mut area = vec![0; self.quality[view].len()];
        for &l in self.labels[view].data.iter().filter(|&&l| l >= 0) {
            area[l as usize] += 1;
        }
        area
    }
    pub fn feature(&self, MaskId { view, mask }: MaskId) -> &[f32] {
        let dim = self.features[view as usize].len() / self.quality[view as usize].len().max(1);
        let start = mask as usize * dim;
        &self.features[view as usize][start..start + dim]
    }
    /// Cosine of two unit features.
    pub fn cosine(&self, a: MaskId, b: MaskId) -> f64 {
        dot(self.feature(a), self.feature(b))
    }
    /// Weight of a mask in its component: pixels times quality
    /// (docs/internals/method.md#components).
    pub fn weight(&self, MaskId { view, mask }: MaskId) -> f64 {
        self.areas[view as usize][mask as usize] as f64 * self.quality[view as usize][mask as usize] as f64
    }
    /// Writes labels, features and quality back.
    pub fn store(self, views: &mut [ViewMasks], level: usize) {
        let parts = self.labels.into_iter().zip(self.features).zip(self.quality);
        for (view, ((labels, features), quality)) in views.iter_mut().zip(parts) {
            let out = &mut view.levels[level];
            (out.labels, out.features, out.quality) = (labels, features, quality);
        }
    }
    /// Number of links between each mask of `from` and each mask of `to`.
    fn counts(&self, from: usize, to: usize, links: &Links) -> Counts {
        let mut counts = Counts { cols: self.quality[to].len(), data: Vec::new() };
        counts.data = vec![0; self.quality[from].len() * counts.cols];
        for (p, &a) in self.labels[from].data.iter().enumerate() {
            let Some(q) = links.target(p).filter(|_| a >= 0) else { continue };
            let b = self.labels[to].data[q];
            if b >= 0 {
                counts.data[a as usize * counts.cols + b as usize] += 1;
            }
        }
        counts
    }
    /// Number of pixels of each mask of `view` whose position has a match in `links`.
    fn matched_positions(&self, view: usize, links: &Links) -> Vec<u32> {
        let mut area = vec![0; self.quality[view].len()];
        for (p, &b) in self.labels[view].data.iter().enumerate() {
            if b >= 0 && links.target(p).is_some() {
                area[b as usize] += 1;
            }
        }
        area
    }
    /// Pixels of each mask of `view` that the other view could see.
    fn visible_areas(&self, view: usize, links: &Links) -> Vec<u32> {
        let mut area = vec![0; self.quality[view].len()];
        for (p, &a) in self.labels[view].data.iter().enumerate() {
            if a >= 0 && links.visible(p) {
                area[a as usize] += 1;
            }
        }
        area
    }
}

/// A dense count matrix, masks of one view by masks of another.
struct Counts {
    cols: usize,
    data: Vec<u32>,
}

impl Counts {
    fn at(&self, a: usize, b: usize) -> u32 {
        self.data[a * self.cols + b]
    }
    fn row(&self, a: usize) -> &[u32] {
        &self.data[a * self.cols..(a + 1) * self.cols]
    }
}

/// Best partner per (source view, source mask, target view).
pub(super) type Table = BTreeMap<(u32, u32, u32), Edge>;

/// Both directions of a pair: (from, to, links there, links back).
fn directions(pair: &PairLinks) -> [(usize, usize, &Links, &Links); 2] {
    [(pair.i, pair.j, &pair.forward, &pair.backward), (pair.j, pair.i, &pair.backward, &pair.forward)]
}

/// argmax of a count row; ties go to the higher cosine, then to the smaller index.
fn best_partner(state: &LevelState, row: &[u32], source: MaskId, view: u32) -> Option<usize> {
    let top = *row.iter().max().filter(|&&n| n > 0)?;
    let mut best: Option<(f64, usize)> = None;
    for (b, _) in row.iter().enumerate().filter(|(_, n)| **n == top) {
        let cosine = state.cosine(source, MaskId { view, mask: b as u32 });
        if best.is_none_or(|(c, _)| cosine > c) {
            best = Some((cosine, b));
        }
    }
    best.map(|(_, b)| b)
}

fn edge(state: &LevelState, step: u8, from: MaskId, to: MaskId, area: f64, options: &AlignOptions) -> Edge {
    let lang = state.likeness(from, to);
    Edge { step, from, to, area, lang, score: options.lambda * lang + (1.0 - options.lambda) * area }
}

/// Step 1 (docs/internals/method.md#pixel-matching): every mask proposes the mask that most of its
/// matches fall into.
pub(super) fn match_proposals(
    state: &LevelState,
    pairs: &[PairLinks],
    options: &AlignOptions,
    step: u8,
) -> Table {
    let mut table = Table::new();
    for (i, j, links, back) in pairs.iter().flat_map(directions) {
        let (there, back) = (state.counts(i, j, links), state.counts(j, i, back));
        let matched = match options.area {
            AreaScore::SamePlace => state.matched_positions(j, links),
            _ => Vec::new(),
        };
        let n_min = options.min_matches(state.labels[i].data.len());
        for a in 0..state.quality[i].len() {
            let source = MaskId::new(i, a);
            let Some(b) = best_partner(state, there.row(a), source, j as u32) else { continue };
            if there.at(a, b) < n_min {
                continue;
            }
            let size = state.areas[j][b].max(1) as f64;
            let area = match options.area {
                AreaScore::Coverage => back.at(b, a) as f64 / size,
                AreaScore::Paper => (there.at(a, b) as f64 / size).min(1.0),
                AreaScore::SamePlace => matched[b] as f64 / size,
            };
            let e = edge(state, step, source, MaskId::new(j, b), area, options);
            if e.score > options.tau1 {
                table.insert((source.view, source.mask, j as u32), e);
            }
        }
    }
    table
}

/// Edges between masks that fusion left alone belong to step 1.
pub(super) fn mark_unfused(table: &mut Table, fused: &[Fusion]) {
    let touched: BTreeSet<MaskId> = fused.iter().map(|f| MaskId { view: f.view, mask: f.kept }).collect();
    for e in table.values_mut() {
        if !touched.contains(&e.from) && !touched.contains(&e.to) {
            e.step = 1;
        }
    }
}

/// Masks of one view that one mask of another view covers together.
struct FusionSet {
    view: usize,
    members: Vec<usize>,
    target: MaskId,
    coverage: f64,
}

/// Step 2 (docs/internals/method.md#mask-fusion): relabels every fusion set to its smallest id;
/// returns the joined pairs.
pub(super) fn fuse(state: &mut LevelState, pairs: &[PairLinks], options: &AlignOptions) -> Vec<Fusion> {
    let mut sets = fusion_sets(state, pairs, options);
    sets.sort_by(|x, y| {
        y.coverage.total_cmp(&x.coverage).then_with(|| (x.view, x.target).cmp(&(y.view, y.target)))
    });
    let mut parent: Vec<Vec<usize>> = state.quality.iter().map(|q| (0..q.len()).collect()).collect();
    let mut taken = BTreeSet::new();
    let mut features = Vec::new();
    for set in &sets {
        // a mask joins at most one fusion set per target view
        let fresh = |m: &usize| !taken.contains(&(set.view, *m, set.target.view));
        let members: Vec<usize> = set.members.iter().copied().filter(fresh).collect();
        if members.len() < 2 {
            continue;
        }
        for &m in &members {
            taken.insert((set.view, m, set.target.view));
            join(&mut parent[set.view], members[0], m);
        }
        features.push((set.view, members[0], state.feature(set.target).to_vec()));
    }
    // The fused mask takes the feature of its target mask (docs/internals/method.md#mask-fusion).
    // The strongest set is applied last, so its feature remains.
    for (view, member, feature) in features.into_iter().rev() {
        let start = find(&parent[view], member) * feature.len();
        state.features[view][start..start + feature.len()].copy_from_slice(&feature);
    }
    let mut fused = Vec::new();
    for (view, parent) in parent.iter().enumerate() {
        let absorbed: Vec<usize> = (0..parent.len()).filter(|&m| find(parent, m) != m).collect();
        if absorbed.is_empty() {
            continue;
        }
        for &m in &absorbed {
            let root = find(parent, m);
            let (wa, wb) = (state.areas[view][root] as f32, state.areas[view][m] as f32);
            let quality = &mut state.quality[view];
            quality[root] = (quality[root] * wa + quality[m] * wb) / (wa + wb).max(1.0);
            fused.push(Fusion { view: view as u32, kept: root as u32, absorbed: m as u32 });
        }
        for l in state.labels[view].data.iter_mut().filter(|l| **l >= 0) {
            *l = find(parent, *l as usize) as i32;
        }
        state.areas[view] = state.count_areas(view);
    }
    fused
}

fn find(parent: &[usize], mut m: usize) -> usize {
    while parent[m] != m {
        m = parent[m];
    }
    m
}

/// Joins two sets under the smaller root.
fn join(parent: &mut [usize], a: usize, b: usize) {
    let (a, b) = (find(parent, a), find(parent, b));
    parent[a.max(b)] = a.min(b);
}

fn fusion_sets(state: &LevelState, pairs: &[PairLinks], options: &AlignOptions) -> Vec<FusionSet> {
    let table = match_proposals(state, pairs, options, 1);
    let mut sets = Vec::new();
    for (i, j, there, back) in pairs.iter().flat_map(directions) {
        let (there, back) = (state.counts(i, j, there), state.counts(j, i, back));
        let background = options.background_share * state.labels[j].data.len() as f64;
        for b in 0..state.quality[j].len() {
            let target = MaskId::new(j, b);
            let size = state.areas[j][b] as f64;
            if size == 0.0 || size > background {
                continue;
            }
            let chosen =
                |a: &usize| table.get(&(i as u32, *a as u32, j as u32)).is_some_and(|e| e.to == target);
            let members: Vec<usize> = (0..state.quality[i].len()).filter(chosen).collect();
            if members.len() < 2 {
                continue;
            }
            let contained = |&a: &usize| {
                let all: u32 = there.row(a).iter().sum();
                there.at(a, b) as f64 >= options.containment * all as f64
            };
            let coverage = members.iter().map(|&a| back.at(b, a) as f64).sum::<f64>() / size;
            // with little coverage the members may be only a part of the target
            let whole = coverage >= options.fusion_cover && members.iter().all(contained);
            let agreed = || !options.votes || is_voted(&table, i, &members, j, state.labels.len());
            if whole && agreed() {
                sets.push(FusionSet { view: i, members, target, coverage });
            }
        }
    }
    sets
}

/// Whether at least as many views show masks of view `i` as one mask as show them as several; `j`
/// shows them as one. A
/// view that matches fewer than two of them has no vote.
fn is_voted(table: &Table, i: usize, members: &[usize], j: usize, views: usize) -> bool {
    let (mut one, mut several) = (1, 0);
    for k in (0..views).filter(|k| *k != i && *k != j) {
        let partners: Vec<MaskId> =
            members.iter().filter_map(|a| Some(table.get(&(i as u32, *a as u32, k as u32))?.to)).collect();
        match partners.iter().all(|to| *to == partners[0]) {
            _ if partners.len() < 2 => {}
            true => one += 1,
            false => several += 1,
        }
    }
    one >= several
}

/// Step 3 (docs/internals/method.md#reprojection): mutual best partners through depth and poses;
/// they replace weaker matches from the same source and delete matches that geometry contradicts.
pub(super) fn add_reprojections(
    table: &mut Table,
    state: &LevelState,
    pairs: &[PairLinks],
    options: &AlignOptions,
) {
    for pair in pairs {
        let counts =
            [state.counts(pair.i, pair.j, &pair.forward), state.counts(pair.j, pair.i, &pair.backward)];
        for (k, (i, j, _, back_links)) in directions(pair).into_iter().enumerate() {
            let (there, back) = (&counts[k], &counts[1 - k]);
            let visible = state.visible_areas(j, back_links);
            let n_min = options.min_matches(state.labels[i].data.len());
            drop_contradicted(table, (i, j), there, n_min);
            for a in 0..state.quality[i].len() {
                let source = MaskId::new(i, a);
                let Some(b) = best_partner(state, there.row(a), source, j as u32) else { continue };
                let mutual = || best_partner(state, back.row(b), MaskId::new(j, b), i as u32) == Some(a);
                if there.at(a, b) < n_min || (options.mutual && !mutual()) {
                    continue;
                }
                let area = match options.area {
                    AreaScore::Coverage => back.at(b, a) as f64 / visible[b].max(1) as f64,
                    AreaScore::Paper | AreaScore::SamePlace => {
                        (there.at(a, b) as f64 / state.areas[j][b].max(1) as f64).min(1.0)
                    }
                };
                let e = edge(state, 3, source, MaskId::new(j, b), area, options);
                if e.score <= options.tau2 {
                    continue;
                }
                let slot = table.entry((source.view, source.mask, j as u32)).or_insert(e);
                if e.score >= slot.score {
                    *slot = e;
                }
            }
        }
    }
}

/// Removes matches i → j and j → i whose source projects into view j with enough pixels, none of
/// them on the partner.
fn drop_contradicted(table: &mut Table, (i, j): (usize, usize), there: &Counts, n_min: u32) {
    table.retain(|_, e| {
        let (a, b) = if (e.from.view, e.to.view) == (i as u32, j as u32) {
            (e.from.mask as usize, e.to.mask as usize)
        } else if (e.to.view, e.from.view) == (i as u32, j as u32) {
            (e.to.mask as usize, e.from.mask as usize)
        } else {
            return true;
        };
        let seen: u32 = there.row(a).iter().sum();
        e.step == 3 || seen < n_min || there.at(a, b) > 0
    });
}

/// Keeps the edge with the largest score per unordered pair of masks; best first, step 3 first
/// among equal scores.
pub(super) fn undirected(table: Table) -> Vec<Edge> {
    let mut best: BTreeMap<(MaskId, MaskId), Edge> = BTreeMap::new();
    for e in table.into_values() {
        let key = (e.from.min(e.to), e.from.max(e.to));
        let slot = best.entry(key).or_insert(e);
        if (e.score, e.step) > (slot.score, slot.step) {
            *slot = e;
        }
    }
    let mut edges: Vec<((MaskId, MaskId), Edge)> = best.into_iter().collect();
    edges.sort_by(|(ka, a), (kb, b)| {
        b.score.total_cmp(&a.score).then((b.step == 3).cmp(&(a.step == 3))).then(ka.cmp(kb))
    });
    edges.into_iter().map(|(_, e)| e).collect()
}
