//! Headers of PLY files: elements, their properties, and comments.
use std::collections::HashSet;

/// Type of a property.
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

    /// Bytes of a value.
    pub const fn size(self) -> usize {
        match self {
            PropertyType::I8 | PropertyType::U8 => 1,
            PropertyType::I16 | PropertyType::U16 => 2,
            PropertyType::I32 | PropertyType::U32 | PropertyType::F32 => 4,
            PropertyType::F64 => 8,
        }
    }

    /// Value in `bytes`, which begins with this type; bytes beyond its size are not read.
    pub fn value(self, bytes: &[u8], little: bool) -> f64 {
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

/// Largest number of columns of an element: a linear search over 4,096 names is fast, and Gaussians
/// with features have some hundreds.
const MOST_COLUMNS: usize = 4096;

/// Largest header, bytes: 4,096 columns with long names.
const LONGEST_HEADER: usize = 1 << 20;

/// Header of a file with respect to one of its elements.
#[derive(Debug)]
pub(super) struct Header {
    pub ascii: bool,
    pub little: bool,
    /// Bytes (binary) or lines (ASCII) before the rows of the element.
    pub skip: usize,
    pub rows: usize,
    pub columns: Vec<(String, PropertyType)>,
    /// First byte after the header.
    pub body: usize,
    /// Lines of `comment` and `obj_info`, without these words.
    pub comments: Vec<String>,
    /// Elements with rows, in the order of the file.
    pub elements: Vec<String>,
}

/// Lines of a header up to `end_header`, and the first byte after it. The first line decides
/// whether a carriage return alone ends a line: in other files the byte after `end_header\r` could
/// be a value equal to a line feed.
fn lines(bytes: &[u8]) -> Result<(Vec<String>, usize), String> {
    let mark = if bytes.starts_with(b"\xef\xbb\xbf") { 3 } else { 0 };
    let bytes = &bytes[mark..];
    let first = bytes.iter().take(64).position(|b| matches!(b, b'\n' | b'\r'));
    let Some(first) = first.filter(|end| bytes[..*end].trim_ascii() == b"ply") else {
        return Err("not a PLY file (its first line is not \"ply\")".into());
    };
    let end = if bytes[first] == b'\r' && bytes.get(first + 1) != Some(&b'\n') { b'\r' } else { b'\n' };
    let mut lines = Vec::new();
    let mut at = first + 1;
    let start = &bytes[..bytes.len().min(LONGEST_HEADER)];
    loop {
        let length = start[at..].iter().position(|b| *b == end);
        let text = start[at..][..length.unwrap_or(start.len() - at)].trim_ascii();
        if text == b"end_header" {
            let length = length.ok_or("the file ends with its header; copy it again")?;
            return Ok((lines, mark + at + length + 1));
        }
        let length = length.ok_or("the header has no end_header line")?;
        lines.push(String::from_utf8_lossy(text).into_owned());
        at += length + 1;
    }
}

/// Reads the header and the layout of the element `wanted`.
pub(super) fn header(bytes: &[u8], wanted: &str) -> Result<Header, String> {
    let (lines, body) = lines(bytes)?;
    let mut h = Header {
        ascii: false,
        little: true,
        skip: 0,
        rows: 0,
        columns: Vec::new(),
        body,
        comments: Vec::new(),
        elements: Vec::new(),
    };
    let mut elements: Vec<Element> = Vec::new();
    for line in &lines {
        let words: Vec<&str> = line.split_whitespace().collect();
        match words.as_slice() {
            ["comment" | "obj_info", ..] => {
                let text = line.split_once(char::is_whitespace).map_or("", |(_, text)| text.trim());
                h.comments.push(text.to_owned());
            }
            ["format", kind, _] => match *kind {
                "ascii" => h.ascii = true,
                "binary_little_endian" => {}
                "binary_big_endian" => h.little = false,
                other => return Err(format!("unknown PLY format {other:?}")),
            },
            ["element", name, count] => {
                let rows = count.parse().map_err(|_| format!("bad element count {count:?}"))?;
                if elements.iter().any(|e| e.name == *name) {
                    return Err(format!("it has two elements {name}; which one counts is not stated"));
                }
                elements.push(Element { name: (*name).into(), rows, ..Element::default() });
            }
            ["property", property @ ..] => {
                elements.last_mut().map_or(Ok(()), |element| element.add(property))?;
            }
            _ => {}
        }
    }
    let Some(at) = elements.iter().position(|e| e.name == wanted) else {
        return Err(format!("there is no {wanted} element"));
    };
    for before in &elements[..at] {
        h.skip = h.skip.saturating_add(before.length(h.ascii)?);
    }
    h.elements = elements.iter().filter(|e| e.rows > 0).map(|e| e.name.clone()).collect();
    let element = elements.swap_remove(at);
    element.check()?;
    (h.rows, h.columns) = (element.rows, element.columns);
    Ok(h)
}

#[derive(Default)]
struct Element {
    name: String,
    rows: usize,
    columns: Vec<(String, PropertyType)>,
    has_list: bool,
}

impl Element {
    /// Adds a property, given the words after "property".
    fn add(&mut self, property: &[&str]) -> Result<(), String> {
        match property {
            ["list", ..] => self.has_list = true,
            [kind, name] => {
                let kind =
                    PropertyType::parse(kind).ok_or_else(|| format!("unknown property type {kind:?}"))?;
                if self.columns.len() == MOST_COLUMNS {
                    return Err(format!("element {} has more than {MOST_COLUMNS} properties", self.name));
                }
                self.columns.push(((*name).to_owned(), kind));
            }
            _ => {}
        }
        Ok(())
    }

    /// Refuses rows of varying length, and duplicate column names.
    fn check(&self) -> Result<(), String> {
        let name = &self.name;
        if self.has_list {
            return Err(format!(
                "element {name} has a list property, which is not supported; write it without"
            ));
        }
        let mut seen = HashSet::new();
        match self.columns.iter().find(|c| !seen.insert(c.0.as_str())) {
            Some((twice, _)) => {
                Err(format!("element {name} has the property {twice} twice; remove one of them"))
            }
            None => Ok(()),
        }
    }

    /// Length in bytes (binary) or lines (ASCII).
    fn length(&self, ascii: bool) -> Result<usize, String> {
        if ascii || self.rows == 0 {
            return Ok(self.rows);
        }
        if self.has_list {
            return Err(format!(
                "element {} has a list property and stands before the others, which is not supported; put it last",
                self.name
            ));
        }
        let width: usize = self.columns.iter().map(|c| c.1.size()).sum();
        Ok(self.rows.saturating_mul(width))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const COLUMN: &str = "element vertex 1\nproperty uchar a\n";

    fn read(text: &str) -> Result<(Header, Vec<u8>), String> {
        let h = header(text.as_bytes(), "vertex")?;
        let body = text.as_bytes()[h.body..].to_vec();
        Ok((h, body))
    }

    #[test]
    fn end_header_counts_as_a_line() {
        let comments = "comment see end_header below\nobj_info end_header 3\n";
        let text = format!("ply\nformat ascii 1.0\n{comments}{COLUMN}end_header\n7\n");
        let (h, body) = read(&text).unwrap();
        assert_eq!(h.comments, ["see end_header below", "end_header 3"]);
        assert_eq!((h.rows, body.as_slice()), (1, &b"7\n"[..]));
        let lines = read(&format!("ply\nformat ascii 1.0\n{comments}{COLUMN}")).unwrap_err();
        assert!(lines.contains("no end_header line"), "{lines}");
    }

    #[test]
    fn every_line_ending_is_read() {
        let text = format!("ply\nformat binary_little_endian 1.0\n{COLUMN}end_header\n");
        // The value is a line feed: it must not be read as part of a line ending.
        for (ending, blanks) in [("\n", ""), ("\r\n", ""), ("\r", ""), ("\n", " \t"), ("\r\n", "  ")] {
            let text = text.replace('\n', &format!("{blanks}{ending}")) + "\n";
            let (h, body) = read(&text).unwrap();
            assert_eq!((h.columns.len(), body.as_slice()), (1, &b"\n"[..]), "{ending:?}");
        }
        let (h, body) = read(&("\u{feff}".to_owned() + &text.replace(' ', "\t") + "\x05")).unwrap();
        assert_eq!((h.rows, h.little, body.as_slice()), (1, true, &[5][..]));
    }

    #[test]
    fn ambiguous_headers_are_refused() {
        let refusal = |lines: &str| read(&format!("ply\nformat ascii 1.0\n{lines}end_header\n")).unwrap_err();
        assert!(refusal(&format!("{COLUMN}property float a\n")).contains("property a twice"));
        assert!(refusal(&format!("{COLUMN}element vertex 3\n")).contains("two elements vertex"));
        assert!(refusal(&format!("{COLUMN}property list uchar int b\n")).contains("list property"));
        let list = "element face 2\nproperty list uchar int b\n";
        assert!(read(&format!("ply\nformat ascii 1.0\n{list}{COLUMN}end_header\n")).is_ok());
        let binary = format!("ply\nformat binary_little_endian 1.0\n{list}{COLUMN}end_header\n");
        assert!(read(&binary).unwrap_err().contains("element face has a list property"));
    }
}
