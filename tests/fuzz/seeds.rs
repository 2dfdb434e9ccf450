//! Valid files, mostly from the program's own writers.
use super::readers::{Container, Seed};
use exif::experimental::Writer as ExifWriter;
use exif::{Field, In, Tag, Value};
use image::{DynamicImage, ImageEncoder, ImageFormat};
use sha2::{Digest, Sha256};
use splatvk::format::edits::{Combine, Edit, EditList, Operation, Pick, Rows, Term};
use splatvk::format::npy::{self as npy_format, NpyArray};
use splatvk::format::scene_dir::{self, Contents};
use splatvk::format::{
    cameras, colmap as colmap_format, gaussians as files, ply, transforms as transforms_format,
};
use splatvk::photo::{self as photos, Photo};
use splatvk::scene::{
    Camera, Codebook, LanguageField, LevelField, MaskId, PointCloud, Pose, RgbImage, Seen, Splats, World,
};
use std::io::{Cursor, Read, Write};
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};

pub fn file(name: &str, bytes: Vec<u8>) -> Seed {
    Seed { name: name.into(), bytes, damaged: true, container: None }
}

/// A file that others need and that stays intact.
pub fn kept(name: &str, bytes: Vec<u8>) -> Seed {
    Seed { damaged: false, ..file(name, bytes) }
}

fn inside(name: &str, bytes: Vec<u8>, container: Container) -> Seed {
    Seed { container: Some(container), ..file(name, bytes) }
}

/// Files that `write` creates in a folder, by name.
fn made(write: impl FnOnce(&Path)) -> Vec<(String, Vec<u8>)> {
    let folder = tempfile::tempdir().unwrap();
    write(folder.path());
    let (mut open, mut found) = (vec![folder.path().to_path_buf()], Vec::new());
    while let Some(path) = open.pop() {
        if path.is_dir() {
            open.extend(std::fs::read_dir(&path).unwrap().map(|e| e.unwrap().path()));
        } else {
            let name = path.strip_prefix(folder.path()).unwrap().to_string_lossy().into_owned();
            found.push((name, std::fs::read(&path).unwrap()));
        }
    }
    found.sort();
    found
}

fn only(write: impl FnOnce(&Path)) -> Vec<u8> {
    made(|folder| write(&folder.join("a"))).remove(0).1
}

fn splats(n: usize, sh_degree: u32) -> Splats {
    let mut s = Splats { sh_degree, ..Splats::default() };
    for i in 0..n {
        let v = i as f32 * 0.37;
        s.means.push([v, 1.0 - v, 0.5 * v]);
        s.log_scales.push([-2.0, -1.5 - v, -3.0]);
        s.quats.push([1.0, 0.1 * v, -0.2, 0.3]);
        s.opacity_logits.push(v - 1.0);
        s.sh.extend((0..s.sh_len() * 3).map(|k| (k as f32 + v).sin() * 0.5));
    }
    s
}

fn field(n: usize) -> LanguageField {
    let codebook = Codebook {
        embedding_dim: 3,
        code_dim: 2,
        embeddings: vec![1.0, 0.0, 0.0, 0.0, 0.6, 0.8],
        codes: vec![1.0, 0.0, 0.0, 1.0],
        weights: vec![40.0, 60.0],
        members: vec![vec![MaskId::new(0, 0)], vec![MaskId::new(0, 1), MaskId::new(1, 0)]],
        min_chord: 1.4,
    };
    let mut level = LevelField { codebook, reliability: vec![0.5; n], ..LevelField::default() };
    level.set_features((0..n).flat_map(|i| if i % 2 == 0 { [1.0, 0.0] } else { [0.6, 0.8] }).collect());
    let raw = LevelField { mixes: Vec::new(), ..level.clone() };
    LanguageField { levels: vec![level, raw, LevelField::default()], space: "dir:test".into() }
}

fn named(n: &str) -> Camera {
    let pose = Pose::exp(glam::DVec3::new(0.1, 0.2, 0.3), glam::DVec3::new(0.0, 0.4, -0.1));
    Camera { name: n.into(), width: 64, height: 64, fx: 70.5, fy: 70.5, cx: 32.0, cy: 32.0, pose }
}

fn pixels() -> image::RgbImage {
    image::RgbImage::from_fn(64, 64, |x, y| image::Rgb([(x * 4) as u8, (y * 4) as u8, (x * y % 251) as u8]))
}

/// A photo of 64 × 64 pixels.
pub fn photo(stem: &str) -> Photo {
    let data = pixels().pixels().map(|p| p.0.map(|v| f32::from(v) / 255.0)).collect();
    let image = RgbImage { width: 64, height: 64, data };
    photos::from_pixels(format!("{stem}.png").as_ref(), &image, None, 64).unwrap()
}

pub fn gaussians(name: &'static str, degree: u32) -> Vec<Seed> {
    let s = splats(5, degree);
    made(|f| files::write(&f.join(name), &s, None).unwrap()).into_iter().map(|(n, b)| file(&n, b)).collect()
}

pub fn ascii_ply() -> Vec<u8> {
    let names = "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3";
    let properties: String = names.split(' ').map(|n| format!("property float {n}\n")).collect();
    let row = "0.1 0.2 3 0.5 0.4 -0.3 1.5 -2 -2.5 -3 1 0 0 0\n";
    format!("ply\nformat ascii 1.0\nelement vertex 4\n{properties}end_header\n{}", row.repeat(4)).into_bytes()
}

fn cloud() -> PointCloud {
    let n = 6;
    PointCloud {
        positions: (0..n).map(|i| [i as f32, 0.5, 2.0]).collect(),
        colours: vec![[0.2, 0.4, 0.6]; n],
        confidence: vec![1.0; n],
        view: vec![0; n],
        radius: vec![0.0; n],
        normals: Vec::new(),
    }
}

pub fn points() -> Vec<u8> {
    only(|f| ply::write_points(f, &cloud()).unwrap())
}

/// Version 3 of .spz, in gzip.
pub fn gzip(name: &str) -> Seed {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/formats/minimal-v3.spz");
    inside(name, std::fs::read(path).unwrap(), |bytes, change| {
        let mut plain = Vec::new();
        flate2::read::GzDecoder::new(bytes).read_to_end(&mut plain).unwrap();
        let mut out = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
        out.write_all(&change(&plain)).unwrap();
        out.finish().unwrap()
    })
}

/// Members of an archive by name.
fn members(bytes: &[u8]) -> Vec<(String, Vec<u8>)> {
    let mut archive = zip::ZipArchive::new(Cursor::new(bytes)).unwrap();
    (0..archive.len())
        .map(|k| {
            let mut member = archive.by_index(k).unwrap();
            let mut bytes = Vec::new();
            member.read_to_end(&mut bytes).unwrap();
            (member.name().unwrap().to_string(), bytes)
        })
        .collect()
}

/// Damages meta.json inside of the archive.
pub fn sog(name: &'static str) -> Vec<Seed> {
    let container: Container = |bytes, change| {
        let mut out = zip::ZipWriter::new(Cursor::new(Vec::new()));
        let options = zip::write::SimpleFileOptions::default();
        for (name, content) in members(bytes) {
            out.start_file(&name, options).unwrap();
            let content = if name == "meta.json" { change(&content) } else { content };
            out.write_all(&content).unwrap();
        }
        out.finish().unwrap().into_inner()
    };
    gaussians(name, 1).into_iter().map(|s| Seed { container: Some(container), ..s }).collect()
}

/// A .sog as files of a folder, all of which are damaged.
pub fn sog_folder() -> Vec<Seed> {
    members(&gaussians("a.sog", 2)[0].bytes).into_iter().map(|(name, bytes)| file(&name, bytes)).collect()
}

/// Damages the JSON document, with corrected lengths.
pub fn glb(name: &'static str) -> Vec<Seed> {
    let container: Container = |bytes, change| {
        let length = u32::from_le_bytes(bytes[12..16].try_into().unwrap()) as usize;
        let text = change(&bytes[20..20 + length]);
        let total = bytes.len() - length + text.len();
        let words = [total as u32, text.len() as u32].map(u32::to_le_bytes);
        [&bytes[..8], &words[0], &words[1], &bytes[16..20], &text, &bytes[20 + length..]].concat()
    };
    gaussians(name, 1).into_iter().map(|s| Seed { container: Some(container), ..s }).collect()
}

/// With the buffer in a file beside it.
pub fn gltf() -> Vec<Seed> {
    let glb = gaussians("a.glb", 1).remove(0).bytes;
    let length = u32::from_le_bytes(glb[12..16].try_into().unwrap()) as usize;
    let mut root: serde_json::Value = serde_json::from_slice(&glb[20..20 + length]).unwrap();
    root["buffers"][0]["uri"] = "a.bin".into();
    // A second node with the same mesh.
    root["nodes"] =
        serde_json::json!([{ "mesh": 0, "children": [1] }, { "mesh": 0, "translation": [1, 2, 3] }]);
    vec![file("a.gltf", root.to_string().into_bytes()), file("a.bin", glb[28 + length..].to_vec())]
}

/// Damages one member of an archive after the other.
const MEMBERS: Container = |bytes, change| {
    static TURN: AtomicUsize = AtomicUsize::new(0);
    let mut archive = zip::ZipArchive::new(Cursor::new(bytes)).unwrap();
    let turn = TURN.fetch_add(1, Relaxed) % archive.len();
    let mut out = zip::ZipWriter::new(Cursor::new(Vec::new()));
    for k in 0..archive.len() {
        let mut member = archive.by_index(k).unwrap();
        let mut content = Vec::new();
        member.read_to_end(&mut content).unwrap();
        out.start_file(member.name().unwrap().to_string(), zip::write::SimpleFileOptions::default()).unwrap();
        out.write_all(&if k == turn { change(&content) } else { content }).unwrap();
    }
    out.finish().unwrap().into_inner()
};

/// Language data of splats, beside their file.
pub fn language() -> Vec<Seed> {
    let (s, field) = (splats(6, 0), field(6));
    let seeds = made(|f| files::write(&f.join("a.splat"), &s, Some(&field)).unwrap()).into_iter();
    seeds.map(|(n, b)| if n.ends_with("npz") { inside(&n, b, MEMBERS) } else { kept(&n, b) }).collect()
}

pub fn colmap(binary: bool) -> Vec<Seed> {
    let list = [named("a.png"), named("b.png")];
    let write = if binary { colmap_format::write_binary } else { colmap_format::write };
    made(|f| write(f, &list, Some(&cloud())).unwrap()).into_iter().map(|(n, b)| file(&n, b)).collect()
}

pub fn transforms() -> Seed {
    let list = [named("a.png"), named("b.png")];
    file("a.json", only(|f| transforms_format::write(f, &list, None).unwrap()))
}

pub fn cameras_json() -> Seed {
    file("a.json", only(|f| cameras::write_json(f, &[named("a.png"), named("b.png")]).unwrap()))
}

pub fn npy(name: &str) -> Seed {
    file(name, npy_format::encode(&NpyArray::f32(&[3, 4], (0..12).map(|v| v as f32).collect())).unwrap())
}

pub fn npz(name: &str) -> Seed {
    let (a, b) = (NpyArray::f32(&[3], vec![1.0, 2.0, 3.0]), NpyArray::f32(&[3], vec![0.0, 1.0, 0.0]));
    let bytes = only(|f| npy_format::write_packed_npz(f, &[("mug", &a), ("plate", &b)]).unwrap());
    inside(name, bytes, MEMBERS)
}

pub fn depth(name: &str) -> Seed {
    file(name, npy_format::encode(&NpyArray::f32(&[64, 64], vec![2.0; 64 * 64])).unwrap())
}

fn scene_files() -> Vec<(String, Vec<u8>)> {
    let (s, field, photos) = (splats(6, 1), field(6), [photo("a"), photo("b")]);
    let contents = Contents {
        splats: &s,
        seen: &Seen { pixels: vec![3.0; 6] },
        backdrop: &Default::default(),
        holes: &Splats::default(),
        cameras: &[named("a.png"), named("b.png")],
        world: &World::default(),
        photos: &photos,
        points: None,
        language: Some(&field),
        text_embeddings: None,
    };
    made(|f| {
        scene_dir::write(f, &contents).unwrap();
        let scene = scene_dir::load(f).unwrap();
        let pick = Pick::Word { text: "a mug".into(), grow: 0.0 };
        let selection = vec![Term { combine: Combine::Add, pick }];
        let (before, mut list) = (EditList::new(&s), EditList::new(&s));
        list.push(Edit { operation: Operation::Delete {}, selection, splats: Rows::of([1, 4]) });
        list.replace(&before, &scene).unwrap();
    })
}

/// A scene directory; every file that is loaded is damaged.
pub fn scene() -> Vec<Seed> {
    let plain = ["scene.json", "point_cloud.ply", "seen.npy", "edits.json", "cameras/transforms.json"];
    scene_files()
        .into_iter()
        .filter_map(|(n, b)| match &*n {
            n if plain.contains(&n) => Some(file(n, b)),
            n if n.ends_with(".npz") => Some(inside(n, b, MEMBERS)),
            _ => None,
        })
        .collect()
}

pub fn scene_photos() -> Vec<Seed> {
    let all = scene_files().into_iter();
    all.filter(|(n, _)| n == "cameras/photos.json" || n.starts_with("cameras/images/"))
        .map(|(n, b)| if n.ends_with("json") { file(&n, b) } else { inside(&n, b, CHUNKS) })
        .collect()
}

pub fn run_json() -> Seed {
    let plan = serde_json::json!({ "method": "lift", "queries": ["a mug"], "feature_dim": 16 });
    file("run.json", serde_json::json!({ "config": { "plan": plan } }).to_string().into_bytes())
}

/// A checkpoint after its checksum.
pub fn checkpoint(name: &str) -> Seed {
    let body = postcard::to_stdvec(&(splats(4, 1), field(4))).unwrap();
    inside(name, with_checksum(&body), |bytes, change| {
        let body = change(&bytes[64..]);
        let sum: String = Sha256::digest(&body).iter().map(|b| format!("{b:02x}")).collect();
        [sum.as_bytes(), &body].concat()
    })
}

fn with_checksum(body: &[u8]) -> Vec<u8> {
    let sum: String = Sha256::digest(body).iter().map(|b| format!("{b:02x}")).collect();
    [sum.as_bytes(), body].concat()
}

pub fn adapter() -> Seed {
    let text = "family = \"mine\"\n[[graph]]\npart = \"depth\"\nneeds = [\"inverse_depth\"]\n\
                names.image = [\"pixels\", \"x\"]\nnames.inverse_depth = \"y\"\nlayouts.image = \"B 3 H W\"\n\
                apply.inverse_depth = \"exp\"\nimage = { mean = [0.5, 0.5, 0.5], std = [0.5, 0.5, 0.5], size = 518, \
                multiple = 14, fit = \"resize\" }\n[sha256]\n\"m.onnx\" = \"00\"\n";
    file("adapter.toml", text.into())
}

/// A graph of one input and one output, by the field numbers of the published onnx.proto3.
pub fn onnx() -> Vec<u8> {
    fn bytes(field: u8, data: &[u8]) -> Vec<u8> {
        [&[field << 3 | 2, data.len() as u8], data].concat()
    }
    let port = |name: &str, dims: &[u8]| {
        let axes: Vec<u8> = dims
            .iter()
            .flat_map(|d| if *d == 0 { bytes(1, &bytes(2, b"n")) } else { bytes(1, &[8, *d]) })
            .collect();
        let tensor = [&[8, 1][..], &bytes(2, &axes)].concat();
        [bytes(1, name.as_bytes()), bytes(2, &bytes(1, &tensor))].concat()
    };
    let weight = [&[8, 2, 8, 2, 16, 1][..], &bytes(8, b"w"), &bytes(9, &[0; 16])].concat();
    let place = [bytes(1, b"location"), bytes(2, b"w.bin")].concat();
    let outside = [&[8, 4, 16, 1][..], &bytes(8, b"v"), &bytes(13, &place)].concat();
    let graph = [
        bytes(2, b"g"),
        bytes(5, &weight),
        bytes(5, &outside),
        bytes(11, &port("x", &[1, 3, 0, 0])),
        bytes(12, &port("y", &[1, 0, 0])),
    ];
    let opset = [bytes(1, b""), vec![16, 17]].concat();
    let graph = graph.concat();
    // Two bytes of length: the graph has more than 127 bytes.
    let length = [graph.len() as u8 & 0x7f | 0x80, (graph.len() >> 7) as u8];
    [&[8, 8, 7 << 3 | 2][..], &length, &graph, &bytes(8, &opset)].concat()
}

/// Masks and features of two photos.
pub fn masks() -> Vec<Seed> {
    let labels: Vec<f32> = (0..3 * 64 * 64).map(|p| if p % 64 < 32 { 0.0 } else { 1.0 }).collect();
    let labels = npy_format::encode(&NpyArray::f32(&[3, 64, 64], labels)).unwrap();
    let rows = npy_format::encode(&NpyArray::f32(&[2, 3], vec![1.0, 0.0, 0.0, 0.0, 0.6, 0.8])).unwrap();
    ["a", "b"]
        .iter()
        .flat_map(|s| [(format!("{s}_s.npy"), labels.clone()), (format!("{s}_f.npy"), rows.clone())])
        .map(|(n, b)| file(&n, b))
        .collect()
}

fn label_png(values: impl Fn(u32, u32) -> u8) -> Vec<u8> {
    let mut out = Vec::new();
    let grey = image::GrayImage::from_fn(16, 16, |x, y| image::Luma([values(x, y)]));
    let encoder = image::codecs::png::PngEncoder::new(&mut out);
    encoder.write_image(&grey, 16, 16, image::ExtendedColorType::L8).unwrap();
    out
}

pub fn ground_truth() -> Vec<Seed> {
    let frame = serde_json::json!({
        "file": "images/a.png", "split": "train", "fx": 70.0, "fy": 70.0, "cx": 8.0, "cy": 8.0,
        "world_to_camera": [[1, 0, 0, 0.5], [0, 1, 0, 0], [0, 0, 1, 2], [0, 0, 0, 1]],
    });
    let truth = serde_json::json!({ "width": 16, "height": 16, "labels": { "1": "mug" }, "frames": [frame] });
    let depth = NpyArray::f32(&[16, 16], vec![1.5; 256]);
    vec![
        file("ground_truth.json", truth.to_string().into_bytes()),
        inside("masks/a.png", label_png(|x, _| u8::from(x > 7)), CHUNKS),
        inside("depth/a.npz", only(|f| npy_format::write_npz(f, &[("depth", &depth)]).unwrap()), MEMBERS),
    ]
}

pub fn lerf() -> Seed {
    let object = serde_json::json!({
        "category": "mug", "segmentation": [[2.0, 2.0], [12.5, 3.0], [8.0, 14.0]], "bbox": [2, 2, 12, 14]
    });
    let labels = serde_json::json!({ "info": { "width": 16, "height": 16 }, "objects": [object] });
    file("frame_1.json", labels.to_string().into_bytes())
}

pub fn ovs() -> Vec<Seed> {
    vec![
        file("segmentations/classes.txt", b"mug\nplate\n".to_vec()),
        inside("segmentations/00/mug.png", label_png(|x, y| if x > y { 255 } else { 0 }), CHUNKS),
    ]
}

pub fn scannet() -> Vec<Seed> {
    let table = "id\traw_category\tnyu40id\n1\twall\t1\n2\tchair\t5\n".as_bytes().to_vec();
    let matrix = |f: f64, c: f64| format!("{f} 0 {c} 0\n0 {f} {c} 0\n0 0 1 0\n0 0 0 1\n").into_bytes();
    vec![
        inside("label-filt/0.png", label_png(|x, _| u8::from(x > 3)), CHUNKS),
        file("scannetv2-labels.combined.tsv", table),
        file("intrinsic/intrinsic_color.txt", matrix(70.0, 8.0)),
        file("pose/0.txt", matrix(1.0, 0.0)),
        kept("color/0.png", label_png(|x, _| x as u8)),
    ]
}

/// Types and contents of the chunks of a PNG.
fn chunks(bytes: &[u8]) -> Vec<([u8; 4], Vec<u8>)> {
    let (mut at, mut all) = (8, Vec::new());
    while let Some(length) = bytes.get(at..at + 4) {
        let length = u32::from_be_bytes(length.try_into().unwrap()) as usize;
        all.push((bytes[at + 4..at + 8].try_into().unwrap(), bytes[at + 8..at + 8 + length].to_vec()));
        at += 12 + length;
    }
    all
}

/// A PNG of chunks, with correct lengths and checksums.
fn png_of(chunks: &[([u8; 4], Vec<u8>)]) -> Vec<u8> {
    let mut out = b"\x89PNG\r\n\x1a\n".to_vec();
    for (kind, content) in chunks {
        let mut sum = flate2::Crc::new();
        sum.update(kind);
        sum.update(content);
        out.extend((content.len() as u32).to_be_bytes());
        out.extend(kind);
        out.extend(content);
        out.extend(sum.sum().to_be_bytes());
    }
    out
}

/// Damages one chunk of a PNG after the other, with correct checksums.
const CHUNKS: Container = |bytes, change| {
    static TURN: AtomicUsize = AtomicUsize::new(0);
    let mut all = chunks(bytes);
    let turn = TURN.fetch_add(1, Relaxed) % all.len();
    all[turn].1 = change(&all[turn].1);
    png_of(&all)
};

/// Like [`CHUNKS`], and with missing, repeated, resized and moved chunks.
const ORDER: Container = |bytes, change| {
    static TURN: AtomicUsize = AtomicUsize::new(0);
    let mut all = chunks(bytes);
    let (turn, n) = (TURN.fetch_add(1, Relaxed), all.len());
    let (k, place) = (turn % n, turn / n % n);
    match turn / (n * n) % 6 {
        0 => drop(all.remove(k)),
        1 => all.insert(place, all[k].clone()),
        2 => all.swap(k, place),
        3 => all[k].1.resize(turn / n % 800, 7),
        _ => all[k].1 = change(&all[k].1),
    }
    png_of(&all)
};

fn deflated(bytes: &[u8]) -> Vec<u8> {
    let mut out = flate2::write::ZlibEncoder::new(Vec::new(), flate2::Compression::fast());
    out.write_all(bytes).unwrap();
    out.finish().unwrap()
}

/// A PNG with a palette and a chunk of every type that is read.
pub fn indexed(name: &str) -> Seed {
    let packet =
        b"<x xmlns:G=\"http://ns.google.com/photos/1.0/panorama/\" G:ProjectionType=\"rectilinear\"/>";
    let rows: Vec<u8> =
        (0..64u8).flat_map(|y| std::iter::once(0).chain((0..64).map(move |x| (x * 3) ^ y))).collect();
    let numbers = |v: &[u32]| v.iter().flat_map(|v| v.to_be_bytes()).collect::<Vec<u8>>();
    let chunk = |kind: &[u8; 4], content: Vec<u8>| (*kind, content);
    let all = [
        chunk(b"IHDR", [numbers(&[64, 64]), vec![8, 3, 0, 0, 0]].concat()),
        chunk(b"cICP", vec![12, 13, 0, 1]),
        chunk(b"iCCP", [&b"p3\0\0"[..], &deflated(&icc_profile())].concat()),
        chunk(b"gAMA", numbers(&[45_455])),
        chunk(b"cHRM", numbers(&[31_270, 32_900, 64_000, 33_000, 30_000, 60_000, 15_000, 6_000])),
        chunk(b"PLTE", (0..768).map(|k| (k * 7 % 256) as u8).collect()),
        chunk(b"tRNS", (0..=255).map(|k| 255 - k / 4).collect()),
        chunk(b"eXIf", exif_block()),
        chunk(b"iTXt", [&b"XML:com.adobe.xmp\0\x01\0\0\0"[..], &deflated(packet)].concat()),
        chunk(b"zTXt", [&b"a\0\0"[..], &deflated(b"text")].concat()),
        chunk(b"IDAT", deflated(&rows)),
        chunk(b"IEND", Vec::new()),
    ];
    inside(name, png_of(&all), ORDER)
}

/// A photo in the format of its name.
pub fn picture(name: &str) -> Seed {
    let mut out = Cursor::new(Vec::new());
    let image = DynamicImage::from(pixels());
    match name {
        "a.png" => return inside(name, png_with(Some(exif_block()), None), CHUNKS),
        "a.jpg" => {
            let mut encoder = image::codecs::jpeg::JpegEncoder::new_with_quality(&mut out, 80);
            encoder.set_exif_metadata(exif_block()).unwrap();
            encoder.encode_image(&image).unwrap();
        }
        "a.exr" => image.to_rgba32f().write_to(&mut out, ImageFormat::OpenExr).unwrap(),
        "a.hdr" => DynamicImage::from(image.to_rgb32f()).write_to(&mut out, ImageFormat::Hdr).unwrap(),
        "a.webp" => image.write_to(&mut out, ImageFormat::WebP).unwrap(),
        _ => image.write_to(&mut out, ImageFormat::Tiff).unwrap(),
    }
    file(name, out.into_inner())
}

fn png_with(exif: Option<Vec<u8>>, icc: Option<Vec<u8>>) -> Vec<u8> {
    let mut out = Vec::new();
    let mut encoder = image::codecs::png::PngEncoder::new(&mut out);
    if let Some(block) = exif {
        encoder.set_exif_metadata(block).unwrap();
    }
    if let Some(profile) = icc {
        encoder.set_icc_profile(profile).unwrap();
    }
    encoder.write_image(&pixels(), 64, 64, image::ExtendedColorType::Rgb8).unwrap();
    out
}

fn exif_block() -> Vec<u8> {
    let mut note = b"Apple iOS\0\0\x01MM".to_vec();
    note.extend([2u16, 1, 9, 0, 1, 0, 4, 8, 10, 0, 3, 0, 44, 0, 0].iter().flat_map(|v| v.to_be_bytes()));
    note.extend([0, 1000, -1000, 1000, 0, 1000].iter().flat_map(|v: &i32| v.to_be_bytes()));
    let fields = [
        (Tag::Orientation, Value::Short(vec![6])),
        (Tag::FocalLengthIn35mmFilm, Value::Short(vec![26])),
        (Tag::Make, Value::Ascii(vec![b"Acme".to_vec()])),
        (Tag::LensModel, Value::Ascii(vec![b"wide".to_vec()])),
        (Tag::MakerNote, Value::Undefined(note, 0)),
    ];
    let fields = fields.map(|(tag, value)| Field { tag, ifd_num: In::PRIMARY, value });
    let mut writer = ExifWriter::new();
    fields.iter().for_each(|f| writer.push_field(f));
    let mut bytes = Cursor::new(Vec::new());
    writer.write(&mut bytes, false).unwrap();
    bytes.into_inner()
}

/// Damages the tags of a photo, not the photo.
pub fn exif(name: &str) -> Seed {
    inside(name, png_with(Some(exif_block()), None), |_, change| png_with(Some(change(&exif_block())), None))
}

fn icc_profile() -> Vec<u8> {
    moxcms::ColorProfile::new_display_p3().encode().unwrap()
}

/// Damages the ICC profile of a photo.
pub fn icc(name: &str) -> Seed {
    inside(name, png_with(None, Some(icc_profile())), |_, change| {
        png_with(None, Some(change(&icc_profile())))
    })
}
