//! Elements of PLY files as tables.
use super::ply_header::{Header, PropertyType, header};
use crate::files;

/// The `vertex` element of a PLY file.
pub(super) struct Table {
    pub rows: usize,
    pub columns: Vec<(String, PropertyType)>,
    /// See [`Header::comments`] and [`Header::elements`].
    pub comments: Vec<String>,
    elements: Vec<String>,
    cells: Cells,
}

enum Cells {
    /// [rows, columns], parsed from text.
    Parsed(Vec<f32>),
    /// The file, decoded value by value: parsing columns of bytes to floats would take four times
    /// the memory.
    Stored { bytes: Vec<u8>, first: usize, offsets: Vec<usize>, width: usize, little: bool },
}

impl Table {
    pub fn column(&self, name: &str) -> Option<usize> {
        self.columns.iter().position(|c| c.0 == name)
    }
    /// Names of the columns.
    pub fn names(&self) -> Vec<&str> {
        self.columns.iter().map(|c| c.0.as_str()).collect()
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
    /// Column numbers of all names, or the first missing name.
    pub fn all<const N: usize>(&self, names: [&str; N]) -> Result<[usize; N], String> {
        let mut out = [0; N];
        for (o, name) in out.iter_mut().zip(names) {
            *o = self.column(name).ok_or_else(|| name.to_string())?;
        }
        Ok(out)
    }
    /// Like [`Table::all`], case-insensitive; `None` if a name is missing.
    pub fn all_of_any_case<const N: usize>(&self, names: [&str; N]) -> Option<[usize; N]> {
        let find = |name: &str| self.columns.iter().position(|c| c.0.eq_ignore_ascii_case(name));
        let mut out = [0; N];
        for (o, name) in out.iter_mut().zip(names) {
            *o = find(name)?;
        }
        Some(out)
    }
    /// Columns `prefix0, prefix1, …`, without gaps.
    pub fn series(&self, prefix: &str) -> Result<Vec<usize>, String> {
        let found: Vec<usize> = (0..).map_while(|k| self.column(&format!("{prefix}{k}"))).collect();
        match self.columns.iter().filter(|c| c.0.starts_with(prefix)).count() == found.len() {
            true => Ok(found),
            false => {
                Err(format!("its columns {prefix}0, {prefix}1, … have a gap at {prefix}{}", found.len()))
            }
        }
    }
    /// A note on columns other than `read` and on other elements.
    pub fn unread(&self, read: &[&str]) -> Option<String> {
        unread(&self.columns, read, &self.elements, &["vertex"])
    }
}

/// A note on columns and elements that are not read; normals have no meaning here and are not
/// named.
fn unread(
    columns: &[(String, PropertyType)],
    read_columns: &[&str],
    elements: &[String],
    read_elements: &[&str],
) -> Option<String> {
    let known = |name: &str| read_columns.contains(&name) || matches!(name, "nx" | "ny" | "nz");
    let columns: Vec<&str> = columns.iter().map(|c| c.0.as_str()).filter(|name| !known(name)).collect();
    let elements: Vec<&str> =
        elements.iter().map(String::as_str).filter(|name| !read_elements.contains(name)).collect();
    let parts: Vec<String> = [("columns", columns), ("elements", elements)]
        .into_iter()
        .filter(|(_, names)| !names.is_empty())
        .map(|(what, names)| format!("{what} {}", files::listed(&names)))
        .collect();
    (!parts.is_empty()).then(|| format!("not read: {}", parts.join("; ")))
}

/// Rows of one element of a binary file, with full precision.
pub(super) struct Rows<'a> {
    columns: Vec<(String, PropertyType)>,
    offsets: Vec<usize>,
    width: usize,
    little: bool,
    bytes: &'a [u8],
    /// See [`Header::comments`] and [`Header::elements`].
    pub comments: Vec<String>,
    elements: Vec<String>,
}

impl Rows<'_> {
    pub fn len(&self) -> usize {
        self.bytes.len() / self.width.max(1)
    }
    pub fn find(&self, name: &str) -> Option<usize> {
        self.columns.iter().position(|c| c.0 == name)
    }
    /// Column numbers of all names.
    pub fn all<const N: usize>(&self, names: [&str; N]) -> Result<[usize; N], String> {
        let mut out = [0; N];
        for (o, name) in out.iter_mut().zip(names) {
            *o = self.find(name).ok_or_else(|| format!("no column {name}"))?;
        }
        Ok(out)
    }
    /// Columns `prefix0, prefix1, …` up to the first gap.
    pub fn series(&self, prefix: &str) -> Vec<usize> {
        (0..).map_while(|k| self.find(&format!("{prefix}{k}"))).collect()
    }
    /// Like [`Table::unread`], with the elements that are read.
    pub fn unread(&self, read: &[&str], elements: &[&str]) -> Option<String> {
        unread(&self.columns, read, &self.elements, elements)
    }
    pub fn value(&self, row: usize, column: usize) -> f64 {
        let at = row * self.width + self.offsets[column];
        let kind = self.columns[column].1;
        kind.value(&self.bytes[at..at + kind.size()], self.little)
    }
}

/// Whether the file has an element of a name.
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
    let (first, end) = byte_range(&h, width, bytes.len())?;
    Ok(Rows {
        columns: h.columns,
        offsets,
        width,
        little: h.little,
        bytes: &bytes[first..end],
        comments: h.comments,
        elements: h.elements,
    })
}

/// Byte offsets of the columns in a row, and the size of a row.
fn layout(columns: &[(String, PropertyType)]) -> (Vec<usize>, usize) {
    let mut width = 0;
    let mut next = |(_, kind): &(String, PropertyType)| {
        width += kind.size();
        width - kind.size()
    };
    let offsets = columns.iter().map(&mut next).collect();
    (offsets, width)
}

/// Byte range of the rows. Checked before anything is allocated: the counts come from the file.
fn byte_range(h: &Header, width: usize, size: usize) -> Result<(usize, usize), String> {
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
        let (first, _) = byte_range(&h, width, bytes.len())?;
        Cells::Stored { bytes, first, offsets, width, little: h.little }
    };
    Ok(Table { rows: h.rows, columns: h.columns, comments: h.comments, elements: h.elements, cells })
}

/// Values of a text file, row by row.
fn parsed(h: &Header, body: &[u8]) -> Result<Vec<f32>, String> {
    let wide = h.columns.len();
    let text = std::str::from_utf8(body).map_err(|_| "the ASCII body is not text".to_string())?;
    let early = || format!("{} rows are announced but the file ends early; copy it again", h.rows);
    // A value takes at least two bytes with the blank after it.
    let count = h.rows.checked_mul(wide).filter(|n| *n <= body.len().div_ceil(2)).ok_or_else(early)?;
    let mut values = Vec::with_capacity(count);
    // Either character ends a line, so that both together leave an empty one.
    let lines = text.split(['\n', '\r']).filter(|line| !line.trim().is_empty());
    for (row, line) in lines.skip(h.skip).take(h.rows).enumerate() {
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
