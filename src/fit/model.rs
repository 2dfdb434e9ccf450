//! Splat parameters in GPU memory with their gradients and optimiser state, which pruning moves
//! together.
use super::losses::Losses;
use super::options::Rates;
use crate::gpu::{self, Buffer, Device, Recorder};
use crate::pass::adam::{Class, EPSILON, Moments, Schedule};
use crate::pass::compact;
use crate::pass::fused_update::{ROWS, SplatAdam, UpdateKernel};
use crate::pass::rasterizer::{RasterOptions, Rasterizer, SplatBuffers};
use crate::pass::regularise::{self, RatioPenalty};
use crate::scene::{SH_C0, Splats};
use crate::{Error, Result};
use serde::{Deserialize, Serialize};

/// Parameter classes, in the order of the rows of the schedule.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum ParameterClass {
    Means = ROWS[0] as isize,
    LogScales = ROWS[1] as isize,
    Quats = ROWS[2] as isize,
    Opacity = ROWS[3] as isize,
    Sh = ROWS[4] as isize,
}

/// All classes but the features.
pub(super) const GEOMETRY_AND_COLOUR: [ParameterClass; 5] = [
    ParameterClass::Means,
    ParameterClass::LogScales,
    ParameterClass::Quats,
    ParameterClass::Opacity,
    ParameterClass::Sh,
];

/// Row of the features in the schedule.
const FEATURE_ROW: usize = 5;

/// All parameters of the splats, in buffers of exactly their number: recordings are made again when
/// it changes.
pub(super) struct Model {
    device: Device,
    /// Parameters that the rasteriser reads.
    pub(super) values: SplatBuffers,
    /// Gradients of geometry and colour that its backward pass writes; `None` where one pass
    /// computes and uses them.
    gradients: Option<SplatBuffers>,
    /// [N, d] gradients of the features.
    pub(super) feature_gradients: Buffer<f32>,
    moments: [Moments; 5],
    feature_moments: Moments,
    pub(super) schedule: Schedule,
    /// Largest log-scale of each of the last rows, the splats that no photo shows.
    pub(super) unseen: Vec<f32>,
    /// Number of steps in the moments.
    step: usize,
}

/// State of a [`Model`] that steps change, for checkpoints.
#[derive(Serialize, Deserialize)]
pub(super) struct State {
    pub(super) splats: Splats,
    features: Vec<f32>,
    feature_dim: usize,
    /// Moments per class, then of the features.
    moments: Vec<Vec<u32>>,
    step: usize,
    unseen: Vec<f32>,
}

impl Model {
    /// Reads the state.
    pub(super) fn state(&self) -> Result<State> {
        let (splats, features) = self.values.download()?;
        let all = self.moments.iter().chain([&self.feature_moments]);
        let moments = all.map(|m| m.buffer.read()).collect::<gpu::Result<_>>()?;
        let (feature_dim, unseen) = (self.values.feature_dim, self.unseen.clone());
        Ok(State { splats, features, feature_dim, moments, step: self.step, unseen })
    }

    /// Restores a model from its state.
    pub(super) fn restored(device: &Device, state: &State) -> Result<Self> {
        let mut model = Model::new(device, &state.splats, state.feature_dim)?;
        model.values.features.write(&state.features)?;
        for (own, kept) in model.moments.iter().chain([&model.feature_moments]).zip(&state.moments) {
            own.buffer.write(kept)?;
        }
        (model.step, model.unseen) = (state.step, state.unseen.clone());
        Ok(model)
    }

    /// Uploads splats and reserves features [N, feature_dim], all zero.
    pub(super) fn new(device: &Device, splats: &Splats, feature_dim: usize) -> Result<Self> {
        let zeros = vec![0.0; splats.len() * feature_dim];
        let values = SplatBuffers::upload(device, splats, &zeros, feature_dim)?;
        let n = values.count;
        let moments = |kind| Moments::new(device, n * width(&values, kind));
        Ok(Model {
            moments: [
                moments(ParameterClass::Means)?,
                moments(ParameterClass::LogScales)?,
                moments(ParameterClass::Quats)?,
                moments(ParameterClass::Opacity)?,
                moments(ParameterClass::Sh)?,
            ],
            feature_moments: Moments::new(device, n * feature_dim)?,
            schedule: Schedule::new(device, FEATURE_ROW + 1)?,
            device: device.clone(),
            gradients: gradients_of(device, &values)?,
            feature_gradients: device.buffer::<f32>("gradient features", (n * feature_dim).max(4))?,
            values,
            unseen: Vec::new(),
            step: 0,
        })
    }

    /// Keeps the colour of splats that cover less than about `pixels` of a photo of `size` pixels:
    /// Adam moves by the rate however small the gradient, so that colours that leave no trace would
    /// drift.
    pub(super) fn hold_colours_below(&mut self, pixels: f64, size: usize) {
        // Gradient by the lowest coefficient of a splat with that blending weight, of the L1 loss.
        let gradient = Losses::PHOTOS.l1 * f64::from(SH_C0) / 3.0 * pixels / size.max(1) as f64;
        self.schedule.set_epsilon(ROWS[4], gradient.max(EPSILON));
    }

    /// Number of splats.
    pub(super) fn count(&self) -> usize {
        self.values.count
    }

    /// Row of the first splat that no photo shows.
    pub(super) fn first_unseen(&self) -> usize {
        self.count() - self.unseen.len()
    }

    /// Sets the rates of the next step; `extent` scales the rate of the means.
    pub(super) fn set_rates(
        &mut self,
        rates: &Rates,
        feature_rate: f64,
        extent: f64,
        iteration: usize,
    ) -> Result<()> {
        self.step += 1;
        let rows = [
            [rates.means.at(iteration) * extent; 2],
            [rates.log_scales; 2],
            [rates.quats; 2],
            [rates.opacity; 2],
            [rates.sh_dc, rates.sh_rest],
            [feature_rate; 2],
        ];
        self.schedule.set(self.step, &rows)
    }

    /// Records the backward pass from the screen-space splats of a frame to geometry, opacity and
    /// colour, and their Adam step; void where the frame overflowed.
    pub(super) fn record_update(
        &self,
        rec: &mut Recorder,
        raster: &Rasterizer,
        options: &RasterOptions,
        needles: Option<RatioPenalty>,
    ) {
        let Some(gradients) = &self.gradients else {
            let state = SplatAdam { moments: &self.moments, schedule: &self.schedule, needles };
            return raster.record_update(rec, &self.values, options, &state);
        };
        raster.record_splat_gradients(rec, &self.values, options, gradients);
        if let Some(needles) = needles {
            let count = self.count();
            regularise::record_ratio(rec, &self.values.log_scales, &gradients.log_scales, count, needles);
        }
        for kind in GEOMETRY_AND_COLOUR {
            let w = width(&self.values, kind);
            let class = Class {
                slot: kind as u32,
                count: self.count() * w,
                stride: w as u32,
                head: if kind == ParameterClass::Sh { 3 } else { w as u32 },
            };
            let (values, gradients) = (buffer(&self.values, kind), buffer(gradients, kind));
            let (moments, guard) = (&self.moments[kind as usize], &raster.frame().status);
            self.schedule.record(rec, class, values, gradients, moments, guard);
        }
    }

    /// Records the gradients of the raw features and their Adam step; void where the frame
    /// overflowed.
    pub(super) fn record_feature_update(
        &self,
        rec: &mut Recorder,
        raster: &Rasterizer,
        options: &RasterOptions,
    ) {
        raster.record_feature_gradients(rec, &self.values, options, &self.feature_gradients);
        let count = self.count() * self.values.feature_dim;
        let class = Class { slot: FEATURE_ROW as u32, count, stride: 1, head: 1 };
        self.schedule.record(
            rec,
            class,
            &self.values.features,
            &self.feature_gradients,
            &self.feature_moments,
            &raster.frame().status,
        );
    }

    /// Fails if a gradient of any step so far was not finite.
    pub(super) fn check(&self, iteration: usize) -> Result<()> {
        match self.schedule.faults()? {
            0 => Ok(()),
            n => Err(Error::work(format!(
                "training broke down before step {iteration}: {n} gradients are not finite; the cameras or points \
                 may be degenerate"
            ))),
        }
    }

    /// Keeps the given rows with their optimiser state; features and their moments are reset.
    /// Returns whether rows were removed.
    pub(super) fn keep(&mut self, rows: &[u32]) -> Result<bool> {
        if rows.len() == self.count() {
            return Ok(false);
        }
        self.replace(rows, &[])?;
        Ok(true)
    }

    /// Keeps the given rows with their optimiser state, and appends copies of the `added` rows
    /// without one. Features and their moments are reset. Splats that no photo shows stay last, so
    /// that none is added to a model with such.
    pub(super) fn replace(&mut self, kept: &[u32], added: &[u32]) -> Result<()> {
        debug_assert!(added.is_empty() || self.unseen.is_empty());
        let (device, rows) = (&self.device, [kept, added].concat());
        let n = rows.len();
        let index = device.buffer_from("kept rows", &rows)?;
        let (degree, dim) = (self.values.sh_degree, self.values.feature_dim);
        let mut values = SplatBuffers::zeros(device, "splats", n, degree, dim)?;
        values.antialiased = self.values.antialiased;
        for kind in GEOMETRY_AND_COLOUR {
            let w = width(&self.values, kind);
            *buffer_mut(&mut values, kind) =
                compact::gather(device, "kept splats", buffer(&self.values, kind), &index, n, w)?;
            let moments = &mut self.moments[kind as usize];
            moments.buffer = compact::gather(device, "adam moments", &moments.buffer, &index, n, w)?;
            if !added.is_empty() {
                moments.buffer.write_at(w * kept.len(), &vec![0; w * added.len()])?;
            }
        }
        self.feature_moments = Moments::new(device, n * dim)?;
        self.gradients = gradients_of(device, &values)?;
        self.feature_gradients = device.buffer::<f32>("gradient features", (n * dim).max(4))?;
        let first = self.first_unseen();
        let last = kept.iter().filter_map(|row| (*row as usize).checked_sub(first));
        self.unseen = last.map(|row| self.unseen[row]).collect();
        self.values = values;
        Ok(())
    }

    /// Copies the splats to the host.
    ///
    /// # Errors
    /// Where a value is not finite.
    pub(super) fn splats(&self) -> Result<Splats> {
        let (splats, _) = self.values.download()?;
        let fault = |(name, values): (&str, &[f32])| match not_finite(values) {
            0 => None,
            n => Some(format!("{n} {name}")),
        };
        let all: [(&str, &[f32]); 5] = [
            ("means", splats.means.as_flattened()),
            ("log-scales", splats.log_scales.as_flattened()),
            ("quaternions", splats.quats.as_flattened()),
            ("opacities", &splats.opacity_logits),
            ("SH coefficients", &splats.sh),
        ];
        let faults: Vec<String> = all.into_iter().filter_map(fault).collect();
        if faults.is_empty() {
            return Ok(splats);
        }
        Err(Error::work(format!(
            "training produced numbers that are not finite ({}); nothing was kept: the cameras or points may be degenerate",
            faults.join(", ")
        )))
    }
}

/// Buffers for the gradients of geometry and colour, where the device needs them.
fn gradients_of(device: &Device, values: &SplatBuffers) -> Result<Option<SplatBuffers>> {
    match UpdateKernel::of(device.info()) {
        UpdateKernel::Fused => Ok(None),
        UpdateKernel::Separate => {
            SplatBuffers::zeros(device, "gradient", values.count, values.sh_degree, 0).map(Some)
        }
    }
}

/// Number of values that are not finite.
pub(super) fn not_finite(values: &[f32]) -> usize {
    values.iter().filter(|v| !v.is_finite()).count()
}

/// Values per splat of a class.
fn width(splats: &SplatBuffers, kind: ParameterClass) -> usize {
    match kind {
        ParameterClass::Means | ParameterClass::LogScales => 3,
        ParameterClass::Quats => 4,
        ParameterClass::Opacity => 1,
        ParameterClass::Sh => 3 * splats.sh_len(),
    }
}

/// Buffer of a class.
fn buffer(splats: &SplatBuffers, kind: ParameterClass) -> &Buffer<f32> {
    match kind {
        ParameterClass::Means => &splats.means,
        ParameterClass::LogScales => &splats.log_scales,
        ParameterClass::Quats => &splats.quats,
        ParameterClass::Opacity => &splats.opacity_logits,
        ParameterClass::Sh => &splats.sh,
    }
}

fn buffer_mut(splats: &mut SplatBuffers, kind: ParameterClass) -> &mut Buffer<f32> {
    match kind {
        ParameterClass::Means => &mut splats.means,
        ParameterClass::LogScales => &mut splats.log_scales,
        ParameterClass::Quats => &mut splats.quats,
        ParameterClass::Opacity => &mut splats.opacity_logits,
        ParameterClass::Sh => &mut splats.sh,
    }
}
