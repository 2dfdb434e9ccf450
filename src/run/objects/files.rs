//! The things of a scene as files: a list, a table, splats and a picture per thing, and the whole
//! scene (docs/use/objects.md).
use super::{Object, numbers, thumbnail};
use crate::format::gaussians::gltf::{self, Node};
use crate::format::gaussians::{SplatFormat, WriteOptions, write_as};
use crate::format::ply::{self, PlyOptions};
use crate::format::scene_dir::Scene;
use crate::format::{picture, write_json};
use crate::photo::stems_apart;
use crate::progress::Progress;
use crate::query::things::{LEVELS, OBJECTS};
use crate::report::file_name;
use crate::run::ask::QueryScene;
use crate::run::export::{Asked, Placement};
use crate::run::outputs::WrittenFiles;
use crate::run::stored;
use crate::scene::{Camera, Splats, World};
use crate::{Error, Result};
use serde_json::{Value, json};
use std::fmt::Write;
use std::path::Path;

/// Settings of the files of things.
#[derive(Clone, Debug)]
pub struct ObjectFiles {
    /// Level of the files, an index of [`LEVELS`]; objects.json lists all.
    pub level: usize,
    /// Name of the format of the file of each thing.
    pub format: String,
    /// Keep the axes and the unit of the scene.
    pub raw: bool,
}

impl Default for ObjectFiles {
    fn default() -> Self {
        ObjectFiles { level: OBJECTS, format: "ply".to_owned(), raw: false }
    }
}

/// A reserved folder for the files of things.
pub struct ObjectFolder<'a> {
    files: &'a ObjectFiles,
    format: &'static SplatFormat,
    out: WrittenFiles,
}

/// Things of a scene with the state that found them.
pub struct Listed<'a> {
    /// The scene, whose language is on the device.
    pub scene: &'a mut Scene,
    /// Its words and views.
    pub ready: &'a QueryScene,
    /// Its things.
    pub list: &'a [Object],
}

impl ObjectFiles {
    /// Reserves a folder before the scene is read; with `force` ordinary files of the same names
    /// may be replaced, but none of `inputs`.
    ///
    /// # Errors
    /// Unknown formats and levels, and places that may not be written.
    pub fn reserve(&self, folder: &Path, force: bool, inputs: &[&Path]) -> Result<ObjectFolder<'_>> {
        let format = SplatFormat::named(&self.format)
            .ok_or_else(|| Error::input(format!("--format: there is no format {} of splats", self.format)))?;
        if self.level >= LEVELS.len() {
            return Err(Error::input(format!("--level: there is no level {}", self.level)));
        }
        Ok(ObjectFolder { files: self, format, out: WrittenFiles::open(folder, force, inputs)? })
    }
}

/// Record of the things of a scene: objects.json, as far as no files are written.
///
/// # Errors
/// Two cameras of one name.
pub fn record(scene: &Scene, list: &[Object], level: usize) -> Result<Value> {
    let stems = stems(&scene.cameras)?;
    let entries: Vec<Value> = list.iter().map(|o| o.record(list, &stems, &scene.world)).collect();
    Ok(json!({
        "scene": scene.path, "out": null, "world": scene.world, "level": LEVELS[level], "files": null,
        "objects": entries,
    }))
}

impl ObjectFolder<'_> {
    /// Writes the files and returns objects.json; the splats of the scene take the place of the
    /// files.
    ///
    /// # Errors
    /// Places that cannot be written, and files that appeared meanwhile.
    pub fn write(self, listed: Listed, out: &Path, progress: &dyn Progress) -> Result<Value> {
        let Listed { scene, ready, list } = listed;
        let mut report = record(scene, list, self.files.level)?;
        let asked = Asked { raw: self.files.raw, ..Asked::default() };
        let placement = Placement::new(scene, asked, &self.files.format)?;
        placement.apply(scene, &mut None);
        progress.inform(&format!("files are {}", placement.text()));
        report["out"] = json!(out);
        report["files"] = placement.json();
        let mut folder = self;
        let no_entries = || Error::work("a record without objects");
        let entries = report["objects"].as_array_mut().ok_or_else(no_entries)?;
        folder.write_files(scene, ready, list, entries, progress)?;
        let mut out = folder.out;
        write_json(&out.file("objects.json")?, &report)?;
        out.keep()?;
        Ok(report)
    }

    /// Writes the files of the things of a level, the numbered scene, the table and the pictures,
    /// and adds their names to the entries.
    fn write_files(
        &mut self,
        scene: &Scene,
        ready: &QueryScene,
        list: &[Object],
        entries: &mut [Value],
        progress: &dyn Progress,
    ) -> Result<()> {
        let level = self.files.level;
        for (object, entry) in list.iter().zip(entries).filter(|(o, _)| o.thing.level == level) {
            progress.check()?;
            let stem = format!("{}-{}", object.thing.id(), file_name(&object.name));
            let name = format!("{stem}{}", self.format.ending);
            let splats = scene.splats.picked(&object.thing.instance.splats);
            write_as(&self.out.file(&name)?, &splats, None, self.format, WriteOptions::default())?;
            entry["file"] = name.into();
            if let Some(best) = &object.best_view {
                let name = format!("pictures/{stem}.png");
                let picture = thumbnail(ready.frames()[best.view].picture(), best);
                picture::write_png(&self.out.file(&name)?, &picture)?;
                entry["picture"] = name.into();
            }
        }
        let numbers = numbers(list, level, scene.splats.len());
        write_nodes(&self.out.file("scene.glb")?, scene, list, level, &numbers)?;
        let options = PlyOptions { objects: Some(&numbers), ..PlyOptions::default() };
        ply::write_splats(&self.out.file("scene.ply")?, &scene.splats, options)?;
        let csv = csv(list, &scene.world);
        let path = self.out.file("objects.csv")?;
        std::fs::write(&path, csv).map_err(Error::unwritable(&path))
    }
}

/// Writes the scene with a named node per thing of the level, and one for the rest.
fn write_nodes(path: &Path, scene: &Scene, list: &[Object], level: usize, numbers: &[u32]) -> Result<()> {
    let of_level: Vec<&Object> = list.iter().filter(|o| o.thing.level == level).collect();
    let mut parts: Vec<Splats> =
        of_level.iter().map(|o| scene.splats.picked(&o.thing.instance.splats)).collect();
    let rest: Vec<usize> = (0..numbers.len()).filter(|i| numbers[*i] == 0).collect();
    let mut names: Vec<(&str, Value)> = of_level
        .iter()
        .map(|o| (o.name.as_str(), json!({ "id": o.thing.id(), "named": o.is_named })))
        .collect();
    if !rest.is_empty() {
        parts.push(scene.splats.picked(&rest));
        names.push((REST, json!({})));
    }
    let nodes = names.into_iter().zip(&parts);
    let nodes: Vec<Node> = nodes.map(|((name, extras), splats)| Node { name, splats, extras }).collect();
    gltf::write_nodes(path, &stored::name(&scene.path), &nodes)
}

/// Name of the splats of no thing.
const REST: &str = "rest";

/// A row per thing.
fn csv(list: &[Object], world: &World) -> String {
    let mut text =
        "id,number,level,parent,name,named,splats,share,reliability,x,y,z,size_1,size_2,size_3,metres_1,metres_2,metres_3\n"
            .to_owned();
    for object in list {
        let instance = &object.thing.instance;
        let parent = object.thing.parent.and_then(|k| list.get(k)).map(|o| o.thing.id()).unwrap_or_default();
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
            object.thing.id(),
            object.thing.number(),
            LEVELS[object.thing.level],
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

/// One stem per camera, with parent folders where file names repeat. Two equal names are refused:
/// their files would overwrite each other.
///
/// # Errors
/// Two cameras of one name.
pub fn stems(list: &[Camera]) -> Result<Vec<String>> {
    let stems = stems_apart(&list.iter().map(|c| c.name.as_str()).collect::<Vec<_>>());
    for (i, stem) in stems.iter().enumerate() {
        if stems[..i].contains(stem) {
            return Err(Error::input(format!(
                "two cameras have the name \"{stem}\"; rename one in the camera file"
            )));
        }
    }
    Ok(stems)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn csv_fields_are_quoted() {
        assert_eq!(quoted("blue mug"), "blue mug");
        assert_eq!(quoted("a \"b\", c"), "\"a \"\"b\"\", c\"");
    }
}
