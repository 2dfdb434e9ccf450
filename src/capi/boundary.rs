//! Conversions between C and Rust: panics, errors, pointers, texts and versioned structures.
use super::options::*;
use super::types::*;
use crate::files::panic_text;
use crate::sync::lock;
use crate::{Error, Result};
use std::cell::RefCell;
use std::ffi::c_char;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::PathBuf;
use std::sync::Mutex;

/// Maximum of bytes of a text: longer than any path of a system. Queries have a smaller limit.
const MOST_TEXT: usize = 1 << 16;
/// Maximum of structures in an array: photos, outputs, instances.
const MOST_STRUCTURES: usize = 1 << 20;

/// Failure of a call.
pub enum CallError {
    /// An error of the library.
    Error(Error),
    /// Wrong use of the interface by the calling program.
    Argument(String),
    /// An edit of a doubtful selection.
    Doubtful(String),
}

impl From<crate::gpu::Error> for CallError {
    fn from(error: crate::gpu::Error) -> Self {
        Error::from(error).into()
    }
}

impl From<Error> for CallError {
    fn from(e: Error) -> Self {
        CallError::Error(e)
    }
}

/// Returns a [`CallError::Argument`].
pub fn bad_argument<T>(what: impl Into<String>) -> Result<T, CallError> {
    Err(CallError::Argument(what.into()))
}

/// Text of the last failure.
#[derive(Default)]
pub struct LastError(Mutex<String>);

impl LastError {
    /// Keeps a text.
    pub fn set(&self, text: String) {
        *lock(&self.0) = text;
    }
    /// Copies the text as a C string: see [`copy_text`].
    pub unsafe fn copy(&self, out: *mut c_char, bytes: usize) -> usize {
        // SAFETY: passed on.
        unsafe { copy_text(&lock(&self.0), out, bytes) }
    }
}

thread_local! {
    /// Text of the last failed call without a handle.
    static CREATION: RefCell<String> = const { RefCell::new(String::new()) };
}

/// Runs the body of a function with a handle. No panic unwinds into C; the handle keeps the text of
/// a failure.
pub fn guard(store: &LastError, body: impl FnOnce() -> Result<(), CallError>) -> SvkStatus {
    caught(|text| store.set(text), body)
}

/// [`guard`] for functions without a handle; the thread keeps the text.
pub fn guard_creation(body: impl FnOnce() -> Result<(), CallError>) -> SvkStatus {
    caught(|text| CREATION.with(|c| *c.borrow_mut() = text), body)
}

/// Copies the text of [`guard_creation`].
pub unsafe fn copy_creation_error(out: *mut c_char, bytes: usize) -> usize {
    // SAFETY: passed on.
    CREATION.with(|c| unsafe { copy_text(&c.borrow(), out, bytes) })
}

/// [`guard`] for functions that return a number; 0 after a panic.
pub fn guard_number<T: Default>(body: impl FnOnce() -> T) -> T {
    catch_unwind(AssertUnwindSafe(body)).unwrap_or_default()
}

/// Runs a body, catches panics, and passes the text of a failure to `store`.
fn caught(store: impl FnOnce(String), body: impl FnOnce() -> Result<(), CallError>) -> SvkStatus {
    let (status, text) = match catch_unwind(AssertUnwindSafe(body)) {
        Ok(Ok(())) => return SvkStatus::Ok,
        Ok(Err(CallError::Error(e))) => (status(&e), e.to_string()),
        Ok(Err(CallError::Argument(text))) => (SvkStatus::Argument, text),
        Ok(Err(CallError::Doubtful(text))) => (SvkStatus::Doubtful, text),
        Err(panic) => (SvkStatus::Internal, format!("internal error: {}", panic_text(panic.as_ref()))),
    };
    store(text);
    status
}

/// Status of an error.
fn status(e: &Error) -> SvkStatus {
    match e {
        Error::Input(_) => SvkStatus::Input,
        Error::Io { .. } => SvkStatus::Io,
        Error::Unwritable { .. } => SvkStatus::Unwritable,
        Error::Missing(_) => SvkStatus::Missing,
        Error::MissingModel { .. } => SvkStatus::MissingModel,
        Error::NoDevice { .. } => SvkStatus::NoDevice,
        Error::DeviceLost { .. } => SvkStatus::DeviceLost,
        Error::OutOfDeviceMemory { .. } => SvkStatus::OutOfDeviceMemory,
        Error::Gpu { .. } => SvkStatus::Gpu,
        Error::Work(_) => SvkStatus::Work,
        Error::Cancelled => SvkStatus::Cancelled,
        _ => SvkStatus::Internal,
    }
}

/// Structures whose first field is their size, and for which all zero is a valid value.
///
/// # Safety
/// `repr(C)`, the first field is `size: usize`, and zero bytes are a value.
pub unsafe trait Versioned: Copy {
    /// Name in messages.
    const NAME: &'static str;
    /// Size of the first version, bytes: the smallest that a caller can have.
    const FIRST: usize;
}

/// Sizes of the first versions in bytes, for pointers of 64 bits. They are literals, so that an
/// appended field does not change them.
macro_rules! versioned {
    ($($name:ident $first:literal),*) => {$(
        // SAFETY: `repr(C)` integers, floats, raw pointers and optional functions after a size.
        unsafe impl Versioned for $name {
            const NAME: &'static str = stringify!($name);
            const FIRST: usize = if cfg!(target_pointer_width = "64") { $first } else { size_of::<$name>() };
        }
        const _: () = assert!(<$name as Versioned>::FIRST <= size_of::<$name>(), "a structure never shrinks");
    )*};
}

versioned!(
    SvkContextOptions 32,
    SvkVulkanDevice 96,
    SvkCamera 144,
    SvkPhoto 88,
    SvkTrainOptions 88,
    SvkSceneInfo 48,
    SvkOutput 80,
    SvkSync 40,
    SvkAnswer 48,
    SvkInstance 224,
    SvkLabelOptions 104,
    SvkExportOptions 80,
    SvkMeshOptions 88,
    SvkMeshInfo 72,
    SvkObjectsOptions 64,
    SvkEdit 80,
    SvkEdited 40
);

/// Size that a structure states, bytes.
///
/// # Safety
/// `pointer` points to a versioned structure.
unsafe fn stated_size<T: Versioned>(pointer: *const T) -> Result<usize, CallError> {
    // SAFETY: per the contract; every versioned structure starts with its size.
    let size = unsafe { pointer.cast::<usize>().read() };
    // No later version adds so much: the field is uninitialised.
    if size < T::FIRST || size > T::FIRST + 4096 {
        return bad_argument(format!("{}.size is {size}; set it to sizeof({})", T::NAME, T::NAME));
    }
    Ok(size)
}

/// Reads a structure of an older or newer version. Fields that the caller's version lacks become
/// zero; fields that this version lacks must be zero.
pub unsafe fn read<T: Versioned>(pointer: *const T) -> Result<T, CallError> {
    if pointer.is_null() {
        return bad_argument(format!("the pointer to {} is null", T::NAME));
    }
    // SAFETY: not null, so the caller's structure.
    let size = unsafe { stated_size(pointer) }?;
    let mut value = std::mem::MaybeUninit::<T>::zeroed();
    let known = size.min(size_of::<T>());
    // SAFETY: the caller's structure has `size` bytes; zero bytes are a value of T.
    unsafe {
        std::ptr::copy_nonoverlapping(pointer.cast::<u8>(), value.as_mut_ptr().cast::<u8>(), known);
        let rest = std::slice::from_raw_parts(pointer.cast::<u8>().add(known), size - known);
        if rest.iter().any(|b| *b != 0) {
            return bad_argument(format!(
                "{} uses fields that this version of splatvk does not know",
                T::NAME
            ));
        }
        Ok(value.assume_init())
    }
}

/// [`read`] with zero for a null pointer.
pub unsafe fn read_or_default<T: Versioned>(pointer: *const T) -> Result<T, CallError> {
    if pointer.is_null() {
        // SAFETY: zero bytes are a value of T.
        return Ok(unsafe { std::mem::zeroed() });
    }
    // SAFETY: passed on.
    unsafe { read(pointer) }
}

/// [`read`] of an array; its stride is the size that the first element states.
pub unsafe fn read_array<T: Versioned>(pointer: *const T, count: usize) -> Result<Vec<T>, CallError> {
    if count == 0 {
        return Ok(Vec::new());
    }
    if count > MOST_STRUCTURES {
        return bad_argument(format!("{count} of {} are too many; at most {MOST_STRUCTURES}", T::NAME));
    }
    if pointer.is_null() {
        return bad_argument(format!("the pointer to {} is null", T::NAME));
    }
    // SAFETY: not null, so the first of the caller's structures.
    let stride = unsafe { stated_size(pointer) }?;
    // SAFETY: the caller gives `count` structures of this size.
    (0..count).map(|i| unsafe { read(pointer.cast::<u8>().add(i * stride).cast::<T>()) }).collect()
}

/// Fills the fields of a caller's structure that its version has; its size stays.
pub unsafe fn write<T: Versioned>(pointer: *mut T, value: &T) -> Result<(), CallError> {
    if pointer.is_null() {
        return bad_argument(format!("the pointer to {} is null", T::NAME));
    }
    // SAFETY: not null, so the caller's structure.
    let known = unsafe { stated_size(pointer) }?.min(size_of::<T>());
    let head = size_of::<usize>();
    // SAFETY: the caller's structure has at least `known` bytes, the first of which hold its size.
    unsafe {
        let from = std::ptr::from_ref(value).cast::<u8>().add(head);
        std::ptr::copy_nonoverlapping(from, pointer.cast::<u8>().add(head), known - head);
    }
    Ok(())
}

/// Fills at most `count` structures of a caller's array; its stride is the size that the first
/// element states.
pub unsafe fn write_array<T: Versioned>(
    pointer: *mut T,
    count: usize,
    values: &[T],
) -> Result<(), CallError> {
    if count == 0 || values.is_empty() {
        return Ok(());
    }
    if pointer.is_null() {
        return bad_argument(format!("the pointer to {} is null", T::NAME));
    }
    // SAFETY: not null, so the first of the caller's structures.
    let stride = unsafe { stated_size(pointer) }?;
    let mut elements = values.iter().take(count).enumerate();
    // SAFETY: the caller gives `count` structures of this size.
    elements.try_for_each(|(i, v)| unsafe { write(pointer.cast::<u8>().add(i * stride).cast::<T>(), v) })
}

/// Copies a text of the caller; `None` for null.
pub unsafe fn text(pointer: *const c_char, what: &str) -> Result<Option<String>, CallError> {
    if pointer.is_null() {
        return Ok(None);
    }
    // SAFETY: a null-terminated text, per the header; reading stops at its end.
    let Some(length) = (0..=MOST_TEXT).find(|k| unsafe { pointer.add(*k).read() } == 0) else {
        return bad_argument(format!("{what} has more than {MOST_TEXT} bytes, or no zero byte at its end"));
    };
    // SAFETY: `length` bytes were read before the zero.
    let bytes = unsafe { std::slice::from_raw_parts(pointer.cast::<u8>(), length) };
    match std::str::from_utf8(bytes) {
        Ok(text) => Ok(Some(text.to_owned())),
        Err(_) => bad_argument(format!("{what} is not UTF-8")),
    }
}

/// Copies a path of the caller; `None` for null.
pub unsafe fn path(pointer: *const c_char, what: &str) -> Result<Option<PathBuf>, CallError> {
    // SAFETY: passed on.
    Ok(unsafe { text(pointer, what) }?.map(PathBuf::from))
}

/// Copies a text with a terminating zero into `bytes` bytes at `out`, truncated where it does not
/// fit. Returns the number of bytes that the whole text needs.
pub unsafe fn copy_text(text: &str, out: *mut c_char, bytes: usize) -> usize {
    if !out.is_null() && bytes > 0 {
        let mut fits = text.len().min(bytes - 1);
        while !text.is_char_boundary(fits) {
            fits -= 1;
        }
        // SAFETY: the caller's memory has `bytes` bytes.
        unsafe {
            std::ptr::copy_nonoverlapping(text.as_ptr(), out.cast::<u8>(), fits);
            out.add(fits).write(0);
        }
    }
    text.len() + 1
}

/// Reference to a caller's handle; an error for null.
pub unsafe fn handle<'a, T>(pointer: *const T, name: &str) -> Result<&'a T, CallError> {
    // SAFETY: null or a live handle, per the header.
    match unsafe { pointer.as_ref() } {
        Some(handle) => Ok(handle),
        None => bad_argument(format!("the {name} is null")),
    }
}

/// Reference to a caller's pointer for a new handle, set to null; an error where it is null itself.
pub unsafe fn slot<'a, T>(pointer: *mut *mut T) -> Result<&'a mut *mut T, CallError> {
    // SAFETY: null or a writable pointer, per the header.
    match unsafe { pointer.as_mut() } {
        Some(slot) => {
            *slot = std::ptr::null_mut();
            Ok(slot)
        }
        None => bad_argument("the pointer to the new handle is null"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu;

    #[test]
    fn guard_maps_panics_and_errors_to_status() {
        let store = LastError::default();
        let text = || store.0.lock().unwrap().clone();
        assert_eq!(guard(&store, || Ok(())), SvkStatus::Ok);
        assert_eq!(guard(&store, || Err(Error::input("bad photo").into())), SvkStatus::Input);
        assert_eq!(text(), "bad photo");
        assert_eq!(guard(&store, || panic!("broken {}", 7)), SvkStatus::Internal);
        assert_eq!(text(), "internal error: broken 7");
        assert_eq!(guard(&store, || Err(Error::Cancelled.into())), SvkStatus::Cancelled);
        let lost = || Err(gpu::Error::vulkan("a step", gpu::VulkanError::from_code(-4)).into());
        assert_eq!(guard(&store, lost), SvkStatus::DeviceLost);
        assert!(text().contains("a step: the device was lost"), "{}", text());
        let full = || Err(Error::io("scene")(std::io::ErrorKind::StorageFull.into()).into());
        assert_eq!(guard(&store, full), SvkStatus::Unwritable);
    }

    #[test]
    fn read_accepts_other_versions() {
        #[repr(C)]
        struct Newer {
            known: SvkSync,
            added: u64,
        }
        // SAFETY: zero is a value.
        let mut newer: Newer = unsafe { std::mem::zeroed() };
        newer.known.size = size_of::<Newer>();
        newer.known.wait_value = 7;
        // SAFETY: the structure has the size that it states.
        let back = unsafe { read(&raw const newer.known) };
        assert_eq!(back.ok().unwrap().wait_value, 7);
        newer.added = 1;
        // SAFETY: as above.
        assert!(unsafe { read(&raw const newer.known) }.is_err(), "an unknown field is in use");
        newer.known.size = 3;
        // SAFETY: as above.
        assert!(unsafe { read(&raw const newer.known) }.is_err(), "no version is that small");
        // SAFETY: zero is a value.
        let mut older: SvkTrainOptions = unsafe { std::mem::zeroed() };
        older.size = std::mem::offset_of!(SvkTrainOptions, max_size);
        (older.seed, older.max_size) = (3, 99);
        // SAFETY: the structure is larger than the size that it states.
        let read = unsafe { read(&raw const older) }.ok().unwrap();
        assert_eq!((read.seed, read.max_size), (3, 0), "version 1 has no max_size");
    }

    #[test]
    fn texts_and_arrays_are_bounded() {
        let long = std::ffi::CString::new("a".repeat(MOST_TEXT + 1)).unwrap();
        let read = |text: &std::ffi::CStr| {
            // SAFETY: a null-terminated text.
            unsafe { super::text(text.as_ptr(), "text") }
        };
        assert!(matches!(read(&long), Err(CallError::Argument(e)) if e.contains("more than 65536 bytes")));
        let longest = std::ffi::CString::new("a".repeat(MOST_TEXT)).unwrap();
        assert_eq!(read(&longest).ok().flatten().map(|t| t.len()), Some(MOST_TEXT));
        let sync = SvkSync { size: size_of::<SvkSync>(), ..unsafe_zero() };
        // SAFETY: refused before the array is read.
        assert!(unsafe { read_array(&raw const sync, usize::MAX) }.is_err());
    }

    fn unsafe_zero() -> SvkSync {
        // SAFETY: zero is a value.
        unsafe { std::mem::zeroed() }
    }

    #[test]
    fn copy_text_truncates_between_characters() {
        let mut room = [1 as c_char; 6];
        // SAFETY: six bytes.
        let needed = unsafe { copy_text("aé€b", room.as_mut_ptr(), 6) };
        // SAFETY: ended by copy_text.
        let text = unsafe { std::ffi::CStr::from_ptr(room.as_ptr()) }.to_str().unwrap();
        assert_eq!((needed, text), (8, "aé"));
    }
}
