//! A scene as a file of another program: format, selected splats, axes and unit
//! (docs/use/export.md).
mod losses;
mod output;
mod page;
mod placement;

pub use output::{format, formats, is_folder};
pub use placement::{Asked, Placement, up_axis};

use crate::format::gaussians::WriteOptions;
use crate::format::scene_dir::Scene;
use crate::format::{colmap, ply, spz, transforms};
use crate::progress::Progress;
use crate::report::thousands;
use crate::scene::Camera;
use crate::{Error, Result};
use losses::{warn_of_losses, warn_of_models};
use output::{Output, check_ending};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

/// Settings of an export.
#[derive(Clone, Debug)]
pub struct ExportPlan {
    /// Name of the format; `None` = by the ending of the file.
    pub format: Option<String>,
    /// ply: degree of the spherical harmonics of the file, 0 to 3, padded with zeros.
    pub ply_degree: u32,
    /// spz: version of the file, 2 to 4; `None` = [`spz::DEFAULT_VERSION`].
    pub spz_version: Option<u32>,
    /// ply: features and codes as extra columns.
    pub with_features: bool,
    /// html: heading of the page; `None` = the name of the scene.
    pub title: Option<String>,
    /// html: file of named views; `None` = that of the scene.
    pub views: Option<PathBuf>,
    /// Keep the splats that no photo shows, and the backdrop.
    pub guessed: bool,
    /// Axes and unit.
    pub asked: Asked,
}

impl Default for ExportPlan {
    fn default() -> Self {
        ExportPlan {
            format: None,
            ply_degree: 3,
            spz_version: None,
            with_features: false,
            title: None,
            views: None,
            guessed: false,
            asked: Asked::default(),
        }
    }
}

/// A checked export whose output is reserved.
pub struct Export<'a> {
    plan: &'a ExportPlan,
    file: &'a Path,
    format: &'a str,
    out: Output,
}

/// A finished export: one line on what was done, also as the `summary` of a JSON object.
pub struct Exported {
    /// The line.
    pub text: String,
    /// Axes, unit, numbers.
    pub json: Value,
}

/// Written things.
enum Content {
    /// Splats; those that no photo shows are `left_out` or `kept` among them.
    Splats { written: usize, left_out: usize, kept: usize },
    /// Cameras, with the points of a COLMAP model.
    Cameras { cameras: usize, points: Option<usize> },
}

impl Exported {
    fn new(text: String, mut json: Value) -> Exported {
        json["summary"] = text.as_str().into();
        Exported { text, json }
    }

    fn placed(placement: &Placement, content: &Content) -> Exported {
        let text = format!("{}, {}", placement.text(), content.text());
        let mut json = placement.json();
        match *content {
            Content::Splats { written, left_out, kept } => {
                json["splats"] = written.into();
                json["guessed"] = json!({ "left_out": left_out, "kept": kept });
            }
            Content::Cameras { cameras, points } => {
                json["cameras"] = cameras.into();
                json["points"] = points.into();
            }
        }
        Exported::new(text, json)
    }
}

impl Content {
    fn text(&self) -> String {
        match *self {
            Content::Splats { written, left_out: 0, kept: 0 } => counted(written, "splat"),
            Content::Splats { written, left_out: 0, kept } => {
                format!("{}, {} of them guessed", counted(written, "splat"), thousands(kept))
            }
            Content::Splats { written, left_out, .. } => format!(
                "{}; {} that no photo shows left out: --guessed keeps them",
                counted(written, "splat"),
                thousands(left_out)
            ),
            Content::Cameras { cameras, points: None } => counted(cameras, "camera"),
            Content::Cameras { cameras, points: Some(points) } => {
                format!("{}, {}", counted(cameras, "camera"), counted(points, "point"))
            }
        }
    }
}

fn counted(n: usize, noun: &str) -> String {
    format!("{} {noun}{}", thousands(n), if n == 1 { "" } else { "s" })
}

impl ExportPlan {
    /// Reserves a file or a folder before the scene at `scene` is read; with `force` an ordinary
    /// file, or files of the same names in the folder, may be replaced.
    ///
    /// # Errors
    /// Options that do not fit the format, and places that may not be written.
    pub fn reserve<'a>(&'a self, scene: &Path, file: &'a Path, force: bool) -> Result<Export<'a>> {
        let format = format(self.format.as_deref(), file)?;
        if format == "html" {
            page::check(self)?;
        } else if self.title.is_some() {
            return Err(Error::input("--title: only --format html has a heading; leave it out"));
        } else if self.views.is_some() {
            return Err(Error::input("--views: only --format html has named views; leave it out"));
        }
        if self.spz_version.is_some() && format != "spz" {
            return Err(Error::input("--spz-version: only --format spz has versions; leave it out"));
        }
        Ok(Export { plan: self, file, format, out: Output::reserve(scene, file, format, force)? })
    }
}

impl Export<'_> {
    /// Writes a scene.
    ///
    /// # Errors
    /// A scene that lacks the cameras, the language, the direction up or the scale that are asked
    /// for.
    pub fn write(self, mut scene: Scene, progress: &dyn Progress) -> Result<Exported> {
        let Export { plan, file: place, format, out } = self;
        if scene.path.as_os_str().is_empty() && (format == "html" || is_folder(format)) {
            return Err(Error::input(format!(
                "--format {format}: save the scene first, its photos and points are there"
            )));
        }
        let out = match out {
            Output::File(file) if format == "html" => return page::write(plan, &scene, file),
            other => other,
        };
        let content = select(&mut scene, plan.guessed);
        let placement = Placement::new(&scene, plan.asked, format)?;
        let mut points = match is_folder(format) {
            true => colmap::read_points(&scene.path.join("cameras/colmap")).ok(),
            false => None,
        };
        placement.apply(&mut scene, &mut points);
        progress.check()?;
        let content = match out {
            Output::Folder(mut folder) => {
                let cameras = cameras(&scene)?;
                let [text, binary] = colmap::FILES;
                let (write, other): (fn(&_, &_, _) -> _, _) = match format {
                    "colmap" => (colmap::write, binary),
                    _ => (colmap::write_binary, text),
                };
                write(folder.folder(), cameras, points.as_ref())?;
                folder.outdate(other.into_iter());
                folder.keep()?;
                Content::Cameras { cameras: cameras.len(), points: points.map(|points| points.len()) }
            }
            Output::Splats(files, splat_format) => {
                warn_of_losses(&scene.splats, splat_format, progress);
                warn_of_models(&scene, progress);
                let options = WriteOptions { spz_version: plan.spz_version.unwrap_or(spz::DEFAULT_VERSION) };
                files.write(&scene.splats, scene.language.as_ref(), splat_format, options)?;
                content
            }
            Output::File(file) if format == "transforms" => {
                let cameras = cameras(&scene)?;
                file.keep(|path| transforms::write(path, cameras, None))?;
                Content::Cameras { cameras: cameras.len(), points: None }
            }
            Output::File(file) => {
                let language = if plan.with_features { scene.language.as_ref() } else { None };
                if plan.with_features && language.is_none() {
                    return Err(Error::input(format!(
                        "{}: the scene has no language; leave --with-features out",
                        scene.path.display()
                    )));
                }
                if plan.with_features {
                    warn_of_models(&scene, progress);
                }
                let options = ply::PlyOptions { degree: plan.ply_degree, language, objects: None };
                file.keep(|path| ply::write_splats(path, &scene.splats, options))?;
                content
            }
        };
        if let Some(warning) = check_ending(place, format)? {
            progress.warn(&warning);
        }
        Ok(Exported::placed(&placement, &content))
    }
}

/// Drops the splats that no photo shows, or adds those behind the scene.
fn select(scene: &mut Scene, guessed: bool) -> Content {
    // A bare file of Gaussians is exported as it is.
    let unseen = if scene.seen.pixels.is_empty() { 0 } else { scene.seen.unseen() } + scene.backdrop.len();
    match guessed {
        true => add_backdrop(scene),
        false => keep_seen(scene),
    }
    let (left_out, kept) = if guessed { (0, unseen) } else { (unseen, 0) };
    Content::Splats { written: scene.splats.len(), left_out, kept }
}

/// Appends the backdrop, without language.
fn add_backdrop(scene: &mut Scene) {
    let (before, more) = (scene.splats.len(), std::mem::take(&mut scene.backdrop));
    if more.is_empty() {
        return;
    }
    scene.language = scene.language.take().map(|field| field.extended(&more, before));
    scene.splats.append_raised(more);
}

/// Drops splats that no photo shows.
fn keep_seen(scene: &mut Scene) {
    // A bare file of Gaussians is exported as it is.
    if scene.seen.pixels.is_empty() {
        return;
    }
    let rows = scene.seen.rows(&scene.splats);
    scene.language = scene.language.take().map(|field| field.picked(&rows, scene.splats.len()));
    scene.splats = scene.splats.picked(&rows);
}

fn cameras(scene: &Scene) -> Result<&[Camera]> {
    if scene.cameras.is_empty() {
        return Err(Error::input(format!(
            "{}: a file of Gaussians has no cameras; give a scene directory",
            scene.path.display()
        )));
    }
    Ok(&scene.cameras)
}
