//! Reading: every primitive of the default scene that has the extension, moved by the nodes above it.
use super::layout::{BIN_CHUNK, EXTENSION, FLOAT, JSON_CHUNK, MAGIC, attribute, turned};
use crate::format::{logit, transform};
use crate::scene::{Similarity, Splats, sh_coefficients};
use crate::{Error, Result};
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use glam::{DMat3, DMat4, DQuat, DVec3};
use serde::Deserialize;
use std::collections::BTreeMap;
use std::path::Path;

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Root {
    scene: Option<usize>,
    #[serde(default)]
    scenes: Vec<Scene>,
    #[serde(default)]
    nodes: Vec<Node>,
    #[serde(default)]
    meshes: Vec<Mesh>,
    #[serde(default)]
    accessors: Vec<Accessor>,
    #[serde(default)]
    buffer_views: Vec<BufferView>,
    #[serde(default)]
    buffers: Vec<Buffer>,
    #[serde(default)]
    extensions_required: Vec<String>,
}

#[derive(Deserialize)]
struct Scene {
    #[serde(default)]
    nodes: Vec<usize>,
}

#[derive(Deserialize)]
struct Node {
    mesh: Option<usize>,
    #[serde(default)]
    children: Vec<usize>,
    matrix: Option<[f64; 16]>,
    translation: Option<[f64; 3]>,
    rotation: Option<[f64; 4]>,
    scale: Option<[f64; 3]>,
}

#[derive(Deserialize)]
struct Mesh {
    primitives: Vec<Primitive>,
}

#[derive(Deserialize)]
struct Primitive {
    /// 4, triangles, is the default.
    mode: Option<u32>,
    attributes: BTreeMap<String, usize>,
    #[serde(default)]
    extensions: BTreeMap<String, serde_json::Value>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Accessor {
    buffer_view: Option<usize>,
    #[serde(default)]
    byte_offset: usize,
    component_type: u32,
    #[serde(default)]
    normalized: bool,
    count: usize,
    #[serde(rename = "type")]
    kind: String,
    sparse: Option<serde_json::Value>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct BufferView {
    buffer: usize,
    #[serde(default)]
    byte_offset: usize,
    byte_length: usize,
    byte_stride: Option<usize>,
}

#[derive(Deserialize)]
struct Buffer {
    uri: Option<String>,
}

/// Reads a `.glb` or `.gltf`: scene axes, SH of the highest degree that any part has.
pub fn read_splats(path: &Path) -> Result<Splats> {
    let bytes = std::fs::read(path).map_err(Error::io(path))?;
    let folder = path.parent().unwrap_or(Path::new(""));
    parse(&bytes, folder).map_err(|e| Error::input(format!("{}: {e}", path.display())))
}

fn parse(bytes: &[u8], folder: &Path) -> Result<Splats, String> {
    let (text, bin) = chunks(bytes)?;
    let root: Root = serde_json::from_slice(text).map_err(|e| format!("not a glTF document ({e})"))?;
    if let Some(other) = root.extensions_required.iter().find(|e| *e != EXTENSION) {
        return Err(format!("needs the extension {other}, which splatvk does not know; export it without"));
    }
    let buffers = root.buffers.iter().map(|b| contents(b, bin, folder)).collect::<Result<Vec<_>, _>>()?;
    let document = Document { root: &root, buffers };
    let mut parts = Vec::new();
    let top: Vec<usize> = match root.scenes.get(root.scene.unwrap_or(0)) {
        Some(scene) => scene.nodes.clone(),
        // Without scenes every node that no other has is one.
        None => {
            let mut below = vec![false; root.nodes.len()];
            for child in root.nodes.iter().flat_map(|n| &n.children) {
                // One that is not there is refused where its parent is visited.
                if let Some(below) = below.get_mut(*child) {
                    *below = true;
                }
            }
            (0..root.nodes.len()).filter(|i| !below[*i]).collect()
        }
    };
    // Nodes to visit, each with the transformation above it; in a tree no node comes twice.
    let mut open: Vec<(usize, DMat4)> = top.into_iter().rev().map(|n| (n, DMat4::IDENTITY)).collect();
    let mut seen = vec![false; root.nodes.len()];
    while let Some((index, above)) = open.pop() {
        let node = root.nodes.get(index).ok_or_else(|| format!("there is no node {index}"))?;
        if std::mem::replace(&mut seen[index], true) {
            return Err(format!("node {index} is below two others; nodes must form a tree"));
        }
        let matrix = above * local(node);
        for mut splats in document.gaussians(node)? {
            transform::transform_splats(&mut splats, &similarity(matrix, index)?);
            parts.push(splats);
        }
        open.extend(node.children.iter().rev().map(|child| (*child, matrix)));
    }
    let degree = parts
        .iter()
        .map(|p| p.sh_degree)
        .max()
        .ok_or_else(|| format!("no part of it has the extension {EXTENSION}: not a file of Gaussians"))?;
    let mut all = Splats { sh_degree: degree, ..Splats::default() };
    for mut part in parts {
        let (own, wanted) = (3 * part.sh_len(), 3 * all.sh_len());
        if own < wanted {
            let padded = |row: &[f32]| {
                row.iter().copied().chain(std::iter::repeat_n(0.0, wanted - own)).collect::<Vec<_>>()
            };
            part.sh = part.sh.chunks_exact(own).flat_map(padded).collect();
            part.sh_degree = degree;
        }
        all.append(part);
    }
    transform::transform_splats(&mut all, &turned());
    Ok(all)
}

/// The JSON of a file, and the binary chunk of a `.glb`.
fn chunks(bytes: &[u8]) -> Result<(&[u8], Option<&[u8]>), String> {
    let early = || "the file ends early; copy it again".to_owned();
    let word = |at: usize| -> Result<u32, String> {
        let b = bytes.get(at..at + 4).ok_or_else(early)?;
        Ok(u32::from_le_bytes([b[0], b[1], b[2], b[3]]))
    };
    if word(0)? != MAGIC {
        return Ok((bytes, None));
    }
    if word(4)? != 2 {
        return Err(format!("glTF version {}; only version 2 is known", word(4)?));
    }
    if (word(8)? as usize) > bytes.len() {
        return Err(early());
    }
    let chunk = |at: usize, kind: u32| -> Result<&[u8], String> {
        let (size, found) = (word(at)? as usize, word(at + 4)?);
        let body = bytes.get(at + 8..).and_then(|b| b.get(..size)).ok_or_else(early)?;
        if found == kind {
            Ok(body)
        } else {
            Err("its chunks are not in the order of a .glb file".to_owned())
        }
    };
    let text = chunk(12, JSON_CHUNK)?;
    let next = 20 + text.len();
    let bin = if next < bytes.len() { Some(chunk(next, BIN_CHUNK)?) } else { None };
    Ok((text, bin))
}

fn contents(buffer: &Buffer, bin: Option<&[u8]>, folder: &Path) -> Result<Vec<u8>, String> {
    let Some(uri) = &buffer.uri else {
        return Ok(bin.ok_or("a buffer has no address and the file no binary chunk")?.to_vec());
    };
    if let Some(data) = uri.strip_prefix("data:") {
        let body = data.split_once(";base64,").ok_or("a buffer inside of the file is not base64")?.1;
        return STANDARD.decode(body).map_err(|e| format!("damaged base64 ({e}); copy the file again"));
    }
    if uri.contains("://") {
        return Err(format!("its buffer {uri} is not a local file; download it and give its name"));
    }
    let path = folder.join(uri);
    std::fs::read(&path).map_err(|e| format!("its buffer {}: {e}", path.display()))
}

struct Document<'a> {
    root: &'a Root,
    buffers: Vec<Vec<u8>>,
}

impl Document<'_> {
    /// The Gaussians of a node, a set per primitive that has the extension, in the node's own axes.
    fn gaussians(&self, node: &Node) -> Result<Vec<Splats>, String> {
        let Some(mesh) = node.mesh else { return Ok(Vec::new()) };
        let mesh = self.root.meshes.get(mesh).ok_or_else(|| format!("there is no mesh {mesh}"))?;
        let ours = mesh.primitives.iter().filter(|p| p.extensions.contains_key(EXTENSION));
        ours.map(|p| self.primitive(p)).collect()
    }

    fn primitive(&self, primitive: &Primitive) -> Result<Splats, String> {
        let extension = &primitive.extensions[EXTENSION];
        let property = |name: &str, known: &str| match extension.get(name).and_then(|v| v.as_str()) {
            Some(value) if value != known => Err(format!("{name} {value} is not supported, only {known}")),
            _ => Ok(()),
        };
        property("kernel", "ellipse")?;
        property("colorSpace", "srgb_rec709_display")?;
        property("projection", "perspective")?;
        if primitive.mode != Some(0) {
            return Err("Gaussians must be points (mode 0)".to_owned());
        }
        let means = self.vectors::<3>(primitive, "POSITION", "VEC3")?;
        let rotations = self.vectors::<4>(primitive, &attribute("ROTATION"), "VEC4")?;
        let scales = self.vectors::<3>(primitive, &attribute("SCALE"), "VEC3")?;
        let opacities = self.vectors::<1>(primitive, &attribute("OPACITY"), "SCALAR")?;
        let name = |degree: u32, n: u32| attribute(&format!("SH_DEGREE_{degree}_COEF_{n}"));
        let has =
            |degree: &u32| (0..=2 * degree).any(|n| primitive.attributes.contains_key(&name(*degree, n)));
        let sh_degree = (1..=3).rev().find(has).unwrap_or(0);
        let mut columns = Vec::with_capacity(sh_coefficients(sh_degree));
        for degree in 0..=sh_degree {
            for n in 0..=2 * degree {
                columns.push(self.vectors::<3>(primitive, &name(degree, n), "VEC3")?);
            }
        }
        let counts = [rotations.len(), scales.len(), opacities.len()];
        if counts.into_iter().chain(columns.iter().map(Vec::len)).any(|n| n != means.len()) {
            return Err("its attributes have different numbers of Gaussians".to_owned());
        }
        // A flat Gaussian has a scale of 0, of which there is no logarithm.
        let log_scale = |v: f32| v.max(f32::MIN_POSITIVE).ln();
        if scales.as_flattened().iter().any(|v| *v < 0.0) {
            return Err(
                "a scale is negative: drafts of the extension held logarithms; export the file again"
                    .to_owned(),
            );
        }
        Ok(Splats {
            log_scales: scales.iter().map(|s| s.map(log_scale)).collect(),
            quats: rotations.iter().map(|q| [q[3], q[0], q[1], q[2]]).collect(),
            opacity_logits: opacities.iter().map(|[a]| logit(*a)).collect(),
            sh_degree,
            sh: (0..means.len()).flat_map(|i| columns.iter().flat_map(move |c| c[i])).collect(),
            means,
        })
    }

    /// An attribute as floats, whatever the file stores it in.
    fn vectors<const N: usize>(
        &self,
        primitive: &Primitive,
        name: &str,
        kind: &str,
    ) -> Result<Vec<[f32; N]>, String> {
        let index =
            *primitive.attributes.get(name).ok_or_else(|| format!("the attribute {name} is missing"))?;
        let bad = |what: &str| format!("{name}: {what}");
        let accessor = self.root.accessors.get(index).ok_or_else(|| bad("its accessor is missing"))?;
        if accessor.kind != kind {
            return Err(bad(&format!("{} where {kind} is needed", accessor.kind)));
        }
        let (Some(view), None) = (accessor.buffer_view, &accessor.sparse) else {
            return Err(bad("sparse and empty accessors are not supported"));
        };
        let view = self.root.buffer_views.get(view).ok_or_else(|| bad("its buffer view is missing"))?;
        let early = || bad("the buffer ends early; copy the file again");
        let buffer = self.buffers.get(view.buffer).ok_or_else(|| bad("its buffer is missing"))?;
        let bytes =
            buffer.get(view.byte_offset..).and_then(|b| b.get(..view.byte_length)).ok_or_else(early)?;
        let bytes = bytes.get(accessor.byte_offset..).ok_or_else(early)?;
        let component = Component::of(accessor).ok_or_else(|| bad("its numbers are of an unknown type"))?;
        let row = N * component.bytes;
        let stride = view.byte_stride.unwrap_or(row);
        let needed =
            accessor.count.checked_sub(1).map_or(Some(0), |n| n.checked_mul(stride)?.checked_add(row));
        if stride < row || needed.is_none_or(|n| n > bytes.len()) {
            return Err(early());
        }
        let vector = |i: usize| {
            let own = &bytes[i * stride..i * stride + row];
            std::array::from_fn(|k| (component.read)(&own[k * component.bytes..]) / component.one)
        };
        let vectors: Vec<[f32; N]> = (0..accessor.count).map(vector).collect();
        if vectors.as_flattened().iter().all(|v| v.is_finite()) {
            Ok(vectors)
        } else {
            Err(bad("not all numbers are finite"))
        }
    }
}

/// How a number is stored; `one` is what stands for 1.
struct Component {
    bytes: usize,
    read: fn(&[u8]) -> f32,
    one: f32,
}

impl Component {
    fn of(accessor: &Accessor) -> Option<Component> {
        let (bytes, read, one): (_, fn(&[u8]) -> f32, _) = match accessor.component_type {
            FLOAT => {
                return Some(Component {
                    bytes: 4,
                    read: |b| f32::from_le_bytes([b[0], b[1], b[2], b[3]]),
                    one: 1.0,
                });
            }
            5120 => (1, |b| f32::from(b[0] as i8), 127.0),
            5121 => (1, |b| f32::from(b[0]), 255.0),
            5122 => (2, |b| f32::from(i16::from_le_bytes([b[0], b[1]])), 32767.0),
            5123 => (2, |b| f32::from(u16::from_le_bytes([b[0], b[1]])), 65535.0),
            _ => return None,
        };
        Some(Component { bytes, read, one: if accessor.normalized { one } else { 1.0 } })
    }
}

fn local(node: &Node) -> DMat4 {
    if let Some(matrix) = node.matrix {
        return DMat4::from_cols_array(&matrix);
    }
    DMat4::from_scale_rotation_translation(
        node.scale.map_or(DVec3::ONE, DVec3::from_array),
        node.rotation.map_or(DQuat::IDENTITY, |q| DQuat::from_array(q).normalize()),
        node.translation.map_or(DVec3::ZERO, DVec3::from_array),
    )
}

/// A transformation that keeps Gaussians what they are: no shear, no mirror, one scale.
fn similarity(matrix: DMat4, node: usize) -> Result<Similarity, String> {
    let linear = DMat3::from_mat4(matrix);
    let scale = linear.determinant().cbrt();
    let rotation = linear * (1.0 / scale);
    let proper = scale > 0.0 && (rotation * rotation.transpose()).abs_diff_eq(DMat3::IDENTITY, 1e-4);
    if !proper {
        return Err(format!(
            "node {node} stretches or mirrors its Gaussians; apply its transformation before the export"
        ));
    }
    Ok(Similarity { scale, rotation, translation: matrix.w_axis.truncate() })
}
