//! `splatvk view`: the interactive view of a scene, served to the browser of this machine.
use super::args::{DeviceArgs, EditUse, ViewArgs};
use super::print::{print, print_json};
use super::progress;
use super::scene;
use super::serve::{Answer, ServerAddress, Site, serve};
use crate::format::scene_dir::Scene;
use crate::gpu;
use crate::query::QueryOptions;
use crate::report::viewer::{self, CodeNames, Lifetime, Packed, SCENE_PATH, Scene3d, Served};
use crate::run::Compat;
use crate::run::ask::QueryScene;
use crate::run::encoder;
use crate::run::preview;
use crate::run::record;
use crate::{Error, Result, files};
use serde_json::json;
use std::path::Path;
use std::sync::mpsc::RecvTimeoutError;
use std::time::{Duration, Instant, SystemTime};

/// Interval at which Ctrl-C is noticed between questions.
const POLL_INTERVAL: Duration = Duration::from_millis(100);
/// Interval at which a preview is looked at.
const LOOK_INTERVAL: Duration = Duration::from_secs(1);

pub fn view(args: &ViewArgs) -> Result<()> {
    let ViewArgs { scene, port, budget, mesh, edits, device } = args;
    let (budget, mesh) = (*budget, mesh.as_deref());
    let content = Content { path: scene, edits: *edits, device, suggested: &[], budget, mesh };
    Shown::open(*port, content)?.serve(device.json)
}

/// Content of a page.
#[derive(Clone, Copy)]
pub struct Content<'a> {
    /// The scene.
    pub path: &'a Path,
    /// Use of its edits.
    pub edits: EditUse,
    /// Device and models for questions.
    pub device: &'a DeviceArgs,
    /// Queries that the page offers.
    pub suggested: &'a [String],
    /// Most splats of the page.
    pub budget: usize,
    /// Mesh of the scene.
    pub mesh: Option<&'a Path>,
}

/// A scene that is prepared to be served.
pub struct Shown<'a> {
    content: Content<'a>,
    server: ServerAddress,
    /// Time stamp of the scene that a run is to replace.
    before: Option<SystemTime>,
    prepared: Prepared,
}

/// A site, and the state behind it.
struct Prepared {
    site: Site,
    ready: Option<QueryScene>,
    /// Time stamp of a preview; `None` for a finished scene.
    preview: Option<SystemTime>,
}

impl<'a> Shown<'a> {
    /// Loads a scene, or the preview of one that a run is making.
    ///
    /// # Errors
    /// A port that is in use, and a scene that cannot be read or has no splats.
    pub fn open(port: u16, content: Content<'a>) -> Result<Self> {
        // The port is bound first: one that is in use is reported before the scene is prepared.
        let server = ServerAddress::bind(port)?;
        let before = written(content.path);
        let prepared = Prepared::load(content)?;
        Ok(Shown { content, server, before, prepared })
    }

    /// Address of the page.
    pub fn url(&self) -> String {
        self.server.url()
    }

    /// Serves until the user or the parent process ends it.
    pub fn serve(self, as_json: bool) -> Result<()> {
        let Shown { content, server, before, prepared } = self;
        let path = content.path;
        let Prepared { site, mut ready, mut preview } = prepared;
        let options = Compat::answers(None, path)?;
        let (address, answers) = (server.url(), site.answers_questions);
        let (questions, live) = serve(server, site)?;
        // From here on stopping leaves nothing undone. Whoever reads the address may stop the
        // server.
        progress::stop_without_error();
        if as_json {
            print_json(&json!({
                "address": address, "scene": path, "questions": answers, "preview": preview.is_some(),
            }))?;
        } else {
            let what = if preview.is_some() { "a preview of " } else { "" };
            print(&format!("{what}{} is at {address}  (Ctrl-C ends)\n", path.display()))?;
        }
        let input = StandardInput::new();
        let mut looked = Instant::now();
        while !progress::stopped() && !input.has_closed() {
            match questions.recv_timeout(POLL_INTERVAL) {
                // The page was closed while its question waited.
                Ok(question) if question.reply.is_closed() => {}
                Ok(question) => {
                    let answer = reply(ready.as_mut(), &question.text, &options);
                    let _ = question.reply.send(answer);
                }
                Err(RecvTimeoutError::Timeout | RecvTimeoutError::Disconnected) => {}
            }
            if preview.is_none() || looked.elapsed() < LOOK_INTERVAL {
                continue;
            }
            looked = Instant::now();
            match stamp(path) {
                Some(stamp) if Some(stamp) == preview => {}
                Some(stamp) => {
                    // A preview that is replaced at this moment comes with the next look.
                    let packed = preview::of_running(path)
                        .map(|p| scene::load(&p, content.edits).and_then(|s| pack(&s, content.budget)));
                    if let Some(Ok(packed)) = packed {
                        live.renew(packed.bytes);
                        preview = Some(stamp);
                    }
                }
                // The run is over; without a new scene the preview stays.
                None if written(path).is_some_and(|time| Some(time) != before) => {
                    let last = Prepared::load(content)?;
                    live.replace(last.site);
                    (ready, preview) = (last.ready, last.preview);
                }
                None => live.say("The run ended without a scene; this is its last preview."),
            }
        }
        Ok(())
    }
}

/// Time stamp of the preview of a scene that a run is making.
fn stamp(scene: &Path) -> Option<SystemTime> {
    written(&preview::of_running(scene)?)
}

/// Time stamp of a scene.
fn written(scene: &Path) -> Option<SystemTime> {
    scene.join("scene.json").metadata().ok()?.modified().ok()
}

impl Prepared {
    fn load(content: Content) -> Result<Prepared> {
        let Content { path, edits, device, suggested, budget, mesh } = content;
        let mesh = mesh.map(read_mesh).transpose()?;
        let preview = stamp(path);
        // The run may end at this moment and take its preview away.
        let running = preview.and_then(|_| scene::load(&preview::of_running(path)?, edits).ok());
        let preview = preview.filter(|_| running.is_some());
        let scene = running.map_or_else(|| scene::load(path, edits), Ok)?;
        if scene.splats.is_empty() {
            return Err(Error::input(format!("{}: no splats to show", path.display())));
        }
        let (mut ready, no_questions) = match query_scene(&scene, device) {
            _ if preview.is_some() => (None, Some("words come with the finished scene".to_owned())),
            Ok(ready) => (Some(ready), None),
            Err(error) => (None, Some(error.to_string())),
        };
        if let Some(reason) = no_questions.as_deref().filter(|_| scene.language.is_some()) {
            progress::reporter().warn(&format!("no questions: {reason}"));
        }
        let names = ready.as_mut().map_or(Ok(CodeNames::new()), QueryScene::names)?;
        let suggested = match &ready {
            None => Vec::new(),
            Some(_) if suggested.is_empty() => queries_of_run(path),
            Some(_) => suggested.to_vec(),
        };
        let packed = pack(&scene, budget)?;
        let views = (preview.is_none() && path.is_dir()).then(|| path.to_owned());
        let served = Served {
            no_questions: no_questions.as_deref(),
            lifetime: if preview.is_some() { Lifetime::Preview } else { Lifetime::Final },
            shown: packed.shown,
            total: packed.total,
            saves_views: views.is_some(),
            has_mesh: mesh.is_some(),
        };
        let site = Site {
            page: page(&scene, path, &names, suggested, &served)?,
            scene_path: SCENE_PATH,
            scene: packed.bytes,
            answers_questions: ready.is_some(),
            is_preview: preview.is_some(),
            views,
            mesh,
        };
        Ok(Prepared { site, ready, preview })
    }
}

/// Queries of the run that made a scene.
fn queries_of_run(scene: &Path) -> Vec<String> {
    record::read(scene, "").map(|record| record.config.plan.inputs.queries).unwrap_or_default()
}

fn pack(scene: &Scene, budget: usize) -> Result<Packed> {
    viewer::pack(&scene.splats, &scene.seen, &scene.backdrop, scene.language.as_ref(), budget)
}

/// Bytes of a GLB file, which the page reads.
fn read_mesh(path: &Path) -> Result<Vec<u8>> {
    let bytes = files::read(path)?;
    if bytes.starts_with(b"glTF") {
        return Ok(bytes);
    }
    Err(Error::input(format!(
        "--mesh {}: is no .glb file; make one: splatvk mesh SCENE FILE.glb",
        path.display()
    )))
}

/// Prepares the scene for questions in its own views.
fn query_scene(scene: &Scene, device: &DeviceArgs) -> Result<QueryScene> {
    let field = scene.language.clone().ok_or_else(|| Error::input("this scene has no language"))?;
    let encoder = encoder::of_scene(scene, device.registry()?)?;
    let device = gpu::open(device.device.as_deref())?;
    let mut ready = QueryScene::open(&device, (&scene.splats, &scene.cameras), field, encoder)?;
    ready.set_views(&scene.cameras)?;
    Ok(ready)
}

fn page(
    scene: &Scene,
    path: &Path,
    names: &CodeNames,
    suggested: Vec<String>,
    served: &Served,
) -> Result<String> {
    let (images, title) = (scene::photos(scene), scene::title(path));
    let view = Scene3d { suggested, ..Scene3d::of(scene, &title, &images, names) };
    view.served(served)
}

fn reply(ready: Option<&mut QueryScene>, text: &str, options: &QueryOptions) -> Answer {
    let ready = ready.ok_or_else(|| (404, "this scene answers no questions".to_owned()))?;
    let clock = Instant::now();
    let answers = ready
        .ask(text, options)
        .map_err(|e| (if (2..=3).contains(&e.exit_code()) { 422 } else { 500 }, e.to_string()))?;
    let mut reply = answers.shown().json();
    reply["milliseconds"] = (1e3 * clock.elapsed().as_secs_f64()).into();
    Ok(reply.to_string())
}

/// Detects that the parent of this process is gone, by a closed terminal or pipe. Nothing is read.
struct StandardInput {
    /// False if standard input was closed from the beginning, and so carries no information.
    watched: bool,
}

impl StandardInput {
    fn new() -> Self {
        StandardInput { watched: !hung_up() }
    }

    fn has_closed(&self) -> bool {
        self.watched && hung_up()
    }
}

#[cfg(all(target_os = "linux", target_env = "gnu"))]
fn hung_up() -> bool {
    let mut input = libc::pollfd { fd: libc::STDIN_FILENO, events: 0, revents: 0 };
    // SAFETY: `input` is one pollfd, which lives through the call; 0 ms makes it return at once.
    let ready = unsafe { libc::poll(&raw mut input, 1, 0) };
    ready == 1 && input.revents & libc::POLLHUP != 0
}

/// A terminal that closes also sends a signal.
#[cfg(not(all(target_os = "linux", target_env = "gnu")))]
fn hung_up() -> bool {
    false
}
