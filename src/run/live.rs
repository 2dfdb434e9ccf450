//! A scene that a program holds in memory: rendered, queried and saved on demand. The C interface
//! is built on it.
use super::answer::Answers;
use super::ask::QuerySession;
use super::compat::{Compat, query_options};
use super::execute::save;
use super::outcome::RunOutcome;
use super::plan::Machine;
use super::view::{DecodedFrame, FeatureChannels, Viewer};
use super::{encoder, sources};
use crate::files::check_spared;
use crate::format::gaussians::{Reserved, WriteOptions};
use crate::format::scene_dir::{self, Contents, Scene};
use crate::format::views::Views;
use crate::format::{Workspace, colmap, gaussians, scene_photos};
use crate::gpu::Device;
use crate::infer::Registry;
use crate::pass::bands::Band;
use crate::pass::rasterizer::FrameBuffers;
use crate::photo;
use crate::progress::Silent;
use crate::query::QueryOptions;
use crate::query::phrasing::Reading;
use crate::report::viewer::{CodeNames, Layers, Scene3d};
use crate::scene::{Camera, LanguageField, Seen, Splats, World};
use crate::{Error, Result};
use std::path::Path;

/// A trained or loaded scene on a device.
///
/// ```no_run
/// # fn main() -> splatvk::Result<()> {
/// use splatvk::{gpu, infer::Registry, photo, pose::choose, progress::Silent, run::{self, Extras, ReconstructionConfig, live::LiveScene}};
/// let device = gpu::open(None)?;
/// let (chosen, _) = choose::photos(&["my-photos".into()], Some(4), &Silent)?;
/// let photos = photo::load_each(&chosen, photo::MAX_SIZE, &Silent)?;
/// let models = Registry::open(None)?;
/// let outcome = run::reconstruct(
///     &ReconstructionConfig::default(),
///     &Extras::default(),
///     &device,
///     &models,
///     photos,
///     &Silent,
/// )?;
/// let mut scene = LiveScene::trained(&device, outcome, &models)?;
/// let camera = scene.cameras()[0].clone();
/// let answer = scene.ask("blue mug", &camera)?;
/// println!("{}; in this view at {:?}", answer.verdict(), answer.views[0].location);
/// scene.save("out/kitchen".as_ref(), false)?;
/// # Ok(())
/// # }
/// ```
pub struct LiveScene {
    device: Device,
    origin: SceneOrigin,
    registry: Registry,
    viewer: Viewer,
    options: QueryOptions,
    /// Query state, created by the first query.
    session: Option<QuerySession>,
    /// Camera and frame of the last query.
    last_view: Option<(Camera, DecodedFrame)>,
}

enum SceneOrigin {
    Trained(Box<RunOutcome>),
    Loaded(Box<Scene>),
}

impl LiveScene {
    /// Loads a scene directory with its edits, or a file of Gaussians without language; the text
    /// encoder comes from `registry`.
    pub fn load(device: &Device, path: &Path, registry: &Registry) -> Result<LiveScene> {
        LiveScene::loaded(device, scene_dir::load(path)?, registry)
    }

    /// Takes a scene that was loaded.
    pub fn loaded(device: &Device, scene: Scene, registry: &Registry) -> Result<LiveScene> {
        LiveScene::new(device, SceneOrigin::Loaded(Box::new(scene)), registry)
    }

    /// Takes the outcome of a run.
    pub fn trained(device: &Device, outcome: RunOutcome, registry: &Registry) -> Result<LiveScene> {
        LiveScene::new(device, SceneOrigin::Trained(Box::new(outcome)), registry)
    }

    fn new(device: &Device, origin: SceneOrigin, registry: &Registry) -> Result<LiveScene> {
        let (splats, field) = match &origin {
            SceneOrigin::Trained(o) => (&o.splats, o.language.as_ref().map(|l| &l.field)),
            SceneOrigin::Loaded(s) => (&s.splats, s.language.as_ref()),
        };
        let compat = match &origin {
            SceneOrigin::Trained(o) => o.plan.config.language.as_ref().and_then(|l| l.compat),
            SceneOrigin::Loaded(s) if s.language.is_some() => Compat::of_scene(&s.path)?,
            SceneOrigin::Loaded(_) => None,
        };
        let viewer = Viewer::new(device, splats, field.unwrap_or(&LanguageField::default()))?;
        Ok(LiveScene {
            device: device.clone(),
            origin,
            registry: registry.clone(),
            viewer,
            options: query_options(compat),
            session: None,
            last_view: None,
        })
    }

    /// Device and models of the scene.
    pub fn machine(&self) -> Machine {
        Machine::of(self.device.clone(), self.registry.clone())
    }
    /// Device of the scene.
    pub fn device(&self) -> &Device {
        &self.device
    }
    /// The Gaussians.
    pub fn splats(&self) -> &Splats {
        match &self.origin {
            SceneOrigin::Trained(o) => &o.splats,
            SceneOrigin::Loaded(s) => &s.splats,
        }
    }
    /// Blending weight of the splats in the photos.
    pub fn seen(&self) -> &Seen {
        match &self.origin {
            SceneOrigin::Trained(o) => &o.seen,
            SceneOrigin::Loaded(s) => &s.seen,
        }
    }
    /// Cameras, one per photo; none for a bare file.
    pub fn cameras(&self) -> &[Camera] {
        match &self.origin {
            SceneOrigin::Trained(o) => &o.cameras,
            SceneOrigin::Loaded(s) => &s.cameras,
        }
    }
    /// Codebooks and features; `None` for a scene without language.
    pub fn language(&self) -> Option<&LanguageField> {
        match &self.origin {
            SceneOrigin::Trained(o) => o.language.as_ref().map(|l| &l.field),
            SceneOrigin::Loaded(s) => s.language.as_ref(),
        }
    }
    /// Direction up and scale.
    pub fn world(&self) -> &World {
        match &self.origin {
            SceneOrigin::Trained(o) => &o.world,
            SceneOrigin::Loaded(s) => &s.world,
        }
    }
    /// Warnings of the run, or parts that the reader of a file of Gaussians left out.
    pub fn warnings(&self) -> &[String] {
        match &self.origin {
            SceneOrigin::Trained(o) => &o.warnings,
            SceneOrigin::Loaded(s) => &s.warnings,
        }
    }
    /// Path of the scene directory or file; empty for a scene that is not saved.
    pub fn path(&self) -> &Path {
        match &self.origin {
            SceneOrigin::Trained(o) => &o.plan.output.out,
            SceneOrigin::Loaded(s) => &s.path,
        }
    }
    /// A copy of the scene, for work that changes it.
    pub fn copied(&self) -> Scene {
        match &self.origin {
            SceneOrigin::Loaded(scene) => Scene::clone(scene),
            SceneOrigin::Trained(outcome) => {
                let mut scene = Scene::default();
                scene.path = outcome.plan.output.out.clone();
                scene.splats = outcome.splats.clone();
                scene.seen = outcome.seen.clone();
                scene.backdrop = outcome.backdrop.clone();
                scene.cameras = outcome.cameras.clone();
                scene.world = outcome.world.clone();
                scene.language = self.language().cloned();
                scene
            }
        }
    }
    /// Place of a level's features in [`LiveScene::draw_bands`]; `None` without codes.
    pub fn features(&self, level: usize) -> Option<FeatureChannels> {
        self.viewer.features(level)
    }

    /// Renders one camera band by band and passes each band to `visit` while it is on the device:
    /// [`Viewer::draw_bands`].
    pub fn draw_bands(
        &mut self,
        model: usize,
        camera: &Camera,
        visit: impl FnMut(&FrameBuffers, &Band) -> Result<()>,
    ) -> Result<()> {
        check(camera)?;
        self.viewer.draw_bands(model, camera, visit)
    }

    /// Renders one camera whose frame fits on the device. The frame stays on the device and is
    /// valid until the next call.
    pub fn draw(&mut self, camera: &Camera) -> Result<&FrameBuffers> {
        check(camera)?;
        self.viewer.draw(camera)
    }

    /// Renders and decodes one camera.
    pub fn view(&mut self, camera: &Camera) -> Result<DecodedFrame> {
        check(camera)?;
        self.viewer.view(camera)
    }

    /// The splats of `rows` as a scene of their own, with its cameras, photos and language.
    ///
    /// # Errors
    /// Rows that the scene does not have, and a trained scene that is not saved yet.
    pub fn picked(&self, rows: &[usize]) -> Result<LiveScene> {
        let count = self.splats().len();
        if let Some(row) = rows.iter().find(|row| **row >= count) {
            return Err(Error::input(format!("there is no splat {row}; the scene has {count}")));
        }
        if self.path().as_os_str().is_empty() {
            return Err(Error::input("save the scene before a part of it is taken"));
        }
        let pixels = &self.seen().pixels;
        let mut scene = Scene::default();
        scene.path = self.path().to_path_buf();
        scene.splats = self.splats().picked(rows);
        scene.seen.pixels = rows.iter().filter_map(|&i| pixels.get(i)).copied().collect();
        scene.cameras = self.cameras().to_vec();
        scene.world = self.world().clone();
        scene.language = self.language().map(|field| field.clone().picked(rows, count));
        LiveScene::new(&self.device, SceneOrigin::Loaded(Box::new(scene)), &self.registry)
    }

    /// The interactive view as a whole page with at most `most` splats, for a frame in another
    /// page ([`Scene3d::framed`]).
    pub fn page(&self, title: &str, most: usize, asks: bool) -> Result<String> {
        let none = CodeNames::new();
        let no_holes = Splats::default();
        let (holes, backdrop) = match &self.origin {
            SceneOrigin::Trained(o) => (&no_holes, &o.backdrop),
            SceneOrigin::Loaded(s) => (&s.holes, &s.backdrop),
        };
        let names = match &self.origin {
            SceneOrigin::Trained(o) => o.language.as_ref().map_or(&none, |l| &l.names),
            SceneOrigin::Loaded(_) => &none,
        };
        let scene = Scene3d {
            title,
            layers: Layers { splats: self.splats(), seen: self.seen(), holes, backdrop },
            cameras: self.cameras(),
            world: self.world(),
            photos: Vec::new(),
            language: self.language(),
            names,
            answers: Vec::new(),
            suggested: Vec::new(),
            named: Views::default(),
        };
        scene.framed(most, asks)
    }

    /// Answers a text for the scene and for one view.
    pub fn ask(&mut self, text: &str, camera: &Camera) -> Result<Answers> {
        check(camera)?;
        if self.language().is_none_or(|f| f.levels.iter().all(|l| l.codebook.is_empty())) {
            return Err(Error::input(
                "the scene has no language; only scenes made from photos by a run have it",
            ));
        }
        let mut session = match self.session.take() {
            Some(ready) => ready,
            None => self.open_session()?,
        };
        let answers = self.answer(&mut session, text, camera);
        self.session = Some(session);
        answers
    }

    /// The understood part of a text.
    pub fn reading(&mut self, text: &str) -> Result<Reading> {
        let mut session = match self.session.take() {
            Some(ready) => ready,
            None => self.open_session()?,
        };
        let reading = session.reading(text);
        self.session = Some(session);
        reading
    }

    fn answer(&mut self, session: &mut QuerySession, text: &str, camera: &Camera) -> Result<Answers> {
        let (camera, frame) = match self.last_view.take().filter(|(c, _)| c == camera) {
            Some(same) => same,
            None => (camera.clone(), self.viewer.view(camera)?),
        };
        // Not `self.language()`: the viewer is borrowed mutably while the field is read.
        let field = match &self.origin {
            SceneOrigin::Trained(o) => o.language.as_ref().map(|l| &l.field),
            SceneOrigin::Loaded(s) => s.language.as_ref(),
        };
        let field = field.ok_or_else(no_language)?;
        let views = (std::slice::from_ref(&camera), std::slice::from_ref(&frame));
        let answers = session.ask(text, &mut self.viewer, field, views, &self.options, None);
        self.last_view = Some((camera, frame));
        answers
    }

    fn open_session(&self) -> Result<QuerySession> {
        let encoder = match &self.origin {
            SceneOrigin::Trained(o) => {
                let config = o.plan.config.language.as_ref().ok_or_else(no_language)?;
                sources::encoder(&config.features, &self.registry)?
            }
            SceneOrigin::Loaded(s) => encoder::of_scene(s, self.registry.clone())?,
        };
        let field = self.language().ok_or_else(no_language)?;
        QuerySession::open(encoder, self.splats(), field, self.cameras())
    }

    /// Writes a file of Gaussians in the format of its ending ([`gaussians::write`]), or a scene
    /// directory if the path has no ending, ends in a slash or is a folder, whole or not at all;
    /// `replace` allows to replace an existing scene or file.
    pub fn save(&mut self, path: &Path, replace: bool) -> Result<()> {
        if gaussians::is_named(path) {
            self.check_spared(path)?;
            let format = gaussians::format(path)?;
            return Reserved::open(path, replace)?.write(
                self.splats(),
                self.language(),
                format,
                WriteOptions::default(),
            );
        }
        if let Some(ending) = path.extension()
            && !path.is_dir()
            && !path.as_os_str().as_encoded_bytes().ends_with(b"/")
        {
            return Err(Error::input(format!(
                "{}: .{} is no format of splats (there are {}); a scene directory of this name ends in a slash",
                path.display(),
                ending.display(),
                gaussians::endings()
            )));
        }
        match &mut self.origin {
            SceneOrigin::Trained(outcome) => save(outcome, path, replace, &Silent),
            SceneOrigin::Loaded(scene) => save_loaded(scene, path, replace),
        }
    }

    /// Refuses to replace the file that the scene was loaded from.
    fn check_spared(&self, path: &Path) -> Result<()> {
        match &self.origin {
            SceneOrigin::Loaded(scene) => check_spared(path, [scene.path.as_path()]),
            SceneOrigin::Trained(_) => Ok(()),
        }
    }
}

fn no_language() -> Error {
    Error::work("the scene has no language")
}

fn save_loaded(scene: &Scene, path: &Path, replace: bool) -> Result<()> {
    let workspace = Workspace::create(path, replace, &[&scene.path])?;
    let folder = scene.path.join("cameras");
    // A scene without its photos is saved without them.
    let load_image = |c: &Camera| photo::load_at(&scene_photos::picture(&scene.path, c)?, usize::MAX).ok();
    let photos = scene_photos::load(&scene.path).ok();
    let photos = photos.or_else(|| scene.cameras.iter().map(load_image).collect()).unwrap_or_default();
    let points = colmap::read_points(&folder.join("colmap")).ok();
    let table = scene.path.join(scene_dir::TEXT_EMBEDDINGS);
    let contents = Contents {
        splats: &scene.splats,
        seen: &scene.seen,
        backdrop: &scene.backdrop,
        holes: &scene.holes,
        cameras: &scene.cameras,
        world: &scene.world,
        photos: &photos,
        points: points.as_ref(),
        language: scene.language.as_ref(),
        text_embeddings: table.is_file().then_some(table.as_path()),
    };
    scene_dir::write(workspace.path(), &contents)?;
    workspace.commit().map(drop)
}

/// Refuses cameras from outside that cannot be rendered.
fn check(camera: &Camera) -> Result<()> {
    camera.clone().checked().map(drop).map_err(Error::input)
}
