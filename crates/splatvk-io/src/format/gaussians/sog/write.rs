//! Writer of `.sog`.
use super::codebook::Codebook;
use super::{Asset, Coded, FIRST_TAG, Files, META, Means, Meta, ROW, Rest, VERSION, palette};
use crate::format::gaussians::{ply_packed, usable};
use crate::format::{archive, to_byte};
use crate::math::{quaternion_norm, sigmoid};
use crate::scene::Splats;
use crate::{Error, Result};
use image_webp::{ColorType, EncoderParams, WebPEncoder};
use rayon::prelude::*;
use std::path::Path;

/// Most entries of the palette: its indices have 16 bits.
const MOST_ENTRIES: usize = 1 << 16;
/// Gaussians per entry of the palette.
const PER_ENTRY: usize = 8;

/// An image of the archive.
struct Picture {
    name: &'static str,
    width: usize,
    height: usize,
    colour: ColorType,
    bytes: Vec<u8>,
}

/// Writes a file. The images compress best if neighbours are neighbours in them, so the order
/// changes: row r of the file is Gaussian `order[r]` of the scene.
pub fn write_splats(path: &Path, s: &Splats) -> Result<Vec<u32>> {
    usable::check_written(s)?;
    let order = ply_packed::morton_order(&s.means);
    let (mut pictures, means) = positions(s, &order);
    let (scales, picture) = scales(s, &order);
    pictures.push(picture);
    pictures.push(rotations(s, &order));
    let (sh0, picture) = base_colours(s, &order);
    pictures.push(picture);
    let rest = (s.sh_degree > 0 && !order.is_empty()).then(|| higher_bands(s, &order));
    let rest = rest.map(|(rest, both)| {
        pictures.extend(both);
        rest
    });
    let meta = Meta {
        version: VERSION,
        asset: Asset { generator: format!("splatvk {}", env!("CARGO_PKG_VERSION")) },
        count: order.len(),
        antialias: s.antialiased,
        means,
        scales,
        quats: Files { files: ["quats.webp".into()] },
        sh0,
        rest,
    };
    let failed = |e: &dyn std::fmt::Display| Error::work(format!("{}: {e}", path.display()));
    let meta = serde_json::to_vec(&meta).map_err(|e| failed(&e))?;
    let encoded: Vec<_> = pictures.par_iter().map(|p| (p.name, encoded(p))).collect();
    let images =
        encoded.into_iter().map(|(name, bytes)| Ok((name.to_owned(), bytes.map_err(|e| failed(&e))?)));
    // The images are compressed already.
    let members = std::iter::once(Ok((META.to_owned(), meta))).chain(images);
    archive::write(path, "sog", zip::CompressionMethod::Stored, members)?;
    Ok(order)
}

/// Lossless WebP, with or without prediction from the neighbours, whichever is smaller: indices of
/// a codebook are like those of their neighbours, indices of a palette are not.
fn encoded(picture: &Picture) -> Result<Vec<u8>, image_webp::EncodingError> {
    let encode = |predicted: bool| -> Result<Vec<u8>, image_webp::EncodingError> {
        let mut out = Vec::new();
        let mut encoder = WebPEncoder::new(&mut out);
        let mut params = EncoderParams::default();
        params.use_predictor_transform = predicted;
        encoder.set_params(params);
        // At most 16,384 pixels on a side: 268 million Gaussians.
        encoder.encode(&picture.bytes, picture.width as u32, picture.height as u32, picture.colour)?;
        Ok(out)
    };
    let (with, without) = rayon::join(|| encode(true), || encode(false));
    let (with, without) = (with?, without?);
    Ok(if with.len() < without.len() { with } else { without })
}

/// An image of one pixel per Gaussian, nearly square, of a multiple of four pixels on each side.
fn picture<const N: usize>(
    name: &'static str,
    order: &[u32],
    pixel: impl Fn(usize) -> [u8; N] + Sync,
) -> Picture {
    let fours = |n: usize| n.div_ceil(4).max(1) * 4;
    let width = fours(order.len().isqrt());
    let height = fours(order.len().div_ceil(width));
    let mut bytes = vec![0; width * height * N];
    let pixels = bytes.par_chunks_exact_mut(N).zip(order);
    pixels.for_each(|(to, i)| to.copy_from_slice(&pixel(*i as usize)));
    let colour = if N == 4 { ColorType::Rgba8 } else { ColorType::Rgb8 };
    Picture { name, width, height, colour, bytes }
}

fn logarithmic(v: f32) -> f64 {
    let v = f64::from(v);
    v.abs().ln_1p().copysign(v)
}

fn positions(s: &Splats, order: &[u32]) -> (Vec<Picture>, Means) {
    let bounds = |k: usize| {
        let all = s.means.iter().map(|m| logarithmic(m[k]));
        all.fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], v| [low.min(v), high.max(v)])
    };
    let bounds = [0, 1, 2].map(bounds).map(|b| if b[0] <= b[1] { b } else { [0.0; 2] });
    let word = |i: usize, k: usize| {
        let [low, high] = bounds[k];
        let at = if high > low { (logarithmic(s.means[i][k]) - low) / (high - low) } else { 0.0 };
        // In [0, 65535].
        (65535.0 * at).round() as u16
    };
    let names = ["means_l.webp", "means_u.webp"];
    let pictures = names
        .into_iter()
        .enumerate()
        .map(|(byte, name)| picture(name, order, |i| [0, 1, 2].map(|k| word(i, k).to_le_bytes()[byte])));
    let means =
        Means { mins: bounds.map(|b| b[0]), maxs: bounds.map(|b| b[1]), files: names.map(str::to_owned) };
    (pictures.collect(), means)
}

fn scales(s: &Splats, order: &[u32]) -> (Coded, Picture) {
    let codes = Codebook::fit(s.log_scales.as_flattened().to_vec());
    let picture = picture("scales.webp", order, |i| s.log_scales[i].map(|v| codes.index(v)));
    (Coded { codebook: codes.padded(), files: [picture.name.into()] }, picture)
}

/// The three smaller components of (w, x, y, z) over ±1/√2, and which one is the largest.
fn rotations(s: &Splats, order: &[u32]) -> Picture {
    picture("quats.webp", order, |i| {
        let q = s.quats[i];
        let largest = (0..4).max_by(|a, b| q[*a].abs().total_cmp(&q[*b].abs())).unwrap_or(0);
        // q and −q are one rotation: the largest component is read as positive.
        let sign = q[largest].signum() / quaternion_norm(&q);
        let mut bytes = [FIRST_TAG + largest as u8; 4];
        for (byte, k) in bytes.iter_mut().zip((0..4).filter(|k| *k != largest)) {
            *byte = to_byte(q[k] * sign * std::f32::consts::FRAC_1_SQRT_2 + 0.5);
        }
        bytes
    })
}

fn base_colours(s: &Splats, order: &[u32]) -> (Coded, Picture) {
    let width = 3 * s.sh_len();
    let base = |i: usize| [0, 1, 2].map(|k| s.sh[i * width + k]);
    let codes = Codebook::fit((0..s.len()).flat_map(base).collect());
    let picture = picture("sh0.webp", order, |i| {
        let [r, g, b] = base(i).map(|v| codes.index(v));
        [r, g, b, to_byte(sigmoid(s.opacity_logits[i]))]
    });
    (Coded { codebook: codes.padded(), files: [picture.name.into()] }, picture)
}

fn higher_bands(s: &Splats, order: &[u32]) -> (Rest, [Picture; 2]) {
    let coefficients = s.sh_len() - 1;
    let width = 3 * coefficients;
    let rows: Vec<f32> = s.sh.chunks_exact(3 + width).flat_map(|row| &row[3..]).copied().collect();
    let most = (s.len() / PER_ENTRY).clamp(ROW, MOST_ENTRIES);
    let palette = palette::fit(&rows, width, most);
    let codes = Codebook::fit(palette.entries.clone());
    let count = palette.entries.len() / width;
    let height = count.div_ceil(ROW);
    let mut bytes: Vec<u8> = palette.entries.iter().map(|v| codes.index(*v)).collect();
    bytes.resize(ROW * height * width, 0);
    let (name, colour) = ("shN_centroids.webp", ColorType::Rgb8);
    let entries = Picture { name, width: ROW * coefficients, height, colour, bytes };
    let labels = picture("shN_labels.webp", order, |i| {
        let [low, high] = palette.labels[i].to_le_bytes();
        [low, high, 0]
    });
    let files = [entries.name.into(), labels.name.into()];
    let rest = Rest { count, bands: s.sh_degree, codebook: codes.padded(), files };
    (rest, [entries, labels])
}
