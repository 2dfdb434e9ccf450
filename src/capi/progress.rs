//! [`Progress`] that calls the host's callback.
use super::types::*;
use crate::progress::Progress;
use crate::sync::lock;
use std::ffi::{CString, c_void};
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};

/// Progress callback of the host.
pub struct Callback {
    call: SvkProgressFunction,
    user: *mut c_void,
    cancelled: AtomicBool,
    /// Current stage; locked during a call, so that calls never overlap.
    stage: Mutex<StageProgress>,
}

#[derive(Default)]
struct StageProgress {
    name: CString,
    total: u64,
}

// SAFETY: `user` is only passed back to the host's function, which any thread may call.
unsafe impl Send for Callback {}
// SAFETY: as above; the mutex serialises calls.
unsafe impl Sync for Callback {}

/// Converts a text to a C string without zero bytes.
fn c_text(text: &str) -> CString {
    CString::new(text.replace('\0', "")).unwrap_or_default()
}

impl Callback {
    /// # Safety
    /// `call` accepts `user` in any thread, one call at a time, until this is dropped.
    pub unsafe fn new(call: SvkProgressFunction, user: *mut c_void) -> Callback {
        Callback { call, user, cancelled: AtomicBool::new(false), stage: Mutex::default() }
    }

    fn report(&self, kind: SvkProgressKind, done: u64, note: &str, begin: Option<(&str, u64)>) {
        let Some(call) = self.call else { return };
        let mut stage = lock(&self.stage);
        if let Some((name, total)) = begin {
            *stage = StageProgress { name: c_text(name), total };
        }
        let note = c_text(note);
        let progress = SvkProgress {
            size: size_of::<SvkProgress>(),
            kind: kind as u32,
            stage: stage.name.as_ptr(),
            done,
            total: stage.total,
            note: note.as_ptr(),
        };
        // SAFETY: allowed by the contract of `new`; the texts live until it returns.
        if unsafe { call(self.user, &raw const progress) } != 0 {
            self.cancelled.store(true, Ordering::SeqCst);
        }
    }
}

impl Progress for Callback {
    fn begin(&self, stage: &'static str, steps: u64) {
        self.report(SvkProgressKind::Begin, 0, "", Some((stage, steps)));
    }
    fn step(&self, done: u64, note: &str) {
        self.report(SvkProgressKind::Step, done, note, None);
    }
    fn end(&self) {
        self.report(SvkProgressKind::End, 0, "", None);
    }
    fn warn(&self, message: &str) {
        self.report(SvkProgressKind::Warning, 0, message, None);
    }
    fn cancelled(&self) -> bool {
        self.cancelled.load(Ordering::SeqCst)
    }
}
