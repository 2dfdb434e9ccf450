//! `splatvk view`: the interactive view of a scene, served to the browser of this machine.
use super::args::ViewArgs;
use super::print::{print, print_json};
use super::progress;
use super::scene;
use crate::format::scene_dir::Scene;
use crate::gpu::Device;
use crate::photo;
use crate::query::QueryOptions;
use crate::report::viewer::{self, CodeNames, SCENE_PATH, Scene3d};
use crate::run::Compat;
use crate::run::ask::QueryScene;
use crate::run::encoder;
use crate::scene::RgbImage;
use crate::{Error, Result};
use serde_json::{Value, json};
use std::io::Read;
use std::net::{Ipv4Addr, SocketAddrV4};
use std::time::{Duration, Instant};
use tiny_http::{Header, Method, Request, Response, Server};

/// How soon Ctrl-C is noticed between requests.
const POLL_INTERVAL: Duration = Duration::from_millis(100);
/// Longest request body: a question is a few words.
const MAX_BYTES: u64 = 4096;
/// What the page may do: run what it carries, ask its own server, and nothing else.
const CONTENT_SECURITY_POLICY: &str = "default-src 'none'; script-src 'unsafe-inline' data:; worker-src data:; style-src 'unsafe-inline'; \
                      img-src data: blob:; connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

pub fn view(args: &ViewArgs) -> Result<()> {
    let scene = scene::load(&args.scene)?;
    if scene.splats.is_empty() {
        return Err(Error::input(format!("{}: no splats to show", args.scene.display())));
    }
    // Bound first: a port that is taken is said before the scene is prepared.
    let server = listen(args.port)?;
    let (mut ready, no_questions) = match questions(&scene, args) {
        Ok(ready) => (Some(ready), None),
        Err(error) => (None, Some(error.to_string())),
    };
    if let Some(reason) = no_questions.as_deref().filter(|_| scene.language.is_some()) {
        progress::reporter().warn(&format!("no questions: {reason}"));
    }
    let names = ready.as_mut().map_or(Ok(CodeNames::new()), QueryScene::names)?;
    let content = Content {
        options: Compat::answers(None, &args.scene)?,
        page: page(&scene, args, &names, no_questions.as_deref())?,
        splats: viewer::pack(&scene.splats, &scene.seen, scene.language.as_ref(), usize::MAX)?.bytes,
        port: port_of(&server)?,
    };
    let address = format!("http://127.0.0.1:{}/", content.port);
    if args.device.json {
        print_json(&json!({ "address": address, "scene": args.scene, "questions": ready.is_some() }))?;
    } else {
        print(&format!("{} is at {address}  (Ctrl-C ends)\n", args.scene.display()))?;
    }
    while !progress::stopped() {
        let request =
            server.recv_timeout(POLL_INTERVAL).map_err(Error::io("the connection to the browser"))?;
        if let Some(request) = request {
            // A browser that closed the page does not wait for the answer.
            let _ = content.serve(request, ready.as_mut());
        }
    }
    Ok(())
}

/// Only this machine can connect.
fn listen(port: u16) -> Result<Server> {
    let refused =
        |e| Error::input(format!("--port {port}: {e}; give another, or leave it out to take a free one"));
    Server::http(SocketAddrV4::new(Ipv4Addr::LOCALHOST, port)).map_err(refused)
}

fn port_of(server: &Server) -> Result<u16> {
    let address = server.server_addr().to_ip().map(|a| a.port());
    address.ok_or_else(|| Error::work("the server has no port"))
}

/// The scene ready for questions, looked at from its own cameras.
fn questions(scene: &Scene, args: &ViewArgs) -> Result<QueryScene> {
    let field = scene.language.clone().ok_or_else(|| Error::input("this scene has no language"))?;
    let encoder = encoder::of_scene(scene, args.device.registry()?)?;
    let device = Device::open(args.device.device.as_deref())?;
    let mut ready = QueryScene::open(&device, (&scene.splats, &scene.cameras), field, encoder)?;
    ready.set_views(&scene.cameras)?;
    Ok(ready)
}

fn page(scene: &Scene, args: &ViewArgs, names: &CodeNames, no_questions: Option<&str>) -> Result<String> {
    // Photos are decoration here: a scene whose pictures were deleted still shows.
    let load =
        |c: &crate::scene::Camera| photo::load_at(&scene.path.join("cameras").join(&c.name), usize::MAX).ok();
    let photos: Option<Vec<_>> = scene.cameras.iter().map(load).collect();
    let images: Vec<RgbImage> = photos.unwrap_or_default().into_iter().map(|p| p.image).collect();
    let path = args.scene.canonicalize().unwrap_or_else(|_| args.scene.clone());
    let title = path.file_stem().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
    let view = Scene3d {
        title: &title,
        splats: &scene.splats,
        seen: &scene.seen,
        cameras: &scene.cameras,
        world: &scene.world,
        photos: images.iter().collect(),
        language: scene.language.as_ref(),
        names,
        answers: Vec::new(),
    };
    view.served(no_questions)
}

/// What is sent.
struct Content {
    options: QueryOptions,
    page: String,
    splats: Vec<u8>,
    port: u16,
}

impl Content {
    fn serve(&self, mut request: Request, ready: Option<&mut QueryScene>) -> std::io::Result<()> {
        let (status, kind, body) = match self.answer(&mut request, ready) {
            Ok((kind, body)) => (200, kind, body),
            Err((status, message)) => {
                (status, "application/json", json!({ "error": message }).to_string().into_bytes())
            }
        };
        let mut response = Response::from_data(body).with_status_code(status);
        for (name, value) in [
            ("Content-Type", kind),
            ("Cache-Control", "no-store"),
            ("Content-Security-Policy", CONTENT_SECURITY_POLICY),
            ("X-Content-Type-Options", "nosniff"),
        ] {
            if let Ok(header) = Header::from_bytes(name, value) {
                response.add_header(header);
            }
        }
        request.respond(response)
    }

    fn answer(
        &self,
        request: &mut Request,
        ready: Option<&mut QueryScene>,
    ) -> Result<(&'static str, Vec<u8>), (u16, String)> {
        if !self.is_own(request) {
            return Err((403, "this server answers only the page that it sent".into()));
        }
        match (request.method(), request.url()) {
            (Method::Get, "/") => Ok(("text/html; charset=utf-8", self.page.clone().into_bytes())),
            (Method::Get, url) if url.strip_prefix('/') == Some(SCENE_PATH) => {
                Ok(("application/octet-stream", self.splats.clone()))
            }
            (Method::Post, "/query") => {
                let ready = ready.ok_or_else(|| (404, "this scene answers no questions".to_owned()))?;
                let text = question(request)
                    .ok_or_else(|| (400, "ask as {\"text\": \"a few words\"}".to_owned()))?;
                let answer = reply(ready, &text, &self.options)
                    .map_err(|e| (if e.exit_code() == 2 { 422 } else { 500 }, e.to_string()))?;
                Ok(("application/json", answer.to_string().into_bytes()))
            }
            _ => Err((404, "there is nothing here".into())),
        }
    }

    /// Other pages in the same browser can reach this address too. A host name of theirs that resolves to it shows in
    /// `Host`, and a request that their script makes in `Origin`.
    fn is_own(&self, request: &Request) -> bool {
        let header = |name: &'static str| {
            request.headers().iter().find(|h| h.field.equiv(name)).map(|h| h.value.as_str().to_owned())
        };
        let ours = ["127.0.0.1", "localhost"].map(|name| format!("{name}:{}", self.port));
        let host = header("Host").is_some_and(|h| ours.contains(&h));
        let origin = header("Origin").is_none_or(|o| ours.iter().any(|a| o == format!("http://{a}")));
        host && origin
    }
}

fn question(request: &mut Request) -> Option<String> {
    let mut body = String::new();
    request.as_reader().take(MAX_BYTES).read_to_string(&mut body).ok()?;
    let body: Value = serde_json::from_str(&body).ok()?;
    let text = body["text"].as_str()?.trim();
    (!text.is_empty()).then(|| text.to_owned())
}

fn reply(ready: &mut QueryScene, text: &str, options: &QueryOptions) -> Result<Value> {
    let clock = Instant::now();
    let answers = ready.ask(text, options)?;
    let mut reply = answers.shown().json();
    reply["milliseconds"] = (1e3 * clock.elapsed().as_secs_f64()).into();
    Ok(reply)
}
