//! Locking that ignores poisoning.
use std::sync::{Mutex, MutexGuard, PoisonError};

/// Locks, ignoring poison: guarded values stay consistent between their changes, and the thread
/// that panicked reports it.
pub fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
