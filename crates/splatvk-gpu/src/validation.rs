//! The Khronos validation layer with synchronization validation, its messages collected so that
//! tests can fail on them.
use crate::sync::lock;
use crate::{Error, Result};
use ash::vk;
use std::ffi::{CStr, c_void};
use std::sync::{Mutex, MutexGuard};

pub(crate) const LAYER: &CStr = c"VK_LAYER_KHRONOS_validation";

/// Where the layer's messages end up.
#[derive(Default)]
pub(crate) struct Messages(Mutex<Vec<String>>);

impl Messages {
    fn lock(&self) -> MutexGuard<'_, Vec<String>> {
        lock(&self.0)
    }
}

/// The message store in a box, so that the address the driver keeps stays valid when the owner
/// moves.
pub(crate) struct Sink {
    messages: Box<Messages>,
    gpu_assisted: bool,
}

impl Sink {
    pub fn new(gpu_assisted: bool) -> Sink {
        Sink { messages: Box::default(), gpu_assisted }
    }

    /// Checks beside those of the calls.
    pub fn features(&self) -> &'static [vk::ValidationFeatureEnableEXT] {
        use vk::ValidationFeatureEnableEXT as Enable;
        const ALL: &[Enable] = &[
            Enable::SYNCHRONIZATION_VALIDATION,
            Enable::GPU_ASSISTED,
            // The layer binds a set of its own.
            Enable::GPU_ASSISTED_RESERVE_BINDING_SLOT,
        ];
        if self.gpu_assisted { ALL } else { &ALL[..1] }
    }

    /// Checks that are left out: newer layers (1.4.309) warn where calls are checked beside every
    /// access, which other tests do without.
    pub fn without(&self) -> &'static [vk::ValidationFeatureDisableEXT] {
        if self.gpu_assisted { &[vk::ValidationFeatureDisableEXT::CORE_CHECKS] } else { &[] }
    }

    /// For instance creation and for the messenger itself. No message is filtered.
    pub fn messenger_info(&self) -> vk::DebugUtilsMessengerCreateInfoEXT<'static> {
        let store: *const Messages = &*self.messages;
        vk::DebugUtilsMessengerCreateInfoEXT::default()
            .message_severity(
                vk::DebugUtilsMessageSeverityFlagsEXT::ERROR | vk::DebugUtilsMessageSeverityFlagsEXT::WARNING,
            )
            // GENERAL is the loader talking about the machine's drivers and layers, not about our
            // calls.
            .message_type(
                vk::DebugUtilsMessageTypeFlagsEXT::VALIDATION
                    | vk::DebugUtilsMessageTypeFlagsEXT::PERFORMANCE,
            )
            .pfn_user_callback(Some(collect))
            .user_data(store as *mut c_void)
    }

    pub fn messages(&self) -> Vec<String> {
        self.messages.lock().clone()
    }
}

unsafe extern "system" fn collect(
    _: vk::DebugUtilsMessageSeverityFlagsEXT,
    _: vk::DebugUtilsMessageTypeFlagsEXT,
    data: *const vk::DebugUtilsMessengerCallbackDataEXT<'_>,
    user: *mut c_void,
) -> vk::Bool32 {
    if !data.is_null() && !user.is_null() {
        // SAFETY: Vulkan passes valid callback data, and `user` is the boxed store, which outlives
        // the instance.
        let (text, store) = unsafe { ((*data).message_as_c_str(), &*(user as *const Messages)) };
        store.lock().push(text.map(|t| t.to_string_lossy().into_owned()).unwrap_or_default());
    }
    vk::FALSE
}

/// An error with the package name when the layer is not installed.
pub(crate) fn require_layer(entry: &ash::Entry) -> Result<()> {
    // SAFETY: a plain query.
    let layers = unsafe { entry.enumerate_instance_layer_properties() }.unwrap_or_default();
    if layers.iter().any(|l| l.layer_name_as_c_str() == Ok(LAYER)) {
        return Ok(());
    }
    Err(Error::NoValidationLayer(
        "the Vulkan validation layer is not installed; on Debian or Ubuntu: apt install vulkan-validationlayers"
            .to_owned(),
    ))
}
