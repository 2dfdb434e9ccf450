//! Search of frames for a text query on a device that keeps their code maps
//! (docs/internals/method.md#level-and-mask).
use crate::Result;
use crate::gpu::shaders::query_columns::ROWS;
use crate::gpu::shaders::query_peaks::{NONE, RUN, WORKGROUP};
use crate::gpu::shaders::shared::query::{ANSWERS, SUMMED_LEVELS};
use crate::gpu::{Buffer, Device, KernelVariant, Program, Recorder, VariantPair, shaders};
use crate::query::frame::{FrameSearch, LevelPeaks, Table};
use crate::query::maps::CodeMaps;
use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::Arc;

/// Largest buffer of column sums, bytes: frames beyond are searched after the others.
const MOST_BYTES: u64 = 256 << 20;

/// Words of the result of a workgroup: the largest blended excess, the largest sum of relevancy, its
/// pixel, and one without meaning.
const FOUND: usize = 4;

/// Code maps on a device, with the passes that search them. Reference:
/// [`HostSearch`](crate::query::frame::HostSearch).
pub struct DeviceSearch {
    /// Codes of the largest codebook, and one for pixels without a code.
    slots: usize,
    parts: Vec<Part>,
}

/// Frames of one size that are searched at once.
struct Part {
    frames: Range<usize>,
    levels: usize,
    /// [frames, levels, slots]
    tables: Buffer<u32>,
    /// [frames, levels, workgroups, FOUND]
    found: Buffer<u32>,
    workgroups: usize,
    program: Program,
}

impl DeviceSearch {
    /// Uploads the maps of frames with at most `codes` codes per level, if the device is to search
    /// them: `None` where the processor does, or for a frame that is too large.
    pub fn open(device: &Device, frames: &[Arc<CodeMaps>], codes: usize) -> Result<Option<DeviceSearch>> {
        match VariantPair::QUERIES.chosen(device.info()) {
            KernelVariant::DeviceQuery => DeviceSearch::new(device, frames, codes),
            _ => Ok(None),
        }
    }

    /// Uploads the maps of frames with at most `codes` codes per level; `None` for a frame whose sums
    /// the device does not bind.
    pub fn new(device: &Device, frames: &[Arc<CodeMaps>], codes: usize) -> Result<Option<DeviceSearch>> {
        let most = device.info().max_storage_range.min(MOST_BYTES);
        let mut search = DeviceSearch { slots: codes + 1, parts: Vec::new() };
        let mut first = 0;
        for same in frames.chunk_by(|a, b| shape(a) == shape(b)) {
            let (width, height, levels) = shape(&same[0]);
            let bytes = 4 * (levels as u64 + 1) * (width * height) as u64;
            let at_once = most.checked_div(bytes).unwrap_or(0).min(u16::MAX.into()) as usize;
            if at_once == 0 || levels > SUMMED_LEVELS as usize {
                return Ok(None);
            }
            for frames in same.chunks(at_once) {
                search.parts.push(Part::new(device, frames, first, search.slots)?);
                first += frames.len();
            }
        }
        Ok(Some(search))
    }

    /// Device milliseconds of the passes over all frames, with the tables of the last query.
    pub fn time_passes(&self) -> Result<BTreeMap<String, f64>> {
        let mut all = BTreeMap::new();
        for part in &self.parts {
            for (pass, ms) in part.program.run_timed()? {
                *all.entry(pass).or_insert(0.0) += ms;
            }
        }
        Ok(all)
    }
}

/// Width, height and number of levels.
fn shape(maps: &CodeMaps) -> (usize, usize, usize) {
    (maps.width, maps.height, maps.levels.len())
}

impl Part {
    fn new(device: &Device, frames: &[Arc<CodeMaps>], first: usize, slots: usize) -> Result<Part> {
        let (width, height, levels) = shape(&frames[0]);
        let count = frames.len();
        let mut words = Vec::with_capacity((count * levels * width * height).div_ceil(2));
        let codes: Vec<u16> = frames.iter().flat_map(|f| &f.levels).flat_map(|l| &l.codes).copied().collect();
        words.extend(codes.chunks(2).map(|c| u32::from(c[0]) | u32::from(*c.last().unwrap_or(&0)) << 16));
        let workgroups = (width.div_ceil(RUN as usize) * height).div_ceil(WORKGROUP[0] as usize);
        let codes = device.buffer_from("query codes", &words)?;
        let tables = device.buffer::<u32>("query tables", count * levels * slots)?;
        let columns = device.buffer::<u32>("query columns", count * (levels + 1) * width * height)?;
        let found = device.buffer::<u32>("query peaks", FOUND * count * levels * workgroups)?;
        let mut rec = Recorder::new(device, "query");
        let [w, h, l, s] = [width, height, levels, slots].map(|n| n as u32);
        rec.pass("query columns");
        let call = shaders::query_columns::call(
            &shaders::query_columns::Bindings { codes: &codes, tables: &tables, columns: &columns },
            &shaders::query_columns::Push { width: w, height: h, levels: l, slots: s },
        );
        let columns_of = shaders::query_columns::WORKGROUP[0];
        rec.dispatch(call, [w.div_ceil(columns_of), h.div_ceil(ROWS as u32), count as u32]);
        rec.pass("query peaks");
        let call = shaders::query_peaks::call(
            &shaders::query_peaks::Bindings {
                codes: &codes,
                tables: &tables,
                columns: &columns,
                found: &found,
            },
            &shaders::query_peaks::Push { width: w, height: h, levels: l, slots: s },
        );
        rec.dispatch(call, [workgroups as u32, count as u32, 1]);
        rec.download(&found);
        let program = rec.compile()?;
        Ok(Part { frames: first..first + count, levels, tables, found, workgroups, program })
    }

    fn search(
        &self,
        tables: &[Table],
        answering: &[Vec<Vec<u16>>],
        slots: usize,
    ) -> Result<Vec<Vec<LevelPeaks>>> {
        let mut entries = vec![0u32; self.tables.len()];
        let maps = answering[self.frames.clone()].iter().flat_map(|levels| tables.iter().zip(levels));
        for (entries, (table, codes)) in entries.chunks_exact_mut(slots).zip(maps) {
            entries.iter_mut().zip(table.values()).for_each(|(entry, value)| *entry = *value);
            match codes.is_empty() {
                // Without an answering code any pixel may be the location.
                true => entries.iter_mut().for_each(|entry| *entry |= ANSWERS),
                false => codes.iter().for_each(|k| entries[usize::from(*k)] |= ANSWERS),
            }
        }
        self.tables.write(&entries)?;
        self.program.run()?;
        let found = self.found.read()?;
        let levels = found.chunks_exact(FOUND * self.workgroups).map(largest);
        let levels: Vec<LevelPeaks> = levels.collect();
        Ok(levels.chunks(self.levels.max(1)).map(<[LevelPeaks]>::to_vec).collect())
    }
}

/// The largest of the results of workgroups.
fn largest(groups: &[u32]) -> LevelPeaks {
    let (mut peak, mut best) = (0, None);
    for group in groups.chunks_exact(FOUND) {
        peak = peak.max(group[0]);
        let (sum, pixel) = (group[1], group[2]);
        let precedes = |(s, p): (u32, u32)| sum > s || (sum == s && pixel < p);
        if pixel != NONE && best.is_none_or(precedes) {
            best = Some((sum, pixel));
        }
    }
    LevelPeaks { peak, location: best.map_or(0, |(_, pixel)| pixel as usize) }
}

impl FrameSearch for DeviceSearch {
    fn search(&mut self, tables: &[Table], answering: &[Vec<Vec<u16>>]) -> Result<Vec<Vec<LevelPeaks>>> {
        let mut all = Vec::with_capacity(answering.len());
        for part in &self.parts {
            all.extend(part.search(tables, answering, self.slots)?);
        }
        Ok(all)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::shaders::shared::query::{SIDE, UNIT};
    use crate::gpu::{Options, TestDevice, options, test_device};
    use crate::math::Random;
    use crate::query::frame::HostSearch;
    use crate::query::{QueryOptions, answer_all, window};
    use crate::scene::Image;

    /// Maps of rectangles of codes, some pixels without one.
    fn maps(random: &mut Random, [width, height]: [usize; 2], counts: &[usize]) -> Arc<CodeMaps> {
        let level = |count: &usize| {
            let mut map = Image::filled(width, height, -1);
            for _ in 0..30 {
                let (x, y) = (random.below(width), random.below(height));
                let (w, h) = (1 + random.below(width), 1 + random.below(height));
                let code = random.below(count + 1) as i32 - 1;
                for y in y..(y + h / 2 + 1).min(height) {
                    map.data[y * width + x..y * width + (x + w / 2 + 1).min(width)].fill(code);
                }
            }
            map
        };
        let levels: Vec<Image<i32>> = counts.iter().map(level).collect();
        Arc::new(CodeMaps::new(&levels).unwrap())
    }

    fn check(device: &Device, sizes: &[[usize; 2]], counts: &[usize]) {
        let mut random = Random::new(3);
        let frames: Vec<Arc<CodeMaps>> = sizes.iter().map(|size| maps(&mut random, *size, counts)).collect();
        let codes = counts.iter().copied().max().unwrap_or(0);
        let mut device = DeviceSearch::new(device, &frames, codes).unwrap().unwrap();
        let mut host = HostSearch(&frames);
        for trial in 0..4 {
            // The last query fits nothing; the first has a level without codes.
            let most = if trial == 3 { 0.0 } else { 1.0 };
            let relevancy: Vec<Vec<f32>> = counts
                .iter()
                .enumerate()
                .map(|(l, count)| if trial == 0 && l == 0 { 0 } else { *count })
                .map(|count| (0..count).map(|_| most * random.uniform() as f32).collect())
                .collect();
            let tables: Vec<Table> = relevancy.iter().map(|r| Table::new(r)).collect();
            let shown = |maps: &Arc<CodeMaps>| {
                let levels = maps.levels.iter().map(|l| l.shown.iter().map(|s| s.code).step_by(3).collect());
                levels.collect::<Vec<Vec<u16>>>()
            };
            let answering: Vec<Vec<Vec<u16>>> = frames.iter().map(shown).collect();
            let found = device.search(&tables, &answering).unwrap();
            assert_eq!(found, host.search(&tables, &answering).unwrap(), "{trial}");
            assert!(trial == 3 || found.iter().flatten().any(|f| f.peak > 0 && f.location > 0));
            let options = QueryOptions::default();
            let by_device = answer_all(&frames, &relevancy, &options, Some(&mut device)).unwrap();
            let by_host = answer_all(&frames, &relevancy, &options, None).unwrap();
            for (a, b) in by_device.iter().zip(&by_host) {
                assert_eq!(
                    (a.level, a.location, a.score, a.mask()),
                    (b.level, b.location, b.score, b.mask())
                );
            }
        }
    }

    #[test]
    fn device_search_equals_host_search() {
        let device = test_device();
        check(&device, &[[97, 71], [97, 71], [33, 130], [8, 5], [1, 1]], &[12, 8, 4]);
        check(&device, &[[41, 36]], &[2, 300]);
    }

    /// The processor's side is in a crate without shaders, and has the numbers again.
    #[test]
    fn numbers_are_those_of_the_processor() {
        assert_eq!((window::MOST_LEVELS, window::UNIT), (SUMMED_LEVELS as usize, UNIT));
        assert_eq!(window::AREA as i32, SIDE * SIDE);
    }

    #[test]
    fn device_search_divides_frames_by_binding() {
        let small = Options { max_binding: Some(64 << 10), ..options(None) };
        let device = TestDevice::open(&small).unwrap();
        check(&device, &[[60, 40], [60, 40], [60, 40]], &[5, 9]);
        let frames = [maps(&mut Random::new(1), [320, 200], &[5])];
        assert!(DeviceSearch::new(&device, &frames, 5).unwrap().is_none());
    }
}
