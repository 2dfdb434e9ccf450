//! `splatvk objects`
use super::args::{DeviceArgs, EditUse, share};
use super::export::placement::{Asked, Placement};
use super::outputs::WrittenFiles;
use super::print::{print, print_json};
use super::progress;
use super::scene::{self, scene_name};
use super::views;
use crate::format::gaussians::gltf::{self, Node};
use crate::format::gaussians::{FORMATS, SplatFormat, WriteOptions, write_as};
use crate::format::ply::{self, PlyOptions};
use crate::format::scene_dir::Scene;
use crate::format::{picture, write_json};
use crate::report::file_name;
use crate::run::ask::QueryScene;
use crate::run::objects::{self, NOUNS, Object, ObjectOptions};
use crate::scene::{LEVEL_NAMES, Splats};
use crate::{Error, Result, files};
use clap::builder::PossibleValuesParser;
use clap::{Args, ValueEnum};
use serde_json::{Value, json};
use std::fmt::Write;
use std::path::{Path, PathBuf};

/// Levels of the files.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum FileLevel {
    /// Things as a whole
    Whole,
    /// Their parts
    Part,
    /// Parts of parts
    Subpart,
}

impl FileLevel {
    /// Index as in [`LEVEL_NAMES`].
    fn index(self) -> usize {
        match self {
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
    /// Level of the files; objects.json lists all three
    #[arg(long, value_enum, default_value = "whole")]
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

/// The things of a scene, whose language moves onto the device.
///
/// # Errors
/// A scene without language or without cameras.
pub fn listed(
    scene: &mut Scene,
    device: &DeviceArgs,
    options: &ObjectOptions,
) -> Result<(QueryScene, Vec<Object>)> {
    objects::of_scene(scene, &device.machine(), options, progress::reporter().as_ref())
}

pub fn objects(args: &ObjectsArgs) -> Result<()> {
    let inputs: Vec<&Path> =
        [Some(args.scene.as_path()), args.vocabulary.as_deref()].into_iter().flatten().collect();
    let mut out =
        args.out.as_deref().map(|folder| WrittenFiles::open(folder, args.force, &inputs)).transpose()?;
    let vocabulary = args.vocabulary.as_deref().map(vocabulary).transpose()?;
    let mut scene = scene::load(&args.scene, args.edits)?;
    let options = ObjectOptions { vocabulary, least_share: args.min_share };
    let (ready, list) = listed(&mut scene, &args.device, &options)?;
    let stems = views::stems(&scene.cameras)?;
    let mut entries: Vec<Value> = list.iter().map(|o| o.record(&list, &stems, &scene.world)).collect();
    let mut report = json!({
        "scene": args.scene, "out": args.out, "world": scene.world,
        "level": LEVEL_NAMES[args.level.index()], "files": null,
    });
    if let Some(out) = &mut out {
        let asked = Asked { raw: args.raw, ..Asked::default() };
        let placement = Placement::new(&scene, asked, &args.format)?;
        placement.apply(&mut scene, &mut None);
        progress::reporter().inform(&format!("files are {}", placement.text()));
        report["files"] = placement.json();
        write_files(args, out, &scene, &ready, &list, &mut entries)?;
    }
    report["objects"] = entries.into();
    if let Some(mut out) = out {
        write_json(&out.file("objects.json")?, &report)?;
        out.keep()?;
    }
    match args.device.json {
        true => print_json(&report),
        false => print(&table(&list, args)),
    }
}

/// Reads the lines of a vocabulary.
pub fn vocabulary(path: &Path) -> Result<Vec<String>> {
    let text = files::read_text(path)?;
    let mut words: Vec<String> = Vec::new();
    for line in text.lines().map(str::trim).filter(|line| !line.is_empty()) {
        if words.iter().any(|word| word == line) {
            return Err(Error::input(format!(
                "{}: \"{line}\" is there twice; leave one out",
                path.display()
            )));
        }
        words.push(line.to_owned());
    }
    if words.is_empty() {
        return Err(Error::input(format!("{}: no words; give one name per line", path.display())));
    }
    Ok(words)
}

/// Writes the files of the things of a level, the numbered scene, the table and the pictures, and
/// adds their names to the entries.
fn write_files(
    args: &ObjectsArgs,
    out: &mut WrittenFiles,
    scene: &Scene,
    ready: &QueryScene,
    list: &[Object],
    entries: &mut [Value],
) -> Result<()> {
    let level = args.level.index();
    let format = SplatFormat::named(&args.format).ok_or_else(|| Error::input("--format: unknown"))?;
    for (object, entry) in list.iter().zip(entries).filter(|(o, _)| o.thing.level == level) {
        progress::reporter().check()?;
        let stem = format!("{}-{}", object.id(), file_name(&object.name));
        let name = format!("{stem}{}", format.ending);
        let splats = scene.splats.picked(&object.thing.instance.splats);
        write_as(&out.file(&name)?, &splats, None, format, WriteOptions::default())?;
        entry["file"] = name.into();
        if let Some(best) = &object.best_view {
            let name = format!("pictures/{stem}.png");
            let picture = objects::thumbnail(ready.frames()[best.view].picture(), best);
            picture::write_png(&out.file(&name)?, &picture)?;
            entry["picture"] = name.into();
        }
    }
    let numbers = objects::numbers(list, level, scene.splats.len());
    write_nodes(args, &out.file("scene.glb")?, scene, list)?;
    let options = PlyOptions { objects: Some(&numbers), ..PlyOptions::default() };
    ply::write_splats(&out.file("scene.ply")?, &scene.splats, options)?;
    let csv = csv(list, &scene.world);
    let path = out.file("objects.csv")?;
    std::fs::write(&path, csv).map_err(Error::unwritable(&path))
}

/// Writes the scene with a named node per thing of the level, and one for the rest.
fn write_nodes(args: &ObjectsArgs, path: &Path, scene: &Scene, list: &[Object]) -> Result<()> {
    let of_level: Vec<&Object> = list.iter().filter(|o| o.thing.level == args.level.index()).collect();
    let mut parts: Vec<Splats> =
        of_level.iter().map(|o| scene.splats.picked(&o.thing.instance.splats)).collect();
    let numbers = objects::numbers(list, args.level.index(), scene.splats.len());
    let rest: Vec<usize> = (0..numbers.len()).filter(|i| numbers[*i] == 0).collect();
    let mut names: Vec<(&str, Value)> =
        of_level.iter().map(|o| (o.name.as_str(), json!({ "id": o.id(), "named": o.is_named }))).collect();
    if !rest.is_empty() {
        parts.push(scene.splats.picked(&rest));
        names.push((REST, json!({})));
    }
    let nodes = names.into_iter().zip(&parts);
    let nodes: Vec<Node> = nodes.map(|((name, extras), splats)| Node { name, splats, extras }).collect();
    gltf::write_nodes(path, &scene_name(&args.scene), &nodes)
}

/// Name of the splats of no thing.
const REST: &str = "rest";

/// A row per thing.
fn csv(list: &[Object], world: &crate::scene::World) -> String {
    let mut text =
        "id,number,level,parent,name,named,splats,share,reliability,x,y,z,size_1,size_2,size_3,metres_1,metres_2,metres_3\n"
            .to_owned();
    for object in list {
        let instance = &object.thing.instance;
        let parent = object.thing.parent.and_then(|k| list.get(k)).map(Object::id).unwrap_or_default();
        let (centre, size) = (instance.centre, instance.oriented.size);
        let metres = match &world.scale {
            Some(scale) => (size * scale.metres_per_unit).to_array().map(|v| format!("{v:.4}")).join(","),
            None => ",,".to_owned(),
        };
        let reliability = instance.reliability.map_or(String::new(), |r| format!("{r:.3}"));
        // Writing to a String cannot fail.
        let _ = writeln!(
            text,
            "{},{},{},{parent},{},{},{},{:.6},{reliability},{:.5},{:.5},{:.5},{:.5},{:.5},{:.5},{metres}",
            object.id(),
            object.thing.number(),
            LEVEL_NAMES[object.thing.level],
            quoted(&object.name),
            object.is_named,
            instance.splats.len(),
            instance.share,
            centre.x,
            centre.y,
            centre.z,
            size.x,
            size.y,
            size.z
        );
    }
    text
}

/// A field of a CSV file (RFC 4180).
fn quoted(text: &str) -> String {
    match text.contains([',', '"', '\n', '\r']) {
        true => format!("\"{}\"", text.replace('"', "\"\"")),
        false => text.to_owned(),
    }
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
        let (id, instance) = (object.id(), &object.thing.instance);
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
    fn csv_fields_are_quoted() {
        assert_eq!(quoted("blue mug"), "blue mug");
        assert_eq!(quoted("a \"b\", c"), "\"a \"\"b\"\", c\"");
    }

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
