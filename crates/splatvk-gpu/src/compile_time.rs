//! Tells the host when a driver takes long to compile shaders, while it does: on a first run some
//! take half a minute. Drivers that compile when a pipeline first runs, as lavapipe does, are not
//! seen.
use crate::sync::lock;
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::sync::{Mutex, OnceLock};
use std::time::{Duration, Instant};

/// Called with the name of the device.
type Listener = fn(&str);

static LISTENER: OnceLock<Listener> = OnceLock::new();

/// A user who sees nothing for longer believes that the program hangs; lavapipe with its pipelines
/// on disk needs less for all of them.
const PATIENCE: Duration = Duration::from_secs(2);

/// Has `listener` called, at most once per device and from a thread of its own, when the driver of
/// a device has compiled for two seconds and is not done. The first listener of a process stays.
pub fn on_long_compilation(listener: fn(&str)) {
    let _ = LISTENER.set(listener);
}

/// The time that compilations on one device may still take before the listener is called; none
/// afterwards.
pub(crate) struct CompileTime(Mutex<Option<Duration>>);

impl CompileTime {
    pub fn new() -> Self {
        CompileTime(Mutex::new(Some(PATIENCE)))
    }

    /// As if two seconds had gone by.
    #[cfg(feature = "testing")]
    pub fn use_up(&self) {
        *lock(&self.0) = Some(Duration::ZERO);
    }

    /// Runs `compile` for the device of this name.
    pub fn during<T>(&self, device: &str, compile: impl FnOnce() -> T) -> T {
        match LISTENER.get() {
            Some(listener) => self.watched(|| listener(device), compile),
            None => compile(),
        }
    }

    fn watched<T>(&self, say: impl FnOnce() + Send, compile: impl FnOnce() -> T) -> T {
        let mut left = lock(&self.0);
        let Some(patience) = *left else { return compile() };
        if patience.is_zero() {
            say();
            *left = None;
            return compile();
        }
        let began = Instant::now();
        let (compiled, wait) = channel::<()>();
        std::thread::scope(|scope| {
            let watch = scope.spawn(move || {
                let late = wait.recv_timeout(patience) == Err(RecvTimeoutError::Timeout);
                if late {
                    say();
                }
                late
            });
            let made = compile();
            drop(compiled);
            let said = watch.join().unwrap_or(true);
            *left = if said { None } else { Some(patience.saturating_sub(began.elapsed())) };
            made
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::atomic::{AtomicBool, Ordering};

    #[test]
    fn a_compilation_is_told_of_while_it_lasts_and_once() {
        let time = CompileTime(Mutex::new(Some(Duration::from_millis(20))));
        let (said, hears) = channel();
        // It ends only when its end has been reported.
        assert!(time.watched(|| said.send(()).unwrap(), || hears.recv_timeout(PATIENCE * 10)).is_ok());
        let again = AtomicBool::new(false);
        let say = || again.store(true, Ordering::SeqCst);
        time.watched(say, || std::thread::sleep(Duration::from_millis(40)));
        assert!(!again.into_inner());
    }

    #[test]
    fn short_ones_add_up() {
        let (patience, told) = (Duration::from_secs(600), AtomicBool::new(false));
        let time = CompileTime(Mutex::new(Some(patience)));
        for _ in 0..3 {
            let say = || told.store(true, Ordering::SeqCst);
            time.watched(say, || std::thread::sleep(Duration::from_millis(5)));
        }
        assert!(!told.into_inner());
        let left = time.0.into_inner().unwrap().unwrap();
        assert!(left <= patience - Duration::from_millis(15), "{left:?}");
    }
}
