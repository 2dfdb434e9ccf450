//! What `splatvk doctor` says about Vulkan.
use super::info::DeviceInfo;
use super::{features, select};
use crate::Error;
use ash::vk;

/// How a line of the report turned out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Status {
    /// There and good.
    Ok,
    /// Works, but something optional is missing or slow.
    Note,
    /// splatvk cannot run without it.
    Missing,
}

/// One line: what was looked at, what was found, and what to do if that is not enough.
#[derive(Clone, Debug)]
pub struct Line {
    /// E.g. `loader`, `device 0`, `float atomics`.
    pub topic: String,
    /// Judgement.
    pub status: Status,
    /// What was found.
    pub found: String,
    /// What to do, when `status` is not [`Status::Ok`].
    pub advice: Option<String>,
}

fn line(topic: &str, status: Status, found: impl Into<String>, advice: Option<&str>) -> Line {
    Line { topic: topic.to_owned(), status, found: found.into(), advice: advice.map(str::to_owned) }
}

/// Looks at loader, devices and the features of the device that would be used (`choice` as in
/// [`super::Device::open`]). Never fails: what is missing is a line.
pub fn vulkan(choice: Option<&str>) -> Vec<Line> {
    let entry = match select::load() {
        Ok(entry) => entry,
        Err(e) => return vec![line("Vulkan loader", Status::Missing, e.to_string(), Some(select::INSTALL))],
    };
    // SAFETY: a plain query.
    let version =
        unsafe { entry.try_enumerate_instance_version() }.ok().flatten().unwrap_or(vk::API_VERSION_1_0);
    let (major, minor, patch) =
        (vk::api_version_major(version), vk::api_version_minor(version), vk::api_version_patch(version));
    let mut lines = vec![line("Vulkan loader", Status::Ok, format!("Vulkan {major}.{minor}.{patch}"), None)];
    let instance = match select::instance(&entry, None) {
        Ok(instance) => instance,
        Err(e) => {
            lines.push(line("Vulkan instance", Status::Missing, e.to_string(), Some(select::INSTALL)));
            return lines;
        }
    };
    devices(&instance, choice, &mut lines);
    // SAFETY: nothing made from the instance is left.
    unsafe { instance.destroy_instance(None) };
    lines
}

fn devices(instance: &ash::Instance, choice: Option<&str>, lines: &mut Vec<Line>) {
    let all = match select::candidates(instance) {
        Ok(all) => all,
        Err(e) => {
            lines.push(line("Vulkan device", Status::Missing, e.to_string(), Some(select::INSTALL)));
            return;
        }
    };
    for (index, candidate) in all.iter().enumerate() {
        let topic = format!("Vulkan device {index}");
        lines.push(match features::survey(instance, candidate) {
            Ok(info) => {
                let (major, minor, patch) = info.api_version;
                let kind = if info.is_cpu { ", runs on the CPU" } else { "" };
                let found = format!("{} (Vulkan {major}.{minor}.{patch}, {}{kind})", info.name, info.driver);
                line(&topic, Status::Ok, found, None)
            }
            Err(reason) => {
                let found = format!("{}: {reason}", candidate.name);
                line(&topic, Status::Note, found, Some("update its driver, or use another device"))
            }
        });
    }
    match select::choose(all, choice) {
        Ok(candidate) => match features::survey(instance, &candidate) {
            Ok(info) => chosen(&info, lines),
            Err(reason) => lines.push(line("Vulkan device", Status::Missing, reason, Some(select::INSTALL))),
        },
        Err(Error::Input(e)) => {
            lines.push(line(
                "Vulkan device",
                Status::Missing,
                e,
                Some("name one of these, or leave --device out"),
            ));
        }
        Err(e) => lines.push(line("Vulkan device", Status::Missing, e.to_string(), Some(select::INSTALL))),
    }
}

/// Required and optional features and the limits that matter.
fn chosen(info: &DeviceInfo, lines: &mut Vec<Line>) {
    use super::Capability::*;
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
    if !info.without.is_empty() {
        let names: Vec<&str> = info.without.iter().map(|w| w.name()).collect();
        let advice = "doctor --check found wrong results; after an update of the driver it starts anew";
        lines.push(line("switched off", Status::Note, names.join(", "), Some(advice)));
    }
    let mib = |bytes: u64| bytes >> 20;
    // One feature plane set of 20 channels at 1 Mpixel in f32 takes 80 MB; Vulkan itself only promises 128 MiB.
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reports_the_device_in_use_and_an_unknown_choice() {
        let lines = vulkan(None);
        assert!(lines.iter().all(|l| l.status != Status::Missing), "{lines:?}");
        assert!(lines.iter().any(|l| l.topic == "in use"));
        let lines = vulkan(Some("no such device"));
        let last = lines.last().unwrap();
        assert_eq!(last.status, Status::Missing);
        assert!(last.found.contains("part of the name: 0 = "), "{}", last.found);
    }
}
