//! Versions and contexts.
use super::boundary::{self, CallError, LastError, bad_argument, guard_creation, guard_number};
use super::types::*;
use crate::gpu::vk::{self, Handle};
use crate::gpu::{self, Device, EnabledFeatures, HostDevice, Options, QueueLock};
use crate::infer::provider::NAMES;
use crate::infer::{Compute, Registry};
use crate::run::Machine;
use std::ffi::{CStr, c_char, c_void};

/// Version of this interface: major × 65536 + minor. A program works with any library of the same
/// major version and the same or a higher minor version.
pub const SVK_ABI_VERSION: u32 = 0x1_0001;

/// A Vulkan device and a folder of models.
pub struct SvkContext {
    pub(super) device: Device,
    pub(super) registry: Registry,
    pub(super) error: LastError,
}

impl SvkContext {
    /// The device and the models, for runs.
    pub(super) fn machine(&self) -> Machine {
        Machine::of(self.device.clone(), self.registry.clone())
    }
}

/// Returns the SVK_ABI_VERSION of the library. Thread-safe.
#[unsafe(no_mangle)]
pub extern "C" fn svk_abi_version() -> u32 {
    SVK_ABI_VERSION
}

/// Returns the version of the library, such as "0.1.0", in static memory. Thread-safe.
#[unsafe(no_mangle)]
pub extern "C" fn svk_version() -> *const c_char {
    const TEXT: &CStr = match CStr::from_bytes_with_nul(concat!(env!("CARGO_PKG_VERSION"), "\0").as_bytes()) {
        Ok(text) => text,
        Err(_) => c"",
    };
    TEXT.as_ptr()
}

/// Creates a context on a new Vulkan device. `options` may be NULL. On failure `*context` is NULL,
/// and svk_context_error(NULL, ...) returns the error text in the same thread. Thread-safe.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn svk_context_create(
    options: *const SvkContextOptions,
    context: *mut *mut SvkContext,
) -> SvkStatus {
    guard_creation(|| {
        // SAFETY: per the header.
        unsafe {
            let slot = boundary::slot(context)?;
            let options = boundary::read_or_default(options)?;
            let device = boundary::text(options.device, "SvkContextOptions.device")?;
            let mut chosen = gpu::options(device.as_deref());
            chosen.validation |= options.validation != 0;
            chosen.deterministic = options.deterministic != 0;
            *slot = boxed(gpu::open_with(&chosen)?, &options)?;
        }
        Ok(())
    })
}

/// Creates a context on a Vulkan device of the host. `options` may be NULL. Errors as of
/// svk_context_create. Thread-safe.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn svk_context_adopt(
    device: *const SvkVulkanDevice,
    options: *const SvkContextOptions,
    context: *mut *mut SvkContext,
) -> SvkStatus {
    guard_creation(|| {
        // SAFETY: per the header.
        unsafe {
            let slot = boundary::slot(context)?;
            let given = boundary::read(device)?;
            let options = boundary::read_or_default(options)?;
            let chosen = Options { deterministic: options.deterministic != 0, ..Options::default() };
            *slot = boxed(Device::adopt(host_device(&given)?, &chosen)?, &options)?;
        }
        Ok(())
    })
}

/// Makes a context on the heap.
unsafe fn boxed(device: Device, options: &SvkContextOptions) -> Result<*mut SvkContext, CallError> {
    // SAFETY: passed on.
    let models = unsafe { boundary::path(options.models, "SvkContextOptions.models") }?;
    // SAFETY: passed on.
    let provider = unsafe { boundary::text(options.provider, "SvkContextOptions.provider") }?;
    if let Some(unknown) = provider.as_deref().filter(|p| !NAMES.contains(p)) {
        return bad_argument(format!(
            "SvkContextOptions.provider is {unknown}; use one of {}",
            NAMES.join(", ")
        ));
    }
    let registry = Registry::with(models.as_deref(), Compute::by(provider.as_deref()))?;
    Ok(Box::into_raw(Box::new(SvkContext { device, registry, error: LastError::default() })))
}

/// Maximum of extension names; drivers have about three hundred.
const MOST_EXTENSIONS: u32 = 4096;

/// Checks and converts the host's description of its device.
unsafe fn host_device(given: &SvkVulkanDevice) -> Result<HostDevice, CallError> {
    let mut extensions = Vec::new();
    if given.extension_count > 0 {
        if given.extension_count > MOST_EXTENSIONS {
            return bad_argument(format!(
                "SvkVulkanDevice.extension_count is {}; at most {MOST_EXTENSIONS}",
                given.extension_count
            ));
        }
        if given.extensions.is_null() {
            return bad_argument("SvkVulkanDevice.extensions is null but extension_count is not 0");
        }
        // SAFETY: the structure states the number of texts.
        let names = unsafe { std::slice::from_raw_parts(given.extensions, given.extension_count as usize) };
        // SAFETY: null-terminated texts.
        extensions.extend(names.iter().map(|n| unsafe { CStr::from_ptr(*n) }.to_owned()));
    }
    // SAFETY: a pointer to vkGetInstanceProcAddr of another type, as the header asks for; "C" and
    // "system" are the same calling convention on 64-bit platforms with Vulkan.
    let get = given
        .get_instance_proc_addr
        .map(|f| unsafe { std::mem::transmute::<unsafe extern "C" fn(), vk::PFN_vkGetInstanceProcAddr>(f) });
    Ok(HostDevice {
        get_instance_proc_addr: get,
        instance: vk::Instance::from_raw(given.instance as u64),
        physical_device: vk::PhysicalDevice::from_raw(given.physical_device as u64),
        device: vk::Device::from_raw(given.device as u64),
        queue: vk::Queue::from_raw(given.queue as u64),
        queue_family: given.queue_family,
        extensions,
        // SAFETY: null or the chain that the device was made with.
        features: unsafe { EnabledFeatures::read(given.features) },
        queue_lock: queue_lock(given)?,
    })
}

/// The `user` pointer of the host; its functions accept it in any thread.
struct User(*mut c_void);

// SAFETY: only passed back to the host's functions, which may be called from any thread.
unsafe impl Send for User {}
// SAFETY: as above.
unsafe impl Sync for User {}

/// Wraps the host's queue functions; `None` where it has none.
fn queue_lock(given: &SvkVulkanDevice) -> Result<Option<QueueLock>, CallError> {
    let (lock, unlock) = match (given.lock_queue, given.unlock_queue) {
        (None, None) => return Ok(None),
        (Some(lock), Some(unlock)) => (lock, unlock),
        _ => return bad_argument("SvkVulkanDevice: set both lock_queue and unlock_queue, or none"),
    };
    let user = User(given.user);
    Ok(Some(Box::new(move |work: &mut dyn FnMut()| {
        let user = &user;
        // SAFETY: the host's functions and pointer; `work` submits to a queue and does not panic.
        unsafe {
            lock(user.0);
            work();
            unlock(user.0);
        }
    })))
}

/// Destroys a context; its scenes stay usable. NULL is allowed. No other call with this context may
/// be running.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn svk_context_destroy(context: *mut SvkContext) {
    if !context.is_null() {
        // SAFETY: made by Box::into_raw, and not used any more.
        guard_number(|| drop(unsafe { Box::from_raw(context) }));
    }
}

/// Copies the name of the Vulkan device into `text`, which has `bytes` bytes; it is truncated where
/// it does not fit and always ends with a zero byte. Returns the number of bytes that the whole
/// name needs. Thread-safe.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn svk_context_device_name(
    context: *const SvkContext,
    text: *mut c_char,
    bytes: usize,
) -> usize {
    // SAFETY: per the header.
    guard_number(|| match unsafe { context.as_ref() } {
        // SAFETY: per the header.
        Some(context) => unsafe { boundary::copy_text(&context.device.info().name, text, bytes) },
        None => 0,
    })
}

/// Copies the error text of the last failed call with this context, in any thread, into `text` as
/// svk_context_device_name does; returns the number of bytes that the whole text needs. With
/// `context` NULL: of the last failed creation of a context in this thread. Thread-safe.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn svk_context_error(
    context: *const SvkContext,
    text: *mut c_char,
    bytes: usize,
) -> usize {
    // SAFETY: per the header.
    guard_number(|| unsafe {
        match context.as_ref() {
            Some(context) => context.error.copy(text, bytes),
            None => boundary::copy_creation_error(text, bytes),
        }
    })
}
