//! Reader: every primitive of the default scene that has the extension, transformed by the nodes
//! above it.
use super::buffers::{Buffer, contents};
use super::extensions::{self, Refused};
use super::layout::{EXTENSION, attribute, turned};
use crate::format::gaussians::degree;
use crate::format::glb::{BIN_CHUNK, FLOAT, JSON_CHUNK, MAGIC};
use crate::format::{logit, transform};
use crate::scene::{Similarity, Splats, sh_coefficients};
use crate::{Error, Result, files};
use glam::{DMat3, DMat4, DQuat, DVec3};
use serde::Deserialize;
use std::collections::{BTreeMap, HashSet};
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
    #[serde(default)]
    extensions_used: Vec<String>,
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
    // Boxed: a node without these fields takes few bytes in the file, and should not take many in
    // memory.
    matrix: Option<Box<[f64; 16]>>,
    translation: Option<Box<[f64; 3]>>,
    rotation: Option<Box<[f64; 4]>>,
    scale: Option<Box<[f64; 3]>>,
    #[serde(default)]
    extensions: Refused,
}

#[derive(Deserialize)]
struct Mesh {
    primitives: Vec<Primitive>,
}

#[derive(Deserialize)]
struct Primitive {
    /// Default 4, triangles.
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
    #[serde(default)]
    extensions: Refused,
}

/// Largest number of nodes: scenes of Gaussians have a handful, and a node takes 200 bytes while it
/// is visited.
const MOST_NODES: usize = 100_000;

/// Reads a `.glb` or `.gltf`: scene axes, SH of the highest degree of any part. Buffer files are
/// read from the folder of the file only. Notes name parts that are not read, a line each.
pub fn read_noted(path: &Path, notes: &mut Vec<String>) -> Result<Splats> {
    let bytes = files::read(path)?;
    let folder = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    parse(&bytes, folder, notes).map_err(|e| Error::input(format!("{}: {e}", path.display())))
}

fn parse(bytes: &[u8], folder: &Path, notes: &mut Vec<String>) -> Result<Splats, String> {
    let (text, bin) = chunks(bytes)?;
    let root: Root = files::parse_json(text).map_err(|e| format!("not a glTF document ({e})"))?;
    root.extensions_required.iter().try_for_each(|name| extensions::required(name))?;
    notes.extend(root.extensions_used.iter().filter_map(|name| extensions::note(name)));
    let document = Document { buffers: contents(&root.buffers, folder)?, root: &root, bin };
    let placed = document.transformed_primitives()?;
    let degrees = placed.iter().map(|(p, _)| Document::sh_degree(p));
    let sh_degree = degrees
        .max()
        .ok_or_else(|| format!("no part of it has the extension {EXTENSION}: not a file of Gaussians"))?;
    document.check_size(&placed, sh_degree, bytes.len())?;
    let mut seen = HashSet::new();
    // Nodes may instantiate a primitive several times.
    for (primitive, _) in placed.iter().filter(|(p, _)| seen.insert(std::ptr::from_ref(*p))) {
        extensions::check(&primitive.extensions[EXTENSION], notes)?;
        notes.extend(unread(primitive));
    }
    let others = root.meshes.iter().flat_map(|m| &m.primitives);
    let others = others.filter(|p| !p.extensions.contains_key(EXTENSION)).count();
    if others > 0 {
        notes.push(format!("{others} meshes without Gaussians are not read"));
    }
    let mut all = Splats { sh_degree, ..Splats::default() };
    for (primitive, by) in placed {
        let mut part = document.primitive(primitive, sh_degree)?;
        transform::transform_splats(&mut part, &by);
        // The first part is most often the only one: moved, not copied.
        if all.is_empty() { all = part } else { all.append(part) }
    }
    transform::transform_splats(&mut all, &turned());
    Ok(all)
}

/// The JSON of a file, and the binary chunk of a `.glb`.
fn chunks(bytes: &[u8]) -> Result<(&[u8], Option<&[u8]>), String> {
    if word(bytes, 0)? != MAGIC {
        return Ok((bytes, None));
    }
    if word(bytes, 4)? != 2 {
        return Err(format!("glTF version {}; only version 2 is known", word(bytes, 4)?));
    }
    if (word(bytes, 8)? as usize) > bytes.len() {
        return Err(truncated());
    }
    let text = chunk(bytes, 12, JSON_CHUNK)?;
    let next = 20 + text.len();
    let bin = if next < bytes.len() { Some(chunk(bytes, next, BIN_CHUNK)?) } else { None };
    Ok((text, bin))
}

fn truncated() -> String {
    "the file ends early; copy it again".to_owned()
}

/// The little-endian word at an offset.
fn word(bytes: &[u8], at: usize) -> Result<u32, String> {
    let b = bytes.get(at..at + 4).ok_or_else(truncated)?;
    Ok(u32::from_le_bytes([b[0], b[1], b[2], b[3]]))
}

/// Content of the chunk at an offset, which must be of a type.
fn chunk(bytes: &[u8], at: usize, kind: u32) -> Result<&[u8], String> {
    let (size, found) = (word(bytes, at)? as usize, word(bytes, at + 4)?);
    let body = bytes.get(at + 8..).and_then(|b| b.get(..size)).ok_or_else(truncated)?;
    if found == kind { Ok(body) } else { Err("its chunks are not in the order of a .glb file".to_owned()) }
}

struct Document<'a> {
    root: &'a Root,
    bin: Option<&'a [u8]>,
    buffers: BTreeMap<&'a str, Vec<u8>>,
}

impl<'a> Document<'a> {
    /// All primitives with the extension below the default scene, with their transformations; one
    /// entry for every node that instantiates them.
    fn transformed_primitives(&self) -> Result<Vec<(&'a Primitive, Similarity)>, String> {
        let root = self.root;
        let too_many = |n: usize| format!("{n} nodes, more than the {MOST_NODES} that are read; merge some");
        let top: Vec<usize> = match root.scenes.get(root.scene.unwrap_or(0)) {
            Some(scene) => scene.nodes.clone(),
            // Without scenes every node without a parent is a root.
            None => {
                let mut below = vec![false; root.nodes.len()];
                for child in root.nodes.iter().flat_map(|n| &n.children) {
                    below.get_mut(*child).into_iter().for_each(|b| *b = true);
                }
                (0..root.nodes.len()).filter(|i| !below[*i]).collect()
            }
        };
        if root.nodes.len().max(top.len()) > MOST_NODES {
            return Err(too_many(root.nodes.len().max(top.len())));
        }
        let mut placed = Vec::new();
        // Nodes to visit, each with the transformation above it; in a tree no node occurs twice.
        let mut open: Vec<(usize, DMat4)> = top.into_iter().rev().map(|n| (n, DMat4::IDENTITY)).collect();
        let mut seen = vec![false; root.nodes.len()];
        while let Some((index, above)) = open.pop() {
            let node = root.nodes.get(index).ok_or_else(|| format!("there is no node {index}"))?;
            if std::mem::replace(&mut seen[index], true) {
                return Err(format!("node {index} is below two others; nodes must form a tree"));
            }
            let matrix = above * local_matrix(node);
            for primitive in self.primitives(node)? {
                placed.push((primitive, similarity(matrix, index)?));
            }
            if open.len() + node.children.len() > MOST_NODES || placed.len() > MOST_NODES {
                return Err(too_many(open.len() + node.children.len().max(placed.len())));
            }
            open.extend(node.children.iter().rev().map(|child| (*child, matrix)));
        }
        Ok(placed)
    }

    /// Primitives of a node that have the extension.
    fn primitives(&self, node: &Node) -> Result<impl Iterator<Item = &'a Primitive>, String> {
        let none = &[][..];
        let all = match node.mesh {
            None => none,
            Some(mesh) => {
                let mesh = self.root.meshes.get(mesh).ok_or_else(|| format!("there is no mesh {mesh}"))?;
                &mesh.primitives
            }
        };
        let shown = all.iter().filter(|p| p.extensions.contains_key(EXTENSION));
        if shown.clone().next().is_some() {
            node.extensions.check()?;
        }
        Ok(shown)
    }

    /// Refuses files that would take far more memory than they have bytes: many nodes with one
    /// mesh, attributes that share their bytes. Counted before anything of that size is allocated.
    fn check_size(
        &self,
        placed: &[(&Primitive, Similarity)],
        sh_degree: u32,
        text: usize,
    ) -> Result<(), String> {
        let bytes = text as u64 + self.buffers.values().map(|b| b.len() as u64).sum::<u64>();
        let count = |(p, _): &(&Primitive, Similarity)| {
            let accessor = p.attributes.get("POSITION").and_then(|a| self.root.accessors.get(*a));
            accessor.map_or(0, |a| a.count as u64)
        };
        let total = placed.iter().map(count).fold(0u64, u64::saturating_add);
        // Mean, scales, rotation, opacity, coefficients.
        let row = 4 * (3 + 3 + 4 + 1 + 3 * sh_coefficients(sh_degree) as u64);
        let most = (4 * bytes + files::ROOM) / row;
        if total > most {
            return Err(format!(
                "its nodes show {total} Gaussians, and {most} are the most that are read of a file of {bytes} bytes; show \
                 its meshes fewer times"
            ));
        }
        Ok(())
    }

    fn sh_degree(primitive: &Primitive) -> u32 {
        let has = |degree: &u32| {
            (0..=2 * degree).any(|n| primitive.attributes.contains_key(&coefficient(*degree, n)))
        };
        (1..=3).rev().find(has).unwrap_or(0)
    }

    /// Gaussians of a primitive in the axes of its node; missing coefficients up to `sh_degree` are
    /// zero.
    fn primitive(&self, primitive: &Primitive, sh_degree: u32) -> Result<Splats, String> {
        if primitive.mode != Some(0) {
            return Err("Gaussians must be points (mode 0)".to_owned());
        }
        let means: Vec<[f32; 3]> = self.vectors(primitive, "POSITION", "VEC3")?.collect();
        let mut s = Splats { sh_degree, means, ..Splats::default() };
        let (n, width) = (s.len(), 3 * s.sh_len());
        let check_count = |found: usize| match found == n {
            true => Ok(()),
            false => Err("its attributes have different numbers of Gaussians".to_owned()),
        };
        let rotations = self.vectors(primitive, &attribute("ROTATION"), "VEC4")?;
        s.quats = rotations.map(|q: [f32; 4]| [q[3], q[0], q[1], q[2]]).collect();
        let scales = self.vectors(primitive, &attribute("SCALE"), "VEC3")?;
        s.log_scales = scales.collect();
        let opacities = self.vectors(primitive, &attribute("OPACITY"), "SCALAR")?;
        s.opacity_logits = opacities.map(|[a]| logit(a)).collect();
        [s.quats.len(), s.log_scales.len(), s.opacity_logits.len()].into_iter().try_for_each(check_count)?;
        if s.log_scales.as_flattened().iter().any(|v| *v < 0.0) {
            return Err(
                "a scale is negative: drafts of the extension held logarithms; export the file again"
                    .to_owned(),
            );
        }
        for v in s.log_scales.as_flattened_mut() {
            *v = v.ln();
        }
        s.sh = vec![0.0; n * width];
        for degree in 0..=Document::sh_degree(primitive) {
            for k in 0..=2 * degree {
                let column = self.vectors::<3>(primitive, &coefficient(degree, k), "VEC3")?;
                check_count(column.len())?;
                let first = 3 * (degree * degree + k) as usize;
                for (row, value) in s.sh.chunks_exact_mut(width).zip(column) {
                    row[first..first + 3].copy_from_slice(&value);
                }
            }
        }
        Ok(s)
    }

    /// An attribute as floats, from any stored component type.
    fn vectors<'s, const N: usize>(
        &'s self,
        primitive: &Primitive,
        name: &str,
        kind: &str,
    ) -> Result<impl ExactSizeIterator<Item = [f32; N]> + use<'s, 'a, N>, String> {
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
        view.extensions.check()?;
        let buffer = self.root.buffers.get(view.buffer).ok_or_else(|| bad("its buffer is missing"))?;
        let buffer = match &buffer.uri {
            Some(uri) => self.buffers.get(uri.as_str()).map(Vec::as_slice),
            None => self.bin,
        };
        let buffer = buffer.ok_or("a buffer has no address and the file no binary chunk")?;
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
        let vector = move |i: usize| {
            let own = &bytes[i * stride..i * stride + row];
            std::array::from_fn(|k| (component.read)(&own[k * component.bytes..]) / component.one)
        };
        Ok((0..accessor.count).map(vector))
    }
}

/// Notes on attributes of the extension that are not read, such as those of higher SH degrees.
fn unread(primitive: &Primitive) -> Vec<String> {
    let degrees = (0..=degree::MOST_DEGREE).flat_map(|l| (0..=2 * l).map(move |n| coefficient(l, n)));
    let read: Vec<String> =
        ["ROTATION", "SCALE", "OPACITY"].iter().map(|n| attribute(n)).chain(degrees).collect();
    let own = attribute("");
    let beyond =
        (degree::MOST_DEGREE + 1..=4).filter(|l| primitive.attributes.contains_key(&coefficient(*l, 0)));
    let notes = beyond.map(degree::beyond_degree);
    let others = primitive.attributes.keys().filter(|n| n.starts_with(&own) && !read.contains(n));
    let others =
        others.filter(|n| !n.contains("SH_DEGREE_4_")).map(|n| format!("its attribute {n} is not read"));
    notes.chain(others).collect()
}

fn coefficient(degree: u32, n: u32) -> String {
    attribute(&format!("SH_DEGREE_{degree}_COEF_{n}"))
}

/// Storage of a component; `one` is the stored value of 1.
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

fn local_matrix(node: &Node) -> DMat4 {
    if let Some(matrix) = &node.matrix {
        return DMat4::from_cols_array(matrix);
    }
    let vector = |v: &Option<Box<[f64; 3]>>, none: DVec3| v.as_ref().map_or(none, |v| DVec3::from_array(**v));
    DMat4::from_scale_rotation_translation(
        vector(&node.scale, DVec3::ONE),
        node.rotation.as_ref().map_or(DQuat::IDENTITY, |q| DQuat::from_array(**q).normalize()),
        vector(&node.translation, DVec3::ZERO),
    )
}

/// The similarity of a matrix; refuses shear, mirroring and non-uniform scale.
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
