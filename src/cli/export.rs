//! `splatvk export`
use super::args::EditUse;
use super::print::{print, print_json};
use super::progress;
use super::scene;
use crate::Result;
use crate::run::export::{self, Asked, ExportPlan, Exported};
use crate::scene::UpAxis;
use clap::Args;
use clap::builder::{PossibleValue, PossibleValuesParser};
use serde_json::json;
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
    #[arg(long, value_parser = export::up_axis, allow_hyphen_values = true, value_name = "AXIS")]
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

    fn plan(&self) -> ExportPlan {
        ExportPlan {
            format: self.format.clone(),
            ply_degree: self.ply_degree,
            spz_version: self.spz_version,
            with_features: self.with_features,
            title: self.title.clone(),
            views: self.views.clone(),
            guessed: self.guessed,
            asked: Asked { up: self.up, metres: self.metres, raw: self.raw },
        }
    }

    /// Refuses options that state no format.
    pub fn check(&self) -> Result<()> {
        export::format(self.format.as_deref(), self.place()).map(drop)
    }
}

fn formats() -> PossibleValuesParser {
    PossibleValuesParser::new(export::formats().map(|(name, about)| PossibleValue::new(name).help(about)))
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
    let plan = args.plan();
    let out = plan.reserve(&args.scene, args.place(), args.force)?;
    out.write(scene::load(&args.scene, args.edits)?, progress::reporter().as_ref())
}
