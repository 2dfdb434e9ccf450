//! Features by linear least squares: their blend is nearest to the codes of all labelled pixels
//! (docs/internals/method.md#lifting).
use super::lift::{Lifted, Lifting, MIN_WEIGHT, unit_start};
use crate::Result;
use crate::pass::codes::Mode;
use rayon::prelude::*;

/// Steps of conjugate gradients. A step costs a forward and a backward pass per photo, so these
/// cost about as much as training with the draft preset. Not searched
/// (docs/internals/experiments.md#measured-lifting).
const SOLVER_STEPS: usize = 8;

/// λ: weight of the prior, the mean code of a splat, as a share of its blending weight. With a
/// tenth, pixels determine the features where they agree, and the prior where they leave them open.
/// Not searched (docs/internals/experiments.md#measured-lifting).
const PRIOR: f32 = 0.1;

/// Sets the raw features of the model to the solution of
/// `min_f Σ_px |Σ_i w_i f_i − c|² + λ Σ_i W_i |f_i − m_i|²`, scaled to the length that training
/// starts from. W_i is the blending weight of splat i over the labelled pixels and m_i the mean of
/// the codes of its pixels.
pub(super) fn solve(lifting: &mut Lifting, lifted: &Lifted) -> Result<()> {
    let width = lifting.targets.width();
    // W for every value; 0 keeps the values of splats that no labelled pixel shows at zero.
    let usable = |w: &f32| if *w > MIN_WEIGHT { *w } else { 0.0 };
    let weights: Vec<f32> =
        lifted.weights.iter().map(usable).flat_map(|w| std::iter::repeat_n(w, width)).collect();
    let mean: Vec<f32> = lifted.sums.par_iter().zip(&weights).map(|(s, w)| quotient(s, w)).collect();
    let mut x = mean;
    // The right-hand side is Aᵀc + λWm = (1 + λ) Aᵀc where W > 0.
    let applied = apply(lifting, lifted, &weights, &x)?;
    let right_hand_side = |(s, w): (&f32, &f32)| if *w > 0.0 { (1.0 + PRIOR) * s } else { 0.0 };
    let mut residual: Vec<f32> =
        lifted.sums.par_iter().zip(&weights).map(right_hand_side).zip(&applied).map(|(b, a)| b - a).collect();
    let precondition = |r: &[f32]| -> Vec<f32> {
        r.par_iter().zip(&weights).map(|(r, w)| quotient(r, &((1.0 + PRIOR) * w))).collect()
    };
    let mut z = precondition(&residual);
    let mut direction = z.clone();
    let mut energy = dot(&residual, &z);
    for _ in 0..SOLVER_STEPS {
        let applied = apply(lifting, lifted, &weights, &direction)?;
        let curvature = dot(&direction, &applied);
        // False for NaN, too: the solution so far stays.
        let descends = curvature > 0.0 && energy > 0.0;
        if !descends {
            break;
        }
        let step = (energy / curvature) as f32;
        x.par_iter_mut().zip(&direction).for_each(|(x, d)| *x += step * d);
        residual.par_iter_mut().zip(&applied).for_each(|(r, a)| *r -= step * a);
        z = precondition(&residual);
        let next = dot(&residual, &z);
        let beta = (next / energy) as f32;
        direction.par_iter_mut().zip(&z).for_each(|(d, z)| *d = z + beta * *d);
        energy = next;
    }
    Ok(lifting.model.values.features.write(&unit_start(x, width))?)
}

/// `v / w`, or 0 where w = 0.
fn quotient(v: &f32, w: &f32) -> f32 {
    if *w > 0.0 { v / w } else { 0.0 }
}

/// `(AᵀA + λW) v`, with A the blending of all labelled pixels. The photos give `AᵀA v − Aᵀc`, and
/// Aᵀc are the lifted sums.
fn apply(lifting: &mut Lifting, lifted: &Lifted, weights: &[f32], v: &[f32]) -> Result<Vec<f32>> {
    lifting.model.values.features.write(v)?;
    let mut sums = lifted.sums.clone();
    for view in 0..lifting.cameras.len() {
        lifting.add_gradients(view, Mode::Residual, &mut sums)?;
    }
    let with_prior = |((s, w), v): ((&f32, &f32), &f32)| if *w > 0.0 { s + PRIOR * w * v } else { 0.0 };
    Ok(sums.par_iter().zip(weights).zip(v).map(with_prior).collect())
}

fn dot(a: &[f32], b: &[f32]) -> f64 {
    a.par_iter().zip(b).map(|(x, y)| f64::from(*x) * f64::from(*y)).sum()
}

#[cfg(test)]
mod tests {
    use super::PRIOR;
    use crate::fit::{LanguageOptions, LanguageRun, Photos, Preset, Start, Training};
    use crate::gpu::test_device;
    use crate::pass::{FeatureMode, RasterOptions, Renderer};
    use crate::progress::Silent;
    use crate::scene::seeded;
    use crate::scene::{Codebook, Image, LevelField, Pose, RgbImage, Splats};
    use glam::{DMat3, DVec3};

    #[test]
    fn features_solve_the_normal_equations() {
        const SIZE: (usize, usize) = (48, 36);
        let device = test_device();
        // A small splat before a large one, and one beside them.
        let splats = Splats {
            means: vec![[0.0, 0.0, 2.0], [0.1, 0.0, 3.0], [-0.5, 0.1, 4.0]],
            log_scales: [0.1f32, 0.4, 0.4].map(|s| [s.ln(); 3]).to_vec(),
            quats: vec![[1.0, 0.0, 0.0, 0.0]; 3],
            opacity_logits: vec![1.0; 3],
            sh_degree: 0,
            sh: vec![0.0; 9],
            antialiased: false,
        };
        let label = |p: usize| if p < 5 * SIZE.0 { -1 } else { i32::from(p % SIZE.0 > 26) };
        let codebook = Codebook {
            embedding_dim: 1,
            code_dim: 3,
            embeddings: vec![1.0; 2],
            codes: vec![1.0, 0.0, 0.0, 0.0, 1.0, 0.0],
            ..Codebook::default()
        };
        let data = (0..SIZE.0 * SIZE.1).map(label).collect();
        let targets = vec![Image { width: SIZE.0, height: SIZE.1, data }];
        let level = LevelField { codebook, targets, ..LevelField::default() };
        let images = [RgbImage { width: SIZE.0, height: SIZE.1, data: vec![[0.5; 3]; SIZE.0 * SIZE.1] }];
        let cameras = [seeded::camera(SIZE.0 as u32, SIZE.1 as u32, Pose::IDENTITY)];
        let options =
            LanguageOptions { start: Start::LeastSquares, ..LanguageOptions::preset(Preset::Draft) };
        let photos = Photos { images: &images, cameras: &cameras, depths: None, coverage: &[] };
        let run = LanguageRun::new(&device, photos, &splats, &[(0, &level)], &options, &Silent).unwrap();
        let (_, found) = run.trainer().step_resources().params.download().unwrap();

        // Blending weight of each splat in every pixel.
        let raster = RasterOptions { feature_mode: FeatureMode::Linear, ..RasterOptions::default() };
        let one_each = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];
        let mut renderer = Renderer::new(&device, &splats, &one_each, 3).unwrap().with_options(raster);
        let shown = renderer.render(&cameras[0]).unwrap().features;
        // (AᵀA + λW) f = (1 + λ) Aᵀc; a column per channel.
        let (mut left, mut right, prior) = (DMat3::ZERO, DMat3::ZERO, f64::from(PRIOR));
        for (p, w) in shown.chunks_exact(3).enumerate().filter(|(p, _)| label(*p) >= 0) {
            let w = DVec3::new(w[0].into(), w[1].into(), w[2].into());
            left += DMat3::from_cols(w * w.x, w * w.y, w * w.z) + DMat3::from_diagonal(prior * w);
            *right.col_mut(label(p) as usize) += (1.0 + prior) * w;
        }
        let solution = left.inverse() * right;
        for (splat, f) in found.chunks_exact(3).enumerate() {
            let own = DVec3::new(f[0].into(), f[1].into(), f[2].into()).normalize();
            let off = own.distance(solution.row(splat).normalize());
            // The sums are of f32; the means of the codes are 0.3 to 0.8 away.
            assert!(off < 5e-3, "{splat}: {own}, {off} from {solution}");
        }
    }
}
