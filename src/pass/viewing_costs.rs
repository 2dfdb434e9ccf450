//! Device memory of viewing on a GPU, which needs no GPU to be counted. A change that makes one
//! larger states so in its commit.
use super::splat_buffers::SplatBuffers;
use super::tile_lists::first_entries;
use super::{RasterOptions, Rasterizer, Renderer};
use crate::gpu::{Recorder, idle_device};
use crate::scene::seeded;

/// Bytes of a renderer that has drawn one view.
fn bytes(splats: usize, [width, height]: [u32; 2], degree: u32) -> f64 {
    let device = idle_device();
    let (splats, camera) = seeded::benchmark(splats, width, height, degree, 0);
    let before = device.memory().current;
    let mut renderer = Renderer::new(&device, &splats, &[], 0).unwrap().with_near(0.05);
    renderer.draw(&camera).unwrap();
    (device.memory().current - before) as f64
}

#[test]
fn memory_of_viewing_does_not_grow() {
    // Lists have six entries per splat here, and fewer in large scenes.
    let per_entry = bytes_per_entry();
    println!("{per_entry:.2} bytes per entry");
    assert!(per_entry <= 18.1, "{per_entry} bytes per entry");
    for (degree, most) in [(0, 122.1), (3, 302.1)] {
        let [small, large] = [100_000, 200_000].map(|splats| bytes(splats, [64, 48], degree));
        let per_splat = (large - small) / 1e5 - 6.0 * per_entry;
        println!("SH {degree}: {per_splat:.1} bytes per splat");
        assert!(per_splat <= most, "SH {degree}: {per_splat} bytes per splat");
    }
    let [small, large] = [[640, 480], [1280, 960]].map(|size| bytes(1000, size, 0));
    let per_pixel = (large - small) / (3.0 * 640.0 * 480.0);
    println!("{per_pixel:.1} bytes per pixel");
    assert!(per_pixel <= 21.2, "{per_pixel} bytes per pixel");
}

/// Bytes of the tile lists per entry, with the sort.
fn bytes_per_entry() -> f64 {
    let device = idle_device();
    let mut raster = Rasterizer::for_viewing(&device, 1, 0, &[[64, 48]]).unwrap();
    let mut grown = |entries: usize| {
        raster.grow(entries / 5 * 4).unwrap();
        device.memory().current as f64
    };
    let [small, large] = [1_000_000, 2_000_000].map(&mut grown);
    (large - small) / 1e6
}

#[test]
fn large_lists_begin_with_an_entry_per_splat() {
    assert_eq!(first_entries(1000, 10), 6040);
    assert_eq!(first_entries(2_000_000, 0), 12_000_000);
    assert_eq!(first_entries(20_000_000, 0), 20_000_000);
}

/// A backward pass that binds no gradients would write anywhere.
#[test]
fn viewing_records_no_backward_pass() {
    let device = idle_device();
    let (splats, _) = seeded::benchmark(10, 16, 16, 0, 0);
    let params = SplatBuffers::upload(&device, &splats, &[], 0).unwrap();
    let gradients = params.zeros_like(&device).unwrap();
    let mut raster = Rasterizer::for_viewing(&device, 10, 0, &[[16, 16]]).unwrap();
    let backward = |raster: &Rasterizer| {
        let mut rec = Recorder::new(&device, "step");
        raster.record_backward(&mut rec, &params, &RasterOptions::default(), &gradients);
        rec.compile().map(|_| ())
    };
    let e = backward(&raster).unwrap_err().to_string();
    assert!(e.contains("for viewing"), "{e}");
    raster.allocate_gradients().unwrap();
    backward(&raster).unwrap();
}
