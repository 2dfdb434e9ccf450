//! The lines of `splatvk doctor` about Vulkan.
use super::options::options;
use super::variants::VariantPair;
use splatvk_gpu::{DeviceInfo, Error, INSTALL, Survey, Surveyed, survey};

/// Judgement of a line of the report.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Status {
    /// Present and good.
    Ok,
    /// Works, but something optional is missing or slow.
    Note,
    /// splatvk cannot run without it.
    Missing,
}

/// One line: a topic, the finding, and advice if that is not enough.
#[derive(Clone, Debug)]
pub struct Line {
    /// E.g. `loader`, `device 0`, `float atomics`.
    pub topic: String,
    /// Judgement.
    pub status: Status,
    /// Finding.
    pub found: String,
    /// Advice, when `status` is not [`Status::Ok`].
    pub advice: Option<String>,
}

fn line(topic: &str, status: Status, found: impl Into<String>, advice: Option<&str>) -> Line {
    Line { topic: topic.to_owned(), status, found: found.into(), advice: advice.map(str::to_owned) }
}

/// Reports loader, devices and the features of the device that would be used (`choice` as in
/// [`super::open`]). Never fails: a missing part is a line.
pub fn vulkan(choice: Option<&str>) -> Vec<Line> {
    let options = options(choice);
    let missing = |topic: &str, found: String| line(topic, Status::Missing, found, Some(INSTALL));
    let Survey { loader: (major, minor, patch), devices, chosen } = match survey(&options) {
        Ok(survey) => survey,
        Err(e) => return vec![missing("Vulkan", e.to_string())],
    };
    let mut lines = vec![line("Vulkan loader", Status::Ok, format!("Vulkan {major}.{minor}.{patch}"), None)];
    for (index, Surveyed { name, info }) in devices.into_iter().enumerate() {
        let topic = format!("Vulkan device {index}");
        lines.push(match info {
            Ok(info) => {
                let (major, minor, patch) = info.api_version;
                let kind = if info.is_cpu { ", runs on the CPU" } else { "" };
                let pci = info.pci.iter().map(|pci| format!(" · pci:{pci}")).collect::<String>();
                let found = format!(
                    "{name} (Vulkan {major}.{minor}.{patch}, {}{kind}) · uuid:{}{pci}",
                    info.driver, info.uuid
                );
                line(&topic, Status::Ok, found, None)
            }
            Err(reason) => {
                let advice = "update its driver, or use another device";
                line(&topic, Status::Note, format!("{name}: {reason}"), Some(advice))
            }
        });
    }
    if let Some(list) = &options.cuda_visible {
        let found = format!("`{list}`: other cards of NVIDIA are not used");
        lines.push(line("CUDA_VISIBLE_DEVICES", Status::Note, found, None));
    }
    match chosen {
        Ok(info) => describe(&info, &mut lines),
        Err(Error::Choice(e)) => {
            let advice = "name one of these, or leave --device out";
            lines.push(line("Vulkan device", Status::Missing, e, Some(advice)));
        }
        Err(e) => lines.push(missing("Vulkan device", e.to_string())),
    }
    lines
}

/// Appends lines on required and optional features and on limits.
fn describe(info: &DeviceInfo, lines: &mut Vec<Line>) {
    use splatvk_gpu::Capability::*;
    if info.is_cpu {
        let advice = "a GPU with a Vulkan 1.2 driver is much faster; nothing else changes";
        lines.push(line(
            "in use",
            Status::Note,
            format!("{}: this is a CPU device", info.name),
            Some(advice),
        ));
    } else {
        lines.push(line("in use", Status::Ok, info.name.clone(), None));
    }
    lines.push(line("synchronization2", Status::Ok, "yes (required)", None));
    let needed = [SubgroupBasic, SubgroupArithmetic, SubgroupBallot, SubgroupShuffle];
    let lacking: Vec<String> =
        needed.iter().filter(|c| !info.capabilities.contains(c)).map(|c| format!("{c:?}")).collect();
    let (low, high) = info.subgroup_sizes;
    let sizes =
        if low == high { format!("size {}", info.subgroup_size) } else { format!("sizes {low} to {high}") };
    lines.push(if lacking.is_empty() {
        line("subgroups", Status::Ok, format!("{sizes}, basic, arithmetic, ballot, shuffle (required)"), None)
    } else {
        let found = format!("{sizes}, without {}", lacking.join(", "));
        line("subgroups", Status::Missing, found, Some("update the driver, or use another device"))
    });
    lines.push(if info.float_atomics {
        line("float atomics", Status::Ok, "native add in buffers (optional)", None)
    } else {
        let advice = "a compare-and-swap loop is used instead: same results, slower training";
        line("float atomics", Status::Note, "missing (optional)", Some(advice))
    });
    if !info.disabled.is_empty() {
        let names: Vec<&str> = info.disabled.iter().map(String::as_str).collect();
        let advice =
            "by doctor --check (wrong results; an update of the driver starts anew) or by SPLATVK_DISABLE";
        lines.push(line("switched off", Status::Note, names.join(", "), Some(advice)));
    }
    lines.extend(preferred(info));
    let mib = |bytes: u64| bytes >> 20;
    // A set of 20 channels at 1 Mpixel in f32 takes 80 MB; Vulkan guarantees 128 MiB.
    lines.push(line(
        "limits",
        Status::Ok,
        format!(
            "largest buffer in a shader {} MiB, shared memory {} KiB, workgroup {} threads, {} buffers per shader",
            mib(info.max_storage_range),
            info.shared_memory >> 10,
            info.max_workgroup_threads,
            info.max_bindings
        ),
        None,
    ));
}

/// A line on the remembered kernel variants that replace the defaults, where they do.
fn preferred(info: &DeviceInfo) -> Option<Line> {
    let replaced = VariantPair::TIMED.into_iter().filter_map(|pair| {
        let (default, chosen) = (pair.variants(info.is_cpu)[0], pair.chosen(info));
        let is_preferred = info.preferred.as_ref().is_some_and(|names| names.contains(chosen.name()));
        (chosen != default && is_preferred).then(|| format!("{} ({})", chosen.name(), default.name()))
    });
    let replaced: Vec<String> = replaced.collect();
    let advice = "faster here than the kernels in brackets; doctor --check times them again";
    (!replaced.is_empty()).then(|| line("faster kernels", Status::Note, replaced.join(", "), Some(advice)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::KernelVariant;
    use std::collections::BTreeSet;

    #[test]
    fn preferred_variants_are_shown() {
        let names = |variants: &[KernelVariant]| -> BTreeSet<String> {
            variants.iter().map(|v| v.name().to_owned()).collect()
        };
        let mut info = DeviceInfo::default();
        assert!(preferred(&info).is_none());
        info.preferred = Some(BTreeSet::from(["unknown".to_owned(), "sort in one sweep".to_owned()]));
        assert!(preferred(&info).is_none(), "the default of a GPU");
        info.preferred = Some(names(&[KernelVariant::ChunkSort, KernelVariant::SsimStrips]));
        info.disabled = names(&[KernelVariant::SsimStrips]);
        let line = preferred(&info).unwrap();
        assert_eq!(line.found, "sort in chunks (sort in one sweep)");
    }

    #[test]
    fn report_names_device_and_unknown_choice() {
        let lines = vulkan(None);
        assert!(lines.iter().all(|l| l.status != Status::Missing), "{lines:?}");
        assert!(lines.iter().any(|l| l.topic == "in use"));
        let lines = vulkan(Some("no such device"));
        let last = lines.last().unwrap();
        assert_eq!(last.status, Status::Missing);
        assert!(last.found.contains("part of the name: 0 = "), "{}", last.found);
    }
}
