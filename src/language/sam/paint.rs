//! Masks → one label per pixel.
use super::nms::Mask;
use crate::language::LevelMasks;
use crate::language::dir::MIN_MASK_PIXELS;
use crate::scene::Plane;

/// Larger masks first, so that small ones lie on top, and of equal ones the better on top. Masks of which fewer than
/// [`MIN_MASK_PIXELS`] remain visible are dropped.
pub(super) fn labels(masks: &[Mask], width: usize, height: usize) -> LevelMasks {
    let mut order: Vec<usize> = (0..masks.len()).collect();
    order.sort_by(|a, b| {
        let (a, b) = (&masks[*a], &masks[*b]);
        b.bits.count().cmp(&a.bits.count()).then(a.score().total_cmp(&b.score()))
    });
    let mut labels = Plane::filled(width, height, -1i32);
    for index in order {
        masks[index].bits.ones().for_each(|p| labels.data[p] = index as i32);
    }
    let mut visible = vec![0usize; masks.len()];
    labels.data.iter().filter_map(|l| usize::try_from(*l).ok()).for_each(|l| visible[l] += 1);
    let mut out = LevelMasks::default();
    let mut place = vec![-1i32; masks.len()];
    for (k, mask) in masks.iter().enumerate().filter(|(k, _)| visible[*k] >= MIN_MASK_PIXELS) {
        place[k] = out.quality.len() as i32;
        out.quality.push(mask.score());
    }
    labels.data.iter_mut().for_each(|l| *l = usize::try_from(*l).map_or(-1, |l| place[l]));
    out.labels = labels;
    out
}
