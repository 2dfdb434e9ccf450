//! Benchmark of the radix sort.
use super::measure::Budget;
use super::model::Roofline;
use super::report::Section;
use crate::gpu::{Device, Recorder};
use crate::math::Random;
use crate::pass::sort::Sort;
use crate::{Error, Result};

/// Bits of the keys.
const BITS: u32 = 32;
/// Digits of eight bits: the passes over the data.
const PASSES: f64 = 4.0;
/// A key and a value, read and written. Counting the digits reads keys again, which is overhead
/// here.
const BYTES_PER_PASS: f64 = 16.0;

/// Measures the sort of `keys` random 32-bit keys with values.
pub fn measure(device: &Device, keys: usize, limits: (&Budget, &Roofline)) -> Result<Section> {
    let (budget, roofline) = limits;
    let mut random = Random::new(1);
    let pairs: Vec<[u32; 2]> = (0..keys as u32).map(|i| [random.bits() as u32, i]).collect();
    let unsorted = device.buffer_from("unsorted", pairs.as_flattened())?;
    let sorted = device.buffer::<u32>("sorted", 2 * keys)?;
    let count = device.buffer_from("count", &[keys as u32])?;
    let sort = Sort::new(device, keys)?;
    let record = || {
        let mut rec = Recorder::new(device, "radix sort");
        rec.pass("restore the unsorted keys");
        rec.copy(&unsorted, &sorted);
        rec.pass("radix sort");
        sort.record(&mut rec, &sorted, &count, BITS);
        rec
    };
    let mut section = Section::new("radix sort", format!("{keys} random 32-bit keys with 32-bit values"));
    section.passes(device, &record, budget)?;
    let result = sorted.read()?;
    let (result, _) = result.as_chunks::<2>();
    let in_order = result.windows(2).all(|w| w[0][0] <= w[1][0]);
    if !in_order || result.iter().any(|[key, value]| pairs[*value as usize][0] != *key) {
        return Err(Error::gpu(format!("{}: the radix sort of {keys} keys is wrong", device.info().name)));
    }
    let bytes = BYTES_PER_PASS * PASSES * keys as f64;
    let floor = roofline.floor_ms(bytes, 0.0);
    if let Some(row) = section.rows.iter_mut().find(|r| r.name == "radix sort") {
        row.bytes = Some(bytes);
        row.floor_ms = Some(floor);
        let ms = row.ms.median;
        section.figure("items per second", keys as f64 / ms / 1e3, "M/s");
        section.figure("bytes moved", bytes / ms / 1e6, "GB/s (16 per item in each of 4 passes)");
        section.figure("share of the copy bandwidth", 100.0 * floor / ms, "%");
    }
    Ok(section)
}
