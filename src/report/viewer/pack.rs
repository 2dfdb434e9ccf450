//! Compact splats for the page: quantised, in spatial order, deflated.
//!
//! Little endian, after gzip; N splats, B = ⌈N / 256⌉ blocks, L levels of things, none without
//! language, R = (degree + 1)² − 1:
//!
//! | field | type | meaning |
//! |---|---|---|
//! | head | `SVKVIEW1`, u32 × 4 | N, SH degree, L, flags (1: kinds present, 2: antialiased) |
//! | SH scale | f32 × 3 | largest absolute coefficient of degrees 1, 2, 3 |
//! | ranges | f32 × 10 per block | lowest and highest x, y, z; log scale; colour |
//! | x, y, z | u16 × N each | position in the block's range |
//! | log scales | u8 × N, three times | in the block's range |
//! | rotation | u32 × N | smallest three of the unit quaternion, 10 bits each; index of largest |
//! | opacity | u8 × N | 0 to 1 |
//! | red, green, blue | u8 × N each | 0.5 + SH₀ · DC in the block's range |
//! | SH rest | i8 × N, 3 R times | coefficient by coefficient, RGB; 127 = the scale of its degree |
//! | codes | u16 × N, L times | code + 1 per level, in the order of [`LEVELS`]; 0 = none |
//! | kinds | u8 × N | sum of 1: no photo shows it, 2: of a [hole](Layers::holes), 4: of the
//! backdrop, 8: of a surface |
//!
//! Planes of one quantity deflate better than records. A position is exact to 1/65535 of a block,
//! which is a few neighbouring splats wide.
use crate::format::scene_dir::Scene;
use crate::math::{quaternion_norm, sigmoid};
use crate::query::instances::Places;
use crate::query::things::{LEVELS, OBJECTS};
use crate::scene::{LanguageField, SH_C0, Seen, Splats};
use crate::{Error, Result};
use rayon::prelude::*;

/// First bytes of the file.
const MAGIC: &[u8; 8] = b"SVKVIEW1";
/// Number of splats that share a range.
const BLOCK: usize = 256;
/// Least opacity of a drawn splat (docs/internals/method.md#forward-rasterisation).
const MIN_ALPHA: f32 = 1.0 / 255.0;

/// Bits of the plane of kinds.
const UNSEEN: u8 = 1;
const HOLE: u8 = 2;
const BACKDROP: u8 = 4;
const SURFACE: u8 = 8;

/// Splats of a page, each layer in front of the next.
#[derive(Clone, Copy, Debug)]
pub struct Layers<'a> {
    /// The scene.
    pub splats: &'a Splats,
    /// Visibility of its splats in the photos; unknown ones count as seen.
    pub seen: &'a Seen,
    /// Splats that edits took away: a page hatches them behind the scene.
    pub holes: &'a Splats,
    /// Splats behind all others.
    pub backdrop: &'a Splats,
}

impl<'a> From<&'a Scene> for Layers<'a> {
    fn from(scene: &'a Scene) -> Layers<'a> {
        let Scene { splats, seen, holes, backdrop, .. } = scene;
        Layers { splats, seen, holes, backdrop }
    }
}

/// A packed scene.
pub struct Packed {
    /// Gzip stream.
    pub bytes: Vec<u8>,
    /// Index of every packed splat in the scene, its holes and its backdrop, one after the other.
    pub order: Vec<usize>,
    /// Number of splats of the scene, those of holes and backdrop included.
    pub total: usize,
}

/// Packs at most `most` splats, those of the largest opacity times area.
pub fn pack(layers: Layers, language: Option<&LanguageField>, most: usize) -> Result<Packed> {
    let Layers { splats, seen, holes, backdrop } = layers;
    let mut all = splats.clone();
    for more in [holes, backdrop].into_iter().filter(|more| !more.is_empty()) {
        all.append_raised(more.clone());
    }
    let own = splats.len();
    let kind = |i: usize| match i {
        _ if i < own => u8::from(seen.is_unseen(i)) * UNSEEN,
        _ if i < own + holes.len() => HOLE,
        _ => BACKDROP | UNSEEN,
    };
    let order = morton_order(&all, most_visible(&all, most));
    let (codes, is_surface) = language.map(|field| things(splats, field)).unwrap_or_default();
    let surface = |i: usize| u8::from(is_surface.get(i).is_some_and(|own| *own)) * SURFACE;
    let kinds: Vec<u8> = order.iter().map(|i| kind(*i) | surface(*i)).collect();
    let raw = write(&all, &kinds, &codes, &order);
    Ok(Packed { bytes: gzip(&raw)?, order, total: all.len() })
}

/// Bytes that are deflated as one part: parts cannot refer to each other, which costs a window of
/// 32 KiB each.
const PART: usize = 1 << 19;

/// Gzip stream of one member, its parts deflated in parallel and joined at byte boundaries. The
/// parts do not depend on the number of threads.
fn gzip(raw: &[u8]) -> Result<Vec<u8>> {
    let last = raw.len().div_ceil(PART).saturating_sub(1);
    let parts: Vec<Result<Vec<u8>>> =
        raw.par_chunks(PART).enumerate().map(|(k, part)| deflate(part, k == last)).collect();
    // Signature, deflate, no flags, no time, no hint on the level, no operating system.
    let mut out = vec![0x1f, 0x8b, 8, 0, 0, 0, 0, 0, 0, 0xff];
    if parts.is_empty() {
        out.extend(deflate(&[], true)?);
    }
    for part in parts {
        out.extend(part?);
    }
    let mut checksum = flate2::Crc::new();
    checksum.update(raw);
    out.extend(checksum.sum().to_le_bytes());
    out.extend((raw.len() as u32).to_le_bytes());
    Ok(out)
}

/// Deflates a part of a stream; all but the `last` end at a byte boundary.
fn deflate(part: &[u8], last: bool) -> Result<Vec<u8>> {
    // Level 6 is a tenth larger than 9 and four times as fast.
    let mut compress = flate2::Compress::new(flate2::Compression::new(6), false);
    let flush = if last { flate2::FlushCompress::Finish } else { flate2::FlushCompress::Sync };
    // Room for the worst case, so that one call suffices: stored blocks and the flush.
    let mut out = Vec::with_capacity(part.len() + part.len() / 1000 + 1024);
    let status = compress.compress_vec(part, &mut out, flush);
    let status = status.map_err(|e| Error::work(format!("viewer scene: {e}")))?;
    let whole = match last {
        true => status == flate2::Status::StreamEnd,
        false => compress.total_in() == part.len() as u64 && out.len() < out.capacity(),
    };
    if whole { Ok(out) } else { Err(Error::work("viewer scene: deflate stopped early")) }
}

fn alpha(splats: &Splats, i: usize) -> f32 {
    sigmoid(splats.opacity_logits[i])
}

/// Indices of visible splats; of more than `most`, those with the largest opacity times area.
fn most_visible(splats: &Splats, most: usize) -> Vec<usize> {
    let finite = |i: &usize| splats.means[*i].iter().chain(&splats.log_scales[*i]).all(|v| v.is_finite());
    let visible = |i: &usize| alpha(splats, *i) >= MIN_ALPHA && finite(i);
    let mut list: Vec<usize> = (0..splats.len()).filter(visible).collect();
    if list.len() > most {
        let log_coverage = |i: usize| {
            let mut s = splats.log_scales[i];
            s.sort_by(f32::total_cmp);
            alpha(splats, i).ln() + s[1] + s[2]
        };
        list.sort_by(|&a, &b| log_coverage(b).total_cmp(&log_coverage(a)));
        list.truncate(most);
    }
    list
}

/// Sorts indices by Morton order, so that blocks are small.
fn morton_order(splats: &Splats, mut list: Vec<usize>) -> Vec<usize> {
    let (low, high) = bounds(list.iter().map(|&i| splats.means[i]));
    let key = |i: usize| {
        (0..3).fold(0u64, |key, a| {
            let cell = (splats.means[i][a] - low[a]) / (high[a] - low[a]).max(f32::MIN_POSITIVE);
            // 21 bits per axis fill 63.
            key | spread((cell.clamp(0.0, 1.0) * 2_097_151.0) as u64) << a
        })
    };
    list.par_sort_by_cached_key(|&i| key(i));
    list
}

/// Inserts two zero bits before each of 21 bits.
fn spread(v: u64) -> u64 {
    (0..21).fold(0, |out, bit| out | (v >> bit & 1) << (3 * bit))
}

/// Component-wise minimum and maximum.
fn bounds<const K: usize>(rows: impl Iterator<Item = [f32; K]>) -> ([f32; K], [f32; K]) {
    rows.fold(([f32::MAX; K], [f32::MIN; K]), |(low, high), row| {
        (std::array::from_fn(|k| low[k].min(row[k])), std::array::from_fn(|k| high[k].max(row[k])))
    })
}

fn write(splats: &Splats, kinds: &[u8], codes: &[Vec<u16>], order: &[usize]) -> Vec<u8> {
    let rest = splats.sh_len() - 1;
    let colour = |i: usize| [0, 1, 2].map(|c| 0.5 + SH_C0 * splats.sh[3 * (rest + 1) * i + c]);
    let all = |i: usize| {
        let ([x, y, z], [a, b, c], [r, g, u]) = (splats.means[i], splats.log_scales[i], colour(i));
        [x, y, z, a, b, c, r, g, u]
    };
    let ranges: Vec<[[f32; 2]; 5]> = order
        .par_chunks(BLOCK)
        .map(|block| {
            let (low, high) = bounds(block.iter().map(|&i| all(i)));
            let join = |from: usize| {
                let low = low[from..from + 3].iter().copied().fold(f32::MAX, f32::min);
                [low, high[from..from + 3].iter().copied().fold(f32::MIN, f32::max)]
            };
            [[low[0], high[0]], [low[1], high[1]], [low[2], high[2]], join(3), join(6)]
        })
        .collect();
    let share = |at: usize, k: usize, v: f32| {
        let [low, high] = ranges[at / BLOCK][k];
        ((v - low) / (high - low).max(f32::MIN_POSITIVE)).clamp(0.0, 1.0)
    };
    let scales = sh_scales(splats, order, rest);
    let mut out = MAGIC.to_vec();
    let has_kinds = kinds.iter().any(|kind| *kind != 0);
    let flags = u32::from(has_kinds) | u32::from(splats.antialiased) << 1;
    for v in [order.len() as u32, splats.sh_degree, codes.len() as u32, flags] {
        out.extend(v.to_le_bytes());
    }
    scales.iter().chain(ranges.iter().flatten().flatten()).for_each(|v| out.extend(v.to_le_bytes()));
    let items = || order.iter().copied().enumerate();
    let byte = |v: f32| (v * 255.0).round() as u8;
    let plane = |plane: Plane| -> Vec<u8> {
        match plane {
            Plane::Position(k) => {
                let share = |(at, i): (usize, usize)| (share(at, k, splats.means[i][k]) * 65535.0).round();
                items().flat_map(|item| (share(item) as u16).to_le_bytes()).collect()
            }
            Plane::LogScale(k) => {
                items().map(|(at, i)| byte(share(at, 3, splats.log_scales[i][k]))).collect()
            }
            Plane::Rotation => {
                order.iter().flat_map(|i| packed_rotation(splats.quats[*i]).to_le_bytes()).collect()
            }
            Plane::Opacity => order.iter().map(|i| byte(alpha(splats, *i))).collect(),
            Plane::Colour(k) => items().map(|(at, i)| byte(share(at, 4, colour(i)[k]))).collect(),
            Plane::Rest(k, c) => {
                let scale = scales[degree_of(k) - 1].max(f32::MIN_POSITIVE);
                let value = |i: &usize| splats.sh[3 * ((rest + 1) * i + 1 + k) + c];
                order.iter().map(|i| (value(i) / scale * 127.0).round() as i8 as u8).collect()
            }
            Plane::Codes(level) => {
                let code = |i: &usize| codes[level].get(*i).copied().unwrap_or(0).to_le_bytes();
                order.iter().flat_map(code).collect()
            }
            Plane::Kinds => kinds.to_vec(),
        }
    };
    let mut planes: Vec<Plane> = (0..3).map(Plane::Position).chain((0..3).map(Plane::LogScale)).collect();
    planes.extend([Plane::Rotation, Plane::Opacity]);
    planes.extend((0..3).map(Plane::Colour));
    planes.extend((0..rest).flat_map(|k| (0..3).map(move |c| Plane::Rest(k, c))));
    planes.extend((0..codes.len()).map(Plane::Codes));
    planes.extend(has_kinds.then_some(Plane::Kinds));
    planes.into_par_iter().map(plane).collect::<Vec<_>>().iter().for_each(|plane| out.extend(plane));
    out
}

/// One quantity of all splats, with its axis, coefficient or level.
#[derive(Clone, Copy)]
enum Plane {
    Position(usize),
    LogScale(usize),
    Rotation,
    Opacity,
    Colour(usize),
    /// Coefficient after the lowest, and channel.
    Rest(usize, usize),
    Codes(usize),
    Kinds,
}

/// Degree of the k-th coefficient after the lowest.
fn degree_of(k: usize) -> usize {
    match k {
        0..3 => 1,
        3..8 => 2,
        _ => 3,
    }
}

fn sh_scales(splats: &Splats, order: &[usize], rest: usize) -> [f32; 3] {
    let mut scales = [0f32; 3];
    for &i in order {
        for k in 0..rest {
            let at = 3 * ((rest + 1) * i + 1 + k);
            let scale = &mut scales[degree_of(k) - 1];
            *scale = splats.sh[at..at + 3].iter().fold(*scale, |m, v| m.max(v.abs()));
        }
    }
    scales
}

/// Packs a quaternion by its smallest three components. The largest follows from the unit length,
/// with a positive sign (q and −q are one rotation); the others are within ±√½.
fn packed_rotation(q: [f32; 4]) -> u32 {
    let norm = quaternion_norm(&q);
    let largest = (0..4).max_by(|&a, &b| q[a].abs().total_cmp(&q[b].abs())).unwrap_or(0);
    let sign = if q[largest] < 0.0 { -1.0 } else { 1.0 };
    let mut packed = (largest as u32) << 30;
    for (slot, k) in (0..4).filter(|&k| k != largest).enumerate() {
        let v = (sign * q[k] / norm * std::f32::consts::SQRT_2).clamp(-1.0, 1.0);
        packed |= (((v + 1.0) * 511.5).round() as u32) << (10 * slot);
    }
    packed
}

/// Per level of things code + 1 of every splat of the scene, 0 without a code, and whether it is on
/// a surface that carries things.
fn things(splats: &Splats, field: &LanguageField) -> (Vec<Vec<u16>>, Vec<bool>) {
    let places = Places::of(splats, field);
    let (mut codes, mut is_surface) = (vec![vec![0; splats.len()]; LEVELS.len()], vec![false; splats.len()]);
    let number = |code: usize| u16::try_from(code + 1).unwrap_or(0);
    for (level, lists) in places.lists().iter().enumerate().take(OBJECTS) {
        for code in 0..lists.counts().count() {
            lists.splats_of(std::iter::once(code)).iter().for_each(|i| codes[level][*i] = number(code));
        }
    }
    for object in places.objects() {
        for i in object.instance.splats {
            (codes[OBJECTS][i], is_surface[i]) = (number(object.code), object.is_surface);
        }
    }
    (codes, is_surface)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::seeded;
    use crate::scene::{Codebook, LevelField};
    use std::io::Read;

    fn unpacked(packed: &Packed) -> Vec<u8> {
        let mut raw = Vec::new();
        flate2::read::GzDecoder::new(&packed.bytes[..]).read_to_end(&mut raw).unwrap();
        raw
    }

    /// Decoder of the page, value by value.
    struct Reader<'a>(&'a [u8]);

    impl Reader<'_> {
        fn take<const K: usize>(&mut self) -> [u8; K] {
            let (head, tail) = self.0.split_at(K);
            self.0 = tail;
            head.try_into().unwrap()
        }
        fn f32(&mut self) -> f32 {
            f32::from_le_bytes(self.take())
        }
        fn u16(&mut self) -> u16 {
            u16::from_le_bytes(self.take())
        }
        fn u8(&mut self) -> u8 {
            self.take::<1>()[0]
        }
    }

    #[test]
    fn packed_values_are_quantised_correctly() {
        let (splats, _) = seeded::small(700, 40, 30, 2, 5);
        let features: Vec<f32> =
            (0..700).flat_map(|i| [[1.0, 0.0], [0.0, 1.0], [0.0, 0.05]][i % 3]).collect();
        let codebook = Codebook {
            embedding_dim: 1,
            code_dim: 2,
            embeddings: vec![1.0; 2],
            codes: vec![1.0, 0.0, 0.0, 1.0],
            ..Codebook::default()
        };
        let level = LevelField { codebook, features, ..LevelField::default() };
        let field = LanguageField { levels: vec![level, LevelField::default()], space: String::new() };
        let order = morton_order(&splats, most_visible(&splats, usize::MAX));
        let seen = Seen { pixels: (0..700).map(|i| (i % 2) as f32).collect() };
        let none = Splats::default();
        let layers = Layers { splats: &splats, seen: &seen, holes: &none, backdrop: &none };
        let packed = pack(layers, Some(&field), usize::MAX).unwrap();
        let n = order.len();
        assert_eq!((&packed.order, packed.total), (&order, 700));
        let raw = unpacked(&packed);
        let mut r = Reader(&raw);
        assert_eq!(&r.take::<8>(), MAGIC);
        let head: [u32; 4] = std::array::from_fn(|_| u32::from_le_bytes(r.take()));
        assert_eq!(head, [n as u32, 2, 4, 1]);
        let sh_scales: [f32; 3] = std::array::from_fn(|_| r.f32());
        let ranges: Vec<[f32; 10]> =
            (0..n.div_ceil(BLOCK)).map(|_| std::array::from_fn(|_| r.f32())).collect();
        let near = |got: f32, want: f32, step: f32| {
            // Half a step, and the rounding of f32.
            assert!((got - want).abs() <= 0.501 * step + 1e-6 * want.abs(), "{got} {want} {step}");
        };
        let value = |i: usize, k: usize, share: f32| {
            let range = &ranges[i / BLOCK][2 * k..];
            range[0] + share * (range[1] - range[0])
        };
        let step = |i: usize, k: usize, levels: f32| {
            (ranges[i / BLOCK][2 * k + 1] - ranges[i / BLOCK][2 * k]) / levels
        };
        for k in 0..3 {
            for (i, &s) in order.iter().enumerate() {
                near(value(i, k, r.u16() as f32 / 65535.0), splats.means[s][k], step(i, k, 65535.0));
            }
        }
        for k in 0..3 {
            for (i, &s) in order.iter().enumerate() {
                near(value(i, 3, r.u8() as f32 / 255.0), splats.log_scales[s][k], step(i, 3, 255.0));
            }
        }
        for &s in &order {
            let bits = u32::from_le_bytes(r.take());
            let largest = (bits >> 30) as usize;
            let mut q = [0f32; 4];
            for (slot, k) in (0..4).filter(|&k| k != largest).enumerate() {
                q[k] = ((bits >> (10 * slot) & 1023) as f32 / 511.5 - 1.0) * std::f32::consts::FRAC_1_SQRT_2;
            }
            q[largest] = (1.0 - q.iter().map(|v| v * v).sum::<f32>()).max(0.0).sqrt();
            let want = splats.quats[s];
            let norm = want.iter().map(|v| v * v).sum::<f32>().sqrt();
            let cosine = q.iter().zip(want).map(|(a, b)| a * b).sum::<f32>().abs() / norm;
            // Three errors of half a step of √2/1023, and the resulting error of the largest.
            assert!(cosine > 1.0 - 3e-6, "{q:?} {want:?}");
        }
        for &s in &order {
            near(r.u8() as f32 / 255.0, alpha(&splats, s), 1.0 / 255.0);
        }
        for k in 0..3 {
            for (i, &s) in order.iter().enumerate() {
                near(
                    value(i, 4, r.u8() as f32 / 255.0),
                    0.5 + SH_C0 * splats.sh[27 * s + k],
                    step(i, 4, 255.0),
                );
            }
        }
        for k in 0..8 {
            let scale = sh_scales[degree_of(k) - 1];
            for c in 0..3 {
                for &s in &order {
                    near(
                        r.u8() as i8 as f32 / 127.0 * scale,
                        splats.sh[27 * s + 3 * (k + 1) + c],
                        scale / 127.0,
                    );
                }
            }
        }
        for &s in &order {
            assert_eq!(r.u16(), [1, 2, 0][s % 3], "code + 1, or none for a feature of length 0.05");
        }
        assert!((0..2 * n).all(|_| r.u16() == 0), "levels without codes");
        let things = order.iter().filter(|s| match r.u16() {
            0 => false,
            code => code == [1, 2, 0][*s % 3],
        });
        assert!(2 * things.count() > n, "most splats belong to a thing of their code");
        for &s in &order {
            assert_eq!(r.u8(), u8::from(s % 2 == 0), "even ones are in no photo");
        }
        assert!(r.0.is_empty());
        let unknown =
            unpacked(&pack(Layers { seen: &Seen::default(), ..layers }, Some(&field), usize::MAX).unwrap());
        assert_eq!((unknown[20], unknown.len()), (0, raw.len() - n), "no row where nothing is known");
    }

    #[test]
    fn layers_are_kinds() {
        let (splats, _) = seeded::small(60, 40, 30, 1, 5);
        let (holes, backdrop) = (splats.picked(&[0, 1, 2]).bare(), splats.picked(&[3, 4]).bare());
        let seen = Seen { pixels: vec![0.0; 30] };
        let layers = Layers { splats: &splats, seen: &seen, holes: &holes, backdrop: &backdrop };
        let packed = pack(layers, None, usize::MAX).unwrap();
        let raw = unpacked(&packed);
        let kinds = &raw[raw.len() - packed.order.len()..];
        for (kind, i) in kinds.iter().zip(&packed.order) {
            let expected = match i {
                0..30 => UNSEEN,
                30..60 => 0,
                60..63 => HOLE,
                _ => BACKDROP | UNSEEN,
            };
            assert_eq!(*kind, expected, "{i}");
        }
        assert_eq!((packed.total, kinds.iter().filter(|kind| **kind == HOLE).count()), (65, 3));
    }

    #[test]
    fn gzip_of_several_parts_is_one_member() {
        for length in [0, 1, PART - 1, PART, PART + 1, 3 * PART + 77] {
            let raw: Vec<u8> = (0..length).map(|i| (i * i / 7919 % 251) as u8).collect();
            let packed = gzip(&raw).unwrap();
            // A browser reads one member and refuses anything after it.
            let mut reader = flate2::bufread::GzDecoder::new(&packed[..]);
            let mut read = Vec::new();
            reader.read_to_end(&mut read).unwrap();
            assert!(read == raw && reader.into_inner().is_empty(), "{length} bytes");
        }
        // Noise does not deflate.
        let mut random = crate::math::Random::new(1017);
        let noise: Vec<u8> = (0..PART + PART / 2).map(|_| (random.uniform() * 256.0) as u8).collect();
        let mut read = Vec::new();
        flate2::read::GzDecoder::new(&gzip(&noise).unwrap()[..]).read_to_end(&mut read).unwrap();
        assert!(read == noise);
    }

    #[test]
    fn most_visible_keeps_the_largest_coverage() {
        let (mut splats, _) = seeded::small(50, 40, 30, 0, 1);
        splats.opacity_logits.fill(2.0);
        splats.opacity_logits[7] = -9.0;
        for (i, s) in splats.log_scales.iter_mut().enumerate() {
            *s = [-9.0, i as f32 * 0.1, i as f32 * 0.1];
        }
        assert_eq!(most_visible(&splats, 100).len(), 49, "one is too faint to be drawn");
        let mut most = most_visible(&splats, 3);
        most.sort_unstable();
        assert_eq!(most, [47, 48, 49]);
    }
}
