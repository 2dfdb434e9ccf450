//! Edits of a scene directory: selects splats, and keeps a list of operations on them
//! (docs/use/edit.md).
mod complete;
pub mod expression;
mod floaters;
mod select;

use super::Answers;
use super::ask::QueryScene;
use super::encoder;
use super::plan::Machine;
use super::view;
use crate::format::edits::{self, Edit, EditList, Operation, Rows, Term};
use crate::format::scene_dir::{self, Scene};
use crate::infer::RegionEncoder;
use crate::pass::renderer::Renderer;
use crate::progress::Silent;
use crate::query::QueryOptions;
use crate::query::instances::Places;
use crate::report::viewer::CodeNames;
use crate::scene::{Camera, Image, LanguageField};
use crate::{Error, Result};
use rayon::prelude::*;
pub use select::Histogram;
use std::path::Path;
use std::sync::Arc;
use std::time::SystemTime;

/// Part of its blending weight without the splats in front of it up to which a splat is hidden. On
/// breakfast a deleted mug leaves blobs with 0.1 and none with 0.2.
const HIDDEN: f32 = 0.2;

/// Selected splats.
#[derive(Clone, Debug, Default)]
pub struct Selected {
    /// Rows in the reconstruction.
    pub rows: Rows,
    /// Number of splats.
    pub count: usize,
    /// Share of the opacity of the scene, 0 to 1.
    pub share: f64,
    /// Reasons why the selection may be wrong, each a clause; none where it is sure.
    pub doubts: Vec<String>,
    /// How they were selected.
    pub terms: Vec<Term>,
}

/// A scene directory that is being edited.
///
/// ```no_run
/// # fn main() -> splatvk::Result<()> {
/// use splatvk::format::edits::Operation;
/// use splatvk::run::{Machine, edit::{Editor, expression}};
/// let mut editor = Editor::open("kitchen".as_ref(), &Machine::default())?;
/// let chair = editor.select(&expression::terms("chair", editor.scene(), 0.0)?)?;
/// if chair.doubts.is_empty() {
///     editor.push(vec![(Operation::Delete {}, chair)])?;
/// }
/// # Ok(())
/// # }
/// ```
pub struct Editor {
    machine: Machine,
    /// Reason why the scene cannot be edited.
    fixed: Option<String>,
    /// The scene as it was reconstructed.
    whole: Arc<Scene>,
    list: EditList,
    /// Time stamp of the file of `list`.
    stamp: Option<SystemTime>,
    /// The scene after its edits.
    scene: Arc<Scene>,
    /// State of selections, made by the first one that needs it.
    lookup: Lookup,
}

/// Data of the edited scene for selections.
#[derive(Default)]
struct Lookup {
    /// Text model of `words`, while they are none.
    encoder: Option<Box<dyn RegionEncoder>>,
    /// Words and codes, on the device.
    words: Option<QueryScene>,
    /// Depth of the splats, on the device.
    surface: Option<Renderer>,
    /// The last view of it: outlines follow each other from one camera.
    depth: Option<(Camera, Image<f32>)>,
    /// Places of a scene without language.
    places: Option<Places>,
}

impl Editor {
    /// Loads a scene directory.
    ///
    /// # Errors
    /// A file of Gaussians, and an edit list that cannot be read.
    pub fn open(path: &Path, machine: &Machine) -> Result<Editor> {
        if path.is_file() {
            return Err(Error::input(format!(
                "{}: a file of Gaussians has no place for edits; splatvk label makes a scene directory of it",
                path.display()
            )));
        }
        let whole = Arc::new(scene_dir::load_unedited(path)?);
        let stamp = stamp(path);
        let list = EditList::read(path, &whole.splats)?;
        let scene = edited(&whole, &list);
        let (machine, lookup) = (machine.clone(), Lookup::default());
        Ok(Editor { machine, fixed: None, whole, list, stamp, scene, lookup })
    }

    /// A loaded scene for selections and questions. Edits are refused with a reason.
    pub fn read_only(scene: Scene, reason: &str, machine: &Machine) -> Editor {
        let (list, whole) = (EditList::new(&scene.splats), Arc::new(scene));
        Editor {
            machine: machine.clone(),
            fixed: Some(reason.to_owned()),
            scene: whole.clone(),
            whole,
            list,
            stamp: None,
            lookup: Lookup::default(),
        }
    }

    /// Takes the list that is in the scene now; returns whether another program changed it.
    ///
    /// # Errors
    /// A list that cannot be read; the present one stays then.
    pub fn reload(&mut self) -> Result<bool> {
        let stamp = stamp(&self.whole.path);
        if self.fixed.is_some() || stamp == self.stamp {
            return Ok(false);
        }
        let list = EditList::read(&self.whole.path, &self.whole.splats)?;
        self.stamp = stamp;
        let differs = list != self.list;
        if differs {
            let scene = edited(&self.whole, &list);
            self.take(list, scene);
        }
        Ok(differs)
    }

    /// The scene after its edits.
    pub fn scene(&self) -> &Scene {
        &self.scene
    }

    /// The edits.
    pub fn list(&self) -> &EditList {
        &self.list
    }

    /// Selects splats of the edited scene.
    ///
    /// # Errors
    /// A word that the scene does not contain or the text model does not know, an id or a property
    /// that the scene does not have, and a selection of nothing.
    pub fn select(&mut self, terms: &[Term]) -> Result<Selected> {
        let (rows, doubts) = self.rows(terms)?;
        if rows.is_empty() {
            return Err(Error::input(format!("{}: selects no splat of the scene", expression::texts(terms))));
        }
        let logits = &self.scene.splats.opacity_logits;
        let opacity = |logit: &f32| 1.0 / (1.0 + f64::from(-logit).exp());
        // Parts in their order: the sum does not depend on the threads.
        let parts = logits.par_chunks(1 << 16).map(|part| part.iter().map(opacity).sum());
        let all: f64 = parts.collect::<Vec<f64>>().iter().sum();
        let share = rows.iter().map(|i| opacity(&logits[*i])).sum::<f64>() / all.max(f64::MIN_POSITIVE);
        let count = rows.len();
        let rows = match &self.scene.edits {
            Some(edits) => edits.originals(rows),
            None => Rows::of(rows),
        };
        Ok(Selected { rows, count, share, doubts, terms: terms.to_vec() })
    }

    /// Adds edits of selections, and writes the list into the scene. A deletion takes along splats
    /// that it would uncover and no photo shows; returns their number.
    ///
    /// # Errors
    /// Edits that leave nothing, a folder that cannot be written, and a list that another program
    /// changed meanwhile; the scene is unchanged then.
    pub fn push(&mut self, edits: Vec<(Operation, Selected)>) -> Result<usize> {
        let (mut list, mut deleted, mut along) = (self.list.clone(), Rows::default(), 0);
        for (operation, Selected { terms, mut rows, .. }) in edits {
            if operation == (Operation::Delete {}) {
                deleted = deleted.with(&rows);
                let uncovered = self.uncovered(&deleted)?;
                along += uncovered.count();
                rows = rows.with(&uncovered);
                deleted = deleted.with(&uncovered);
            }
            list.push(Edit { operation, selection: terms, splats: rows });
        }
        let scene = edited(&self.whole, &list);
        if scene.splats.is_empty() {
            return Err(Error::input(format!(
                "{}: the edit leaves no splat; nothing is changed",
                self.whole.path.display()
            )));
        }
        self.replace(list, scene).map(|()| along)
    }

    /// Undoes the last edit; false without one.
    ///
    /// # Errors
    /// A folder that cannot be written.
    pub fn undo(&mut self) -> Result<bool> {
        self.step(EditList::undo)
    }

    /// Applies the edit that was undone last; false without one.
    ///
    /// # Errors
    /// A folder that cannot be written.
    pub fn redo(&mut self) -> Result<bool> {
        self.step(EditList::redo)
    }

    fn step(&mut self, step: impl FnOnce(&mut EditList) -> bool) -> Result<bool> {
        let mut list = self.list.clone();
        if !step(&mut list) {
            return Ok(false);
        }
        let scene = edited(&self.whole, &list);
        self.replace(list, scene).map(|()| true)
    }

    fn replace(&mut self, list: EditList, scene: Arc<Scene>) -> Result<()> {
        if let Some(reason) = &self.fixed {
            return Err(Error::input(reason.clone()));
        }
        let replaced = list.replace(&self.list, &self.whole);
        // After a refusal the next reload reads the file in any case.
        self.stamp = None;
        replaced?;
        self.stamp = stamp(&self.whole.path);
        self.take(list, scene);
        Ok(())
    }

    fn take(&mut self, list: EditList, scene: Arc<Scene>) {
        let Lookup { encoder, words, .. } = std::mem::take(&mut self.lookup);
        self.lookup.encoder = words.map(QueryScene::into_encoder).or(encoder);
        (self.list, self.scene) = (list, scene);
    }

    /// Answers a text in the views of the photos.
    ///
    /// # Errors
    /// A scene without language, and a text that its model does not know.
    pub fn ask(&mut self, text: &str, options: &QueryOptions) -> Result<Answers> {
        self.prepare()?;
        self.words()?.ask(text, options)
    }

    /// Decodes the views of the photos, which [`Editor::ask`] otherwise does with its first text.
    ///
    /// # Errors
    /// A scene without language, and a missing text model.
    pub fn prepare(&mut self) -> Result<()> {
        let scene = self.scene.clone();
        let words = self.words()?;
        if words.frames().is_empty() {
            words.set_views(&scene.cameras)?;
        }
        Ok(())
    }

    /// The best phrases of the text model for each code.
    ///
    /// # Errors
    /// A scene without language, and a missing text model.
    pub fn names(&mut self) -> Result<CodeNames> {
        self.words()?.names()
    }

    /// The scene with its words on the device.
    fn words(&mut self) -> Result<&mut QueryScene> {
        if self.lookup.words.is_none() {
            let scene = &self.scene;
            let field = scene.language.clone().ok_or_else(|| {
                Error::input(format!(
                    "{}: the scene has no language, so no words, ids and clicks; splatvk label gives it one",
                    scene.path.display()
                ))
            })?;
            let encoder = match self.lookup.encoder.take() {
                Some(encoder) => encoder,
                None => encoder::of_scene(scene, self.machine.registry()?)?,
            };
            let device = self.machine.gpu()?;
            let ready = QueryScene::open(&device, (&scene.splats, &scene.cameras), field, encoder)?;
            self.lookup.words = Some(ready);
        }
        self.lookup.words.as_mut().ok_or_else(|| Error::work("no words"))
    }

    /// Splats that are hidden in all photos until others are deleted: photos never formed them.
    fn uncovered(&self, deleted: &Rows) -> Result<Rows> {
        let scene = &self.scene;
        let row = |i: usize| scene.edits.as_ref().map_or(i, |edits| edits.rows[i] as usize);
        let kept: Vec<usize> = (0..scene.splats.len()).filter(|i| !deleted.has(row(*i))).collect();
        let device = self.machine.gpu()?;
        let bare = scene.splats.bare();
        let before = view::seen(&device, &bare, &scene.cameras, &Silent)?.pixels;
        let after = view::seen(&device, &bare.picked(&kept), &scene.cameras, &Silent)?.pixels;
        let is_hidden = |(i, after): &(&usize, &f32)| before[**i] < HIDDEN * **after;
        Ok(Rows::of(kept.iter().zip(&after).filter(is_hidden).map(|(i, _)| row(*i))))
    }

    /// Depth of a view, scene units; 0 where nothing is.
    fn depth(&mut self, camera: &Camera) -> Result<Image<f32>> {
        if let Some((_, depth)) = self.lookup.depth.as_ref().filter(|(known, _)| known == camera) {
            return Ok(depth.clone());
        }
        if self.lookup.surface.is_none() {
            let device = self.machine.gpu()?;
            self.lookup.surface = Some(Renderer::new(&device, &self.scene.splats.bare(), &[], 0)?);
        }
        let renderer = self.lookup.surface.as_mut().ok_or_else(|| Error::work("no renderer"))?;
        let depth = renderer.render(camera)?.depth;
        self.lookup.depth = Some((camera.clone(), depth.clone()));
        Ok(depth)
    }

    /// Positions of the splats, with their codes where the scene has language.
    fn places(&mut self) -> &Places {
        let Editor { scene, lookup, .. } = self;
        match &lookup.words {
            Some(words) => words.places(),
            None => lookup.places.get_or_insert_with(|| {
                Places::of(&scene.splats, scene.language.as_ref().unwrap_or(&LanguageField::default()))
            }),
        }
    }
}

/// Time stamp of the edits of a scene directory; `None` without.
fn stamp(scene: &Path) -> Option<SystemTime> {
    scene.join(edits::FILE).metadata().ok()?.modified().ok()
}

/// The scene after the edits of a list; without any it is shared.
fn edited(whole: &Arc<Scene>, list: &EditList) -> Arc<Scene> {
    match list.edits.is_empty() {
        true => whole.clone(),
        false => Arc::new(list.apply(Scene::clone(whole))),
    }
}

#[cfg(test)]
mod tests;
