//! Repeated measurements and the quartiles of their times.
use crate::Result;
use serde::{Deserialize, Serialize};
use std::time::Instant;

/// How long one measurement runs.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Budget {
    /// Repeats for this long, but at least [`MIN_RUNS`] times.
    pub seconds: f64,
    /// Exactly this often instead.
    pub repeats: Option<usize>,
}

/// Fewer runs have no quartiles.
pub const MIN_RUNS: usize = 5;
/// Runs that are not counted: the driver compiles shaders at the first, caches and clocks settle at
/// the second …
const WARM_UP: usize = 2;
/// … and, when a time is given, for this share of it.
const WARM_UP_SHARE: f64 = 0.1;

impl Default for Budget {
    fn default() -> Self {
        Budget { seconds: 2.0, repeats: None }
    }
}

impl Budget {
    /// Calls `run` to warm up and then until the budget is used; what each counted call returned.
    pub fn repeat<T>(&self, mut run: impl FnMut() -> Result<T>) -> Result<Vec<T>> {
        let start = Instant::now();
        let mut warm = 0;
        while warm < WARM_UP
            || (self.repeats.is_none() && start.elapsed().as_secs_f64() < WARM_UP_SHARE * self.seconds)
        {
            run()?;
            warm += 1;
        }
        let start = Instant::now();
        let mut results = Vec::new();
        loop {
            let done = match self.repeats {
                Some(n) => results.len() >= n.max(1),
                None => results.len() >= MIN_RUNS && start.elapsed().as_secs_f64() >= self.seconds,
            };
            if done {
                return Ok(results);
            }
            results.push(run()?);
        }
    }

    /// Wall-clock milliseconds of each call.
    pub fn wall(&self, mut run: impl FnMut() -> Result<()>) -> Result<Quartiles> {
        let runs = self.repeat(|| {
            let (processor, start) = (processor_ms(), Instant::now());
            run()?;
            let wall = start.elapsed().as_secs_f64() * 1e3;
            Ok((wall, (processor_ms() - processor) / cores()))
        })?;
        let times: Vec<f64> = runs.iter().map(|r| r.0).collect();
        let processor = Quartiles::of(&runs.iter().map(|r| r.1).collect::<Vec<_>>()).median;
        Ok(Quartiles { processor, ..Quartiles::of(&times) })
    }
}

/// Processor milliseconds of all threads of this process so far, as Linux counts them; 0 elsewhere.
pub(super) fn processor_ms() -> f64 {
    let Ok(threads) = std::fs::read_dir("/proc/self/task") else { return 0.0 };
    let nanoseconds = |thread: std::io::Result<std::fs::DirEntry>| {
        let text = std::fs::read_to_string(thread.ok()?.path().join("schedstat")).ok()?;
        text.split_whitespace().next()?.parse::<f64>().ok()
    };
    threads.filter_map(nanoseconds).sum::<f64>() / 1e6
}

/// Of the host, as far as this process may use them.
pub(super) fn cores() -> f64 {
    std::thread::available_parallelism().map_or(1, usize::from) as f64
}

/// The distribution of repeated times, milliseconds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Quartiles {
    /// Half of the runs took at most this.
    pub median: f64,
    /// A quarter took at most this …
    pub lower_quartile: f64,
    /// … and a quarter at least this.
    pub upper_quartile: f64,
    /// The fastest run.
    pub best: f64,
    /// How many runs.
    pub runs: usize,
    /// Median of the processor time of this process, all threads, divided by the cores: on a CPU
    /// device about what a run would take if nothing else ran. 0 where it was not taken.
    #[serde(default)]
    pub processor: f64,
}

impl Quartiles {
    /// Of the given times; all zero when there are none.
    pub fn of(times: &[f64]) -> Quartiles {
        let mut sorted = times.to_vec();
        sorted.sort_by(f64::total_cmp);
        // Linear interpolation between the order statistics.
        let at = |share: f64| {
            let x = share * sorted.len().saturating_sub(1) as f64;
            let (low, high) = (x.floor() as usize, x.ceil() as usize);
            match (sorted.get(low), sorted.get(high)) {
                (Some(a), Some(b)) => a + (b - a) * (x - low as f64),
                _ => 0.0,
            }
        };
        Quartiles {
            median: at(0.5),
            lower_quartile: at(0.25),
            upper_quartile: at(0.75),
            best: at(0.0),
            runs: times.len(),
            processor: 0.0,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quartiles_of_known_times() {
        let s = Quartiles::of(&[5.0, 1.0, 2.0, 4.0, 3.0]);
        assert_eq!((s.best, s.lower_quartile, s.median, s.upper_quartile, s.runs), (1.0, 2.0, 3.0, 4.0, 5));
        let s = Quartiles::of(&[1.0, 2.0]);
        assert_eq!((s.lower_quartile, s.median), (1.25, 1.5));
        assert_eq!(Quartiles::of(&[]), Quartiles::default());
    }

    #[test]
    fn warm_up_is_not_counted_and_repeats_are_exact() {
        let mut calls = 0;
        let budget = Budget { seconds: 0.0, repeats: Some(3) };
        let seen = budget
            .repeat(|| {
                calls += 1;
                Ok(calls)
            })
            .unwrap();
        assert_eq!(seen, [3, 4, 5]);
        assert_eq!(Budget { seconds: 0.0, repeats: None }.repeat(|| Ok(())).unwrap().len(), MIN_RUNS);
    }
}
