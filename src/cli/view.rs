//! `splatvk view`: the interactive view of a scene, served to the browser of this machine.
mod backend;

use super::args::{DeviceArgs, EditUse, ViewArgs};
use super::print::{print, print_json};
use super::progress;
use super::scene;
use super::serve::{ServerAddress, Site, serve};
use crate::format::scene_dir::Scene;
use crate::report::viewer::{self, CodeNames, Lifetime, SCENE_PATH, Scene3d, Served};
use crate::run::Compat;
use crate::run::edit::Editor;
use crate::run::preview;
use crate::run::record;
use crate::{Error, Result, files};
use backend::Backend;
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
    /// `None` for a preview.
    backend: Option<Backend>,
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
        let Prepared { site, mut backend, mut preview } = prepared;
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
                    let none = || Err((404, "the scene is still being made".to_owned()));
                    let answer = backend.as_mut().map_or_else(none, |b| b.answer(&question.asks, &live));
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
                    let packed = preview::of_running(path).map(|preview| {
                        let scene = scene::load(&preview, content.edits)?;
                        viewer::pack((&scene).into(), None, content.budget)
                    });
                    if let Some(Ok(packed)) = packed {
                        live.renew(packed.bytes);
                        preview = Some(stamp);
                    }
                }
                // The run is over; without a new scene the preview stays.
                None if written(path).is_some_and(|time| Some(time) != before) => {
                    let last = Prepared::load(content)?;
                    live.replace(last.site);
                    (backend, preview) = (last.backend, last.preview);
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
        let is_fixed = running.is_some() || edits.ignore_edits || path.is_file();
        let mut editor = match running {
            Some(scene) => Editor::read_only(scene, "a preview cannot be edited", &device.machine()),
            None if is_fixed => {
                let reason = "this page was opened without the edits of the scene, and changes none";
                Editor::read_only(scene::load(path, edits)?, reason, &device.machine())
            }
            None => {
                let editor = Editor::open(path, &device.machine())?;
                scene::remark(path, editor.scene());
                editor
            }
        };
        if editor.scene().splats.is_empty() {
            return Err(Error::input(format!("{}: no splats to show", path.display())));
        }
        let has_language = editor.scene().language.is_some();
        let no_questions = match preview {
            Some(_) => Some("words come with the finished scene".to_owned()),
            None if !has_language => Some("this scene has no language".to_owned()),
            None => editor.prepare().err().map(|error| error.to_string()),
        };
        if let Some(reason) = no_questions.as_deref().filter(|_| has_language) {
            progress::reporter().warn(&format!("no questions: {reason}"));
        }
        let names = if no_questions.is_none() { editor.names()? } else { CodeNames::new() };
        let suggested = match &no_questions {
            Some(_) => Vec::new(),
            None if suggested.is_empty() => queries_of_run(path),
            None => suggested.to_vec(),
        };
        let scene = editor.scene();
        let packed = viewer::pack(scene.into(), scene.language.as_ref(), budget)?;
        let views = (preview.is_none() && path.is_dir()).then(|| path.to_owned());
        let served = Served {
            no_questions: no_questions.as_deref(),
            lifetime: if preview.is_some() { Lifetime::Preview } else { Lifetime::Final },
            shown: packed.order.len(),
            total: packed.total,
            saves_views: views.is_some(),
            edits: !is_fixed,
            has_mesh: mesh.is_some(),
        };
        let site = Site {
            page: page(scene, path, &names, suggested, &served)?,
            scene_path: SCENE_PATH,
            scene: packed.bytes,
            answers_questions: no_questions.is_none(),
            selects: !is_fixed,
            is_preview: preview.is_some(),
            views,
            mesh,
        };
        let backend = match preview {
            Some(_) => None,
            None => Some(Backend::new(editor, Compat::answers(None, path)?, budget, packed.order)),
        };
        Ok(Prepared { site, backend, preview })
    }
}

/// Queries of the run that made a scene.
fn queries_of_run(scene: &Path) -> Vec<String> {
    record::read(scene, "").map(|record| record.config.plan.inputs.queries).unwrap_or_default()
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
