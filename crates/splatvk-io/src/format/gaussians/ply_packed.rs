//! Compressed PLY of SuperSplat: chunks of 256 Gaussians with their bounds, each Gaussian in four
//! 32-bit words, SH in bytes. About a quarter of the size of a plain PLY without SH.
use super::ply_header::PropertyType;
use super::ply_table as table;
use super::{degree, ply_comments, usable};
use crate::math::quaternion_norm;
use crate::scene::Splats;
use crate::{Error, Result};
use std::path::Path;

/// Gaussians per chunk.
const CHUNK: usize = 256;
/// Columns of a chunk: minimum and maximum of position, log scale and colour.
const BOUNDS: [&str; 18] = [
    "min_x",
    "min_y",
    "min_z",
    "max_x",
    "max_y",
    "max_z",
    "min_scale_x",
    "min_scale_y",
    "min_scale_z",
    "max_scale_x",
    "max_scale_y",
    "max_scale_z",
    "min_r",
    "min_g",
    "min_b",
    "max_r",
    "max_g",
    "max_b",
];
const WORDS: [&str; 4] = ["packed_position", "packed_rotation", "packed_scale", "packed_color"];
/// Log scales beyond ± this carry no information (2e-9 to 5e8 units) and would cost the others of
/// the chunk their precision.
const LOG_SCALE_MAX: f32 = 20.0;
/// Range of an SH byte: −4 to 4.
const SH_RANGE: f32 = 8.0;
/// Opacity 0 and 1 have no finite logit; the bytes next to them are at ±5.5.
const LOGIT_MAX: f32 = 10.0;

/// Whether the vertex columns are packed.
pub(super) fn is_packed(columns: &[(String, PropertyType)]) -> bool {
    columns.iter().any(|c| c.0 == WORDS[0])
}

/// Reads the bytes of a file.
pub(super) fn parse(bytes: &[u8], notes: &mut Vec<String>) -> Result<Splats, String> {
    let chunks = table::rows(bytes, "chunk")?;
    let vertices = table::rows(bytes, "vertex")?;
    let words = vertices.all(WORDS)?;
    // Before version 2 of SuperSplat, chunks had no colour bounds: colours span 0 to 1.
    let bounds: Vec<Option<usize>> = BOUNDS.iter().map(|n| chunks.find(n)).collect();
    if let Some(k) = (0..12).find(|k| bounds[*k].is_none()) {
        return Err(format!("no column {} in the chunks", BOUNDS[k]));
    }
    if chunks.len() != vertices.len().div_ceil(CHUNK) {
        return Err(format!("{} chunks for {} Gaussians; copy the file again", chunks.len(), vertices.len()));
    }
    let sh = if table::has(bytes, "sh") { Some(table::rows(bytes, "sh")?) } else { None };
    let columns = sh.as_ref().map(|s| s.series("f_rest_")).unwrap_or_default();
    if sh.as_ref().is_some_and(|s| s.len() != vertices.len()) {
        return Err("the sh element has another number of rows".into());
    }
    let (sh_degree, rest) = degree::sh_degree(columns.len(), notes)?;
    let mut s = Splats::with_capacity(vertices.len(), sh_degree);
    for i in 0..vertices.len() {
        let bound = |k: usize| bounds[k].map(|c| chunks.value(i / CHUNK, c) as f32);
        let span = |first: usize, at: f32| match (bound(first), bound(first + 3)) {
            (Some(low), Some(high)) => low + at * (high - low),
            _ => at,
        };
        let [position, rotation, scale, colour] = words.map(|c| vertices.value(i, c) as u32);
        let [x, y, z] = thirds(position);
        s.means.push([span(0, x), span(1, y), span(2, z)]);
        let [x, y, z] = thirds(scale);
        s.log_scales.push([span(6, x), span(7, y), span(8, z)]);
        s.quats.push(unpack_rotation(rotation));
        let [r, g, b, a] = colour.to_be_bytes().map(|v| f32::from(v) / 255.0);
        let base = [span(12, r), span(13, g), span(14, b)];
        s.sh.extend(base.map(|v| (v - 0.5) / crate::scene::SH_C0));
        s.opacity_logits.push(crate::format::logit(a).clamp(-LOGIT_MAX, LOGIT_MAX));
        if let Some(rows) = &sh {
            for k in 0..s.sh_len() - 1 {
                s.sh.extend([0, 1, 2].map(|channel| {
                    // Middle of the byte's interval; 0 and 255 are the ends themselves.
                    let v = rows.value(i, columns[channel * rest + k]);
                    let at = if v <= 0.0 {
                        0.0
                    } else if v >= 255.0 {
                        1.0
                    } else {
                        (v + 0.5) / 256.0
                    };
                    (at as f32 - 0.5) * SH_RANGE
                }));
            }
        }
    }
    notes.extend(ply_comments::places(&vertices.comments));
    s.antialiased = ply_comments::antialiased(&vertices.comments, notes)?;
    notes.extend(vertices.unread(&WORDS, &["chunk", "vertex", "sh"]));
    Ok(s)
}

/// 11, 10 and 11 bits from the top, each divided by its maximum.
fn thirds(word: u32) -> [f32; 3] {
    [(word >> 21) as f32 / 2047.0, (word >> 11 & 1023) as f32 / 1023.0, (word & 2047) as f32 / 2047.0]
}

fn pack_thirds(v: [f32; 3]) -> u32 {
    let quantised = |v: f32, most: f32| (v * most).round().clamp(0.0, most) as u32;
    quantised(v[0], 2047.0) << 21 | quantised(v[1], 1023.0) << 11 | quantised(v[2], 2047.0)
}

/// Index of the largest of (w, x, y, z), then the others in order, ten bits each over ±1/√2.
fn unpack_rotation(word: u32) -> [f32; 4] {
    let largest = (word >> 30) as usize;
    let mut q = [0.0f32; 4];
    let mut squares = 0.0;
    for (slot, k) in (0..4).filter(|k| *k != largest).enumerate() {
        let bits = word >> (20 - 10 * slot) & 1023;
        q[k] = (bits as f32 / 1023.0 - 0.5) * std::f32::consts::SQRT_2;
        squares += q[k] * q[k];
    }
    q[largest] = (1.0 - squares).max(0.0).sqrt();
    q
}

fn pack_rotation(q: [f32; 4]) -> u32 {
    let norm = quaternion_norm(&q);
    let largest = (0..4).max_by(|a, b| q[*a].abs().total_cmp(&q[*b].abs())).unwrap_or(0);
    let sign = q[largest].signum() / norm;
    (0..4).filter(|k| *k != largest).fold(largest as u32, |word, k| {
        let at = q[k] * sign / std::f32::consts::SQRT_2 + 0.5;
        word << 10 | (at * 1023.0).round().clamp(0.0, 1023.0) as u32
    })
}

/// Writes a file. Neighbours share a chunk, so the order of the Gaussians changes: row r of the
/// file is Gaussian `order[r]` of the scene.
pub fn write_splats(path: &Path, s: &Splats) -> Result<Vec<u32>> {
    usable::check_written(s)?;
    let order = morton_order(&s.means);
    let rest = s.sh_len() - 1;
    let mut header = String::from("ply\nformat binary_little_endian 1.0\ncomment Generated by splatvk\n");
    if s.antialiased {
        header += ply_comments::MIP;
    }
    header += &format!("element chunk {}\n", s.len().div_ceil(CHUNK));
    BOUNDS.iter().for_each(|n| header += &format!("property float {n}\n"));
    header += &format!("element vertex {}\n", s.len());
    WORDS.iter().for_each(|n| header += &format!("property uint {n}\n"));
    if rest > 0 {
        header += &format!("element sh {}\n", s.len());
        (0..3 * rest).for_each(|k| header += &format!("property uchar f_rest_{k}\n"));
    }
    let mut out = (header + "end_header\n").into_bytes();
    let mut vertices = Vec::with_capacity(16 * s.len());
    for chunk in order.chunks(CHUNK) {
        let values: Vec<[f32; 9]> = chunk.iter().map(|i| bounded_values(s, *i as usize)).collect();
        let least: [f32; 9] = std::array::from_fn(|k| values.iter().fold(f32::INFINITY, |m, v| m.min(v[k])));
        let most: [f32; 9] =
            std::array::from_fn(|k| values.iter().fold(f32::NEG_INFINITY, |m, v| m.max(v[k])));
        for first in [0, 3, 6] {
            for v in least[first..first + 3].iter().chain(&most[first..first + 3]) {
                out.extend(v.to_le_bytes());
            }
        }
        for (i, v) in chunk.iter().zip(&values) {
            let share = |k: usize| {
                let span = most[k] - least[k];
                if span > 0.0 { (v[k] - least[k]) / span } else { 0.0 }
            };
            let opacity = crate::format::to_byte(crate::math::sigmoid(s.opacity_logits[*i as usize]));
            let [r, g, b] = [6, 7, 8].map(|k| crate::format::to_byte(share(k)));
            for word in [
                pack_thirds([share(0), share(1), share(2)]),
                pack_rotation(s.quats[*i as usize]),
                pack_thirds([share(3), share(4), share(5)]),
                u32::from_be_bytes([r, g, b, opacity]),
            ] {
                vertices.extend(word.to_le_bytes());
            }
        }
    }
    out.append(&mut vertices);
    for &i in &order {
        let own = &s.sh[i as usize * 3 * (rest + 1)..][3..3 * (rest + 1)];
        for channel in 0..3 {
            out.extend(
                (0..rest).map(|k| {
                    ((own[3 * k + channel] / SH_RANGE + 0.5) * 256.0).floor().clamp(0.0, 255.0) as u8
                }),
            );
        }
    }
    std::fs::write(path, out).map_err(Error::unwritable(path))?;
    Ok(order)
}

/// Bounded values of a chunk: position, log scale, colour.
fn bounded_values(s: &Splats, i: usize) -> [f32; 9] {
    let ([x, y, z], [a, b, c]) =
        (s.means[i], s.log_scales[i].map(|v| v.clamp(-LOG_SCALE_MAX, LOG_SCALE_MAX)));
    let base = &s.sh[i * 3 * s.sh_len()..];
    let [r, g, blue] = [0, 1, 2].map(|k| 0.5 + crate::scene::SH_C0 * base[k]);
    [x, y, z, a, b, c, r, g, blue]
}

/// Indices in Morton order, ten bits per axis.
pub(super) fn morton_order(means: &[[f32; 3]]) -> Vec<u32> {
    let mut low = [f32::INFINITY; 3];
    let mut high = [f32::NEG_INFINITY; 3];
    for m in means {
        for k in 0..3 {
            (low[k], high[k]) = (low[k].min(m[k]), high[k].max(m[k]));
        }
    }
    let mut keyed: Vec<(u32, u32)> =
        means.iter().enumerate().map(|(i, m)| (morton_key(m, &low, &high), i as u32)).collect();
    keyed.sort_unstable();
    keyed.into_iter().map(|(_, i)| i).collect()
}

/// Morton code of a position between two bounds.
fn morton_key(mean: &[f32; 3], low: &[f32; 3], high: &[f32; 3]) -> u32 {
    let spread = |v: u32| (0..10).fold(0u32, |out, bit| out | (v >> bit & 1) << (3 * bit));
    (0..3).fold(0u32, |key, k| {
        let span = high[k] - low[k];
        let at = if span > 0.0 { ((mean[k] - low[k]) / span * 1023.0) as u32 } else { 0 };
        key | spread(at.min(1023)) << k
    })
}
