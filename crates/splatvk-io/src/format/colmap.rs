//! COLMAP models, text and binary. World → camera, OpenCV axes, first pixel centre at 0.5.
use super::lens_models::{self, LensModel, Optics};
use crate::scene::{Camera, GivenCamera, Lens, PointCloud, Pose};
use crate::{Error, Result, files};
use glam::{DMat3, DQuat, DVec3};
use std::collections::HashMap;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

/// Whether a folder contains a text or binary model.
pub fn is_model(folder: &Path) -> bool {
    ["txt", "bin"]
        .iter()
        .any(|e| ["cameras", "images"].iter().all(|n| folder.join(format!("{n}.{e}")).is_file()))
}

/// Usual places of a model below the folder of a data set or a scene.
const BELOW: [&str; 12] = [
    "",
    "sparse/0",
    "sparse",
    "colmap/sparse/0",
    "colmap/sparse",
    "dense/sparse/0",
    "dense/sparse",
    "dense/0/sparse",
    "cameras/colmap",
    "colmap",
    "0",
    "undistorted/sparse",
];

/// Folder of the model of a data set: the first of `BELOW` that [`is_model`].
pub fn find(folder: &Path) -> Option<PathBuf> {
    BELOW.iter().map(|below| folder.join(below)).find(|f| is_model(f))
}

/// Files of a text and of a binary model. Order in which the files of the other form are deleted: a
/// model is read as text as long as its images exist as text.
pub const FILES: [[&str; 3]; 2] =
    [["images.txt", "cameras.txt", "points3D.txt"], ["images.bin", "cameras.bin", "points3D.bin"]];

struct Intrinsics {
    size: (u32, u32),
    optics: Optics,
}

/// Cameras by their id; an error where the camera model is not supported.
type Intrinsic = HashMap<u32, Result<Intrinsics, String>>;

fn intrinsics(
    id: u32,
    model: &LensModel,
    size: (u32, u32),
    p: &[f64],
    folder: &Path,
) -> Result<Intrinsics, String> {
    match model.optics(p) {
        Some(optics) => Ok(Intrinsics { size, optics }),
        None if model.name == "EQUIRECTANGULAR" => Err(format!(
            "camera {id} is {}, a panorama; cut it into pinhole views first (COLMAP's panorama_sfm.py)",
            model.name
        )),
        None => Err(format!(
            "camera {id} is {}, whose lens is not read; undistort the photos with colmap image_undistorter --image_path IMAGES \
             --input_path {} --output_path NEW, then give NEW/sparse and NEW/images",
            model.name,
            folder.display()
        )),
    }
}

/// Reads the cameras of a model folder with their distortion, in the order of its image ids.
pub fn read(folder: &Path) -> Result<Vec<GivenCamera>> {
    let text = folder.join("images.txt").is_file();
    let ext = if text { "txt" } else { "bin" };
    let (cameras, images) = (folder.join(format!("cameras.{ext}")), folder.join(format!("images.{ext}")));
    let (camera_bytes, image_bytes) = (files::read(&cameras)?, files::read(&images)?);
    let (intrinsics, mut shots) = if text {
        (
            text_cameras(&camera_bytes, folder).map_err(named(&cameras))?,
            text_images(&image_bytes).map_err(named(&images))?,
        )
    } else {
        (
            binary_cameras(&camera_bytes, folder).map_err(named(&cameras))?,
            binary_images(&image_bytes).map_err(named(&images))?,
        )
    };
    shots.sort_by_key(|s| s.id);
    let mut out = Vec::with_capacity(shots.len());
    for shot in shots {
        let missing = || format!("image {:?} names camera {}, which is missing", shot.name, shot.camera);
        let own = intrinsics.get(&shot.camera).ok_or_else(missing).map_err(named(&images))?;
        let own = own.as_ref().map_err(|e| named(&cameras)(e.clone()))?;
        out.push(shot.with_intrinsics(own).checked().map_err(named(&images))?);
    }
    if out.is_empty() { Err(named(&images)("the model has no images".into())) } else { Ok(out) }
}

/// Attaches the path of a file to a message.
fn named(path: &Path) -> impl Fn(String) -> Error {
    let path = path.display().to_string();
    move |e| Error::input(format!("{path}: {e}"))
}

struct Shot {
    id: u32,
    q: [f64; 4],
    t: [f64; 3],
    camera: u32,
    name: String,
}

impl Shot {
    fn with_intrinsics(self, own: &Intrinsics) -> GivenCamera {
        let rotation =
            DMat3::from_quat(DQuat::from_xyzw(self.q[1], self.q[2], self.q[3], self.q[0]).normalize());
        let pose = Pose { rotation, translation: DVec3::from_array(self.t) };
        let ((width, height), Optics { f, c, lens }) = (own.size, own.optics);
        let camera = Camera { name: self.name, width, height, fx: f[0], fy: f[1], cx: c[0], cy: c[1], pose };
        GivenCamera { camera, lens }
    }
}

fn number<T: std::str::FromStr>(word: Option<&str>, line: usize) -> Result<T, String> {
    word.and_then(|w| w.parse().ok())
        .ok_or_else(|| format!("line {line}: {:?} is not a number", word.unwrap_or("")))
}

/// Lines that are no comments, with line numbers from 1.
fn lines(text: &str) -> impl Iterator<Item = (usize, &str)> {
    text.lines().enumerate().map(|(i, line)| (i + 1, line.trim())).filter(|(_, line)| !line.starts_with('#'))
}

/// Next word and the rest of the line; any number of blanks and tabs separates words.
fn split(line: &str) -> (Option<&str>, &str) {
    let line = line.trim_start();
    let end = line.find(char::is_whitespace).unwrap_or(line.len());
    ((end > 0).then_some(&line[..end]), &line[end..])
}

fn text_cameras(bytes: &[u8], folder: &Path) -> Result<Intrinsic, String> {
    let mut out = HashMap::new();
    for (i, line) in lines(files::plain_text(bytes)?).filter(|(_, l)| !l.is_empty()) {
        let mut words = line.split_whitespace();
        let id = number(words.next(), i)?;
        let name = words.next().unwrap_or("");
        let model = LensModel::named(name).ok_or_else(|| {
            format!(
                "line {i}: camera model {name:?} is not known; those that are read: {}",
                lens_models::read_names()
            )
        })?;
        let size = (number(words.next(), i)?, number(words.next(), i)?);
        let p: Vec<f64> = words.map(|w| number(Some(w), i)).collect::<Result<_, _>>()?;
        if p.len() != model.parameters() {
            return Err(format!("line {i}: {} needs {} parameters", model.name, model.parameters()));
        }
        if out.insert(id, intrinsics(id, model, size, &p, folder)).is_some() {
            return Err(format!("line {i}: a second camera {id}"));
        }
    }
    Ok(out)
}

/// Whether a line holds the 2D points of the preceding image: numbers in threes. An image line has
/// nine numbers and a name.
fn is_points(line: &str) -> bool {
    let words = line.split_whitespace();
    words.clone().count().is_multiple_of(3) && words.into_iter().all(|w| w.parse::<f64>().is_ok())
}

fn text_images(bytes: &[u8]) -> Result<Vec<Shot>, String> {
    // Two lines per image; the second (2D points) is often empty, and some programs leave it out.
    let mut out = Vec::new();
    let mut points_may_follow = false;
    for (i, line) in lines(files::plain_text(bytes)?) {
        if std::mem::take(&mut points_may_follow) && is_points(line) || line.is_empty() {
            continue;
        }
        let mut rest = line;
        let mut word = || {
            let (word, after) = split(rest);
            rest = after;
            word
        };
        let id = number(word(), i)?;
        let mut seven = [0.0; 7];
        for v in &mut seven {
            *v = number(word(), i)?;
        }
        let [qw, qx, qy, qz, x, y, z] = seven;
        let camera = number(word(), i)?;
        // The name is the rest of the line: it may contain blanks.
        let name = rest.trim().to_string();
        if name.is_empty() {
            return Err(format!("line {i}: the name of the image is missing"));
        }
        out.push(Shot { id, q: [qw, qx, qy, qz], t: [x, y, z], camera, name });
        points_may_follow = true;
    }
    Ok(out)
}

/// Little-endian cursor over a file whose counts may be wrong.
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

fn binary_cameras(bytes: &[u8], folder: &Path) -> Result<Intrinsic, String> {
    let mut b = Bytes(bytes);
    let mut out = HashMap::new();
    for _ in 0..b.u64()? {
        let (id, model) = (b.u32()?, b.u32()? as usize);
        let side = |n: u64| u32::try_from(n).map_err(|_| format!("camera {id} has a side of {n} pixels"));
        let size = (side(b.u64()?)?, side(b.u64()?)?);
        let model = LensModel::numbered(model).ok_or_else(|| {
            format!("camera {id} has the camera model of number {model}, which is not known; those that are read: {}", lens_models::read_names())
        })?;
        let p: Vec<f64> =
            (0..model.parameters()).map(|_| b.f64s::<1>().map(|v| v[0])).collect::<Result<_, _>>()?;
        out.insert(id, intrinsics(id, model, size, &p, folder));
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

/// Reads `points3D.txt` or `points3D.bin` of a model folder or of a data set with one; confidence
/// 1, radius 0.
pub fn read_points(folder: &Path) -> Result<PointCloud> {
    let files = BELOW
        .iter()
        .flat_map(|below| ["txt", "bin"].map(|e| folder.join(below).join(format!("points3D.{e}"))));
    let Some(path) = files.into_iter().find(|p| p.is_file()) else {
        return Err(Error::input(format!(
            "{}: no points3D.bin or points3D.txt here or in its sparse folders; give the folder of a COLMAP model",
            folder.display()
        )));
    };
    let bytes = files::read(&path)?;
    let text = path.extension().is_some_and(|e| e == "txt");
    let points = if text { text_points(&bytes) } else { binary_points(&bytes) };
    let points = points.map_err(|e| Error::input(format!("{}: {e}", path.display())))?;
    let n = points.len();
    let (positions, colours) = points.into_iter().unzip();
    Ok(PointCloud {
        positions,
        colours,
        confidence: vec![1.0; n],
        view: vec![0; n],
        radius: vec![0.0; n],
        normals: Vec::new(),
    })
}

type Point = ([f32; 3], [f32; 3]);

fn text_points(bytes: &[u8]) -> Result<Vec<Point>, String> {
    let text = files::plain_text(bytes)?;
    let lines = lines(text).filter(|(_, l)| !l.is_empty());
    lines
        .map(|(i, line)| {
            let mut words = line.split_whitespace().skip(1);
            let mut six = [0.0f32; 6];
            for v in &mut six {
                *v = number(words.next(), i)?;
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

/// Largest number of points in `points3D.txt`: other tools only start from them, and text takes 70
/// bytes a point.
const MAX_POINTS: usize = 100_000;

/// Writes a text model with PINHOLE cameras. Rust prints the shortest digits that read back
/// exactly.
pub fn write(folder: &Path, cameras: &[Camera], points: Option<&PointCloud>) -> Result<()> {
    write_text(folder, cameras, None, points)
}

/// Writes a text model of the distorted photos: one distortion per camera, as OPENCV, FULL_OPENCV
/// or OPENCV_FISHEYE.
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
        let (model, distortion) =
            lenses.and_then(|l| l.get(i)).map_or(("PINHOLE", Vec::new()), lens_models::of_lens);
        let terms: String = distortion.iter().map(|v| format!(" {v}")).collect();
        let pinhole = format!("{} {} {} {} {} {}", c.width, c.height, c.fx, c.fy, c.cx, c.cy);
        let _ = writeln!(intrinsics, "{id} {model} {pinhole}{terms}");
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

/// Bytes of a count in a binary model.
fn count(n: usize) -> [u8; 8] {
    (n as u64).to_le_bytes()
}

/// Writes a binary model with PINHOLE cameras and all points: binary points are small.
pub fn write_binary(folder: &Path, cameras: &[Camera], points: Option<&PointCloud>) -> Result<()> {
    std::fs::create_dir_all(folder).map_err(Error::unwritable(folder))?;
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
        // No reprojection error and no track: the points come from stereo.
        cloud.extend(0f64.to_le_bytes());
        cloud.extend(count(0));
    }
    for (name, bytes) in [("cameras.bin", intrinsics), ("images.bin", images), ("points3D.bin", cloud)] {
        let path = folder.join(name);
        std::fs::write(&path, bytes).map_err(Error::unwritable(&path))?;
    }
    Ok(())
}
