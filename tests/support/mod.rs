//! Shared by the integration tests.
#![allow(dead_code, clippy::unwrap_used, clippy::expect_used, clippy::panic)] // each test binary uses its own part
use splatvk::gpu::{Device, Recorder};
use splatvk::pass::bands::Band;
use splatvk::pass::close::{Distance, Tolerance, compare};
pub use splatvk::pass::close::{IMAGE, gradient_tolerance};
use splatvk::pass::first_step::FirstStep;
use splatvk::pass::params::{Gradients, Params};
use splatvk::pass::raster_forward::Cutoffs;
use splatvk::pass::reference::{self, Forward};
use splatvk::pass::regularise::RatioPenalty;
use splatvk::pass::{
    DeviceChoices, FrameBuffers, GradientReduction, RasterOptions, Rasterizer, SplatBuffers, TileBinning,
    View, bin,
};
use splatvk::scene::seeded;
use splatvk::scene::{Camera, Splats};

/// Scene with all inputs of a render.
pub struct Scene {
    pub splats: Splats,
    pub features: Vec<f32>,
    pub dim: usize,
    pub view: View,
    pub options: RasterOptions,
}

/// Planes that the GPU rendered.
pub struct Rendered {
    pub planes: Vec<f32>,
    pub transmittance: Vec<f32>,
}

/// Gradients that the GPU computed.
#[derive(PartialEq, Debug)]
pub struct GpuGradients {
    pub splats: Splats,
    pub features: Vec<f32>,
    pub camera: Vec<f32>,
}

impl Scene {
    pub fn new(splats: Splats, camera: &Camera, dim: usize, seed: u64) -> Scene {
        let features = seeded::features(splats.len(), dim, seed);
        let options = RasterOptions { sh_degree: splats.sh_degree, ..RasterOptions::default() };
        let view = View::new(camera, 0.05).with_background([0.2, 0.4, 0.1]);
        Scene { splats, features, dim, view, options }
    }

    /// N random splats over a 75 × 53 image (partial tiles on both borders).
    pub fn small(n: usize, sh_degree: u32, dim: usize, seed: u64) -> Scene {
        let (splats, camera) = seeded::small(n, 75, 53, sh_degree, seed);
        Scene::new(splats, &camera, dim, seed)
    }

    pub fn pixels(&self) -> usize {
        (self.view.size[0] * self.view.size[1]) as usize
    }

    pub fn params(&self) -> Params {
        Params::new(&self.splats, &self.features, self.dim)
    }

    pub fn reference(&self) -> Forward {
        reference::forward(&self.params(), &self.view, self.options.feature_mode, &Cutoffs::STANDARD)
    }

    pub fn upload(&self, device: &Device) -> (SplatBuffers, Rasterizer) {
        self.upload_for(device, DeviceChoices::of(device))
    }

    pub fn upload_for(&self, device: &Device, ways: DeviceChoices) -> (SplatBuffers, Rasterizer) {
        let params = SplatBuffers::upload(device, &self.splats, &self.features, self.dim).unwrap();
        let [width, height] = self.view.size;
        let raster = Rasterizer::with(device, self.splats.len(), self.dim, width, height, ways).unwrap();
        raster.set_view(&self.view).unwrap();
        (params, raster)
    }

    pub fn render(&self, device: &Device) -> Rendered {
        let (params, mut raster) = self.upload(device);
        raster.forward(&params, &self.options).unwrap();
        rendered(&raster)
    }

    /// Random upstream gradients for all planes, alpha last.
    pub fn upstream(&self, seed: u64) -> Vec<f32> {
        let mut random = splatvk::math::Random::new(seed ^ 0xB0);
        (0..(5 + self.dim) * self.pixels()).map(|_| random.scaled_normal(1.0) as f32).collect()
    }

    pub fn gradients(&self, device: &Device, upstream: &[f32]) -> GpuGradients {
        self.gradients_by(device, DeviceChoices::of(device), upstream)
    }

    pub fn gradients_by(&self, device: &Device, ways: DeviceChoices, upstream: &[f32]) -> GpuGradients {
        let (params, mut raster) = self.upload_for(device, ways);
        raster.forward(&params, &self.options).unwrap();
        raster.frame().planes_grad.write(upstream).unwrap();
        let gradients = params.zeros_like(device).unwrap();
        let mut rec = Recorder::new(device, "backward");
        raster.record_backward(&mut rec, &params, &self.options, &gradients);
        rec.run().unwrap();
        let (splats, features) = gradients.download().unwrap();
        GpuGradients { splats, features, camera: raster.frame().camera_grad.read().unwrap() }
    }

    pub fn reference_gradients(&self, forward: &Forward, upstream: &[f32]) -> Gradients {
        let upstream: Vec<f64> = upstream.iter().map(|&g| g.into()).collect();
        let mode = self.options.feature_mode;
        reference::backward(&self.params(), &self.view, mode, &Cutoffs::STANDARD, forward, &upstream)
    }
}

/// Compares a step of [`Rasterizer::record_update`] from fresh moments with the references.
#[track_caller]
pub fn assert_update(device: &Device, scene: &Scene, ways: DeviceChoices) {
    let (params, mut raster) = scene.upload_for(device, ways);
    raster.forward(&params, &scene.options).unwrap();
    let upstream = scene.upstream(7);
    raster.frame().planes_grad.write(&upstream).unwrap();
    let reference = scene.reference_gradients(&scene.reference(), &upstream);
    let needles = Some(RatioPenalty { weight: 0.5, limit: 1.5 });
    let first = FirstStep::new(device, &scene.params(), reference.params, needles).unwrap();
    let mut rec = Recorder::new(device, "update");
    raster.record_band_backward(&mut rec, &params, &scene.options, &raster.frame().bands.get(0));
    raster.record_update(&mut rec, &params, &scene.options, &first.state());
    rec.run().unwrap();

    let moved = Params::new(&params.download().unwrap().0, &[], 0);
    let distance = first.compare(&moved).unwrap().unwrap_or_else(|e| panic!("{e}"));
    println!("gradients by a first step: relative L2 {distance:.2e}");
    assert_class("pose twist", &raster.frame().camera_grad.read().unwrap()[..6], &reference.twist);
}

pub fn rendered(raster: &Rasterizer) -> Rendered {
    Rendered {
        planes: raster.frame().planes.read().unwrap(),
        transmittance: raster.frame().transmittance.read().unwrap(),
    }
}

#[track_caller]
pub fn assert_close(name: &str, actual: &[f32], reference: &[f64], tolerance: &Tolerance) -> Distance {
    match compare(actual, reference, tolerance) {
        Ok(distance) => {
            println!("{name}: {distance}");
            distance
        }
        Err(e) => panic!("{name}: {e}"),
    }
}

#[track_caller]
pub fn assert_images(actual: &Rendered, reference: &Forward) {
    assert_close("planes", &actual.planes, &reference.image.planes, &IMAGE);
    assert_close("transmittance", &actual.transmittance, &reference.image.transmittance, &IMAGE);
}

#[track_caller]
pub fn assert_class(name: &str, actual: &[f32], reference: &[f64]) {
    assert_close(name, actual, reference, &gradient_tolerance(reference));
}

#[track_caller]
pub fn assert_gradients(scene: &Scene, actual: &GpuGradients, seed: u64) {
    let forward = scene.reference();
    let reference = scene.reference_gradients(&forward, &scene.upstream(seed));
    let p = &reference.params;
    let flat = |v: &[[f32; 3]]| v.as_flattened().to_vec();
    let wide = |v: &[glam::DVec3]| v.iter().flat_map(|x| x.to_array()).collect::<Vec<f64>>();
    assert_class("means", &flat(&actual.splats.means), &wide(&p.means));
    assert_class("log scales", &flat(&actual.splats.log_scales), &wide(&p.log_scales));
    let quats: Vec<f64> = p.quats.iter().flat_map(|q| q.to_array()).collect();
    assert_class("quats", actual.splats.quats.as_flattened(), &quats);
    assert_class("opacity logits", &actual.splats.opacity_logits, &p.opacity_logits);
    assert_class("sh", &actual.splats.sh, &wide(&p.sh));
    assert_class("features", &actual.features, &p.features);
    assert_class("pose twist", &actual.camera[..6], &reference.twist);
    assert_class("intrinsics", &actual.camera[6..], &reference.intrinsics);
}

/// Frame and gradients band by band, and the number of bands.
pub fn in_bands(
    scene: &Scene,
    device: &Device,
    summation: GradientReduction,
    upstream: &[f32],
) -> (Vec<f32>, GpuGradients, usize) {
    let params = SplatBuffers::upload(device, &scene.splats, &scene.features, scene.dim).unwrap();
    let [width, height] = scene.view.size;
    let ways = DeviceChoices { summation, ..DeviceChoices::of(device) };
    let mut raster = Rasterizer::with(device, scene.splats.len(), scene.dim, width, height, ways).unwrap();
    raster.set_view(&scene.view).unwrap();
    let pixels = scene.pixels();
    let mut image = vec![f32::NAN; (4 + scene.dim) * pixels];
    // Also grows the lists.
    let seen = |frame: &FrameBuffers, band: &Band| {
        let planes = frame.planes.read()?;
        let (stored, inner) = (frame.bands.stored(band), frame.bands.inner(band));
        for (to, from) in image.chunks_exact_mut(pixels).zip(planes.chunks_exact(frame.bands.pixels())) {
            to[inner.clone()].copy_from_slice(&from[stored.clone()]);
        }
        Ok(())
    };
    raster.forward_bands(&params, &scene.options, seen).unwrap();
    let gradients = params.zeros_like(device).unwrap();
    let bands = raster.frame().bands.clone();
    let run = |record: &dyn Fn(&mut Recorder)| {
        let mut rec = Recorder::new(device, "bands");
        record(&mut rec);
        rec.run().unwrap();
    };
    for band in bands.iter() {
        run(&|rec| {
            if band.index == 0 {
                raster.record_projection(rec, &params, &scene.options);
            }
            raster.record_band(rec, &params, &band);
        });
        raster.frame().planes_grad.write(&bands.cut_inner(&band, upstream, 0.0)).unwrap();
        run(&|rec| raster.record_band_backward(rec, &params, &scene.options, &band));
    }
    run(&|rec| raster.record_gradients(rec, &params, &scene.options, &gradients));
    let (splats, features) = gradients.download().unwrap();
    let camera = raster.frame().camera_grad.read().unwrap();
    (image, GpuGradients { splats, features, camera }, bands.count())
}

/// Compares the lists of both groupings, with and without the index of each entry; they must be
/// equal and contain those of the reference, nearest first. Returns the number of entries of the
/// reference, and of additional entries.
#[track_caller]
pub fn assert_lists(device: &Device, scene: &Scene) -> (usize, usize) {
    let forward = scene.reference();
    let expected = bin::reference(&forward.projected, &forward.order, scene.view.size);
    let lists = |grouping, summation| {
        tile_lists(scene, device, DeviceChoices { grouping, summation, ..DeviceChoices::of(device) })
    };
    let counted = lists(TileBinning::Counting, GradientReduction::Atomics);
    for summation in [GradientReduction::Atomics, GradientReduction::Entries] {
        assert_eq!(counted, lists(TileBinning::Sorting, summation), "{summation:?}");
    }
    assert_eq!(counted.len(), expected.len());
    let mut extra = 0;
    for (list, expected) in counted.iter().zip(&expected) {
        let mut rest = list.iter();
        assert!(expected.iter().all(|i| rest.any(|j| i == j)), "{expected:?} is no subsequence of {list:?}");
        extra += list.len() - expected.len();
    }
    (expected.iter().map(Vec::len).sum(), extra)
}

fn tile_lists(scene: &Scene, device: &Device, choices: DeviceChoices) -> Vec<Vec<u32>> {
    let (params, mut raster) = scene.upload_for(device, choices);
    raster.forward(&params, &scene.options).unwrap();
    raster.tile_lists().unwrap()
}
