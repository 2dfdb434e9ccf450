//! Opening a device of our own.
use crate::device::{Device, Setup};
use crate::info::Options;
use crate::validation::Sink;
use crate::{Error, Result};
use crate::{choice, features, select};
use ash::vk;

impl Device {
    /// Opens the preferred device (discrete, integrated, virtual, CPU), or the one that
    /// [`Options::choice`] names.
    ///
    /// # Errors
    /// [`Error::NoDevice`] without a usable loader, driver or device, [`Error::Choice`] if the
    /// choice matches none, [`Error::NoValidationLayer`] if validation is asked for and not
    /// installed.
    pub fn open(options: &Options) -> Result<Device> {
        let entry = select::load()?;
        let sink = options.validation.then(|| Sink::new(options.gpu_assisted));
        let instance = select::instance(&entry, sink.as_ref())?;
        // A clone keeps the loader in memory: `build` drops its entry on failure, and the instance
        // must be destroyed after.
        match Self::build(entry.clone(), &instance, sink, options) {
            Ok(device) => Ok(device),
            Err(e) => {
                // SAFETY: nothing made from the instance is alive after the failure.
                unsafe { instance.destroy_instance(None) };
                Err(e)
            }
        }
    }

    fn build(
        entry: ash::Entry,
        instance: &ash::Instance,
        sink: Option<Sink>,
        options: &Options,
    ) -> Result<Device> {
        let candidate = choice::choose(select::candidates(instance, options)?, options.choice.as_deref())?;
        let physical = candidate.physical;
        let queue_family = select::queue_family(instance, physical)
            .ok_or_else(|| Error::no_device(format!("{} has no compute queue", candidate.name)))?;
        let options = options.for_device(&candidate.properties);
        let (device, info) = features::create(instance, &candidate, queue_family, &options)?;
        // SAFETY: the queue was requested in `create`.
        let queue = unsafe { device.get_device_queue(queue_family, 0) };
        let setup = Setup {
            instance: instance.clone(),
            device,
            info,
            queue,
            queue_family,
            sync2_extension: candidate.properties.api_version < vk::API_VERSION_1_3,
            timeline: false,
            queue_lock: None,
            owned: true,
            cache: options.cache,
            natives: options.natives,
        };
        Self::assemble(entry, physical, sink, setup)
    }
}
