//! Reads the header of an ONNX file without its weights: inputs, outputs, operator set, and files
//! with external weights. This takes milliseconds for files of several gigabytes and detects
//! truncated files before they are loaded.
//!
//! Field numbers are those of the published onnx.proto3.
use std::collections::HashSet;
use std::fmt;
use std::fs::File;
use std::io::{BufReader, Read, Seek};
use std::path::{Component, Path, PathBuf};

use crate::{Error, Result, files};

/// Element type of a tensor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ElementType {
    /// 16-, 32- or 64-bit floats.
    Float,
    /// 32- or 64-bit integers.
    Integer,
    /// Truth values.
    Truth,
    /// Anything else (string, 8-bit, bfloat16, not a tensor).
    Other,
}

/// One axis of a tensor.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Dim {
    /// Fixed length.
    Fixed(usize),
    /// Length known when the graph runs.
    Free,
}

impl Dim {
    /// The length, if the file fixes it.
    pub fn length(&self) -> Option<usize> {
        match self {
            Dim::Fixed(n) => Some(*n),
            Dim::Free => None,
        }
    }
}

/// An input or output of a graph.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Port {
    /// Its name.
    pub name: String,
    /// Its element type.
    pub kind: ElementType,
    /// Its axes, outermost first; `None` when the file does not state them.
    pub dims: Option<Vec<Dim>>,
}

impl fmt::Display for Port {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let axis = |d: &Dim| match d {
            Dim::Fixed(n) => n.to_string(),
            Dim::Free => "?".to_string(),
        };
        let dims = match &self.dims {
            Some(dims) => dims.iter().map(axis).collect::<Vec<_>>().join("×"),
            None => "…".to_string(),
        };
        write!(f, "{} [{dims}]", self.name)
    }
}

/// The parts of an ONNX file that are not weights.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Header {
    /// Version of the standard operators.
    pub opset: i64,
    /// Its inputs.
    pub inputs: Vec<Port>,
    /// Its outputs.
    pub outputs: Vec<Port>,
    /// Files with weights, beside this one.
    pub external: Vec<PathBuf>,
    /// Number of weights.
    pub parameters: u64,
}

/// Largest number of axes of a tensor and of outputs of a graph: real ones have some tens. A few
/// bytes in the file take fifty in memory.
const MOST_PARTS: usize = 1 << 12;
/// Largest number of weights of a graph, which old files list among the inputs: the largest
/// language models have some thousands.
const MOST_WEIGHTS: usize = 1 << 17;

/// A field of a protobuf message.
enum Field {
    Number(u64),
    /// Length of the bytes that follow.
    Bytes(u64),
    Skipped,
}

struct Reader {
    file: BufReader<File>,
    at: u64,
    size: u64,
}

impl Reader {
    fn byte(&mut self) -> Option<u8> {
        let mut one = [0];
        self.file.read_exact(&mut one).ok()?;
        self.at += 1;
        Some(one[0])
    }

    fn number(&mut self) -> Option<u64> {
        let mut value = 0u64;
        for shift in (0..64).step_by(7) {
            let byte = self.byte()?;
            value |= u64::from(byte & 0x7f) << shift;
            if byte < 0x80 {
                return Some(value);
            }
        }
        None
    }

    fn skip(&mut self, n: u64) -> Option<()> {
        self.at = self.at.checked_add(n).filter(|end| *end <= self.size)?;
        self.file.seek_relative(i64::try_from(n).ok()?).ok()
    }

    /// Reads the next field's number and value; for bytes, stops at their start.
    fn field(&mut self) -> Option<(u64, Field)> {
        let key = self.number()?;
        let field = match key & 7 {
            0 => Field::Number(self.number()?),
            1 => self.skip(8).map(|()| Field::Skipped)?,
            2 => {
                let n = self.number()?;
                // Longer than the file: cut off, or not a protobuf at all.
                (self.at.checked_add(n)? <= self.size).then_some(Field::Bytes(n))?
            }
            5 => self.skip(4).map(|()| Field::Skipped)?,
            _ => return None,
        };
        Some((key >> 3, field))
    }

    /// Calls `each` for every field of the next `length` bytes; bytes that it leaves are skipped.
    fn message(
        &mut self,
        length: u64,
        each: &mut dyn FnMut(&mut Reader, u64, Field) -> Option<()>,
    ) -> Option<()> {
        let end = self.at.checked_add(length)?;
        while self.at < end {
            let (number, field) = self.field()?;
            let next = match field {
                Field::Bytes(n) => self.at + n,
                _ => self.at,
            };
            if next > end {
                return None;
            }
            each(self, number, field)?;
            self.skip(next.checked_sub(self.at)?)?;
        }
        (self.at == end).then_some(())
    }

    fn text(&mut self, n: u64) -> Option<String> {
        // Limit of names and keys.
        let mut bytes = vec![0; usize::try_from(n).ok().filter(|n| *n < 1 << 16)?];
        self.file.read_exact(&mut bytes).ok()?;
        self.at += n;
        String::from_utf8(bytes).ok()
    }

    fn port(&mut self, length: u64) -> Option<Port> {
        let mut port = Port { name: String::new(), kind: ElementType::Other, dims: None };
        self.message(length, &mut |r, number, field| {
            match (number, field) {
                (1, Field::Bytes(n)) => port.name = r.text(n)?,
                (2, Field::Bytes(n)) => r.message(n, &mut |r, number, field| match (number, field) {
                    (1, Field::Bytes(n)) => r.tensor_type(n, &mut port),
                    _ => Some(()),
                })?,
                _ => {}
            }
            Some(())
        })?;
        Some(port)
    }

    fn tensor_type(&mut self, length: u64, port: &mut Port) -> Option<()> {
        self.message(length, &mut |r, number, field| {
            match (number, field) {
                (1, Field::Number(n)) => {
                    port.kind = match n {
                        1 | 10 | 11 => ElementType::Float,
                        6 | 7 => ElementType::Integer,
                        9 => ElementType::Truth,
                        _ => ElementType::Other,
                    }
                }
                (2, Field::Bytes(n)) => port.dims = Some(r.shape(n)?),
                _ => {}
            }
            Some(())
        })
    }

    fn shape(&mut self, length: u64) -> Option<Vec<Dim>> {
        let mut dims = Vec::new();
        self.message(length, &mut |r, number, field| {
            if let (1, Field::Bytes(n)) = (number, field) {
                let mut dim = Dim::Free;
                r.message(n, &mut |_, number, field| {
                    if let (1, Field::Number(n)) = (number, field) {
                        dim = Dim::Fixed(usize::try_from(n).ok()?);
                    }
                    Some(())
                })?;
                (dims.len() < MOST_PARTS).then(|| dims.push(dim))?;
            }
            Some(())
        })?;
        Some(dims)
    }

    /// Reads a weight: name, number of values, and file, if external.
    fn weight(&mut self, length: u64) -> Option<(String, u64, Option<String>)> {
        let (mut name, mut values, mut place) = (String::new(), 1u64, None);
        self.message(length, &mut |r, number, field| {
            match (number, field) {
                (1, Field::Number(n)) => values = values.saturating_mul(n),
                (1, Field::Bytes(n)) => {
                    let end = r.at + n;
                    while r.at < end {
                        values = values.saturating_mul(r.number()?);
                    }
                }
                (8, Field::Bytes(n)) => name = r.text(n)?,
                (13, Field::Bytes(n)) => {
                    let (mut key, mut value) = (String::new(), String::new());
                    r.message(n, &mut |r, number, field| {
                        match (number, field) {
                            (1, Field::Bytes(n)) => key = r.text(n)?,
                            (2, Field::Bytes(n)) => value = r.text(n)?,
                            _ => {}
                        }
                        Some(())
                    })?;
                    if key == "location" {
                        place = Some(value);
                    }
                }
                _ => {}
            }
            Some(())
        })?;
        Some((name, values, place))
    }
}

/// Reads the header of an ONNX file; the error names the file and the fault.
pub fn read(path: &Path) -> Result<Header> {
    let (file, size) = files::open(path)?;
    let mut reader = Reader { file: BufReader::new(file), at: 0, size };
    let header = read_header(&mut reader, path).filter(|h| !h.inputs.is_empty() && !h.outputs.is_empty());
    let folder = path.parent().unwrap_or(Path::new(""));
    if let Some(other) = header.iter().flat_map(|h| &h.external).find(|p| !is_inside(p, folder)) {
        return Err(Error::missing_model(
            path.display(),
            format!(
                "{}: its weights are in {}, outside of its folder; export it again with the weights beside it",
                path.display(),
                other.display()
            ),
        ));
    }
    header.ok_or_else(|| {
        let at = reader.file.stream_position().unwrap_or_default();
        Error::missing_model(path.display(), format!(
            "{}: not a complete ONNX file (unreadable at byte {at} of {size}): truncated or of another format; copy or \
             export it again",
            path.display()
        ))
    })
}

/// Whether a path leads into a folder without `..`.
fn is_inside(path: &Path, folder: &Path) -> bool {
    let inside = path.strip_prefix(folder);
    inside.is_ok_and(|p| p.components().all(|c| matches!(c, Component::Normal(_) | Component::CurDir)))
}

fn read_header(reader: &mut Reader, path: &Path) -> Option<Header> {
    let mut header = Header::default();
    let mut weights = HashSet::new();
    let mut places = HashSet::new();
    reader.message(reader.size, &mut |r, number, field| {
        match (number, field) {
            (7, Field::Bytes(n)) => r.message(n, &mut |r, number, field| {
                match (number, field) {
                    (5, Field::Bytes(n)) => {
                        let (name, values, place) = r.weight(n)?;
                        header.parameters = header.parameters.saturating_add(values);
                        places.extend(place);
                        (weights.len() < MOST_WEIGHTS).then(|| weights.insert(name))?;
                    }
                    (11, Field::Bytes(n)) if header.inputs.len() < MOST_WEIGHTS => {
                        header.inputs.push(r.port(n)?);
                    }
                    (12, Field::Bytes(n)) if header.outputs.len() < MOST_PARTS => {
                        header.outputs.push(r.port(n)?);
                    }
                    (11 | 12, _) => return None,
                    _ => {}
                }
                Some(())
            })?,
            (8, Field::Bytes(n)) => {
                let (mut domain, mut version) = (String::new(), 0);
                r.message(n, &mut |r, number, field| {
                    match (number, field) {
                        (1, Field::Bytes(n)) => domain = r.text(n)?,
                        (2, Field::Number(n)) => version = n as i64,
                        _ => {}
                    }
                    Some(())
                })?;
                if domain.is_empty() || domain == "ai.onnx" {
                    header.opset = version;
                }
            }
            _ => {}
        }
        Some(())
    })?;
    // Old files list their weights among the inputs.
    header.inputs.retain(|i| !weights.contains(&i.name));
    header.external = places.into_iter().map(|p| path.with_file_name(p)).collect();
    header.external.sort();
    Some(header)
}

/// Lists ports as "a [1×3×?×?], b [?×77]".
pub fn listed(ports: &[Port]) -> String {
    ports.iter().map(Port::to_string).collect::<Vec<_>>().join(", ")
}
