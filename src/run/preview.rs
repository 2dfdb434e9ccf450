//! Preview of a scene whose splats are still being trained: the points of stereo as splats, then
//! the splats so far.
use super::stages::PlacedPhotos;
use crate::checkpoint::Checkpoint;
use crate::files::{self, Partial};
use crate::fit::init::splats_from_points;
use crate::fit::{InitOptions, RgbOptions};
use crate::format::Workspace;
use crate::format::scene_dir::{self, Contents};
use crate::pose::Geometry;
use crate::progress::{Overall, Progress};
use crate::report::shell_quoted;
use crate::scene::{Camera, Seen, Splats, World};
use crate::sync::lock;
use crate::{Error, Result};
use std::path::{Path, PathBuf};
use std::sync::{Condvar, Mutex, PoisonError};
use std::time::{Duration, Instant};

/// Opacity of a splat: training starts from transparent ones, which look like fog.
const OPACITY: f32 = 0.95;
/// Size of a splat against training, which closes the gaps itself.
const GROWTH: f32 = 1.5;
/// Time between two previews. Writing one takes a fraction of a second.
const RENEWED_AFTER: Duration = Duration::from_secs(8);

/// Place of the preview of a run.
#[derive(Clone, Debug)]
pub struct Preview {
    /// Folder of the preview, inside the hidden folder of the scene: it goes with it.
    folder: PathBuf,
    /// Place of the finished scene, for the message.
    scene: PathBuf,
}

impl Preview {
    /// Preview of the scene that `workspace` writes to `scene`.
    pub(super) fn of(workspace: &Workspace, scene: &Path) -> Preview {
        Preview { folder: workspace.preview(), scene: scene.to_path_buf() }
    }

    /// Writes the points of stereo as splats, prints how to look at them, and then the splats of
    /// the training in the same place as they come, whole or not at all. A failure costs the run
    /// nothing but the preview.
    pub(super) fn show(
        &self,
        placed: &PlacedPhotos,
        geometry: &Geometry,
        options: &RgbOptions,
        trained: &Renewals,
        progress: &dyn Progress,
    ) {
        let first = start(geometry, options);
        match first.and_then(|splats| self.write(&splats, &geometry.cameras, placed)) {
            Ok(()) => progress
                .inform(&format!("look at a preview meanwhile: splatvk view {}", shell_quoted(&self.scene))),
            Err(error) => return progress.inform(&format!("no preview: {error}")),
        }
        while let Some((splats, cameras)) = trained.next() {
            // The disk may be full: the run reports that where it matters.
            if self.write(&splats, &cameras, placed).is_err() {
                return;
            }
        }
    }

    fn write(&self, splats: &Splats, cameras: &[Camera], placed: &PlacedPhotos) -> Result<()> {
        let written = self.folder.with_extension("part");
        crate::format::create_folder(&written)?;
        let contents = Contents {
            splats,
            seen: &Seen::default(),
            backdrop: &Default::default(),
            holes: &Default::default(),
            cameras,
            world: &World::default(),
            photos: &placed.photos,
            points: None,
            language: None,
            text_embeddings: None,
        };
        scene_dir::write(&written, &contents)?;
        let failed = Error::io(&self.folder);
        if !self.folder.exists() {
            return std::fs::rename(&written, &self.folder).map_err(failed);
        }
        let aside = self.folder.with_extension("old");
        files::swap(&written, &self.folder, &aside).map_err(failed)?;
        for old in [written, aside] {
            let _ = std::fs::remove_dir_all(old);
        }
        Ok(())
    }
}

/// The points of stereo as splats.
fn start(geometry: &Geometry, options: &RgbOptions) -> Result<Splats> {
    let InitOptions { footprint, neighbours, .. } = options.init;
    let init = InitOptions {
        opacity: OPACITY,
        footprint: GROWTH * footprint,
        neighbours: GROWTH * neighbours,
        ..options.init
    };
    splats_from_points(&geometry.points, &init, options.seed)
}

/// Splats of a training on their way to the preview; the last ones replace those that wait.
pub(super) struct Renewals {
    state: Mutex<Renewal>,
    changed: Condvar,
}

struct Renewal {
    waiting: Option<(Splats, Vec<Camera>)>,
    ended: bool,
    /// When the next splats are of use.
    next: Instant,
}

impl Renewals {
    pub(super) fn new() -> Renewals {
        let state = Renewal { waiting: None, ended: false, next: Instant::now() + RENEWED_AFTER };
        Renewals { state: Mutex::new(state), changed: Condvar::new() }
    }

    /// The next splats; `None` after the end of the training.
    fn next(&self) -> Option<(Splats, Vec<Camera>)> {
        let mut state = lock(&self.state);
        loop {
            if state.ended {
                return None;
            }
            if let Some(splats) = state.waiting.take() {
                return Some(splats);
            }
            state = self.changed.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
    }

    fn is_due(&self) -> bool {
        let state = lock(&self.state);
        state.waiting.is_none() && Instant::now() >= state.next
    }

    fn put(&self, splats: Splats, cameras: &[Camera]) {
        let mut state = lock(&self.state);
        state.waiting = Some((splats, cameras.to_vec()));
        state.next = Instant::now() + RENEWED_AFTER;
        self.changed.notify_one();
    }

    fn end(&self) {
        lock(&self.state).ended = true;
        self.changed.notify_one();
    }
}

/// Progress of a training that renews the preview until it is dropped.
pub(super) struct Renewing<'a> {
    pub(super) progress: &'a dyn Progress,
    pub(super) to: &'a Renewals,
}

impl Drop for Renewing<'_> {
    fn drop(&mut self) {
        self.to.end();
    }
}

impl Progress for Renewing<'_> {
    fn begin(&self, stage: &'static str, steps: u64) {
        self.progress.begin(stage, steps);
    }
    fn step(&self, done: u64, note: &str) {
        self.progress.step(done, note);
    }
    fn figures(&self, step: u64, figures: &[(&str, f64)]) {
        self.progress.figures(step, figures);
    }
    fn overall(&self, overall: Overall) {
        self.progress.overall(overall);
    }
    fn end(&self) {
        self.progress.end();
    }
    fn warn(&self, message: &str) {
        self.progress.warn(message);
    }
    fn inform(&self, message: &str) {
        self.progress.inform(message);
    }
    fn cancelled(&self) -> bool {
        self.progress.cancelled()
    }
    fn checkpoint(&self) -> Option<&Checkpoint> {
        self.progress.checkpoint()
    }
    fn wants_splats(&self) -> bool {
        self.to.is_due()
    }
    fn splats(&self, splats: Splats, cameras: &[Camera]) {
        self.to.put(splats, cameras);
    }
    fn second_lane(&self) -> Box<dyn Progress + '_> {
        self.progress.second_lane()
    }
}

/// Preview of the scene that a running process writes to `scene`.
pub fn of_running(scene: &Path) -> Option<PathBuf> {
    Partial::preview_of_running(scene)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::progress::Silent;
    use crate::run::stages::{KnownGeometry, PlacedPhotos};
    use crate::scene::{PointCloud, RgbImage, seeded};

    #[test]
    fn preview_is_a_scene_until_its_workspace_ends() {
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path().join("a scene");
        let image = RgbImage { width: 64, height: 64, data: vec![[0.5; 3]; 64 * 64] };
        let photo = crate::photo::from_pixels("a.png".as_ref(), &image, None, 64).unwrap();
        let (splats, camera) = seeded::small(40, 64, 64, 0, 3);
        let points = PointCloud {
            positions: splats.means.clone(),
            colours: vec![[0.2, 0.4, 0.6]; splats.len()],
            ..PointCloud::default()
        };
        let geometry = Geometry { cameras: vec![camera], points, ..Geometry::default() };
        let known = KnownGeometry::Complete(geometry.clone());
        let placed = PlacedPhotos { photos: vec![photo], left_out: Vec::new(), known };
        for commits in [false, true] {
            let workspace = Workspace::create(&out, false, &[]).unwrap();
            assert_eq!(of_running(&out), None, "nothing before it is written");
            let preview = Preview::of(&workspace, &out);
            let options = RgbOptions::preset(crate::fit::Preset::Draft);
            let renewals = Renewals::new();
            std::thread::scope(|scope| {
                scope.spawn(|| preview.show(&placed, &geometry, &options, &renewals, &Silent));
                let shown = |count: usize| loop {
                    let found = of_running(&out);
                    match found.and_then(|found| scene_dir::load(&found).ok()) {
                        Some(scene) if scene.splats.len() == count => break scene,
                        _ => std::thread::sleep(Duration::from_millis(5)),
                    }
                };
                let scene = shown(splats.len());
                assert!(!out.exists() && scene.cameras.len() == 1 && scene.splats.opacity_logits[0] > 2.0);
                assert!(!renewals.is_due());
                renewals.put(seeded::small(3, 64, 64, 0, 3).0, &geometry.cameras);
                shown(3);
                renewals.end();
            });
            let found = of_running(&out).unwrap();
            if commits {
                workspace.commit().unwrap();
            } else {
                drop(workspace);
            }
            assert_eq!((of_running(&out), found.exists(), out.exists()), (None, false, commits));
        }
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "nothing else stays");
    }
}
