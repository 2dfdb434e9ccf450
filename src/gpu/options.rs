//! Options of a device from the environment.
use super::{KernelVariant, folder::FolderCache, native};
use crate::Error;
use splatvk_gpu::{Cache, Device, Options};
use std::sync::Arc;

/// Opens the preferred device with [`options`], or the one that `choice` names
/// ([`Options::choice`]).
///
/// # Errors
/// Those of [`Device::open`], and where `SPLATVK_DISABLE` names no kernel variant.
pub fn open(choice: Option<&str>) -> crate::Result<Device> {
    open_with(&options(choice))
}

/// Opens a device with [`options`] that the caller has changed.
///
/// # Errors
/// Those of [`open`].
pub fn open_with(options: &Options) -> crate::Result<Device> {
    check_disabled(options)?;
    let natives =
        if options.disabled.contains(KernelVariant::NativePasses.name()) { &[] } else { native::ALL };
    Ok(Device::open(&Options { natives, ..options.clone() })?)
}

/// Whether kernel variants may be timed at the first use of a device that is opened with these
/// options. Without a cache every process would time them; with disabled variants or validation,
/// times are not those of usual runs; a deterministic device uses no preferences. `SPLATVK_TUNE=0`
/// turns it off.
pub fn may_choose_kernels(options: &Options) -> bool {
    let off = std::env::var("SPLATVK_TUNE").is_ok_and(|v| v == "0");
    let Options { cache, disabled, deterministic, validation, .. } = options;
    !off && cache.is_some() && disabled.is_empty() && !deterministic && !validation
}

fn check_disabled(options: &Options) -> crate::Result<()> {
    let known = KernelVariant::ALL.map(KernelVariant::name);
    match options.disabled.iter().find(|name| !known.contains(&name.as_str())) {
        None => Ok(()),
        Some(name) => Err(Error::input(format!(
            "SPLATVK_DISABLE: no kernel variant is called `{name}`; they are {}",
            known.join(", ")
        ))),
    }
}

/// Options from the environment. The device is `choice`, or else `SPLATVK_DEVICE`, among those that
/// `CUDA_VISIBLE_DEVICES` leaves: Vulkan itself ignores that variable.
/// `SPLATVK_VALIDATION=1` turns the validation layer on, `gpu` its GPU-assisted checks, too.
/// `SPLATVK_STAGING=1` keeps buffers out of host-visible memory. `SPLATVK_MAX_BINDING` limits the
/// size of a buffer, MiB. `SPLATVK_DISABLE` names kernel variants to disable, separated by commas
/// ([`KernelVariant::name`]). The cache is a folder of the program, where it has one.
pub fn options(choice: Option<&str>) -> Options {
    let variable = |name: &str| std::env::var(name).ok().filter(|v| !v.is_empty());
    let validation = variable("SPLATVK_VALIDATION");
    let validation = validation.as_deref();
    Options {
        choice: choice.map(str::to_owned).or_else(|| variable("SPLATVK_DEVICE")),
        // Set and empty hides all devices of NVIDIA.
        cuda_visible: std::env::var("CUDA_VISIBLE_DEVICES").ok(),
        validation: validation.is_some_and(|v| v == "1" || v == "gpu"),
        gpu_assisted: validation.is_some_and(|v| v == "gpu"),
        staging: variable("SPLATVK_STAGING").is_some_and(|v| v == "1"),
        max_binding: variable("SPLATVK_MAX_BINDING")
            .and_then(|v| v.parse::<u64>().ok())
            .map(|mib| mib.saturating_mul(1 << 20)),
        disabled: variable("SPLATVK_DISABLE")
            .map(|names| names.split(',').map(|n| n.trim().to_owned()).filter(|n| !n.is_empty()).collect())
            .unwrap_or_default(),
        cache: FolderCache::own().map(|cache| Arc::new(cache) as Arc<dyn Cache>),
        ..Options::default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn kernels_are_chosen_in_usual_runs() {
        let cache: Option<Arc<dyn Cache>> = Some(Arc::new(FolderCache::own().unwrap()));
        let usual = Options { cache, ..Options::default() };
        assert_eq!(may_choose_kernels(&usual), std::env::var("SPLATVK_TUNE").as_deref() != Ok("0"));
        assert!(!may_choose_kernels(&Options { cache: None, ..usual.clone() }));
        assert!(!may_choose_kernels(&Options { deterministic: true, ..usual.clone() }));
        assert!(!may_choose_kernels(&Options { validation: true, ..usual.clone() }));
        let disabled = [KernelVariant::FusedUpdate.name().to_owned()].into();
        assert!(!may_choose_kernels(&Options { disabled, ..usual }));
    }

    #[test]
    fn unknown_variants_are_refused() {
        let named = |names: &[&str]| Options {
            disabled: names.iter().map(|n| (*n).to_owned()).collect(),
            ..Options::default()
        };
        check_disabled(&named(&[])).unwrap();
        check_disabled(&named(&KernelVariant::ALL.map(KernelVariant::name))).unwrap();
        let e = check_disabled(&named(&["sort in one sweep", "fused"])).unwrap_err().to_string();
        assert!(e.contains("`fused`") && e.contains("update in one pass"), "{e}");
    }
}
