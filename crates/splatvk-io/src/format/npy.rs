//! NumPy `.npy` (format versions 1–3) and `.npz` files: little-endian, C order.
use super::archive;
use crate::{Error, Result, files};
use half::f16;
use std::cmp::Ordering;
use std::collections::BTreeMap;
use std::io::{Cursor, Read};
use std::path::Path;

const MAGIC: &[u8] = b"\x93NUMPY";

/// Longest header of an array in an archive, bytes: NumPy's own have 128, and it refuses headers
/// beyond 10,000.
const LONGEST_HEADER: u64 = 1 << 16;

/// The values of an array in its stored type.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub enum NpyData {
    /// `<f2`
    F16(Vec<f16>),
    /// `<f4`
    F32(Vec<f32>),
    /// `<f8`
    F64(Vec<f64>),
    /// `|u1` and `|b1`
    U8(Vec<u8>),
    /// `<i2`
    I16(Vec<i16>),
    /// `<i4`
    I32(Vec<i32>),
    /// `<i8`
    I64(Vec<i64>),
    /// `<U…`, a scalar string.
    Text(String),
}

/// An n-dimensional array, row-major.
#[derive(Clone, Debug, PartialEq)]
pub struct NpyArray {
    /// Length along each axis, outermost first.
    pub shape: Vec<usize>,
    /// Values, last axis fastest.
    pub data: NpyData,
}

impl NpyData {
    fn len(&self) -> usize {
        match self {
            NpyData::F16(v) => v.len(),
            NpyData::F32(v) => v.len(),
            NpyData::F64(v) => v.len(),
            NpyData::U8(v) => v.len(),
            NpyData::I16(v) => v.len(),
            NpyData::I32(v) => v.len(),
            NpyData::I64(v) => v.len(),
            NpyData::Text(_) => 1,
        }
    }
    fn descr(&self) -> String {
        match self {
            NpyData::F16(_) => "<f2".into(),
            NpyData::F32(_) => "<f4".into(),
            NpyData::F64(_) => "<f8".into(),
            NpyData::U8(_) => "|u1".into(),
            NpyData::I16(_) => "<i2".into(),
            NpyData::I32(_) => "<i4".into(),
            NpyData::I64(_) => "<i8".into(),
            NpyData::Text(s) => format!("<U{}", s.chars().count().max(1)),
        }
    }
    fn bytes(&self) -> Vec<u8> {
        match self {
            NpyData::F16(v) => v.iter().flat_map(|x| x.to_le_bytes()).collect(),
            NpyData::F32(v) => v.iter().flat_map(|x| x.to_le_bytes()).collect(),
            NpyData::F64(v) => v.iter().flat_map(|x| x.to_le_bytes()).collect(),
            NpyData::U8(v) => v.clone(),
            NpyData::I16(v) => v.iter().flat_map(|x| x.to_le_bytes()).collect(),
            NpyData::I32(v) => v.iter().flat_map(|x| x.to_le_bytes()).collect(),
            NpyData::I64(v) => v.iter().flat_map(|x| x.to_le_bytes()).collect(),
            NpyData::Text(s) if s.is_empty() => vec![0; 4],
            NpyData::Text(s) => s.chars().flat_map(|c| (c as u32).to_le_bytes()).collect(),
        }
    }
}

impl NpyArray {
    /// An f32 array. The caller keeps `shape` consistent with `data`; [`write()`] checks it.
    pub fn f32(shape: &[usize], data: Vec<f32>) -> Self {
        NpyArray { shape: shape.to_vec(), data: NpyData::F32(data) }
    }
    /// An i32 array.
    pub fn i32(shape: &[usize], data: Vec<i32>) -> Self {
        NpyArray { shape: shape.to_vec(), data: NpyData::I32(data) }
    }
    /// A u8 array.
    pub fn u8(shape: &[usize], data: Vec<u8>) -> Self {
        NpyArray { shape: shape.to_vec(), data: NpyData::U8(data) }
    }
    /// A scalar string.
    pub fn text(value: &str) -> Self {
        NpyArray { shape: Vec::new(), data: NpyData::Text(value.to_string()) }
    }
    /// All values as f32 (integers and f64 are rounded); empty for text.
    pub fn to_f32(&self) -> Vec<f32> {
        match &self.data {
            NpyData::F16(v) => v.iter().map(|x| x.to_f32()).collect(),
            NpyData::F32(v) => v.clone(),
            NpyData::F64(v) => v.iter().map(|&x| x as f32).collect(),
            NpyData::U8(v) => v.iter().map(|&x| x as f32).collect(),
            NpyData::I16(v) => v.iter().map(|&x| x as f32).collect(),
            NpyData::I32(v) => v.iter().map(|&x| x as f32).collect(),
            NpyData::I64(v) => v.iter().map(|&x| x as f32).collect(),
            NpyData::Text(_) => Vec::new(),
        }
    }
    /// All values as i32: floats are rounded, values outside i32 saturate, NaN becomes 0; empty for
    /// text.
    pub fn to_i32(&self) -> Vec<i32> {
        match &self.data {
            NpyData::F16(v) => v.iter().map(|x| x.to_f32().round() as i32).collect(),
            NpyData::F32(v) => v.iter().map(|x| x.round() as i32).collect(),
            NpyData::F64(v) => v.iter().map(|x| x.round() as i32).collect(),
            NpyData::U8(v) => v.iter().map(|&x| x as i32).collect(),
            NpyData::I16(v) => v.iter().map(|&x| x as i32).collect(),
            NpyData::I32(v) => v.clone(),
            NpyData::I64(v) => v.iter().map(|&x| x.clamp(i32::MIN as i64, i32::MAX as i64) as i32).collect(),
            NpyData::Text(_) => Vec::new(),
        }
    }
    /// The string of a text array.
    pub fn as_text(&self) -> Option<&str> {
        match &self.data {
            NpyData::Text(s) => Some(s),
            _ => None,
        }
    }
}

/// Reads one `.npy` file.
pub fn read(path: impl AsRef<Path>) -> Result<NpyArray> {
    let path = path.as_ref();
    decode(&files::read(path)?, &path.display().to_string())
}

/// Writes one `.npy` file (version 1.0, header padded to 64 bytes).
pub fn write(path: impl AsRef<Path>, array: &NpyArray) -> Result<()> {
    let path = path.as_ref();
    let bytes = encode(array)?;
    std::fs::write(path, bytes).map_err(Error::unwritable(path))
}

/// Reads every `.npy` member of an `.npz` file, by name without the extension. Refuses content of
/// more than 16 times the bytes of the file plus 64 MiB.
pub fn read_npz(path: impl AsRef<Path>) -> Result<BTreeMap<String, NpyArray>> {
    read_npz_of(path.as_ref(), 0)
}

/// Like [`read_npz`], for data of `rows` splats, which may compress to almost nothing.
pub(super) fn read_npz_of(path: &Path, rows: usize) -> Result<BTreeMap<String, NpyArray>> {
    let bytes = files::read(path)?;
    // Three levels with two codes of four bytes, a share and a reliability.
    let mut left = files::most_content(bytes.len()).saturating_add(30 * rows as u64);
    let bad = |what: String| {
        Error::input(format!("{}: {what}; copy the file again or make it anew", path.display()))
    };
    let damaged = |e: zip::result::ZipError| bad(format!("not a readable npz (zip) file ({e})"));
    let read_members = || -> Result<BTreeMap<String, NpyArray>> {
        let mut archive = zip::ZipArchive::new(Cursor::new(bytes.as_slice())).map_err(damaged)?;
        let mut out = BTreeMap::new();
        for k in 0..archive.len() {
            let mut member = archive.by_index(k).map_err(damaged)?;
            let name = member.name().map_err(damaged)?.to_string();
            let Some(key) = name.strip_suffix(".npy") else { continue };
            let bytes =
                read_member(&mut member, left).map_err(|what| bad(format!("array {key:?}: {what}")))?;
            left = left.saturating_sub(bytes.len() as u64);
            out.insert(key.to_string(), decode(&bytes, &format!("{}[{key}]", path.display()))?);
        }
        Ok(out)
    };
    files::guarded(read_members).unwrap_or_else(|panic| Err(bad(format!("damaged ({panic})"))))
}

/// Reads a whole member of at most `left` bytes: its header first, which states the number of bytes
/// of its values.
fn read_member(member: &mut impl Read, left: u64) -> Result<Vec<u8>, String> {
    let damaged = |e: std::io::Error| format!("damaged ({e})");
    let mut bytes = Vec::new();
    // Versions 2 and 3 have the longest preamble.
    member.by_ref().take(12).read_to_end(&mut bytes).map_err(damaged)?;
    let end = preamble(&bytes)?;
    if end as u64 > left.min(LONGEST_HEADER) {
        return Err("its npy header is too long".to_owned());
    }
    member
        .by_ref()
        .take((end as u64).saturating_sub(bytes.len() as u64))
        .read_to_end(&mut bytes)
        .map_err(damaged)?;
    let size = Header::parse(&bytes)?.size()?;
    let total = (end as u64).saturating_add(size);
    if total > left {
        return Err(format!("{size} bytes of values are far more than the file can hold"));
    }
    // One byte more detects trailing data, and makes the archive verify the checksum.
    bytes.reserve_exact(size as usize + 1);
    member.take(total - bytes.len() as u64 + 1).read_to_end(&mut bytes).map_err(damaged)?;
    Ok(bytes)
}

/// Writes an `.npz` file, uncompressed so that readers can map it.
pub fn write_npz(path: impl AsRef<Path>, arrays: &[(&str, &NpyArray)]) -> Result<()> {
    write_zip(path.as_ref(), arrays, zip::CompressionMethod::Stored)
}

/// Writes a compressed `.npz` file (as `numpy.savez_compressed`).
pub fn write_packed_npz(path: impl AsRef<Path>, arrays: &[(&str, &NpyArray)]) -> Result<()> {
    write_zip(path.as_ref(), arrays, zip::CompressionMethod::Deflated)
}

fn write_zip(path: &Path, arrays: &[(&str, &NpyArray)], method: zip::CompressionMethod) -> Result<()> {
    let members = arrays.iter().map(|(name, array)| Ok((format!("{name}.npy"), encode(array)?)));
    archive::write(path, "npz", method, members)
}

/// Serialises an array as a `.npy` file image.
pub fn encode(array: &NpyArray) -> Result<Vec<u8>> {
    let count: usize = array.shape.iter().product();
    if count != array.data.len() {
        return Err(Error::work(format!(
            "npy: shape {:?} holds {count} values but {} were given",
            array.shape,
            array.data.len()
        )));
    }
    let shape = match array.shape.as_slice() {
        [n] => format!("({n},)"),
        dims => format!("({})", dims.iter().map(|d| d.to_string()).collect::<Vec<_>>().join(", ")),
    };
    let mut header =
        format!("{{'descr': '{}', 'fortran_order': False, 'shape': {shape}, }}", array.data.descr());
    // magic + version + length field = 10 bytes; the whole preamble ends with '\n' on a multiple of
    // 64
    while (10 + header.len() + 1) % 64 != 0 {
        header.push(' ');
    }
    header.push('\n');
    let mut out = Vec::with_capacity(10 + header.len() + count * 4);
    out.extend_from_slice(MAGIC);
    out.extend_from_slice(&[1, 0]);
    out.extend_from_slice(&(header.len() as u16).to_le_bytes());
    out.extend_from_slice(header.as_bytes());
    out.extend_from_slice(&array.data.bytes());
    Ok(out)
}

/// Parses a `.npy` file image; `origin` names it in errors.
pub fn decode(bytes: &[u8], origin: &str) -> Result<NpyArray> {
    parse(bytes).map_err(|what| Error::input(format!("{origin}: {what}")))
}

fn parse(bytes: &[u8]) -> Result<NpyArray, String> {
    let header = Header::parse(bytes)?;
    let (size, found) = (header.size()?, &bytes[header.end..]);
    match (found.len() as u64).cmp(&size) {
        Ordering::Less => {
            Err(format!("truncated, {size} bytes of values expected, {} found; copy it again", found.len()))
        }
        Ordering::Greater => {
            Err(format!("{size} bytes of values expected, more follow; copy it again or save it anew"))
        }
        Ordering::Equal => Ok(NpyArray { data: parse_values(header.descr, found), shape: header.shape }),
    }
}

/// Offset of the values, from the first bytes of a file.
fn preamble(bytes: &[u8]) -> Result<usize, String> {
    if bytes.len() < 10 || &bytes[..6] != MAGIC {
        return Err("not a NumPy array file (wrong magic bytes); copy it again or save it anew".to_owned());
    }
    let length = match bytes[6] {
        1 => return Ok(10 + usize::from(u16::from_le_bytes([bytes[8], bytes[9]]))),
        2 | 3 if bytes.len() >= 12 => u32::from_le_bytes([bytes[8], bytes[9], bytes[10], bytes[11]]),
        v => return Err(format!("npy format version {v} is not supported (1 to 3 are); save it anew")),
    };
    (length as usize).checked_add(12).ok_or_else(|| "its npy header is too long".to_owned())
}

/// Header of an array.
struct Header<'a> {
    descr: &'a str,
    shape: Vec<usize>,
    /// Offset of the values.
    end: usize,
}

impl Header<'_> {
    fn parse(bytes: &[u8]) -> Result<Header<'_>, String> {
        let end = preamble(bytes)?;
        let start = if bytes[6] == 1 { 10 } else { 12 };
        let header = bytes.get(start..end).ok_or("truncated npy header; copy it again")?;
        let header = std::str::from_utf8(header).map_err(|_| "npy header is not text; save it anew")?;
        let descr = quoted(header, "descr").ok_or("npy header has no plain 'descr'; save it anew")?;
        if field(header, "fortran_order").is_some_and(|f| f.starts_with("True")) {
            return Err("Fortran order is not supported; save numpy.ascontiguousarray(x)".to_owned());
        }
        let shape = parse_shape(header).ok_or("npy header has no readable 'shape'; save it anew")?;
        Ok(Header { descr, shape, end })
    }

    /// Size of all values, bytes.
    fn size(&self) -> Result<u64, String> {
        let one = self.value_bytes()? as u64;
        let total = self.shape.iter().try_fold(one, |n, d| n.checked_mul(*d as u64));
        total.ok_or_else(|| "npy shape is too large; save it anew".to_owned())
    }

    fn value_bytes(&self) -> Result<usize, String> {
        let bytes = match self.descr {
            "|u1" | "|b1" | "|i1" => Some(1),
            "<f2" | "<i2" => Some(2),
            "<f4" | "<i4" => Some(4),
            "<f8" | "<i8" => Some(8),
            // A scalar string of UTF-32.
            other if self.shape.iter().all(|d| *d == 1) => {
                other.strip_prefix("<U").and_then(|n| n.parse::<usize>().ok()?.checked_mul(4))
            }
            _ => None,
        };
        bytes.ok_or_else(|| {
            format!(
                "element type '{}' is not supported (f2 f4 f8 u1 b1 i1 i2 i4 i8, little-endian)",
                self.descr
            )
        })
    }
}

/// Text after `'name':` in the header's Python dictionary.
fn field<'a>(header: &'a str, name: &str) -> Option<&'a str> {
    let at = header.find(&format!("'{name}'"))?;
    header[at + name.len() + 2..].trim_start().strip_prefix(':').map(str::trim_start)
}

fn quoted<'a>(header: &'a str, name: &str) -> Option<&'a str> {
    field(header, name)?.strip_prefix('\'')?.split('\'').next()
}

fn parse_shape(header: &str) -> Option<Vec<usize>> {
    let inside = field(header, "shape")?.strip_prefix('(')?.split(')').next()?;
    inside.split(',').map(str::trim).filter(|s| !s.is_empty()).map(|s| s.parse().ok()).collect()
}

/// Values of a type that [`Header::value_bytes`] accepts; `bytes` are exactly theirs.
fn parse_values(descr: &str, bytes: &[u8]) -> NpyData {
    macro_rules! values {
        ($variant:ident, $t:ty) => {
            NpyData::$variant(bytes.as_chunks().0.iter().map(|word| <$t>::from_le_bytes(*word)).collect())
        };
    }
    match descr {
        "<f2" => values!(F16, f16),
        "<f4" => values!(F32, f32),
        "<f8" => values!(F64, f64),
        "|i1" => NpyData::I16(bytes.iter().map(|&b| b as i8 as i16).collect()),
        "<i2" => values!(I16, i16),
        "<i4" => values!(I32, i32),
        "<i8" => values!(I64, i64),
        text if text.starts_with("<U") => {
            let chars = bytes.as_chunks().0.iter().map(|word| u32::from_le_bytes(*word));
            NpyData::Text(chars.take_while(|&c| c != 0).filter_map(char::from_u32).collect())
        }
        _ => NpyData::U8(bytes.to_vec()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Write;

    #[cfg(target_os = "linux")]
    #[test]
    fn full_disk_is_error() {
        let array = NpyArray::f32(&[2], vec![1.0, 2.0]);
        let error = write_packed_npz("/dev/full", &[("a", &array)]).unwrap_err();
        assert!(error.exit_code() == 4 && error.to_string().contains("the disk is full"), "{error}");
    }

    #[test]
    fn every_type_survives_a_round_trip() {
        let arrays = [
            NpyArray { shape: vec![2], data: NpyData::F16(vec![f16::from_f32(0.5), f16::from_f32(-2.0)]) },
            NpyArray::f32(&[2, 3], vec![1.0, -2.5, 3.0, f32::MIN_POSITIVE, 5.0, 6.0]),
            NpyArray { shape: vec![1, 1, 1], data: NpyData::F64(vec![std::f64::consts::PI]) },
            NpyArray::u8(&[4], vec![0, 1, 254, 255]),
            NpyArray { shape: vec![2], data: NpyData::I16(vec![-3, 300]) },
            NpyArray::i32(&[0, 7], vec![]),
            NpyArray { shape: vec![1], data: NpyData::I64(vec![-1]) },
            NpyArray::text("words/ä"),
        ];
        let dir = tempfile::tempdir().unwrap();
        let npz = dir.path().join("a.npz");
        let names: Vec<String> = (0..arrays.len()).map(|k| format!("x{k}")).collect();
        let list: Vec<(&str, &NpyArray)> = names.iter().map(String::as_str).zip(&arrays).collect();
        write_npz(&npz, &list).unwrap();
        let back = read_npz(&npz).unwrap();
        for (k, array) in arrays.iter().enumerate() {
            let bytes = encode(array).unwrap();
            let preamble = 10 + u16::from_le_bytes([bytes[8], bytes[9]]) as usize;
            assert_eq!(preamble % 64, 0);
            assert_eq!(&decode(&bytes, "x").unwrap(), array);
            assert_eq!(&back[&format!("x{k}")], array);
        }
    }

    #[test]
    fn reads_depth_written_by_numpy() {
        let file = concat!(env!("CARGO_MANIFEST_DIR"), "/../../tests/data/breakfast/depth/train_00.npz");
        let depth = &read_npz(file).unwrap()["depth"];
        assert_eq!(depth.shape, [480, 640]);
        let z = depth.to_f32();
        assert!(z.iter().all(|&z| (0.0..20.0).contains(&z)) && z.iter().any(|&z| z > 0.2));
    }

    #[test]
    fn damage_is_reported_not_swallowed() {
        let good = encode(&NpyArray::f32(&[3], vec![1.0, 2.0, 3.0])).unwrap();
        let cut = decode(&good[..good.len() - 1], "cut.npy").unwrap_err().to_string();
        assert!(cut.contains("cut.npy") && cut.contains("truncated"), "{cut}");
        assert!(decode(&good[..40], "x").is_err() && decode(b"PK\x03\x04aaaaaaaa", "x").is_err());
        let at = good.windows(5).position(|w| w == b"False").unwrap();
        let mut fortran = good.clone();
        fortran[at..at + 5].copy_from_slice(b"True ");
        assert!(decode(&fortran, "x").unwrap_err().to_string().contains("Fortran"));
        let endian: Vec<u8> = good.iter().map(|&b| if b == b'<' { b'>' } else { b }).collect();
        assert!(decode(&endian, "x").unwrap_err().to_string().contains(">f4"));
        assert!(encode(&NpyArray::f32(&[2, 2], vec![0.0])).is_err());
        let more = decode(&[&good[..], &[0]].concat(), "x").unwrap_err().to_string();
        assert!(more.contains("more follow"), "{more}");
    }

    /// Error for an archive of one member, whose bytes `change` may damage.
    fn archive(path: &Path, member: &[&[u8]], change: impl Fn(&mut Vec<u8>)) -> String {
        let method = zip::CompressionMethod::Deflated;
        let options = zip::write::SimpleFileOptions::default().compression_method(method);
        let mut zip = zip::ZipWriter::new(Cursor::new(Vec::new()));
        zip.start_file("a.npy", options).unwrap();
        member.iter().for_each(|part| zip.write_all(part).unwrap());
        let mut bytes = zip.finish().unwrap().into_inner();
        change(&mut bytes);
        std::fs::write(path, bytes).unwrap();
        let e = read_npz(path).unwrap_err();
        assert_eq!(e.exit_code(), 2);
        e.to_string()
    }

    #[test]
    fn npz_content_is_bounded_and_verified() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.npz");
        let array = encode(&NpyArray::u8(&[100], vec![7; 100])).unwrap();
        let zeros = vec![0u8; 1 << 20];
        let follows = archive(&path, &[&array, &zeros], |_| ());
        assert!(follows.contains("more follow") && follows.contains("a.npz"), "{follows}");
        // 100 MiB of zeros, as their header states, in 100 KB.
        let header = std::str::from_utf8(&array[10..128]).unwrap().replace("(100,)", "(104857600,)");
        let large = [&array[..10], &header.as_bytes()[..118]].concat();
        let parts: Vec<&[u8]> =
            std::iter::once(&large[..]).chain(std::iter::repeat_n(&zeros[..], 100)).collect();
        let bomb = archive(&path, &parts, |_| ());
        assert!(bomb.contains("104857600 bytes") && bomb.contains("far more"), "{bomb}");
        // A wrong checksum.
        let damaged = archive(&path, &[&array], |bytes| {
            let at = bytes.windows(4).position(|w| w == b"PK\x01\x02").unwrap();
            bytes[at + 16] ^= 1;
        });
        assert!(damaged.contains("a.npz: ") && damaged.contains("copy the file again"), "{damaged}");
    }
}
