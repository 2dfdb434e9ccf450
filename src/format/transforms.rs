//! nerfstudio `transforms.json`: camera → world in OpenGL axes (x right, y up, z backward).
use crate::scene::{Camera, Lens, Pose};
use crate::{Result, files, photo};
use glam::{DMat3, DVec3};
use serde::{Deserialize, Deserializer, Serialize};
use std::path::Path;

/// Intrinsics, at the top of the file or per frame; a frame's own win. The file itself and a frame are one type: flattened
/// structures would hold all that a file has besides in memory first.
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
    camera_angle_x: Option<f64>,
    camera_model: Option<String>,
    k1: f64,
    k2: f64,
    k3: f64,
    k4: f64,
    p1: f64,
    p2: f64,
    /// Of a frame.
    file_path: String,
    #[serde(deserialize_with = "rows")]
    transform_matrix: Option<[[f64; 4]; 3]>,
    /// Of the file.
    frames: Option<Vec<Block>>,
}

/// The first three rows of a matrix with three or four.
fn rows<'a, D: Deserializer<'a>>(from: D) -> Result<Option<[[f64; 4]; 3]>, D::Error> {
    let rows = Vec::<Vec<f64>>::deserialize(from)?;
    let row = |k: usize| <[f64; 4]>::try_from(rows.get(k)?.as_slice()).ok();
    let matrix = (|| Some([row(0)?, row(1)?, row(2)?]))();
    let fits = rows.len() <= 4 && rows.iter().all(|r| r.len() == 4);
    let matrix = matrix.filter(|_| fits);
    matrix.map(Some).ok_or_else(|| serde::de::Error::custom("transform_matrix must be 4 × 4"))
}

/// Cameras of a file's text; `folder` is where its image paths start, for files that do not state the image size.
pub(super) fn parse(text: &str, folder: &Path) -> Result<Vec<Camera>, String> {
    let file: Block = files::parse_json(text.as_bytes())
        .map_err(|e| format!("not a JSON camera file (transforms.json): {e}; check it"))?;
    let Some(frames) = &file.frames else {
        return Err(
            "neither transforms.json (an object with \"frames\") nor cameras.json (a list)".to_string()
        );
    };
    frames.iter().enumerate().map(|(i, f)| camera(&file, f, i, folder)).collect()
}

fn camera(shared: &Block, own: &Block, index: usize, folder: &Path) -> Result<Camera, String> {
    let name = if own.file_path.is_empty() { format!("{index:05}") } else { own.file_path.clone() };
    let model = own.camera_model.as_ref().or(shared.camera_model.as_ref());
    if let Some(m) = model.filter(|m| m.contains("FISHEYE") || m.contains("EQUIRECT")) {
        return Err(format!("frame {name:?}: camera model {m} is not a pinhole; undistort the photos first"));
    }
    for (k, v) in [("k1", own.k1, shared.k1), ("k2", own.k2, shared.k2), ("k3", own.k3, shared.k3)]
        .into_iter()
        .chain([("k4", own.k4, shared.k4), ("p1", own.p1, shared.p1), ("p2", own.p2, shared.p2)])
        .map(|(k, a, b)| (k, if a != 0.0 { a } else { b }))
    {
        if v != 0.0 {
            return Err(format!(
                "frame {name:?}: lens distortion {k} = {v} is not supported; undistort the photos first"
            ));
        }
    }
    let pick = |get: fn(&Block) -> Option<f64>| get(own).or_else(|| get(shared));
    let stated = pick(|i| i.w).zip(pick(|i| i.h));
    let (w, h) = stated.or_else(|| size_of_image(folder, &name)).ok_or_else(|| {
        format!("frame {name:?}: no image size; add \"w\" and \"h\" to the file or keep the images beside it")
    })?;
    let fx = pick(|i| i.fl_x).or_else(|| pick(|i| i.camera_angle_x).map(|a| 0.5 * w / (0.5 * a).tan()));
    let fx = fx.ok_or_else(|| format!("frame {name:?}: no focal length (fl_x or camera_angle_x)"))?;
    Camera {
        width: w as u32,
        height: h as u32,
        fx,
        fy: pick(|i| i.fl_y).unwrap_or(fx),
        cx: pick(|i| i.cx).unwrap_or(w / 2.0),
        cy: pick(|i| i.cy).unwrap_or(h / 2.0),
        pose: own
            .transform_matrix
            .as_ref()
            .map(pose)
            .ok_or_else(|| format!("frame {name:?}: transform_matrix is missing"))?,
        name,
    }
    .checked()
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
    lens: Option<Lens>,
    transform_matrix: [[f64; 4]; 4],
}

/// Writes `transforms.json`; every frame carries its own intrinsics. `ply_file_path`, relative to the file, names points
/// or splats for tools that start from them.
pub fn write(path: &Path, cameras: &[Camera], ply_file_path: Option<&str>) -> Result<()> {
    write_frames(path, cameras, None, ply_file_path)
}

/// Writes `transforms.json` of photos as they were taken: every frame with its `k1` and `k2`.
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
                lens: lenses.and_then(|l| l.get(i)).copied(),
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
