//! Repeated measurements and the quartiles of their times.
use crate::Result;
use serde::{Deserialize, Serialize};
use std::time::Instant;

/// Length of one measurement.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Budget {
    /// Seconds of repeated runs, of which there are at least [`MIN_RUNS`].
    pub seconds: f64,
    /// Exact number of runs instead.
    pub repeats: Option<usize>,
}

/// Fewest runs with quartiles.
pub const MIN_RUNS: usize = 5;
/// Fewest warm-up runs: the driver compiles shaders in the first, caches and clocks settle in the
/// second.
const WARM_UP: usize = 2;
/// Least share of [`Budget::seconds`] for warm-up runs.
const WARM_UP_SHARE: f64 = 0.1;

impl Default for Budget {
    fn default() -> Self {
        Budget { seconds: 2.0, repeats: None }
    }
}

impl Budget {
    /// Calls `run` to warm up and then until the budget is used; returns the results after the
    /// warm-up.
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

    /// Wall-clock milliseconds per call.
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

/// Number of host cores that this process may use.
pub(super) fn cores() -> f64 {
    std::thread::available_parallelism().map_or(1, usize::from) as f64
}

/// The distribution of repeated times, milliseconds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Quartiles {
    /// Median.
    pub median: f64,
    /// First quartile.
    pub lower_quartile: f64,
    /// Third quartile.
    pub upper_quartile: f64,
    /// The fastest run.
    pub best: f64,
    /// Number of runs.
    pub runs: usize,
    /// Median of the processor time of all threads of this process, divided by the cores: on a CPU
    /// device about the time of a run on an idle machine. 0 where it was not measured.
    #[serde(default)]
    pub processor: f64,
}

impl Quartiles {
    /// Quartiles of the given times; all zero without any.
    pub fn of(times: &[f64]) -> Quartiles {
        let mut sorted = times.to_vec();
        sorted.sort_by(f64::total_cmp);
        // Linear interpolation between the order statistics.
        let quantile = |share: f64| {
            let x = share * sorted.len().saturating_sub(1) as f64;
            let (low, high) = (x.floor() as usize, x.ceil() as usize);
            match (sorted.get(low), sorted.get(high)) {
                (Some(a), Some(b)) => a + (b - a) * (x - low as f64),
                _ => 0.0,
            }
        };
        Quartiles {
            median: quantile(0.5),
            lower_quartile: quantile(0.25),
            upper_quartile: quantile(0.75),
            best: quantile(0.0),
            runs: times.len(),
            processor: 0.0,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quartiles_of_known_times_match() {
        let s = Quartiles::of(&[5.0, 1.0, 2.0, 4.0, 3.0]);
        assert_eq!((s.best, s.lower_quartile, s.median, s.upper_quartile, s.runs), (1.0, 2.0, 3.0, 4.0, 5));
        let s = Quartiles::of(&[1.0, 2.0]);
        assert_eq!((s.lower_quartile, s.median), (1.25, 1.5));
        assert_eq!(Quartiles::of(&[]), Quartiles::default());
    }

    #[test]
    fn budget_repeats_exactly_after_warm_up() {
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
