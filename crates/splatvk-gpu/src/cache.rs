//! Bytes kept from one process to the next: compiled pipelines, the kernel variants that gave wrong
//! results on a device, and those that were faster there than the defaults.
use ash::vk;
use std::collections::BTreeSet;
use std::fmt::{Debug, Write as _};
use std::io;

/// Keeps bytes by name. The host decides where, for instance in files of a folder.
pub trait Cache: Debug + Send + Sync {
    /// The bytes last written under a name. `None` if there are none or they may have changed
    /// since: drivers trust their data, so an implementation verifies a checksum.
    fn read(&self, name: &str) -> Option<Vec<u8>>;

    /// Replaces the bytes of a name as a whole.
    ///
    /// # Errors
    /// Those of the storage. Pipelines that cannot be kept are compiled again by the next process.
    fn write(&self, name: &str, data: &[u8]) -> io::Result<()>;
}

/// Bytes of `VkPipelineCacheHeaderVersionOne`: length, version, vendor, device, UUID.
const HEADER: usize = 16 + vk::UUID_SIZE;

/// First line of the preferred kernel variants: without any, the file states that they were timed.
const PREFERRED: &str = "preferred kernel variants\n";

/// Names and headers of one driver's entries. Another driver version has other names.
#[derive(Clone)]
pub(crate) struct Driver {
    name: String,
    header: [u8; HEADER],
}

impl Driver {
    pub fn new(properties: &vk::PhysicalDeviceProperties) -> Driver {
        let vk::PhysicalDeviceProperties {
            vendor_id, device_id, driver_version, pipeline_cache_uuid, ..
        } = *properties;
        let mut name = format!("{vendor_id:08x}-{device_id:08x}-{driver_version:08x}-");
        for byte in pipeline_cache_uuid {
            // Writing to a string cannot fail.
            let _ = write!(name, "{byte:02x}");
        }
        let mut header = [0; HEADER];
        let words =
            [HEADER as u32, vk::PipelineCacheHeaderVersion::ONE.as_raw() as u32, vendor_id, device_id];
        for (to, word) in header.chunks_exact_mut(4).zip(words) {
            to.copy_from_slice(&word.to_le_bytes());
        }
        header[16..].copy_from_slice(&pipeline_cache_uuid);
        Driver { name, header }
    }

    fn pipelines_name(&self) -> String {
        format!("{}.pipelines", self.name)
    }

    /// Another version of this crate may have mended a kernel, so it starts anew.
    fn disabled_name(&self) -> String {
        format!("{}-{}.disabled", self.name, env!("CARGO_PKG_VERSION"))
    }

    /// Another version of this crate may have faster kernels, so it starts anew.
    fn preferred_name(&self) -> String {
        format!("{}-{}.preferred", self.name, env!("CARGO_PKG_VERSION"))
    }

    /// Compiled pipelines of an earlier process. Empty if there are none or another driver made
    /// them.
    pub fn pipelines(&self, cache: &dyn Cache) -> Vec<u8> {
        cache.read(&self.pipelines_name()).filter(|data| data.starts_with(&self.header)).unwrap_or_default()
    }

    /// Keeps compiled pipelines if they are more than a header and new.
    pub fn keep_pipelines(&self, cache: &dyn Cache, data: &[u8]) {
        if data.len() > HEADER && data.starts_with(&self.header) && self.pipelines(cache) != data {
            // A cache that takes nothing costs later processes their time.
            let _ = cache.write(&self.pipelines_name(), data);
        }
    }

    /// Names of the disabled kernel variants.
    pub fn disabled(&self, cache: &dyn Cache) -> BTreeSet<String> {
        let text = cache.read(&self.disabled_name()).unwrap_or_default();
        String::from_utf8_lossy(&text).lines().map(str::to_owned).collect()
    }

    /// Replaces the names of the disabled kernel variants.
    pub fn disable(&self, cache: &dyn Cache, names: &BTreeSet<String>) -> io::Result<()> {
        let known = self.disabled(cache);
        if known == *names {
            return Ok(());
        }
        let lines: Vec<&str> = names.iter().map(String::as_str).collect();
        cache.write(&self.disabled_name(), lines.join("\n").as_bytes())
    }

    /// Names of the preferred kernel variants; `None` where nothing is kept that can be read.
    pub fn preferred(&self, cache: &dyn Cache) -> Option<BTreeSet<String>> {
        let text = String::from_utf8(cache.read(&self.preferred_name())?).ok()?;
        Some(text.strip_prefix(PREFERRED)?.lines().map(str::to_owned).collect())
    }

    /// Replaces the names of the preferred kernel variants; `None` forgets them.
    pub fn prefer(&self, cache: &dyn Cache, names: Option<&BTreeSet<String>>) -> io::Result<()> {
        let lines =
            |names: &BTreeSet<String>| names.iter().map(|name| format!("{name}\n")).collect::<String>();
        let text = names.map(|names| format!("{PREFERRED}{}", lines(names))).unwrap_or_default();
        cache.write(&self.preferred_name(), text.as_bytes())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Device, InMemoryCache, Options, Recorder};
    use std::sync::Arc;

    fn driver(driver_version: u32) -> Driver {
        Driver::new(&vk::PhysicalDeviceProperties {
            vendor_id: 0x10de,
            device_id: 0x2330,
            driver_version,
            pipeline_cache_uuid: [7; vk::UUID_SIZE],
            ..Default::default()
        })
    }

    #[test]
    fn pipelines_return_to_their_driver_only() {
        let (cache, own, newer) = (InMemoryCache::default(), driver(1), driver(2));
        own.keep_pipelines(&cache, &own.header);
        assert!(cache.is_empty(), "a header alone is not kept");
        let data = [own.header.as_slice(), b"compiled"].concat();
        own.keep_pipelines(&cache, &data);
        assert_eq!(own.pipelines(&cache), data);
        assert!(newer.pipelines(&cache).is_empty());
        // Under the newer driver's name, with another device's header.
        let foreign = [[9; HEADER].as_slice(), b"compiled"].concat();
        newer.keep_pipelines(&cache, &foreign);
        cache.write(&newer.pipelines_name(), &foreign).unwrap();
        assert!(newer.pipelines(&cache).is_empty());
    }

    #[test]
    fn disabled_variants_stay_disabled_for_this_driver() {
        let (cache, own, newer) = (InMemoryCache::default(), driver(1), driver(2));
        let names = BTreeSet::from(["a".to_owned(), "b c".to_owned()]);
        own.disable(&cache, &names).unwrap();
        assert_eq!(own.disabled(&cache), names);
        assert!(newer.disabled(&cache).is_empty());
        own.disable(&cache, &BTreeSet::new()).unwrap();
        assert!(own.disabled(&cache).is_empty());
    }

    #[test]
    fn preferred_variants_return_to_their_driver_only() {
        let (cache, own, newer) = (InMemoryCache::default(), driver(1), driver(2));
        assert_eq!(own.preferred(&cache), None);
        let names = BTreeSet::from(["a".to_owned(), "b c".to_owned()]);
        for names in [&names, &BTreeSet::new()] {
            own.prefer(&cache, Some(names)).unwrap();
            assert_eq!(own.preferred(&cache).as_ref(), Some(names));
            assert_eq!(newer.preferred(&cache), None);
        }
        assert!(own.disabled(&cache).is_empty());
        own.prefer(&cache, None).unwrap();
        assert_eq!(own.preferred(&cache), None);
        for damaged in [&b"a\n"[..], b"preferred kernel variants\n\xff"] {
            cache.write(&own.preferred_name(), damaged).unwrap();
            assert_eq!(own.preferred(&cache), None);
        }
    }

    #[test]
    fn opened_device_carries_preferred_variants() {
        let cache = Arc::new(InMemoryCache::default());
        let options = Options { cache: Some(cache.clone()), ..Options::default() };
        let names = BTreeSet::from(["a".to_owned()]);
        let device = Device::open(&options).unwrap();
        assert_eq!(device.info().preferred, None);
        device.prefer(cache.as_ref(), Some(&names)).unwrap();
        assert_eq!(device.preferred(cache.as_ref()), Some(names.clone()));
        assert_eq!(Device::open(&options).unwrap().info().preferred, Some(names));
        assert_eq!(crate::survey(&options).unwrap().chosen.unwrap().preferred.unwrap().len(), 1);
        let given = Options { preferred: Some(BTreeSet::new()), ..options };
        assert_eq!(Device::open(&given).unwrap().info().preferred, Some(BTreeSet::new()));
    }

    #[test]
    fn a_device_opens_whatever_its_cache_holds() {
        let cache = Arc::new(InMemoryCache::default());
        let options = Options { validation: true, cache: Some(cache.clone()), ..Options::default() };
        let work = || {
            let device = Device::open(&options).unwrap();
            let numbers = device.buffer::<u32>("numbers", 4).unwrap();
            let mut rec = Recorder::new(&device, "fill");
            rec.fill(&numbers, 3);
            rec.run().unwrap();
            assert_eq!(numbers.read().unwrap(), [3; 4]);
            device.assert_no_validation_messages();
            device.driver()
        };
        let driver = work();
        cache.write(&driver.pipelines_name(), b"rubbish").unwrap();
        work();
    }
}
