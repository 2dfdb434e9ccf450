//! Counts of pixel–splat pairs: evaluated by the raster kernels, and blended into a pixel.
use super::rasterizer::Rasterizer;
use super::tile_lists::TILE;
use crate::Result;
use crate::gpu::{Device, Recorder, shaders};

/// Counts the [evaluated, blended] pairs of the last forward pass.
pub fn count(device: &Device, raster: &Rasterizer) -> Result<[f64; 2]> {
    let frame = raster.frame();
    let tiles = frame.tiles();
    let counts = device.buffer::<u32>("pair counts", 2 * (TILE * TILE * tiles[0] * tiles[1]) as usize)?;
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
    Ok([0, 1].map(|k| counts.iter().skip(k).step_by(2).map(|&c| f64::from(c)).sum()))
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

    #[test]
    fn pair_counts_match_reference() {
        let device = crate::gpu::test_device();
        let (splats, camera) = seeded::benchmark(600, 75, 53, 0, 2);
        let view = View::new(&camera, 0.05);
        let params = SplatBuffers::upload(&device, &splats, &[], 0).unwrap();
        let mut raster = Rasterizer::new(&device, 600, 0, 75, 53).unwrap();
        raster.set_view(&view).unwrap();
        raster.forward(&params, &RasterOptions::default()).unwrap();
        let [evaluated, blended] = count(&device, &raster).unwrap();

        let forward =
            reference::forward(&Params::new(&splats, &[], 0), &view, FeatureMode::Linear, &Cutoffs::STANDARD);
        let scene = ReferenceScene {
            projected: &forward.projected,
            features: &[],
            feature_dim: 0,
            order: &forward.order,
            view: &view,
        };
        let pixels = (0..53).flat_map(|y| (0..75).map(move |x| (x, y)));
        let expected: usize = pixels.map(|(x, y)| walk(&scene, &Cutoffs::STANDARD, x, y).0.len()).sum();
        // f32 and f64 may disagree at the two thresholds for a pair in ten thousand.
        assert!((blended - expected as f64).abs() <= 1e-3 * expected as f64, "{blended} of {expected}");
        let listed: usize = raster.tile_lists().unwrap().iter().map(Vec::len).sum();
        assert!(evaluated >= blended && evaluated <= 64.0 * listed as f64, "{evaluated} {listed}");
    }
}
