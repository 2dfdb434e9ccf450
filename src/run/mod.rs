//! The whole pipeline on one page: photos → cameras, depth and points → splats → language → scene directory.
pub mod ask;
pub mod budget;
pub mod encoder;
mod light;
mod list;
pub mod live;
pub mod method;
mod networks;
mod plan;
mod record;
pub mod refine;
pub mod score;
pub mod sources;
pub(crate) mod stages;
pub mod train;
pub mod view;

pub use method::{FEATURE_DIM, Method, Recipe};
pub use plan::RunPlan;
pub use record::{closing_table, run_record};

use crate::Result;
use crate::fit::{self, Preset};
use crate::format::Workspace;
use crate::format::scene_dir::{self, Contents};
use crate::gpu::{self, Device};
use crate::infer::{Registry, home};
use crate::language;
use crate::photo::{self, Photo};
use crate::pipeline::{Graph, Store};
use crate::pose::{self, Geometry};
use crate::progress::{Progress, Recorded, StageRecord};
use crate::query::QueryResult;
use crate::query::highlight::Highlight;
use crate::report::ModelUsed;
use crate::report::viewer::{Names, ShownAnswer};
use crate::scene::{Camera, LanguageField, Splats};
use networks::Networks;
use sources::Build;
use std::path::{Path, PathBuf};
use std::time::Duration;
use view::DecodedFrame;

/// The answers to one text, one per photo.
#[derive(Clone, Debug)]
pub struct Answers {
    /// What was asked.
    pub text: String,
    /// Per photo.
    pub views: Vec<QueryResult>,
    /// For the scene as a whole.
    pub highlight: Highlight,
}

impl Answers {
    /// For the interactive view.
    pub fn shown(&self) -> ShownAnswer<'_> {
        ShownAnswer {
            text: &self.text,
            found: self.found(),
            views: self.views.len(),
            highlight: &self.highlight,
        }
    }

    /// Photos in which the text was found.
    pub fn found(&self) -> usize {
        self.views.iter().filter(|v| v.found).count()
    }
}

/// Everything a finished run knows; [`crate::report`] turns it into run.json, report.html and the summary.
pub struct Outcome {
    /// What was asked for.
    pub plan: RunPlan,
    /// The preset that was used.
    pub preset: Preset,
    /// The device that was used.
    pub device: crate::gpu::DeviceInfo,
    /// Which photos were used and why, where there were more than wanted.
    pub choice: Option<pose::choose::Choice>,
    /// Photos at working resolution.
    pub photos: Vec<Photo>,
    /// Geometry before training.
    pub geometry: Geometry,
    /// Refined cameras.
    pub cameras: Vec<Camera>,
    /// The scene.
    pub splats: Splats,
    /// Figures of the colour stage.
    pub rgb: fit::FitStats,
    /// The scene's language.
    pub field: LanguageField,
    /// Masks, edges and components behind it.
    pub alignment: language::align::Alignment,
    /// Decode accuracy over the language stage.
    pub language_curve: Vec<fit::LanguagePoint>,
    /// The trained scene seen from every photo's camera.
    pub frames: Vec<DecodedFrame>,
    /// One per query of the plan.
    pub answers: Vec<Answers>,
    /// The text model's own phrases per level and code.
    pub names: Names,
    /// What computed the networks.
    pub provider: Option<&'static str>,
    /// Built-in models.
    pub models: Vec<crate::infer::ModelStatus>,
    /// Files of the networks that were used.
    pub networks: Vec<ModelUsed>,
    /// Times and memory per stage, up to the writing of the scene.
    pub stages: Vec<StageRecord>,
    /// Wall seconds up to there; less than the stages together, since some overlap.
    pub seconds: f64,
    /// What the user was warned of.
    pub warnings: Vec<String>,
}

/// Runs the plan and writes the scene directory, whole or not at all.
pub fn run(plan: &RunPlan, progress: &dyn Progress) -> Result<Outcome> {
    let progress = &Recorded::new(progress);
    let workspace = Workspace::create(&plan.out, plan.force)?;
    // The device comes first: it says how large the photos may be.
    let device = Device::with(&gpu::Options {
        deterministic: plan.deterministic,
        ..gpu::Options::from_env(plan.device.as_deref())
    })?;
    let max_size = plan.max_size.unwrap_or(photo::default_max_size(device.info().is_cpu));
    let (chosen, choice) = pose::choose::photos(&plan.inputs, plan.views, progress)?;
    plan.check_budget(&device, &photo::sizes_of(&chosen), max_size)?;
    let photos = photo::load_each(&chosen, max_size, progress)?;
    let registry = plan.registry()?;
    let store = store(plan.resume, plan.checkpoint_seconds);
    let outcome = Outcome { choice, ..work(plan, &device, &registry, photos, &store, progress)? };
    write(workspace, &outcome, progress)?;
    Ok(outcome)
}

/// The run without its files, for programs that hold photos, device and models themselves. Of the plan, everything about
/// inputs, output, device and models goes unread.
pub fn reconstruct(
    plan: &RunPlan,
    device: &Device,
    registry: &Registry,
    photos: Vec<Photo>,
    progress: &dyn Progress,
) -> Result<Outcome> {
    photo::check_set(&photos)?;
    let sizes: Vec<_> = photos.iter().map(|p| (p.image.width, p.image.height)).collect();
    plan.check_budget(device, &sizes, usize::MAX)?;
    work(plan, device, registry, photos, &Store::none(), &Recorded::new(progress))
}

/// Writes what [`reconstruct`] made as a scene directory, whole or not at all; `force` replaces a scene.
pub fn save(outcome: &mut Outcome, out: &Path, force: bool, progress: &dyn Progress) -> Result<()> {
    let workspace = Workspace::create(out, force)?;
    outcome.plan.out = out.to_path_buf();
    write(workspace, outcome, progress)
}

fn work(
    plan: &RunPlan,
    device: &Device,
    registry: &Registry,
    photos: Vec<Photo>,
    store: &Store,
    progress: &Recorded,
) -> Result<Outcome> {
    // Whatever can be refused is read before the long work, not after it.
    registry.compute().report(progress)?;
    let networks = Networks::of(plan, registry)?;
    networks.warn_untrained(progress);
    list::check(plan, &photos, registry)?;
    let preset = plan.preset_on(device);
    let mut build = Build { graph: Graph::default(), registry: registry.clone(), plan: plan.clone(), preset };
    let scene = list::scene(&mut build, device, photos)?;
    let mut made = build.graph.run(&scene.targets(), device, registry, store, progress)?;
    registry.compute().report(progress)?;
    let (trained, language) = (made.take(scene.trained)?, made.take(scene.language)?);
    Ok(Outcome {
        plan: plan.clone(),
        preset,
        device: device.info().clone(),
        choice: None,
        photos: made.take(scene.placed)?.photos,
        geometry: made.take(scene.geometry)?,
        cameras: trained.cameras,
        splats: language.splats,
        rgb: trained.stats,
        field: language.field,
        alignment: made.take(scene.aligned)?.alignment,
        language_curve: language.curve,
        frames: made.take(scene.frames)?,
        answers: made.take(scene.answers)?,
        names: made.take(scene.names)?,
        provider: registry.compute().name().ok(),
        models: registry.status(),
        networks: networks.used()?,
        stages: progress.stages(),
        seconds: progress.seconds(),
        warnings: progress.warnings(),
    })
}

/// Training states are some ten megabytes for scenes of a few photos: written in a fraction of a second.
pub const CHECKPOINT_SECONDS: u64 = 30;

/// What stages made, on disk.
fn store(resume: bool, checkpoint_seconds: u64) -> Store {
    Store::at(stage_folder(), resume, Duration::from_secs(checkpoint_seconds))
}

/// Where runs keep what their stages made.
pub fn stage_folder() -> PathBuf {
    home().join("stages")
}

fn write(workspace: Workspace, outcome: &Outcome, progress: &dyn Progress) -> Result<()> {
    progress.begin("write", 2);
    progress.check()?;
    let table = sources::text_table(&outcome.plan.features);
    let contents = Contents {
        splats: &outcome.splats,
        cameras: &outcome.cameras,
        photos: &outcome.photos,
        points: Some(&outcome.geometry.points),
        language: Some(&outcome.field),
        text_embeddings: table.as_deref(),
    };
    scene_dir::write(workspace.path(), &contents)?;
    progress.step(1, "");
    record::write(workspace.path(), outcome)?;
    progress.check()?;
    workspace.commit()?;
    progress.end();
    Ok(())
}
