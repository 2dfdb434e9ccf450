//! Search of frames for text queries.
use splatvk::gpu::Device;
use splatvk::math::Random;
use splatvk::pass::query_peaks::DeviceSearch;
use splatvk::query::frame::{FrameSearch, HostSearch, Table};
use splatvk::query::maps::CodeMaps;
use splatvk::scene::Image;
use std::sync::Arc;

/// Frames smaller than the box and frames that it does not reach across, with rows of more than one
/// run and partial workgroups.
pub fn search(device: &Device) {
    let mut random = Random::new(1060);
    for ([width, height], codes) in [([37usize, 34usize], 6usize), ([9, 20], 300)] {
        // Blocks of 4 x 4 pixels of a code, one of a few none.
        let mut level = |count: usize| {
            let blocks: Vec<i32> = (0..width * height).map(|_| random.below(count + 1) as i32 - 1).collect();
            let data = (0..width * height).map(|p| blocks[p / width / 4 * width + p % width / 4]).collect();
            Image { width, height, data }
        };
        let mut frame = || Arc::new(CodeMaps::new(&[level(codes), level(3)]).unwrap());
        let frames = [frame(), frame()];
        let mut tables =
            |count: usize| Table::new(&(0..count).map(|_| random.uniform() as f32).collect::<Vec<_>>());
        let tables = [tables(codes), tables(3)];
        let shown = |frame: &Arc<CodeMaps>, level: usize| {
            let list = frame.levels[level].shown.iter().map(|s| s.code);
            list.step_by(3).collect::<Vec<u16>>()
        };
        let answering =
            vec![vec![shown(&frames[0], 0), shown(&frames[0], 1)], vec![shown(&frames[1], 0), Vec::new()]];
        let mut search = DeviceSearch::new(device, &frames, codes).unwrap().unwrap();
        let found = search.search(&tables, &answering).unwrap();
        assert_eq!(found, HostSearch(&frames).search(&tables, &answering).unwrap());
        assert!(found.iter().flatten().any(|f| f.peak > 0 && f.location > 0), "{found:?}");
    }
}
