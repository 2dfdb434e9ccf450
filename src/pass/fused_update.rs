//! Projection backward and Adam in one pass: the gradients of the parameters never leave the
//! workgroup, and their buffers are not needed.
//!
//! Equations and references: [`super::project_backward`], [`super::regularise::ratio_penalty`],
//! [`super::adam`]; [`super::first_step`] compares them.
use super::adam::{Moments, Schedule};
use super::frame::FrameBuffers;
use super::params::Params;
use super::project_backward::{groups, record_camera};
use super::regularise::RatioPenalty;
use super::splat_buffers::SplatBuffers;
use crate::gpu::shaders::structs::CameraView;
use crate::gpu::{Buffer, DeviceInfo, KernelVariant, Recorder, VariantPair, shaders};

/// Rows of the [`Schedule`], and places in the array of moments, of the parameter classes: means,
/// log scales, quaternions, opacity logits, SH.
pub const ROWS: [u32; 5] = [
    shaders::fused_update::MEANS_ROW,
    shaders::fused_update::LOG_SCALES_ROW,
    shaders::fused_update::QUATS_ROW,
    shaders::fused_update::OPACITY_LOGITS_ROW,
    shaders::fused_update::SH_ROW,
];

/// Name of the pass in a recording.
pub const PASS: &str = "projection backward + Adam";

/// Passes from the gradients of the screen-space splats to the next parameters.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum UpdateKernel {
    /// Projection backward writes gradients that Adam reads, for CPU devices: two barriers per
    /// workgroup cost them more than the memory.
    Separate,
    /// Both in one pass, for GPUs.
    Fused,
}

impl UpdateKernel {
    /// The faster choice for the device, unless it is disabled or the device binds too few buffers.
    pub fn of(info: &DeviceInfo) -> UpdateKernel {
        match VariantPair::UPDATES.chosen(info) {
            KernelVariant::FusedUpdate if fits(info) => UpdateKernel::Fused,
            _ => UpdateKernel::Separate,
        }
    }
}

/// Whether the device binds the buffers of the fused pass at once.
pub fn fits(info: &DeviceInfo) -> bool {
    info.max_bindings >= shaders::fused_update::FAMILY.modules[0].bindings.len() as u32
}

/// State of Adam for all parameters but the features.
#[derive(Clone, Copy)]
pub struct SplatAdam<'a> {
    /// Moving averages, in the order of [`ROWS`].
    pub moments: &'a [Moments; 5],
    /// Rates of the step.
    pub schedule: &'a Schedule,
    /// Penalty on needles, whose gradient is added to that of the images.
    pub needles: Option<RatioPenalty>,
}

/// Records gradients and Adam's step of all parameters but the features; void where
/// `frame.status[1] ≠ 0`. All stored SH coefficients must be in use.
pub(super) fn record(
    rec: &mut Recorder,
    splats: &SplatBuffers,
    camera: &Buffer<CameraView>,
    frame: &FrameBuffers,
    most_groups: u32,
    state: &SplatAdam,
) {
    let [means, log_scales, quats, opacity_logits, sh] = state.moments;
    let call = shaders::fused_update::call(
        shaders::fused_update::Variant { sh_degree: splats.sh_degree },
        &shaders::fused_update::Bindings {
            camera,
            means: &splats.means,
            log_scales: &splats.log_scales,
            quats: &splats.quats,
            opacity_logits: &splats.opacity_logits,
            sh: &splats.sh,
            projected_grad: &frame.projected_grad,
            means_moments: &means.buffer,
            log_scales_moments: &log_scales.buffer,
            quats_moments: &quats.buffer,
            opacity_logits_moments: &opacity_logits.buffer,
            sh_moments: &sh.buffer,
            camera_parts: &frame.camera_parts,
            faults: &state.schedule.faults,
            rates: &state.schedule.rates,
            guard: &frame.status,
        },
        &shaders::fused_update::Push {
            count: splats.count as u32,
            antialiased: splats.antialiased.into(),
            weight: state.needles.map_or(0.0, |n| n.weight as f32),
            limit: state.needles.map_or(1.0, |n| n.limit),
        },
    );
    let groups = groups(splats.count, most_groups);
    rec.dispatch(call, [groups, 1, 1]);
    record_camera(rec, frame, groups);
}

/// The numbers of each class, in the order of [`ROWS`].
pub fn flat(params: &Params) -> [Vec<f64>; 5] {
    let flat = |v: &[glam::DVec3]| v.iter().flat_map(glam::DVec3::to_array).collect();
    [
        flat(&params.means),
        flat(&params.log_scales),
        params.quats.iter().flat_map(glam::DVec4::to_array).collect(),
        params.opacity_logits.clone(),
        flat(&params.sh),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::{Device, test_device};
    use crate::pass::adam::Class;
    use crate::pass::{DeviceChoices, RasterOptions, Rasterizer, View};
    use crate::scene::seeded;

    struct Step {
        device: Device,
        params: SplatBuffers,
        raster: Rasterizer,
        moments: [Moments; 5],
        schedule: Schedule,
    }

    const OPTIONS: RasterOptions = RasterOptions {
        sh_degree: 1,
        feature_mode: crate::pass::FeatureMode::Linear,
        features_move_geometry: true,
    };

    /// A frame whose gradients by the planes contain a number that is not finite.
    fn step() -> Step {
        let device = test_device();
        let (splats, camera) = seeded::small(150, 75, 53, 1, 1080);
        let params = SplatBuffers::upload(&device, &splats, &[], 0).unwrap();
        let choices = DeviceChoices {
            summation: crate::pass::GradientReduction::Entries,
            ..DeviceChoices::of(&device)
        };
        let mut raster = Rasterizer::with(&device, 150, 0, 75, 53, choices).unwrap();
        raster.set_view(&View::new(&camera, 0.05)).unwrap();
        raster.forward(&params, &OPTIONS).unwrap();
        let mut upstream = vec![0.5f32; 5 * 75 * 53];
        upstream[20 * 75 + 30] = f32::INFINITY;
        raster.frame().planes_grad.write(&upstream).unwrap();
        let mut rec = Recorder::new(&device, "backward");
        raster.record_band_backward(&mut rec, &params, &OPTIONS, &raster.frame().bands.get(0));
        rec.run().unwrap();
        let moments = WIDTHS.map(|width| Moments::new(&device, 150 * width).unwrap());
        let mut schedule = Schedule::new(&device, 5).unwrap();
        schedule.set(1, &[[1e-3, 1e-4]; 5]).unwrap();
        Step { device: device.clone(), params, raster, moments, schedule }
    }

    const WIDTHS: [usize; 5] = [3, 3, 4, 1, 12];

    fn update(step: &Step) {
        let mut rec = Recorder::new(&step.device, "update");
        let state = SplatAdam { moments: &step.moments, schedule: &step.schedule, needles: None };
        step.raster.record_update(&mut rec, &step.params, &OPTIONS, &state);
        rec.run().unwrap();
    }

    fn moments(step: &Step) -> Vec<[f32; 2]> {
        step.moments.iter().zip(WIDTHS).flat_map(|(m, width)| m.read(150 * width).unwrap()).collect()
    }

    #[test]
    fn update_of_overflowed_frame_is_void() {
        let step = step();
        let before = step.params.download().unwrap();
        step.raster.frame().status.write(&[0, 1, 0]).unwrap();
        update(&step);
        assert!(before == step.params.download().unwrap() && step.schedule.faults().unwrap() == 0);
        assert!(moments(&step).iter().all(|m| *m == [0.0; 2]));
    }

    #[test]
    fn non_finite_gradients_count_as_in_adam() {
        let (fused, separate) = (step(), step());
        update(&fused);
        let Step { device, params, raster, schedule, .. } = &separate;
        let gradients = params.zeros_like(device).unwrap();
        let mut rec = Recorder::new(device, "separate");
        raster.record_gradients(&mut rec, params, &OPTIONS, &gradients);
        let classes = [
            (&params.means, &gradients.means),
            (&params.log_scales, &gradients.log_scales),
            (&params.quats, &gradients.quats),
            (&params.opacity_logits, &gradients.opacity_logits),
            (&params.sh, &gradients.sh),
        ];
        for (k, (values, gradients)) in classes.into_iter().enumerate() {
            let (slot, count, stride) = (ROWS[k], 150 * WIDTHS[k], WIDTHS[k] as u32);
            let class = Class { slot, count, stride, head: stride.min(if k == 4 { 3 } else { 4 }) };
            let guard = &raster.frame().status;
            schedule.record(&mut rec, class, values, gradients, &separate.moments[k], guard);
        }
        rec.run().unwrap();
        let faults = schedule.faults().unwrap();
        assert!(faults > 0 && faults == fused.schedule.faults().unwrap(), "{faults}");
        for (a, b) in moments(&separate).as_flattened().iter().zip(moments(&fused).as_flattened()) {
            // Twice the rounding of m.
            assert!((a - b).abs() <= a.abs() / 64.0 + 1e-12, "{a} {b}");
        }
        let splats = fused.params.download().unwrap().0;
        assert!(splats.means.as_flattened().iter().chain(&splats.sh).all(|v| v.is_finite()));
    }
}
