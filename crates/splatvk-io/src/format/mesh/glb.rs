//! Binary glTF.
use super::{MeshFile, collider_name};
use crate::Result;
use crate::format::glb::{self, Numbers};
use crate::scene::{Hull, Mesh, MeshPart};
use serde_json::{Value, json};
use std::path::Path;

const UNLIT: &str = "KHR_materials_unlit";
/// Materials: the colours of the vertices as they are, and nothing.
const COLOURED: usize = 0;
const INVISIBLE: usize = 1;

#[derive(Default)]
struct Document {
    numbers: Numbers,
    meshes: Vec<Value>,
    nodes: Vec<Value>,
}

pub(super) fn write(path: &Path, mesh: &Mesh, file: &MeshFile) -> Result<()> {
    let mut document = Document::default();
    // Place of the scene's node, which names its children.
    document.nodes.push(Value::Null);
    let children: Vec<usize> = mesh.parts.iter().map(|part| document.part(mesh, part, file)).collect();
    document.nodes[0] = json!({ "name": file.name, "children": children, "extras": file.extras });
    let material = |name: &str, alpha: f32, mode: &str| {
        json!({
            "name": name,
            "pbrMetallicRoughness": {
                "baseColorFactor": [1.0, 1.0, 1.0, alpha], "metallicFactor": 0.0, "roughnessFactor": 1.0
            },
            "alphaMode": mode,
            // Surfaces that photos see from one side are open at the back.
            "doubleSided": true,
            "extensions": { UNLIT: {} }
        })
    };
    let mut materials = vec![material("colours", 1.0, "OPAQUE")];
    if mesh.parts.iter().any(|part| !part.colliders.is_empty()) {
        materials.push(material("collider", 0.0, "MASK"));
    }
    let root = json!({
        "asset": { "version": "2.0", "generator": concat!("splatvk ", env!("CARGO_PKG_VERSION")) },
        "extensionsUsed": [UNLIT],
        "scene": 0,
        "scenes": [{ "name": file.name, "nodes": [0] }],
        "nodes": document.nodes,
        "meshes": document.meshes,
        "materials": materials,
        "accessors": document.numbers.accessors,
        "bufferViews": document.numbers.views,
    });
    glb::write(path, root, document.numbers.data)
}

impl Document {
    /// Adds a part with its shapes of physics; returns its node.
    fn part(&mut self, mesh: &Mesh, part: &MeshPart, file: &MeshFile) -> usize {
        let own = mesh.part(part);
        let origin = if file.own_origins { bottom(&own) } else { [0.0; 3] };
        let positions = self.numbers.positions(&moved(&own.positions, origin));
        let normals = self.numbers.floats("VEC3", 3, own.normals.as_flattened());
        let opaque: Vec<f32> = own.colours.iter().flat_map(|[r, g, b]| [*r, *g, *b, 1.0]).collect();
        let colours = self.numbers.shares("VEC4", 4, &opaque);
        let triangles = self.numbers.triangles(&own.triangles);
        self.meshes.push(json!({ "name": part.name, "primitives": [{
            "attributes": { "POSITION": positions, "NORMAL": normals, "COLOR_0": colours },
            "indices": triangles,
            "material": COLOURED
        }] }));
        let mut node = json!({
            "name": part.name,
            "mesh": self.meshes.len() - 1,
            "extras": { "triangles": own.triangles.len() }
        });
        if file.own_origins {
            node["translation"] = json!(origin);
        }
        let count = part.colliders.len();
        let shapes = part.colliders.iter().enumerate();
        let children: Vec<usize> = shapes
            .map(|(i, hull)| self.collider(&collider_name(&part.name, i, count), hull, origin))
            .collect();
        if !children.is_empty() {
            node["children"] = json!(children);
        }
        self.nodes.push(node);
        self.nodes.len() - 1
    }

    fn collider(&mut self, name: &str, hull: &Hull, origin: [f32; 3]) -> usize {
        let positions = self.numbers.positions(&moved(&hull.positions, origin));
        let triangles = self.numbers.triangles(&hull.triangles);
        self.meshes.push(json!({ "name": name, "primitives": [{
            "attributes": { "POSITION": positions }, "indices": triangles, "material": INVISIBLE
        }] }));
        self.nodes
            .push(json!({ "name": name, "mesh": self.meshes.len() - 1, "extras": { "collider": "convex" } }));
        self.nodes.len() - 1
    }
}

/// Middle of the bottom of the box around a mesh.
fn bottom(mesh: &Mesh) -> [f32; 3] {
    let Some((low, high)) = mesh.extent() else { return [0.0; 3] };
    let middle = |k: usize| (low[k] + high[k]) / 2.0;
    [middle(0), low[1], middle(2)]
}

fn moved(positions: &[[f32; 3]], origin: [f32; 3]) -> Vec<[f32; 3]> {
    positions.iter().map(|p| [0, 1, 2].map(|k| p[k] - origin[k])).collect()
}
