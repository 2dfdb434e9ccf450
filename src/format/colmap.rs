//! COLMAP models, text and binary. World → camera, OpenCV axes, first pixel centre at 0.5.
use crate::scene::{Camera, Lens, PointCloud, Pose};
use crate::{Error, Result, files};
use glam::{DMat3, DQuat, DVec3};
use std::collections::HashMap;
use std::fmt::Write as _;
use std::path::Path;

/// True for a folder that holds a text or binary model.
pub fn is_model(folder: &Path) -> bool {
    ["txt", "bin"]
        .iter()
        .any(|e| ["cameras", "images"].iter().all(|n| folder.join(format!("{n}.{e}")).is_file()))
}

/// Files of a model as text and of one in binary, in the order in which those of the other form go: a model is read as text as
/// long as its images are there as text.
pub const FILES: [[&str; 3]; 2] =
    [["images.txt", "cameras.txt", "points3D.txt"], ["images.bin", "cameras.bin", "points3D.bin"]];

/// Model names in the order of COLMAP's numbers, with the number of parameters and how many of them are f, c.
const MODELS: [(&str, usize); 5] =
    [("SIMPLE_PINHOLE", 3), ("PINHOLE", 4), ("SIMPLE_RADIAL", 4), ("RADIAL", 5), ("OPENCV", 8)];

#[derive(Clone, Copy)]
struct Intrinsics {
    size: (u32, u32),
    f: [f64; 2],
    c: [f64; 2],
}

fn intrinsics(model: usize, size: (u32, u32), p: &[f64]) -> Result<Intrinsics, String> {
    let (name, _) = MODELS[model];
    let (f, c, distortion) = match (model, p) {
        (0 | 2 | 3, [f, cx, cy, rest @ ..]) => ([*f; 2], [*cx, *cy], rest),
        (_, [fx, fy, cx, cy, rest @ ..]) => ([*fx, *fy], [*cx, *cy], rest),
        _ => return Err(format!("camera model {name} with {} parameters", p.len())),
    };
    match distortion.iter().find(|k| **k != 0.0) {
        Some(k) => Err(format!(
            "{name} camera with lens distortion {k}: undistort the photos first (colmap image_undistorter)"
        )),
        None => Ok(Intrinsics { size, f, c }),
    }
}

fn unknown_model(model: impl std::fmt::Display) -> String {
    format!("camera model {model} is not supported; undistort to PINHOLE (colmap image_undistorter)")
}

/// Reads the cameras of a model folder, in the order of its image numbers.
pub fn read(folder: &Path) -> Result<Vec<Camera>> {
    let text = folder.join("images.txt").is_file();
    let ext = if text { "txt" } else { "bin" };
    let (cameras, images) = (folder.join(format!("cameras.{ext}")), folder.join(format!("images.{ext}")));
    let named = |p: &Path| {
        let p = p.display().to_string();
        move |e: String| Error::input(format!("{p}: {e}"))
    };
    let (camera_bytes, image_bytes) = (files::read(&cameras)?, files::read(&images)?);
    let (intrinsics, mut shots) = if text {
        (
            text_cameras(&camera_bytes).map_err(named(&cameras))?,
            text_images(&image_bytes).map_err(named(&images))?,
        )
    } else {
        (
            binary_cameras(&camera_bytes).map_err(named(&cameras))?,
            binary_images(&image_bytes).map_err(named(&images))?,
        )
    };
    shots.sort_by_key(|s| s.id);
    let out: Result<Vec<Camera>, String> = shots
        .into_iter()
        .map(|s| {
            let k = intrinsics
                .get(&s.camera)
                .ok_or_else(|| format!("image {:?} names camera {}, which is missing", s.name, s.camera))?;
            let rotation = DMat3::from_quat(DQuat::from_xyzw(s.q[1], s.q[2], s.q[3], s.q[0]).normalize());
            let pose = Pose { rotation, translation: DVec3::from_array(s.t) };
            let (width, height) = k.size;
            Camera { name: s.name, width, height, fx: k.f[0], fy: k.f[1], cx: k.c[0], cy: k.c[1], pose }
                .checked()
        })
        .collect();
    let out = out.map_err(named(&images))?;
    if out.is_empty() { Err(named(&images)("the model has no images".into())) } else { Ok(out) }
}

struct Shot {
    id: u32,
    q: [f64; 4],
    t: [f64; 3],
    camera: u32,
    name: String,
}

fn number<T: std::str::FromStr>(word: Option<&str>, line: usize) -> Result<T, String> {
    word.and_then(|w| w.parse().ok())
        .ok_or_else(|| format!("line {line}: {:?} is not a number", word.unwrap_or("")))
}

fn text_cameras(bytes: &[u8]) -> Result<HashMap<u32, Intrinsics>, String> {
    let text = String::from_utf8_lossy(bytes);
    let mut out = HashMap::new();
    for (i, line) in text.lines().enumerate().filter(|(_, l)| !l.starts_with('#') && !l.trim().is_empty()) {
        let mut words = line.split_whitespace();
        let id = number(words.next(), i + 1)?;
        let model = words.next().unwrap_or("");
        let model = MODELS.iter().position(|m| m.0 == model).ok_or_else(|| unknown_model(model))?;
        let size = (number(words.next(), i + 1)?, number(words.next(), i + 1)?);
        let p: Vec<f64> = words.map(|w| number(Some(w), i + 1)).collect::<Result<_, _>>()?;
        if p.len() != MODELS[model].1 {
            return Err(format!("line {}: {} needs {} parameters", i + 1, MODELS[model].0, MODELS[model].1));
        }
        out.insert(id, intrinsics(model, size, &p)?);
    }
    Ok(out)
}

/// Whether a line is the 2D points of the image before it, numbers in threes; an image has nine and a name.
fn is_points(line: &str) -> bool {
    let words = line.split_whitespace();
    words.clone().count().is_multiple_of(3) && words.into_iter().all(|w| w.parse::<f64>().is_ok())
}

fn text_images(bytes: &[u8]) -> Result<Vec<Shot>, String> {
    let text = String::from_utf8_lossy(bytes);
    // Two lines an image; the second (2D points) is often empty, and some programs leave it out.
    let mut out = Vec::new();
    let mut points_may_follow = false;
    for (i, line) in text.lines().enumerate().filter(|(_, l)| !l.starts_with('#')) {
        if std::mem::take(&mut points_may_follow) && is_points(line) || line.trim().is_empty() {
            continue;
        }
        let mut words = line.splitn(10, ' ');
        let id = number(words.next(), i + 1)?;
        let mut seven = [0.0; 7];
        for v in &mut seven {
            *v = number(words.next(), i + 1)?;
        }
        let [qw, qx, qy, qz, x, y, z] = seven;
        let camera = number(words.next(), i + 1)?;
        let name = words.next().unwrap_or("").trim_end().to_string();
        if name.is_empty() {
            return Err(format!("line {}: the name of the image is missing", i + 1));
        }
        out.push(Shot { id, q: [qw, qx, qy, qz], t: [x, y, z], camera, name });
        points_may_follow = true;
    }
    Ok(out)
}

/// Little-endian cursor over a file that may lie about its counts.
struct Bytes<'a>(&'a [u8]);

impl<'a> Bytes<'a> {
    fn take(&mut self, n: usize) -> Result<&'a [u8], String> {
        if n > self.0.len() {
            return Err("the file ends early; copy it again".into());
        }
        let (head, tail) = self.0.split_at(n);
        self.0 = tail;
        Ok(head)
    }
    fn array<const N: usize>(&mut self) -> Result<[u8; N], String> {
        let mut out = [0; N];
        out.copy_from_slice(self.take(N)?);
        Ok(out)
    }
    fn u32(&mut self) -> Result<u32, String> {
        Ok(u32::from_le_bytes(self.array()?))
    }
    fn u64(&mut self) -> Result<u64, String> {
        Ok(u64::from_le_bytes(self.array()?))
    }
    fn f64s<const N: usize>(&mut self) -> Result<[f64; N], String> {
        let mut out = [0.0; N];
        for v in &mut out {
            *v = f64::from_le_bytes(self.array()?);
        }
        Ok(out)
    }
    fn text(&mut self) -> Result<String, String> {
        let end = self.0.iter().position(|b| *b == 0).ok_or("a name has no end")?;
        let name = String::from_utf8_lossy(self.take(end)?).into_owned();
        self.take(1)?;
        Ok(name)
    }
}

fn binary_cameras(bytes: &[u8]) -> Result<HashMap<u32, Intrinsics>, String> {
    let mut b = Bytes(bytes);
    let mut out = HashMap::new();
    for _ in 0..b.u64()? {
        let (id, model) = (b.u32()?, b.u32()? as usize);
        let side = |n: u64| u32::try_from(n).map_err(|_| format!("camera {id} has a side of {n} pixels"));
        let size = (side(b.u64()?)?, side(b.u64()?)?);
        let count = MODELS.get(model).ok_or_else(|| unknown_model(model))?.1;
        let p: Vec<f64> = (0..count).map(|_| b.f64s::<1>().map(|v| v[0])).collect::<Result<_, _>>()?;
        out.insert(id, intrinsics(model, size, &p)?);
    }
    Ok(out)
}

fn binary_images(bytes: &[u8]) -> Result<Vec<Shot>, String> {
    let mut b = Bytes(bytes);
    let mut out = Vec::new();
    for _ in 0..b.u64()? {
        let (id, q, t, camera, name) = (b.u32()?, b.f64s()?, b.f64s()?, b.u32()?, b.text()?);
        let points = b.u64()?;
        b.take(usize::try_from(points).unwrap_or(usize::MAX).saturating_mul(24))?;
        out.push(Shot { id, q, t, camera, name });
    }
    Ok(out)
}

/// Reads `points3D.txt` or `points3D.bin` of a model folder; confidence 1, radius 0.
pub fn read_points(folder: &Path) -> Result<PointCloud> {
    let (text, binary) = (folder.join("points3D.txt"), folder.join("points3D.bin"));
    let path = if text.is_file() { text.clone() } else { binary };
    let bytes = files::read(&path)?;
    let points = if path == text { text_points(&bytes) } else { binary_points(&bytes) };
    let points = points.map_err(|e| Error::input(format!("{}: {e}", path.display())))?;
    let n = points.len();
    let (positions, colours) = points.into_iter().unzip();
    Ok(PointCloud { positions, colours, confidence: vec![1.0; n], view: vec![0; n], radius: vec![0.0; n] })
}

type Point = ([f32; 3], [f32; 3]);

fn text_points(bytes: &[u8]) -> Result<Vec<Point>, String> {
    let text = String::from_utf8_lossy(bytes);
    let lines = text.lines().enumerate().filter(|(_, l)| !l.starts_with('#') && !l.trim().is_empty());
    lines
        .map(|(i, line)| {
            let mut words = line.split_whitespace().skip(1);
            let mut six = [0.0f32; 6];
            for v in &mut six {
                *v = number(words.next(), i + 1)?;
            }
            Ok(([six[0], six[1], six[2]], [six[3], six[4], six[5]].map(|v| v / 255.0)))
        })
        .collect()
}

fn binary_points(bytes: &[u8]) -> Result<Vec<Point>, String> {
    let mut b = Bytes(bytes);
    let mut out = Vec::new();
    for _ in 0..b.u64()? {
        b.u64()?;
        let position = b.f64s::<3>()?.map(|v| v as f32);
        let colour = b.array::<3>()?.map(|v| v as f32 / 255.0);
        b.f64s::<1>()?;
        let track = b.u64()?;
        b.take(usize::try_from(track).unwrap_or(usize::MAX).saturating_mul(8))?;
        out.push((position, colour));
    }
    Ok(out)
}

/// Most points that `points3D.txt` gets: other tools only start from them, and text takes 70 bytes a point.
const MAX_POINTS: usize = 100_000;

/// Writes a text model with PINHOLE cameras. Rust prints the shortest digits that read back exactly.
pub fn write(folder: &Path, cameras: &[Camera], points: Option<&PointCloud>) -> Result<()> {
    write_text(folder, cameras, None, points)
}

/// Writes a text model of photos as they were taken, with OPENCV cameras: one lens per camera.
pub fn write_lensed(folder: &Path, cameras: &[Camera], lenses: &[Lens]) -> Result<()> {
    write_text(folder, cameras, Some(lenses), None)
}

fn write_text(
    folder: &Path,
    cameras: &[Camera],
    lenses: Option<&[Lens]>,
    points: Option<&PointCloud>,
) -> Result<()> {
    std::fs::create_dir_all(folder).map_err(Error::unwritable(folder))?;
    let mut intrinsics = String::from("# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]\n");
    let mut images =
        String::from("# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME\n# POINTS2D[] as (X, Y, POINT3D_ID)\n");
    for (i, c) in cameras.iter().enumerate() {
        let id = i + 1;
        // Writing to a String cannot fail.
        let pinhole = format!("{} {} {} {} {} {}", c.width, c.height, c.fx, c.fy, c.cx, c.cy);
        let _ = match lenses.and_then(|l| l.get(i)) {
            Some(Lens { k1, k2 }) => writeln!(intrinsics, "{id} OPENCV {pinhole} {k1} {k2} 0 0"),
            None => writeln!(intrinsics, "{id} PINHOLE {pinhole}"),
        };
        let q = DQuat::from_mat3(&c.pose.rotation).normalize();
        let t = c.pose.translation;
        let _ = writeln!(
            images,
            "{id} {} {} {} {} {} {} {} {id} {}\n",
            q.w, q.x, q.y, q.z, t.x, t.y, t.z, c.name
        );
    }
    let mut cloud = String::from("# POINT3D_ID X Y Z R G B ERROR TRACK[] as (IMAGE_ID, POINT2D_IDX)\n");
    if let Some(p) = points {
        let stride = p.len().div_ceil(MAX_POINTS).max(1);
        for (id, i) in (0..p.len()).step_by(stride).enumerate() {
            let ([x, y, z], [r, g, b]) = (p.positions[i], p.colours[i].map(super::to_byte));
            let _ = writeln!(cloud, "{} {x} {y} {z} {r} {g} {b} 0", id + 1);
        }
    }
    for (name, text) in [("cameras.txt", intrinsics), ("images.txt", images), ("points3D.txt", cloud)] {
        let path = folder.join(name);
        std::fs::write(&path, text).map_err(Error::unwritable(&path))?;
    }
    Ok(())
}

/// Writes a binary model with PINHOLE cameras, and all points: only text needs many bytes for them.
pub fn write_binary(folder: &Path, cameras: &[Camera], points: Option<&PointCloud>) -> Result<()> {
    std::fs::create_dir_all(folder).map_err(Error::unwritable(folder))?;
    let count = |n: usize| (n as u64).to_le_bytes();
    let mut intrinsics = count(cameras.len()).to_vec();
    let mut images = intrinsics.clone();
    for (id, c) in (1u32..).zip(cameras) {
        let q = DQuat::from_mat3(&c.pose.rotation).normalize();
        let t = c.pose.translation;
        intrinsics.extend([id, 1].iter().flat_map(|v| v.to_le_bytes()));
        intrinsics.extend([c.width, c.height].iter().flat_map(|v| u64::from(*v).to_le_bytes()));
        intrinsics.extend([c.fx, c.fy, c.cx, c.cy].iter().flat_map(|v| v.to_le_bytes()));
        images.extend(id.to_le_bytes());
        images.extend([q.w, q.x, q.y, q.z, t.x, t.y, t.z].iter().flat_map(|v| v.to_le_bytes()));
        images.extend(id.to_le_bytes());
        images.extend(c.name.bytes().filter(|b| *b != 0).chain([0]));
        images.extend(count(0));
    }
    let mut cloud = count(points.map_or(0, PointCloud::len)).to_vec();
    for (id, (position, colour)) in points.iter().flat_map(|p| p.positions.iter().zip(&p.colours)).enumerate()
    {
        cloud.extend(count(id + 1));
        cloud.extend(position.iter().flat_map(|v| f64::from(*v).to_le_bytes()));
        cloud.extend(colour.map(super::to_byte));
        // No reprojection error and no track: the points are those of stereo.
        cloud.extend(0f64.to_le_bytes());
        cloud.extend(count(0));
    }
    for (name, bytes) in [("cameras.bin", intrinsics), ("images.bin", images), ("points3D.bin", cloud)] {
        let path = folder.join(name);
        std::fs::write(&path, bytes).map_err(Error::unwritable(&path))?;
    }
    Ok(())
}
