//! The choice of a physical device: by number, name, UUID or PCI address.
use crate::{Error, Result};
use ash::vk;
use std::fmt::Write;

/// Advice where there is no loader or no device. lavapipe makes a machine without a GPU work.
pub const INSTALL: &str = "on Debian or Ubuntu: apt install libvulkan1 mesa-vulkan-drivers (the second also \
                                  brings lavapipe, a device that runs on the CPU)";

/// A physical device with the properties that decide whether and when it is used.
pub(crate) struct Candidate {
    pub physical: vk::PhysicalDevice,
    pub properties: vk::PhysicalDeviceProperties,
    pub name: String,
    /// Equal for every driver of the card; `nvidia-smi -L` prints it, too.
    pub uuid: [u8; 16],
    /// Where the driver reports it.
    pub pci: Option<Pci>,
    /// Why it cannot be used, if so.
    pub unusable: Option<String>,
}

/// Vendor number of NVIDIA, the devices of CUDA.
const NVIDIA: u32 = 0x10de;

/// Position of a device on the PCI bus: domain, bus, device, function. `Display` and [`Pci::parse`]
/// use the form of `lspci -D`: "0000:3b:00.0".
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct Pci(pub [u32; 4]);

impl Pci {
    /// Reads "0000:3b:00.0"; the domain may be missing.
    fn parse(text: &str) -> Option<Pci> {
        let (bus, function) = text.rsplit_once('.').unwrap_or((text, "0"));
        let mut parts =
            bus.split(':').map(|part| u32::from_str_radix(part, 16).ok()).collect::<Option<Vec<_>>>()?;
        if parts.len() == 2 {
            parts.insert(0, 0);
        }
        let [domain, bus, device] = parts[..] else { return None };
        Some(Pci([domain, bus, device, u32::from_str_radix(function, 16).ok()?]))
    }
}

impl std::fmt::Display for Pci {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let [domain, bus, device, function] = self.0;
        write!(f, "{domain:04x}:{bus:02x}:{device:02x}.{function}")
    }
}

/// A UUID as 8-4-4-4-12 hexadecimal digits.
pub(crate) fn uuid_text(uuid: [u8; 16]) -> String {
    let mut text = String::with_capacity(36);
    for (i, byte) in uuid.iter().enumerate() {
        let dash = if [4, 6, 8, 10].contains(&i) { "-" } else { "" };
        let _ = write!(text, "{dash}{byte:02x}");
    }
    text
}

/// Whether a UUID begins with the digits of a text, in which case and dashes do not matter and
/// which `nvidia-smi` begins with "GPU-".
fn uuid_begins(uuid: [u8; 16], text: &str) -> bool {
    let text = text.to_lowercase();
    let digits = text.strip_prefix("gpu-").unwrap_or(&text).replace('-', "");
    !digits.is_empty() && uuid_text(uuid).replace('-', "").starts_with(&digits)
}

/// The devices that `CUDA_VISIBLE_DEVICES` leaves: those of other vendors, and the named ones of
/// NVIDIA in its order. CUDA ignores what follows an entry that names no device.
pub(crate) fn visible(all: Vec<Candidate>, cuda: Option<&str>) -> Result<Vec<Candidate>> {
    let Some(list) = cuda else { return Ok(all) };
    let mut by_bus: Vec<usize> = (0..all.len()).filter(|i| all[*i].properties.vendor_id == NVIDIA).collect();
    by_bus.sort_by_key(|i| all[*i].pci);
    let mut kept: Vec<usize> = Vec::new();
    for entry in list.split(',').map(str::trim) {
        if entry.starts_with("MIG-") {
            return Err(Error::Choice(format!(
                "CUDA_VISIBLE_DEVICES names {entry}, a part of a card, which Vulkan cannot open; name the whole card"
            )));
        }
        let found = match entry.parse::<usize>() {
            Ok(number) => by_bus.get(number).copied(),
            Err(_) if !entry.starts_with("GPU-") => None,
            Err(_) => {
                let mut named = by_bus.iter().copied().filter(|i| uuid_begins(all[*i].uuid, entry));
                named.next().filter(|_| named.next().is_none())
            }
        };
        match found {
            Some(i) if !kept.contains(&i) => kept.push(i),
            _ => break,
        }
    }
    // The places of NVIDIA's devices in the order of preference are taken by the named ones in
    // their order.
    let mut named = kept.into_iter();
    let order: Vec<usize> =
        (0..all.len()).filter_map(|i| if by_bus.contains(&i) { named.next() } else { Some(i) }).collect();
    if order.is_empty() && !all.is_empty() {
        return Err(Error::no_device(format!(
            "CUDA_VISIBLE_DEVICES is `{list}` and hides every Vulkan device; change it, or unset it"
        )));
    }
    let mut all: Vec<Option<Candidate>> = all.into_iter().map(Some).collect();
    Ok(order.into_iter().filter_map(|i| all[i].take()).collect())
}

/// The first usable device, or the one that `choice` names: `uuid:…` (its beginning), `pci:…`, its
/// index in this order, or its name or a part of it.
pub(crate) fn choose(all: Vec<Candidate>, choice: Option<&str>) -> Result<Candidate> {
    if all.is_empty() {
        return Err(Error::no_device(format!("no Vulkan device; {INSTALL}")));
    }
    let listed = list(all.iter().enumerate());
    let Some(text) = choice else {
        return all.into_iter().find(|c| c.unusable.is_none()).ok_or_else(|| {
            Error::no_device(format!(
                "no usable Vulkan device among {listed}: Vulkan 1.2 with VK_KHR_synchronization2 and a compute queue is needed; {INSTALL}"
            ))
        });
    };
    let matching = matches(&all, text)?;
    let [one] = matching[..] else {
        return Err(Error::Choice(if matching.is_empty() {
            format!(
                "no Vulkan device matches `{text}`; give its number, uuid:…, pci:… or a part of the name: {listed}"
            )
        } else {
            let several = list(matching.iter().map(|i| (*i, &all[*i])));
            format!("`{text}` matches several Vulkan devices; give the number, or uuid:…: {several}")
        }));
    };
    match all.into_iter().nth(one) {
        Some(Candidate { name, unusable: Some(reason), .. }) => {
            Err(Error::no_device(format!("Vulkan device {name} cannot be used: {reason}")))
        }
        Some(candidate) => Ok(candidate),
        None => Err(Error::no_device(format!("no Vulkan device; {INSTALL}"))),
    }
}

/// Indices of the devices that a text names.
fn matches(all: &[Candidate], text: &str) -> Result<Vec<usize>> {
    let which = |test: &dyn Fn(&Candidate) -> bool| -> Vec<usize> {
        all.iter().enumerate().filter(|(_, c)| test(c)).map(|(i, _)| i).collect()
    };
    if let Some(uuid) = text.strip_prefix("uuid:") {
        return Ok(which(&|c| uuid_begins(c.uuid, uuid)));
    }
    if let Some(address) = text.strip_prefix("pci:") {
        let pci = Pci::parse(address).ok_or_else(|| {
            Error::Choice(format!("`{text}` is no PCI address; write it as pci:0000:3b:00.0 (lspci -D)"))
        })?;
        return Ok(which(&|c| c.pci == Some(pci)));
    }
    if let Ok(index) = text.parse::<usize>() {
        return Ok((index < all.len()).then_some(index).into_iter().collect());
    }
    let wanted = text.to_lowercase();
    let whole = which(&|c| c.name.to_lowercase() == wanted);
    Ok(if whole.is_empty() { which(&|c| c.name.to_lowercase().contains(&wanted)) } else { whole })
}

/// "0 = NAME, 1 = NAME"; equal names with their UUIDs.
fn list<'a>(devices: impl Iterator<Item = (usize, &'a Candidate)> + Clone) -> String {
    let named = devices.clone().map(|(i, c)| {
        let alike = devices.clone().filter(|(_, other)| other.name == c.name).count() > 1;
        let uuid = if alike { format!(" (uuid:{})", uuid_text(c.uuid)) } else { String::new() };
        format!("{i} = {}{uuid}", c.name)
    });
    named.collect::<Vec<_>>().join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;
    use ash::vk;

    fn made_up(name: &str, vendor: u32, unusable: Option<&str>) -> Candidate {
        Candidate {
            physical: vk::PhysicalDevice::null(),
            properties: vk::PhysicalDeviceProperties { vendor_id: vendor, ..Default::default() },
            name: name.to_owned(),
            uuid: [0; 16],
            pci: None,
            unusable: unusable.map(str::to_owned),
        }
    }

    /// Three equal cards, of which the driver lists the one on the second bus first, and a CPU.
    fn node() -> Vec<Candidate> {
        let card = |bus: u8| Candidate {
            uuid: [bus; 16],
            pci: Some(Pci([0, bus.into(), 0, 0])),
            ..made_up("NVIDIA H100", NVIDIA, None)
        };
        vec![card(0x3b), card(0x18), card(0xaf), made_up("llvmpipe", 0x10005, None)]
    }

    fn said(all: Vec<Candidate>, choice: Option<&str>) -> String {
        choose(all, choice).err().unwrap().to_string()
    }

    #[test]
    fn an_unusable_device_is_passed_over_unless_it_is_named() {
        let old = || made_up("Old GPU", 1, Some("update the driver"));
        let all = || vec![old(), made_up("New GPU", 1, None)];
        assert_eq!(choose(all(), None).unwrap().name, "New GPU");
        assert_eq!(choose(all(), Some("new")).unwrap().name, "New GPU");
        assert!(said(all(), Some("0")).ends_with("Old GPU cannot be used: update the driver"));
        assert!(said(vec![old()], None).contains("no usable Vulkan device among 0 = Old GPU"));
    }

    #[test]
    fn equal_cards_are_told_apart_by_uuid_and_pci_address() {
        let bus = |choice: &str| choose(node(), Some(choice)).unwrap().pci.unwrap().0[1];
        assert_eq!(bus("1"), 0x18);
        for choice in ["uuid:afaf", "uuid:GPU-AFAFAFAF-afaf", "pci:0000:af:00.0", "pci:AF:00.0", "pci:af:00"]
        {
            assert_eq!(bus(choice), 0xaf, "{choice}");
        }
        let several = said(node(), Some("h100"));
        assert!(
            several.contains("several") && several.contains("2 = NVIDIA H100 (uuid:afafafaf-afaf-"),
            "{several}"
        );
        assert!(said(node(), Some("uuid:77")).starts_with("no Vulkan device matches `uuid:77`"));
        assert!(said(node(), Some("uuid:")).starts_with("no Vulkan device matches"));
        assert!(said(node(), Some("4")).starts_with("no Vulkan device matches"));
        assert!(said(node(), Some("pci:x")).contains("is no PCI address"));
        // A whole name wins over parts of names.
        let all = vec![made_up("RTX 4090 Ti", 1, None), made_up("RTX 4090", 1, None)];
        assert_eq!(choose(all, Some("rtx 4090")).unwrap().name, "RTX 4090");
    }

    #[test]
    fn cuda_visible_devices_counts_along_the_bus() {
        let left = |list: &str| -> Vec<Option<u32>> {
            visible(node(), Some(list)).unwrap().iter().map(|c| c.pci.map(|p| p.0[1])).collect()
        };
        assert_eq!(visible(node(), None).unwrap().len(), 4);
        assert_eq!(left("0"), [Some(0x18), None]);
        assert_eq!(left("2, 1"), [Some(0xaf), Some(0x3b), None]);
        assert_eq!(left("GPU-afaf,GPU-1818"), [Some(0xaf), Some(0x18), None]);
        // As in CUDA: nothing is visible from an unknown, ambiguous or repeated entry on.
        for list in ["", "-1", "7,0", "GPU-", "NoDevFiles"] {
            assert_eq!(left(list), [None], "{list}");
        }
        assert_eq!(left("1,1,0"), [Some(0x3b), None]);
        let hidden = visible(node().into_iter().take(3).collect(), Some("")).err().unwrap();
        assert!(hidden.to_string().contains("hides every Vulkan device"), "{hidden}");
        assert!(visible(node(), Some("MIG-1")).err().unwrap().to_string().contains("MIG-1"));
    }

    #[test]
    fn uuids_and_addresses_have_their_usual_forms() {
        let uuid = std::array::from_fn(|i| i as u8 * 16);
        assert_eq!(uuid_text(uuid), "00102030-4050-6070-8090-a0b0c0d0e0f0");
        let pci = Pci::parse("0001:3b:1f.2").unwrap();
        assert_eq!((pci, pci.to_string().as_str()), (Pci([1, 0x3b, 0x1f, 2]), "0001:3b:1f.2"));
        for wrong in ["", "3b", "0:1:2:3", "g:0.0", "0:0.x"] {
            assert_eq!(Pci::parse(wrong), None, "{wrong}");
        }
    }
}
