//! Elements of PLY files as tables.
use crate::{Error, Result, files};
use std::path::Path;

/// A column of a PLY element.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum PropertyType {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl PropertyType {
    fn parse(name: &str) -> Option<PropertyType> {
        Some(match name {
            "char" | "int8" => PropertyType::I8,
            "uchar" | "uint8" => PropertyType::U8,
            "short" | "int16" => PropertyType::I16,
            "ushort" | "uint16" => PropertyType::U16,
            "int" | "int32" => PropertyType::I32,
            "uint" | "uint32" => PropertyType::U32,
            "float" | "float32" => PropertyType::F32,
            "double" | "float64" => PropertyType::F64,
            _ => return None,
        })
    }
    const fn size(self) -> usize {
        match self {
            PropertyType::I8 | PropertyType::U8 => 1,
            PropertyType::I16 | PropertyType::U16 => 2,
            PropertyType::I32 | PropertyType::U32 | PropertyType::F32 => 4,
            PropertyType::F64 => 8,
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
            PropertyType::I8 => bits as u8 as i8 as f64,
            PropertyType::U8 => bits as f64,
            PropertyType::I16 => bits as u16 as i16 as f64,
            PropertyType::U16 => bits as f64,
            PropertyType::I32 => bits as u32 as i32 as f64,
            PropertyType::U32 => bits as f64,
            PropertyType::F32 => f32::from_bits(bits as u32) as f64,
            PropertyType::F64 => f64::from_bits(bits),
        }
    }
}

/// The `vertex` element of a PLY file.
pub(super) struct Table {
    pub rows: usize,
    pub columns: Vec<(String, PropertyType)>,
    cells: Cells,
}

enum Cells {
    /// [rows, columns], parsed from text.
    Parsed(Vec<f32>),
    /// The file, read value by value: columns of bytes would take four times as much as floats.
    Stored { bytes: Vec<u8>, first: usize, offsets: Vec<usize>, width: usize, little: bool },
}

/// Most columns of an element. Names of 4,096 take no time to look through; Gaussians with features have some hundreds.
const MOST_COLUMNS: usize = 4096;

/// Most bytes before the values: those of 4,096 columns with long names.
const LONGEST_HEADER: usize = 1 << 20;

impl Table {
    fn column(&self, name: &str) -> Option<usize> {
        self.columns.iter().position(|c| c.0 == name)
    }
    pub fn at(&self, row: usize, column: usize) -> f32 {
        match &self.cells {
            Cells::Parsed(values) => values[row * self.columns.len() + column],
            Cells::Stored { bytes, first, offsets, width, little } => {
                let (at, kind) = (first + row * width + offsets[column], self.columns[column].1);
                kind.value(&bytes[at..at + kind.size()], *little) as f32
            }
        }
    }
    /// Column numbers of all the names, or the first name that is missing.
    pub fn all<const N: usize>(&self, names: [&str; N]) -> Result<[usize; N], String> {
        let mut out = [0; N];
        for (o, name) in out.iter_mut().zip(names) {
            *o = self.column(name).ok_or_else(|| name.to_string())?;
        }
        Ok(out)
    }
    /// Columns `prefix0, prefix1, …` as long as they go on.
    pub fn series(&self, prefix: &str) -> Vec<usize> {
        (0..).map_while(|k| self.column(&format!("{prefix}{k}"))).collect()
    }
}

pub(super) struct Header {
    ascii: bool,
    little: bool,
    /// Bytes (binary) or lines (ASCII) before the vertex rows.
    skip: usize,
    rows: usize,
    pub columns: Vec<(String, PropertyType)>,
    /// First byte after the header.
    body: usize,
}

/// What the header says about the element `wanted`.
pub(super) fn header(bytes: &[u8], wanted: &str) -> Result<Header, String> {
    if !bytes.starts_with(b"ply") {
        return Err("not a PLY file (it does not start with \"ply\")".into());
    }
    let mark = b"end_header";
    let start = &bytes[..bytes.len().min(LONGEST_HEADER)];
    let end = start.windows(mark.len()).position(|w| w == mark).ok_or("the header has no end_header line")?;
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
                    let width: usize = done.2.iter().map(|c: &(String, PropertyType)| c.1.size()).sum();
                    let own = done.1.saturating_mul(if h.ascii { 1 } else { width });
                    h.skip = h.skip.saturating_add(own);
                }
            }
            ["property", "list", ..] if !found && element.0 != "face" => {
                return Err(format!("element {} has a list property, which is not supported", element.0));
            }
            ["property", kind, name] => {
                let kind =
                    PropertyType::parse(kind).ok_or_else(|| format!("unknown property type {kind:?}"))?;
                if element.2.len() == MOST_COLUMNS {
                    return Err(format!("element {} has more than {MOST_COLUMNS} properties", element.0));
                }
                element.2.push((name.to_string(), kind));
            }
            _ => {}
        }
    }
    if found { Ok(h) } else { Err(format!("there is no {wanted} element")) }
}

/// The rows of one element of a binary file, with every digit of their values.
pub(super) struct Rows<'a> {
    columns: Vec<(String, PropertyType)>,
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
    let (offsets, width) = layout(&h.columns);
    let (first, end) = place(&h, width, bytes.len())?;
    Ok(Rows { columns: h.columns, offsets, width, little: h.little, bytes: &bytes[first..end] })
}

/// Where the columns of a row begin, and its bytes.
fn layout(columns: &[(String, PropertyType)]) -> (Vec<usize>, usize) {
    let mut width = 0;
    let mut next = |(_, kind): &(String, PropertyType)| {
        width += kind.size();
        width - kind.size()
    };
    let offsets = columns.iter().map(&mut next).collect();
    (offsets, width)
}

/// First byte of the rows and the first after them. Checked before anything is allocated: the counts come from the file.
fn place(h: &Header, width: usize, size: usize) -> Result<(usize, usize), String> {
    let first = h.body.checked_add(h.skip);
    let end = first.and_then(|first| h.rows.checked_mul(width)?.checked_add(first));
    match (first, end) {
        (Some(first), Some(end)) if end <= size => Ok((first, end)),
        _ => Err(format!(
            "{} rows of {width} bytes are announced but the file ends early; copy it again",
            h.rows
        )),
    }
}

pub(super) fn table(bytes: Vec<u8>) -> Result<Table, String> {
    let h = header(&bytes, "vertex")?;
    let cells = if h.ascii {
        Cells::Parsed(parsed(&h, bytes.get(h.body..).unwrap_or_default())?)
    } else {
        let (offsets, width) = layout(&h.columns);
        let (first, _) = place(&h, width, bytes.len())?;
        Cells::Stored { bytes, first, offsets, width, little: h.little }
    };
    Ok(Table { rows: h.rows, columns: h.columns, cells })
}

/// The rows of a text file.
fn parsed(h: &Header, body: &[u8]) -> Result<Vec<f32>, String> {
    let wide = h.columns.len();
    let text = std::str::from_utf8(body).map_err(|_| "the ASCII body is not text".to_string())?;
    let early = || format!("{} rows are announced but the file ends early; copy it again", h.rows);
    // A value takes two bytes at least, with the blank after it.
    let count = h.rows.checked_mul(wide).filter(|n| *n <= body.len().div_ceil(2)).ok_or_else(early)?;
    let mut values = Vec::with_capacity(count);
    for (row, line) in text.lines().skip(h.skip).take(h.rows).enumerate() {
        let before = values.len();
        for word in line.split_whitespace().take(wide) {
            values.push(word.parse::<f32>().map_err(|_| format!("{word:?} is not a number (row {row})"))?);
        }
        if values.len() - before != wide {
            return Err(format!("row {row} has fewer than {wide} values"));
        }
    }
    if values.len() == count { Ok(values) } else { Err(early()) }
}

pub(super) fn open(path: &Path) -> Result<Table> {
    table(files::read(path)?).map_err(|e| Error::input(format!("{}: {e}", path.display())))
}
