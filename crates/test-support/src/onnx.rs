//! Tiny ONNX files, built byte by byte (field numbers of the published onnx.proto3).
use std::path::Path;

pub const FLOAT: u64 = 1;
pub const INT64: u64 = 7;
pub const BOOL: u64 = 9;

/// A graph under construction. Axes are numbers or names ("?" = any).
#[derive(Default)]
pub struct Onnx {
    pub opset: u64,
    graph: Vec<u8>,
}

pub enum Attribute<'a> {
    Int(i64),
    Ints(&'a [i64]),
}

fn varint(mut n: u64) -> Vec<u8> {
    let mut out = Vec::new();
    while n > 0x7f {
        out.push(n as u8 & 0x7f | 0x80);
        n >>= 7;
    }
    out.push(n as u8);
    out
}

fn number(field: u64, n: u64) -> Vec<u8> {
    [varint(field << 3), varint(n)].concat()
}

fn bytes(field: u64, data: &[u8]) -> Vec<u8> {
    [varint(field << 3 | 2), varint(data.len() as u64), data.to_vec()].concat()
}

fn port(name: &str, kind: u64, dims: &str) -> Vec<u8> {
    let axis = |d: &str| match d.parse::<u64>() {
        Ok(n) => bytes(1, &number(1, n)),
        Err(_) => bytes(1, &bytes(2, d.as_bytes())),
    };
    let mut tensor = number(1, kind);
    // "…": no shape in the file.
    if dims != "…" {
        tensor.extend(bytes(2, &dims.split_whitespace().flat_map(axis).collect::<Vec<u8>>()));
    }
    [bytes(1, name.as_bytes()), bytes(2, &bytes(1, &tensor))].concat()
}

impl Onnx {
    pub fn new() -> Onnx {
        Onnx { opset: 17, graph: bytes(2, b"g") }
    }

    pub fn input(mut self, name: &str, kind: u64, dims: &str) -> Onnx {
        self.graph.extend(bytes(11, &port(name, kind, dims)));
        self
    }

    pub fn output(self, name: &str, dims: &str) -> Onnx {
        self.output_of(name, FLOAT, dims)
    }

    /// An output of another element type than floats.
    pub fn output_of(mut self, name: &str, kind: u64, dims: &str) -> Onnx {
        self.graph.extend(bytes(12, &port(name, kind, dims)));
        self
    }

    pub fn weight(mut self, name: &str, dims: &[u64], values: &[f32]) -> Onnx {
        let mut t: Vec<u8> = dims.iter().flat_map(|d| number(1, *d)).collect();
        t.extend(number(2, FLOAT));
        t.extend(bytes(8, name.as_bytes()));
        t.extend(bytes(9, &values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>()));
        self.graph.extend(bytes(5, &t));
        self
    }

    pub fn integers(mut self, name: &str, values: &[i64]) -> Onnx {
        let mut t = number(1, values.len() as u64);
        t.extend(number(2, INT64));
        t.extend(bytes(8, name.as_bytes()));
        t.extend(bytes(9, &values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>()));
        self.graph.extend(bytes(5, &t));
        self
    }

    /// A weight with its values in another file.
    pub fn external(mut self, name: &str, dims: &[u64], file: &str) -> Onnx {
        let mut t: Vec<u8> = dims.iter().flat_map(|d| number(1, *d)).collect();
        t.extend(number(2, FLOAT));
        t.extend(bytes(8, name.as_bytes()));
        t.extend(bytes(13, &[bytes(1, b"location"), bytes(2, file.as_bytes())].concat()));
        t.extend(number(14, 1));
        self.graph.extend(bytes(5, &t));
        self
    }

    /// Appends the node `op inputs → outputs`.
    pub fn node(mut self, op: &str, inputs: &str, outputs: &str, attributes: &[(&str, Attribute)]) -> Onnx {
        let mut n: Vec<u8> = inputs.split_whitespace().flat_map(|i| bytes(1, i.as_bytes())).collect();
        n.extend(outputs.split_whitespace().flat_map(|o| bytes(2, o.as_bytes())));
        n.extend(bytes(4, op.as_bytes()));
        for (name, value) in attributes {
            let mut a = bytes(1, name.as_bytes());
            match value {
                Attribute::Int(i) => a.extend([number(3, *i as u64), number(20, 2)].concat()),
                Attribute::Ints(list) => {
                    a.extend(list.iter().flat_map(|i| number(8, *i as u64)).collect::<Vec<u8>>());
                    a.extend(number(20, 7));
                }
            }
            n.extend(bytes(5, &a));
        }
        self.graph.extend(bytes(1, &n));
        self
    }

    pub fn encode(&self) -> Vec<u8> {
        // Intermediate representation 8, with the operators of `opset`.
        [number(1, 8), bytes(7, &self.graph), bytes(8, &[bytes(1, b""), number(2, self.opset)].concat())]
            .concat()
    }

    pub fn write(&self, path: &Path) {
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, self.encode()).unwrap();
    }
}
