//! `.spz`, Niantic's compressed splats: versions 2 and 3 (one gzip stream, or bare) and 4 (one
//! Zstandard stream per attribute) are read and written. About a tenth of the size of a PLY.
//!
//! The format's axes are right, up, back unless a file states others; files are turned by 180°
//! about x on the way in and out. Positions are 24-bit fixed point with as many fractional bits as
//! their extent permits (the format's own tools take 12).
use super::{degree, spz_extensions, usable};
use crate::math::quaternion_norm;
use crate::scene::{Splats, sh_coefficients};
use crate::{Error, Result, files};
use std::io::{Read, Write as _};
use std::path::Path;

const MAGIC: u32 = 0x5053_474e; // "NGSP"
/// Bytes of the header of versions 1 to 3; version 4 begins with it, too.
const HEADER: usize = 16;
/// Bytes of the header of version 4.
const HEADER_4: usize = 32;
/// Largest position in 24 signed bits.
const FIXED_MAX: f32 = 8_388_607.0;
/// Slope of the base colour: byte = (f_dc · 0.15 + 0.5) · 255.
const COLOUR_SCALE: f32 = 0.15;
/// Largest base colour of a byte: f_dc ends at 0.5 / 0.15.
pub const BRIGHTEST: f32 = 0.5 + crate::scene::SH_C0 * 0.5 / COLOUR_SCALE;
/// Largest number of Gaussians that is read, so that a damaged count does not exhaust memory: ten
/// times the largest shared scenes.
const MAX_GAUSSIANS: usize = 100_000_000;

/// Largest size of the extension records: known ones have some dozens of bytes.
const MOST_BEHIND: u64 = 1 << 20;

/// Signs of the SH coefficients when y and z are negated: the parity of each basis function in (y,
/// z) together.
const SH_SIGNS: [f32; 16] =
    [1.0, -1.0, -1.0, 1.0, -1.0, 1.0, 1.0, -1.0, 1.0, -1.0, 1.0, -1.0, -1.0, 1.0, -1.0, 1.0];

/// Supported versions for writing.
pub const VERSIONS: std::ops::RangeInclusive<u32> = 2..=4;
/// The newest version that most programs read: the loaders of Niantic, SuperSplat and Spark (2.2)
/// all read 3; Spark's does not read 4.
pub const DEFAULT_VERSION: u32 = 3;

/// Bits of the header's flags.
const ANTIALIASED: u8 = 0x01;
const EXTENSIONS: u8 = 0x02;
/// Flag of Spark: a tree of levels of detail, with halved opacities.
const LEVELS_OF_DETAIL: u8 = 0x80;

/// Header of a file.
struct Head {
    version: u32,
    count: usize,
    degree: u32,
    fraction_bits: u32,
    flags: u8,
}

impl Head {
    fn parse(b: &[u8]) -> Result<Head, String> {
        let Some(b) = b.get(..HEADER) else { return Err("the file ends early; copy it again".into()) };
        let word = |at: usize| u32::from_le_bytes([b[at], b[at + 1], b[at + 2], b[at + 3]]);
        if word(0) != MAGIC {
            return Err("not an .spz file (wrong magic bytes)".into());
        }
        let head = Head {
            version: word(4),
            count: word(8) as usize,
            degree: u32::from(b[12]),
            fraction_bits: u32::from(b[13]),
            flags: b[14],
        };
        if !VERSIONS.contains(&head.version) {
            return Err(format!(
                "spz version {} is not known (2 to 4 are); write it as one of these",
                head.version
            ));
        }
        if head.degree > 4 {
            return Err(format!(
                "SH degree {} is not known (0 to 4 are); export it with a lower one",
                head.degree
            ));
        }
        if head.fraction_bits > 24 {
            return Err(format!(
                "{} fractional bits of 24; the file is damaged, copy it again",
                head.fraction_bits
            ));
        }
        if head.count > MAX_GAUSSIANS {
            return Err(format!("{} Gaussians, more than the {MAX_GAUSSIANS} that are read", head.count));
        }
        if head.flags & LEVELS_OF_DETAIL != 0 {
            return Err(
                "all levels of detail of Spark at once (header flag 0x80); export it without LoD".into()
            );
        }
        let unknown = head.flags & !(ANTIALIASED | EXTENSIONS);
        if unknown != 0 {
            return Err(format!("header flags {unknown:#04x} of unknown meaning; write it again as .ply"));
        }
        Ok(head)
    }

    /// Bytes of positions, alphas, colours, scales, rotations, SH.
    fn sections(&self) -> [usize; 6] {
        let rotation = if self.version >= 3 { 4 } else { 3 };
        let rest = 3 * (sh_coefficients(self.degree) - 1);
        [9, 1, 3, 3, rotation, rest].map(|n| n * self.count)
    }
}

impl Head {
    /// Like [`Head::sections`], bounded by the size of the file in bytes: the count comes from the
    /// file.
    fn checked_sections(&self, size: usize) -> Result<[usize; 6], String> {
        let sections = self.sections();
        match sections.iter().sum::<usize>() as u64 <= files::most_content(size) {
            true => Ok(sections),
            false => Err(format!("{} Gaussians are far more than its {size} bytes can hold", self.count)),
        }
    }
}

/// Reads a file; notes name parts that are not read, a line each.
pub fn read_noted(path: &Path, notes: &mut Vec<String>) -> Result<Splats> {
    let bytes = files::read(path)?;
    let parsed = files::guarded(|| parse(&bytes, notes)).unwrap_or_else(|panic| Err(broken(panic)));
    parsed.map_err(|e| Error::input(format!("{}: {e}", path.display())))
}

fn parse(bytes: &[u8], notes: &mut Vec<String>) -> Result<Splats, String> {
    if bytes.starts_with(&[0x1f, 0x8b]) {
        return unpack(&inflated(bytes)?, notes);
    }
    if Head::parse(bytes)?.version >= 4 { unpack_4(bytes, notes) } else { unpack(bytes, notes) }
}

/// Content of a gzip stream: the Gaussians, and a bounded number of bytes after them.
fn inflated(bytes: &[u8]) -> Result<Vec<u8>, String> {
    let mut plain = Vec::new();
    let mut gzip = flate2::read::GzDecoder::new(bytes);
    // The header first: it states how much may follow.
    gzip.by_ref().take(HEADER as u64).read_to_end(&mut plain).map_err(broken)?;
    let size = Head::parse(&plain)?.checked_sections(bytes.len())?.iter().sum::<usize>();
    gzip.by_ref().take(size as u64).read_to_end(&mut plain).map_err(broken)?;
    // The decoder verifies the checksum at the end of the stream.
    gzip.by_ref().take(MOST_BEHIND).read_to_end(&mut plain).map_err(broken)?;
    match gzip.read(&mut [0]).map_err(broken)? {
        0 => Ok(plain),
        _ => Err(format!("holds more than {MOST_BEHIND} bytes behind its Gaussians; write it again")),
    }
}

fn broken(e: impl std::fmt::Display) -> String {
    format!("damaged compression ({e}); copy the file again")
}

/// Versions 2 and 3 after decompression.
fn unpack(bytes: &[u8], notes: &mut Vec<String>) -> Result<Splats, String> {
    let head = Head::parse(bytes)?;
    if head.version >= 4 {
        return Err("version 4 inside of gzip is not valid".into());
    }
    let mut rest = &bytes[HEADER..];
    let mut parts = [&[][..]; 6];
    for (part, size) in parts.iter_mut().zip(head.sections()) {
        *part = rest.get(..size).ok_or("the file ends early; copy it again")?;
        rest = &rest[size..];
    }
    in_scene_axes(&head, splats(&head, parts, notes), rest, notes)
}

/// Gaussians in the axes of the scene, by the extension records of their file.
fn in_scene_axes(
    head: &Head,
    mut s: Splats,
    extensions: &[u8],
    notes: &mut Vec<String>,
) -> Result<Splats, String> {
    match (head.flags & EXTENSIONS != 0, extensions.len()) {
        (true, _) => spz_extensions::apply(&mut s, extensions, notes)?,
        (false, 0) => {}
        (false, more) => notes.push(format!("{more} bytes beside its Gaussians are not read")),
    }
    Ok(s)
}

fn unpack_4(bytes: &[u8], notes: &mut Vec<String>) -> Result<Splats, String> {
    let head = Head::parse(bytes)?;
    let streams = usize::from(*bytes.get(15).ok_or_else(truncated)?);
    let table = (long_word(bytes, 16)? & 0xffff_ffff) as usize;
    let extensions =
        bytes.get(HEADER_4..table).ok_or("its table begins inside of its header; copy it again")?;
    // Empty attributes have no stream.
    let sizes = head.checked_sections(bytes.len())?;
    let wanted = sizes.iter().filter(|s| **s > 0).count();
    if streams != wanted {
        return Err(format!("{streams} streams where {wanted} are needed; copy the file again"));
    }
    let mut parts: [Vec<u8>; 6] = Default::default();
    let mut at = table + 16 * streams;
    let mut stream = 0;
    for (part, size) in parts.iter_mut().zip(sizes).filter(|(_, size)| *size > 0) {
        let length = usize::try_from(long_word(bytes, table + 16 * stream)?).map_err(|_| truncated())?;
        let end = at.checked_add(length).ok_or_else(truncated)?;
        let packed = bytes.get(at..end).ok_or_else(truncated)?;
        part.reserve_exact(size);
        let mut decoder = ruzstd::decoding::StreamingDecoder::new(packed).map_err(broken)?;
        decoder.by_ref().take(size as u64).read_to_end(part).map_err(broken)?;
        if part.len() != size {
            return Err(truncated());
        }
        if decoder.read(&mut [0]).map_err(broken)? != 0 {
            return Err("a stream holds more than its Gaussians; copy the file again".into());
        }
        (at, stream) = (end, stream + 1);
    }
    let s = splats(&head, [0, 1, 2, 3, 4, 5].map(|k| parts[k].as_slice()), notes);
    in_scene_axes(&head, s, extensions, notes)
}

fn truncated() -> String {
    "the file ends early; copy it again".to_string()
}

/// The little-endian 64-bit word at an offset.
fn long_word(bytes: &[u8], at: usize) -> Result<u64, String> {
    let b = bytes.get(at..at + 8).ok_or_else(truncated)?;
    Ok(u64::from_le_bytes([b[0], b[1], b[2], b[3], b[4], b[5], b[6], b[7]]))
}

fn splats(head: &Head, parts: [&[u8]; 6], notes: &mut Vec<String>) -> Splats {
    let [positions, alphas, colours, scales, rotations, sh] = parts;
    let unit = 1.0 / (1u32 << head.fraction_bits) as f32;
    // The upper bytes of an i32, shifted down with the sign.
    let fixed = |b: &[u8]| (i32::from_le_bytes([0, b[0], b[1], b[2]]) >> 8) as f32 * unit;
    let mean = |b: &[u8]| [fixed(&b[..3]), -fixed(&b[3..6]), -fixed(&b[6..9])];
    let degree = head.degree.min(degree::MOST_DEGREE);
    notes.extend((degree < head.degree).then(|| degree::beyond_degree(head.degree)));
    // Bands follow each other, so the first coefficients are those of the lower degree.
    let (stored, rest) = (sh_coefficients(head.degree) - 1, sh_coefficients(degree) - 1);
    let mut all = Vec::with_capacity(head.count * 3 * (rest + 1));
    for (i, c) in colours.chunks_exact(3).enumerate() {
        all.extend(c.iter().map(|v| (f32::from(*v) / 255.0 - 0.5) / COLOUR_SCALE));
        let own = &sh[i * 3 * stored..][..3 * rest];
        all.extend(
            own.iter().enumerate().map(|(k, v)| SH_SIGNS[1 + k / 3] * (f32::from(*v) - 128.0) / 128.0),
        );
    }
    let rotation = if head.version >= 3 { smallest_three } else { first_three };
    let width = if head.version >= 3 { 4 } else { 3 };
    Splats {
        means: positions.chunks_exact(9).map(mean).collect(),
        log_scales: scales
            .chunks_exact(3)
            .map(|b| [0, 1, 2].map(|k| f32::from(b[k]) / 16.0 - 10.0))
            .collect(),
        quats: rotations.chunks_exact(width).map(|b| turned(rotation(b))).collect(),
        opacity_logits: alphas.iter().map(|a| crate::format::logit(f32::from(*a) / 255.0)).collect(),
        sh_degree: degree,
        sh: all,
        antialiased: head.flags & ANTIALIASED != 0,
    }
}

/// Rotation (w, x, y, z) in axes with y and z negated.
fn turned([w, x, y, z]: [f32; 4]) -> [f32; 4] {
    [w, x, -y, -z]
}

/// Version 2: x, y, z in bytes; w follows from unit length, and is positive.
fn first_three(b: &[u8]) -> [f32; 4] {
    let [x, y, z] = [0, 1, 2].map(|k| f32::from(b[k]) / 127.5 - 1.0);
    [(1.0 - x * x - y * y - z * z).max(0.0).sqrt(), x, y, z]
}

fn pack_three(q: [f32; 4]) -> [u8; 3] {
    let norm = quaternion_norm(&q);
    // q and −q are one rotation; w is read as positive.
    let sign = q[0].signum() / norm;
    [1, 2, 3].map(|k| byte((q[k] * sign + 1.0) * 127.5))
}

/// Largest magnitude of any component except the largest.
const SMALLER_MAX: f32 = std::f32::consts::FRAC_1_SQRT_2;
/// Largest value in nine bits.
const MAGNITUDE: u32 = 511;

/// Version 3: index of the largest of (x, y, z, w) in the top two bits, then the other three from
/// the last to the first, each a sign and nine bits of magnitude.
fn smallest_three(b: &[u8]) -> [f32; 4] {
    let mut bits = u32::from_le_bytes([b[0], b[1], b[2], b[3]]);
    let largest = (bits >> 30) as usize;
    let mut q = [0.0f32; 4];
    let mut squares = 0.0;
    for k in (0..4).rev().filter(|k| *k != largest) {
        let value = SMALLER_MAX * (bits & MAGNITUDE) as f32 / MAGNITUDE as f32;
        q[k] = if bits >> 9 & 1 == 1 { -value } else { value };
        squares += value * value;
        bits >>= 10;
    }
    q[largest] = (1.0 - squares).max(0.0).sqrt();
    [q[3], q[0], q[1], q[2]]
}

fn pack_rotation([w, x, y, z]: [f32; 4]) -> [u8; 4] {
    let q = [x, y, z, w];
    let norm = quaternion_norm(&q);
    let largest = (0..4).max_by(|a, b| q[*a].abs().total_cmp(&q[*b].abs())).unwrap_or(3);
    // q and −q are one rotation: with a positive sign the largest component need not be stored.
    let sign = q[largest].signum() / norm;
    let mut bits = largest as u32;
    for k in (0..4).filter(|k| *k != largest) {
        let value = q[k] * sign;
        let magnitude = (value.abs() / SMALLER_MAX * MAGNITUDE as f32).round().min(MAGNITUDE as f32) as u32;
        bits = bits << 10 | u32::from(value < 0.0) << 9 | magnitude;
    }
    bits.to_le_bytes()
}

/// Writes one of [`VERSIONS`], in the order of the scene.
pub fn write_splats(path: &Path, s: &Splats, version: u32) -> Result<()> {
    usable::check_written(s)?;
    if !VERSIONS.contains(&version) {
        return Err(Error::input(format!("spz version {version} is not known; give 2, 3 or 4")));
    }
    let bits = fraction_bits(s).ok_or_else(|| {
        Error::input(format!(
            "the scene reaches {:.1e} units from its origin and .spz ends at {FIXED_MAX:.1e}; write another format \
             (--format ply)",
            widest(s)
        ))
    })?;
    let count = u32::try_from(s.len())
        .map_err(|_| Error::input("too many Gaussians for .spz; write another format (--format ply)"))?;
    let sections: Vec<Vec<u8>> = pack(s, bits, version).into_iter().filter(|p| !p.is_empty()).collect();
    let mut out = Vec::new();
    for word in [MAGIC, version, count] {
        out.extend(word.to_le_bytes());
    }
    let flags = if s.antialiased { ANTIALIASED } else { 0 };
    // Only version 4 has a number of streams.
    let streams = if version >= 4 { sections.len() as u8 } else { 0 };
    out.extend([s.sh_degree as u8, bits as u8, flags, streams]);
    let out = if version >= 4 { streams_of(out, &sections) } else { gzip_of(out, &sections) };
    std::fs::write(path, out.map_err(Error::unwritable(path))?).map_err(Error::unwritable(path))
}

/// Versions 2 and 3: all sections in one gzip stream.
fn gzip_of(mut plain: Vec<u8>, sections: &[Vec<u8>]) -> std::io::Result<Vec<u8>> {
    sections.iter().for_each(|p| plain.extend_from_slice(p));
    let mut gzip = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::default());
    gzip.write_all(&plain)?;
    gzip.finish()
}

/// Version 4: a table of streams, then one stream per attribute.
fn streams_of(mut out: Vec<u8>, sections: &[Vec<u8>]) -> std::io::Result<Vec<u8>> {
    out.extend((HEADER_4 as u32).to_le_bytes());
    out.resize(HEADER_4, 0);
    let level = ruzstd::encoding::CompressionLevel::Fastest;
    let packed: Vec<Vec<u8>> =
        sections.iter().map(|p| ruzstd::encoding::compress_to_vec(p.as_slice(), level)).collect();
    for (packed, plain) in packed.iter().zip(sections) {
        out.extend((packed.len() as u64).to_le_bytes());
        out.extend((plain.len() as u64).to_le_bytes());
    }
    packed.iter().for_each(|p| out.extend_from_slice(p));
    Ok(out)
}

/// Largest absolute coordinate.
fn widest(s: &Splats) -> f32 {
    s.means.as_flattened().iter().fold(0.0f32, |m, v| m.max(v.abs()))
}

/// Largest number of fractional bits, up to 24, with which all positions fit.
fn fraction_bits(s: &Splats) -> Option<u32> {
    let widest = widest(s);
    (0..=24).rev().find(|b| widest * (1u32 << b) as f32 <= FIXED_MAX)
}

fn byte(v: f32) -> u8 {
    v.round().clamp(0.0, 255.0) as u8
}

fn pack(s: &Splats, bits: u32, version: u32) -> [Vec<u8>; 6] {
    let mut parts: [Vec<u8>; 6] = Default::default();
    let scale = (1u32 << bits) as f32;
    let width = 3 * s.sh_len();
    for i in 0..s.len() {
        let [x, y, z] = s.means[i];
        for v in [x, -y, -z] {
            let fixed = (v * scale).round().clamp(-FIXED_MAX, FIXED_MAX) as i32;
            parts[0].extend_from_slice(&fixed.to_le_bytes()[..3]);
        }
        parts[1].push(byte(255.0 * crate::math::sigmoid(s.opacity_logits[i])));
        let sh = &s.sh[i * width..(i + 1) * width];
        parts[2].extend(sh[..3].iter().map(|v| byte((v * COLOUR_SCALE + 0.5) * 255.0)));
        parts[3].extend(s.log_scales[i].map(|v| byte((v + 10.0) * 16.0)));
        let rotation = turned(s.quats[i]);
        match version {
            2 => parts[4].extend(pack_three(rotation)),
            _ => parts[4].extend(pack_rotation(rotation)),
        }
        let rest = sh[3..].iter().enumerate();
        parts[5].extend(rest.map(|(k, v)| byte(SH_SIGNS[1 + k / 3] * v * 128.0 + 128.0)));
    }
    parts
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::seeded;

    /// A bare file of version 3, altered by `change`, with `behind` after its Gaussians.
    fn read(change: impl FnOnce(&mut Vec<u8>), behind: &[u8]) -> Result<(Splats, Vec<String>), String> {
        let s = seeded::small(5, 32, 24, 3, 1002).0;
        let mut bytes = Vec::new();
        for word in [MAGIC, 3, 5] {
            bytes.extend(word.to_le_bytes());
        }
        bytes.extend([3, 12, 0, 0]);
        pack(&s, 12, 3).iter().for_each(|part| bytes.extend(part));
        change(&mut bytes);
        bytes.extend(behind);
        let mut notes = Vec::new();
        parse(&bytes, &mut notes).map(|s| (s, notes))
    }

    #[test]
    fn header_flags_are_used_or_refused() {
        let (plain, notes) = read(|_| {}, &[]).unwrap();
        assert!(!plain.antialiased && notes.is_empty());
        let (s, notes) = read(|b| b[14] = 1, &[]).unwrap();
        assert!(s == Splats { antialiased: true, ..plain } && notes.is_empty());
        for (flags, words) in [(0x80, "LoD"), (0x81, "LoD"), (0x04, "flags 0x04"), (0x43, "flags 0x40")] {
            let e = read(|b| b[14] = flags, &[]).unwrap_err();
            assert!(e.contains(words), "{flags:#x}: {e}");
        }
        assert!(read(|b| b[12] = 5, &[]).unwrap_err().contains("SH degree 5"));
        assert!(read(|b| b[13] = 30, &[]).unwrap_err().contains("30 fractional bits"));
        assert!(read(|b| b[4] = 7, &[]).unwrap_err().contains("version 7"));
    }

    #[test]
    fn fourth_sh_band_is_noted() {
        let (plain, _) = read(|_| {}, &[]).unwrap();
        // Each Gaussian's 15 coefficients, then the nine of band 4.
        let (s, notes) = read(
            |b| {
                let first = b.len() - 5 * 45;
                let sh = b.split_off(first);
                b[12] = 4;
                sh.chunks(45).for_each(|own| b.extend(own.iter().chain(&[200; 27])));
            },
            &[],
        )
        .unwrap();
        assert_eq!(s, plain);
        assert!(notes.len() == 1 && notes[0].contains("band 4"), "{notes:?}");
    }

    #[test]
    fn bytes_behind_gaussians_are_bounded() {
        let (_, notes) = read(|_| {}, &[7; 9]).unwrap();
        assert!(notes[0].contains("9 bytes"), "{notes:?}");
        let mut bytes = Vec::new();
        assert!(read(|b| bytes = b.clone(), &[]).is_ok());
        let mut gzip = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
        gzip.write_all(&bytes).unwrap();
        (0..80).for_each(|_| gzip.write_all(&[0; 1 << 20]).unwrap());
        let e = parse(&gzip.finish().unwrap(), &mut Vec::new()).unwrap_err();
        assert!(e.contains("bytes behind its Gaussians"), "{e}");
    }

    #[test]
    fn every_version_is_read_back() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.spz");
        let s = Splats { antialiased: true, ..seeded::small(50, 32, 24, 2, 1003).0 };
        for version in VERSIONS {
            write_splats(&path, &s, version).unwrap();
            let mut notes = Vec::new();
            let back = read_noted(&path, &mut notes).unwrap();
            assert!(back.antialiased && back.len() == 50 && notes.is_empty(), "{version}: {notes:?}");
            for (a, b) in s.quats.iter().zip(&back.quats) {
                let norm = a.iter().map(|v| v * v).sum::<f32>().sqrt();
                let dot = a.iter().zip(b).map(|(x, y)| x * y).sum::<f32>() / norm;
                // In version 2 w is computed from the others, so half a step of theirs moves a w
                // near 0 by a tenth.
                assert!(dot.abs() > if version == 2 { 0.99 } else { 0.99999 }, "{version}: {dot}");
            }
        }
        assert!(write_splats(&path, &s, 5).unwrap_err().to_string().contains("version 5"));
    }
}
