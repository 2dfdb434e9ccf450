//! Counts of pixel–splat pairs: evaluated by the raster passes, blended into a pixel, and in rows
//! of a tile with any blended pair.
use super::rasterizer::Rasterizer;
use super::tile_lists::TILE;
use crate::Result;
use crate::gpu::{Device, Recorder, shaders};

/// Pixel–splat pairs of a frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pairs {
    /// Evaluated by the raster passes: shaders, or native code where it takes their place.
    pub evaluated: f64,
    /// Blended into a pixel.
    pub blended: f64,
    /// Pairs in rows of a tile (8 × 1 pixels) in which the splat is blended into a pixel.
    pub in_rows: f64,
}

/// Counts the pairs of the last forward pass.
pub fn count(device: &Device, raster: &Rasterizer) -> Result<Pairs> {
    let frame = raster.frame();
    let tiles = frame.tiles();
    let counts = device.buffer::<u32>("pair counts", 4 * (TILE * TILE * tiles[0] * tiles[1]) as usize)?;
    let call = shaders::count_pairs::call(
        &shaders::count_pairs::Bindings {
            projected: &frame.projected,
            tile_ranges: &frame.lists.ranges,
            tile_splats: &frame.lists.splats,
            counts: &counts,
        },
        &shaders::count_pairs::Push { width: frame.width, height: frame.height, tiles_x: tiles[0] },
    );
    let mut rec = Recorder::new(device, "pair counts");
    rec.dispatch(call, [tiles[0], tiles[1], 1]);
    rec.run()?;
    let counts = counts.read()?;
    let sum = |k: usize| counts.iter().skip(k).step_by(4).map(|&c| f64::from(c)).sum();
    Ok(Pairs { evaluated: sum(0), blended: sum(1), in_rows: sum(2) })
}

/// Number of splats of the last forward pass that may lie on the image: in front of the near plane,
/// not too faint, and with a bounding rectangle that reaches a tile.
pub fn visible(raster: &Rasterizer) -> Result<usize> {
    let sorted = raster.count.read()?[0] as usize;
    // Where sums are stored per entry, hidden splats are sorted, too.
    let mut hidden = 0;
    raster.frame().depth_pairs.read_with(0..2 * sorted, &mut |first, words| {
        let keys = words.iter().skip(first % 2).step_by(2);
        hidden += keys.filter(|key| **key == shaders::project::HIDDEN_KEY).count();
    })?;
    Ok(sorted - hidden)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pass::View;
    use crate::pass::params::Params;
    use crate::pass::raster_forward::{Cutoffs, ReferenceScene, walk};
    use crate::pass::reference;
    use crate::pass::{FeatureMode, RasterOptions, SplatBuffers};
    use crate::scene::seeded;
    use std::collections::BTreeSet;

    #[test]
    fn pair_counts_match_reference() {
        let device = crate::gpu::test_device();
        let (splats, camera) = seeded::benchmark(600, 75, 53, 0, 2);
        let view = View::new(&camera, 0.05);
        let params = SplatBuffers::upload(&device, &splats, &[], 0).unwrap();
        let mut raster = Rasterizer::new(&device, 600, 0, 75, 53).unwrap();
        raster.set_view(&view).unwrap();
        raster.forward(&params, &RasterOptions::default()).unwrap();
        let Pairs { evaluated, blended, in_rows } = count(&device, &raster).unwrap();

        let forward =
            reference::forward(&Params::new(&splats, &[], 0), &view, FeatureMode::Linear, &Cutoffs::STANDARD);
        let scene = ReferenceScene {
            projected: &forward.projected,
            features: &[],
            feature_dim: 0,
            order: &forward.order,
            view: &view,
        };
        let (mut pairs, mut rows) = (0, BTreeSet::new());
        for (x, y) in (0..53).flat_map(|y| (0..75).map(move |x| (x, y))) {
            let (list, _) = walk(&scene, &Cutoffs::STANDARD, x, y);
            pairs += list.len();
            rows.extend(list.iter().map(|pair| (pair.splat, x / TILE, y)));
        }
        let listed: BTreeSet<u32> = raster.tile_lists().unwrap().into_iter().flatten().collect();
        let visible = visible(&raster).unwrap();
        let in_front = forward.projected.iter().flatten().count();
        assert!((listed.len()..=in_front).contains(&visible), "{visible} of {in_front}");
        // f32 and f64 may disagree at the two thresholds for a pair in ten thousand.
        let is_near = |a: f64, b: usize| (a - b as f64).abs() <= 1e-3 * b as f64;
        assert!(is_near(blended, pairs), "{blended} of {pairs}");
        assert!(is_near(in_rows, TILE as usize * rows.len()), "{in_rows} in {} rows", rows.len());
        let listed: usize = raster.tile_lists().unwrap().iter().map(Vec::len).sum();
        assert!(evaluated >= blended && evaluated <= 64.0 * listed as f64, "{evaluated} {listed}");
    }
}
