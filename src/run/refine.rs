//! Refinement of held-out cameras against a finished scene, as in evaluations of methods without
//! known poses: the scene is frozen, and the camera moves until its render is closest to the photo.
use crate::Result;
use crate::fit::pose::PoseAdam;
use crate::fit::scale::SceneScale;
use crate::fit::schedule::Exponential;
use crate::gpu::{Buffer, Device, Program, Recorder};
use crate::pass::metrics::planar;
use crate::pass::rasterizer::{RasterOptions, Rasterizer, SplatBuffers};
use crate::pass::ssim_l1::{ImageLoss, SsimL1};
use crate::pass::sum::{self, PARTIALS};
use crate::pass::view::View;
use crate::photo::PlainBorder as Border;
use crate::pose::numeric::rotation_angle;
use crate::progress::Progress;
use crate::scene::{Camera, Pose, RgbImage, Splats};

/// Weights of L1 and 1 − SSIM, as in training (Kerbl et al. 2023).
const WEIGHTS: [f64; 2] = [0.8, 0.2];

/// (divisor of the size, steps, first and last rate in radians). At half size a render costs a
/// third and the photo's blur widens the basin of convergence to several pixels; the last steps at
/// full size settle a tenth of a pixel. All steps together can turn a camera by 1.9 degrees about
/// each axis: a larger error is no residue of an alignment.
const LEVELS: [(u32, usize, f64, f64); 2] = [(2, 60, 1e-3, 2e-4), (1, 25, 3e-4, 3e-5)];

/// Refines cameras against a frozen scene.
pub struct ViewRefiner {
    device: Device,
    params: SplatBuffers,
    gradients: SplatBuffers,
    options: RasterOptions,
    means: Vec<[f32; 3]>,
}

/// A refined camera, with its displacement.
#[derive(Clone, Debug)]
pub struct RefinedCamera {
    /// Refined camera.
    pub camera: Camera,
    /// Rotation from the given camera, degrees.
    pub rotation_degrees: f64,
    /// Displacement of the centre over the median depth.
    pub centre_fraction: f64,
}

impl ViewRefiner {
    /// Uploads a scene without its language.
    pub fn new(device: &Device, splats: &Splats) -> Result<ViewRefiner> {
        let params = SplatBuffers::upload(device, splats, &[], 0)?;
        Ok(ViewRefiner {
            device: device.clone(),
            gradients: params.zeros_like(device)?,
            options: RasterOptions { sh_degree: splats.sh_degree, ..RasterOptions::default() },
            params,
            means: splats.means.clone(),
        })
    }

    /// Returns the camera near the given one that shows the photo best; sizes are those of the
    /// photo.
    pub fn refine(
        &self,
        camera: &Camera,
        photo: &RgbImage,
        progress: &dyn Progress,
    ) -> Result<RefinedCamera> {
        let scale = SceneScale::measure(std::slice::from_ref(camera), &self.means);
        let mut photo = photo.clone();
        Border::of(&photo).continue_picture(&mut photo);
        let mut pose = camera.pose;
        for (divisor, steps, first, last) in LEVELS {
            let size = [camera.width, camera.height].map(|s| s.div_ceil(divisor));
            let scaled = Camera { pose, ..camera.resized(size[0], size[1]) };
            let image = photo.resized_by_area(size[0] as usize, size[1] as usize);
            let rate = Exponential { start: first, end: last, steps };
            pose = self.descend(&scaled, &image, (steps, rate), &scale, progress)?;
        }
        let turn = pose.compose(&camera.pose.inverse()).rotation;
        Ok(RefinedCamera {
            rotation_degrees: rotation_angle(&turn).to_degrees(),
            centre_fraction: (pose.centre() - camera.pose.centre()).length() / scale.median_depth,
            camera: Camera { pose, ..camera.clone() },
        })
    }

    /// Runs gradient descent at one size; returns the visited pose with the least loss.
    fn descend(
        &self,
        camera: &Camera,
        photo: &RgbImage,
        (steps, rate): (usize, Exponential),
        scale: &SceneScale,
        progress: &dyn Progress,
    ) -> Result<Pose> {
        let mut raster = Rasterizer::new(&self.device, self.params.count, 0, camera.width, camera.height)?;
        // An image that needs several bands keeps the pose of the coarser level.
        let bands = raster.frame().bands.clone();
        if bands.count() > 1 {
            return Ok(camera.pose);
        }
        let loss = SsimL1::new(&self.device, std::slice::from_ref(&bands))?;
        let sums = self.device.buffer::<f32>("loss sums", 2 * PARTIALS)?;
        raster.set_view(&View::new(camera, scale.near()))?;
        raster.forward(&self.params, &self.options)?;
        let target = self.device.buffer_from("photo", &planar(&target(photo, &raster)?))?;
        let mut program: Option<Program> = None;
        let (mut pose, mut adam) = (camera.pose, PoseAdam::default());
        let mut best = (f64::INFINITY, pose);
        for step in 0..=steps {
            progress.check()?;
            raster.set_view(&View::new(&Camera { pose, ..camera.clone() }, scale.near()))?;
            loop {
                let ready = match program.take() {
                    Some(program) => program,
                    None => self.record(&raster, &loss, &target, &sums).compile()?,
                };
                ready.run()?;
                match raster.overflow()? {
                    None => program = Some(ready),
                    Some(needed) => {
                        raster.grow(needed)?;
                        continue;
                    }
                }
                break;
            }
            let s = sums.read()?;
            let total = ImageLoss::of(&bands, [0, 1].map(|slot| sum::total(&s, slot)), None)
                .total(WEIGHTS[0], WEIGHTS[1]);
            if total < best.0 {
                best = (total, pose);
            }
            if step < steps {
                let g = raster.frame().camera_grad.read()?;
                let twist = [g[0], g[1], g[2], g[3], g[4], g[5]].map(f64::from);
                pose = adam.update(&pose, twist, rate.at(step), scale.median_depth);
            }
        }
        Ok(best.1)
    }

    fn record(
        &self,
        raster: &Rasterizer,
        loss: &SsimL1,
        target: &Buffer<f32>,
        sums: &Buffer<f32>,
    ) -> Recorder {
        let frame = raster.frame();
        let mut rec = Recorder::new(&self.device, "refine view");
        raster.record_forward(&mut rec, &self.params, &self.options);
        let whole = frame.bands.get(0);
        let (bands, gradient) = ((&frame.bands, &whole), &frame.planes_grad);
        loss.record(&mut rec, bands, &frame.planes, target, gradient, None, WEIGHTS, (sums, 0));
        raster.record_backward(&mut rec, &self.params, &self.options, &self.gradients);
        rec
    }
}

/// Photo with the exposure and white balance of the scene: mean and deviation of every channel are
/// those of the render. Pixels that the scene does not cover are those of the render.
fn target(photo: &RgbImage, raster: &Rasterizer) -> Result<RgbImage> {
    let pixels = photo.data.len();
    let planes = raster.frame().planes.read_range(0..3 * pixels)?;
    let transmittance = raster.frame().transmittance.read_range(0..pixels)?;
    let covered: Vec<usize> = (0..pixels).filter(|&p| transmittance[p] < 0.5).collect();
    let mut out = photo.clone();
    for c in 0..3 {
        let (mean, deviation) = mean_and_deviation(&covered, |p| photo.data[p][c]);
        let (scene_mean, scene_deviation) = mean_and_deviation(&covered, |p| planes[c * pixels + p]);
        let gain = if deviation > 1e-6 { scene_deviation / deviation } else { 1.0 };
        for (p, value) in out.data.iter_mut().enumerate() {
            let rendered = planes[c * pixels + p];
            let corrected = (scene_mean + gain * (f64::from(value[c]) - mean)) as f32;
            value[c] = if transmittance[p] < 0.5 { corrected } else { rendered };
        }
    }
    Ok(out)
}

fn mean_and_deviation(pixels: &[usize], value: impl Fn(usize) -> f32) -> (f64, f64) {
    let n = pixels.len().max(1) as f64;
    let mean = pixels.iter().map(|&p| f64::from(value(p))).sum::<f64>() / n;
    let variance = pixels.iter().map(|&p| (f64::from(value(p)) - mean).powi(2)).sum::<f64>() / n;
    (mean, variance.sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pass::renderer::Renderer;
    use crate::progress::Silent;
    use crate::scene::seeded;
    use glam::DVec3;

    /// Splats with sharp edges, and a render of them.
    fn scene() -> (Device, Splats, Camera, RgbImage) {
        let device = crate::gpu::open(None).unwrap();
        let (splats, camera) = seeded::small(400, 96, 72, 1, 5);
        let mut photo = Renderer::new(&device, &splats, &[], 0).unwrap().render(&camera).unwrap().rgb;
        photo.data.iter_mut().flatten().for_each(|v| *v = v.clamp(0.0, 1.0));
        (device, splats, camera, photo)
    }

    fn displacement(a: &Camera, b: &Camera) -> (f64, f64) {
        let turn = a.pose.compose(&b.pose.inverse()).rotation;
        (rotation_angle(&turn).to_degrees(), (a.pose.centre() - b.pose.centre()).length())
    }

    #[test]
    fn refine_recovers_pose_under_any_light() {
        let (device, splats, camera, mut photo) = scene();
        for c in &mut photo.data {
            *c = [0.7 * c[0] + 0.1, 0.8 * c[1], 0.9 * c[2] + 0.05];
        }
        let scale = SceneScale::measure(std::slice::from_ref(&camera), &splats.means).median_depth;
        let off = Pose::exp(DVec3::new(0.006, -0.004, 0.005) * scale, DVec3::new(0.006, 0.008, -0.005));
        let given = Camera { pose: off.compose(&camera.pose), ..camera.clone() };
        let moved = ViewRefiner::new(&device, &splats).unwrap().refine(&given, &photo, &Silent).unwrap();
        let (before, after) = (displacement(&given, &camera), displacement(&moved.camera, &camera));
        assert!(before.0 > 0.6 && after.0 < 0.1, "{before:?} {after:?}");
        assert!(after.1 < 0.2 * before.1, "{before:?} {after:?}");
        let (rotation, distance) = displacement(&moved.camera, &given);
        assert!((rotation - moved.rotation_degrees).abs() < 1e-9);
        let median_depth = SceneScale::measure(std::slice::from_ref(&given), &splats.means).median_depth;
        assert!((distance / median_depth - moved.centre_fraction).abs() < 1e-9);
    }

    #[test]
    fn refine_keeps_exact_camera() {
        let (device, splats, camera, photo) = scene();
        let moved = ViewRefiner::new(&device, &splats).unwrap().refine(&camera, &photo, &Silent).unwrap();
        // 0.05 degrees are 0.08 pixels here; a smaller render is not quite the smaller photo.
        assert!(moved.rotation_degrees < 0.05 && moved.centre_fraction < 1e-3, "{moved:?}");
    }
}
