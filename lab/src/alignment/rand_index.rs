//! Adjusted Rand index (Hubert and Arabie 1985) between predicted things and true objects.
use serde::Serialize;
use std::collections::BTreeMap;

/// Counts of pixels by predicted thing and true object.
#[derive(Clone, Debug, Default)]
pub struct Contingency {
    cells: BTreeMap<(u32, u32), f64>,
    things: BTreeMap<u32, f64>,
    objects: BTreeMap<u32, f64>,
    alone: f64,
}

/// Agreement of two partitions of pixels.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Agreement {
    /// Adjusted Rand index: 1 = the same partition, 0 = as good as chance.
    pub rand: f64,
    /// Share of the pairs in one thing that are of one object.
    pub precision: f64,
    /// Share of the pairs of one object that are in one thing.
    pub recall: f64,
}

impl Contingency {
    /// Counts a pixel; `None` is a thing of its own.
    pub fn add(&mut self, thing: Option<u32>, object: u32) {
        *self.objects.entry(object).or_default() += 1.0;
        match thing {
            Some(thing) => {
                *self.things.entry(thing).or_default() += 1.0;
                *self.cells.entry((thing, object)).or_default() += 1.0;
            }
            None => self.alone += 1.0,
        }
    }

    /// The agreement; perfect without pixels.
    pub fn agreement(&self) -> Agreement {
        let pairs = |n: &f64| 0.5 * n * (n - 1.0);
        let both: f64 = self.cells.values().map(pairs).sum();
        let things: f64 = self.things.values().map(pairs).sum();
        let objects: f64 = self.objects.values().map(pairs).sum();
        let all = pairs(&(self.things.values().sum::<f64>() + self.alone));
        let share = |part: f64, of: f64| if of > 0.0 { part / of } else { 1.0 };
        let chance = share(things * objects, all);
        let most = 0.5 * (things + objects);
        Agreement {
            rand: share(both - chance, most - chance),
            precision: share(both, things),
            recall: share(both, objects),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn agreement_matches_published_example() {
        // Hubert and Arabie 1985, by the contingency table of scikit-learn's user guide: labels
        // 0 0 0 1 1 1 against 0 0 1 1 2 2 have 0.2424.
        let mut table = Contingency::default();
        for (object, thing) in [0, 0, 0, 1, 1, 1].into_iter().zip([0, 0, 1, 1, 2, 2]) {
            table.add(Some(thing), object);
        }
        let agreement = table.agreement();
        assert!((agreement.rand - 0.242_424_24).abs() < 1e-6, "{agreement:?}");
        assert!(
            (agreement.precision - 2.0 / 3.0).abs() < 1e-12 && (agreement.recall - 2.0 / 6.0).abs() < 1e-12
        );
        let mut same = Contingency::default();
        (0..10).for_each(|k| same.add(Some(k / 3), 7 + k / 3));
        assert_eq!(same.agreement(), Agreement { rand: 1.0, precision: 1.0, recall: 1.0 });
        let mut none = Contingency::default();
        (0..10).for_each(|_| none.add(None, 1));
        assert_eq!(none.agreement().recall, 0.0);
    }
}
