//! The scene autoencoder of LangSplat (Qin et al. 2024, docs/internals/method.md#other-codebooks)
//! as an alternative codebook, for comparison with the bijection.
//!
//! An encoder D → 3 and a decoder 3 → D are trained on the scene's features. Splats carry points of
//! the unit sphere, and the decoder maps a rendered point to an embedding. The decoder is
//! tabulated: the codebook is a lattice of [`LATTICE`] directions, at most 3.4° from any point,
//! 1.7° on average, each with its decoded embedding. The error of the decoder is far larger, and
//! the rest of the engine uses an ordinary codebook.
use super::network::{Adam, Mode, Network};
use super::{CodeEntry, EncodedLevel, min_chord};
use crate::math::Random;
use crate::progress::Progress;
use crate::scene::Codebook;
use crate::{Error, Result};
use nalgebra::DMatrix;

/// Number of directions in the table.
const LATTICE: usize = 2048;
/// Published schedule.
const EPOCHS: usize = 100;
const BATCH: usize = 64;
const RATE: f64 = 7e-4;
/// Weight of 1 − cosine beside the mean square error.
const COSINE_WEIGHT: f32 = 1e-3;

/// Widths after the input of encoder and decoder.
const ENCODER: [usize; 5] = [256, 128, 64, 32, 3];
const DECODER: [usize; 6] = [16, 32, 64, 128, 256, 256];

/// Trained encoder and decoder.
pub(crate) struct Autoencoder {
    encoder: Network,
    decoder: Network,
    /// Mean cosine of the training features and their reconstruction.
    pub cosine: f64,
}

/// Columns scaled to unit length, and their lengths.
fn unit_columns(x: &DMatrix<f32>) -> (DMatrix<f32>, Vec<f32>) {
    let norms: Vec<f32> = x.column_iter().map(|c| c.norm().max(1e-12)).collect();
    let mut y = x.clone();
    y.column_iter_mut().zip(&norms).for_each(|(mut c, n)| c /= *n);
    (y, norms)
}

/// Gradient by x of `y = x / ‖x‖` for upstream `g`.
fn unit_backward(y: &DMatrix<f32>, norms: &[f32], g: &DMatrix<f32>) -> DMatrix<f32> {
    let mut out = g.clone();
    for (k, mut column) in out.column_iter_mut().enumerate() {
        let along = y.column(k).dot(&g.column(k));
        column.axpy(-along, &y.column(k), 1.0);
        column /= norms[k];
    }
    out
}

impl Autoencoder {
    /// Trains on unit rows `[N, dim]` for the published epochs, but at least `least_steps`: minutes
    /// on a CPU.
    pub fn train(
        features: &[f32],
        dim: usize,
        least_steps: usize,
        seed: u64,
        progress: &dyn Progress,
    ) -> Result<Self> {
        let count = features.len() / dim.max(1);
        if count == 0 {
            return Err(Error::work("autoencoder: the scene has no region features"));
        }
        let mut random = Random::new(seed ^ 0xae);
        let decoder: Vec<usize> = DECODER.into_iter().chain([dim]).collect();
        let mut this = Autoencoder {
            encoder: Network::new(dim, &ENCODER, true, &mut random),
            decoder: Network::new(3, &decoder, false, &mut random),
            cosine: 0.0,
        };
        let mut adam = Adam::new(RATE);
        let mut order: Vec<usize> = (0..count).collect();
        let batch = BATCH.min(count);
        let steps = (EPOCHS * count.div_ceil(batch)).max(least_steps);
        let (mut done, mut start) = (0, count);
        while done < steps {
            progress.check()?;
            if start + batch > count {
                random.shuffle(&mut order);
                start = 0;
            }
            let rows = &order[start..start + batch];
            let x = DMatrix::from_fn(dim, batch, |r, c| features[rows[c] * dim + r]);
            start += batch;
            done += 1;
            adam.tick();
            this.step(&x, &mut adam)?;
        }
        let x = DMatrix::from_column_slice(dim, count, features);
        let restored = this.decode(&this.encode(&x));
        let sum: f64 = (0..count).map(|k| f64::from(x.column(k).dot(&restored.column(k)))).sum();
        this.cosine = sum / count as f64;
        Ok(this)
    }

    /// One step of Adam on a batch of columns.
    fn step(&mut self, x: &DMatrix<f32>, adam: &mut Adam) -> Result<()> {
        let inner = self.encoder.forward(x, Mode::Train);
        let (code, code_norms) = unit_columns(inner.output());
        let outer = self.decoder.forward(&code, Mode::Train);
        let (y, norms) = unit_columns(outer.output());
        let (_, gradient) = loss(&y, x);
        let gradient = unit_backward(&y, &norms, &gradient);
        let gradient = self.decoder.backward(&outer, gradient, adam);
        let gradient = unit_backward(&code, &code_norms, &gradient);
        self.encoder.backward(&inner, gradient, adam);
        if y.iter().all(|v| v.is_finite()) {
            Ok(())
        } else {
            Err(Error::work("autoencoder: training produced numbers that are not finite"))
        }
    }

    /// [3, N] unit columns.
    pub fn encode(&self, x: &DMatrix<f32>) -> DMatrix<f32> {
        unit_columns(self.encoder.forward(x, Mode::Infer).output()).0
    }

    /// [D, N] unit columns.
    pub fn decode(&self, code: &DMatrix<f32>) -> DMatrix<f32> {
        unit_columns(self.decoder.forward(code, Mode::Infer).output()).0
    }
}

/// Mean square error + 0.001·(1 − cosine) of unit columns, and the gradient by `y`.
fn loss(y: &DMatrix<f32>, x: &DMatrix<f32>) -> (f32, DMatrix<f32>) {
    let (n, batch) = (y.len() as f32, y.ncols() as f32);
    let difference = y - x;
    let cosine: f32 = (0..y.ncols()).map(|k| y.column(k).dot(&x.column(k))).sum::<f32>() / batch;
    let value = difference.norm_squared() / n + COSINE_WEIGHT * (1.0 - cosine);
    (value, difference * (2.0 / n) - x * (COSINE_WEIGHT / batch))
}

/// Points of a Fibonacci lattice on the unit sphere, [LATTICE, 3].
fn lattice() -> Vec<f32> {
    (0..LATTICE).flat_map(lattice_point).collect()
}

fn lattice_point(k: usize) -> [f32; 3] {
    let golden = std::f64::consts::PI * (3.0 - 5f64.sqrt());
    let z = 1.0 - (2 * k + 1) as f64 / LATTICE as f64;
    let (r, angle) = ((1.0 - z * z).sqrt(), golden * k as f64);
    [r * angle.cos(), r * angle.sin(), z].map(|v| v as f32)
}

/// One codebook per level, all over the same lattice; every entry gets the direction nearest to its
/// encoding.
pub(crate) fn build(
    levels: &[Vec<CodeEntry>],
    least_steps: usize,
    seed: u64,
    progress: &dyn Progress,
) -> Result<(Vec<EncodedLevel>, f64)> {
    let first = levels.iter().flatten().next();
    let dim = first.map_or(0, |e| e.embedding.len());
    let all: Vec<f32> = levels.iter().flatten().flat_map(|e| e.embedding.iter().copied()).collect();
    let model = Autoencoder::train(&all, dim, least_steps, seed, progress)?;
    let codes = lattice();
    let embeddings = model.decode(&DMatrix::from_column_slice(3, LATTICE, &codes));
    let table = Codebook {
        embedding_dim: dim,
        code_dim: 3,
        embeddings: embeddings.as_slice().to_vec(),
        min_chord: min_chord(&codes, 3),
        codes,
        weights: vec![0.0; LATTICE],
        members: vec![Vec::new(); LATTICE],
    };
    Ok((levels.iter().map(|entries| encode_level(&model, &table, entries)).collect(), model.cosine))
}

/// Assigns entries to the directions of `table`, which has no weights and members yet.
fn encode_level(model: &Autoencoder, table: &Codebook, entries: &[CodeEntry]) -> EncodedLevel {
    if entries.is_empty() {
        return EncodedLevel::default();
    }
    let mut codebook = table.clone();
    let mut code_of = Vec::with_capacity(entries.len());
    for entry in entries {
        let code = model.encode(&DMatrix::from_column_slice(table.embedding_dim, 1, &entry.embedding));
        let k = codebook.decode(code.as_slice()).unwrap_or(0);
        codebook.weights[k] += entry.weight as f32;
        codebook.members[k].extend_from_slice(&entry.members);
        code_of.push(k as u32);
    }
    EncodedLevel { codebook, code_of }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::progress::Silent;
    use crate::scene::MaskId;
    use std::sync::atomic::{AtomicUsize, Ordering};

    fn unit_rows(count: usize, dim: usize, seed: u64) -> Vec<f32> {
        let mut random = Random::new(seed);
        let mut rows: Vec<f32> = (0..count * dim).map(|_| random.normal() as f32).collect();
        crate::dir::normalise_rows(&mut rows, dim);
        rows
    }

    #[test]
    fn loss_gradient_matches_central_differences() {
        let (x, y) = (unit_rows(3, 6, 1), unit_rows(3, 6, 2));
        let x = DMatrix::from_column_slice(6, 3, &x);
        let y = DMatrix::from_column_slice(6, 3, &y);
        // through the normalisation, by central differences
        let value = |y: &DMatrix<f32>| loss(&unit_columns(y).0, &x).0;
        let (unit, norms) = unit_columns(&(&y * 1.7));
        let g = unit_backward(&unit, &norms, &loss(&unit, &x).1);
        for k in 0..18 {
            let (mut a, mut b) = (&y * 1.7, &y * 1.7);
            a[k] += 1e-2;
            b[k] -= 1e-2;
            let numeric = (value(&a) - value(&b)) / 2e-2;
            // f32: values near 0.3 carry 3e-8, over a step of 2e-2; the third derivative adds a
            // share of 1e-4
            assert!((numeric - g[k]).abs() < 1e-5 + 1e-3 * g[k].abs(), "{k}: {numeric} {}", g[k]);
        }
    }

    #[test]
    #[ignore = "takes long: tools/test-long"]
    fn autoencoder_restores_few_features_only() {
        let few = Autoencoder::train(&unit_rows(4, 32, 1000), 32, 2000, 0, &Silent).unwrap();
        assert!(few.cosine > 0.95, "{}", few.cosine);
        // 300 unrelated directions do not fit on a sphere, which the bijection avoids
        let many = Autoencoder::train(&unit_rows(300, 32, 1000), 32, 2000, 0, &Silent).unwrap();
        assert!(many.cosine < 0.8 && many.cosine > 0.2, "{}", many.cosine);
    }

    /// Cancels at the third check.
    #[derive(Default)]
    struct StopAtThree(AtomicUsize);

    impl Progress for StopAtThree {
        fn begin(&self, _: &'static str, _: u64) {}
        fn step(&self, _: u64, _: &str) {}
        fn end(&self) {}
        fn warn(&self, _: &str) {}
        fn cancelled(&self) -> bool {
            self.0.fetch_add(1, Ordering::SeqCst) >= 2
        }
    }

    #[test]
    fn train_cancelled_stops_between_steps() {
        let progress = StopAtThree::default();
        let stopped = Autoencoder::train(&unit_rows(4, 32, 1000), 32, 2000, 0, &progress);
        assert!(matches!(stopped, Err(Error::Cancelled)));
        assert_eq!(progress.0.into_inner(), 3, "it asks before every step");
    }

    #[test]
    #[ignore = "takes long: tools/test-long"]
    fn lattice_covers_sphere_and_decodes() {
        let codes = lattice();
        let probe = unit_rows(500, 3, 1001);
        for p in probe.chunks_exact(3) {
            let best =
                codes.chunks_exact(3).map(|c| c[0] * p[0] + c[1] * p[1] + c[2] * p[2]).fold(-1.0, f32::max);
            assert!(best.acos().to_degrees() < 3.4, "{}", best.acos().to_degrees());
        }
        let rows = unit_rows(5, 16, 1002);
        let entry = |row: &[f32]| CodeEntry {
            embedding: row.to_vec(),
            weight: 10.0,
            members: vec![MaskId::new(0, 0)],
        };
        let entries: Vec<CodeEntry> = rows.chunks_exact(16).map(entry).collect();
        let (built, cosine) = build(&[entries.clone(), Vec::new()], 2000, 0, &Silent).unwrap();
        assert!(built[1].codebook.is_empty() && built[0].code_of.len() == 5);
        let book = &built[0].codebook;
        let restored: f32 = entries
            .iter()
            .zip(&built[0].code_of)
            .map(|(e, &k)| {
                let row = &book.embeddings[k as usize * 16..(k as usize + 1) * 16];
                row.iter().zip(&e.embedding).map(|(a, b)| a * b).sum::<f32>()
            })
            .sum::<f32>()
            / 5.0;
        // at most 3.4° from the encoding, and the decoder is smooth
        assert!((f64::from(restored) - cosine).abs() < 0.1, "{restored} {cosine}");
    }
}
