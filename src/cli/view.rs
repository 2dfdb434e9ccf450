//! `splatvk view`: the interactive view of a scene, served to the browser of this machine.
use super::args::ViewArgs;
use super::print::{print, print_json};
use super::progress;
use super::scene;
use super::serve::{Answer, ServerAddress, Site, serve};
use crate::format::scene_dir::Scene;
use crate::format::scene_photos;
use crate::gpu;
use crate::photo;
use crate::query::QueryOptions;
use crate::report::viewer::{self, CodeNames, SCENE_PATH, Scene3d};
use crate::run::Compat;
use crate::run::ask::QueryScene;
use crate::run::encoder;
use crate::run::preview;
use crate::scene::{Camera, RgbImage};
use crate::{Error, Result};
use serde_json::json;
use std::path::Path;
use std::sync::mpsc::RecvTimeoutError;
use std::time::{Duration, Instant};

/// Interval at which Ctrl-C is noticed between questions.
const POLL_INTERVAL: Duration = Duration::from_millis(100);

pub fn view(args: &ViewArgs) -> Result<()> {
    let (scene, is_preview) = load(&args.scene)?;
    if scene.splats.is_empty() {
        return Err(Error::input(format!("{}: no splats to show", args.scene.display())));
    }
    // The port is bound first: one that is in use is reported before the scene is prepared.
    let server = ServerAddress::bind(args.port)?;
    let (mut ready, no_questions) = match query_scene(&scene, args) {
        _ if is_preview => (None, Some("words come with the finished scene".to_owned())),
        Ok(ready) => (Some(ready), None),
        Err(error) => (None, Some(error.to_string())),
    };
    if let Some(reason) = no_questions.as_deref().filter(|_| scene.language.is_some()) {
        progress::reporter().warn(&format!("no questions: {reason}"));
    }
    let options = Compat::answers(None, &args.scene)?;
    let names = ready.as_mut().map_or(Ok(CodeNames::new()), QueryScene::names)?;
    let site = Site {
        page: page(&scene, args, &names, no_questions.as_deref(), is_preview)?,
        scene_path: SCENE_PATH,
        scene: viewer::pack(
            &scene.splats,
            &scene.seen,
            &scene.backdrop,
            scene.language.as_ref(),
            usize::MAX,
        )?
        .bytes,
        answers_questions: ready.is_some(),
    };
    let address = server.url();
    let questions = serve(server, site)?;
    // From here on stopping leaves nothing undone. Whoever reads the address may stop the server.
    progress::stop_without_error();
    if args.device.json {
        print_json(&json!({
            "address": address, "scene": args.scene, "questions": ready.is_some(), "preview": is_preview,
        }))?;
    } else {
        let what = if is_preview { "a preview of " } else { "" };
        print(&format!("{what}{} is at {address}  (Ctrl-C ends)\n", args.scene.display()))?;
    }
    let input = StandardInput::new();
    while !progress::stopped() && !input.has_closed() {
        match questions.recv_timeout(POLL_INTERVAL) {
            // The page was closed while its question waited.
            Ok(question) if question.reply.is_closed() => {}
            Ok(question) => {
                let answer = reply(ready.as_mut(), &question.text, &options);
                let _ = question.reply.send(answer);
            }
            Err(RecvTimeoutError::Timeout) => {}
            // Without questions the server has no sender.
            Err(RecvTimeoutError::Disconnected) => std::thread::sleep(POLL_INTERVAL),
        }
    }
    Ok(())
}

/// Loads the preview of a scene that a run is making, or the scene; and whether it is a preview.
fn load(path: &Path) -> Result<(Scene, bool)> {
    // The run may end at this moment and take its preview away.
    match preview::of_running(path).map(|preview| scene::load(&preview)) {
        Some(Ok(scene)) => Ok((scene, true)),
        _ => Ok((scene::load(path)?, false)),
    }
}

/// Prepares the scene for questions in its own views.
fn query_scene(scene: &Scene, args: &ViewArgs) -> Result<QueryScene> {
    let field = scene.language.clone().ok_or_else(|| Error::input("this scene has no language"))?;
    let encoder = encoder::of_scene(scene, args.device.registry()?)?;
    let device = gpu::open(args.device.device.as_deref())?;
    let mut ready = QueryScene::open(&device, (&scene.splats, &scene.cameras), field, encoder)?;
    ready.set_views(&scene.cameras)?;
    Ok(ready)
}

fn page(
    scene: &Scene,
    args: &ViewArgs,
    names: &CodeNames,
    no_questions: Option<&str>,
    is_preview: bool,
) -> Result<String> {
    // Photos are optional: a scene without its images, or with images elsewhere, is still shown.
    let load = |c: &Camera| photo::load_at(&scene_photos::picture(&scene.path, c)?, usize::MAX).ok();
    let photos: Option<Vec<_>> = scene.cameras.iter().map(load).collect();
    let images: Vec<RgbImage> = photos.unwrap_or_default().into_iter().map(|p| p.image).collect();
    let path = args.scene.canonicalize().unwrap_or_else(|_| args.scene.clone());
    let title = path.file_stem().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
    let view = Scene3d {
        title: &title,
        splats: &scene.splats,
        seen: &scene.seen,
        backdrop: &scene.backdrop,
        cameras: &scene.cameras,
        world: &scene.world,
        photos: images.iter().collect(),
        language: scene.language.as_ref(),
        names,
        answers: Vec::new(),
    };
    let notice = "A preview: the scene is still being made. Open it again when the run is done.";
    view.served(no_questions, is_preview.then_some(notice))
}

fn reply(ready: Option<&mut QueryScene>, text: &str, options: &QueryOptions) -> Answer {
    let ready = ready.ok_or_else(|| (404, "this scene answers no questions".to_owned()))?;
    let clock = Instant::now();
    let answers =
        ready.ask(text, options).map_err(|e| (if e.exit_code() == 2 { 422 } else { 500 }, e.to_string()))?;
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
