//! Pictures like those of the paper: masks of several methods, locations with boxes, the alignment
//! step by step, and the worst answers.
mod answers;
mod draw;
mod page;

pub use page::{Row, Section, Tile, page};

use crate::Result;
use crate::ablate::{Plan, Runner, Setup};
use answers::{Answered, Question, Shots};
use splatvk::report::colour;
use splatvk::run::method::{Method, Recipe};
use splatvk::scene::{LEVEL_NAMES, RgbImage};

/// Most rows of a section of questions.
const MOST: usize = 6;

/// Alignment steps of the columns of the section about alignment.
const STEPS: [(&str, [bool; 3]); 4] = [
    ("none", [false; 3]),
    ("step 1", [true, false, false]),
    ("steps 1, 2", [true, true, false]),
    ("steps 1, 2, 3", [true; 3]),
];

/// Makes the scenes of the methods on the data set of a runner, and draws all sections. The worst
/// answers are those of the first method.
pub fn draw(plan: &Plan, lab: &mut Runner, methods: &[&'static Method]) -> Result<Vec<Section>> {
    let regions = plan.regions.clone().unwrap_or_else(|| plan.sources.regions());
    let base = plan.base(lab, regions);
    let shots = Shots::of(lab, base.views)?;
    let mut answered = Vec::new();
    for method in methods {
        let recipe = base.regime.recipe(method.recipe);
        let scene = lab.scene(&Setup { recipe, ..base.clone() })?;
        answered.push(Answered::by(method.name, lab, &scene, &shots, base.regime.compat)?);
    }
    let shown = shots.largest(MOST);
    let mut sections = vec![masks(&shots, &answered, &shown), locations(&shots, &answered, &shown)];
    sections.extend(alignment(lab, &base)?);
    sections.extend(answered.first().map(|first| failures(&shots, first)));
    Ok(sections)
}

fn masks(shots: &Shots, answered: &[Answered], questions: &[Question]) -> Section {
    let mut columns = vec!["photo".to_owned(), "truth".to_owned()];
    columns.extend(answered.iter().map(|a| a.method.to_owned()));
    let row = |q: &Question| {
        let (photo, truth) = (shots.photo(q), shots.mask(q));
        let mut tiles =
            vec![Tile::plain(photo.clone()), Tile::plain(colour::outline_image(photo, Some(&truth)))];
        tiles.extend(answered.iter().map(|a| {
            let answer = a.answer(q);
            let image = colour::outline_image(photo, Some(&answer.mask()));
            Tile { image, caption: format!("IoU {:.2}", shots.iou(q, answer)) }
        }));
        Row { name: shots.name(q), tiles }
    };
    Section {
        name: "masks",
        about: "Masks of the methods; everything outside of a mask is grey.".into(),
        columns,
        rows: questions.iter().map(row).collect(),
    }
}

fn locations(shots: &Shots, answered: &[Answered], questions: &[Question]) -> Section {
    let row = |q: &Question| Row {
        name: shots.name(q),
        tiles: answered.iter().map(|a| located(shots, a, q)).collect(),
    };
    Section {
        name: "locations",
        about: "Relevancy. The box is that of the labelled thing; the cross is the location of the answer: green \
                on the thing, red beside it."
            .into(),
        columns: answered.iter().map(|a| a.method.to_owned()).collect(),
        rows: questions.iter().map(row).collect(),
    }
}

/// Relevancy with the box of the labelled thing and the location of the answer.
fn located(shots: &Shots, answered: &Answered, q: &Question) -> Tile {
    let (answer, truth) = (answered.answer(q), shots.mask(q));
    let mut image = colour::heat_image(shots.photo(q), &answer.relevancy(), None);
    if let Some(bounds) = draw::bounds(&truth) {
        draw::rectangle(&mut image, bounds);
    }
    let (x, y) = answer.location;
    let is_right = truth.at(x, y);
    draw::cross(&mut image, (x, y), is_right);
    Tile { image, caption: if is_right { "on it" } else { "beside it" }.into() }
}

/// One section per level: the codes of the photos after each step.
fn alignment(lab: &mut Runner, base: &Setup) -> Result<Vec<Section>> {
    let mut by_steps = Vec::new();
    for (_, steps) in STEPS {
        let recipe = Recipe { steps, ..base.recipe };
        by_steps.push(lab.aligned(&Setup { recipe, ..base.clone() })?);
    }
    let photos = lab.frames(base.views)?;
    let section = |level: usize| {
        let row = |view: usize| Row {
            name: photos[view].stem.clone(),
            tiles: by_steps
                .iter()
                .filter_map(|language| {
                    let level = &language.field.levels[level];
                    let image = colour::label_image(level.targets.get(view)?);
                    Some(Tile { image, caption: format!("{} codes", level.codebook.len()) })
                })
                .collect(),
        };
        Section {
            name: ["alignment-s", "alignment-m", "alignment-l"][level],
            about: format!(
                "Codes of the masks on level {} after each step. Within a column, one colour is one code.",
                LEVEL_NAMES[level]
            ),
            columns: STEPS.map(|(name, _)| name.to_owned()).into(),
            rows: (0..photos.len()).map(row).collect(),
        }
    };
    Ok((0..LEVEL_NAMES.len()).map(section).collect())
}

fn failures(shots: &Shots, answered: &Answered) -> Section {
    let row = |q: &Question| {
        let (photo, answer): (&RgbImage, _) = (shots.photo(q), answered.answer(q));
        let mask = colour::outline_image(photo, Some(&answer.mask()));
        Row {
            name: shots.name(q),
            tiles: vec![
                Tile::plain(colour::outline_image(photo, Some(&shots.mask(q)))),
                located(shots, answered, q),
                Tile { image: mask, caption: format!("IoU {:.2}", shots.iou(q, answer)) },
            ],
        }
    };
    Section {
        name: "failures",
        about: format!("The worst answers of {}.", answered.method),
        columns: ["truth", "relevancy", "mask"].map(str::to_owned).into(),
        rows: answered.worst(shots, MOST).iter().map(row).collect(),
    }
}
