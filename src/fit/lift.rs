//! Code targets in GPU memory, and lifting: the blending-weighted mean of the codes of the pixels
//! of each splat (docs/internals/method.md#lifting).
use super::scale::SceneScale;
use super::views::Views;
use crate::gpu::{self, Buffer, Device};
use crate::pass::bands::Band;
use crate::pass::codes::Targets;
use crate::pass::label_weights::LabelWeights;
use crate::pass::options::RasterOptions;
use crate::pass::rasterizer::{Rasterizer, SplatBuffers};
use crate::pass::view::View;
use crate::progress::Progress;
use crate::scene::{Camera, Coverage, Image, LevelField, RgbImage, Splats};
use crate::{Error, Result};
use rayon::prelude::*;

/// Least blending weight over labelled pixels, in pixels; splats with less start without a feature,
/// whose direction would be noise (docs/internals/method.md#lifting).
pub(super) const MIN_WEIGHT: f32 = 0.05;
/// Length of a lifted raw feature: far above ε, so that steps rotate it without collapsing it.
const LIFTED_LENGTH: f32 = 0.5;

/// Labels, codes and loss weights of all views and levels.
pub(super) struct CodeTargets {
    levels: u32,
    width: u32,
    /// [ΣK, d], all levels.
    codes: Buffer<f32>,
    /// Per view and band: [levels, rows·W] rows of `codes`, −1 = none or halo.
    labels: Vec<Vec<Buffer<i32>>>,
    /// Per view: [levels] weight of one labelled value.
    weights: Vec<Buffer<f32>>,
}

impl CodeTargets {
    /// Checks and uploads the targets. `weight` is the weight of L_sem, the mean over levels of the
    /// mean absolute difference over labelled pixels and channels.
    pub(super) fn new(
        device: &Device,
        levels: &[&LevelField],
        images: &[RgbImage],
        views: &Views,
        weight: f64,
    ) -> Result<Self> {
        let width = code_length(levels)?;
        let codes: Vec<f32> = levels.iter().flat_map(|l| l.codebook.codes.iter().copied()).collect();
        let (mut labels, mut weights) = (Vec::new(), Vec::new());
        for (view, image) in images.iter().enumerate() {
            let (mut rows, mut scale, mut first) = (Vec::new(), Vec::new(), 0);
            for level in levels {
                let start = rows.len();
                rows.extend(rows_of(level, view, image.data.len(), first)?);
                let valid = rows[start..].iter().filter(|r| **r >= 0).count().max(1);
                scale.push((weight / (levels.len() * valid * width) as f64) as f32);
                first += level.codebook.len() as i32;
            }
            let bands = &views.list[view].bands;
            let band = |b| device.buffer_from("code labels", &bands.cut_inner(&b, &rows, -1));
            labels.push(bands.iter().map(band).collect::<gpu::Result<_>>()?);
            weights.push(device.buffer_from("code weights", &scale)?);
        }
        Ok(CodeTargets {
            levels: levels.len() as u32,
            width: width as u32,
            codes: device.buffer_from("codes", &codes)?,
            labels,
            weights,
        })
    }

    /// Targets of the language loss in one band of a view.
    pub(super) fn of(&self, view: usize, band: &Band) -> Targets<'_> {
        Targets {
            labels: &self.labels[view][band.index],
            codes: &self.codes,
            weights: &self.weights[view],
            levels: self.levels,
            width: self.width,
        }
    }
}

/// Code length of levels that share a model.
pub(super) fn code_length(levels: &[&LevelField]) -> Result<usize> {
    let mut lengths = levels.iter().map(|l| l.codebook.code_dim);
    let first = lengths.next().unwrap_or(0);
    if lengths.any(|length| length != first) {
        return Err(Error::work("all levels must have codes of one length to share a model"));
    }
    Ok(first)
}

/// The labels of one level and view as rows of the common code table, whose first row for this
/// level is `first`.
fn rows_of(level: &LevelField, view: usize, pixels: usize, first: i32) -> Result<Vec<i32>> {
    let Some(map) = level.targets.get(view) else {
        return Ok(vec![-1; pixels]);
    };
    let codes = level.codebook.len() as i32;
    if map.data.len() != pixels || map.data.iter().any(|&l| l >= codes) {
        return Err(Error::work(format!(
            "the code targets of view {view} do not fit its photo ({} values for {pixels} pixels) or codebook",
            map.data.len()
        )));
    }
    Ok(map.data.iter().map(|&l| if l < 0 { -1 } else { l + first }).collect())
}

/// Sums of codes and weights of the splats over all labelled pixels.
pub(super) struct Lifted {
    /// [N, levels·d] blending-weighted sums of codes, `Σ_px w c`.
    pub(super) sums: Vec<f32>,
    /// [N, levels] blending weights of labelled pixels, `Σ_px w`, in pixels.
    pub(super) weights: Vec<f32>,
}

/// Lifts the codes of all photos onto splats.
pub(super) fn lift(
    device: &Device,
    cameras: &[Camera],
    splats: &Splats,
    levels: &[&LevelField],
    progress: &dyn Progress,
) -> Result<Lifted> {
    let labels = |view: usize| {
        let pixels = cameras[view].width as usize * cameras[view].height as usize;
        labels_of_view(levels, view, pixels)
    };
    let weights = label_weights(device, cameras, splats, labels, progress)?;
    Ok(Lifted::new(&weights, splats.len(), levels))
}

/// Masks of one photo.
#[derive(Clone, Copy)]
pub struct PhotoMasks<'a> {
    /// One per thing, each of the size of the camera.
    pub masks: &'a [Image<bool>],
    /// Used pixels; the others do not count. `None` = all.
    pub coverage: Option<&'a Coverage>,
}

/// Lifts masks of photos onto splats, in closed form: per thing the share [N] of the blending
/// weight of a splat that lies inside the masks, over all photos that show it; 0 for splats that
/// none shows. `photos` has one entry per camera with equally many masks.
pub fn lift_masks(
    device: &Device,
    cameras: &[Camera],
    splats: &Splats,
    photos: &[PhotoMasks],
    progress: &dyn Progress,
) -> Result<Vec<Vec<f32>>> {
    let things = photos.first().map_or(0, |photo| photo.masks.len());
    let weights = label_weights(device, cameras, splats, |view| mask_labels(&photos[view]), progress)?;
    let share = |thing: usize, splat: usize| {
        let of = |label: usize| {
            let found = weights.of(splat).iter().find(|(known, _)| *known == label as i32);
            found.map_or(0.0, |(_, weight)| *weight)
        };
        let (outside, inside) = (of(2 * thing), of(2 * thing + 1));
        if outside + inside > MIN_WEIGHT { inside / (outside + inside) } else { 0.0 }
    };
    let shares = |thing| (0..splats.len()).into_par_iter().map(|splat| share(thing, splat)).collect();
    Ok((0..things).map(shares).collect())
}

/// [things, H·W] labels of a photo: twice the number of the thing, and one more inside its mask.
fn mask_labels(photo: &PhotoMasks) -> Result<Vec<i32>> {
    let label = |thing: usize, pixel: usize, inside: bool| match photo.coverage {
        Some(coverage) if !coverage.uses(pixel) => -1,
        _ => 2 * thing as i32 + i32::from(inside),
    };
    let of_thing = |(thing, mask): (usize, &Image<bool>)| {
        let pixels = mask.data.iter().enumerate();
        pixels.map(|(pixel, inside)| label(thing, pixel, *inside)).collect::<Vec<i32>>()
    };
    Ok(photo.masks.iter().enumerate().flat_map(of_thing).collect())
}

/// Blending weights of the splats over the pixels of each label. `labels` returns those of a view,
/// [levels, H·W]; −1 = none. Nothing but blending weights is rendered.
fn label_weights(
    device: &Device,
    cameras: &[Camera],
    splats: &Splats,
    labels: impl Fn(usize) -> Result<Vec<i32>>,
    progress: &dyn Progress,
) -> Result<LabelWeights> {
    let params = SplatBuffers::upload(device, splats, &[], 0)?;
    let near = SceneScale::measure(cameras, &splats.means).near();
    // Colours are not rendered.
    let options = RasterOptions { sh_degree: 0, ..RasterOptions::default() };
    let sizes: Vec<[u32; 2]> = cameras.iter().map(|c| [c.width, c.height]).collect();
    let mut raster = Rasterizer::for_viewing(device, splats.len(), 0, &sizes)?;
    let mut weights = LabelWeights::new(splats.len());
    for (view, camera) in cameras.iter().enumerate() {
        progress.check()?;
        raster.set_size(sizes[view])?;
        raster.set_view(&View::new(camera, near))?;
        raster.add_label_weights(&params, &options, &labels(view)?, &mut weights)?;
    }
    Ok(weights)
}

/// [levels, H·W] labels of a view as rows of the common code table; −1 = none.
fn labels_of_view(levels: &[&LevelField], view: usize, pixels: usize) -> Result<Vec<i32>> {
    let (mut rows, mut first) = (Vec::with_capacity(levels.len() * pixels), 0);
    for level in levels {
        rows.extend(rows_of(level, view, pixels, first)?);
        first += level.codebook.len() as i32;
    }
    Ok(rows)
}

impl Lifted {
    /// Sums of the codes of labels, which are rows of the common code table.
    fn new(weights: &LabelWeights, splats: usize, levels: &[&LevelField]) -> Lifted {
        let width = levels[0].codebook.code_dim;
        let rows: Vec<(usize, &[f32])> = levels
            .iter()
            .enumerate()
            .flat_map(|(l, level)| level.codebook.codes.chunks_exact(width).map(move |code| (l, code)))
            .collect();
        let mut lifted = Lifted {
            sums: vec![0.0; splats * levels.len() * width],
            weights: vec![0.0; splats * levels.len()],
        };
        let of_splats = lifted.sums.par_chunks_exact_mut(levels.len() * width);
        let of_splats = of_splats.zip(lifted.weights.par_chunks_exact_mut(levels.len()));
        of_splats.enumerate().for_each(|(splat, (sums, total))| {
            for &(label, weight) in weights.of(splat) {
                let (level, code) = rows[label as usize];
                total[level] += weight;
                let sums = &mut sums[level * width..(level + 1) * width];
                sums.iter_mut().zip(code).for_each(|(sum, c)| *sum += weight * c);
            }
        });
        lifted
    }

    /// Raw start features [N, levels·d], in the directions of the sums.
    pub(super) fn features(&self, width: usize) -> Vec<f32> {
        let mut features = self.sums.clone();
        // The length of a sum is at most the weight, and equal if all codes agree.
        features.par_chunks_exact_mut(width).filter(|f| length(f) <= MIN_WEIGHT).for_each(|f| f.fill(0.0));
        unit_start(features, width)
    }

    /// Reliability [N] of one of `levels`: the length of the mean of the unit codes of the pixels
    /// of a splat (docs/internals/method.md#reliability), in steps of 1/255; 0 for splats without
    /// pixels.
    pub(super) fn reliability(&self, level: usize, levels: usize, width: usize) -> Vec<f32> {
        let sums = self.sums.chunks_exact(width).skip(level).step_by(levels);
        let weights = self.weights.iter().skip(level).step_by(levels);
        let mean_length = |(sum, &weight): (&[f32], &f32)| {
            if weight > MIN_WEIGHT { (255.0 * (length(sum) / weight).min(1.0)).round() / 255.0 } else { 0.0 }
        };
        sums.zip(weights).map(mean_length).collect()
    }
}

/// Scales features to the length that training starts from; zeros stay.
pub(super) fn unit_start(mut features: Vec<f32>, width: usize) -> Vec<f32> {
    features.par_chunks_exact_mut(width).for_each(|feature| {
        let norm = length(feature);
        if norm > 0.0 {
            feature.iter_mut().for_each(|v| *v *= LIFTED_LENGTH / norm);
        }
    });
    features
}

/// Length of a vector.
fn length(v: &[f32]) -> f32 {
    v.iter().map(|v| v * v).sum::<f32>().sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reliability_is_length_of_mean_code() {
        // Two levels of two numbers: one code throughout, two codes in equal parts; hardly any
        // weight, two opposite codes.
        let sums = vec![3.0, 0.0, 1.0, 1.0, 0.01, 0.0, 0.0, 0.0];
        let lifted = Lifted { sums, weights: vec![3.0, 2.0, 0.01, 4.0] };
        assert_eq!(lifted.reliability(0, 2, 2), [1.0, 0.0]);
        // √½ in steps of 1/255.
        assert_eq!(lifted.reliability(1, 2, 2), [180.0 / 255.0, 0.0]);
    }
}
