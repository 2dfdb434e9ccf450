//! Splats of the rules of a selection.
use super::complete::completed;
use super::{Editor, floaters};
use crate::format::edits::{Combine, Pick, Property, Term};
use crate::query::instances::Places;
use crate::query::presence::Presence;
use crate::query::things::OBJECTS;
use crate::query::{MaskRule, QueryOptions};
use crate::run::Compat;
use crate::scene::Camera;
use crate::{Error, Result};
use glam::{DVec2, DVec3};
use rayon::prelude::*;

/// Number of bins of a histogram.
const BINS: usize = 48;
/// Smallest value of a logarithmic histogram: pixels, or scene units.
const LEAST_SEEN: f64 = 1e-6;

/// Distribution of a property.
#[derive(Clone, Debug, PartialEq)]
pub struct Histogram {
    /// [bins + 1] ascending.
    pub edges: Vec<f64>,
    /// [bins] numbers of splats.
    pub counts: Vec<usize>,
}

/// Splats of a rule.
#[derive(Default)]
struct Found {
    /// Rows of the edited scene, ascending.
    rows: Vec<usize>,
    doubts: Vec<String>,
    /// Level whose codes selected them.
    level: Option<usize>,
}

impl Editor {
    /// Rows of the edited scene that terms select.
    pub(super) fn rows(&mut self, terms: &[Term]) -> Result<(Vec<usize>, Vec<String>)> {
        let mut selected = vec![false; self.scene.splats.len()];
        let mut doubts = Vec::new();
        for term in terms {
            let Found { rows, doubts: more, level } = self.pick(&term.pick)?;
            let rows = match level {
                Some(level) => {
                    let lists = &self.words()?.places().lists()[level].clone();
                    completed(rows, &self.scene.splats, lists)
                }
                None => rows,
            };
            let mut is_picked = vec![false; selected.len()];
            rows.iter().for_each(|row| is_picked[*row] = true);
            for (selected, picked) in selected.iter_mut().zip(is_picked) {
                *selected = match term.combine {
                    Combine::Add => *selected | picked,
                    Combine::Remove => *selected & !picked,
                    Combine::Intersect => *selected & picked,
                };
            }
            doubts.extend(more);
        }
        let rows = selected.iter().enumerate().filter(|(_, is)| **is).map(|(row, _)| row).collect();
        Ok((rows, doubts))
    }

    fn pick(&mut self, pick: &Pick) -> Result<Found> {
        if let Pick::Click { camera, .. } | Pick::Outline { camera, .. } = pick {
            camera.clone().checked().map_err(Error::input)?;
        }
        let sure = |rows: Vec<usize>| Found { rows, ..Found::default() };
        let of_level = |(rows, level): (Vec<usize>, usize)| Found { level: Some(level), ..sure(rows) };
        match pick {
            Pick::Word { text, grow } => self.word(text, *grow),
            Pick::Thing { id } => self.thing(id).map(of_level),
            Pick::Range { property, least, most } => self.range(*property, *least, *most).map(sure),
            Pick::Click { camera, pixel, level } => self.click(camera, *pixel, *level).map(of_level),
            Pick::Outline { camera, polygon, through } => self.outline(camera, polygon, *through).map(sure),
            Pick::Floaters { thorough } => {
                let cameras = self.scene.cameras.clone();
                let depths = cameras.iter().map(|c| self.depth(c)).collect::<Result<Vec<_>>>()?;
                Ok(sure(floaters::find(&self.scene, &depths, *thorough)?))
            }
        }
    }

    /// Splats of the answer to a text.
    fn word(&mut self, text: &str, grow: f32) -> Result<Found> {
        if !(-1.0..=1.0).contains(&grow) {
            return Err(Error::input(format!("grow {grow}: give −1 to 1")));
        }
        let mut options = Compat::answers(None, &self.scene.path)?;
        if grow != 0.0 {
            let MaskRule::Codes(share) = options.mask else {
                return Err(Error::input(
                    "the answers of this scene follow a published protocol and cannot grow",
                ));
            };
            options = QueryOptions { mask: MaskRule::Codes(grown(share, grow)), ..options };
        }
        let answers = self.words()?.ask(text, &options)?;
        let refused = |reason: &str| {
            Err(Error::input(format!(
                "\"{text}\": {reason}; splatvk objects lists the things of the scene, and \"id:o3\" selects one"
            )))
        };
        let mut found = Found { rows: answers.selection.splats, ..Found::default() };
        found.level = Some(answers.selection.level);
        match answers.presence {
            _ if answers.reading.is_unknown() => refused("the built-in words do not know it"),
            Some(Presence::Absent) => refused("there is no sign of it in the scene"),
            _ if found.rows.is_empty() || !answers.selection.found => {
                refused("it fits no splat of the scene")
            }
            Some(Presence::Found) => Ok(found),
            Some(Presence::Unsure) | None => {
                let doubt = match answers.p_value {
                    Some(p) => {
                        format!("is unsure ({:.0} % of other things fit the scene as well)", 100.0 * p)
                    }
                    None => "may be absent: the text model of this scene cannot judge it".to_owned(),
                };
                Ok(Found { doubts: vec![format!("\"{text}\" {doubt}")], ..found })
            }
        }
    }

    /// Splats of a thing of `splatvk objects`.
    fn thing(&mut self, id: &str) -> Result<(Vec<usize>, usize)> {
        let places = self.words()?.places();
        let thing = places.things(0.0).into_iter().find(|thing| thing.id() == id);
        let found = thing.map(|thing| (thing.instance.splats, places.code_level(thing.level)));
        found.ok_or_else(|| {
            Error::input(format!("\"id:{id}\": the scene has no such thing; splatvk objects lists its ids"))
        })
    }

    /// Splats whose property is in a range.
    fn range(&self, property: Property, least: Option<f64>, most: Option<f64>) -> Result<Vec<usize>> {
        let value = self.value(property)?;
        let inside = |i: &usize| {
            let value = value(*i);
            least.is_none_or(|least| value >= least) && most.is_none_or(|most| value <= most)
        };
        Ok((0..self.scene.splats.len()).into_par_iter().filter(inside).collect())
    }

    /// Distribution of a property in the edited scene. Bins of size and seen are equally wide in the
    /// logarithm.
    ///
    /// # Errors
    /// A property that the scene does not state.
    pub fn histogram(&self, property: Property) -> Result<Histogram> {
        let value = self.value(property)?;
        let by_factor = matches!(property, Property::Size | Property::Seen);
        // Splats that no photo shows count in the first bin.
        let scaled = |v: f64| if by_factor { v.max(LEAST_SEEN).ln() } else { v };
        let values: Vec<f64> =
            (0..self.scene.splats.len()).into_par_iter().map(|i| scaled(value(i))).collect();
        let low = values.iter().copied().fold(f64::INFINITY, f64::min);
        let high = values.iter().copied().fold(f64::NEG_INFINITY, f64::max).max(low + f64::EPSILON);
        let mut counts = vec![0; BINS];
        for v in values {
            counts[((v - low) / (high - low) * BINS as f64).clamp(0.0, BINS as f64 - 1.0) as usize] += 1;
        }
        let edge = |k: usize| low + (high - low) * k as f64 / BINS as f64;
        let edges = (0..=BINS).map(|k| if by_factor { edge(k).exp() } else { edge(k) }).collect();
        Ok(Histogram { edges, counts })
    }

    /// A property by the row of a splat.
    fn value(&self, property: Property) -> Result<Box<dyn Fn(usize) -> f64 + Sync + '_>> {
        let scene = &self.scene;
        Ok(match property {
            Property::Opacity => Box::new(|i| 1.0 / (1.0 + f64::from(-scene.splats.opacity_logits[i]).exp())),
            Property::Size => {
                Box::new(|i| f64::from(scene.splats.log_scales[i].into_iter().fold(f32::MIN, f32::max)).exp())
            }
            Property::Seen if scene.seen.pixels.is_empty() => {
                return Err(self.unknown("seen: the scene does not state the photos' weights of its splats"));
            }
            Property::Seen => Box::new(|i| f64::from(scene.seen.pixels[i])),
            Property::Reliability => {
                let levels = scene.language.iter().flat_map(|field| &field.levels).rev();
                let known = levels.map(|level| &level.reliability).find(|values| !values.is_empty());
                let values = known.ok_or_else(|| {
                    self.unknown("reliability: the scene does not state it; scenes of splatvk run do")
                })?;
                Box::new(|i| f64::from(values[i]))
            }
        })
    }

    fn unknown(&self, reason: &str) -> Error {
        Error::input(format!("{}: {reason}", self.scene.path.display()))
    }

    /// Splats of the thing at a pixel, with the level of its codes: of several things with one code,
    /// the nearest. Without `level` it is the object, or the coarsest mask where there is none.
    fn click(
        &mut self,
        camera: &Camera,
        pixel: [f64; 2],
        level: Option<usize>,
    ) -> Result<(Vec<usize>, usize)> {
        let at = pixel_of(camera, pixel)?;
        let maps = self.words()?.codes(camera)?;
        let codes: Vec<Option<usize>> = maps.iter().map(|map| usize::try_from(map.data[at]).ok()).collect();
        let found = clicked(level, &codes, self.places().code_level(OBJECTS));
        let (level, code) = found.ok_or_else(|| {
            let [x, y] = pixel;
            Error::input(format!("{}: there is no thing at pixel {x:.0}, {y:.0}", camera.name))
        })?;
        let depth = f64::from(self.depth(camera)?.data[at]);
        let place = camera.unproject(DVec2::from_array(pixel), depth);
        let places = self.places();
        let of_codes = places.code_level(level);
        let splats = places.lists()[of_codes].splats_of(std::iter::once(code));
        let things: Vec<Vec<usize>> = match level {
            OBJECTS => places.objects().into_iter().map(|object| object.instance.splats).collect(),
            level => places.instances(&splats, level).into_iter().map(|group| group.splats).collect(),
        };
        Ok((nearest(places, &things, &splats, place, of_codes), of_codes))
    }

    /// Splats whose centres lie in an outline.
    fn outline(&mut self, camera: &Camera, polygon: &[[f64; 2]], through: bool) -> Result<Vec<usize>> {
        if polygon.len() < 3 || polygon.iter().flatten().any(|v| !v.is_finite()) {
            return Err(Error::input("an outline has at least three corners, all of them finite"));
        }
        let all: Vec<usize> = (0..self.scene.splats.len()).collect();
        let shown = match through {
            true => all,
            false => {
                let depth = self.depth(camera)?;
                self.places().visible(&all, camera, &depth).splats()
            }
        };
        let means = &self.scene.splats.means;
        let corners = || polygon.iter().map(|corner| DVec2::from_array(*corner));
        let (low, high) =
            (corners().fold(DVec2::INFINITY, DVec2::min), corners().fold(-DVec2::INFINITY, DVec2::max));
        let inside = |i: &usize| {
            let (pixel, z) = camera.project(DVec3::from_array(means[*i].map(f64::from)));
            // Most splats are outside of the box already.
            z > 0.0 && pixel.cmpge(low).all() && pixel.cmple(high).all() && is_inside(polygon, pixel)
        };
        Ok(shown.into_par_iter().filter(inside).collect())
    }
}

/// Level and code that a click selects on a pixel with these codes, by level; things have those of
/// level `of_things`.
pub(super) fn clicked(
    level: Option<usize>,
    codes: &[Option<usize>],
    of_things: usize,
) -> Option<(usize, usize)> {
    let code_of = |level: usize| {
        let code = *codes.get(if level == OBJECTS { of_things } else { level })?;
        Some((level, code?))
    };
    let levels = level.map_or(vec![OBJECTS, 2, 1, 0], |level| vec![level]);
    levels.into_iter().find_map(code_of)
}

/// Of `things`, which share no splat, the one with the splat of `splats` that is nearest to a place.
/// Specks of its codes that are no thing of their own go with it, as with a word.
pub(super) fn nearest(
    places: &Places,
    things: &[Vec<usize>],
    splats: &[usize],
    place: DVec3,
    of_codes: usize,
) -> Vec<usize> {
    let mut owner = vec![None; places.centres().len()];
    for (thing, splats) in things.iter().enumerate() {
        splats.iter().for_each(|i| owner[*i] = Some(thing));
    }
    let distance = |i: &usize| places.centres()[*i].distance_squared(place);
    let owned = splats.iter().filter(|i| owner[**i].is_some());
    let chosen = owned.min_by(|a, b| distance(a).total_cmp(&distance(b))).and_then(|i| owner[*i]);
    let lists = &places.lists()[of_codes];
    let mut selected: Vec<usize> = Vec::new();
    for code in 0..lists.counts().count() {
        let own = lists.splats_of(std::iter::once(code));
        if own.iter().any(|i| owner[*i].is_some() && owner[*i] == chosen) {
            selected.extend(own.into_iter().filter(|i| owner[*i].is_none() || owner[*i] == chosen));
        }
    }
    selected.sort_unstable();
    selected
}

/// Share of a mask's bar ([`MaskRule::Codes`]) that grows or shrinks it.
pub(super) fn grown(share: f32, grow: f32) -> f32 {
    match grow >= 0.0 {
        true => share * (1.0 - grow),
        false => share + (1.0 - share) * -grow,
    }
}

/// Index of a pixel of a view.
fn pixel_of(camera: &Camera, [x, y]: [f64; 2]) -> Result<usize> {
    let inside = |v: f64, size: u32| (0.0..f64::from(size)).contains(&v);
    match inside(x, camera.width) && inside(y, camera.height) {
        true => Ok(y as usize * camera.width as usize + x as usize),
        false => Err(Error::input(format!(
            "{}: pixel {x}, {y} is outside of the view, which has {} × {}",
            camera.name, camera.width, camera.height
        ))),
    }
}

/// Whether a point is inside a polygon (even-odd rule).
pub(super) fn is_inside(polygon: &[[f64; 2]], p: DVec2) -> bool {
    let mut inside = false;
    let mut last = polygon[polygon.len() - 1];
    for &corner in polygon {
        let [[x, y], [px, py]] = [corner, last];
        if (y > p.y) != (py > p.y) && p.x < (px - x) * (p.y - y) / (py - y) + x {
            inside = !inside;
        }
        last = corner;
    }
    inside
}
