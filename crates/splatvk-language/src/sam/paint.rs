//! Paints masks into label maps.
use super::nms::Mask;
use crate::LevelMasks;
use crate::dir::MIN_MASK_PIXELS;
use crate::scene::Image;

/// Paints larger masks first, so that small ones lie on top, and of equal sizes the better one on
/// top; with `in_order` list order, cleaned-up masks on top. Masks of which fewer than
/// [`MIN_MASK_PIXELS`] remain visible are dropped.
pub(super) fn labels(masks: &[Mask], in_order: bool, width: usize, height: usize) -> LevelMasks {
    let mut order: Vec<usize> = (0..masks.len()).collect();
    if in_order {
        order.sort_by_key(|k| masks[*k].changed);
    } else {
        order.sort_by(|a, b| {
            let (a, b) = (&masks[*a], &masks[*b]);
            b.bits.count().cmp(&a.bits.count()).then(a.score().total_cmp(&b.score()))
        });
    }
    let mut labels = Image::filled(width, height, -1i32);
    for index in order {
        masks[index].bits.ones().for_each(|p| labels.data[p] = index as i32);
    }
    let mut visible = vec![0usize; masks.len()];
    labels.data.iter().filter_map(|l| usize::try_from(*l).ok()).for_each(|l| visible[l] += 1);
    let mut out = LevelMasks::default();
    let mut label_of = vec![-1i32; masks.len()];
    for (k, mask) in masks.iter().enumerate().filter(|(k, _)| visible[*k] >= MIN_MASK_PIXELS) {
        label_of[k] = out.quality.len() as i32;
        out.quality.push(mask.score());
    }
    labels.data.iter_mut().for_each(|l| *l = usize::try_from(*l).map_or(-1, |l| label_of[l]));
    out.whole = whole(masks, &label_of, width, height);
    if out.whole == std::slice::from_ref(&labels) {
        out.whole.clear();
    }
    out.labels = labels;
    out
}

/// Label maps of the complete masks that have a label, each in the first map where its pixels are
/// free.
fn whole(masks: &[Mask], label_of: &[i32], width: usize, height: usize) -> Vec<Image<i32>> {
    let mut maps: Vec<Image<i32>> = Vec::new();
    for (mask, label) in masks.iter().zip(label_of).filter(|(_, label)| **label >= 0) {
        let free = |map: &Image<i32>| mask.bits.ones().all(|p| map.data[p] < 0);
        let first = maps.iter().position(free).unwrap_or_else(|| {
            maps.push(Image::filled(width, height, -1));
            maps.len() - 1
        });
        mask.bits.ones().for_each(|p| maps[first].data[p] = *label);
    }
    maps
}
