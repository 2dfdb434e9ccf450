//! Camera files: one reader for every kind, and the project's own `cameras.json`.
use super::camera_file::CameraFile;
use super::{colmap, transforms};
use crate::photo::{self, MaskChoice};
use crate::scene::{Camera, GivenCamera, Pose};
use crate::{Error, Result, files};
use glam::{DMat3, DVec3};
use serde::{Deserialize, Serialize};
use std::collections::HashMap;
use std::path::{Component, Path, PathBuf};

/// Reads the cameras of a file that must have no distortion, see [`read_file`].
pub fn read(path: &Path) -> Result<Vec<Camera>> {
    let cameras = read_file(path)?.cameras;
    match cameras.iter().find(|c| !c.lens.is_none()) {
        Some(c) => Err(Error::input(format!(
            "{}: camera {:?} has a lens, and pinholes are needed here; undistort its photos first",
            path.display(),
            c.camera.name
        ))),
        None => Ok(cameras.into_iter().map(|c| c.camera).collect()),
    }
}

/// Reads cameras from nerfstudio `transforms.json`, `cameras.json`, a COLMAP model (text or
/// binary), or the folder of a data set or scene that contains one of them.
pub fn read_file(path: &Path) -> Result<CameraFile> {
    if path.is_dir() {
        return read_folder(path);
    }
    // A file of a COLMAP model stands for the whole model.
    let is_of_model =
        |p: &Path| colmap::FILES.as_flattened().iter().any(|f| p.file_name().is_some_and(|n| n == *f));
    if let Some(folder) = path.parent().filter(|folder| is_of_model(path) && colmap::is_model(folder)) {
        return read_folder(folder);
    }
    let bad = |what: String| Error::input(format!("{}: {what}", path.display()));
    let text = files::read_text(path)?;
    let file = match text.trim_start().chars().next() {
        Some('[') => {
            let entries: Result<Vec<Entry>, _> = files::parse_json(text.as_bytes());
            let entries = entries.map_err(|e| format!("not a JSON camera file (cameras.json): {e}; check it"));
            let cameras =
                entries.and_then(|all| all.into_iter().map(Entry::camera).collect::<Result<Vec<_>, _>>());
            cameras.map(|cameras| CameraFile { cameras, warnings: Vec::new() })
        }
        Some('{') => transforms::parse(&text, path.parent().unwrap_or(Path::new("."))),
        _ => Err("not a JSON camera file: neither transforms.json (an object with \"frames\") nor cameras.json (a list); \
                  check the camera file"
            .to_string()),
    };
    let file = file.map_err(bad)?;
    if file.cameras.is_empty() {
        let nothing = "the file has no cameras".to_owned();
        return Err(bad(file.warnings.first().map_or(nothing, |w| format!("the file has no cameras: {w}"))));
    }
    check_names(&file.cameras).map_err(bad)?;
    Ok(file)
}

fn read_folder(folder: &Path) -> Result<CameraFile> {
    let Some(model) = colmap::find(folder) else {
        // A scene directory keeps them in a subfolder.
        let files =
            ["transforms.json", "cameras/transforms.json", "cameras.json"].map(|name| folder.join(name));
        return match files.iter().find(|file| file.is_file()) {
            Some(file) => read_file(file),
            None => Err(Error::input(format!(
                "{}: no cameras here; give transforms.json, cameras.json or a COLMAP model folder",
                folder.display()
            ))),
        };
    };
    let cameras = colmap::read(&model)?;
    check_names(&cameras).map_err(|e| Error::input(format!("{}: {e}", model.display())))?;
    Ok(CameraFile { cameras, warnings: other_models(&model) })
}

/// Warns of further models: COLMAP writes the parts of a reconstruction that it could not join into
/// numbered folders.
fn other_models(model: &Path) -> Vec<String> {
    let numbered = |p: &PathBuf| p.file_name().is_some_and(|n| n.to_string_lossy().parse::<u32>().is_ok());
    let entries =
        model.parent().filter(|_| numbered(&model.to_path_buf())).and_then(|p| std::fs::read_dir(p).ok());
    let mut others: Vec<PathBuf> = entries.into_iter().flatten().flatten().map(|e| e.path()).collect();
    others.retain(|p| numbered(p) && p.as_path() != model && colmap::is_model(p));
    others.sort();
    let Some(first) = others.first() else { return Vec::new() };
    let more = if others.len() > 1 { format!(" and {} more", others.len() - 1) } else { String::new() };
    vec![format!(
        "{} is used, one of several models; give {}{more} for the others",
        model.display(),
        first.display()
    )]
}

/// Refuses two cameras of one name, as a photo could not be assigned to one of them.
fn check_names(cameras: &[GivenCamera]) -> Result<(), String> {
    let mut seen: HashMap<String, &str> = HashMap::new();
    for c in cameras {
        if seen.insert(photo::plain_name(&c.camera.name), &c.camera.name).is_some() {
            return Err(format!("two cameras have the name {:?}; rename or remove one", c.camera.name));
        }
    }
    Ok(())
}

/// Mask files of photos: a folder, and the masks that a camera file names (`mask_path` of
/// transforms.json).
pub fn masks(folder: Option<&Path>, cameras: Option<&Path>) -> Result<MaskChoice> {
    let mut choice = MaskChoice { folder: folder.map(Path::to_path_buf), named: Vec::new() };
    let inside = cameras.map(|c| c.join("transforms.json")).filter(|file| file.is_file());
    let Some(file) = inside.or(cameras.filter(|c| c.is_file()).map(Path::to_path_buf)) else {
        return Ok(choice);
    };
    let text = files::read_text(&file)?;
    if !text.trim_start().starts_with('{') {
        return Ok(choice);
    }
    let bad = |what: String| Error::input(format!("{}: {what}", file.display()));
    let beside = file.parent().unwrap_or(Path::new("."));
    for (photo, mask) in transforms::masks(&text).map_err(bad)? {
        let path = Path::new(&mask);
        // Files outside the folder of the camera file are not read.
        if !path.components().all(|c| matches!(c, Component::Normal(_) | Component::CurDir)) {
            return Err(bad(format!(
                "frame {photo:?}: mask_path {mask:?} leads out of the file's folder; put the mask beside the file, or give \
                 --photo-masks"
            )));
        }
        let path = beside.join(path);
        if !path.is_file() {
            return Err(bad(format!(
                "frame {photo:?}: its mask {} is not there; put it there, or take mask_path out of the file",
                path.display()
            )));
        }
        choice.named.push((photo, path));
    }
    Ok(choice)
}

/// One camera of `cameras.json`: the layout of 3DGS tools, plus the principal point.
#[derive(Debug, Serialize, Deserialize)]
struct Entry {
    #[serde(default)]
    id: Option<u32>,
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
    fn new(id: usize, c: &Camera) -> Entry {
        Entry {
            id: Some(id as u32),
            img_name: c.name.clone(),
            width: c.width,
            height: c.height,
            position: c.pose.centre().to_array(),
            rotation: c.pose.rotation.to_cols_array_2d(),
            fx: c.fx,
            fy: c.fy,
            cx: Some(c.cx),
            cy: Some(c.cy),
        }
    }

    fn camera(self) -> Result<GivenCamera, String> {
        // The rows of camera → world are the columns of world → camera.
        let rotation = DMat3::from_cols_array_2d(&self.rotation);
        let pose = Pose { rotation, translation: -(rotation * DVec3::from_array(self.position)) };
        let camera = Camera {
            name: self.img_name,
            width: self.width,
            height: self.height,
            fx: self.fx,
            fy: self.fy,
            cx: self.cx.unwrap_or(self.width as f64 / 2.0),
            cy: self.cy.unwrap_or(self.height as f64 / 2.0),
            pose,
        };
        GivenCamera::from(camera).checked()
    }
}

/// Writes `cameras.json`.
pub fn write_json(path: &Path, cameras: &[Camera]) -> Result<()> {
    let entries: Vec<Entry> = cameras.iter().enumerate().map(|(id, c)| Entry::new(id, c)).collect();
    super::write_json(path, &entries)
}
