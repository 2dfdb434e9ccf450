//! Parts that another part of the same whole encloses, such as the inside of a mug and the label of
//! a box: they are no objects of their own.
use super::instances::{Instance, Places};
use super::things::Thing;
use crate::scene::LEVEL_NAMES;
use std::collections::BTreeMap;

/// Share of its splats in the box of another part from which that one encloses a part. In
/// `breakfast` and generated seeds 1 to 4 (tuning) those of one thing have 0.72 and more, a lemon
/// on its plate 0.44.
const ENCLOSED: f64 = 0.6;
/// Side of the box, relative to that of the part, whose outermost splats are not in its own.
const GROWN: f64 = 1.1;

impl Places {
    /// Per part the index of the part that it is one object with: its own, or that of the part which
    /// encloses it. Those at `apart` are enclosed by none and enclose none.
    pub(super) fn enclosing(&self, parts: &[Thing], apart: impl Fn(usize) -> bool) -> Vec<usize> {
        let wholes = self.wholes(parts);
        let size = |k: usize| parts[k].instance.oriented.size.length();
        let of_part = |a: usize| {
            let may = |b: &usize| {
                let one_whole = wholes[a].is_some() && wholes[a] == wholes[*b];
                one_whole && size(*b) > size(a) && !apart(a) && !apart(*b)
            };
            let share = |b: usize| (self.share_inside(&parts[a].instance, &parts[b].instance), b);
            let most = (0..parts.len()).filter(may).map(share).max_by(|x, y| x.0.total_cmp(&y.0));
            most.filter(|(share, _)| *share >= ENCLOSED).map_or(a, |(_, b)| b)
        };
        let next: Vec<usize> = (0..parts.len()).map(of_part).collect();
        // An enclosing part is larger, so that chains end.
        let last = |mut k: usize| {
            while next[k] != k {
                k = next[k];
            }
            k
        };
        (0..parts.len()).map(last).collect()
    }

    /// Share of the splats of a part in the box of another one.
    fn share_inside(&self, part: &Instance, other: &Instance) -> f64 {
        let bounds = &other.oriented;
        let is_inside = |i: &&usize| {
            let from = self.centres()[**i] - bounds.centre;
            (0..3).all(|k| 2.0 * from.dot(bounds.axes[k]).abs() <= GROWN * bounds.size[k])
        };
        part.splats.iter().filter(is_inside).count() as f64 / part.splats.len().max(1) as f64
    }

    /// Per part the code of the coarsest level that most of its splats have.
    fn wholes(&self, parts: &[Thing]) -> Vec<Option<usize>> {
        let mut codes = vec![None; self.centres().len()];
        if let Some(lists) = self.lists().get(LEVEL_NAMES.len() - 1) {
            for code in 0..lists.counts().count() {
                lists.splats_of(std::iter::once(code)).into_iter().for_each(|i| codes[i] = Some(code));
            }
        }
        let most_common = |part: &Thing| {
            let mut counts: BTreeMap<usize, usize> = BTreeMap::new();
            let own = part.instance.splats.iter().filter_map(|i| codes[*i]);
            own.for_each(|code| *counts.entry(code).or_default() += 1);
            let (code, count) = counts.into_iter().max_by_key(|(code, count)| (*count, *code))?;
            (2 * count > part.instance.splats.len()).then_some(code)
        };
        parts.iter().map(most_common).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::level_of;
    use super::super::things::OBJECTS;
    use super::*;
    use crate::scene::{LanguageField, LevelField, Splats};

    /// Splats of cubes: centre, half of the side, and the codes of part and whole.
    fn places(cubes: &[([f32; 3], f32, usize, usize)]) -> Places {
        let (mut means, mut codes): (Vec<[f32; 3]>, Vec<[usize; 2]>) = Default::default();
        for (centre, half, part, whole) in cubes {
            for k in 0..1000 {
                let at = [k % 10, k / 10 % 10, k / 100].map(|v| half * (v as f32 / 4.5 - 1.0));
                means.push([0, 1, 2].map(|axis| centre[axis] + at[axis]));
                codes.push([*part, *whole]);
            }
        }
        let count = means.len();
        let level = |at: usize| level_of(codes.iter().map(|own| own[at]), 4);
        let splats = Splats {
            means,
            log_scales: vec![[0.2f32.ln(); 3]; count],
            quats: vec![[1.0, 0.0, 0.0, 0.0]; count],
            opacity_logits: vec![2.0; count],
            ..Splats::default()
        };
        let levels = vec![LevelField::default(), level(0), level(1)];
        Places::of(&splats, &LanguageField { levels, space: String::new() })
    }

    #[test]
    fn enclosed_parts_of_one_whole_are_one_object() {
        let mug = ([0.0; 3], 1.0, 0, 0);
        let objects = |other: ([f32; 3], f32, usize, usize)| {
            let found = places(&[mug, other]).objects();
            assert!(found.iter().all(|o| o.level == OBJECTS && !o.is_surface));
            found.iter().map(|o| o.instance.splats.len()).collect::<Vec<_>>()
        };
        let inside = ([0.3, 0.0, 0.0], 0.5, 1, 0);
        assert_eq!(objects(inside), [2000]);
        // In another whole, and half outside.
        assert_eq!(objects(([0.3, 0.0, 0.0], 0.5, 1, 1)), [1000, 1000]);
        assert_eq!(objects(([1.2, 0.0, 0.0], 0.5, 1, 0)), [1000, 1000]);
    }
}
