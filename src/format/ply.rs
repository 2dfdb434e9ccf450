//! PLY files: a table reader for one element, and the Gaussian layout that 3DGS viewers expect
//! (docs/method.md#gaussian-ply).
use super::ply_packed;
use crate::scene::{LanguageField, LevelField, PointCloud, Splats, sh_coefficients};
use crate::{Error, Result};
use std::fmt::Write as _;
use std::path::Path;

/// A column of a PLY element.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Kind {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Kind {
    fn parse(name: &str) -> Option<Kind> {
        Some(match name {
            "char" | "int8" => Kind::I8,
            "uchar" | "uint8" => Kind::U8,
            "short" | "int16" => Kind::I16,
            "ushort" | "uint16" => Kind::U16,
            "int" | "int32" => Kind::I32,
            "uint" | "uint32" => Kind::U32,
            "float" | "float32" => Kind::F32,
            "double" | "float64" => Kind::F64,
            _ => return None,
        })
    }
    const fn size(self) -> usize {
        match self {
            Kind::I8 | Kind::U8 => 1,
            Kind::I16 | Kind::U16 => 2,
            Kind::I32 | Kind::U32 | Kind::F32 => 4,
            Kind::F64 => 8,
        }
    }
    /// `bytes` holds exactly this kind's size; `N` extra bytes are never read.
    fn value(self, bytes: &[u8], little: bool) -> f64 {
        let mut raw = [0u8; 8];
        let size = self.size();
        for (k, b) in bytes.iter().take(size).enumerate() {
            raw[if little { k } else { size - 1 - k }] = *b;
        }
        let bits = u64::from_le_bytes(raw);
        match self {
            Kind::I8 => bits as u8 as i8 as f64,
            Kind::U8 => bits as f64,
            Kind::I16 => bits as u16 as i16 as f64,
            Kind::U16 => bits as f64,
            Kind::I32 => bits as u32 as i32 as f64,
            Kind::U32 => bits as f64,
            Kind::F32 => f32::from_bits(bits as u32) as f64,
            Kind::F64 => f64::from_bits(bits),
        }
    }
}

/// The `vertex` element of a PLY file.
struct Table {
    rows: usize,
    columns: Vec<(String, Kind)>,
    /// [rows, columns]
    values: Vec<f32>,
}

impl Table {
    fn column(&self, name: &str) -> Option<usize> {
        self.columns.iter().position(|c| c.0 == name)
    }
    fn at(&self, row: usize, column: usize) -> f32 {
        self.values[row * self.columns.len() + column]
    }
    /// Column numbers of all the names, or the first name that is missing.
    fn all<const N: usize>(&self, names: [&str; N]) -> Result<[usize; N], String> {
        let mut out = [0; N];
        for (o, name) in out.iter_mut().zip(names) {
            *o = self.column(name).ok_or_else(|| name.to_string())?;
        }
        Ok(out)
    }
    /// Columns `prefix0, prefix1, …` as long as they go on.
    fn series(&self, prefix: &str) -> Vec<usize> {
        (0..).map_while(|k| self.column(&format!("{prefix}{k}"))).collect()
    }
}

struct Header {
    ascii: bool,
    little: bool,
    /// Bytes (binary) or lines (ASCII) before the vertex rows.
    skip: usize,
    rows: usize,
    columns: Vec<(String, Kind)>,
    /// First byte after the header.
    body: usize,
}

/// What the header says about the element `wanted`.
fn header(bytes: &[u8], wanted: &str) -> Result<Header, String> {
    if !bytes.starts_with(b"ply") {
        return Err("not a PLY file (it does not start with \"ply\")".into());
    }
    let mark = b"end_header";
    let end = bytes.windows(mark.len()).position(|w| w == mark).ok_or("the header has no end_header line")?;
    let body =
        end + bytes[end..].iter().position(|&b| b == b'\n').ok_or("the file ends with its header")? + 1;
    let text = String::from_utf8_lossy(&bytes[..end]);
    let mut h = Header { ascii: false, little: true, skip: 0, rows: 0, columns: Vec::new(), body };
    // (name, rows, columns) of the elements before and up to the wanted one.
    let mut element = (String::new(), 0usize, Vec::new());
    let mut found = false;
    for line in text.lines().chain(["element end 0"]) {
        let words: Vec<&str> = line.split_whitespace().collect();
        match words.as_slice() {
            ["format", kind, _] => match *kind {
                "ascii" => h.ascii = true,
                "binary_little_endian" => {}
                "binary_big_endian" => h.little = false,
                other => return Err(format!("unknown PLY format {other:?}")),
            },
            ["element", name, count] => {
                let done = std::mem::replace(&mut element, (name.to_string(), 0, Vec::new()));
                element.1 = count.parse().map_err(|_| format!("bad element count {count:?}"))?;
                if done.0 == wanted {
                    (h.rows, h.columns, found) = (done.1, done.2, true);
                } else if !found {
                    let width: usize = done.2.iter().map(|c: &(String, Kind)| c.1.size()).sum();
                    h.skip += done.1.saturating_mul(if h.ascii { 1 } else { width });
                }
            }
            ["property", "list", ..] if !found && element.0 != "face" => {
                return Err(format!("element {} has a list property, which is not supported", element.0));
            }
            ["property", kind, name] => {
                let kind = Kind::parse(kind).ok_or_else(|| format!("unknown property type {kind:?}"))?;
                element.2.push((name.to_string(), kind));
            }
            _ => {}
        }
    }
    if found { Ok(h) } else { Err(format!("there is no {wanted} element")) }
}

/// The rows of one element of a binary file, with every digit of their values.
pub(super) struct Rows<'a> {
    columns: Vec<(String, Kind)>,
    offsets: Vec<usize>,
    width: usize,
    little: bool,
    bytes: &'a [u8],
}

impl Rows<'_> {
    pub fn len(&self) -> usize {
        self.bytes.len() / self.width.max(1)
    }
    pub fn find(&self, name: &str) -> Option<usize> {
        self.columns.iter().position(|c| c.0 == name)
    }
    /// Column numbers of all the names.
    pub fn all<const N: usize>(&self, names: [&str; N]) -> Result<[usize; N], String> {
        let mut out = [0; N];
        for (o, name) in out.iter_mut().zip(names) {
            *o = self.find(name).ok_or_else(|| format!("no column {name}"))?;
        }
        Ok(out)
    }
    /// Columns `prefix0, prefix1, …` as long as they go on.
    pub fn series(&self, prefix: &str) -> Vec<usize> {
        (0..).map_while(|k| self.find(&format!("{prefix}{k}"))).collect()
    }
    pub fn value(&self, row: usize, column: usize) -> f64 {
        let at = row * self.width + self.offsets[column];
        let kind = self.columns[column].1;
        kind.value(&self.bytes[at..at + kind.size()], self.little)
    }
}

/// Whether the file has such an element.
pub(super) fn has(bytes: &[u8], element: &str) -> bool {
    header(bytes, element).is_ok()
}

/// One element of a binary file.
pub(super) fn rows<'a>(bytes: &'a [u8], element: &str) -> Result<Rows<'a>, String> {
    let h = header(bytes, element)?;
    if h.ascii {
        return Err("an ASCII file cannot hold packed columns".into());
    }
    let mut width = 0;
    let mut offsets = Vec::with_capacity(h.columns.len());
    for (_, kind) in &h.columns {
        offsets.push(width);
        width += kind.size();
    }
    let end = h.rows.checked_mul(width).and_then(|n| n.checked_add(h.skip)).unwrap_or(usize::MAX);
    let body = bytes.get(h.body..).unwrap_or_default();
    let rows = body.get(h.skip..end).ok_or("the file ends early; copy it again")?;
    Ok(Rows { columns: h.columns, offsets, width, little: h.little, bytes: rows })
}

fn table(bytes: &[u8]) -> Result<Table, String> {
    let h = header(bytes, "vertex")?;
    let (width, wide) = (h.columns.iter().map(|c| c.1.size()).sum::<usize>(), h.columns.len());
    let body = bytes.get(h.body..).unwrap_or_default();
    let mut values = Vec::new();
    if h.ascii {
        let text = std::str::from_utf8(body).map_err(|_| "the ASCII body is not text".to_string())?;
        for line in text.lines().skip(h.skip).take(h.rows) {
            let before = values.len();
            for word in line.split_whitespace().take(wide) {
                values.push(word.parse::<f32>().map_err(|_| format!("{word:?} is not a number"))?);
            }
            if values.len() - before != wide {
                return Err(format!("row {} has fewer than {wide} values", before / wide.max(1)));
            }
        }
    } else {
        // Sizes are checked before anything is allocated: the counts come from the file.
        let end = h.rows.checked_mul(width).and_then(|n| n.checked_add(h.skip)).unwrap_or(usize::MAX);
        let rows = body.get(h.skip..end).ok_or_else(|| {
            format!("{} rows of {width} bytes are announced but the file ends early; copy it again", h.rows)
        })?;
        values.reserve_exact(h.rows * wide);
        for row in rows.chunks_exact(width.max(1)) {
            let mut at = 0;
            for (_, kind) in &h.columns {
                values.push(kind.value(&row[at..at + kind.size()], h.little) as f32);
                at += kind.size();
            }
        }
    }
    if values.len() != h.rows * wide {
        return Err(format!("{} rows are announced but the file ends early; copy it again", h.rows));
    }
    Ok(Table { rows: h.rows, columns: h.columns, values })
}

fn open(path: &Path) -> Result<Table> {
    let bytes = std::fs::read(path).map_err(Error::io(path))?;
    table(&bytes).map_err(|e| Error::input(format!("{}: {e}", path.display())))
}

/// Reads Gaussians in the INRIA layout, of any SH degree 0–3; unknown columns are skipped. ASCII or binary. Compressed
/// files as SuperSplat writes them are understood, too.
pub fn read_splats(path: &Path) -> Result<Splats> {
    let bytes = std::fs::read(path).map_err(Error::io(path))?;
    let parse = || {
        if ply_packed::is_packed(&header(&bytes, "vertex")?.columns) {
            return ply_packed::parse(&bytes);
        }
        gaussians(&table(&bytes)?)
    };
    parse().map_err(|what| Error::input(format!("{}: {what}", path.display())))
}

fn gaussians(t: &Table) -> Result<Splats, String> {
    let need = |missing: String| format!("no column {missing}: this is not a Gaussian splat file");
    let position = t.all(["x", "y", "z"]).map_err(need)?;
    let scale = t.all(["scale_0", "scale_1", "scale_2"]).map_err(need)?;
    let rotation = t.all(["rot_0", "rot_1", "rot_2", "rot_3"]).map_err(need)?;
    let [opacity] = t.all(["opacity"]).map_err(need)?;
    let dc = t.all(["f_dc_0", "f_dc_1", "f_dc_2"]).map_err(need)?;
    let rest = t.series("f_rest_");
    let sh_degree = (0..=3)
        .find(|&d| 3 * (sh_coefficients(d) - 1) == rest.len())
        .ok_or_else(|| format!("{} f_rest columns fit no SH degree 0–3 (0, 9, 24 or 45)", rest.len()))?;
    let per_channel = rest.len() / 3;
    let mut s = Splats { sh_degree, ..Splats::default() };
    for r in 0..t.rows {
        s.means.push(position.map(|c| t.at(r, c)));
        s.log_scales.push(scale.map(|c| t.at(r, c)));
        s.quats.push(rotation.map(|c| t.at(r, c)));
        s.opacity_logits.push(t.at(r, opacity));
        s.sh.extend(dc.map(|c| t.at(r, c)));
        for k in 0..per_channel {
            s.sh.extend([0, 1, 2].map(|channel| t.at(r, rest[channel * per_channel + k])));
        }
    }
    Ok(s)
}

/// Reads positions and colours (`red green blue` of any type, or `f_dc`); confidence 1, radius 0.
pub fn read_points(path: &Path) -> Result<PointCloud> {
    let t = open(path)?;
    let missing = |c| Error::input(format!("{}: no column {c}: this is not a point cloud", path.display()));
    let position = t.all(["x", "y", "z"]).map_err(missing)?;
    let colours = t.all(["red", "green", "blue"]).ok();
    let dc = t.all(["f_dc_0", "f_dc_1", "f_dc_2"]).ok();
    let mut p = PointCloud::default();
    for r in 0..t.rows {
        p.positions.push(position.map(|c| t.at(r, c)));
        p.colours.push(match (colours, dc) {
            (Some(c), _) => c.map(|c| {
                let full = if matches!(t.columns[c].1, Kind::F32 | Kind::F64) { 1.0 } else { 255.0 };
                (t.at(r, c) / full).clamp(0.0, 1.0)
            }),
            (None, Some(c)) => c.map(|c| (0.5 + super::SH_C0 * t.at(r, c)).clamp(0.0, 1.0)),
            (None, None) => [0.5; 3],
        });
    }
    let n = p.positions.len();
    (p.confidence, p.view, p.radius) = (vec![1.0; n], vec![0; n], vec![0.0; n]);
    Ok(p)
}

/// How [`write_splats`] writes.
#[derive(Clone, Copy, Debug)]
pub struct PlyOptions<'a> {
    /// SH degree of the file: higher coefficients are zero, lower degrees cut them. INRIA's own loader asks for 3.
    pub degree: u32,
    /// Adds unit features and code indices per level after all standard columns; viewers skip what they do not know.
    pub language: Option<&'a LanguageField>,
}

impl Default for PlyOptions<'_> {
    fn default() -> Self {
        PlyOptions { degree: 3, language: None }
    }
}

/// Writes Gaussians in the INRIA layout, binary little-endian.
pub fn write_splats(path: &Path, s: &Splats, options: PlyOptions) -> Result<()> {
    use std::io::Write as _;
    let levels = options.language.map(|l| named_levels(l, s.len())).transpose()?.unwrap_or_default();
    let rest = sh_coefficients(options.degree) - 1;
    let file = std::fs::File::create(path).map_err(Error::io(path))?;
    let mut out = std::io::BufWriter::new(file);
    let mut row: Vec<u8> = Vec::new();
    let mut write = |bytes: &[u8]| out.write_all(bytes).map_err(Error::io(path));
    write(splat_header(s.len(), rest, &levels).as_bytes())?;
    let have = s.sh_len();
    for i in 0..s.len() {
        row.clear();
        let mut push = |v: f32| row.extend_from_slice(&v.to_le_bytes());
        let sh = |k: usize, channel: usize| if k < have { s.sh[(i * have + k) * 3 + channel] } else { 0.0 };
        s.means[i].into_iter().for_each(&mut push);
        [0.0; 3].into_iter().for_each(&mut push);
        (0..3).for_each(|channel| push(sh(0, channel)));
        (0..3).for_each(|channel| (1..=rest).for_each(|k| push(sh(k, channel))));
        push(s.opacity_logits[i]);
        s.log_scales[i].into_iter().for_each(&mut push);
        s.quats[i].into_iter().for_each(&mut push);
        for (_, level) in &levels {
            unit(level, i).into_iter().for_each(&mut push);
        }
        for (_, level) in &levels {
            row.extend_from_slice(&nearest_code(level, i).to_le_bytes());
        }
        write(&row)?;
    }
    out.flush().map_err(Error::io(path))
}

fn named_levels(field: &LanguageField, n: usize) -> Result<Vec<(&'static str, &LevelField)>> {
    let levels: Vec<_> = crate::scene::LEVEL_NAMES
        .into_iter()
        .zip(&field.levels)
        .filter(|(_, l)| !l.codebook.is_empty())
        .collect();
    match levels.iter().find(|(_, l)| l.features.len() != n * l.codebook.code_dim) {
        Some((name, _)) => {
            Err(Error::work(format!("level {name} has features for another number of splats")))
        }
        None => Ok(levels),
    }
}

fn splat_header(n: usize, rest: usize, levels: &[(&str, &LevelField)]) -> String {
    let mut h = String::from("ply\nformat binary_little_endian 1.0\n");
    if let Some((_, first)) = levels.first() {
        let names = levels.iter().map(|l| l.0).collect::<Vec<_>>().join(",");
        let d = first.codebook.code_dim;
        // Writing to a String cannot fail.
        let _ = writeln!(
            h,
            "comment splatvk features d={d} levels={names} codebook=language/codebook_<level>.npz"
        );
    }
    let _ = writeln!(h, "element vertex {n}");
    let names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"].map(String::from).into_iter();
    let names = names
        .chain((0..3 * rest).map(|k| format!("f_rest_{k}")))
        .chain(
            ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
                .map(String::from),
        )
        .chain(
            levels.iter().flat_map(|(l, f)| (0..f.codebook.code_dim).map(move |k| format!("lang_{l}_{k}"))),
        );
    names.for_each(|name| {
        let _ = writeln!(h, "property float {name}");
    });
    levels.iter().for_each(|(l, _)| {
        let _ = writeln!(h, "property int code_{l}");
    });
    h.push_str("end_header\n");
    h
}

/// The unit feature of splat i; zero where the raw feature is zero.
fn unit(level: &LevelField, i: usize) -> Vec<f32> {
    let d = level.codebook.code_dim;
    let raw = &level.features[i * d..(i + 1) * d];
    let norm = raw.iter().map(|v| v * v).sum::<f32>().sqrt();
    raw.iter().map(|v| if norm > 0.0 { v / norm } else { 0.0 }).collect()
}

/// Index of the code nearest to the feature of splat i; −1 without a feature.
fn nearest_code(level: &LevelField, i: usize) -> i32 {
    let feature = unit(level, i);
    if feature.iter().all(|v| *v == 0.0) {
        return -1;
    }
    level.codebook.decode(&feature).map_or(-1, |k| k as i32)
}

/// Writes a coloured point cloud as other tools expect it: `x y z nx ny nz` float, `red green blue` uchar.
pub fn write_points(path: &Path, p: &PointCloud) -> Result<()> {
    let mut bytes = String::from("ply\nformat binary_little_endian 1.0\n").into_bytes();
    let mut header = format!("element vertex {}\n", p.len());
    ["x", "y", "z", "nx", "ny", "nz"].iter().for_each(|n| header.push_str(&format!("property float {n}\n")));
    ["red", "green", "blue"].iter().for_each(|n| header.push_str(&format!("property uchar {n}\n")));
    bytes.extend_from_slice(header.as_bytes());
    bytes.extend_from_slice(b"end_header\n");
    for (position, colour) in p.positions.iter().zip(&p.colours) {
        for v in position.iter().chain(&[0.0; 3]) {
            bytes.extend_from_slice(&v.to_le_bytes());
        }
        bytes.extend(colour.map(super::to_byte));
    }
    std::fs::write(path, bytes).map_err(Error::io(path))
}
