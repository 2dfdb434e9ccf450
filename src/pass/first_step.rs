//! Check of the fused update: a first step that gives back the gradients, which the pass does not
//! store.
use super::adam::{BETA, Moments, Schedule};
use super::close::{Tolerance, compare, gradient_tolerance};
use super::fused_update::{ROWS, SplatAdam, flat};
use super::params::Params;
use super::regularise::{RatioPenalty, ratio_penalty};
use crate::Result;
use crate::gpu::{Device, shaders};

/// (head, tail) rates, powers of two, of the classes in the order of [`ROWS`].
const RATES: [[f64; 2]; 5] = [[0.5; 2], [1.0; 2], [0.25; 2], [2.0; 2], [0.5, 1.0]];
const NAMES: [&str; 5] = ["means", "log scales", "quaternions", "opacity logits", "SH"];

/// Inputs of a first step, and the gradients that it must have.
///
/// ε is the root mean square of the gradients of a class: a parameter moves by
/// rate · g / (|g| + ε), from which g follows.
pub struct FirstStep {
    start: [Vec<f64>; 5],
    gradients: [Vec<f64>; 5],
    epsilon: [f64; 5],
    moments: [Moments; 5],
    schedule: Schedule,
    needles: Option<RatioPenalty>,
}

impl FirstStep {
    /// Prepares the step of `params`; `gradients` are those of the images by the reference, to
    /// which the penalty on needles is added.
    pub fn new(
        device: &Device,
        params: &Params,
        mut gradients: Params,
        needles: Option<RatioPenalty>,
    ) -> Result<FirstStep> {
        if let Some(RatioPenalty { weight, limit }) = needles {
            for (s, g) in params.log_scales.iter().zip(&mut gradients.log_scales) {
                *g += glam::DVec3::from(ratio_penalty(s.to_array(), weight, limit.into()).1);
            }
        }
        let (start, gradients) = (flat(params), flat(&gradients));
        let mut schedule = Schedule::new(device, ROWS.len())?;
        let mean_square = |g: &Vec<f64>| g.iter().map(|g| g * g).sum::<f64>() / g.len().max(1) as f64;
        let epsilon = gradients.each_ref().map(|g| mean_square(g).sqrt().max(1e-9));
        ROWS.iter().zip(epsilon).for_each(|(row, epsilon)| schedule.set_epsilon(*row, epsilon));
        schedule.set(1, &RATES)?;
        let [a, b, c, d, e] = start.each_ref().map(|v| Moments::new(device, v.len()));
        Ok(FirstStep { start, gradients, epsilon, moments: [a?, b?, c?, d?, e?], schedule, needles })
    }

    /// State for [`super::Rasterizer::record_update`].
    pub fn state(&self) -> SplatAdam<'_> {
        SplatAdam { moments: &self.moments, schedule: &self.schedule, needles: self.needles }
    }

    /// Compares the gradients with the reference and the moments with the gradients; `moved` are
    /// the parameters after the step. Returns the largest relative L2 error of a class, or the
    /// number that exceeds its bound.
    pub fn compare(&self, moved: &Params) -> Result<std::result::Result<f64, String>> {
        let faults = self.schedule.faults()?;
        if faults > 0 {
            return Ok(Err(format!("{faults} gradients are not finite")));
        }
        let moved = flat(moved);
        let mut largest = 0.0f64;
        for class in 0..ROWS.len() {
            let found = self.gradients_by(class, &moved[class]);
            let expected = &self.gradients[class];
            let moments = self.moments[class].read(expected.len())?;
            let compared = compare(&found, expected, &gradient_tolerance(expected))
                .and_then(|d| self.moments_fit(class, &moments, &found).map(|()| d.relative_l2));
            match compared {
                Ok(distance) => largest = largest.max(distance),
                Err(e) => return Ok(Err(format!("{}: {e}", NAMES[class]))),
            }
        }
        Ok(Ok(largest))
    }

    /// Gradients of a class by the lengths of the step.
    fn gradients_by(&self, class: usize, moved: &[f64]) -> Vec<f32> {
        let is_sh = ROWS[class] == shaders::fused_update::SH_ROW;
        // SH coefficients per splat: the opacity logits count the splats.
        let width = self.start[class].len() / self.start[3].len().max(1);
        let pairs = self.start[class].iter().zip(moved).enumerate();
        let gradient = |(i, (from, to)): (usize, (&f64, &f64))| {
            let rate = RATES[class][usize::from(is_sh && i % width >= 3)];
            let step = (from - to) / rate;
            (self.epsilon[class] * step / (1.0 - step.abs())) as f32
        };
        pairs.map(gradient).collect()
    }

    /// m is a tenth of the gradient, v a thousandth of its square, both rounded.
    fn moments_fit(
        &self,
        class: usize,
        moments: &[[f32; 2]],
        gradients: &[f32],
    ) -> std::result::Result<(), String> {
        let scale = self.epsilon[class];
        // Parameters are rounded to f32, and the gradients here with them.
        let bounds = [(2f64.powi(-7), 1e-5 * scale), (2f64.powi(-7), 1e-8 * scale * scale)];
        for (k, (relative, absolute)) in bounds.into_iter().enumerate() {
            let tolerance =
                Tolerance { relative_l2: relative, absolute, relative, outliers: 0.0, outlier_factor: 1.0 };
            let found: Vec<f32> = moments.iter().map(|pair| pair[k]).collect();
            let expected: Vec<f64> =
                gradients.iter().map(|g| (1.0 - BETA[k]) * f64::from(*g).powi(k as i32 + 1)).collect();
            compare(&found, &expected, &tolerance).map_err(|e| format!("{}: {e}", ["m", "v"][k]))?;
        }
        Ok(())
    }
}
