//! nerfstudio and instant-ngp `transforms.json`: camera → world in OpenGL axes (x right, y up, z
//! backward).
use super::camera_file::CameraFile;
use super::lens_models::{self, LensModel};
use crate::scene::{Camera, GivenCamera, Lens, Pose};
use crate::{Result, files, photo};
use glam::{DMat3, DVec3};
use serde::{Deserialize, Deserializer, Serialize};
use serde_json::{Map, Value};
use std::path::Path;

/// Intrinsics, at the top of the file or per frame; those of a frame take precedence. The file
/// itself and a frame share one type: flattened structures would first hold all other keys of the
/// file in memory. `null` counts as absent.
#[derive(Debug, Default, Deserialize)]
#[serde(default)]
struct Block {
    fl_x: Option<f64>,
    fl_y: Option<f64>,
    cx: Option<f64>,
    cy: Option<f64>,
    // Some writers store sizes as floats.
    w: Option<f64>,
    h: Option<f64>,
    /// Angles of view, radians.
    camera_angle_x: Option<f64>,
    camera_angle_y: Option<f64>,
    x_fov: Option<f64>,
    y_fov: Option<f64>,
    camera_model: Option<String>,
    is_fisheye: Option<bool>,
    k1: Option<f64>,
    k2: Option<f64>,
    k3: Option<f64>,
    k4: Option<f64>,
    k5: Option<f64>,
    k6: Option<f64>,
    p1: Option<f64>,
    p2: Option<f64>,
    /// Other projections of instant-ngp, and camera motion during exposure.
    ftheta_p0: Option<Value>,
    latlong: Option<Value>,
    equirectangular: Option<Value>,
    orthographic: Option<Value>,
    rolling_shutter: Option<Value>,
    /// Of a frame.
    file_path: Option<String>,
    /// Path relative to the file; black pixels of the mask are not used.
    mask_path: Option<String>,
    #[serde(deserialize_with = "rows")]
    transform_matrix: Option<[[f64; 4]; 3]>,
    /// Of the file.
    frames: Option<Vec<Block>>,
}

/// First three rows of a matrix with three or four.
fn rows<'a, D: Deserializer<'a>>(from: D) -> Result<Option<[[f64; 4]; 3]>, D::Error> {
    let Some(rows) = Option::<Vec<Vec<f64>>>::deserialize(from)? else { return Ok(None) };
    let row = |k: usize| <[f64; 4]>::try_from(rows.get(k)?.as_slice()).ok();
    let matrix = (|| Some([row(0)?, row(1)?, row(2)?]))();
    let fits = rows.len() <= 4 && rows.iter().all(|r| r.len() == 4);
    let matrix = matrix.filter(|_| fits);
    matrix.map(Some).ok_or_else(|| serde::de::Error::custom("transform_matrix must be 4 × 4"))
}

/// Whether a value of any type counts as set.
fn is_set(value: Option<&Value>) -> bool {
    match value {
        None | Some(Value::Null | Value::Bool(false)) => false,
        Some(Value::Array(list)) => list.iter().any(|v| v.as_f64() != Some(0.0)),
        Some(_) => true,
    }
}

/// Cameras of a file's text; image paths are relative to `folder`, for files that do not state the
/// image size.
pub(super) fn parse(text: &str, folder: &Path) -> Result<CameraFile, String> {
    let file: Block = files::parse_json(text.as_bytes())
        .map_err(|e| format!("not a JSON camera file (transforms.json): {e}; check it"))?;
    let Some(frames) = &file.frames else {
        return Err(
            "neither transforms.json (an object with \"frames\") nor cameras.json (a list)".to_string()
        );
    };
    let (mut cameras, mut without, mut moving) = (Vec::new(), Vec::new(), false);
    for (i, frame) in frames.iter().enumerate() {
        let both = Frame { shared: &file, own: frame, name: name(frame, i) };
        moving |= is_set(both.pick(|b| b.rolling_shutter.as_ref()));
        match &frame.transform_matrix {
            Some(matrix) => cameras.push(both.camera(pose(matrix), folder)?),
            // nerfstudio writes frames without a matrix where it could not register them.
            None => without.push(both.name),
        }
    }
    let mut warnings = Vec::new();
    if !without.is_empty() {
        warnings.push(format!("frames without transform_matrix are skipped: {}", files::listed(&without)));
    }
    if moving {
        warnings.push("rolling_shutter is not used: every photo is taken to be from one place".to_owned());
    }
    Ok(CameraFile { cameras, warnings })
}

/// Mask paths of frames, by the name of the photo.
pub(super) fn masks(text: &str) -> Result<Vec<(String, String)>, String> {
    let file: Block = files::parse_json(text.as_bytes())?;
    let named = |f: Block| Some((f.file_path?, f.mask_path.filter(|mask| !mask.is_empty())?));
    Ok(file.frames.unwrap_or_default().into_iter().filter_map(named).collect())
}

fn name(frame: &Block, index: usize) -> String {
    frame.file_path.clone().filter(|p| !p.is_empty()).unwrap_or_else(|| format!("{index:05}"))
}

/// A frame with the shared values of the file.
struct Frame<'a> {
    shared: &'a Block,
    own: &'a Block,
    name: String,
}

impl<'a> Frame<'a> {
    fn pick<T>(&self, get: impl Fn(&'a Block) -> Option<T>) -> Option<T> {
        get(self.own).or_else(|| get(self.shared))
    }

    fn camera(&self, pose: Pose, folder: &Path) -> Result<GivenCamera, String> {
        let bad = |what: String| format!("frame {:?}: {what}", self.name);
        let lens = self.lens().map_err(bad)?;
        let stated = self.pick(|b| b.w).zip(self.pick(|b| b.h));
        let (w, h) = stated.or_else(|| size_of_image(folder, &self.name)).ok_or_else(|| {
            bad("no image size; add \"w\" and \"h\" to the file or keep the images beside it".to_owned())
        })?;
        let focal_of_angle = |side: f64, angle: f64| 0.5 * side / (0.5 * angle).tan();
        let focal_length = |side: f64, focal: Option<f64>, radians: Option<f64>, degrees: Option<f64>| {
            focal
                .or_else(|| radians.or(degrees.map(f64::to_radians)).map(|angle| focal_of_angle(side, angle)))
        };
        let fx =
            focal_length(w, self.pick(|b| b.fl_x), self.pick(|b| b.camera_angle_x), self.pick(|b| b.x_fov));
        let fy =
            focal_length(h, self.pick(|b| b.fl_y), self.pick(|b| b.camera_angle_y), self.pick(|b| b.y_fov));
        let fx = fx.or(fy).ok_or_else(|| bad("no focal length (fl_x or camera_angle_x)".to_owned()))?;
        let camera = Camera {
            width: w as u32,
            height: h as u32,
            fx,
            fy: fy.unwrap_or(fx),
            cx: self.pick(|b| b.cx).unwrap_or(w / 2.0),
            cy: self.pick(|b| b.cy).unwrap_or(h / 2.0),
            pose,
            name: self.name.clone(),
        };
        GivenCamera { camera, lens }.checked()
    }

    fn lens(&self) -> Result<Lens, String> {
        let stated = self.pick(|b| b.camera_model.as_deref());
        let model = stated.map(|m| LensModel::named(m).filter(|m| m.is_read()).ok_or(m)).transpose();
        let model = model.map_err(|m| {
            format!("camera model {m} is not read; those that are: {}", lens_models::read_names())
        })?;
        for (key, value) in [
            ("ftheta_p0", self.pick(|b| b.ftheta_p0.as_ref())),
            ("latlong", self.pick(|b| b.latlong.as_ref())),
            ("equirectangular", self.pick(|b| b.equirectangular.as_ref())),
            ("orthographic", self.pick(|b| b.orthographic.as_ref())),
        ] {
            if is_set(value) {
                return Err(format!(
                    "{key} states a projection that is not read; make the photos rectilinear first, and leave it out"
                ));
            }
        }
        let coefficient = |get: fn(&Block) -> Option<f64>| self.pick(get).unwrap_or(0.0);
        let lens = Lens {
            k1: coefficient(|b| b.k1),
            k2: coefficient(|b| b.k2),
            k3: coefficient(|b| b.k3),
            k4: coefficient(|b| b.k4),
            k5: coefficient(|b| b.k5),
            k6: coefficient(|b| b.k6),
            p1: coefficient(|b| b.p1),
            p2: coefficient(|b| b.p2),
            fisheye: self.pick(|b| b.is_fisheye).unwrap_or(false) || model.is_some_and(LensModel::is_fisheye),
        };
        self.check(lens, model)
    }

    /// Refuses coefficients whose meaning differs between programs.
    fn check(&self, lens: Lens, model: Option<&LensModel>) -> Result<Lens, String> {
        if lens.fisheye && self.pick(|b| b.is_fisheye) == Some(false) {
            return Err("is_fisheye is false and camera_model a fisheye; remove one of them".to_owned());
        }
        let denominator = [("k4", lens.k4), ("k5", lens.k5), ("k6", lens.k6)];
        let extra = match (lens.fisheye, model.map(|m| m.name)) {
            (true, _) => vec![("p1", lens.p1), ("p2", lens.p2), ("k5", lens.k5), ("k6", lens.k6)],
            (false, Some("FULL_OPENCV")) => Vec::new(),
            (false, _) => denominator.to_vec(),
        };
        match extra.into_iter().find(|(_, value)| *value != 0.0) {
            Some((key, value)) if lens.fisheye => {
                Err(format!("{key} = {value}: OPENCV_FISHEYE has k1 to k4 alone; remove it"))
            }
            Some((key, value)) => Err(format!(
                "{key} = {value}: programs differ in what it means (r⁸, or a term of the denominator); say \"camera_model\": \
                 \"FULL_OPENCV\" for OpenCV's rational model, or undistort the photos first"
            )),
            None => Ok(lens),
        }
    }
}

fn size_of_image(folder: &Path, name: &str) -> Option<(f64, f64)> {
    let candidates =
        [folder.join(name), folder.join(format!("{name}.png")), folder.join(format!("{name}.jpg"))];
    candidates.iter().find_map(|p| photo::dimensions(p).ok()).map(|(w, h)| (w as f64, h as f64))
}

/// `T_cw` of a camera → world matrix in OpenGL axes: `T_wc = T_gl · diag(1, −1, −1, 1)`.
fn pose(rows: &[[f64; 4]; 3]) -> Pose {
    let column = |k: usize| DVec3::new(rows[0][k], rows[1][k], rows[2][k]);
    let to_world = DMat3::from_cols(column(0), -column(1), -column(2));
    Pose { rotation: to_world, translation: column(3) }.inverse()
}

#[derive(Serialize)]
struct OutFrame<'a> {
    file_path: &'a str,
    fl_x: f64,
    fl_y: f64,
    cx: f64,
    cy: f64,
    w: u32,
    h: u32,
    #[serde(flatten)]
    lens: Option<OutLens>,
    transform_matrix: [[f64; 4]; 4],
}

/// Distortion of a frame: its model, and the coefficients of that model.
#[derive(Serialize)]
struct OutLens {
    camera_model: &'static str,
    #[serde(flatten)]
    terms: Map<String, Value>,
}

impl OutLens {
    fn new(lens: &Lens) -> OutLens {
        let (camera_model, values) = lens_models::of_lens(lens);
        let names: &[&str] = match camera_model {
            "OPENCV_FISHEYE" => &["k1", "k2", "k3", "k4"],
            _ => &["k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"],
        };
        let terms =
            names.iter().zip(values).map(|(name, value)| ((*name).to_owned(), value.into())).collect();
        OutLens { camera_model, terms }
    }
}

/// Writes `transforms.json`; every frame carries its own intrinsics. `ply_file_path`, relative to
/// the file, names points or splats for tools that start from them.
pub fn write(path: &Path, cameras: &[Camera], ply_file_path: Option<&str>) -> Result<()> {
    write_frames(path, cameras, None, ply_file_path)
}

/// Writes `transforms.json` of the distorted photos: every frame with its distortion.
pub fn write_lensed(path: &Path, cameras: &[Camera], lenses: &[Lens]) -> Result<()> {
    write_frames(path, cameras, Some(lenses), None)
}

fn write_frames(
    path: &Path,
    cameras: &[Camera],
    lenses: Option<&[Lens]>,
    ply_file_path: Option<&str>,
) -> Result<()> {
    let frames: Vec<OutFrame> = cameras
        .iter()
        .enumerate()
        .map(|(i, c)| {
            let to_world = c.pose.inverse();
            let (r, t) = (to_world.rotation, to_world.translation);
            let row = |k: usize| [r.x_axis[k], -r.y_axis[k], -r.z_axis[k], t[k]];
            OutFrame {
                file_path: &c.name,
                fl_x: c.fx,
                fl_y: c.fy,
                cx: c.cx,
                cy: c.cy,
                w: c.width,
                h: c.height,
                lens: lenses.and_then(|l| l.get(i)).map(OutLens::new),
                transform_matrix: [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]],
            }
        })
        .collect();
    let model = if lenses.is_some() { "OPENCV" } else { "PINHOLE" };
    let mut file =
        serde_json::json!({ "camera_model": model, "orientation_override": "none", "frames": frames });
    if let Some(ply) = ply_file_path {
        file["ply_file_path"] = ply.into();
    }
    super::write_json(path, &file)
}
