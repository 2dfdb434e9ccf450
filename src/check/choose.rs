//! Choice of the faster one of two correct kernel variants, per device and driver.
use crate::Result;
use crate::gpu::{KernelVariant, VariantPair};
use std::collections::BTreeSet;
use std::time::{Duration, Instant};

/// Time that a variant must save, as a share of the time of the present one. A smaller gain is not
/// worth a change that the next timing may take back: the ratios of five timings on lavapipe,
/// beside other work, spread by 3 to 27 %.
pub const MARGIN: f64 = 0.05;

/// Wall-clock limit of a choice: longer, a first run would look stuck.
pub const LIMIT: Duration = Duration::from_secs(10);

/// Result for one pair of variants.
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub struct Choice {
    /// The default of the kind of device, and its replacement.
    pub variants: [KernelVariant; 2],
    /// The variant to use.
    pub chosen: KernelVariant,
    /// Times, or the reason why there are none.
    pub timing: Timing,
}

/// Times of two variants.
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub enum Timing {
    /// Both were run.
    Measured(Times),
    /// One or both gave wrong results, and neither was timed.
    Wrong,
    /// The device cannot run one of them.
    Unusable,
    /// The time was over before.
    OutOfTime,
}

/// Times of two variants that were run in turn.
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub struct Times {
    /// Median milliseconds.
    pub medians: [f64; 2],
    /// Median over the rounds of the second time, divided by the first. A clock that changes
    /// between the rounds changes the medians by its factor, but not this ratio.
    pub ratio: f64,
}

impl Times {
    /// Medians of rounds of milliseconds; zero without any.
    pub fn of(rounds: &[[f64; 2]]) -> Times {
        let median = |value: fn(&[f64; 2]) -> f64| {
            let mut values: Vec<f64> = rounds.iter().map(value).collect();
            values.sort_by(f64::total_cmp);
            values.get(values.len() / 2).copied().unwrap_or_default()
        };
        Times { medians: [median(|r| r[0]), median(|r| r[1])], ratio: median(|r| r[1] / r[0]) }
    }
}

/// Chooses for each pair: the correct variant, or the faster one if both are correct and it saves
/// [`MARGIN`], or else the present one. `remembered` names the present variants that are no
/// defaults. `time` measures the variants of a pair on a device that prefers the names chosen so
/// far; it is not called after `until`.
///
/// # Errors
/// Those of `time`.
pub fn choose(
    is_cpu: bool,
    remembered: &BTreeSet<String>,
    wrong: &BTreeSet<KernelVariant>,
    until: Instant,
    mut time: impl FnMut([KernelVariant; 2], &BTreeSet<String>) -> Result<Timing>,
) -> Result<Vec<Choice>> {
    let mut choices: Vec<Choice> = Vec::new();
    for pair in VariantPair::TIMED {
        let variants = pair.variants(is_cpu);
        let present = pair.preferred(is_cpu, remembered);
        let correct: Vec<KernelVariant> = variants.into_iter().filter(|v| !wrong.contains(v)).collect();
        choices.push(match correct[..] {
            [only] => Choice { variants, chosen: only, timing: Timing::Wrong },
            [] => Choice { variants, chosen: present, timing: Timing::Wrong },
            _ => {
                let timing = match Instant::now() < until {
                    true => time(variants, &preferred(&choices))?,
                    false => Timing::OutOfTime,
                };
                Choice { variants, chosen: faster(variants, present, timing), timing }
            }
        });
    }
    Ok(choices)
}

/// The present variant, unless the other one was faster by [`MARGIN`].
fn faster(variants: [KernelVariant; 2], present: KernelVariant, timing: Timing) -> KernelVariant {
    let Timing::Measured(Times { ratio, .. }) = timing else { return present };
    let of_other = if variants[0] == present { ratio } else { 1.0 / ratio };
    if of_other < 1.0 - MARGIN { present.replacement() } else { present }
}

/// Names to remember: the variants that were faster than the defaults. The replacement of a wrong
/// default is not among them, since the default is disabled.
pub fn preferred(choices: &[Choice]) -> BTreeSet<String> {
    let replaces = |c: &&Choice| c.chosen != c.variants[0] && c.timing != Timing::Wrong;
    choices.iter().filter(replaces).map(|c| c.chosen.name().to_owned()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    const LISTS: [KernelVariant; 2] = [KernelVariant::SortedLists, KernelVariant::CountedLists];

    fn measured(times: [f64; 2]) -> Result<Timing> {
        Ok(Timing::Measured(Times::of(&[times])))
    }

    #[test]
    fn changing_clock_keeps_ratio() {
        let times = Times::of(&[[10.0, 16.0], [10.0, 16.0], [10.0, 8.0], [5.0, 8.0], [5.0, 8.0]]);
        assert_eq!(times, Times { medians: [10.0, 8.0], ratio: 1.6 });
    }

    fn later() -> Instant {
        Instant::now() + Duration::from_secs(60)
    }

    /// Choices on a GPU where the lists take these milliseconds and every other variant takes 1.
    fn with_lists(times: [f64; 2], remembered: &[KernelVariant], wrong: &[KernelVariant]) -> Choice {
        let remembered = remembered.iter().map(|v| v.name().to_owned()).collect();
        let wrong: BTreeSet<KernelVariant> = wrong.iter().copied().collect();
        let time = |variants: [KernelVariant; 2], _: &BTreeSet<String>| {
            assert!(variants.iter().all(|v| !wrong.contains(v)), "{variants:?}");
            measured(if variants == LISTS { times } else { [1.0; 2] })
        };
        let choices = choose(false, &remembered, &wrong, later(), time).unwrap();
        assert_eq!(choices.len(), VariantPair::TIMED.len());
        let others = choices.iter().filter(|c| c.variants != LISTS && c.timing != Timing::Wrong);
        assert!(others.into_iter().all(|c| c.chosen == c.variants[0]), "{choices:?}");
        *choices.iter().find(|c| c.variants == LISTS).unwrap()
    }

    #[test]
    fn faster_variant_is_chosen_beyond_margin() {
        let [default, other] = LISTS;
        assert_eq!(with_lists([1.0, 0.9], &[], &[]).chosen, other);
        assert_eq!(with_lists([1.0, 0.96], &[], &[]).chosen, default);
        assert_eq!(with_lists([1.0, 1.04], &[other], &[]).chosen, other);
        assert_eq!(with_lists([0.96, 1.0], &[other], &[]).chosen, other);
        assert_eq!(with_lists([0.9, 1.0], &[other], &[]).chosen, default);
    }

    #[test]
    fn wrong_variant_is_never_chosen() {
        let [default, other] = LISTS;
        let found = with_lists([1.0, 0.1], &[other], &[other]);
        assert_eq!((found.chosen, found.timing), (default, Timing::Wrong));
        let found = with_lists([0.1, 1.0], &[], &[default]);
        assert_eq!((found.chosen, found.timing), (other, Timing::Wrong));
        assert!(preferred(&[found]).is_empty(), "the default is disabled instead");
        assert_eq!(with_lists([1.0, 0.1], &[], &LISTS).chosen, default);
    }

    #[test]
    fn late_pairs_keep_present_variants() {
        let until = Instant::now() + Duration::from_millis(200);
        let remembered = BTreeSet::from([KernelVariant::SsimStrips.name().to_owned()]);
        let mut timed = 0;
        let time = |_: [KernelVariant; 2], _: &BTreeSet<String>| {
            timed += 1;
            std::thread::sleep(until.saturating_duration_since(Instant::now()));
            measured([1.0, 0.5])
        };
        let choices = choose(false, &remembered, &BTreeSet::new(), until, time).unwrap();
        assert_eq!(timed, 1);
        assert!(choices[1..].iter().all(|c| c.timing == Timing::OutOfTime), "{choices:?}");
        let names = [KernelVariant::ChunkSort, KernelVariant::SsimStrips].map(|v| v.name().to_owned());
        assert_eq!(preferred(&choices), BTreeSet::from(names));
    }

    #[test]
    fn later_pairs_prefer_earlier_choices() {
        let mut seen = Vec::new();
        let time = |variants: [KernelVariant; 2], preferred: &BTreeSet<String>| {
            seen.push(preferred.clone());
            measured(if variants[0] == KernelVariant::ChunkSort { [2.0, 1.0] } else { [1.0; 2] })
        };
        choose(true, &BTreeSet::new(), &BTreeSet::new(), later(), time).unwrap();
        let sweep = BTreeSet::from([KernelVariant::SweepSort.name().to_owned()]);
        assert!(seen[0].is_empty() && seen[1..].iter().all(|names| *names == sweep), "{seen:?}");
    }
}
