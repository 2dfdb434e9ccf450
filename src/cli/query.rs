//! `splatvk query`
use super::args::QueryArgs;
use super::line::one_line;
use super::print::{print, print_json};
use super::progress;
use super::scene;
use super::views;
use crate::format::ply::{self, PlyOptions};
use crate::format::scene_dir::Scene;
use crate::format::{picture, write_json};
use crate::gpu;
use crate::infer::concepts::Concepts;
use crate::infer::installed::Task;
use crate::pass::RenderedFrame;
use crate::progress::Progress;
use crate::query::instances::Instance;
use crate::query::phrasing;
use crate::query::presence::Presence;
use crate::query::{QueryOptions, QueryResult};
use crate::report::{colour, file_name};
use crate::run::Compat;
use crate::run::answer::{self, Answers};
use crate::run::ask::QueryScene;
use crate::run::concepts::{self, ConceptScene};
use crate::run::encoder;
use crate::run::outputs::WrittenFiles;
use crate::scene::{Camera, LEVEL_NAMES, RgbImage, Splats, World};
use crate::{Error, Result};
use glam::DVec2;
use serde_json::{Value, json};
use std::fmt::Write;
use std::path::Path;
use std::time::Instant;

/// Cameras whose frames are kept together.
const AT_ONCE: usize = 16;

pub fn query(args: &QueryArgs) -> Result<()> {
    let inputs = [Some(args.scene.as_path()), args.cameras.as_deref()];
    let inputs: Vec<_> = inputs.into_iter().flatten().collect();
    let open = |folder| WrittenFiles::open(folder, args.force, &inputs);
    let mut out = args.out.as_deref().map(open).transpose()?;
    let mut scene = scene::load(&args.scene, args.edits)?;
    if scene.language.is_none() && args.concepts.is_none() {
        return Err(no_language(args));
    }
    let cameras = match &args.cameras {
        Some(file) => views::read(file)?,
        None => scene.cameras.clone(),
    };
    if cameras.is_empty() {
        return Err(Error::input(format!(
            "{}: a file of Gaussians has no cameras, and answers are given in views; add --cameras FILE",
            args.scene.display()
        )));
    }
    let stems = views::stems(&cameras)?;
    let folders: Vec<String> = args.texts.iter().map(|t| file_name(t)).collect();
    for (i, folder) in folders.iter().enumerate() {
        phrasing::check(&args.texts[i])?;
        if args.out.is_some() && folders[..i].contains(folder) {
            return Err(Error::input(format!(
                "\"{}\" is asked twice (its files would be the same); ask once",
                args.texts[i]
            )));
        }
    }
    let progress = progress::reporter();
    let mut ready = match &args.concepts {
        Some(network) => concepts(args, network, &mut scene, &cameras, progress.as_ref())?,
        None => language(args, &mut scene)?,
    };
    progress.begin("query", cameras.len() as u64);
    let mut all: Vec<TextAnswers> = args.texts.iter().map(|_| TextAnswers::default()).collect();
    for (part, (cameras, stems)) in cameras.chunks(AT_ONCE).zip(stems.chunks(AT_ONCE)).enumerate() {
        progress.check()?;
        ready.set_views(cameras)?;
        for ((text, folder), joined) in args.texts.iter().zip(&folders).zip(&mut all) {
            let clock = Instant::now();
            let answers = ready.ask(text)?;
            let before = joined.views.len();
            joined.milliseconds += 1e3 * clock.elapsed().as_secs_f64();
            for (((frame, stem), camera), answer) in
                ready.frames().into_iter().zip(stems).zip(cameras).zip(&answers.views)
            {
                let place = place_json(frame, camera, answer, &scene.world);
                let mut view = to_json(stem, answer, ready.level_name(answer.level), &place);
                if let Some(out) = &mut out {
                    write(out, stem, folder, &frame.rgb, answer, &mut view)?;
                }
                view["reliability"] = answers.view_reliability[joined.views.len() - before].into();
                joined.views.push(view);
            }
            joined.join(answers);
        }
        progress.step((part * AT_ONCE + cameras.len()) as u64, "");
    }
    progress.end();
    let mut queries = Vec::new();
    for (joined, folder) in all.iter().zip(&folders) {
        let Some(answers) = &joined.answers else { continue };
        let mut entry = answers.record(&stems, &scene.world);
        (entry["milliseconds"], entry["views"]) = (joined.milliseconds.into(), joined.views.clone().into());
        entry["embedded_by"] = json!(ready.embedded_by(&answers.text));
        if let Some(out) = out.as_mut().filter(|_| args.splats) {
            let (selection, name) = (&answers.selection, format!("{folder}/splats.ply"));
            let splats = ready.carrier(selection.level, &scene.splats).picked(&selection.splats);
            ply::write_splats(&out.file(&name)?, &splats, PlyOptions::default())?;
            entry["splats"] = json!({
                "count": selection.splats.len(), "level": ready.level_name(selection.level), "found": selection.found,
                "file": name,
            });
        }
        queries.push(entry);
    }
    ready.warning().iter().for_each(|warning| progress.warn(warning));
    let report = json!({ "scene": args.scene, "out": args.out, "world": scene.world, "queries": queries });
    if let Some(mut out) = out {
        write_json(&out.file("answers.json")?, &report)?;
        out.keep()?;
    }
    match (args.device.json, &args.out) {
        (true, _) => print_json(&report),
        (false, Some(folder)) => print(&table(&all, &stems, folder)),
        (false, None) => print(&short_table(&all)),
    }
}

fn no_language(args: &QueryArgs) -> Error {
    Error::input(format!(
        "{}: the scene has no language; make one with splatvk run, or ask a network about its photos: --concepts sam3",
        args.scene.display()
    ))
}

/// Source of the answers.
enum Source {
    /// The scene's language.
    Language(Box<QueryScene>, QueryOptions),
    /// A network that looked at the photos.
    Concepts(Box<ConceptScene>),
}

/// Prepares the language of a scene.
fn language(args: &QueryArgs, scene: &mut Scene) -> Result<Source> {
    let encoder = encoder::of_scene(scene, args.device.registry()?)?;
    let device = gpu::open(args.device.device.as_deref())?;
    let field = scene.language.take().ok_or_else(|| no_language(args))?;
    let ready = QueryScene::open(&device, (&scene.splats, &scene.cameras), field, encoder)?;
    Ok(Source::Language(Box::new(ready), Compat::answers(args.compat.as_deref(), &args.scene)?))
}

/// Asks a network about the photos of a scene. The photos of a file of Gaussians have the cameras
/// of the views.
fn concepts(
    args: &QueryArgs,
    network: &str,
    scene: &mut Scene,
    views: &[Camera],
    progress: &dyn Progress,
) -> Result<Source> {
    let registry = args.device.registry()?;
    let mut network = Concepts::load(registry.installed(Task::Concepts, network)?)?;
    let named = if scene.cameras.is_empty() { views } else { &scene.cameras };
    let (cameras, photos) = concepts::photos(scene, named, args.photos.as_deref(), progress)?;
    let device = gpu::open(args.device.device.as_deref())?;
    let photos = (&cameras[..], &photos[..]);
    let ready =
        ConceptScene::open(&device, scene.splats.clone(), photos, &mut network, &args.texts, progress)?;
    registry.compute().report(progress)?;
    Ok(Source::Concepts(Box::new(ready)))
}

impl Source {
    fn set_views(&mut self, cameras: &[Camera]) -> Result<()> {
        match self {
            Source::Language(scene, _) => scene.set_views(cameras).map(drop),
            Source::Concepts(scene) => scene.set_views(cameras),
        }
    }

    fn ask(&mut self, text: &str) -> Result<Answers> {
        match self {
            Source::Language(scene, options) => scene.ask(text, options),
            Source::Concepts(scene) => scene.ask(text),
        }
    }

    fn frames(&self) -> Vec<&RenderedFrame> {
        match self {
            Source::Language(scene, _) => scene.frames().iter().map(|f| &f.rendered).collect(),
            Source::Concepts(scene) => scene.frames().iter().collect(),
        }
    }

    /// Name of a level; masks of a concept network have none.
    fn level_name(&self, level: usize) -> Option<&'static str> {
        match self {
            Source::Language(..) => LEVEL_NAMES.get(level).copied(),
            Source::Concepts(_) => None,
        }
    }

    /// Splats that a selection counts.
    fn carrier<'s>(&'s self, level: usize, splats: &'s Splats) -> &'s Splats {
        match self {
            Source::Language(scene, _) => scene.field().levels[level].carrier(splats),
            Source::Concepts(_) => splats,
        }
    }

    fn embedded_by(&self, text: &str) -> Option<String> {
        match self {
            Source::Language(scene, _) => scene.encoder().embedding_source(text),
            Source::Concepts(_) => None,
        }
    }

    fn warning(&self) -> Option<String> {
        match self {
            Source::Language(scene, _) => scene.encoder().embedding_warning(),
            Source::Concepts(_) => None,
        }
    }
}

/// Answers to one text, over all cameras in parts.
#[derive(Default)]
struct TextAnswers {
    /// Answers without their `views`, which are in the next field.
    answers: Option<Answers>,
    views: Vec<Value>,
    milliseconds: f64,
}

impl TextAnswers {
    /// Adds the answer for more cameras; only the per-view parts differ.
    fn join(&mut self, mut part: Answers) {
        part.views.clear();
        match &mut self.answers {
            None => self.answers = Some(part),
            Some(all) => {
                let pairs = all.instances.iter_mut().zip(part.instances);
                pairs.for_each(|(all, part)| all.pixels.extend(part.pixels));
            }
        }
    }
}

/// Writes the files of an answer in a view, and records their names.
fn write(
    out: &mut WrittenFiles,
    stem: &str,
    folder: &str,
    picture: &RgbImage,
    a: &QueryResult,
    view: &mut Value,
) -> Result<()> {
    let name = |kind: &str| format!("{folder}/{stem}_{kind}");
    for (key, kind) in [("heat", "heat.png"), ("mask", "mask.png"), ("relevancy", "relevancy.npy")] {
        view[key] = name(kind).into();
    }
    let (relevancy, mask) = (a.relevancy(), a.mask());
    let heat = colour::heat_image(picture, &relevancy, Some(&mask));
    picture::write_png(&out.file(&name("heat.png"))?, &heat)?;
    picture::write_mask_png(&out.file(&name("mask.png"))?, &mask)?;
    let size = (relevancy.width, relevancy.height);
    picture::write_npy(&out.file(&name("relevancy.npy"))?, size, None, &relevancy.data)
}

/// Position of the answer in space and its distance from the camera; null if the scene shows
/// nothing.
fn place_json(frame: &RenderedFrame, camera: &Camera, a: &QueryResult, world: &World) -> Value {
    let (x, y) = a.location;
    let depth = f64::from(frame.depth.at(x, y));
    if depth <= 0.0 {
        return Value::Null;
    }
    let position = camera.unproject(DVec2::new(x as f64 + 0.5, y as f64 + 0.5), depth);
    let distance = position.distance(camera.pose.centre());
    let metres = world.scale.as_ref().map(|s| distance * s.metres_per_unit);
    json!({ "position": position.to_array(), "distance": distance, "distance_metres": metres })
}

fn to_json(stem: &str, a: &QueryResult, level: Option<&str>, place: &Value) -> Value {
    json!({
        "place": place,
        "view": stem, "found": a.found, "score": a.score, "level": level,
        // Pixel position of the most relevant pixel's centre; the first pixel's is (0.5, 0.5).
        "location": [a.location.0 as f64 + 0.5, a.location.1 as f64 + 0.5],
        "mask_pixels": a.mask_pixels(),
    })
}

/// A row per text: presence, p-value, position, and the best view.
fn short_table(texts: &[TextAnswers]) -> String {
    let mut rows = vec![["text", "answer", "p", "place (x, y, z)", "best view"].map(str::to_owned)];
    let mut notes = Vec::new();
    for TextAnswers { answers, views, .. } in texts {
        let Some(answers) = answers else { continue };
        let text = format!("“{}”", one_line(&answers.text));
        notes.extend(answers.remarks().iter().map(|note| format!("{text}: {}\n", one_line(note))));
        let place = answers.instances.first().map(|i| i.centre.to_array().map(|v| format!("{v:.3}")));
        let absent = answers.presence == Some(Presence::Absent);
        let score = |v: &&Value| v["score"].as_f64().unwrap_or(0.0);
        let best = views.iter().filter(|v| v["found"] == true);
        let best = best.max_by(|a, b| score(a).total_cmp(&score(b))).filter(|_| !absent);
        rows.push([
            text,
            match answers.presence {
                _ if answers.reading.is_unknown() => "unknown words".to_owned(),
                Some(Presence::Absent) => "no sign of it".to_owned(),
                Some(Presence::Unsure) => "unsure".to_owned(),
                Some(Presence::Found) | None if best.is_none() => "not found".to_owned(),
                Some(Presence::Found) | None => "found".to_owned(),
            },
            answers.p_value.map_or("-".to_owned(), |p| format!("{p:.3}")),
            place.map_or("-".to_owned(), |p| p.join(", ")),
            best.map_or("-".to_owned(), |v| {
                format!("{} ({:.2})", v["view"].as_str().unwrap_or(""), score(&v))
            }),
        ]);
    }
    columns(&rows) + &notes.concat()
}

/// Aligns cells in columns.
fn columns(rows: &[[String; 5]]) -> String {
    let width_of = |column: usize| rows.iter().map(|r| r[column].chars().count()).max().unwrap_or(0);
    let mut text = String::new();
    for row in rows {
        let cells = row.iter().enumerate().map(|(k, cell)| format!("{cell:<width$}", width = width_of(k)));
        text += cells.collect::<Vec<_>>().join("  ").trim_end();
        text.push('\n');
    }
    text
}

/// Results of all views, with the folder of their files.
fn table(texts: &[TextAnswers], stems: &[String], folder: &Path) -> String {
    let mut text = String::new();
    // Writing to a String cannot fail.
    for TextAnswers { answers, views, milliseconds } in texts {
        let Some(answers) = answers else { continue };
        let found = views.iter().filter(|v| v["found"] == true).count();
        let verdict = answer::verdict(answers.presence, &answers.reading, found, views.len());
        let notes: String = answers.remarks().iter().map(|note| format!("; {note}")).collect();
        let summary = one_line(&format!("“{}”: {verdict}{notes}", answers.text));
        let _ = writeln!(text, "{summary}; answered in {milliseconds:.0} ms");
        for v in views {
            let verdict = if v["found"] == true { "" } else { "  not found" };
            let level = v["level"].as_str().map_or(String::new(), |level| format!(" at level {level}"));
            let _ = writeln!(
                text,
                "  {:<16} {:.2}{level}, pixel {:.0}, {:.0}{verdict}",
                v["view"].as_str().unwrap_or(""),
                v["score"].as_f64().unwrap_or(0.0),
                v["location"][0].as_f64().unwrap_or(0.0),
                v["location"][1].as_f64().unwrap_or(0.0)
            );
        }
        for (n, instance) in answers.instances.iter().enumerate() {
            let _ = writeln!(text, "{}", instance_line(n + 1, instance, stems));
        }
    }
    let _ = writeln!(text, "heat maps and masks are in {}", folder.display());
    text
}

/// Position of an instance in space, and in the first view that shows it.
fn instance_line(n: usize, instance: &Instance, stems: &[String]) -> String {
    let ([x, y, z], [a, b, c]) = (instance.centre.to_array(), instance.oriented.size.to_array());
    let view = stems.iter().zip(&instance.pixels).find_map(|(stem, p)| Some((stem, (*p)?)));
    let view = view.map_or(String::new(), |(stem, [x, y])| format!(", pixel {x:.0}, {y:.0} of view {stem}"));
    let splats = instance.splats.len();
    format!("  {n}. at {x:.3}, {y:.3}, {z:.3}, size {a:.3} × {b:.3} × {c:.3}, {splats} splats{view}")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{Pose, Scale};

    #[test]
    fn place_json_states_units_and_metres() {
        let mut rendered = RenderedFrame::empty(4, 4, 0);
        rendered.depth.data.fill(4.0);
        let (pose, size) = (Pose::IDENTITY, 4);
        let camera =
            Camera { name: "a".into(), width: size, height: size, fx: 4.0, fy: 4.0, cx: 0.5, cy: 1.5, pose };
        // The centre of pixel (3, 1) is 3 pixels right of the principal point: 3 units at depth 4.
        let answer = QueryResult { location: (3, 1), ..QueryResult::default() };
        let scale = Scale { metres_per_unit: 0.25, log_sigma: 0.1, stated: Vec::new() };
        let place =
            place_json(&rendered, &camera, &answer, &World { scale: Some(scale), ..World::default() });
        assert_eq!((place["distance"].as_f64(), place["distance_metres"].as_f64()), (Some(5.0), Some(1.25)));
        assert_eq!(
            place_json(&rendered, &camera, &answer, &World::default())["distance_metres"],
            Value::Null
        );
    }
}
