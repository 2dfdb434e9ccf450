//! A scene that a program holds in memory: rendered, queried and saved on demand. What the C
//! interface is made of.
use super::answer::Answers;
use super::ask::Questions;
use super::compat::{Compat, query_options};
use super::execute::save;
use super::outcome::RunOutcome;
use super::view::{DecodedFrame, FeatureChannels, Viewer};
use super::{encoder, sources};
use crate::files::check_spared;
use crate::format::gaussians::{Reserved, WriteOptions};
use crate::format::scene_dir::{self, Contents, Scene};
use crate::format::{Workspace, colmap, gaussians, scene_photos};
use crate::gpu::Device;
use crate::infer::Registry;
use crate::pass::bands::Band;
use crate::pass::rasterizer::FrameBuffers;
use crate::photo;
use crate::progress::Silent;
use crate::query::QueryOptions;
use crate::query::phrasing::Reading;
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
    /// Opened with the first one.
    questions: Option<Questions>,
    /// The last query's camera and what it shows.
    seen: Option<(Camera, DecodedFrame)>,
}

enum SceneOrigin {
    Trained(Box<RunOutcome>),
    Loaded(Box<Scene>),
}

impl LiveScene {
    /// Loads a scene directory, or a file of Gaussians that has no language. `models` is the folder
    /// of the models, where the text encoder is taken from; `None` = the default one.
    pub fn load(device: &Device, path: &Path, registry: &Registry) -> Result<LiveScene> {
        LiveScene::new(device, SceneOrigin::Loaded(Box::new(scene_dir::load(path)?)), registry)
    }

    /// Takes over what a run made.
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
            questions: None,
            seen: None,
        })
    }

    /// The device that it is drawn on.
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
    /// What the photos show of them.
    pub fn seen(&self) -> &Seen {
        match &self.origin {
            SceneOrigin::Trained(o) => &o.seen,
            SceneOrigin::Loaded(s) => &s.seen,
        }
    }
    /// One per photo; none for a bare file.
    pub fn cameras(&self) -> &[Camera] {
        match &self.origin {
            SceneOrigin::Trained(o) => &o.cameras,
            SceneOrigin::Loaded(s) => &s.cameras,
        }
    }
    /// Codebooks and features, where the scene has language.
    pub fn language(&self) -> Option<&LanguageField> {
        match &self.origin {
            SceneOrigin::Trained(o) => o.language.as_ref().map(|l| &l.field),
            SceneOrigin::Loaded(s) => s.language.as_ref(),
        }
    }
    /// How the scene lies in the world.
    pub fn world(&self) -> &World {
        match &self.origin {
            SceneOrigin::Trained(o) => &o.world,
            SceneOrigin::Loaded(s) => &s.world,
        }
    }
    /// What the run was warned of, or what was left out of a file of Gaussians.
    pub fn warnings(&self) -> &[String] {
        match &self.origin {
            SceneOrigin::Trained(o) => &o.warnings,
            SceneOrigin::Loaded(s) => &s.warnings,
        }
    }
    /// Where [`LiveScene::draw_bands`] renders the features of a level; `None` without codes.
    pub fn features(&self, level: usize) -> Option<FeatureChannels> {
        self.viewer.features(level)
    }

    /// Renders one camera band by band and shows every band while it is on the device:
    /// [`Viewer::draw_bands`].
    pub fn draw_bands(
        &mut self,
        model: usize,
        camera: &Camera,
        seen: impl FnMut(&FrameBuffers, &Band) -> Result<()>,
    ) -> Result<()> {
        check(camera)?;
        self.viewer.draw_bands(model, camera, seen)
    }

    /// Renders one camera that the device holds at once. The frame stays on the device, and valid
    /// until the next call.
    pub fn draw(&mut self, camera: &Camera) -> Result<&FrameBuffers> {
        check(camera)?;
        self.viewer.draw(camera)
    }

    /// Answers a text for the scene and in the view of a camera: the answer has one view.
    pub fn ask(&mut self, text: &str, camera: &Camera) -> Result<Answers> {
        check(camera)?;
        if self.language().is_none_or(|f| f.levels.iter().all(|l| l.codebook.is_empty())) {
            return Err(Error::input(
                "the scene has no language; only scenes made from photos by a run have it",
            ));
        }
        let mut questions = match self.questions.take() {
            Some(ready) => ready,
            None => self.open_questions()?,
        };
        let answers = self.answer(&mut questions, text, camera);
        self.questions = Some(questions);
        answers
    }

    /// What is understood of a text.
    pub fn reading(&mut self, text: &str) -> Result<Reading> {
        let mut questions = match self.questions.take() {
            Some(ready) => ready,
            None => self.open_questions()?,
        };
        let reading = questions.reading(text);
        self.questions = Some(questions);
        reading
    }

    fn answer(&mut self, questions: &mut Questions, text: &str, camera: &Camera) -> Result<Answers> {
        let (camera, frame) = match self.seen.take().filter(|(c, _)| c == camera) {
            Some(same) => same,
            None => (camera.clone(), self.viewer.view(camera)?),
        };
        // Taken apart, since the viewer is used while the field is read.
        let field = match &self.origin {
            SceneOrigin::Trained(o) => o.language.as_ref().map(|l| &l.field),
            SceneOrigin::Loaded(s) => s.language.as_ref(),
        };
        let field = field.ok_or_else(no_language)?;
        let views = (std::slice::from_ref(&camera), std::slice::from_ref(&frame));
        let answers = questions.ask(text, &mut self.viewer, field, views, &self.options);
        self.seen = Some((camera, frame));
        answers
    }

    fn open_questions(&self) -> Result<Questions> {
        let encoder = match &self.origin {
            SceneOrigin::Trained(o) => {
                let config = o.plan.config.language.as_ref().ok_or_else(no_language)?;
                sources::encoder(&config.features, &self.registry)?
            }
            SceneOrigin::Loaded(s) => encoder::of_scene(s, self.registry.clone())?,
        };
        let field = self.language().ok_or_else(no_language)?;
        Questions::open(encoder, self.splats(), field, self.cameras())
    }

    /// Writes a file of the kind that its name asks for ([`gaussians::write`]), or a scene
    /// directory where the name has no ending, ends in a slash or is that of a folder, whole or not
    /// at all; `replace` allows to replace a scene or file that is there.
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
    // A scene without its photos is still whole.
    let plain = |c: &Camera| photo::load_at(&scene_photos::picture(&scene.path, c)?, usize::MAX).ok();
    let photos = scene_photos::load(&scene.path).ok();
    let photos = photos.or_else(|| scene.cameras.iter().map(plain).collect()).unwrap_or_default();
    let points = colmap::read_points(&folder.join("colmap")).ok();
    let table = scene.path.join(scene_dir::TEXT_EMBEDDINGS);
    let contents = Contents {
        splats: &scene.splats,
        seen: &scene.seen,
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

/// Cameras come from outside: refuses what cannot be rendered.
fn check(camera: &Camera) -> Result<()> {
    camera.clone().checked().map(drop).map_err(Error::input)
}
