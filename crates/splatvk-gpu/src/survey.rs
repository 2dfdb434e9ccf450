//! The Vulkan devices of this machine, described without opening one.
use crate::{DeviceInfo, Error, Options, Result, choice, features, select};
use ash::vk;

/// A machine's loader and devices.
#[derive(Debug)]
pub struct Survey {
    /// Version of the loader: major, minor, patch.
    pub loader: (u32, u32, u32),
    /// All devices, best first, in the order that [`Options::choice`] counts.
    pub devices: Vec<Surveyed>,
    /// The device that [`Device::open`](crate::Device::open) would take.
    pub chosen: Result<DeviceInfo>,
}

/// A device: its name, and its description or the reason why it cannot be used.
#[derive(Clone, Debug)]
pub struct Surveyed {
    /// As the driver reports it.
    pub name: String,
    /// The description, or the reason.
    pub info: Result<DeviceInfo, String>,
}

/// Lists the devices and describes the one that the options choose.
///
/// # Errors
/// [`Error::NoDevice`] without a usable loader, instance or driver.
pub fn survey(options: &Options) -> Result<Survey> {
    let entry = select::load()?;
    // SAFETY: a plain query.
    let version =
        unsafe { entry.try_enumerate_instance_version() }.ok().flatten().unwrap_or(vk::API_VERSION_1_0);
    let loader =
        (vk::api_version_major(version), vk::api_version_minor(version), vk::api_version_patch(version));
    let instance = select::instance(&entry, None)?;
    let found = devices(&instance, options);
    // SAFETY: nothing made from the instance is left.
    unsafe { instance.destroy_instance(None) };
    let (devices, chosen) = found?;
    Ok(Survey { loader, devices, chosen })
}

fn devices(instance: &ash::Instance, options: &Options) -> Result<(Vec<Surveyed>, Result<DeviceInfo>)> {
    let all = select::candidates(instance, options)?;
    let devices = all
        .iter()
        .map(|c| Surveyed { name: c.name.clone(), info: features::survey(instance, c, options) })
        .collect();
    let chosen = choice::choose(all, options.choice.as_deref())
        .and_then(|c| features::survey(instance, &c, options).map_err(Error::no_device));
    Ok((devices, chosen))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_survey_lists_devices_and_names_them_for_an_unknown_choice() {
        let survey = |choice: Option<&str>| {
            super::survey(&Options { choice: choice.map(str::to_owned), ..Options::default() }).unwrap()
        };
        let usual = survey(None);
        assert!(usual.devices.iter().any(|d| d.info.as_ref().is_ok_and(|i| i.name == d.name)));
        assert!(usual.chosen.is_ok() && usual.loader >= (1, 2, 0));
        let error = survey(Some("no such device")).chosen.unwrap_err();
        assert!(matches!(&error, Error::Choice(m) if m.contains("part of the name: 0 = ")), "{error}");
    }
}
