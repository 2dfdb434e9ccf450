//! Choice of kernel variants at the first use of a GPU with its driver.
use super::choose::{self, Choice, LIMIT, Timing};
use super::timing::{SceneSize, time_variants};
use super::{Case, compare, names, wrong, wrong_variants};
use crate::gpu::{self, Cache, Device, KernelVariant, Options, VariantPair};
use crate::progress::Progress;
use crate::{Error, Result};
use std::collections::BTreeSet;
use std::io;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Opens a device with `options`. Where it is a GPU and the cache remembers no choice of kernels
/// for its driver, the variants are compared with the CPU and timed first, and the cache keeps the
/// result ([`gpu::may_choose_kernels`] has the exceptions).
///
/// # Errors
/// Those of [`gpu::open_with`], and a stop by the user. Any other error of the choice is a warning,
/// and the device keeps its defaults.
pub fn open(options: &Options, progress: &dyn Progress) -> Result<Device> {
    let device = gpu::open_with(options)?;
    let info = device.info();
    match &options.cache {
        Some(cache) if !info.is_cpu && info.preferred.is_none() && gpu::may_choose_kernels(options) => {
            choose_once(device, cache, options, (LIMIT, None), progress)
        }
        _ => Ok(device),
    }
}

/// Chooses kernel variants, keeps the names of disabled ones and of those faster than the defaults,
/// and opens the device with them.
fn choose_once(
    device: Device,
    cache: &Arc<dyn Cache>,
    options: &Options,
    (limit, size): (Duration, Option<SceneSize>),
    progress: &dyn Progress,
) -> Result<Device> {
    // The defaults are kept first: nothing is timed where nothing can be kept, and nothing is timed
    // again by a second process, or after a driver that has ended this one.
    if device.prefer(cache.as_ref(), Some(&BTreeSet::new())).is_err() {
        return Ok(device);
    }
    progress.inform("choosing the fastest kernels for this device, once");
    // A device that is closed later keeps the pipelines that it was opened with.
    drop(device);
    let plain = Options { cache: Some(Arc::new(PipelinesOnly(cache.clone()))), ..options.clone() };
    let found = correct_and_fast(&plain, Instant::now() + limit, size, progress);
    let device = gpu::open_with(options)?;
    match found {
        Ok((off, choices)) => {
            let late = choices.iter().filter(|c| c.timing == Timing::OutOfTime).count();
            if late > 0 {
                let (all, seconds) = (choices.len(), limit.as_secs());
                progress.inform(&format!(
                    "{late} of {all} kernels keep their defaults: the {seconds} s for the choice are over"
                ));
            }
            let (off, preferred) = (names(&off), choose::preferred(&choices));
            if off.is_empty() && preferred.is_empty() {
                return Ok(device);
            }
            let disabled = device.info().disabled.union(&off).cloned().collect();
            // This process uses the result also where it cannot be kept any more.
            let _ = device.disable(cache.as_ref(), &disabled);
            let _ = device.prefer(cache.as_ref(), Some(&preferred));
            drop(device);
            gpu::open_with(&Options { disabled, preferred: Some(preferred), ..options.clone() })
        }
        Err(Error::Cancelled) => {
            // The next run chooses again.
            let _ = device.prefer(cache.as_ref(), None);
            Err(Error::Cancelled)
        }
        Err(e) => {
            progress.warn(&format!("the kernels keep their defaults, since they could not be timed: {e}"));
            Ok(device)
        }
    }
}

/// Wrong variants to disable, and choices among the others.
fn correct_and_fast(
    options: &Options,
    until: Instant,
    size: Option<SceneSize>,
    progress: &dyn Progress,
) -> Result<(BTreeSet<KernelVariant>, Vec<Choice>)> {
    let plain = Options {
        disabled: BTreeSet::new(),
        preferred: Some(BTreeSet::new()),
        natives: &[],
        ..options.clone()
    };
    let timed = |v: KernelVariant| VariantPair::TIMED.iter().any(|p| p.variants(false).contains(&v));
    let compares = |case: &Case| {
        let concerned = case.variant.is_some_and(|v| timed(v) || v == KernelVariant::FloatAtomics);
        concerned && Instant::now() < until
    };
    let rows = compare(Device::open(&plain)?, &plain, &compares, &mut |_| progress.check())?;
    let none = BTreeSet::new();
    let choices = time_variants(&plain, size, &none, &wrong(&rows), until, &mut || progress.check())?;
    Ok((wrong_variants(&rows), choices))
}

/// Cache of compiled pipelines alone: comparisons and timings use all variants.
#[derive(Debug)]
struct PipelinesOnly(Arc<dyn Cache>);

impl Cache for PipelinesOnly {
    fn read(&self, name: &str) -> Option<Vec<u8>> {
        name.ends_with(".pipelines").then(|| self.0.read(name)).flatten()
    }

    fn write(&self, name: &str, data: &[u8]) -> io::Result<()> {
        if name.ends_with(".pipelines") { self.0.write(name, data) } else { Ok(()) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::InMemoryCache;
    use crate::sync::lock;
    use std::sync::Mutex;

    #[derive(Debug)]
    struct ReadOnly;

    impl Cache for ReadOnly {
        fn read(&self, _: &str) -> Option<Vec<u8>> {
            None
        }
        fn write(&self, _: &str, _: &[u8]) -> io::Result<()> {
            Err(io::ErrorKind::ReadOnlyFilesystem.into())
        }
    }

    /// Keeps what it is told.
    #[derive(Default)]
    struct Told {
        lines: Mutex<Vec<String>>,
        is_stopped: bool,
    }

    impl Progress for Told {
        fn begin(&self, _: &'static str, _: u64) {}
        fn step(&self, _: u64, _: &str) {}
        fn end(&self) {}
        fn warn(&self, message: &str) {
            lock(&self.lines).push(message.to_owned());
        }
        fn cancelled(&self) -> bool {
            self.is_stopped
        }
    }

    fn chosen(cache: Arc<dyn Cache>, limit: Duration, told: &Told) -> Result<Device> {
        let options = Options { cache: Some(cache.clone()), ..gpu::options(None) };
        let device = gpu::open_with(&options).unwrap();
        assert_eq!(device.info().preferred, None);
        let size = SceneSize { splats: 1000, pixels: [96, 64] };
        choose_once(device, &cache, &options, (limit, Some(size)), told)
    }

    #[test]
    fn choice_is_kept_and_used() {
        let (cache, told, begun) = (Arc::new(InMemoryCache::default()), Told::default(), Instant::now());
        let device = chosen(cache.clone(), LIMIT, &told).unwrap();
        // A pair that has begun ends after its next runs, and devices are opened before and after.
        assert!(begun.elapsed() < LIMIT + Duration::from_secs(3), "{:?}", begun.elapsed());
        let kept = device.preferred(cache.as_ref()).unwrap();
        assert_eq!(device.info().preferred.as_ref(), Some(&kept));
        let is_cpu = device.info().is_cpu;
        let others: BTreeSet<String> =
            VariantPair::TIMED.iter().map(|pair| pair.variants(is_cpu)[1].name().to_owned()).collect();
        assert!(kept.is_subset(&others), "{kept:?}");
        assert!(device.info().disabled.is_empty(), "{:?}", device.info().disabled);
        assert_eq!(lock(&told.lines)[0], "choosing the fastest kernels for this device, once");
        println!("{:?}: {kept:?} {:?}", begun.elapsed(), lock(&told.lines));
    }

    #[test]
    fn late_choice_is_kept_once() {
        let (cache, told) = (Arc::new(InMemoryCache::default()), Told::default());
        let device = chosen(cache.clone(), Duration::ZERO, &told).unwrap();
        assert_eq!(device.preferred(cache.as_ref()), Some(BTreeSet::new()));
        let lines = lock(&told.lines).clone();
        assert!(lines.len() == 2 && lines[0].ends_with("once"), "{lines:?}");
        assert!(lines[1].starts_with("7 of 7 kernels keep their defaults"), "{lines:?}");
    }

    #[test]
    fn unkept_choice_is_not_made() {
        let told = Told::default();
        chosen(Arc::new(ReadOnly), Duration::ZERO, &told).unwrap();
        assert!(lock(&told.lines).is_empty());
    }

    #[test]
    fn stopped_choice_is_made_again() {
        let (cache, told) =
            (Arc::new(InMemoryCache::default()), Told { is_stopped: true, ..Told::default() });
        let stopped = chosen(cache.clone(), LIMIT, &told);
        assert!(matches!(stopped, Err(Error::Cancelled)));
        let device = crate::gpu::test_device();
        assert_eq!(device.preferred(cache.as_ref()), None);
    }

    #[test]
    fn cpu_device_is_not_timed() {
        let (cache, told) = (Arc::new(InMemoryCache::default()), Told::default());
        let options = Options { cache: Some(cache.clone()), ..gpu::options(None) };
        let device = open(&options, &told).unwrap();
        if device.info().is_cpu {
            assert!(device.preferred(cache.as_ref()).is_none() && lock(&told.lines).is_empty());
        }
    }

    #[test]
    fn comparisons_ignore_kept_variants() {
        let cache = Arc::new(InMemoryCache::default());
        let pipelines = PipelinesOnly(cache.clone());
        for name in ["a.pipelines", "a.disabled"] {
            cache.write(name, b"kept").unwrap();
            pipelines.write(name, b"new").unwrap();
        }
        assert_eq!(pipelines.read("a.pipelines").as_deref(), Some(&b"new"[..]));
        assert_eq!(pipelines.read("a.disabled"), None);
        assert_eq!(cache.read("a.disabled").as_deref(), Some(&b"kept"[..]));
    }
}
