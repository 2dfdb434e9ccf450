//! How networks are computed.
use super::cache::{self, OutputKey};
use super::provider::{Provider, find};
use crate::progress::Progress;
use crate::sync::lock;
use crate::{Error, Result};
use std::fmt;
use std::sync::{Arc, Mutex, MutexGuard, OnceLock};

/// How networks are computed: by which provider, and whether their answers are kept. Clones share
/// it; several in one process may differ, except that they share the one loaded library.
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
    /// By one of [`super::provider::NAMES`]; by default what `SPLATVK_PROVIDER` says, and without
    /// it `auto`.
    pub fn by(asked: Option<&str>) -> Compute {
        let variable = || std::env::var("SPLATVK_PROVIDER").ok().filter(|v| !v.is_empty());
        let asked = asked.map(str::to_owned).or_else(variable).unwrap_or_else(|| "auto".to_owned());
        Compute::new(asked, true)
    }

    fn new(asked: String, cached: bool) -> Compute {
        let (chosen, notes, turn) = Default::default();
        Compute(Arc::new(Shared { asked, cached, chosen, notes, turn }))
    }

    /// By the same provider, and everything is computed: what is measured must be.
    pub fn uncached(&self) -> Compute {
        Compute::new(self.0.asked.clone(), false)
    }

    /// `compute`, or what it gave the last time with the same key.
    pub fn remember(&self, key: OutputKey, compute: impl FnOnce() -> Result<Vec<f32>>) -> Result<Vec<f32>> {
        if self.0.cached { cache::remember(key, compute) } else { compute() }
    }

    /// Held while a large network is loaded: stages that run beside each other take turns, so that
    /// a run needs the memory of one network and every network has all cores.
    pub fn turn(&self) -> MutexGuard<'_, ()> {
        lock(&self.0.turn)
    }

    /// The provider of new sessions, `None` for the CPU: found by computing a graph of one node on
    /// it. Asked for by name, one that does not answer is an error.
    pub(super) fn selected(&self) -> Result<Option<&'static Provider>> {
        let found = || find(&self.0.asked, &mut |text| self.note(text));
        self.0.chosen.get_or_init(found).clone().map_err(Error::missing)
    }

    /// The name of what computes the networks.
    pub fn name(&self) -> Result<&'static str> {
        Ok(self.selected()?.map_or("cpu", |p| p.name))
    }

    /// A network that the chosen provider refuses is computed by the CPU if nobody asked for the
    /// provider by name.
    pub(super) fn replaceable(&self) -> bool {
        self.0.asked == "auto"
    }

    pub(super) fn note(&self, text: String) {
        lock(&self.0.notes).push(text);
    }

    /// Finds the provider, and returns what did not work since the last call, a sentence each.
    pub fn notes(&self) -> Result<Vec<String>> {
        self.selected()?;
        Ok(std::mem::take(&mut *lock(&self.0.notes)))
    }

    /// Warns of [`Compute::notes`].
    pub fn report(&self, progress: &dyn Progress) -> Result<()> {
        self.notes()?.iter().for_each(|n| progress.warn(n));
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_in_one_process_differ() {
        let (cpu, absent) = (Compute::by(Some("cpu")), Compute::by(Some("gpu")));
        assert_eq!(cpu.name().unwrap(), "cpu");
        assert!(absent.name().unwrap_err().to_string().contains("auto, cpu, cuda"));
        // Answers are kept by one and not by the other.
        let key = || OutputKey::new("test").text("two").values(&[std::process::id()]);
        let value = |compute: &Compute, v: f32| compute.remember(key(), || Ok(vec![v])).unwrap();
        assert_eq!(value(&cpu, 1.0), [1.0]);
        assert_eq!(value(&cpu, 2.0), [1.0]);
        assert_eq!(value(&cpu.uncached(), 3.0), [3.0]);
    }
}
