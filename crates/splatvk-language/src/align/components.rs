//! Builds components, the things of a scene, from accepted edges
//! (docs/internals/method.md#components).
use super::Edge;
use super::score::LevelState;
use crate::scene::MaskId;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};

/// One thing of the scene: masks of different views that show it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Component {
    /// Ascending.
    pub members: Vec<MaskId>,
    /// Weighted medoid: the member whose feature, an actual feature vector, stands for the
    /// component.
    pub medoid: MaskId,
    /// Σ of the members' weights (pixels × quality).
    pub weight: f64,
}

/// Constrained union-find over the edges, best edge first. A union is refused when it would put two
/// masks of one view together (fused masks already share a label).
pub(super) fn build(state: &LevelState, edges: &[Edge]) -> Vec<Component> {
    let mut groups: Vec<Component> = Vec::new();
    let mut owner: BTreeMap<MaskId, usize> = BTreeMap::new();
    for (view, areas) in state.areas.iter().enumerate() {
        for (mask, _) in areas.iter().enumerate().filter(|(_, a)| **a > 0) {
            let key = MaskId::new(view, mask);
            owner.insert(key, groups.len());
            groups.push(Component { members: vec![key], medoid: key, weight: state.weight(key) });
        }
    }
    for e in edges {
        let (Some(&a), Some(&b)) = (owner.get(&e.from), owner.get(&e.to)) else { continue };
        if a == b || shares_view(&groups[a], &groups[b]) {
            continue;
        }
        let (keep, absorbed) = (a.min(b), a.max(b));
        let moved = std::mem::take(&mut groups[absorbed].members);
        for key in &moved {
            owner.insert(*key, keep);
        }
        let group = &mut groups[keep];
        group.members.extend(moved);
        group.members.sort_unstable();
        (group.medoid, group.weight) = medoid(state, &group.members);
    }
    groups.retain(|g| !g.members.is_empty());
    groups
}

fn shares_view(a: &Component, b: &Component) -> bool {
    let views: BTreeSet<u32> = a.members.iter().map(|m| m.view).collect();
    b.members.iter().any(|m| views.contains(&m.view))
}

/// `argmax_m Σ_k ω_k L_m·L_k` and `Σ ω`; ties go to the first member.
fn medoid(state: &LevelState, members: &[MaskId]) -> (MaskId, f64) {
    let mut best = (f64::NEG_INFINITY, members[0]);
    for &m in members {
        let value: f64 = members.iter().map(|&k| state.weight(k) * state.cosine(m, k)).sum();
        if value > best.0 {
            best = (value, m);
        }
    }
    (best.1, members.iter().map(|&m| state.weight(m)).sum())
}
