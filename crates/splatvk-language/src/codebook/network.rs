//! A small fully connected network with hand-written gradients, for the scene autoencoder. Batches
//! are columns.
use crate::math::Random;
use nalgebra::{DMatrix, DVector};

/// Added to a batch variance (the published default).
const NORM_EPSILON: f32 = 1e-5;
/// Weight of a new batch in the running statistics (the published default).
const NORM_MOMENTUM: f32 = 0.1;

/// Mode of the batch normalisation.
#[derive(Clone, Copy, PartialEq)]
pub(super) enum Mode {
    /// Normalises by the statistics of the batch.
    Train,
    /// Normalises by the running statistics.
    Infer,
}

/// Adam (Kingma & Ba 2015) with the usual β and ε.
pub(super) struct Adam {
    rate: f64,
    steps: i32,
}

impl Adam {
    pub fn new(rate: f64) -> Self {
        Adam { rate, steps: 0 }
    }
    /// Counts a batch.
    pub fn tick(&mut self) {
        self.steps += 1;
    }
}

/// A parameter with its moments.
struct Parameter {
    value: DMatrix<f32>,
    first: DMatrix<f32>,
    second: DMatrix<f32>,
}

impl Parameter {
    fn new(value: DMatrix<f32>) -> Self {
        let zeros = DMatrix::zeros(value.nrows(), value.ncols());
        Parameter { value, first: zeros.clone(), second: zeros }
    }
    fn update(&mut self, gradient: &DMatrix<f32>, adam: &Adam) {
        let (b1, b2) = (0.9f32, 0.999f32);
        let correct = |b: f32| 1.0 - f64::from(b).powi(adam.steps);
        let rate = (adam.rate * correct(b2).sqrt() / correct(b1)) as f32;
        // ε of the uncorrected form
        let epsilon = 1e-8 * correct(b2).sqrt() as f32;
        // Slices, not the iterators of matrices, become vector instructions.
        let moments = self.first.as_mut_slice().iter_mut().zip(self.second.as_mut_slice());
        for ((v, (m, s)), g) in self.value.as_mut_slice().iter_mut().zip(moments).zip(gradient.as_slice()) {
            *m = b1 * *m + (1.0 - b1) * g;
            *s = b2 * *s + (1.0 - b2) * g * g;
            *v -= rate * *m / (s.sqrt() + epsilon);
        }
    }
}

/// Batch normalisation of the inputs of a layer.
struct Norm {
    scale: Parameter,
    shift: Parameter,
    mean: DVector<f32>,
    variance: DVector<f32>,
}

struct Layer {
    norm: Option<Norm>,
    /// Whether the input passes a ReLU (after the normalisation).
    relu: bool,
    weight: Parameter,
    bias: Parameter,
}

/// Values of a layer's forward pass that its gradient needs.
struct Trace {
    /// Normalised input before scale and shift, mean and deviation that it was normalised by.
    normalised: Option<(DMatrix<f32>, DVector<f32>, DVector<f32>)>,
    /// Input of the linear map.
    input: DMatrix<f32>,
    output: DMatrix<f32>,
}

/// Traces of a forward pass, one per layer.
pub(super) struct Pass(Vec<Trace>);

impl Pass {
    pub fn output(&self) -> &DMatrix<f32> {
        &self.0[self.0.len() - 1].output
    }
}

pub(super) struct Network {
    layers: Vec<Layer>,
}

impl Network {
    /// Linear layers of the given widths with ReLU between, and batch normalisation before each
    /// ReLU if requested.
    pub fn new(input: usize, widths: &[usize], normalise: bool, random: &mut Random) -> Self {
        let mut layers = Vec::new();
        let mut from = input;
        for (k, &to) in widths.iter().enumerate() {
            let norm = (normalise && k > 0).then(|| Norm {
                scale: Parameter::new(DMatrix::from_element(from, 1, 1.0)),
                shift: Parameter::new(DMatrix::zeros(from, 1)),
                mean: DVector::zeros(from),
                variance: DVector::from_element(from, 1.0),
            });
            // uniform in ±1/√fan-in
            let bound = 1.0 / (from as f64).sqrt();
            let mut draw = |_, _| ((2.0 * random.uniform() - 1.0) * bound) as f32;
            layers.push(Layer {
                norm,
                relu: k > 0,
                weight: Parameter::new(DMatrix::from_fn(to, from, &mut draw)),
                bias: Parameter::new(DMatrix::from_fn(to, 1, &mut draw)),
            });
            from = to;
        }
        Network { layers }
    }

    pub fn forward(&self, x: &DMatrix<f32>, mode: Mode) -> Pass {
        let mut traces: Vec<Trace> = Vec::with_capacity(self.layers.len());
        for layer in &self.layers {
            let input = traces.last().map_or(x, |t| &t.output);
            let trace = layer.forward(input, mode);
            traces.push(trace);
        }
        Pass(traces)
    }

    /// Moves all parameters against the gradient of the output; returns that of the input.
    pub fn backward(&mut self, pass: &Pass, gradient: DMatrix<f32>, adam: &Adam) -> DMatrix<f32> {
        let mut gradient = gradient;
        for (layer, trace) in self.layers.iter_mut().zip(&pass.0).rev() {
            gradient = layer.backward(trace, &gradient, adam);
        }
        gradient
    }
}

impl Layer {
    fn forward(&self, x: &DMatrix<f32>, mode: Mode) -> Trace {
        let (mut input, mut normalised) = (x.clone(), None);
        if let Some(norm) = &self.norm {
            let (mean, variance) = match mode {
                Mode::Train => (x.column_mean(), x.column_variance()),
                Mode::Infer => (norm.mean.clone(), norm.variance.clone()),
            };
            let deviation = variance.map(|v| (v + NORM_EPSILON).sqrt());
            for mut column in input.column_iter_mut() {
                column -= &mean;
                column.component_div_assign(&deviation);
            }
            normalised = Some((input.clone(), mean, deviation));
            for mut column in input.column_iter_mut() {
                column.component_mul_assign(&norm.scale.value.column(0));
                column += norm.shift.value.column(0);
            }
        }
        if self.relu {
            input.apply(|v| *v = v.max(0.0));
        }
        let mut output = &self.weight.value * &input;
        output.column_iter_mut().for_each(|mut c| c += self.bias.value.column(0));
        Trace { normalised, input, output }
    }

    fn backward(&mut self, trace: &Trace, gradient: &DMatrix<f32>, adam: &Adam) -> DMatrix<f32> {
        let by_weight = gradient * trace.input.transpose();
        let by_bias = DMatrix::from_column_slice(gradient.nrows(), 1, gradient.column_sum().as_slice());
        // `tr_mul` would take one product of columns after the other; this one is blocked for the
        // caches.
        let mut by_input = self.weight.value.transpose() * gradient;
        self.weight.update(&by_weight, adam);
        self.bias.update(&by_bias, adam);
        if self.relu {
            by_input.zip_apply(&trace.input, |g, v| {
                if v <= 0.0 {
                    *g = 0.0
                }
            });
        }
        match (&mut self.norm, &trace.normalised) {
            (Some(norm), Some((x, mean, deviation))) => {
                norm.update_running(mean, deviation);
                norm.backward(x, deviation, by_input, adam)
            }
            _ => by_input,
        }
    }
}

impl Norm {
    /// Moves the running statistics towards those of a batch.
    fn update_running(&mut self, mean: &DVector<f32>, deviation: &DVector<f32>) {
        let variance = deviation.map(|d| d * d - NORM_EPSILON);
        self.mean.axpy(NORM_MOMENTUM, mean, 1.0 - NORM_MOMENTUM);
        self.variance.axpy(NORM_MOMENTUM, &variance, 1.0 - NORM_MOMENTUM);
    }

    /// `x` is the normalised input of the pass.
    fn backward(
        &mut self,
        x: &DMatrix<f32>,
        deviation: &DVector<f32>,
        mut gradient: DMatrix<f32>,
        adam: &Adam,
    ) -> DMatrix<f32> {
        let n = x.ncols() as f32;
        let by_shift = gradient.column_sum();
        let by_scale = gradient.component_mul(x).column_sum();
        // ∂L/∂x = s/σ · (g − mean(g) − x̂·mean(g·x̂))
        for (mut g, x) in gradient.column_iter_mut().zip(x.column_iter()) {
            g.axpy(-1.0 / n, &by_shift, 1.0);
            g -= x.component_mul(&by_scale) / n;
            g.component_mul_assign(&self.scale.value.column(0));
            g.component_div_assign(deviation);
        }
        self.shift.update(&DMatrix::from_column_slice(by_shift.len(), 1, by_shift.as_slice()), adam);
        self.scale.update(&DMatrix::from_column_slice(by_scale.len(), 1, by_scale.as_slice()), adam);
        gradient
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn backward_input_gradient_matches_differences() {
        let mut random = Random::new(1000);
        let mut network = Network::new(4, &[6, 5, 2], true, &mut random);
        let mut draw = |r: usize, c: usize| DMatrix::from_fn(r, c, |_, _| random.normal() as f32);
        let (x, upstream) = (draw(4, 7), draw(2, 7));
        let value = |network: &Network, x: &DMatrix<f32>| {
            network.forward(x, Mode::Train).output().component_mul(&upstream).sum()
        };
        let numeric: Vec<f32> = (0..x.len())
            .map(|k| {
                let (mut a, mut b) = (x.clone(), x.clone());
                a[k] += 1e-3;
                b[k] -= 1e-3;
                (value(&network, &a) - value(&network, &b)) / 2e-3
            })
            .collect();
        let pass = network.forward(&x, Mode::Train);
        // a rate of zero: nothing moves
        let mut adam = Adam::new(0.0);
        adam.tick();
        let gradient = network.backward(&pass, upstream.clone(), &adam);
        let scale = gradient.amax();
        // f32 sums near 1 over a step of 2e-3: 1e-4 of rounding; a ReLU may switch within the step
        // for one column of the batch, four inputs
        let off = gradient.iter().zip(&numeric).filter(|(g, n)| (*g - *n).abs() > 5e-3 * scale).count();
        assert!(off <= 4, "{off} of {}: {gradient} {numeric:?}", x.len());
    }

    #[test]
    fn adam_fits_linear_map() {
        let mut random = Random::new(1001);
        let mut network = Network::new(3, &[2], false, &mut random);
        let truth = DMatrix::from_row_slice(2, 3, &[1.0, -2.0, 0.5, 0.0, 1.0, 1.0]);
        let mut adam = Adam::new(0.05);
        for _ in 0..600 {
            let x = DMatrix::from_fn(3, 16, |_, _| random.normal() as f32);
            let pass = network.forward(&x, Mode::Train);
            let gradient = (pass.output() - &truth * &x) / 16.0;
            adam.tick();
            network.backward(&pass, gradient, &adam);
        }
        let probe = DMatrix::identity(3, 3);
        let out = network.forward(&probe, Mode::Infer);
        assert!((out.output() - &truth * &probe).amax() < 0.05, "{}", out.output());
    }
}
