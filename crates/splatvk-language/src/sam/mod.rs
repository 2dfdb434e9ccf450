//! Masks from a network that is prompted with points (docs/internals/method.md#masks-from-points):
//! a grid of points over the photo and over four overlapping crops, three masks each, one list per
//! level; poor, unstable and duplicate masks are dropped and the rest painted into label maps.
mod bits;
mod filter;
mod nms;
mod paint;

#[cfg(test)]
mod tests;

use super::{LevelMasks, ViewMasks};
use crate::progress::Progress;
use crate::scene::RgbImage;
use crate::{Error, Result};
use bits::Bits;
use filter::{Crop, MaskProposal};
use nms::Mask;
use splatvk_infer::cache::OutputKey;
use splatvk_infer::contract::Part;
use splatvk_infer::installed::Installed;
use splatvk_infer::sam::{BATCH, MASKS, Sam};

/// Options of the mask generator; the defaults are those of the paper (LangSplat's).
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct SamOptions {
    /// Points along each side of the photo, and of each crop.
    pub points: usize,
    /// Also process four overlapping crops.
    pub crops: bool,
    /// Least predicted IoU.
    pub min_iou: f32,
    /// Least stability: share of the mask at threshold −1 that remains at +1.
    pub min_stability: f32,
    /// Box IoU above which two masks are duplicates.
    pub box_overlap: f32,
    /// Size below which holes are filled and islands removed, pixels.
    pub min_region: usize,
    /// Mask IoU above which two masks are duplicates.
    pub mask_overlap: f32,
    /// Least predicted IoU · stability.
    pub min_score: f32,
    /// Paint masks in list order, cleaned-up ones last, as LangSplat; else larger ones first.
    pub paint_in_order: bool,
}

impl Default for SamOptions {
    fn default() -> Self {
        SamOptions {
            points: 32,
            crops: true,
            min_iou: 0.7,
            min_stability: 0.85,
            box_overlap: 0.7,
            min_region: 100,
            mask_overlap: 0.8,
            min_score: 0.7,
            paint_in_order: false,
        }
    }
}

/// Smallest (predicted IoU, stability) of cached proposals: the options can be lowered to these
/// without running the network again.
const KEPT: (f32, f32) = (0.5, 0.5);

/// The whole photo and, with `quarters`, the four overlapping crops of layer 1
/// (docs/internals/method.md#masks-from-points).
fn crops(width: usize, height: usize, quarters: bool) -> Vec<Crop> {
    let mut all = vec![Crop { x0: 0, y0: 0, x1: width, y1: height }];
    if quarters {
        // Two crops per side overlap by 512/1500 of the shorter side.
        let overlap = (512.0 / 1500.0 * width.min(height) as f64) as usize;
        let side = |n: usize| (overlap + n).div_ceil(2);
        let (w, h) = (side(width), side(height));
        for x0 in [0, w - overlap] {
            for y0 in [0, h - overlap] {
                all.push(Crop { x0, y0, x1: (x0 + w).min(width), y1: (y0 + h).min(height) });
            }
        }
    }
    all
}

/// Points on a grid over a crop, in its pixels, x fastest.
fn grid(n: usize, crop: Crop) -> Vec<[f64; 2]> {
    let (w, h) = ((crop.x1 - crop.x0) as f64, (crop.y1 - crop.y0) as f64);
    let centre = |k: usize| (k as f64 + 0.5) / n as f64;
    (0..n).flat_map(|j| (0..n).map(move |i| [centre(i) * w, centre(j) * h])).collect()
}

/// Computes the masks of every photo.
pub fn masks(
    model: &Installed,
    images: &[RgbImage],
    options: &SamOptions,
    progress: &dyn Progress,
) -> Result<Vec<ViewMasks>> {
    if options.points == 0 {
        return Err(Error::input("masks: give at least one point per side"));
    }
    let compute = model.compute();
    let _turn = compute.turn();
    let mut network: Option<Sam> = None;
    let crops = if options.crops { 5 } else { 1 };
    let calls = options.points.pow(2).div_ceil(BATCH) * crops;
    progress.begin("masks", (calls * images.len()) as u64);
    let mut views = Vec::with_capacity(images.len());
    for (k, image) in images.iter().enumerate() {
        let mut key = OutputKey::new("masks")
            .model(model.graph(Part::MaskEncoder)?)?
            .model(model.graph(Part::MaskDecoder)?)?;
        key = key.values(&image.data).values(&[
            image.width as u64,
            options.points as u64,
            u64::from(options.crops),
        ]);
        let before = (k * calls) as u64;
        let values = compute.remember(key, || {
            let net = match network.take() {
                Some(net) => net,
                None => Sam::load(model)?,
            };
            let net = network.insert(net);
            let all = propose(net, image, options, &|done| progress.step(before + done, ""), progress)?;
            Ok(filter::pack(&all))
        })?;
        let candidates = filter::unpack(&values).ok_or_else(|| {
            Error::work("masks: a damaged cache file; remove the cache folder and run again")
        })?;
        views.push(choose(candidates, image.width, image.height, options));
        progress.step(before + calls as u64, "");
    }
    progress.end();
    Ok(views)
}

/// Proposals of the network for a photo that pass the thresholds [`KEPT`].
fn propose(
    net: &mut Sam,
    image: &RgbImage,
    options: &SamOptions,
    step: &dyn Fn(u64),
    progress: &dyn Progress,
) -> Result<Vec<MaskProposal>> {
    let (mut all, mut done) = (Vec::new(), 0);
    for (index, crop) in crops(image.width, image.height, options.crops).into_iter().enumerate() {
        progress.check()?;
        let encoded = net.encode(&cut(image, crop))?;
        for points in grid(options.points, crop).chunks(BATCH) {
            progress.check()?;
            let proposals = net.decode(&encoded, points)?;
            all.extend(filter::candidates(
                &proposals,
                points,
                crop,
                index,
                (image.width, image.height),
                KEPT,
            ));
            done += 1;
            step(done);
        }
    }
    Ok(all)
}

fn cut(image: &RgbImage, crop: Crop) -> RgbImage {
    let rows = (crop.y0..crop.y1)
        .flat_map(|y| image.data[y * image.width + crop.x0..y * image.width + crop.x1].iter());
    RgbImage { width: crop.x1 - crop.x0, height: crop.y1 - crop.y0, data: rows.copied().collect() }
}

/// Selects proposals and paints the label maps of the three levels.
fn choose(candidates: Vec<MaskProposal>, width: usize, height: usize, options: &SamOptions) -> ViewMasks {
    let areas: Vec<usize> =
        crops(width, height, options.crops).iter().map(|c| (c.x1 - c.x0) * (c.y1 - c.y0)).collect();
    let levels = (0..MASKS).map(|level| {
        let of_level: Vec<&MaskProposal> = candidates.iter().filter(|c| c.level == level).collect();
        choose_level(&of_level, &areas, (width, height), options)
    });
    ViewMasks { levels: levels.collect() }
}

/// Label map of one level; `areas` has the pixels of each crop.
fn choose_level(
    proposals: &[&MaskProposal],
    areas: &[usize],
    (width, height): (usize, usize),
    options: &SamOptions,
) -> LevelMasks {
    let candidates: Vec<Mask> = proposals
        .iter()
        .filter(|c| c.iou > options.min_iou && c.stability >= options.min_stability)
        .map(|c| Mask {
            bits: Bits::from_runs(width, height, &c.runs),
            iou: c.iou,
            stability: c.stability,
            crop: c.crop,
            changed: false,
        })
        .collect();
    // Box NMS keeps the higher predicted IoU within a crop, the smaller crop across crops, and
    // the unchanged mask after the clean-up.
    let mut kept: Vec<Mask> = Vec::new();
    for crop in 0..areas.len() {
        let of_crop = candidates.iter().filter(|m| m.crop == crop).cloned().collect();
        kept.extend(nms::boxes(of_crop, options.box_overlap, |m| m.iou));
    }
    let area = |m: &Mask| areas.get(m.crop).copied().unwrap_or(1) as f32;
    kept = nms::boxes(kept, options.box_overlap, |m| 1.0 / area(m));
    for mask in &mut kept {
        mask.changed = mask.bits.clean(options.min_region);
    }
    kept.retain(|m| m.bits.count() > 0);
    kept = nms::boxes(kept, options.box_overlap, |m| if m.changed { 0.0 } else { 1.0 });
    kept = nms::masks(kept, options.mask_overlap, options.min_score);
    paint::labels(&kept, options.paint_in_order, width, height)
}
