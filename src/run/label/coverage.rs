//! Choice of views that together show most of the splats.
use rayon::prelude::*;

/// Weights of one view: (item, weight > 0) of the splats or cells that it shows.
pub(super) type Shown = Vec<(u32, f32)>;

/// The positive entries of a vector with one weight per item.
pub(super) fn shown(weights: impl Iterator<Item = f32>) -> Shown {
    (0..).zip(weights).filter(|(_, weight)| *weight > 0.0).collect()
}

/// Rows of `views` in the order of a greedy choice, at most `wanted`.
///
/// Each next view has the largest gain of `Σ_s ln(1 + Σ_c w_cs / w0)`, where w0 is the mean of the
/// weights. The sum is submodular, so that the greedy choice reaches 1 − 1/e of the best one. The
/// logarithm prefers items that no chosen view shows, and still values a second view. The choice
/// ends early where the gain falls below `least_gain` of the first one.
pub(super) fn most_covering(views: &[Shown], wanted: usize, least_gain: f64) -> Vec<usize> {
    let unit = mean(views);
    let items = views.iter().flatten().map(|(item, _)| *item as usize + 1).max().unwrap_or(0);
    let mut covered = vec![0.0f32; items];
    let mut open: Vec<usize> = (0..views.len()).collect();
    let (mut chosen, mut first) = (Vec::new(), None);
    while chosen.len() < wanted {
        let gains: Vec<f64> = open.par_iter().map(|&c| gain(&views[c], &covered, unit)).collect();
        let best = (0..open.len()).max_by(|a, b| gains[*a].total_cmp(&gains[*b]).then(b.cmp(a)));
        let Some(best) = best else { break };
        let enough = least_gain * *first.get_or_insert(gains[best]);
        if gains[best] <= 0.0 || gains[best] < enough {
            break;
        }
        let view = open.remove(best);
        views[view].iter().for_each(|(item, weight)| covered[*item as usize] += weight);
        chosen.push(view);
    }
    chosen
}

/// Mean weight; 1 without any.
fn mean(views: &[Shown]) -> f64 {
    let all = views.iter().flatten();
    let (sum, count) = all.fold((0.0, 0usize), |(sum, n), (_, w)| (sum + f64::from(*w), n + 1));
    if count == 0 { 1.0 } else { sum / count as f64 }
}

/// Gain of a view over those that cover `covered`.
fn gain(view: &Shown, covered: &[f32], unit: f64) -> f64 {
    let terms = view.iter().map(|(item, w)| f64::from(*w) / (unit + f64::from(covered[*item as usize])));
    terms.map(f64::ln_1p).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn greedy_choice_shows_every_splat() {
        // A view of half of the splats, nearly the same view again, one of the other half, an
        // empty one.
        let half = |range: std::ops::Range<usize>| {
            shown((0..100).map(move |i| if range.contains(&i) { 2.0 } else { 0.0 }))
        };
        let weights = [half(0..50), half(0..49), half(50..90), Shown::new()];
        assert_eq!(most_covering(&weights, 2, 0.0), [0, 2]);
        assert_eq!(most_covering(&weights, 9, 0.0), [0, 2, 1], "an empty view gains nothing");
        assert_eq!(most_covering(&weights, 9, 0.7), [0, 2], "the third gains too little");
        assert!(most_covering(&[], 3, 0.0).is_empty());
    }

    #[test]
    fn gain_is_difference_of_the_sum() {
        let (view, covered, unit) = ([1.0f32, 0.0, 4.0], [3.0f32, 1.0, 0.0], 2.0f64);
        let sum = |extra: f64| -> f64 {
            let terms = view.iter().zip(covered);
            terms.map(|(w, c)| (1.0 + (f64::from(c) + extra * f64::from(*w)) / unit).ln()).sum()
        };
        assert!((gain(&shown(view.into_iter()), &covered, unit) - (sum(1.0) - sum(0.0))).abs() < 1e-12);
    }
}
