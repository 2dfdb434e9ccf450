//! Non-maximum suppression of overlapping masks.
use super::bits::Bits;
use rayon::prelude::*;
use std::ops::Range;

/// A candidate mask.
#[derive(Clone, Debug)]
pub(super) struct Mask {
    pub bits: Bits,
    pub iou: f32,
    pub stability: f32,
    pub crop: usize,
    /// Whether the clean-up changed it.
    pub changed: bool,
}

impl Mask {
    pub fn score(&self) -> f32 {
        self.iou * self.stability
    }
}

/// A mask lies inside a larger one if at least the first share of it overlaps and this is less than
/// the second share of the other (docs/internals/method.md#masks-from-points).
const INSIDE: (f32, f32) = (0.85, 0.5);

/// Intersection over union of boxes.
fn box_overlap(a: &(Range<usize>, Range<usize>), b: &(Range<usize>, Range<usize>)) -> f32 {
    // Boxes as SAM measures them: between the centres of the outermost pixels.
    let side = |r: &Range<usize>| r.len().saturating_sub(1) as f32;
    let both = common_length(&a.0, &b.0) * common_length(&a.1, &b.1);
    let either = side(&a.0) * side(&a.1) + side(&b.0) * side(&b.1) - both;
    if either > 0.0 { both / either } else { 0.0 }
}

fn common_length(a: &Range<usize>, b: &Range<usize>) -> f32 {
    (a.end.min(b.end) as f32 - 1.0 - a.start.max(b.start) as f32).max(0.0)
}

/// Keeps masks whose boxes overlap no better one's by an IoU above `most`, in list order. Ties go
/// to the higher predicted IoU, then to the first.
pub(super) fn boxes(masks: Vec<Mask>, most: f32, score: impl Fn(&Mask) -> f32) -> Vec<Mask> {
    let mut order: Vec<usize> = (0..masks.len()).collect();
    let rank = |i: usize| (score(&masks[i]), masks[i].iou);
    order.sort_by(|a, b| rank(*b).0.total_cmp(&rank(*a).0).then(rank(*b).1.total_cmp(&rank(*a).1)));
    let mut kept: Vec<usize> = Vec::new();
    for i in order {
        if kept.iter().all(|k| box_overlap(&masks[*k].bits.bounds, &masks[i].bits.bounds) <= most) {
            kept.push(i);
        }
    }
    let mut stays = vec![false; masks.len()];
    kept.into_iter().for_each(|k| stays[k] = true);
    masks.into_iter().zip(stays).filter(|(_, s)| *s).map(|(m, _)| m).collect()
}

/// Whether another mask suppresses `own`: as a better duplicate, or as a larger mask around it.
fn is_suppressed(own: &Mask, other: &Mask, better: bool, most: f32) -> bool {
    let shared = own.bits.shared(&other.bits) as f32;
    let (a, b) = (own.bits.count() as f32, other.bits.count() as f32);
    let duplicate = better && shared / (a + b - shared) > most;
    let inner = shared / a >= INSIDE.0 && shared / b < INSIDE.1;
    shared > 0.0 && (duplicate || inner)
}

/// Drops masks that overlap a better one by more than `most`, that score no more than `least`, or
/// of which at least 85 % lie inside a mask of the same level of which they cover less than half.
/// If nothing is left, the three best stay.
pub(super) fn masks(masks: Vec<Mask>, most: f32, least: f32) -> Vec<Mask> {
    let mut order: Vec<usize> = (0..masks.len()).collect();
    order.sort_by(|a, b| masks[*b].score().total_cmp(&masks[*a].score()));
    let stays = |rank: usize| {
        let own = &masks[order[rank]];
        let mut others = order.iter().enumerate().filter(|(other, _)| *other != rank);
        own.score() > least && !others.any(|(other, k)| is_suppressed(own, &masks[*k], other < rank, most))
    };
    let mut keep: Vec<bool> = (0..order.len()).into_par_iter().map(stays).collect();
    if !keep.contains(&true) {
        keep.iter_mut().take(3).for_each(|k| *k = true);
    }
    let mut kept: Vec<usize> = order.into_iter().zip(keep).filter(|(_, k)| *k).map(|(i, _)| i).collect();
    kept.sort_unstable();
    let mut place = masks.into_iter().map(Some).collect::<Vec<_>>();
    kept.into_iter().filter_map(|i| place[i].take()).collect()
}
