//! Binary glTF: numbers in one buffer, and the file around it.
use crate::{Error, Result};
use serde_json::{Value, json};
use std::path::Path;

/// "glTF", the start of a binary file.
pub(super) const MAGIC: u32 = 0x4654_6c67;
/// "JSON" and "BIN", the types of its chunks.
pub(super) const JSON_CHUNK: u32 = 0x4e4f_534a;
pub(super) const BIN_CHUNK: u32 = 0x004e_4942;
/// Component types.
pub(super) const FLOAT: u32 = 5126;
pub(super) const UNSIGNED_SHORT: u32 = 5123;
pub(super) const UNSIGNED_INT: u32 = 5125;
/// Targets of buffer views.
const ARRAY_BUFFER: u32 = 34962;
const ELEMENT_ARRAY_BUFFER: u32 = 34963;

/// Accessors, one after the other in one buffer.
#[derive(Default)]
pub(super) struct Numbers {
    pub data: Vec<u8>,
    pub accessors: Vec<Value>,
    pub views: Vec<Value>,
}

impl Numbers {
    /// Adds vertex attributes of f32; returns the accessor.
    pub fn floats(&mut self, kind: &str, width: usize, values: &[f32]) -> usize {
        self.add(kind, FLOAT, ARRAY_BUFFER, values.len() / width, bytemuck::cast_slice(values))
    }

    /// Adds vertex attributes in 0..1 as normalised 16-bit numbers; returns the accessor.
    pub fn shares(&mut self, kind: &str, width: usize, values: &[f32]) -> usize {
        let stored: Vec<u16> = values.iter().map(|v| (v * 65535.0).round() as u16).collect();
        let count = values.len() / width;
        let accessor = self.add(kind, UNSIGNED_SHORT, ARRAY_BUFFER, count, bytemuck::cast_slice(&stored));
        self.accessors[accessor]["normalized"] = json!(true);
        accessor
    }

    /// Adds positions with their extent, which glTF requires; returns the accessor.
    pub fn positions(&mut self, positions: &[[f32; 3]]) -> usize {
        let accessor = self.floats("VEC3", 3, positions.as_flattened());
        let bound = |pick: fn(f32, f32) -> f32, from: f32| {
            positions.iter().fold([from; 3], |b, p| [0, 1, 2].map(|k| pick(b[k], p[k])))
        };
        self.accessors[accessor]["min"] = json!(bound(f32::min, f32::INFINITY));
        self.accessors[accessor]["max"] = json!(bound(f32::max, f32::NEG_INFINITY));
        accessor
    }

    /// Adds the vertex indices of triangles; returns the accessor.
    pub fn triangles(&mut self, triangles: &[[u32; 3]]) -> usize {
        let bytes = bytemuck::cast_slice(triangles);
        self.add("SCALAR", UNSIGNED_INT, ELEMENT_ARRAY_BUFFER, 3 * triangles.len(), bytes)
    }

    fn add(&mut self, kind: &str, component: u32, target: u32, count: usize, bytes: &[u8]) -> usize {
        self.views.push(json!({
            "buffer": 0, "byteOffset": self.data.len(), "byteLength": bytes.len(), "target": target
        }));
        self.accessors.push(json!({
            "bufferView": self.views.len() - 1, "componentType": component, "count": count, "type": kind
        }));
        self.data.extend_from_slice(bytes);
        // Components of every type begin at multiples of their size.
        self.data.resize(self.data.len().next_multiple_of(4), 0);
        self.accessors.len() - 1
    }
}

/// Writes a document without buffers, and its buffer, as a binary file.
pub(super) fn write(path: &Path, mut root: Value, data: Vec<u8>) -> Result<()> {
    root["buffers"] = json!([{ "byteLength": data.len() }]);
    let mut text = root.to_string().into_bytes();
    text.resize(text.len().next_multiple_of(4), b' ');
    let total = 12 + 8 + text.len() + 8 + data.len();
    let mut out = Vec::with_capacity(total);
    for bytes in [MAGIC.to_le_bytes(), 2u32.to_le_bytes(), size_bytes(total, path)?] {
        out.extend(bytes);
    }
    for (chunk, kind) in [(text, JSON_CHUNK), (data, BIN_CHUNK)] {
        out.extend(size_bytes(chunk.len(), path)?);
        out.extend(kind.to_le_bytes());
        out.extend(chunk);
    }
    std::fs::write(path, out).map_err(Error::unwritable(path))
}

/// Bytes of a size in a `.glb`.
fn size_bytes(n: usize, path: &Path) -> Result<[u8; 4]> {
    u32::try_from(n).map(u32::to_le_bytes).map_err(|_| {
        let path = path.display();
        Error::work(format!("{path}: more than the 4 GiB of a .glb file; write a .ply instead"))
    })
}
