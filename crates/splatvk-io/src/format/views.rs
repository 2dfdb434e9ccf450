//! Named views of a scene and notes on its points: `views.json`.
use super::{write_json, write_whole_file};
use crate::scene::{Camera, Pose};
use crate::{Error, Result, files};
use glam::{DMat3, DQuat, DVec3};
use serde::{Deserialize, Serialize};
use std::path::Path;

/// Name of the file in a scene directory.
pub const FILE: &str = "views.json";

/// Format name in the file.
const FORMAT: &str = "splatvk-views";
/// Version of the layout; readers refuse newer ones.
const VERSION: u32 = 1;

/// Largest numbers of views and of notes, and of characters of a name and of a note: a page lists
/// all of them.
const MOST: usize = 200;
const LONGEST_NAME: usize = 80;
const LONGEST_NOTE: usize = 500;

/// Named views, the one at which the interactive view starts, and notes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Views {
    format: String,
    version: u32,
    /// Name of the view at which the interactive view starts.
    pub start: Option<String>,
    /// In the order in which they are listed.
    pub views: Vec<NamedView>,
    /// Notes on points of the scene.
    pub notes: Vec<Note>,
}

impl Default for Views {
    fn default() -> Views {
        Views { format: FORMAT.into(), version: VERSION, start: None, views: Vec::new(), notes: Vec::new() }
    }
}

/// A camera with a name, independent of the size of its picture.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct NamedView {
    /// Unique among the views, whatever the case of its letters.
    pub name: String,
    /// Centre of projection, in the scene's axes and unit.
    pub position: [f64; 3],
    /// Quaternion (w, x, y, z), world to camera; OpenCV axes.
    pub rotation: [f64; 4],
    /// Focal length, in units of the height of the picture.
    pub focal: f64,
    /// Width of the picture by its height.
    pub ratio: f64,
    /// Offset of the principal point from the middle of the picture to the right and downwards, in
    /// units of its height.
    #[serde(default)]
    pub shift: [f64; 2],
    /// Distance to the point about which the view turns, scene units.
    pub distance: f64,
}

impl NamedView {
    /// Camera for a picture of a height, pixels.
    pub fn camera(&self, height: u32) -> Camera {
        let [w, x, y, z] = self.rotation;
        let rotation = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize());
        let size = f64::from(height);
        // Videos have even sizes.
        let width = 2 * ((self.ratio * size / 2.0).round().max(1.0) as u32);
        Camera {
            name: self.name.clone(),
            width,
            height,
            fx: self.focal * size,
            fy: self.focal * size,
            cx: f64::from(width) / 2.0 + self.shift[0] * size,
            cy: size / 2.0 + self.shift[1] * size,
            pose: Pose { rotation, translation: -(rotation * DVec3::from(self.position)) },
        }
    }

    fn check(&self) -> Result<(), String> {
        let called = &self.name;
        checked_text(called, LONGEST_NAME).map_err(|e| format!("name of a view: {e}"))?;
        let numbers = self.position.iter().chain(&self.shift).chain(&self.rotation);
        if numbers.chain([&self.focal, &self.ratio, &self.distance]).any(|v| !v.is_finite()) {
            return Err(format!("view \"{called}\": a number that is not finite"));
        }
        if (DQuat::from_array(self.rotation).length() - 1.0).abs() > 1e-3 {
            return Err(format!("view \"{called}\": its rotation is no unit quaternion (w, x, y, z)"));
        }
        if !(self.focal > 0.0 && self.distance > 0.0 && (0.05..=20.0).contains(&self.ratio)) {
            return Err(format!(
                "view \"{called}\": focal and distance are above 0, ratio is width by height, 0.05 to 20"
            ));
        }
        Ok(())
    }
}

/// A text at a point of the scene.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Note {
    /// Its words.
    pub text: String,
    /// The point, in the scene's axes and unit.
    pub at: [f64; 3],
}

impl Views {
    /// Reads a file.
    ///
    /// # Errors
    /// Bad input for a file that cannot be read, or does not fit docs/use/schemas/views.schema.json.
    pub fn read(path: &Path) -> Result<Views> {
        Views::parse(&files::read(path)?).map_err(|e| Error::input(format!("{}: {e}", path.display())))
    }

    /// Views of a scene directory; none where the scene has no such file.
    pub fn of_scene(scene: &Path) -> Result<Views> {
        let path = scene.join(FILE);
        if path.exists() { Views::read(&path) } else { Ok(Views::default()) }
    }

    /// Views from the text of a file.
    pub fn parse(bytes: &[u8]) -> Result<Views, String> {
        let views: Views = files::parse_json(bytes)?;
        views.check()?;
        Ok(views)
    }

    /// Writes the file of a scene directory, whole or not at all.
    pub fn write(&self, scene: &Path) -> Result<()> {
        write_whole_file(&scene.join(FILE), |file| write_json(file, self))
    }

    /// The view of a name, whatever the case of its letters.
    ///
    /// # Errors
    /// Bad input that lists the names.
    pub fn named(&self, name: &str) -> Result<&NamedView> {
        let found = self.views.iter().find(|v| v.name.to_lowercase() == name.to_lowercase());
        found.ok_or_else(|| {
            let names: Vec<&str> = self.views.iter().map(|v| v.name.as_str()).collect();
            let known = match names.is_empty() {
                true => "the scene has no named views: save one in splatvk view".to_owned(),
                false => format!("there are: {}", names.join(", ")),
            };
            Error::input(format!("no view is called \"{name}\"; {known}"))
        })
    }

    fn check(&self) -> Result<(), String> {
        if self.format != FORMAT || self.version > VERSION {
            return Err(format!("not a file of views that this version reads ({FORMAT}, version {VERSION})"));
        }
        if self.views.len() > MOST || self.notes.len() > MOST {
            return Err(format!("more than {MOST} views or notes; delete some"));
        }
        self.views.iter().try_for_each(NamedView::check)?;
        let mut names: Vec<String> = self.views.iter().map(|v| v.name.to_lowercase()).collect();
        if let Some(start) = &self.start
            && !names.contains(&start.to_lowercase())
        {
            return Err(format!("start: no view is called \"{start}\""));
        }
        names.sort();
        if let Some(pair) = names.windows(2).find(|pair| pair[0] == pair[1]) {
            return Err(format!("two views are called \"{}\"; give another name", pair[0]));
        }
        for note in &self.notes {
            checked_text(&note.text, LONGEST_NOTE).map_err(|e| format!("text of a note: {e}"))?;
            if note.at.iter().any(|v| !v.is_finite()) {
                return Err("a note at a point that is not finite".to_owned());
            }
        }
        Ok(())
    }
}

fn checked_text(text: &str, longest: usize) -> Result<(), String> {
    match text.chars().count() {
        _ if text.trim() != text || text.is_empty() => Err("empty, or with spaces at its ends".to_owned()),
        n if n > longest => Err(format!("{n} characters; at most {longest}")),
        _ if text.chars().any(char::is_control) => Err("with a control character".to_owned()),
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn view(name: &str) -> NamedView {
        NamedView {
            name: name.into(),
            position: [1.0, 2.0, 3.0],
            rotation: [1.0, 0.0, 0.0, 0.0],
            focal: 1.2,
            ratio: 1.5,
            shift: [0.1, 0.0],
            distance: 2.0,
        }
    }

    #[test]
    fn views_are_written_and_read() {
        let folder = tempfile::tempdir().unwrap();
        assert_eq!(Views::of_scene(folder.path()).unwrap(), Views::default());
        let note = Note { text: "a lemon".into(), at: [0.0, -0.5, 1.0] };
        let views = Views {
            start: Some("Front".into()),
            views: vec![view("Front"), view("Side")],
            notes: vec![note],
            ..Views::default()
        };
        views.write(folder.path()).unwrap();
        assert_eq!(Views::of_scene(folder.path()).unwrap(), views);
        assert_eq!(views.named("front").unwrap().name, "Front");
        let error = views.named("Top").unwrap_err().to_string();
        assert!(error.contains("\"Top\"") && error.contains("Front, Side"), "{error}");
    }

    #[test]
    fn damaged_views_are_refused_with_their_reason() {
        let refused = |change: fn(&mut Views), reason: &str| {
            let mut views = Views { views: vec![view("a"), view("b")], ..Views::default() };
            change(&mut views);
            let error = Views::parse(&serde_json::to_vec(&views).unwrap()).unwrap_err();
            assert!(error.contains(reason), "{error}");
        };
        refused(|v| v.start = Some("c".into()), "no view is called \"c\"");
        refused(|v| v.views[1].name = "A".into(), "two views are called");
        refused(|v| v.views[1].name = "x".repeat(81), "at most 80");
        refused(|v| v.views[0].name = " a".into(), "spaces");
        refused(|v| v.views[0].rotation = [2.0, 0.0, 0.0, 0.0], "unit quaternion");
        refused(|v| v.views[0].focal = 0.0, "above 0");
        refused(|v| v.version = 2, "version 1");
        refused(|v| v.notes = vec![Note { text: String::new(), at: [0.0; 3] }], "text of a note");
        assert!(Views::parse(b"{}").is_err() && Views::parse(b"[").is_err());
    }

    #[test]
    fn camera_of_view_has_requested_height() {
        let camera = view("a").camera(200);
        assert_eq!((camera.width, camera.height), (300, 200));
        assert_eq!((camera.fy, camera.cx, camera.cy), (240.0, 170.0, 100.0));
        assert!((camera.pose.centre() - DVec3::new(1.0, 2.0, 3.0)).length() < 1e-12);
        // A point straight ahead is at the principal point.
        assert!(
            (camera.project(DVec3::new(1.0, 2.0, 8.0)).0 - glam::DVec2::new(170.0, 100.0)).length() < 1e-9
        );
    }
}
