//! Execution settings of networks.
use super::cache::{self, OutputKey};
use super::provider::{Provider, find};
use crate::progress::Progress;
use crate::sync::lock;
use crate::{Error, Result};
use std::fmt;
use std::sync::{Arc, Mutex, MutexGuard, OnceLock};

/// Execution settings of networks: the provider, and whether outputs are cached. Clones share them.
/// Several in one process may differ, but share the loaded library.
#[derive(Clone)]
pub struct Compute(Arc<Shared>);

struct Shared {
    asked: String,
    cached: bool,
    chosen: OnceLock<Result<Option<&'static Provider>, String>>,
    notes: Mutex<Vec<String>>,
    turn: Mutex<()>,
}

impl fmt::Debug for Compute {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Compute({}, cached: {})", self.0.asked, self.0.cached)
    }
}

impl Default for Compute {
    fn default() -> Self {
        Compute::by(None)
    }
}

impl Compute {
    /// Selects one of [`super::provider::NAMES`]; by default `SPLATVK_PROVIDER`, else `auto`.
    pub fn by(asked: Option<&str>) -> Compute {
        let variable = || std::env::var("SPLATVK_PROVIDER").ok().filter(|v| !v.is_empty());
        let asked = asked.map(str::to_owned).or_else(variable).unwrap_or_else(|| "auto".to_owned());
        Compute::new(asked, true)
    }

    fn new(asked: String, cached: bool) -> Compute {
        let (chosen, notes, turn) = Default::default();
        Compute(Arc::new(Shared { asked, cached, chosen, notes, turn }))
    }

    /// The same provider without the cache, for measurements.
    pub fn uncached(&self) -> Compute {
        Compute::new(self.0.asked.clone(), false)
    }

    /// Returns the cached result of `key`, else computes and stores it.
    pub fn remember(&self, key: OutputKey, compute: impl FnOnce() -> Result<Vec<f32>>) -> Result<Vec<f32>> {
        if self.0.cached { cache::remember(key, compute) } else { compute() }
    }

    /// Lock to hold while a large network is loaded: concurrent stages take turns, so that a run
    /// needs the memory of one network and every network has all cores.
    pub fn turn(&self) -> MutexGuard<'_, ()> {
        lock(&self.0.turn)
    }

    /// The provider of new sessions, tested by a graph of one node; `None` for the CPU. A provider
    /// that was requested by name and fails is an error.
    pub(super) fn selected(&self) -> Result<Option<&'static Provider>> {
        let found = || find(&self.0.asked, &mut |text| self.note(text));
        self.0.chosen.get_or_init(found).clone().map_err(Error::missing)
    }

    /// Name of the provider.
    pub fn name(&self) -> Result<&'static str> {
        Ok(self.selected()?.map_or("cpu", |p| p.name))
    }

    /// Whether the CPU may compute a network that the provider refuses: with `auto`, not with a
    /// provider requested by name.
    pub(super) fn replaceable(&self) -> bool {
        self.0.asked == "auto"
    }

    pub(super) fn note(&self, text: String) {
        lock(&self.0.notes).push(text);
    }

    /// Finds the provider and returns the problems since the last call, one sentence each.
    pub fn notes(&self) -> Result<Vec<String>> {
        self.selected()?;
        Ok(std::mem::take(&mut *lock(&self.0.notes)))
    }

    /// Reports [`Compute::notes`] as warnings.
    pub fn report(&self, progress: &dyn Progress) -> Result<()> {
        self.notes()?.iter().for_each(|n| progress.warn(n));
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn compute_settings_are_independent() {
        let (cpu, absent) = (Compute::by(Some("cpu")), Compute::by(Some("gpu")));
        assert_eq!(cpu.name().unwrap(), "cpu");
        assert!(absent.name().unwrap_err().to_string().contains("auto, cpu, cuda"));
        // The uncached settings ignore the cached value.
        let key = || OutputKey::new("test").text("two").values(&[std::process::id()]);
        let value = |compute: &Compute, v: f32| compute.remember(key(), || Ok(vec![v])).unwrap();
        assert_eq!(value(&cpu, 1.0), [1.0]);
        assert_eq!(value(&cpu, 2.0), [1.0]);
        assert_eq!(value(&cpu.uncached(), 3.0), [3.0]);
    }
}
