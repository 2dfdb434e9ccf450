//! Camera files: one reader for every kind, the project's own `cameras.json`.
use super::{colmap, transforms};
use crate::scene::{Camera, Pose};
use crate::{Error, Result, files};
use glam::{DMat3, DVec3};
use serde::{Deserialize, Serialize};
use std::path::Path;

/// Reads cameras from nerfstudio `transforms.json`, `cameras.json`, or a COLMAP model folder (text or binary).
pub fn read(path: &Path) -> Result<Vec<Camera>> {
    let bad = |what: String| Error::input(format!("{}: {what}", path.display()));
    if path.is_dir() {
        // A scene directory and common COLMAP layouts keep the model further down.
        let nested = ["", "sparse/0", "sparse", "cameras/colmap", "colmap"].map(|n| path.join(n));
        let model = nested.iter().find(|p| colmap::is_model(p));
        return match model {
            Some(folder) => colmap::read(folder),
            None if path.join("transforms.json").is_file() => read(&path.join("transforms.json")),
            None => Err(bad(
                "no cameras here; give transforms.json, cameras.json or a COLMAP model folder".into()
            )),
        };
    }
    let text = files::read_text(path)?;
    let cameras = match text.trim_start().chars().next() {
        Some('[') => {
            let entries: Result<Vec<Entry>, _> = files::parse_json(text.as_bytes());
            let entries = entries.map_err(|e| format!("not a JSON camera file (cameras.json): {e}; check it"));
            entries.and_then(|all| all.into_iter().map(Entry::camera).collect::<Result<Vec<_>, _>>())
        }
        Some('{') => transforms::parse(&text, path.parent().unwrap_or(Path::new("."))),
        _ => Err("not a JSON camera file: neither transforms.json (an object with \"frames\") nor cameras.json (a list); \
                  check the camera file"
            .to_string()),
    };
    let cameras = cameras.map_err(bad)?;
    if cameras.is_empty() {
        return Err(bad("the file has no cameras".into()));
    }
    Ok(cameras)
}

/// One camera of `cameras.json`: the layout 3DGS tools write, plus the principal point.
#[derive(Debug, Serialize, Deserialize)]
struct Entry {
    #[serde(default)]
    id: u32,
    img_name: String,
    width: u32,
    height: u32,
    /// Camera centre, world.
    position: [f64; 3],
    /// Rows of R, camera → world.
    rotation: [[f64; 3]; 3],
    fx: f64,
    fy: f64,
    #[serde(default)]
    cx: Option<f64>,
    #[serde(default)]
    cy: Option<f64>,
}

impl Entry {
    fn camera(self) -> Result<Camera, String> {
        // The rows of camera → world are the columns of world → camera.
        let rotation = DMat3::from_cols_array_2d(&self.rotation);
        let pose = Pose { rotation, translation: -(rotation * DVec3::from_array(self.position)) };
        Camera {
            name: self.img_name,
            width: self.width,
            height: self.height,
            fx: self.fx,
            fy: self.fy,
            cx: self.cx.unwrap_or(self.width as f64 / 2.0),
            cy: self.cy.unwrap_or(self.height as f64 / 2.0),
            pose,
        }
        .checked()
    }
}

/// Writes `cameras.json`.
pub fn write_json(path: &Path, cameras: &[Camera]) -> Result<()> {
    let entry = |(id, c): (usize, &Camera)| Entry {
        id: id as u32,
        img_name: c.name.clone(),
        width: c.width,
        height: c.height,
        position: c.pose.centre().to_array(),
        rotation: c.pose.rotation.to_cols_array_2d(),
        fx: c.fx,
        fy: c.fy,
        cx: Some(c.cx),
        cy: Some(c.cy),
    };
    let entries: Vec<Entry> = cameras.iter().enumerate().map(entry).collect();
    super::write_json(path, &entries)
}
