//! Turns logits at points into proposals: upsamples them to the photo, tests their stability, drops
//! masks cut off by a crop and stores run lengths.
use rayon::prelude::*;
use splatvk_infer::sam::{MASKS, Proposals};

/// Distance from a crop's border, pixels, up to which a box counts as cut off
/// (docs/internals/method.md#masks-from-points).
pub(super) const BORDER: i32 = 20;

/// A rectangle of the photo, pixels, ends excluded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Crop {
    pub x0: usize,
    pub y0: usize,
    pub x1: usize,
    pub y1: usize,
}

/// A mask that the network proposed, in pixels of the whole photo.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct MaskProposal {
    pub level: usize,
    pub crop: usize,
    pub iou: f32,
    pub stability: f32,
    /// Lengths of runs over the rows, the first of them outside the mask.
    pub runs: Vec<u32>,
}

/// Logit offset of the stability test (docs/internals/method.md#masks-from-points).
const OFFSET: f32 = 1.0;

/// Bilinear weights of one axis: per target pixel the first source index and the weight of the
/// next.
fn axis(pixels: usize, cells: usize, filled: f64) -> Vec<(usize, f32)> {
    let scale = cells as f64 * filled / pixels as f64;
    let weights = (0..pixels).map(|p| {
        let position = ((p as f64 + 0.5) * scale - 0.5).clamp(0.0, (cells - 1) as f64);
        let first = (position as usize).min(cells.saturating_sub(2));
        (first, (position - first as f64) as f32)
    });
    weights.collect()
}

/// The proposals that pass `least` = (predicted IoU, stability), per point three, in order.
///
/// The logits are enlarged bilinearly straight to the photo; SAM goes through 1024 pixels first,
/// which differs by less than the grid of the logits resolves.
pub(super) fn candidates(
    proposals: &Proposals,
    points: &[[f64; 2]],
    crop: Crop,
    index: usize,
    photo: (usize, usize),
    least: (f32, f32),
) -> Vec<MaskProposal> {
    let (w, h) = (proposals.width, proposals.height);
    let columns = axis(crop.x1 - crop.x0, w, proposals.filled[0]);
    let rows = axis(crop.y1 - crop.y0, h, proposals.filled[1]);
    let candidate = |k: usize| {
        let iou = proposals.scores[k];
        // Not `<=`: NaN must fail.
        let passes = iou > least.0;
        let logits = proposals.logits.get(k * w * h..(k + 1) * w * h).filter(|_| passes)?;
        let enlarged = enlarge(logits, w, &columns, &rows);
        let above = |t: f32| enlarged.iter().filter(|v| **v > t).count();
        let (inner, outer) = (above(OFFSET), above(-OFFSET));
        let stability = inner as f32 / outer.max(1) as f32;
        let crop_width = crop.x1 - crop.x0;
        let bounds = bounds(&enlarged, crop_width)?;
        let whole = !cut_off(bounds, crop, photo);
        let runs = (stability >= least.1 && whole).then(|| runs(&enlarged, crop, photo))?;
        Some(MaskProposal { level: k % MASKS, crop: index, iou, stability, runs })
    };
    (0..points.len() * MASKS).into_par_iter().filter_map(candidate).collect()
}

fn enlarge(logits: &[f32], w: usize, columns: &[(usize, f32)], rows: &[(usize, f32)]) -> Vec<f32> {
    let mut out = Vec::with_capacity(columns.len() * rows.len());
    let mut line = vec![0f32; w];
    for (y, t) in rows {
        let (a, b) = (&logits[y * w..(y + 1) * w], logits.get((y + 1) * w..(y + 2) * w));
        let b = b.unwrap_or(a);
        line.iter_mut().zip(a.iter().zip(b)).for_each(|(l, (a, b))| *l = a + t * (b - a));
        out.extend(columns.iter().map(|(x, s)| {
            let (a, b) = (line[*x], line[(x + 1).min(w - 1)]);
            a + s * (b - a)
        }));
    }
    out
}

/// First and last column and row with a positive logit; `None` for an empty mask.
fn bounds(logits: &[f32], width: usize) -> Option<[i32; 4]> {
    let (mut x, mut y) = ((i32::MAX, -1), (i32::MAX, -1));
    for (p, _) in logits.iter().enumerate().filter(|(_, v)| **v > 0.0) {
        let (c, r) = ((p % width) as i32, (p / width) as i32);
        x = (x.0.min(c), x.1.max(c));
        y = (y.0.min(r), r);
    }
    (x.1 >= 0).then_some([x.0, y.0, x.1, y.1])
}

/// Whether a box touches a border of the crop that is not a border of the photo.
fn cut_off(b: [i32; 4], crop: Crop, photo: (usize, usize)) -> bool {
    let near = |v: i32, edge: usize| (v - edge as i32).abs() <= BORDER;
    let x = [b[0] + crop.x0 as i32, b[2] + crop.x0 as i32];
    let y = [b[1] + crop.y0 as i32, b[3] + crop.y0 as i32];
    near(x[0], crop.x0) && !near(x[0], 0)
        || near(y[0], crop.y0) && !near(y[0], 0)
        || near(x[1], crop.x1) && !near(x[1], photo.0)
        || near(y[1], crop.y1) && !near(y[1], photo.1)
}

/// Run lengths of a mask over the rows of the photo.
fn runs(logits: &[f32], crop: Crop, photo: (usize, usize)) -> Vec<u32> {
    let width = crop.x1 - crop.x0;
    let mut runs = RunEncoder::default();
    runs.push(false, (crop.y0 * photo.0) as u32);
    for row in logits.chunks_exact(width) {
        runs.push(false, crop.x0 as u32);
        row.iter().for_each(|v| runs.push(*v > 0.0, 1));
        runs.push(false, (photo.0 - crop.x1) as u32);
    }
    runs.push(false, ((photo.1 - crop.y1) * photo.0) as u32);
    runs.finish()
}

/// Encodes pixels as lengths of runs, the first of them outside the mask.
#[derive(Default)]
struct RunEncoder {
    runs: Vec<u32>,
    inside: bool,
    length: u32,
}

impl RunEncoder {
    fn push(&mut self, inside: bool, pixels: u32) {
        if pixels == 0 {
            return;
        }
        if inside != self.inside {
            self.runs.push(self.length);
            (self.inside, self.length) = (inside, 0);
        }
        self.length += pixels;
    }

    fn finish(mut self) -> Vec<u32> {
        self.runs.push(self.length);
        self.runs
    }
}

/// Encodes proposals as floats for the cache. Integers stay exact: no photo has 2²⁴ pixels.
pub(super) fn pack(all: &[MaskProposal]) -> Vec<f32> {
    let mut out = Vec::new();
    for c in all {
        out.extend([c.level as f32, c.crop as f32, c.iou, c.stability, c.runs.len() as f32]);
        out.extend(c.runs.iter().map(|r| *r as f32));
    }
    out
}

pub(super) fn unpack(mut values: &[f32]) -> Option<Vec<MaskProposal>> {
    let mut all = Vec::new();
    while !values.is_empty() {
        let (head, rest) = values.split_at_checked(5)?;
        let (runs, rest) = rest.split_at_checked(head[4] as usize)?;
        all.push(MaskProposal {
            level: head[0] as usize,
            crop: head[1] as usize,
            iou: head[2],
            stability: head[3],
            runs: runs.iter().map(|r| *r as u32).collect(),
        });
        values = rest;
    }
    Some(all)
}
