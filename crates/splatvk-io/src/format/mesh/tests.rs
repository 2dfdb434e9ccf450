use super::{MeshFile, MeshFormat, write};
use crate::scene::{Hull, Mesh, MeshPart, to_linear};
use serde_json::{Value, json};
use std::path::Path;

/// Two squares side by side, red and grey, the second with a collider.
fn squares() -> Mesh {
    let mut mesh = Mesh::default();
    for (k, (name, colour)) in
        [("red one", [1.0, 0.0, 0.0]), ("grey", [to_linear(0.5); 3])].into_iter().enumerate()
    {
        let first = mesh.positions.len() as u32;
        let at = k as f32 * 2.0;
        mesh.positions.extend([[at, 1.0, 0.0], [at + 1.0, 1.0, 0.0], [at + 1.0, 2.0, 0.0], [at, 2.0, 0.0]]);
        mesh.normals.extend([[0.0, 0.0, 1.0]; 4]);
        mesh.colours.extend([colour; 4]);
        let from = mesh.triangles.len();
        mesh.triangles.extend([[0, 1, 2], [0, 2, 3]].map(|t| t.map(|v| v + first)));
        let name = name.to_owned();
        mesh.parts.push(MeshPart { name, triangles: from..from + 2, colliders: Vec::new() });
    }
    let hull = Hull {
        positions: vec![[2.0, 1.0, 0.0], [3.0, 1.0, 0.0], [2.0, 2.0, 0.0], [2.0, 1.0, 1.0]],
        triangles: vec![[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]],
    };
    mesh.parts[1].colliders = vec![hull.clone()];
    mesh.parts[0].colliders = vec![hull.clone(), hull];
    mesh
}

fn written(name: &str) -> Vec<u8> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    let extras = json!({ "unit": "metre" });
    let file = MeshFile { name: "kitchen", own_origins: true, extras };
    write(&path, &squares(), MeshFormat::of(&path).unwrap(), &file).unwrap();
    std::fs::read(path).unwrap()
}

#[test]
fn glb_has_named_nodes_below_the_scene() {
    let bytes = written("a.glb");
    assert_eq!(bytes.len() as u32, u32::from_le_bytes(bytes[8..12].try_into().unwrap()));
    let length = u32::from_le_bytes(bytes[12..16].try_into().unwrap()) as usize;
    let root: Value = serde_json::from_slice(&bytes[20..20 + length]).unwrap();
    let nodes = root["nodes"].as_array().unwrap();
    assert_eq!(nodes[0]["name"], "kitchen");
    assert_eq!(nodes[0]["extras"]["unit"], "metre");
    let children = |node: &Value| -> Vec<Value> {
        node["children"]
            .as_array()
            .into_iter()
            .flatten()
            .map(|i| nodes[i.as_u64().unwrap() as usize].clone())
            .collect()
    };
    let parts = children(&nodes[0]);
    let names =
        |nodes: &[Value]| nodes.iter().map(|n| n["name"].as_str().unwrap().to_owned()).collect::<Vec<_>>();
    assert_eq!(names(&parts), ["red one", "grey"]);
    assert_eq!(parts[1]["translation"], json!([2.5, 1.0, 0.0]));
    assert_eq!(names(&children(&parts[0])), ["red one_collider_00", "red one_collider_01"]);
    assert_eq!(names(&children(&parts[1])), ["grey_collider"]);
    let mesh = &root["meshes"][parts[1]["mesh"].as_u64().unwrap() as usize]["primitives"][0];
    let accessor = |name: &str| &root["accessors"][mesh["attributes"][name].as_u64().unwrap() as usize];
    assert_eq!(accessor("POSITION")["min"], json!([-0.5, 0.0, 0.0]));
    let view = &root["bufferViews"][accessor("COLOR_0")["bufferView"].as_u64().unwrap() as usize];
    let at = 20 + length + 8 + view["byteOffset"].as_u64().unwrap() as usize;
    let red = u16::from_le_bytes(bytes[at..at + 2].try_into().unwrap());
    assert!((f32::from(red) / 65535.0 - to_linear(0.5)).abs() < 1e-4, "colours are linear");
    assert_eq!(root["materials"][0]["extensions"]["KHR_materials_unlit"], json!({}));
}

#[test]
fn obj_counts_vertices_through_the_file() {
    let text = String::from_utf8(written("a.OBJ")).unwrap();
    let names: Vec<&str> = text.lines().filter_map(|l| l.strip_prefix("o ")).collect();
    assert_eq!(names, ["red one", "red one_collider_00", "red one_collider_01", "grey", "grey_collider"]);
    let faces: Vec<&str> = text.lines().filter(|l| l.starts_with("f ")).collect();
    assert_eq!((faces[0], faces[2]), ("f 1//1 2//2 3//3", "f 5 7 6"));
    assert_eq!(faces[10], "f 13//5 14//6 15//7");
    assert!(text.contains("v 0 1 0 1.0000 0.0000 0.0000") && text.contains("v 3 2 0 0.5020 0.5020 0.5020"));
}

#[test]
fn ply_has_bytes_of_colour() {
    let bytes = written("a.ply");
    let end = b"end_header\n";
    let at = bytes.windows(end.len()).position(|w| w == end).unwrap() + end.len();
    let head = std::str::from_utf8(&bytes[..at]).unwrap();
    assert!(head.contains("comment faces 2 to 4: grey\nelement vertex 8\n"));
    assert_eq!(bytes.len(), at + 8 * 27 + 4 * 13);
    assert_eq!(bytes[at + 24..at + 27], [255, 0, 0]);
    assert_eq!(bytes[at + 4 * 27 + 24..at + 5 * 27], [128; 3]);
}

#[test]
fn other_endings_are_refused() {
    let error = MeshFormat::of(Path::new("a.stl")).unwrap_err();
    assert!(error.exit_code() == 2 && error.to_string().contains(".glb, .ply or .obj, or give --format"));
}
