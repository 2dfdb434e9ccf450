//! Ways of computing that another way can replace, and the memory of those that gave wrong results on a device.
use crate::{Error, Result, files};
use ash::vk;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// One of two or more passes that compute the same.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Way {
    /// Gradients added up by `atomicAdd` on float, where the device has it.
    FloatAtomics,
    /// Gradients of several tiles added up by atomics ([`crate::pass::Summation::Atomics`]), of which floats are emulated by a
    /// compare-and-swap loop where there are none or they are switched off.
    AtomicGradients,
    /// Gradients stored per tile and summed in order ([`crate::pass::Summation::Entries`]).
    StoredGradients,
    /// Radix sort with a chunk per lane ([`crate::pass::sort::Shape::Chunks`]).
    ChunkSort,
    /// Radix sort in one sweep per digit ([`crate::pass::sort::Shape::Sweep`]).
    SweepSort,
    /// Tile lists by counters ([`crate::pass::Grouping::Counting`]).
    CountedLists,
    /// Tile lists by a sort ([`crate::pass::Grouping::Sorting`]).
    SortedLists,
    /// SSIM with a strip of a row per thread ([`crate::pass::ssim_l1::Rows::Strips`]).
    SsimStrips,
    /// SSIM with a span of a row per workgroup ([`crate::pass::ssim_l1::Rows::Shared`]).
    SsimShared,
}

impl Way {
    /// All of them.
    pub const ALL: [Way; 9] = [
        Way::FloatAtomics,
        Way::AtomicGradients,
        Way::StoredGradients,
        Way::ChunkSort,
        Way::SweepSort,
        Way::CountedLists,
        Way::SortedLists,
        Way::SsimStrips,
        Way::SsimShared,
    ];

    /// As `splatvk doctor` prints it.
    pub fn name(self) -> &'static str {
        match self {
            Way::FloatAtomics => "native float atomics",
            Way::AtomicGradients => "gradients by atomics",
            Way::StoredGradients => "gradients by stored entries",
            Way::ChunkSort => "sort in chunks",
            Way::SweepSort => "sort in one sweep",
            Way::CountedLists => "tile lists by counters",
            Way::SortedLists => "tile lists by sorting",
            Way::SsimStrips => "rows in strips",
            Way::SsimShared => "rows in shared memory",
        }
    }

    /// What is used where this one is switched off.
    pub fn replacement(self) -> Way {
        match self {
            Way::FloatAtomics => Way::AtomicGradients,
            Way::AtomicGradients => Way::StoredGradients,
            Way::StoredGradients => Way::AtomicGradients,
            Way::ChunkSort => Way::SweepSort,
            Way::SweepSort => Way::ChunkSort,
            Way::CountedLists => Way::SortedLists,
            Way::SortedLists => Way::CountedLists,
            Way::SsimStrips => Way::SsimShared,
            Way::SsimShared => Way::SsimStrips,
        }
    }
}

/// The file that names what is switched off on a device: another driver and another splatvk start anew.
fn file(folder: &Path, properties: &vk::PhysicalDeviceProperties) -> PathBuf {
    let vk::PhysicalDeviceProperties { vendor_id, device_id, driver_version, pipeline_cache_uuid, .. } =
        *properties;
    let uuid = files::hex(&pipeline_cache_uuid);
    folder.join(format!(
        "{vendor_id:08x}-{device_id:08x}-{driver_version:08x}-{uuid}-{}.switched-off",
        env!("CARGO_PKG_VERSION")
    ))
}

/// What is switched off. A file that is damaged says nothing.
pub(super) fn read(folder: &Path, properties: &vk::PhysicalDeviceProperties) -> BTreeSet<Way> {
    let text = files::read_with_checksum(&file(folder, properties)).unwrap_or_default();
    let text = String::from_utf8_lossy(&text).into_owned();
    text.lines().filter_map(|line| Way::ALL.into_iter().find(|w| w.name() == line)).collect()
}

/// Switches off these ways and no others, for every process that opens the device from now on.
pub(super) fn write(
    folder: &Path,
    properties: &vk::PhysicalDeviceProperties,
    ways: &BTreeSet<Way>,
) -> Result<()> {
    let path = file(folder, properties);
    let done = if ways.is_empty() {
        match std::fs::remove_file(&path) {
            Err(e) if e.kind() != std::io::ErrorKind::NotFound => Err(e),
            _ => Ok(()),
        }
    } else {
        let names: Vec<&str> = ways.iter().map(|w| w.name()).collect();
        files::write_with_checksum(&path, names.join("\n").as_bytes())
    };
    done.map_err(Error::io(&path))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::{Device, Options, test_device};
    use crate::pass::sort::Shape;
    use crate::pass::ssim_l1::Rows;
    use crate::pass::{Grouping, Summation};

    #[test]
    fn what_is_switched_off_stays_so_for_this_driver_until_it_is_found_right() {
        let folder = tempfile::tempdir().unwrap();
        let (own, newer) = (
            vk::PhysicalDeviceProperties::default(),
            vk::PhysicalDeviceProperties { driver_version: 2, ..Default::default() },
        );
        let ways = BTreeSet::from([Way::SweepSort, Way::FloatAtomics]);
        write(folder.path(), &own, &ways).unwrap();
        assert_eq!(read(folder.path(), &own), ways);
        assert!(read(folder.path(), &newer).is_empty());
        std::fs::write(file(folder.path(), &newer), "sort in one sweep").unwrap();
        assert!(read(folder.path(), &newer).is_empty(), "without its checksum");
        write(folder.path(), &own, &BTreeSet::new()).unwrap();
        write(folder.path(), &own, &BTreeSet::new()).unwrap();
        assert!(read(folder.path(), &own).is_empty());
    }

    #[test]
    fn a_device_takes_the_replacement_of_what_is_switched_off() {
        let folder = tempfile::tempdir().unwrap();
        let options = Options { cache: Some(folder.path().to_path_buf()), ..Options::from_env(None) };
        let usual = test_device();
        usual
            .switch_off(folder.path(), &Way::ALL.into_iter().filter(|w| *w != Way::SweepSort).collect())
            .unwrap();
        let device = Device::with(&options).unwrap();
        assert_eq!(Shape::of(&device), Shape::Sweep);
        assert_eq!(Rows::of(&device), Rows::of(&usual));
        assert!(!device.info().float_atomics);
        // Both ways are wrong: nothing else is known, `doctor --check` says so.
        assert_eq!(Summation::of(&device), Summation::of(&usual));
        assert_eq!(Grouping::of(&device), Grouping::of(&usual));
        usual.switch_off(folder.path(), &BTreeSet::from([Way::AtomicGradients, Way::CountedLists])).unwrap();
        let device = Device::with(&options).unwrap();
        assert_eq!(Summation::of(&device), Summation::Entries);
        assert_eq!(Grouping::of(&device), Grouping::Sorting);
        assert_eq!(device.info().float_atomics, usual.info().float_atomics);
    }
}
