//! `splatvk export`
mod losses;
mod output;
mod page;
pub mod placement;

pub use output::{format, is_folder};

use super::args::EditUse;
use super::print::{print, print_json};
use super::progress;
use super::scene;
use crate::format::gaussians::{FORMATS, WriteOptions};
use crate::format::scene_dir::Scene;
use crate::format::{colmap, ply, spz, transforms};
use crate::report::thousands;
use crate::scene::{Camera, UpAxis};
use crate::{Error, Result};
use clap::Args;
use clap::builder::{PossibleValue, PossibleValuesParser};
use losses::{warn_of_losses, warn_of_models};
use output::{Output, check_ending};
use placement::{Asked, Placement, up_axis};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

/// `splatvk export`
#[derive(Debug, Args)]
pub struct ExportArgs {
    /// Scene directory, or a file of Gaussians: .ply (compressed, too), .splat, .spz, .sog, .glb,
    /// .gltf
    pub scene: PathBuf,
    /// File, or folder (colmap, colmap-bin)
    #[arg(required_unless_present = "out")]
    pub file: Option<PathBuf>,
    /// FILE as an option
    #[arg(long, value_name = "PATH", conflicts_with = "file")]
    pub out: Option<PathBuf>,
    /// Format of the file; language goes beside the files of Gaussians, into FILE.language.npz
    /// (ply: --with-features) [default: by the ending of FILE]
    #[arg(long, value_parser = formats(), value_name = "FORMAT")]
    pub format: Option<String>,
    /// Write over what is there: an ordinary file, or those of the same names in a folder
    #[arg(long)]
    pub force: bool,
    /// ply: spherical-harmonics degree of the file, padded with zeros; most viewers ask for 3
    #[arg(long, default_value_t = 3, value_parser = super::args::whole::<u32>(0..=3), value_name = "0-3")]
    pub ply_degree: u32,
    /// spz: version of the file; 3 is read by Niantic, SuperSplat, three.js, Spark and Babylon.js, 4
    /// by SuperSplat, three.js and PlayCanvas (its only one), not by Spark; 2 by older ones
    /// [default: 3]
    #[arg(long, value_parser = clap::value_parser!(u32).range(2..=4), value_name = "2-4")]
    pub spz_version: Option<u32>,
    /// ply: add the language features and codes as extra columns
    #[arg(long)]
    pub with_features: bool,
    /// html: heading of the page [default: name of the scene]
    #[arg(long, value_name = "TEXT")]
    pub title: Option<String>,
    /// html: named views and notes from another file than the scene's own views.json
    #[arg(long, value_name = "FILE")]
    pub views: Option<PathBuf>,
    /// Keep what no photo shows: surfaces continued beyond the photos and behind what stands in
    /// front, and the blurred colours behind the scene (html: the page has them, key G hides them)
    #[arg(long)]
    pub guessed: bool,
    /// The default since guessed surfaces are left out; kept for scripts.
    #[arg(long, hide = true, conflicts_with = "guessed")]
    pub only_seen: bool,
    /// Axis that points up: -y (right, down, forward), y (right, up, back) or z (right, forward,
    /// up); spz, glb and gltf have y [default: y for these, else -y, where the scene states up]
    #[arg(long, value_parser = up_axis, allow_hyphen_values = true, value_name = "AXIS")]
    pub up: Option<UpAxis>,
    /// Scale to metres, and refuse a scene whose metres are not known (splatvk measure --scale)
    /// [default: metres where they are known]
    #[arg(long)]
    pub metres: bool,
    /// Keep the axes and the unit of the scene, as its own cameras have them, except for those that
    /// --up and --metres name
    #[arg(long)]
    pub raw: bool,
    /// Edits
    #[command(flatten)]
    pub edits: EditUse,
    /// Print one JSON object on standard output
    #[arg(long)]
    pub json: bool,
}

impl ExportArgs {
    /// The file or folder to write.
    fn place(&self) -> &Path {
        // The parser requires one of the two.
        self.file.as_deref().or(self.out.as_deref()).unwrap_or(Path::new(""))
    }
}

fn formats() -> PossibleValuesParser {
    let splats = FORMATS.iter().map(|f| PossibleValue::new(f.name).help(f.about));
    let others = [
        ("html", "the interactive view as one page, to look at and to send"),
        ("colmap", "COLMAP text model"),
        ("colmap-bin", "COLMAP binary model"),
        ("transforms", "nerfstudio transforms.json"),
    ];
    PossibleValuesParser::new(splats.chain(others.map(|(name, about)| PossibleValue::new(name).help(about))))
}

/// A finished export: one line on what was done, also as the `summary` of a JSON object.
pub struct Exported {
    text: String,
    json: Value,
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

pub fn export(args: &ExportArgs) -> Result<()> {
    let done = write(args)?;
    progress::reporter().inform(&done.text);
    if args.json {
        let mut told = done.json;
        told["files"] = json!([args.place()]);
        return print_json(&told);
    }
    print(&format!("{}\n", args.place().display()))
}

/// Writes the file or the folder of an export.
pub fn write(args: &ExportArgs) -> Result<Exported> {
    let format = format(args)?;
    if format == "html" {
        page::check(args)?;
    } else if args.title.is_some() {
        return Err(Error::input("--title: only --format html has a heading; leave it out"));
    } else if args.views.is_some() {
        return Err(Error::input("--views: only --format html has named views; leave it out"));
    }
    let out = Output::reserve(args, format)?;
    let mut scene = scene::load(&args.scene, args.edits)?;
    let out = match out {
        Output::File(file) if format == "html" => return page::write(args, &scene, file),
        other => other,
    };
    let content = select(&mut scene, args.guessed);
    let asked = Asked { up: args.up, metres: args.metres, raw: args.raw };
    let placement = Placement::new(&scene, asked, format)?;
    let mut points = match is_folder(format) {
        true => colmap::read_points(&args.scene.join("cameras/colmap")).ok(),
        false => None,
    };
    placement.apply(&mut scene, &mut points);
    progress::reporter().check()?;
    let content = match out {
        Output::Folder(mut folder) => {
            let cameras = cameras(&scene, args)?;
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
            warn_of_losses(&scene.splats, splat_format);
            warn_of_models(&scene);
            let options = WriteOptions { spz_version: args.spz_version.unwrap_or(spz::DEFAULT_VERSION) };
            files.write(&scene.splats, scene.language.as_ref(), splat_format, options)?;
            content
        }
        Output::File(file) if format == "transforms" => {
            let cameras = cameras(&scene, args)?;
            file.keep(|path| transforms::write(path, cameras, None))?;
            Content::Cameras { cameras: cameras.len(), points: None }
        }
        Output::File(file) => {
            let language = if args.with_features { scene.language.as_ref() } else { None };
            if args.with_features && language.is_none() {
                return Err(Error::input(format!(
                    "{}: the scene has no language; leave --with-features out",
                    args.scene.display()
                )));
            }
            if args.with_features {
                warn_of_models(&scene);
            }
            let options = ply::PlyOptions { degree: args.ply_degree, language, objects: None };
            file.keep(|path| ply::write_splats(path, &scene.splats, options))?;
            content
        }
    };
    if let Some(warning) = check_ending(args.place(), format)? {
        progress::reporter().warn(&warning);
    }
    Ok(Exported::placed(&placement, &content))
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

fn cameras<'a>(scene: &'a Scene, args: &ExportArgs) -> Result<&'a [Camera]> {
    if scene.cameras.is_empty() {
        return Err(Error::input(format!(
            "{}: a file of Gaussians has no cameras; give a scene directory",
            args.scene.display()
        )));
    }
    Ok(&scene.cameras)
}
