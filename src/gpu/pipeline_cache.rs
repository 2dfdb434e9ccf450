//! Compiled pipelines on disk, so that a driver compiles a shader once and not in every process. One file per driver
//! version; anything odd about it, and it is as if it were not there.
use crate::files;
use ash::vk;
use std::path::{Path, PathBuf};

/// Most bytes of all files together: those of drivers that are gone make room.
const CAPACITY: u64 = 256 << 20;
const EXTENSION: &str = "pipelines";
/// Bytes of VkPipelineCacheHeaderVersionOne: length, version, vendor, device, UUID.
const HEADER: usize = 16 + vk::UUID_SIZE;

/// Where the pipelines of one driver are kept.
pub(super) struct Store {
    path: PathBuf,
    header: [u8; HEADER],
}

impl Store {
    /// In a folder, for a device and its driver.
    pub fn new(folder: &Path, properties: &vk::PhysicalDeviceProperties) -> Store {
        let vk::PhysicalDeviceProperties {
            vendor_id, device_id, driver_version, pipeline_cache_uuid, ..
        } = *properties;
        let uuid = files::hex(&pipeline_cache_uuid);
        let name = format!("{vendor_id:08x}-{device_id:08x}-{driver_version:08x}-{uuid}.{EXTENSION}");
        let mut header = [0; HEADER];
        let words =
            [HEADER as u32, vk::PipelineCacheHeaderVersion::ONE.as_raw() as u32, vendor_id, device_id];
        for (to, word) in header.chunks_exact_mut(4).zip(words) {
            to.copy_from_slice(&word.to_le_bytes());
        }
        header[16..].copy_from_slice(&pipeline_cache_uuid);
        Store { path: folder.join(name), header }
    }

    /// What an earlier process has left; nothing if it is damaged or another driver's.
    pub fn read(&self) -> Vec<u8> {
        files::read_with_checksum(&self.path)
            .filter(|data| data.starts_with(&self.header))
            .unwrap_or_default()
    }

    /// Keeps what the driver gave, if it is more than a header and not what is there already. A folder that cannot be
    /// written to costs later processes their time, and nobody anything else.
    pub fn write(&self, data: &[u8]) {
        if data.len() > HEADER
            && data.starts_with(&self.header)
            && self.read() != data
            && files::write_with_checksum(&self.path, data).is_ok()
        {
            files::prune(&self.path, EXTENSION, CAPACITY);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::{Device, Options, Recorder, shaders};

    fn properties(driver_version: u32) -> vk::PhysicalDeviceProperties {
        vk::PhysicalDeviceProperties {
            vendor_id: 0x10de,
            device_id: 0x2330,
            driver_version,
            pipeline_cache_uuid: [7; vk::UUID_SIZE],
            ..Default::default()
        }
    }

    #[test]
    fn what_a_driver_gave_comes_back_to_that_driver_only() {
        let folder = tempfile::tempdir().unwrap();
        let (own, newer) =
            (Store::new(folder.path(), &properties(1)), Store::new(folder.path(), &properties(2)));
        assert!(own.read().is_empty());
        own.write(&own.header);
        assert!(!own.path.exists(), "a header alone is not worth a file");
        let data = [own.header.as_slice(), b"compiled"].concat();
        own.write(&data);
        assert_eq!(own.read(), data);
        assert!(newer.read().is_empty());
        // Under the newer driver's name, yet with another device's header.
        let foreign = [[9; HEADER].as_slice(), b"compiled"].concat();
        newer.write(&foreign);
        assert!(!newer.path.exists());
        files::write_with_checksum(&newer.path, &foreign).unwrap();
        assert!(newer.read().is_empty());
        let mut bytes = std::fs::read(&own.path).unwrap();
        let middle = bytes.len() - 3;
        bytes[middle] ^= 1;
        std::fs::write(&own.path, &bytes).unwrap();
        assert!(own.read().is_empty(), "damaged");
        own.write(&data);
        assert_eq!(own.read(), data, "and replaced");
    }

    #[test]
    fn a_device_opens_and_works_whatever_lies_in_the_folder() {
        let folder = tempfile::tempdir().unwrap();
        let work = || {
            let options = Options {
                validation: true,
                cache: Some(folder.path().to_path_buf()),
                ..Options::from_env(None)
            };
            let device = Device::with(&options).unwrap();
            let values = device.buffer_from("values", &[1.0f32, 2.0]).unwrap();
            let result = device.buffer::<f32>("sum", 1).unwrap();
            let mut rec = Recorder::new(&device, "sum");
            let bindings = shaders::sum::Bindings { values: &values, result: &result };
            rec.dispatch(shaders::sum::call(&bindings, &shaders::sum::Push { count: 2, slot: 0 }), [1, 1, 1]);
            rec.run().unwrap();
            assert_eq!(result.read().unwrap(), [3.0]);
            device.assert_no_validation_messages();
            device.store().unwrap().path.clone()
        };
        let path = work();
        std::fs::write(&path, b"rubbish").unwrap();
        work();
    }
}
