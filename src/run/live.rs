//! A scene that a program holds in memory: rendered, queried and saved on demand. What the C interface is made of.
use super::compat::{Compat, query_options};
use super::execute::save;
use super::outcome::RunOutcome;
use super::view::{FeatureChannels, Viewer};
use super::{encoder, sources};
use crate::format::scene_dir::{self, Contents, Scene};
use crate::format::{Workspace, colmap, gaussians};
use crate::gpu::Device;
use crate::infer::{RegionEncoder, Registry};
use crate::pass::bands::Band;
use crate::pass::rasterizer::FrameBuffers;
use crate::photo;
use crate::progress::Silent;
use crate::query::{self, CANONICAL_PHRASES, QueryOptions, QueryResult, TextQuery};
use crate::scene::{Camera, LanguageField, Plane, Seen, Splats};
use crate::{Error, Result};
use std::path::Path;

/// A trained or loaded scene on a device.
///
/// ```no_run
/// # fn main() -> splatvk::Result<()> {
/// use splatvk::{gpu::Device, infer::Registry, photo, pose::choose, progress::Silent, run::{self, RunPlan, live::LiveScene}};
/// let device = Device::open(None)?;
/// let (chosen, _) = choose::photos(&["my-photos".into()], Some(4), &Silent)?;
/// let photos = photo::load_each(&chosen, photo::MAX_SIZE, &Silent)?;
/// let models = Registry::open(None)?;
/// let outcome = run::reconstruct(&RunPlan::default(), &device, &models, photos, &Silent)?;
/// let mut scene = LiveScene::trained(&device, outcome, &models)?;
/// let camera = scene.cameras()[0].clone();
/// let answer = scene.ask("blue mug", &camera)?;
/// println!("found: {}, at {:?}", answer.found, answer.location);
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
    /// The text encoder and the [C, D] unit rows of the canonical phrases; loaded with the first question.
    text_encoder: Option<(Box<dyn RegionEncoder>, Vec<f32>)>,
    /// Decoded codes of the last query's camera.
    seen: Option<(Camera, Vec<Plane<i32>>)>,
}

enum SceneOrigin {
    Trained(Box<RunOutcome>),
    Loaded(Box<Scene>),
}

impl LiveScene {
    /// Loads a scene directory, or a file of Gaussians that has no language. `models` is the folder of the models,
    /// where the text encoder is taken from; `None` = the default one.
    pub fn load(device: &Device, path: &Path, registry: &Registry) -> Result<LiveScene> {
        LiveScene::new(device, SceneOrigin::Loaded(Box::new(scene_dir::load(path)?)), registry)
    }

    /// Takes over what a run made.
    pub fn trained(device: &Device, outcome: RunOutcome, registry: &Registry) -> Result<LiveScene> {
        LiveScene::new(device, SceneOrigin::Trained(Box::new(outcome)), registry)
    }

    fn new(device: &Device, origin: SceneOrigin, registry: &Registry) -> Result<LiveScene> {
        let (splats, field) = match &origin {
            SceneOrigin::Trained(o) => (&o.splats, Some(&o.field)),
            SceneOrigin::Loaded(s) => (&s.splats, s.language.as_ref()),
        };
        let compat = match &origin {
            SceneOrigin::Trained(o) => o.plan.compat,
            SceneOrigin::Loaded(s) => Compat::of_scene(&s.path),
        };
        let viewer = Viewer::new(device, splats, field.unwrap_or(&LanguageField::default()))?;
        Ok(LiveScene {
            device: device.clone(),
            origin,
            registry: registry.clone(),
            viewer,
            options: query_options(compat),
            text_encoder: None,
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
            SceneOrigin::Trained(o) => Some(&o.field),
            SceneOrigin::Loaded(s) => s.language.as_ref(),
        }
    }
    /// What the run was warned of; none for a loaded scene.
    pub fn warnings(&self) -> &[String] {
        match &self.origin {
            SceneOrigin::Trained(o) => &o.warnings,
            SceneOrigin::Loaded(_) => &[],
        }
    }
    /// Where [`LiveScene::draw_bands`] renders the features of a level; `None` without codes.
    pub fn features(&self, level: usize) -> Option<FeatureChannels> {
        self.viewer.features(level)
    }

    /// Renders one camera band by band and shows every band while it is on the device: [`Viewer::draw_bands`].
    pub fn draw_bands(
        &mut self,
        model: usize,
        camera: &Camera,
        seen: impl FnMut(&FrameBuffers, &Band) -> Result<()>,
    ) -> Result<()> {
        check(camera)?;
        self.viewer.draw_bands(model, camera, seen)
    }

    /// Renders one camera that the device holds at once. The frame stays on the device, and valid until the next call.
    pub fn draw(&mut self, camera: &Camera) -> Result<&FrameBuffers> {
        check(camera)?;
        self.viewer.draw(camera)
    }

    /// Answers a text in the view of a camera.
    pub fn ask(&mut self, text: &str, camera: &Camera) -> Result<QueryResult> {
        check(camera)?;
        if text.trim().is_empty() {
            return Err(Error::input("an empty query; give a few words"));
        }
        if self.language().is_none_or(|f| f.levels.iter().all(|l| l.codebook.is_empty())) {
            return Err(Error::input(
                "the scene has no language; only scenes made from photos by a run have it",
            ));
        }
        let (mut encoder, canonicals) = match self.text_encoder.take() {
            Some(ready) => ready,
            None => self.open_text_encoder()?,
        };
        let embedding = encoder.embed_texts(&[text]);
        let query = embedding.map(|embedding| TextQuery {
            text: text.to_owned(),
            embedding,
            canonicals: canonicals.clone(),
            alternatives: Default::default(),
        });
        self.text_encoder = Some((encoder, canonicals));
        let query = query?;
        if self.seen.as_ref().is_none_or(|(c, _)| c != camera) {
            let codes = self.viewer.codes(camera)?;
            self.seen = Some((camera.clone(), codes));
        }
        let codes = self.seen.as_ref().map_or(&[][..], |(_, codes)| codes);
        let field = self.language().ok_or_else(|| Error::work("the scene has no language"))?;
        query::answer(codes, field, &query, &self.options)
    }

    fn open_text_encoder(&self) -> Result<(Box<dyn RegionEncoder>, Vec<f32>)> {
        let mut encoder = match &self.origin {
            SceneOrigin::Trained(o) => sources::encoder(&o.plan.features, &self.registry)?,
            SceneOrigin::Loaded(s) => encoder::of_scene(s, self.registry.clone())?,
        };
        let canonicals = encoder.embed_texts(&CANONICAL_PHRASES)?;
        Ok((encoder, canonicals))
    }

    /// Writes a file of the kind that its name asks for ([`gaussians::write`]), or else a scene directory, whole or not at
    /// all; `replace` allows to replace a scene or file that is there.
    pub fn save(&mut self, path: &Path, replace: bool) -> Result<()> {
        if gaussians::is_named(path) {
            if path.exists() && !replace {
                return Err(Error::input(format!("{}: is already there", path.display())));
            }
            return gaussians::write(path, self.splats(), self.language());
        }
        match &mut self.origin {
            SceneOrigin::Trained(outcome) => save(outcome, path, replace, &Silent),
            SceneOrigin::Loaded(scene) => save_loaded(scene, path, replace),
        }
    }
}

fn save_loaded(scene: &Scene, path: &Path, replace: bool) -> Result<()> {
    let workspace = Workspace::create(path, replace)?;
    let folder = scene.path.join("cameras");
    // A scene without its photos is still whole.
    let photos = scene.cameras.iter().map(|c| photo::load_at(&folder.join(&c.name), usize::MAX));
    let photos = photos.collect::<Result<Vec<_>>>().unwrap_or_default();
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
