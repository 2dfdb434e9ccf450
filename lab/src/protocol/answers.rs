//! Answers as a user gets them, against polygons on photographs: presence, place and mask
//! (docs/internals/data.md#polygons-on-photographs).
use super::lerf::{self, Target};
use super::score::mask_iou;
use crate::{Error, Result};
use serde::{Deserialize, Serialize};
use splatvk::infer::words;
use splatvk::photo::stem;
use splatvk::query::QueryOptions;
use splatvk::query::instances::Places;
use splatvk::query::maps::{LevelMap, VOID};
use splatvk::query::presence::Presence;
use splatvk::query::things::OBJECTS;
use splatvk::run::answer::Answers;
use splatvk::run::ask::QueryScene;
use splatvk::scene::{Camera, Image};
use splatvk_types::files;
use std::collections::BTreeMap;
use std::path::Path;

/// Texts of a set of photographs, from `texts.json`.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Texts {
    /// Labelled things.
    pub categories: Vec<String>,
    /// Other usual names of a category.
    #[serde(default)]
    pub synonyms: BTreeMap<String, Vec<String>>,
    /// Things that no photo shows.
    #[serde(default)]
    pub absent: Vec<String>,
}

/// Labels of a set of photographs.
pub struct Photographs {
    /// The texts to ask.
    pub texts: Texts,
    /// Labelled photos of the scene: camera, and truth by category.
    frames: Vec<(Camera, BTreeMap<String, Target>)>,
}

/// Kind of a question.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Kind {
    /// A labelled category.
    Category,
    /// Another name of a category.
    Synonym,
    /// Nothing that a photo shows.
    Absent,
}

/// One question with its answer.
#[derive(Clone, Debug, Serialize)]
pub struct Asked {
    /// The text.
    pub text: String,
    /// Its kind.
    pub kind: Kind,
    /// The answer in a few words.
    pub verdict: String,
    /// Whether the text is outside of the model's vocabulary.
    pub unknown: bool,
    /// Presence, and the share of other things that fit as well.
    pub presence: Option<Presence>,
    /// See `presence`.
    pub p_value: Option<f32>,
    /// Labelled photos that show the thing.
    pub photos: usize,
    /// Those in which the location of the answer lies on it.
    pub located: usize,
    /// Mean IoU of the answers' masks over these photos, empty ones included.
    pub iou: Option<f64>,
}

impl Asked {
    /// Whether most photos have the location right.
    pub fn is_placed(&self) -> bool {
        2 * self.located > self.photos
    }
}

impl Photographs {
    /// Reads `texts.json` and the label files of a folder; photos that are not in the scene are
    /// left out.
    pub fn open(folder: &Path, scene: &[Camera]) -> Result<Photographs> {
        let file = folder.join(lerf::TEXTS);
        let texts: Texts = files::parse_json(files::read_text(&file)?.as_bytes())
            .map_err(|e| Error::input(format!("{}: {e}", file.display())))?;
        let mut labels = lerf::read_folder(folder)?;
        let own = scene.iter().filter_map(|c| Some((c.clone(), labels.remove(stem(&c.name))?)));
        let frames: Vec<_> = own.collect();
        if frames.is_empty() {
            return Err(Error::input(format!("{}: no labelled photo is in the scene", folder.display())));
        }
        Ok(Photographs { texts, frames })
    }

    /// Asks all texts in the labelled photos.
    pub fn ask(&self, scene: &mut QueryScene, options: &QueryOptions) -> Result<Vec<Asked>> {
        let cameras: Vec<Camera> = self.frames.iter().map(|f| f.0.clone()).collect();
        scene.set_views(&cameras)?;
        let texts = &self.texts;
        let own = texts.categories.iter().map(|c| (c, Kind::Category, Some(c)));
        let others = texts.synonyms.iter();
        let others = others.flat_map(|(c, list)| list.iter().map(move |t| (t, Kind::Synonym, Some(c))));
        let absent = texts.absent.iter().map(|t| (t, Kind::Absent, None));
        let mut asked = Vec::new();
        for (text, kind, category) in own.chain(others).chain(absent) {
            asked.push(self.judge(&scene.ask(text, options)?, kind, category)?);
        }
        Ok(asked)
    }

    fn judge(&self, answers: &Answers, kind: Kind, category: Option<&String>) -> Result<Asked> {
        let (mut photos, mut located, mut overlap) = (0, 0, 0.0);
        for ((_, targets), answer) in self.frames.iter().zip(&answers.views) {
            let Some(target) = category.and_then(|c| targets.get(c)) else { continue };
            let mask = answer.mask();
            let truth = &target.mask;
            let scaled = |p: usize, from: usize, to: usize| (2 * p + 1) * to / (2 * from.max(1));
            let x = scaled(answer.location.0, mask.width, truth.width);
            let y = scaled(answer.location.1, mask.height, truth.height);
            photos += 1;
            located += usize::from(x < truth.width && y < truth.height && truth.at(x, y));
            overlap += mask_iou(&mask, truth)?;
        }
        Ok(Asked {
            text: answers.text.clone(),
            kind,
            verdict: answers.sentence(),
            unknown: answers.reading.is_unknown(),
            presence: answers.presence,
            p_value: answers.p_value,
            photos,
            located,
            iou: (photos > 0).then(|| overlap / photos as f64),
        })
    }
}

/// The name of a labelled thing in one photo.
#[derive(Clone, Debug, Serialize)]
pub struct Named {
    /// The category.
    pub category: String,
    /// Best name of the code of level l in the middle of the thing.
    pub name: String,
    /// Its relevancy, and that of the next name with another noun.
    pub relevancy: [f32; 2],
    /// Whether the category is of the kind of the name.
    pub right: bool,
}

impl Photographs {
    /// Names of the labelled things whose category is in the vocabulary, in the photos of the last
    /// [`Photographs::ask`].
    pub fn names(&self, scene: &mut QueryScene) -> Result<Vec<Named>> {
        let level = scene.field().levels.len().saturating_sub(1);
        let names = scene.names()?;
        let mut named = Vec::new();
        for ((_, targets), frame) in self.frames.iter().zip(scene.frames()) {
            let Some(map) = frame.maps.levels.get(level) else { continue };
            for (category, target) in targets.iter().filter(|(c, _)| words::are_of_one_kind(c, c)) {
                let truth = &target.mask;
                let pixels: Vec<usize> = (0..truth.data.len()).filter(|p| truth.data[*p]).collect();
                let Some(middle) = pixels.get(pixels.len() / 2) else { continue };
                let scaled = |p: usize, from: usize, to: usize| (2 * p + 1) * to / (2 * from);
                let (x, y) = (middle % truth.width, middle / truth.width);
                let (x, y) =
                    (scaled(x, truth.width, frame.maps.width), scaled(y, truth.height, frame.maps.height));
                let code = usize::from(map.codes[y * frame.maps.width + x]);
                let list = names[level].get(code).map_or(&[][..], Vec::as_slice);
                let Some((name, relevancy)) = list.first() else { continue };
                let noun = |name: &str| name.rsplit(' ').next().unwrap_or_default().to_owned();
                let next = list.iter().find(|n| noun(&n.0) != noun(name)).map_or(0.0, |n| n.1);
                named.push(Named {
                    category: category.clone(),
                    name: name.clone(),
                    relevancy: [*relevancy, next],
                    right: words::are_of_one_kind(category, name),
                });
            }
        }
        Ok(named)
    }
}

/// A click on the middle of a labelled thing in one photo.
#[derive(Clone, Debug, Serialize)]
pub struct Clicked {
    /// The category.
    pub category: String,
    /// IoU of the selection with the thing.
    pub iou: f64,
    /// The best IoU of a level's selection.
    pub best: f64,
}

impl Photographs {
    /// Selections by clicks on the labelled things, in the photos of the last [`Photographs::ask`].
    pub fn clicks(&self, scene: &QueryScene) -> Result<Vec<Clicked>> {
        let mut clicked = Vec::new();
        let level = scene.places().code_level(OBJECTS);
        let things = things_of_codes(scene.places(), level);
        for ((_, targets), frame) in self.frames.iter().zip(scene.frames()) {
            let maps = &frame.maps;
            for (category, target) in targets {
                let truth = &target.mask;
                let Some((x, y)) = middle(truth) else { continue };
                let scaled = |p: usize, from: usize, to: usize| (2 * p + 1) * to / (2 * from);
                let pixel =
                    scaled(y, truth.height, maps.height) * maps.width + scaled(x, truth.width, maps.width);
                let code = |level: &LevelMap| Some(usize::from(*level.codes.get(pixel)?));
                let known = |level| code(level).filter(|c| *c != usize::from(VOID));
                let codes: Vec<Option<usize>> = maps.levels.iter().map(known).collect();
                let iou = |level: usize| {
                    let own = maps.levels[level].codes.iter();
                    let data = own.map(|c| Some(usize::from(*c)) == codes[level]).collect();
                    mask_iou(&Image { width: maps.width, height: maps.height, data }, truth)
                };
                let levels = (0..codes.len()).filter(|level| codes[*level].is_some());
                let all = levels.map(iou).collect::<Result<Vec<f64>>>()?;
                let own = codes[level].and_then(|code| things[code]);
                let of_thing = |code: &u16| own.is_some() && things.get(usize::from(*code)) == Some(&own);
                let data = maps.levels[level].codes.iter().map(of_thing).collect();
                let thing = Image { width: maps.width, height: maps.height, data };
                clicked.push(Clicked {
                    category: category.clone(),
                    iou: mask_iou(&thing, truth)?,
                    best: all.into_iter().fold(0.0, f64::max),
                });
            }
        }
        Ok(clicked)
    }
}

/// Per code of a level the object of its heaviest group.
fn things_of_codes(places: &Places, level: usize) -> Vec<Option<usize>> {
    let mut owner = vec![None; places.weights().len()];
    for (k, object) in places.objects().iter().enumerate() {
        object.instance.splats.iter().for_each(|i| owner[*i] = Some(k));
    }
    let of_code = |code: usize| {
        let splats = places.lists()[level].splats_of(std::iter::once(code));
        places.instances(&splats, level).first().and_then(|group| owner[*group.splats.first()?])
    };
    (0..places.lists()[level].counts().count()).map(of_code).collect()
}

/// The pixel of a mask that is farthest from its border, by rows and columns.
fn middle(mask: &Image<bool>) -> Option<(usize, usize)> {
    let (width, height) = (mask.width, mask.height);
    let mut distance: Vec<u32> = mask.data.iter().map(|inside| if *inside { u32::MAX } else { 0 }).collect();
    for y in 0..height {
        for x in 0..width {
            let before = match (x, y) {
                (0, _) | (_, 0) => 0,
                _ => distance[y * width + x - 1].min(distance[(y - 1) * width + x]),
            };
            distance[y * width + x] = distance[y * width + x].min(before.saturating_add(1));
        }
    }
    for y in (0..height).rev() {
        for x in (0..width).rev() {
            let behind = match (x + 1 == width, y + 1 == height) {
                (true, _) | (_, true) => 0,
                _ => distance[y * width + x + 1].min(distance[(y + 1) * width + x]),
            };
            distance[y * width + x] = distance[y * width + x].min(behind.saturating_add(1));
        }
    }
    let farthest = (0..distance.len()).filter(|i| mask.data[*i]).max_by_key(|i| distance[*i])?;
    Some((farthest % width, farthest / width))
}

/// Counts of the answers of one kind.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct Counts {
    /// All texts.
    pub texts: usize,
    /// Found, in the right place.
    pub found: usize,
    /// Found, in a wrong place, or on another thing.
    pub misled: usize,
    /// Unsure, in the right place.
    pub unsure_placed: usize,
    /// Unsure, in a wrong place.
    pub unsure_elsewhere: usize,
    /// No sign of it.
    pub no_sign: usize,
    /// Outside the vocabulary.
    pub unknown: usize,
    /// Photos, those with the right location, and the sum of IoU over them.
    pub photos: usize,
    /// See `photos`.
    pub located: usize,
    /// See `photos`.
    pub iou: f64,
}

impl Counts {
    /// Counts the answers of one kind.
    pub fn of(asked: &[Asked], kind: Kind) -> Counts {
        let mut counts = Counts::default();
        for a in asked.iter().filter(|a| a.kind == kind && (kind == Kind::Absent || a.photos > 0)) {
            counts.texts += 1;
            let cell = match a.presence {
                _ if a.unknown => &mut counts.unknown,
                Some(Presence::Absent) => &mut counts.no_sign,
                Some(Presence::Unsure) if a.is_placed() => &mut counts.unsure_placed,
                Some(Presence::Unsure) => &mut counts.unsure_elsewhere,
                Some(Presence::Found) | None if a.is_placed() => &mut counts.found,
                Some(Presence::Found) | None => &mut counts.misled,
            };
            *cell += 1;
            counts.photos += a.photos;
            counts.located += a.located;
            counts.iou += a.iou.unwrap_or(0.0) * a.photos as f64;
        }
        counts
    }
}
