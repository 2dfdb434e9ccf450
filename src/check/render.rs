//! Checks of rendering and its gradients.
use super::compared::{Found, close, equal, worst};
use super::{Case, case};
use crate::gpu::{Device, KernelVariant, Recorder};
use crate::math::Random;
use crate::pass::close::{IMAGE, Tolerance, gradient_tolerance};
use crate::pass::first_step::FirstStep;
use crate::pass::fused_update;
use crate::pass::label_weights::{self, LabelWeights};
use crate::pass::params::Params;
use crate::pass::raster_forward::{Cutoffs, ReferenceScene};
use crate::pass::reference::{self, Forward};
use crate::pass::{
    DeviceChoices, FeatureMode, GradientReduction, RasterOptions, Rasterizer, ShGradientKernel, SplatBuffers,
    TileBinning, TileSums, View, raster_backward,
    regularise::{self, RatioPenalty},
    screen_gradients,
};
use crate::scene::Splats;
use crate::scene::seeded;
use glam::DVec3;

pub(super) const CASES: &[Case] = &[
    case("projection and rendering", Some(KernelVariant::CountedLists), |d| {
        forward(d, TileBinning::Counting)
    }),
    case("projection and rendering", Some(KernelVariant::SortedLists), |d| forward(d, TileBinning::Sorting)),
    case("tile lists", Some(KernelVariant::SortedLists), sorted_lists),
    case("blending weights by label", None, label_weights),
    case("gradients", Some(KernelVariant::StoredGradients), |d| backward(d, GradientReduction::Entries)),
    case("gradients", Some(KernelVariant::ShuffledSums), |d| tile_sums(d, TileSums::Shuffles)),
    case("gradients", Some(KernelVariant::SharedSums), |d| tile_sums(d, TileSums::Shared)),
    case("gradients of SH", Some(KernelVariant::ShPerThread), |d| {
        sh_gradients(d, ShGradientKernel::PerThread)
    }),
    case("gradients of SH", Some(KernelVariant::ShShared), |d| sh_gradients(d, ShGradientKernel::Shared)),
    case("projection backward with Adam", Some(KernelVariant::FusedUpdate), update),
    case("depth and needle losses", None, regularisers),
    case("gradients on the screen", None, screen_gradients),
];

/// Image size in pixels, no multiple of the tile size.
const SIZE: [u32; 2] = [75, 53];
const FEATURES: usize = 6;
const MODE: FeatureMode = FeatureMode::Gauge { epsilon: 1e-3, blocks: 2 };

struct Scene {
    dim: usize,
    splats: Splats,
    features: Vec<f32>,
    view: View,
    options: RasterOptions,
}

impl Scene {
    fn new(dim: usize) -> Scene {
        let (splats, camera) = seeded::small(150, SIZE[0], SIZE[1], 3, 11);
        let features = seeded::features(splats.len(), dim, 11);
        let view = View::new(&camera, 0.05).with_background([0.2, 0.4, 0.1]);
        let options = RasterOptions { sh_degree: 3, feature_mode: MODE, ..RasterOptions::default() };
        Scene { dim, splats, features, view, options }
    }

    fn params(&self) -> Params {
        Params::new(&self.splats, &self.features, self.dim)
    }

    fn reference(&self) -> Forward {
        reference::forward(&self.params(), &self.view, MODE, &Cutoffs::STANDARD)
    }

    /// The scene on the screen, without features.
    fn projected<'a>(&'a self, forward: &'a Forward) -> ReferenceScene<'a> {
        ReferenceScene {
            projected: &forward.projected,
            features: &[],
            feature_dim: 0,
            order: &forward.order,
            view: &self.view,
        }
    }

    fn rendered(&self, device: &Device, choices: DeviceChoices) -> crate::Result<(SplatBuffers, Rasterizer)> {
        let params = SplatBuffers::upload(device, &self.splats, &self.features, self.dim)?;
        let mut raster = Rasterizer::with(device, self.splats.len(), self.dim, SIZE[0], SIZE[1], choices)?;
        raster.set_view(&self.view)?;
        raster.forward(&params, &self.options)?;
        Ok((params, raster))
    }
}

fn forward(device: &Device, grouping: TileBinning) -> Found {
    let scene = Scene::new(FEATURES);
    let (_, raster) = scene.rendered(device, DeviceChoices { grouping, ..DeviceChoices::of(device) })?;
    let reference = scene.reference();
    let (planes, rest) = (raster.frame().planes.read()?, raster.frame().transmittance.read()?);
    Ok(worst([
        close("planes", &planes, &reference.image.planes, &IMAGE),
        close("transmittance", &rest, &reference.image.transmittance, &IMAGE),
    ]))
}

/// Blending weights by label: two levels, of which one leaves pixels without a label.
fn label_weights(device: &Device) -> Found {
    let scene = Scene::new(FEATURES);
    let (params, mut raster) = scene.rendered(device, DeviceChoices::of(device))?;
    let pixels = (0..SIZE[0] * SIZE[1]).map(|p| [(p % SIZE[0]) as i32, (p / SIZE[0]) as i32]);
    let stripes = pixels.clone().map(|[x, y]| (x + y) / 5 % 4);
    let columns = pixels.map(|[x, _]| if x / 3 % 5 == 0 { -1 } else { 4 + x / 3 % 2 });
    let labels: Vec<i32> = stripes.chain(columns).collect();
    let mut sums = LabelWeights::new(scene.splats.len());
    raster.add_label_weights(&params, &scene.options, &labels, &mut sums)?;
    let forward = scene.reference();
    let reference = scene.projected(&forward);
    let difference = sums.difference(&label_weights::reference(&reference, &labels));
    let text = format!("{difference:.1e} of the weights differ");
    Ok(if difference < 1e-3 { Ok(text) } else { Err(text) })
}

/// Compares the tile lists by sorting with those by counters, of more splats than one chunk has and
/// some on hundreds of tiles. Without counters that are right there is no comparison.
fn sorted_lists(device: &Device) -> Found {
    if device.info().disabled.contains(KernelVariant::CountedLists.name()) {
        return Ok(Ok("not compared".to_owned()));
    }
    let [width, height] = [200, 150];
    let (mut splats, camera) = seeded::small(1000, width, height, 0, 13);
    splats.log_scales.as_flattened_mut().iter_mut().for_each(|s| *s -= 1.0);
    splats.log_scales.iter_mut().step_by(100).for_each(|s| *s = [0.0; 3]);
    let params = SplatBuffers::upload(device, &splats, &[], 0)?;
    let lists = |grouping, summation| -> crate::Result<Vec<u32>> {
        let choices = DeviceChoices { grouping, summation, ..DeviceChoices::of(device) };
        let mut raster = Rasterizer::with(device, splats.len(), 0, width, height, choices)?;
        raster.set_view(&View::new(&camera, 0.05))?;
        raster.forward(&params, &RasterOptions { sh_degree: 0, ..RasterOptions::default() })?;
        Ok(raster.tile_lists()?.iter().flat_map(|l| [&[l.len() as u32], l.as_slice()].concat()).collect())
    };
    let (atomics, entries) = (GradientReduction::Atomics, GradientReduction::Entries);
    let counted = lists(TileBinning::Counting, atomics)?;
    let sorted = equal("lists", &lists(TileBinning::Sorting, atomics)?, &counted);
    Ok(sorted.and(equal("lists with entries", &lists(TileBinning::Sorting, entries)?, &counted)))
}

pub(super) fn backward(device: &Device, summation: GradientReduction) -> Found {
    gradients(device, FEATURES, DeviceChoices { summation, ..DeviceChoices::of(device) })
}

/// Without features, since blocks of features always use shuffles.
fn tile_sums(device: &Device, tile_sums: TileSums) -> Found {
    let choices =
        DeviceChoices { summation: GradientReduction::Atomics, tile_sums, ..DeviceChoices::of(device) };
    gradients(device, 0, choices)
}

fn sh_gradients(device: &Device, sh_gradients: ShGradientKernel) -> Found {
    gradients(device, FEATURES, DeviceChoices { sh_gradients, ..DeviceChoices::of(device) })
}

fn gradients(device: &Device, dim: usize, choices: DeviceChoices) -> Found {
    let scene = Scene::new(dim);
    let (params, raster) = scene.rendered(device, choices)?;
    let mut random = Random::new(12);
    let values = (5 + dim) * (SIZE[0] * SIZE[1]) as usize;
    let upstream: Vec<f32> = (0..values).map(|_| random.scaled_normal(1.0) as f32).collect();
    raster.frame().planes_grad.write(&upstream)?;
    let gradients = params.zeros_like(device)?;
    let mut rec = Recorder::new(device, "self-check of gradients");
    raster.record_backward(&mut rec, &params, &scene.options, &gradients);
    rec.run()?;
    let (splats, features) = gradients.download()?;
    let camera = raster.frame().camera_grad.read()?;

    let upstream: Vec<f64> = upstream.iter().map(|&g| g.into()).collect();
    let reference = reference::backward(
        &scene.params(),
        &scene.view,
        MODE,
        &Cutoffs::STANDARD,
        &scene.reference(),
        &upstream,
    );
    let flat = |v: &[DVec3]| v.iter().flat_map(|x| x.to_array()).collect::<Vec<f64>>();
    let quats: Vec<f64> = reference.params.quats.iter().flat_map(|q| q.to_array()).collect();
    let class = |name: &str, actual: &[f32], reference: &[f64]| {
        close(name, actual, reference, &gradient_tolerance(reference))
    };
    Ok(worst([
        class("means", splats.means.as_flattened(), &flat(&reference.params.means)),
        class("log scales", splats.log_scales.as_flattened(), &flat(&reference.params.log_scales)),
        class("quaternions", splats.quats.as_flattened(), &quats),
        class("opacity logits", &splats.opacity_logits, &reference.params.opacity_logits),
        class("SH", &splats.sh, &flat(&reference.params.sh)),
        class("features", &features, &reference.params.features),
        class("pose", &camera[..6], &reference.twist),
        class("intrinsics", &camera[6..], &reference.intrinsics),
    ]))
}

fn update(device: &Device) -> Found {
    if !fused_update::fits(device.info()) {
        return Ok(Ok(format!("not used: the device binds {} buffers", device.info().max_bindings)));
    }
    let scene = Scene::new(FEATURES);
    let (params, raster) = scene.rendered(device, DeviceChoices::of(device))?;
    let mut random = Random::new(14);
    let values = (5 + FEATURES) * (SIZE[0] * SIZE[1]) as usize;
    let upstream: Vec<f32> = (0..values).map(|_| random.scaled_normal(1.0) as f32).collect();
    raster.frame().planes_grad.write(&upstream)?;
    let upstream: Vec<f64> = upstream.iter().map(|&g| g.into()).collect();
    let (start, forward) = (scene.params(), scene.reference());
    let reference = reference::backward(&start, &scene.view, MODE, &Cutoffs::STANDARD, &forward, &upstream);
    let needles = Some(RatioPenalty { weight: 0.25, limit: 2.0 });
    let first = FirstStep::new(device, &start, reference.params, needles)?;
    let mut rec = Recorder::new(device, "self-check of the update");
    raster.record_band_backward(&mut rec, &params, &scene.options, &raster.frame().bands.get(0));
    raster.record_update(&mut rec, &params, &scene.options, &first.state());
    rec.run()?;

    let update = first.compare(&Params::new(&params.download()?.0, &[], 0))?;
    let camera = raster.frame().camera_grad.read()?;
    let pose = close("pose", &camera[..6], &reference.twist, &gradient_tolerance(&reference.twist));
    Ok(worst([update, pose]))
}

fn regularisers(device: &Device) -> Found {
    let scene = Scene::new(FEATURES);
    let (params, raster) = scene.rendered(device, DeviceChoices::of(device))?;
    let frame = raster.frame();
    let pixels = frame.pixels() as usize;
    let mut random = Random::new(13);
    // A third of the pixels has no reference.
    let depth: Vec<f32> = (0..pixels).map(|_| random.between(-1.0, 2.0).max(0.0) as f32).collect();
    let reference = device.buffer_from("reference depth", &depth)?;
    // A third of the pixels may have any alpha.
    let wanted: Vec<f32> = (0..pixels).map(|_| random.between(-0.5, 1.0) as f32).collect();
    let wanted_alpha = device.buffer_from("wanted alpha", &wanted)?;
    let gradients = params.zeros_like(device)?;
    let n = scene.splats.len();
    let needles = RatioPenalty { weight: 0.25, limit: 2.0 };
    let mut rec = Recorder::new(device, "self-check of the regularisers");
    let (depth_term, alpha_term) = (Some((&reference, 0.5)), Some((&wanted_alpha, 0.5)));
    regularise::record_depth_and_alpha(&mut rec, frame, depth_term, alpha_term);
    regularise::record_ratio(&mut rec, &params.log_scales, &gradients.log_scales, n, needles);
    rec.run()?;

    let wide = |v: &[f32]| v.iter().map(|&a| f64::from(a)).collect::<Vec<f64>>();
    let rendered = frame.planes.read()?[3 * pixels..4 * pixels].to_vec();
    let alpha: Vec<f32> = frame.transmittance.read()?.iter().map(|t| 1.0 - t).collect();
    let (_, by_pixel) = regularise::depth_l1(&wide(&rendered), &wide(&alpha), &wide(&depth), 0.5);
    let upstream = frame.planes_grad.read()?;
    let by_depth: Vec<f64> = by_pixel.iter().map(|g| g[0]).collect();
    let (_, by_wanted) = regularise::alpha_l1(&wide(&alpha), &wide(&wanted), 0.5);
    let by_alpha: Vec<f64> = by_pixel.iter().zip(by_wanted).map(|(g, w)| g[1] + w).collect();
    let plane = |first: usize| &upstream[first * pixels..(first + 1) * pixels];
    let by_scale: Vec<f64> = scene
        .splats
        .log_scales
        .iter()
        .flat_map(|s| regularise::ratio_penalty(s.map(f64::from), 0.25, 2.0).1)
        .collect();
    // Signs and quotients of single values; where the depths agree to rounding, the sign may
    // differ.
    let tolerance = Tolerance {
        relative_l2: 1e-4,
        absolute: 1e-6,
        relative: 1e-4,
        outliers: 1e-3,
        outlier_factor: f64::MAX,
    };
    let scales = gradients.log_scales.read()?;
    let depth = close("by depth", plane(3), &by_depth, &tolerance);
    let alpha = close("by alpha", plane(4 + FEATURES), &by_alpha, &tolerance);
    let scale = close("by log scale", &scales, &by_scale, &tolerance);
    // Without a reference both become zero.
    let mut rec = Recorder::new(device, "self-check of the regularisers");
    regularise::record_depth_and_alpha(&mut rec, frame, None, None);
    rec.run()?;
    let upstream = frame.planes_grad.read()?;
    let zero =
        [3, 4 + FEATURES].iter().all(|k| upstream[k * pixels..(k + 1) * pixels].iter().all(|g| *g == 0.0));
    let cleared = if zero { Ok(0.0) } else { Err("the depth gradient was not cleared".to_owned()) };
    Ok(worst([depth, alpha, scale, cleared]))
}

fn screen_gradients(device: &Device) -> Found {
    let scene = Scene::new(0);
    let (params, raster) = scene.rendered(device, DeviceChoices::of(device))?;
    let frame = raster.frame();
    let mut random = Random::new(15);
    let values = 5 * (SIZE[0] * SIZE[1]) as usize;
    let upstream: Vec<f32> = (0..values).map(|_| random.scaled_normal(1.0) as f32).collect();
    frame.planes_grad.write(&upstream)?;
    let sums = device.buffer_from("sums", &vec![1.0f32; 2 * params.count])?;
    let mut rec = Recorder::new(device, "self-check of the gradients on the screen");
    raster.record_band_backward(&mut rec, &params, &scene.options, &frame.bands.get(0));
    screen_gradients::record(&mut rec, frame, params.count, &sums);
    rec.run()?;
    let forward = scene.reference();
    let reference = scene.projected(&forward);
    let upstream: Vec<f64> = upstream.iter().map(|&g| g.into()).collect();
    let gradients = raster_backward::reference(&reference, &Cutoffs::STANDARD, &upstream);
    let expected: Vec<f64> = forward
        .projected
        .iter()
        .zip(&gradients.geometry)
        .flat_map(|(projected, gradient)| match projected {
            Some(projected) => [1.0 + screen_gradients::reference(projected, gradient, SIZE), 2.0],
            None => [1.0, 1.0],
        })
        .collect();
    Ok(worst([close("sums", &sums.read()?, &expected, &gradient_tolerance(&expected))]))
}
