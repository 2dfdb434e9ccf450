//! `splatvk objects`
use super::args::{DeviceArgs, EditUse, share};
use super::print::{print, print_json};
use super::{progress, scene};
use crate::format::gaussians::FORMATS;
use crate::query::things::OBJECTS;
use crate::run::objects::{self, Listed, NOUNS, Object, ObjectFiles, ObjectOptions};
use crate::{Result, files};
use clap::builder::PossibleValuesParser;
use clap::{Args, ValueEnum};
use std::fmt::Write;
use std::path::{Path, PathBuf};

/// Levels of the files.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum FileLevel {
    /// Things and surfaces, none of them within another
    Object,
    /// Masks of wholes, which may join things with their table
    Whole,
    /// Masks of parts
    Part,
    /// Parts of parts
    Subpart,
}

impl FileLevel {
    /// Index as in [`crate::query::things::LEVELS`].
    fn index(self) -> usize {
        match self {
            FileLevel::Object => OBJECTS,
            FileLevel::Whole => 2,
            FileLevel::Part => 1,
            FileLevel::Subpart => 0,
        }
    }
}

/// `splatvk objects`
#[derive(Debug, Args)]
pub struct ObjectsArgs {
    /// Scene directory with language
    pub scene: PathBuf,
    /// Folder for objects.json, objects.csv, a file and a picture per thing, and scene.ply with the
    /// property `object` [default: only the list, nothing is written]
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Level of the files; objects.json lists all
    #[arg(long, value_enum, default_value = "object")]
    pub level: FileLevel,
    /// Text file with names to choose from, one per line [default: those of the text model]
    #[arg(long, value_name = "FILE")]
    pub vocabulary: Option<PathBuf>,
    /// Smallest share of the opacity of the scene that is a thing
    #[arg(long, default_value_t = objects::LEAST_SHARE, value_name = "SHARE", value_parser = share)]
    pub min_share: f64,
    /// Format of the file of each thing
    #[arg(long, default_value = "ply", value_parser = PossibleValuesParser::new(FORMATS.iter().map(|f| f.name)), value_name = "FORMAT")]
    pub format: String,
    /// Keep the axes and the unit of the scene in the files [default: upright and in metres, as far as
    /// the scene states them]
    #[arg(long, requires = "out")]
    pub raw: bool,
    /// Write over what is there: ordinary files of the same names
    #[arg(long, requires = "out")]
    pub force: bool,
    /// Edits
    #[command(flatten)]
    pub edits: EditUse,
    /// Device and models
    #[command(flatten)]
    pub device: DeviceArgs,
}

pub fn objects(args: &ObjectsArgs) -> Result<()> {
    let inputs = [Some(args.scene.as_path()), args.vocabulary.as_deref()].into_iter().flatten();
    let inputs: Vec<&Path> = inputs.collect();
    let level = args.level.index();
    let files = ObjectFiles { level, format: args.format.clone(), raw: args.raw };
    let out = args.out.as_deref().map(|folder| files.reserve(folder, args.force, &inputs)).transpose()?;
    let vocabulary = args.vocabulary.as_deref().map(vocabulary).transpose()?;
    let mut scene = scene::load(&args.scene, args.edits)?;
    let options = ObjectOptions { vocabulary, least_share: args.min_share };
    let progress = progress::reporter();
    let (ready, list) = objects::of_scene(&mut scene, &args.device.machine(), &options, progress.as_ref())?;
    let report = match (out, &args.out) {
        (Some(out), Some(folder)) => {
            let listed = Listed { scene: &mut scene, ready: &ready, list: &list };
            out.write(listed, folder, progress.as_ref())?
        }
        _ => objects::record(&scene, &list, level)?,
    };
    match args.device.json {
        true => print_json(&report),
        false => print(&table(&list, args)),
    }
}

/// Reads the lines of a vocabulary.
pub fn vocabulary(path: &Path) -> Result<Vec<String>> {
    objects::words(&files::read_text(path)?, &path.display().to_string())
}

/// The list for people: the things of the level, largest first.
fn table(list: &[Object], args: &ObjectsArgs) -> String {
    let level = args.level.index();
    let mut shown: Vec<&Object> = list.iter().filter(|o| o.thing.level == level).collect();
    shown.sort_by(|a, b| b.thing.instance.share.total_cmp(&a.thing.instance.share));
    let width = shown.iter().map(|o| o.name.chars().count()).max().unwrap_or(0).max(4);
    let mut text = String::new();
    for object in &shown {
        let unsure = object.names.iter().find(|_| !object.is_named);
        let unsure = unsure.map_or(String::new(), |name| format!("   unsure: {}", name.text));
        let (id, instance) = (object.thing.id(), &object.thing.instance);
        let _ = writeln!(
            text,
            "{id:>6}  {:<width$}  {:>5.1} %  {:>8} splats{unsure}",
            object.name,
            100.0 * instance.share,
            instance.splats.len()
        );
    }
    let counts = objects::counts(list).into_iter();
    let counts: Vec<String> =
        counts.map(|(noun, all, named)| format!("{all} {noun}s, {named} of them named")).collect();
    let _ = writeln!(text, "{}", counts.join("; "));
    if let Some(out) = &args.out {
        let _ = writeln!(text, "{} files of {}s: {}", shown.len(), NOUNS[level], out.display());
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn vocabulary_is_one_name_per_line() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("words.txt");
        let read = |text: &str| {
            std::fs::write(&path, text).unwrap();
            vocabulary(&path)
        };
        assert_eq!(read("blue mug\n\n  lemon \r\n").unwrap(), ["blue mug", "lemon"]);
        for (text, words) in [("\n \n", "no words"), ("lemon\nlemon\n", "there twice")] {
            let error = read(text).unwrap_err();
            assert!(error.exit_code() == 2 && error.to_string().contains(words), "{error}");
        }
    }
}
