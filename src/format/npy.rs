//! NumPy `.npy` (format versions 1–3) and `.npz` files: little-endian, C order.
use crate::{Error, Result};
use half::f16;
use std::collections::BTreeMap;
use std::io::{Read, Write};
use std::path::Path;

const MAGIC: &[u8] = b"\x93NUMPY";

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
    /// All values as i32: floats are rounded, values outside i32 saturate, NaN becomes 0; empty for text.
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
    let bytes = std::fs::read(path).map_err(Error::io(path))?;
    decode(&bytes, &path.display().to_string())
}

/// Writes one `.npy` file (version 1.0, header padded to 64 bytes).
pub fn write(path: impl AsRef<Path>, array: &NpyArray) -> Result<()> {
    let path = path.as_ref();
    let bytes = encode(array)?;
    std::fs::write(path, bytes).map_err(Error::unwritable(path))
}

/// Reads every `.npy` member of an `.npz` file, by name without the extension.
pub fn read_npz(path: impl AsRef<Path>) -> Result<BTreeMap<String, NpyArray>> {
    let path = path.as_ref();
    let bad = |e: zip::result::ZipError| {
        Error::input(format!("{}: not a readable npz (zip) file: {e}", path.display()))
    };
    let file = std::fs::File::open(path).map_err(Error::io(path))?;
    let mut archive = zip::ZipArchive::new(std::io::BufReader::new(file)).map_err(bad)?;
    let mut out = BTreeMap::new();
    for k in 0..archive.len() {
        let mut member = archive.by_index(k).map_err(bad)?;
        let name = member.name().map_err(bad)?.to_string();
        let Some(key) = name.strip_suffix(".npy") else { continue };
        let mut bytes = Vec::new();
        member.read_to_end(&mut bytes).map_err(Error::io(path))?;
        out.insert(key.to_string(), decode(&bytes, &format!("{}[{key}]", path.display()))?);
    }
    Ok(out)
}

/// Writes an `.npz` file, stored without compression so that readers can map it.
pub fn write_npz(path: impl AsRef<Path>, arrays: &[(&str, &NpyArray)]) -> Result<()> {
    write_zip(path.as_ref(), arrays, zip::CompressionMethod::Stored)
}

/// The same, compressed (as `numpy.savez_compressed`).
pub fn write_packed_npz(path: impl AsRef<Path>, arrays: &[(&str, &NpyArray)]) -> Result<()> {
    write_zip(path.as_ref(), arrays, zip::CompressionMethod::Deflated)
}

fn write_zip(path: &Path, arrays: &[(&str, &NpyArray)], method: zip::CompressionMethod) -> Result<()> {
    let bad = |e: zip::result::ZipError| match e {
        zip::result::ZipError::Io(e) => Error::unwritable(path)(e),
        e => Error::work(format!("{}: cannot write the npz file: {e}", path.display())),
    };
    let file = std::fs::File::create(path).map_err(Error::unwritable(path))?;
    let mut zip = zip::ZipWriter::new(std::io::BufWriter::new(file));
    let options = zip::write::SimpleFileOptions::default().compression_method(method);
    for (name, array) in arrays {
        zip.start_file(format!("{name}.npy"), options).map_err(bad)?;
        zip.write_all(&encode(array)?).map_err(Error::unwritable(path))?;
    }
    zip.finish().map_err(bad)?.flush().map_err(Error::unwritable(path))
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
    // magic + version + length field = 10 bytes; the whole preamble ends with '\n' on a multiple of 64
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
    let bad = |what: &str| Error::input(format!("{origin}: {what}"));
    if bytes.len() < 10 || &bytes[..6] != MAGIC {
        return Err(bad("not a NumPy array file (wrong magic bytes)"));
    }
    let (start, length): (usize, usize) = match bytes[6] {
        1 => (10, u16::from_le_bytes([bytes[8], bytes[9]]) as usize),
        2 | 3 if bytes.len() >= 12 => {
            (12, u32::from_le_bytes([bytes[8], bytes[9], bytes[10], bytes[11]]) as usize)
        }
        v => return Err(bad(&format!("npy format version {v} is not supported (1 to 3 are)"))),
    };
    let end = start.checked_add(length).filter(|&e| e <= bytes.len());
    let end = end.ok_or_else(|| bad("truncated npy header"))?;
    let header = std::str::from_utf8(&bytes[start..end]).map_err(|_| bad("npy header is not text"))?;
    let descr = quoted(header, "descr").ok_or_else(|| bad("npy header has no plain 'descr'"))?;
    if field(header, "fortran_order").is_some_and(|f| f.starts_with("True")) {
        return Err(bad("Fortran order is not supported; save numpy.ascontiguousarray(x)"));
    }
    let shape = parse_shape(header).ok_or_else(|| bad("npy header has no readable 'shape'"))?;
    let count = shape.iter().try_fold(1usize, |n, &d| n.checked_mul(d));
    let count = count.ok_or_else(|| bad("npy shape is too large"))?;
    let data = parse_values(descr, count, &bytes[end..], origin)?;
    Ok(NpyArray { shape, data })
}

/// The text after `'name':` in the header's Python dictionary.
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

fn parse_values(descr: &str, count: usize, bytes: &[u8], origin: &str) -> Result<NpyData> {
    let take = |size: usize| -> Result<&[u8]> {
        let need = count.saturating_mul(size);
        bytes.get(..need).ok_or_else(|| {
            Error::input(format!(
                "{origin}: truncated, {need} bytes of values expected, {} found",
                bytes.len()
            ))
        })
    };
    macro_rules! values {
        ($variant:ident, $t:ty) => {{
            const SIZE: usize = std::mem::size_of::<$t>();
            let mut out: Vec<$t> = Vec::with_capacity(take(SIZE)?.len() / SIZE);
            for chunk in take(SIZE)?.chunks_exact(SIZE) {
                let mut word = [0; SIZE];
                word.copy_from_slice(chunk);
                out.push(<$t>::from_le_bytes(word));
            }
            Ok(NpyData::$variant(out))
        }};
    }
    match descr {
        "<f2" => values!(F16, f16),
        "<f4" => values!(F32, f32),
        "<f8" => values!(F64, f64),
        "|u1" | "|b1" => Ok(NpyData::U8(take(1)?.to_vec())),
        "|i1" => Ok(NpyData::I16(take(1)?.iter().map(|&b| b as i8 as i16).collect())),
        "<i2" => values!(I16, i16),
        "<i4" => values!(I32, i32),
        "<i8" => values!(I64, i64),
        text if text.starts_with("<U") && count == 1 => {
            let chars = bytes.chunks_exact(4).map(|c| u32::from_le_bytes([c[0], c[1], c[2], c[3]]));
            Ok(NpyData::Text(chars.take_while(|&c| c != 0).filter_map(char::from_u32).collect()))
        }
        other => Err(Error::input(format!(
            "{origin}: element type '{other}' is not supported (f2 f4 f8 u1 b1 i1 i2 i4 i8, little-endian)"
        ))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
        let file = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/data/breakfast/depth/train_00.npz");
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
    }
}
