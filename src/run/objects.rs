//! A scene as a list of things with names, boxes and the view that shows each best.
mod files;

pub use files::{Listed, ObjectFiles, ObjectFolder, record, stems};

use super::answer::placement_json;
use super::ask::QueryScene;
use super::encoder;
use super::plan::Machine;
use crate::format::scene_dir::Scene;
use crate::infer::stuff;
use crate::progress::Progress;
use crate::query::QueryOptions;
use crate::query::instances::Instance;
use crate::query::phrasing;
use crate::query::presence::Presence;
use crate::query::things::{self, LEVELS, Thing};
use crate::scene::{Camera, RgbImage, World};
use crate::{Error, Result};
use serde::Serialize;
use serde_json::{Value, json};
use std::collections::{BTreeMap, BTreeSet};

/// Least IoU of a thing and an instance of an answer that mean the same.
const SAME_THING: f64 = 0.5;
/// Names per code of the encoder's own list that are asked.
const ASKED: usize = 3;
/// Least share of the scene of a wall, a floor or another surface of the encoder's own list: a plate
/// is level and flat, too.
const LEAST_SURFACE: f64 = 0.05;

/// Nouns of the levels of things.
pub const NOUNS: [&str; LEVELS.len()] = ["subpart", "part", "whole", "thing"];
/// Noun of an object that is a table, a wall or another plane.
const SURFACE: &str = "surface";

/// Settings of [`list`].
#[derive(Clone, Debug)]
pub struct ObjectOptions {
    /// Names to choose from; `None` = the encoder's own list.
    pub vocabulary: Option<Vec<String>>,
    /// Least share of the opacity of the scene.
    pub least_share: f64,
}

impl Default for ObjectOptions {
    fn default() -> Self {
        ObjectOptions { vocabulary: None, least_share: LEAST_SHARE }
    }
}

/// Default of [`ObjectOptions::least_share`].
pub const LEAST_SHARE: f64 = 0.001;

/// A name that fits a thing.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Name {
    /// The word or phrase.
    pub text: String,
    /// Whether the scene contains it: found or unsure.
    pub presence: Option<Presence>,
    /// Share of other things that fit the scene at least as well.
    pub p_value: Option<f32>,
    /// Best relevancy of a code, 0 to 1.
    pub score: f32,
    /// IoU of the thing and the answer to the name.
    pub iou: f64,
}

/// View that shows most of a thing.
#[derive(Clone, Debug, PartialEq)]
pub struct BestView {
    /// Index of the view.
    pub view: usize,
    /// Pixel that shows its centre, the first pixel's centre at (0.5, 0.5).
    pub pixel: [f64; 2],
    /// Smallest and largest pixel position of its visible splats.
    pub bounds: [[f64; 2]; 2],
}

/// A thing with its names.
#[derive(Clone, Debug)]
pub struct Object {
    /// Splats, boxes, level and parent.
    pub thing: Thing,
    /// Name, unique on its level: the first found name, or the noun of the level with the number.
    pub name: String,
    /// Whether `name` was found; without, it is a number.
    pub is_named: bool,
    /// All names that fit, found ones first.
    pub names: Vec<Name>,
    /// `None` where no view shows it.
    pub best_view: Option<BestView>,
}

impl Object {
    /// Entry of objects.json; `views` are the names of the views.
    pub fn record(&self, all: &[Object], views: &[String], world: &World) -> Value {
        let instance = &self.thing.instance;
        let metres = world.scale.as_ref().map(|scale| placement_json(instance, scale.metres_per_unit));
        let best = self.best_view.as_ref();
        let mut entry = placement_json(instance, 1.0);
        entry["id"] = self.thing.id().into();
        entry["number"] = self.thing.number().into();
        entry["level"] = LEVELS[self.thing.level].into();
        entry["surface"] = self.thing.is_surface.into();
        entry["parent"] = json!(self.thing.parent.and_then(|k| all.get(k)).map(|o| o.thing.id()));
        entry["name"] = self.name.as_str().into();
        entry["named"] = self.is_named.into();
        entry["names"] = json!(self.names);
        entry["metres"] = json!(metres);
        entry["splats"] = instance.splats.len().into();
        entry["share"] = instance.share.into();
        entry["reliability"] = json!(instance.reliability);
        entry["best_view"] = json!(best.map(|b| json!({ "view": views.get(b.view), "pixel": b.pixel })));
        entry
    }
}

/// Part of a picture around the visible splats of a thing, with a margin of a sixth.
pub fn thumbnail(picture: &RgbImage, view: &BestView) -> RgbImage {
    let [low, high] = view.bounds;
    let range = |axis: usize, side: usize| {
        let margin = SMALLEST_MARGIN.max((high[axis] - low[axis]) / 6.0);
        let first = (low[axis] - margin).max(0.0) as usize;
        let end = ((high[axis] + margin).ceil() as usize).min(side);
        first.min(side - 1)..end.max(first + 1).min(side)
    };
    let (columns, rows) = (range(0, picture.width), range(1, picture.height));
    RgbImage {
        width: columns.len(),
        height: rows.len(),
        data: rows.flat_map(|y| columns.clone().map(move |x| picture.at(x, y))).collect(),
    }
}

/// Smallest margin of a thumbnail, pixels.
const SMALLEST_MARGIN: f64 = 6.0;

/// Names of a vocabulary, one per line; `source` names it in messages.
///
/// # Errors
/// No names, and one that is there twice.
pub fn words(text: &str, source: &str) -> Result<Vec<String>> {
    let mut words: Vec<String> = Vec::new();
    for line in text.lines().map(str::trim).filter(|line| !line.is_empty()) {
        if words.iter().any(|word| word == line) {
            return Err(Error::input(format!("{source}: \"{line}\" is there twice; leave one out")));
        }
        words.push(line.to_owned());
    }
    if words.is_empty() {
        return Err(Error::input(format!("{source}: no words; give one name per line")));
    }
    Ok(words)
}

/// The things of a loaded scene, whose language moves onto the device.
///
/// # Errors
/// A scene without language or without cameras.
pub fn of_scene(
    scene: &mut Scene,
    machine: &Machine,
    options: &ObjectOptions,
    progress: &dyn Progress,
) -> Result<(QueryScene, Vec<Object>)> {
    if scene.cameras.is_empty() {
        return Err(Error::input(format!(
            "{}: a file of Gaussians has no views that show its things; splatvk label makes a scene of it",
            scene.path.display()
        )));
    }
    let no_language = || {
        Error::input(format!(
            "{}: the scene has no language; splatvk label gives it one, splatvk run makes scenes with it",
            scene.path.display()
        ))
    };
    scene.language.as_ref().ok_or_else(no_language)?;
    let encoder = encoder::of_scene(scene, machine.registry()?)?;
    let device = machine.gpu()?;
    let field = scene.language.take().ok_or_else(no_language)?;
    let mut ready = QueryScene::open(&device, (&scene.splats, &scene.cameras), field, encoder)?;
    ready.set_views(&scene.cameras)?;
    let list = list(&mut ready, &scene.cameras, options, progress)?;
    Ok((ready, list))
}

/// The things of a scene in the set views of `scene`, whose cameras are `cameras`.
///
/// # Errors
/// A word of the vocabulary that is no query.
pub fn list(
    scene: &mut QueryScene,
    cameras: &[Camera],
    options: &ObjectOptions,
    progress: &dyn Progress,
) -> Result<Vec<Object>> {
    let things = scene.places().things(options.least_share);
    let best = best_views(scene, cameras, &things, progress)?;
    let asked = match &options.vocabulary {
        Some(words) => words.clone(),
        None => own_names(scene, &things)?,
    };
    let mut names = named(scene, &things, &asked, progress)?;
    if options.vocabulary.is_none() {
        let small = things.iter().zip(&mut names).filter(|(t, _)| t.instance.share < LEAST_SURFACE);
        small.for_each(|(_, names)| names.retain(|name| !stuff::is_name(&name.text)));
    }
    let objects = things.into_iter().zip(names).zip(best);
    let mut objects: Vec<Object> = objects
        .map(|((thing, names), best_view)| {
            let found = names.iter().find(|name| name.presence == Some(Presence::Found));
            let noun = if thing.is_surface { SURFACE } else { NOUNS[thing.level] };
            let number = format!("{noun} {}", thing.label());
            let name = found.map_or(number, |found| found.text.clone());
            Object { is_named: found.is_some(), name, thing, names, best_view }
        })
        .collect();
    number_equal_names(&mut objects);
    Ok(objects)
}

/// Appends ".001", ".002" … to names that repeat on a level, as Blender does.
fn number_equal_names(objects: &mut [Object]) {
    let mut used: BTreeSet<(usize, String)> = BTreeSet::new();
    for object in objects {
        let name = object.name.clone();
        let mut copies = 0;
        while !used.insert((object.thing.level, object.name.clone())) {
            copies += 1;
            object.name = format!("{name}.{copies:03}");
        }
    }
}

/// The best names of the codes of the things, from the list of the text model.
fn own_names(scene: &mut QueryScene, things: &[Thing]) -> Result<Vec<String>> {
    let all = scene.names()?;
    let of_thing = |t: &Thing| all.get(t.level).and_then(|level| level.get(t.code));
    let names = things.iter().filter_map(of_thing).flat_map(|list| list.iter().take(ASKED));
    let distinct: BTreeSet<String> = names.map(|(name, _)| name.clone()).collect();
    Ok(distinct.into_iter().collect())
}

/// Per thing the names whose answers are the thing: found ones first, then by p-value.
fn named(
    scene: &mut QueryScene,
    things: &[Thing],
    asked: &[String],
    progress: &dyn Progress,
) -> Result<Vec<Vec<Name>>> {
    let mut names: Vec<Vec<Name>> = vec![Vec::new(); things.len()];
    progress.begin("names", asked.len() as u64);
    for (done, text) in asked.iter().enumerate() {
        progress.check()?;
        phrasing::check(text)?;
        let answers = scene.ask(text, &QueryOptions::default())?;
        let is_here = matches!(answers.presence, None | Some(Presence::Found | Presence::Unsure));
        for instance in answers.instances.iter().filter(|_| is_here && !answers.reading.is_unknown()) {
            for (thing, iou) in same_things(things, instance) {
                names[thing].push(Name {
                    text: text.clone(),
                    presence: answers.presence,
                    p_value: answers.p_value,
                    score: answers.selection.score,
                    iou,
                });
            }
        }
        progress.step(done as u64 + 1, text);
    }
    progress.end();
    for list in &mut names {
        list.sort_by(|a, b| {
            let unsure = |n: &Name| n.presence != Some(Presence::Found);
            let p = |n: &Name| n.p_value.unwrap_or(1.0);
            unsure(a).cmp(&unsure(b)).then(p(a).total_cmp(&p(b))).then(b.score.total_cmp(&a.score))
        });
    }
    Ok(names)
}

/// Things that an instance of an answer means, with their IoU.
fn same_things(things: &[Thing], instance: &Instance) -> Vec<(usize, f64)> {
    let shared = |other: &Instance| {
        let (mut own, mut count) = (other.splats.iter().peekable(), 0usize);
        for splat in &instance.splats {
            while own.next_if(|other| *other < splat).is_some() {}
            count += usize::from(own.peek() == Some(&splat));
        }
        count as f64
    };
    let iou = |thing: &Thing| {
        let both = shared(&thing.instance);
        both / ((thing.instance.splats.len() + instance.splats.len()) as f64 - both).max(1.0)
    };
    let pairs = things.iter().enumerate().map(|(k, thing)| (k, iou(thing)));
    pairs.filter(|(_, iou)| *iou >= SAME_THING).collect()
}

/// Per thing the view that shows most of its splats.
fn best_views(
    scene: &QueryScene,
    cameras: &[Camera],
    things: &[Thing],
    progress: &dyn Progress,
) -> Result<Vec<Option<BestView>>> {
    let mut best: Vec<Option<(usize, BestView)>> = vec![None; things.len()];
    let all: Vec<usize> = (0..scene.places().weights().len()).collect();
    for (view, (camera, frame)) in cameras.iter().zip(scene.frames()).enumerate() {
        progress.check()?;
        let visible = scene.places().visible(&all, camera, &frame.rendered.depth);
        for (thing, best) in things.iter().zip(&mut best) {
            let pixels: Vec<[f64; 2]> =
                visible.of(&thing.instance.splats).map(|(_, pixel)| pixel.to_array()).collect();
            if pixels.len() <= best.as_ref().map_or(0, |b| b.0) {
                continue;
            }
            if let Some(pixel) = scene.places().pixel(&thing.instance, &visible) {
                *best = Some((pixels.len(), BestView { view, pixel, bounds: bounds(&pixels) }));
            }
        }
    }
    Ok(best.into_iter().map(|b| b.map(|b| b.1)).collect())
}

fn bounds(pixels: &[[f64; 2]]) -> [[f64; 2]; 2] {
    let extreme = |pick: fn(f64, f64) -> f64, from: f64| {
        pixels.iter().fold([from; 2], |b, p| [pick(b[0], p[0]), pick(b[1], p[1])])
    };
    [extreme(f64::min, f64::INFINITY), extreme(f64::max, f64::NEG_INFINITY)]
}

/// Number of the thing of every splat on a level, [splats]; 0 for splats of none.
pub fn numbers(objects: &[Object], level: usize, splats: usize) -> Vec<u32> {
    things::numbers(objects.iter().map(|o| &o.thing), level, splats)
}

/// Number of things per level, objects first and then coarsest first, with that of named ones.
pub fn counts(objects: &[Object]) -> Vec<(&'static str, usize, usize)> {
    let mut counts: BTreeMap<usize, (usize, usize)> = BTreeMap::new();
    for object in objects {
        let (all, named) = counts.entry(object.thing.level).or_default();
        *all += 1;
        *named += usize::from(object.is_named);
    }
    counts.into_iter().rev().map(|(level, (all, named))| (NOUNS[level], all, named)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn thing(splats: &[usize]) -> Thing {
        Thing { instance: Instance { splats: splats.to_vec(), ..Instance::default() }, ..Thing::default() }
    }

    #[test]
    fn same_things_overlap_by_half() {
        let things = [thing(&[1, 2, 3, 4]), thing(&[4, 5, 6, 7, 8, 9]), thing(&[])];
        let answer = thing(&[2, 3, 4, 5]).instance;
        // 3 of 5 shared with the first, 2 of 8 with the second.
        assert_eq!(same_things(&things, &answer), [(0, 0.6)]);
    }

    #[test]
    fn equal_names_get_numbers() {
        let object = |level: usize, name: &str| Object {
            thing: Thing { level, ..thing(&[1]) },
            name: name.into(),
            is_named: true,
            names: Vec::new(),
            best_view: None,
        };
        let mut objects =
            ["chair", "chair", "chair.001", "lamp", "chair"].map(|name| object(2, name)).to_vec();
        objects.push(object(1, "chair"));
        number_equal_names(&mut objects);
        let names: Vec<&str> = objects.iter().map(|o| o.name.as_str()).collect();
        assert_eq!(names, ["chair", "chair.001", "chair.001.001", "lamp", "chair.002", "chair"]);
    }
}
