//! Guard around decoders of other crates for untrusted bytes. A panic of a decoder counts as damage
//! of the file: it does not end the program and prints nothing to stderr.
use std::any::Any;
use std::cell::Cell;
use std::panic::{AssertUnwindSafe, catch_unwind, set_hook, take_hook};
use std::sync::Once;

thread_local! {
    /// Whether this thread is inside of [`guarded`].
    static QUIET: Cell<bool> = const { Cell::new(false) };
}

/// Sets [`QUIET`] and restores it on drop, also while a panic unwinds.
struct Quiet(bool);

impl Quiet {
    fn begin() -> Quiet {
        Quiet(QUIET.replace(true))
    }
}

impl Drop for Quiet {
    fn drop(&mut self) {
        QUIET.set(self.0);
    }
}

/// Longest panic text in a message, characters.
const LONGEST: usize = 120;

/// Runs a decoder on this thread; `Err` holds the text of its panic, one line. State that the
/// decoder left half-changed must not be used again.
pub fn guarded<T>(decode: impl FnOnce() -> T) -> Result<T, String> {
    static HOOK: Once = Once::new();
    HOOK.call_once(|| {
        let before = take_hook();
        // The flag of an ending thread is already destroyed.
        set_hook(Box::new(move |panic| match QUIET.try_with(Cell::get) {
            Ok(true) => {}
            _ => before(panic),
        }));
    });
    let quiet = Quiet::begin();
    let outcome = catch_unwind(AssertUnwindSafe(decode));
    drop(quiet);
    outcome.map_err(|panic| one_line(panic_text(panic.as_ref())))
}

/// The message of a panic.
pub fn panic_text(panic: &(dyn Any + Send)) -> &str {
    let text = panic.downcast_ref::<String>().map(String::as_str);
    text.or_else(|| panic.downcast_ref::<&str>().copied()).unwrap_or("no message")
}

fn one_line(text: &str) -> String {
    text.split_whitespace().collect::<Vec<_>>().join(" ").chars().take(LONGEST).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn panic_of_decoder_becomes_line() {
        assert_eq!(guarded(|| 7), Ok(7));
        let nested = guarded(|| {
            let inner = guarded(|| -> u8 { panic!("slice of {}\n bytes", 4) });
            assert!(QUIET.get(), "the outer call is still guarded");
            inner
        });
        assert_eq!(nested, Ok(Err("slice of 4 bytes".to_owned())));
        assert!(!QUIET.get());
    }
}
