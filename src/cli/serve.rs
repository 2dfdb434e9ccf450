//! HTTP server of `splatvk view`: one page with its data, questions and edits, for the browser of
//! the user who started it.
//!
//! It must withstand requests of any process of this machine: other pages of the same browser,
//! other users, requests that never end. All connections share one thread that blocks on none of
//! them, so that none delays another.
use crate::error::words;
use crate::format::views::Views;
use crate::sync::lock;
use crate::{Error, Result};
use http_body_util::{BodyExt, Full, LengthLimitError, Limited};
use hyper::body::{Body, Bytes, Incoming};
use hyper::header::{self, HeaderMap, HeaderName, HeaderValue};
use hyper::service::service_fn;
use hyper::{Method, Request, Response, StatusCode};
use hyper_util::rt::{TokioIo, TokioTimer};
use serde_json::{Value, json};
use std::collections::VecDeque;
use std::convert::Infallible;
use std::net::{Ipv4Addr, SocketAddrV4, TcpListener};
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex};
use std::time::Duration;
use tokio::net::TcpStream;
use tokio::sync::oneshot;
use tokio::task::AbortHandle;
use tokio::time::{sleep, timeout};

/// Maximum size of a request body, bytes: a question is a few words.
const MAX_BODY: usize = 4096;
/// Maximum size of views and notes, bytes: as many as a file may hold fit.
const MAX_VIEWS: usize = 512 << 10;
/// Maximum size of a selection or an edit, bytes: a hundred outlines of a hundred corners.
const MAX_EDIT: usize = 512 << 10;
/// Maximum size of a request head, bytes; browsers send one or two thousand.
const MAX_HEAD: usize = 32 << 10;
/// Time limit for a request to arrive, head and body each. On one machine it takes milliseconds.
const ARRIVAL: Duration = Duration::from_secs(5);
/// Time limit of a connection, with its answer and a browser that reads it slowly.
const CONNECTION: Duration = Duration::from_secs(300);
/// Maximum number of connections: fewer than the 1,024 files that systems let a process open.
const MAX_OPEN: usize = 256;
/// Maximum number of waiting questions; a browser sends one at a time.
const MAX_WAITING: usize = 16;
/// Pause after the system refused a connection for want of files or memory.
const REFUSED: Duration = Duration::from_millis(50);

/// Policy of the page: it runs its own scripts, connects to its own server, and nothing else.
const CONTENT_SECURITY_POLICY: &str = "default-src 'none'; script-src 'unsafe-inline' data:; worker-src data:; style-src 'unsafe-inline'; \
                      img-src data: blob:; connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

/// Type of most answers.
const JSON: &str = "application/json";

/// A JSON text, or status and message of a refusal.
pub type Answer = Result<String, (u16, String)>;

/// A request that needs the scene, with the receiver of its answer.
pub struct Question {
    /// The request.
    pub asks: Asks,
    /// Closed if the connection ended.
    pub reply: oneshot::Sender<Answer>,
}

/// Request that needs the scene.
pub enum Asks {
    /// A query of a text, not empty.
    Text(String),
    /// A selection or an edit, JSON.
    Edit(Bytes),
}

/// Content of the server, which may change.
pub struct Site {
    /// HTML page.
    pub page: String,
    /// Path under which the page requests the scene.
    pub scene_path: &'static str,
    /// Packed scene.
    pub scene: Vec<u8>,
    /// Whether questions are answered.
    pub answers_questions: bool,
    /// Whether selections are made.
    pub selects: bool,
    /// Whether another page will follow.
    pub is_preview: bool,
    /// Scene directory whose views and notes the page may save.
    pub views: Option<PathBuf>,
    /// GLB file of a mesh of the scene.
    pub mesh: Option<Vec<u8>>,
}

/// The site of a running server.
pub struct LiveSite(Arc<Shared>);

impl LiveSite {
    /// Another page, which an open one loads in its place.
    pub fn replace(&self, site: Site) {
        let mut content = lock(&self.0.content);
        let page = content.numbers.0 + 1;
        *content = Content::of(site);
        content.numbers = (page, 0);
    }

    /// Another scene for the same page.
    pub fn renew(&self, scene: Vec<u8>) {
        let mut content = lock(&self.0.content);
        content.scene = scene.into();
        content.numbers.1 += 1;
    }

    /// Number of the present scene of the page.
    pub fn scene(&self) -> u64 {
        lock(&self.0.content).numbers.1
    }

    /// A line for the open page.
    pub fn say(&self, notice: &str) {
        lock(&self.0.content).notice = notice.to_owned();
    }
}

/// A bound port with a secret path that only this process and readers of its output know.
pub struct ServerAddress {
    listener: TcpListener,
    port: u16,
    /// First component of every path: other users of the machine can connect, but not guess it.
    secret: String,
}

impl ServerAddress {
    /// Binds a port of 127.0.0.1, which no other machine can reach; 0 = a free one.
    pub fn bind(port: u16) -> Result<ServerAddress> {
        let refused = |e: std::io::Error| {
            let reason = words(&e);
            Error::input(format!("--port {port}: {reason}; give another, or leave it out to take a free one"))
        };
        let listener = TcpListener::bind(SocketAddrV4::new(Ipv4Addr::LOCALHOST, port)).map_err(refused)?;
        listener.set_nonblocking(true).map_err(refused)?;
        let port = listener.local_addr().map_err(refused)?.port();
        let mut random = [0u8; 16];
        getrandom::fill(&mut random).map_err(|e| Error::work(format!("no random numbers: {e}")))?;
        Ok(ServerAddress { listener, port, secret: random.iter().map(|b| format!("{b:02x}")).collect() })
    }

    /// URL of the page.
    pub fn url(&self) -> String {
        format!("http://127.0.0.1:{}/{}/", self.port, self.secret)
    }
}

/// Serves in a thread of its own until the process ends; returns the receiver of the questions.
pub fn serve(address: ServerAddress, site: Site) -> Result<(Receiver<Question>, LiveSite)> {
    let (sender, questions) = sync_channel(MAX_WAITING);
    let failed = |e: std::io::Error| Error::work(format!("the server cannot start: {}", words(&e)));
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().map_err(failed)?;
    let ServerAddress { listener, port, secret } = address;
    let shared = Arc::new(Shared {
        content: Mutex::new(Content::of(site)),
        questions: sender,
        hosts: hosts(port),
        secret,
    });
    let listener = {
        let _inside = runtime.enter();
        tokio::net::TcpListener::from_std(listener).map_err(failed)?
    };
    let live = LiveSite(shared.clone());
    let accept_all = move || runtime.block_on(accept(&listener, &shared));
    std::thread::Builder::new().name("server".into()).spawn(accept_all).map_err(failed)?;
    Ok((questions, live))
}

/// An open connection.
struct OpenConnection {
    task: AbortHandle,
    /// Whether it waits for the answer to a question.
    waits: Arc<AtomicBool>,
}

async fn accept(listener: &tokio::net::TcpListener, shared: &Arc<Shared>) {
    let mut open: VecDeque<OpenConnection> = VecDeque::new();
    loop {
        let Ok((stream, _)) = listener.accept().await else {
            sleep(REFUSED).await;
            continue;
        };
        open.retain(|c| !c.task.is_finished());
        // Drops the oldest connection without a pending question: it is slow, or does not read.
        if open.len() >= MAX_OPEN
            && let Some(index) = open.iter().position(|c| !c.waits.load(Ordering::Relaxed))
            && let Some(oldest) = open.remove(index)
        {
            oldest.task.abort();
        }
        let waits = Arc::new(AtomicBool::new(false));
        let task = tokio::spawn(connection(stream, shared.clone(), waits.clone())).abort_handle();
        open.push_back(OpenConnection { task, waits });
    }
}

async fn connection(stream: TcpStream, shared: Arc<Shared>, waits: Arc<AtomicBool>) {
    let service = service_fn(|request| {
        let (shared, waits) = (shared.clone(), waits.clone());
        async move { Ok::<_, Infallible>(shared.respond(request, &waits).await) }
    });
    let served = hyper::server::conn::http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(ARRIVAL)
        .max_buf_size(MAX_HEAD)
        // A connection per request costs nothing on one machine, and none is left open.
        .keep_alive(false)
        .serve_connection(TokioIo::new(stream), service);
    // Errors and timeouts concern only a browser that went away.
    let _ = timeout(CONNECTION, served).await;
}

struct Content {
    page: Bytes,
    scene_path: &'static str,
    scene: Bytes,
    answers_questions: bool,
    selects: bool,
    is_preview: bool,
    views: Option<PathBuf>,
    mesh: Option<Bytes>,
    /// Numbers of the page, and of the scene of that page.
    numbers: (u64, u64),
    notice: String,
}

impl Content {
    fn of(site: Site) -> Content {
        Content {
            page: site.page.into(),
            scene_path: site.scene_path,
            scene: site.scene.into(),
            answers_questions: site.answers_questions,
            selects: site.selects,
            is_preview: site.is_preview,
            views: site.views,
            mesh: site.mesh.map(Bytes::from),
            numbers: (0, 0),
            notice: String::new(),
        }
    }

    /// The answer to a request that asks for no work.
    fn get(&self, name: &str) -> Option<(&'static str, Bytes)> {
        match name {
            "" => Some(("text/html; charset=utf-8", self.page.clone())),
            "state" => {
                let (page, scene) = self.numbers;
                let state = json!({
                    "page": page, "preview": self.is_preview, "scene": scene, "notice": self.notice,
                });
                Some((JSON, state.to_string().into()))
            }
            "mesh.glb" => Some(("model/gltf-binary", self.mesh.clone()?)),
            name if name == self.scene_path => Some(("application/octet-stream", self.scene.clone())),
            _ => None,
        }
    }
}

struct Shared {
    content: Mutex<Content>,
    questions: SyncSender<Question>,
    /// Accepted values of `Host`.
    hosts: Vec<String>,
    secret: String,
}

/// Values of `Host` for a server at a port: browsers omit port 80.
fn hosts(port: u16) -> Vec<String> {
    let names = ["127.0.0.1", "localhost"];
    let bare = names.iter().filter(|_| port == 80).map(|name| (*name).to_owned());
    names.iter().map(|name| format!("{name}:{port}")).chain(bare).collect()
}

type Refused = (StatusCode, String);

impl Shared {
    async fn respond(&self, request: Request<Incoming>, waits: &AtomicBool) -> Response<Full<Bytes>> {
        let (status, kind, body) = match self.answer(request, waits).await {
            Ok((kind, body)) => (StatusCode::OK, kind, body),
            Err((status, message)) => (status, JSON, Bytes::from(json!({ "error": message }).to_string())),
        };
        // Hyper omits the body of an answer to HEAD, and keeps its length.
        let mut response = Response::new(Full::new(body));
        *response.status_mut() = status;
        for (name, value) in [
            (header::CONTENT_TYPE, kind),
            (header::CACHE_CONTROL, "no-store"),
            (header::CONTENT_SECURITY_POLICY, CONTENT_SECURITY_POLICY),
            (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
            (header::REFERRER_POLICY, "no-referrer"),
            (HeaderName::from_static("cross-origin-resource-policy"), "same-origin"),
        ] {
            response.headers_mut().insert(name, HeaderValue::from_static(value));
        }
        response
    }

    async fn answer(
        &self,
        request: Request<Incoming>,
        waits: &AtomicBool,
    ) -> Result<(&'static str, Bytes), Refused> {
        if !self.is_own(&request) {
            return Err((StatusCode::FORBIDDEN, "this server answers only the page that it sent".into()));
        }
        let not_found = || (StatusCode::NOT_FOUND, "there is nothing here".to_owned());
        let name = self.path_after_secret(request.uri().path()).ok_or_else(not_found)?.to_owned();
        match (request.method(), name.as_str()) {
            (&Method::GET, "views") => self.views().map(|views| (JSON, views.into())),
            (&Method::POST, "views") => {
                let text = body(request, MAX_VIEWS, "views and notes", "delete some").await?;
                self.save(&text).map(|views| (JSON, views.into()))
            }
            (&Method::GET | &Method::HEAD, name) => lock(&self.content).get(name).ok_or_else(not_found),
            (&Method::POST, "query") => {
                let asks = Asks::Text(question(request).await?);
                self.ask(asks, waits).await.map(|answer| (JSON, answer.into()))
            }
            (&Method::POST, "edit") => {
                let asks =
                    Asks::Edit(body(request, MAX_EDIT, "a selection", "select with fewer outlines").await?);
                self.ask(asks, waits).await.map(|answer| (JSON, answer.into()))
            }
            _ => Err(not_found()),
        }
    }

    /// Path after the secret, which is compared in constant time.
    fn path_after_secret<'p>(&self, path: &'p str) -> Option<&'p str> {
        let (first, name) = path.strip_prefix('/')?.split_once('/')?;
        let differs = first.bytes().zip(self.secret.bytes()).fold(0, |all, (a, b)| all | (a ^ b));
        (first.len() == self.secret.len() && differs == 0).then_some(name)
    }

    /// Whether a request comes from the page of this server. Other pages in the same browser can
    /// reach the address, too: `Host` names their domain if it resolves to this address, and
    /// `Origin` their site if a script sends the request.
    fn is_own(&self, request: &Request<Incoming>) -> bool {
        let is_known = |host: &str| self.hosts.iter().any(|known| known == host);
        let host = single_value(request.headers(), &header::HOST).is_some_and(|h| h.is_some_and(is_known));
        let origin = single_value(request.headers(), &header::ORIGIN)
            .is_none_or(|o| o.and_then(|o| o.strip_prefix("http://")).is_some_and(is_known));
        let authority = request.uri().authority().is_none_or(|a| is_known(a.as_str()));
        host && origin && authority
    }

    /// Scene directory of the views; refuses a page that has none.
    fn views_folder(&self) -> Result<PathBuf, Refused> {
        let folder = lock(&self.content).views.clone();
        folder
            .ok_or_else(|| (StatusCode::NOT_FOUND, "this scene has no place for views and notes".to_owned()))
    }

    /// Views and notes as they are in the scene now.
    fn views(&self) -> Result<String, Refused> {
        let failed = |e: Error| (StatusCode::INTERNAL_SERVER_ERROR, e.to_string());
        Ok(json!(Views::of_scene(&self.views_folder()?).map_err(failed)?).to_string())
    }

    /// Replaces the views and notes of the scene. A file is written in a moment, so that other
    /// requests can wait for it.
    fn save(&self, text: &[u8]) -> Result<String, Refused> {
        let folder = self.views_folder()?;
        let views = Views::parse(text).map_err(|e| (StatusCode::UNPROCESSABLE_ENTITY, e))?;
        views.write(&folder).map_err(|e| (StatusCode::INTERNAL_SERVER_ERROR, e.to_string()))?;
        Ok(json!(views).to_string())
    }

    async fn ask(&self, asks: Asks, waits: &AtomicBool) -> Result<String, Refused> {
        let (is_answered, refusal) = match (&asks, &*lock(&self.content)) {
            (Asks::Text(_), content) => (content.answers_questions, "this scene answers no questions"),
            (Asks::Edit(_), content) => (content.selects, "this page selects and edits nothing"),
        };
        if !is_answered {
            return Err((StatusCode::NOT_FOUND, refusal.to_owned()));
        }
        let busy = |message: &str| (StatusCode::SERVICE_UNAVAILABLE, message.to_owned());
        let (reply, answer) = oneshot::channel();
        self.questions
            .try_send(Question { asks, reply })
            .map_err(|_| busy("too many questions at once; ask again in a moment"))?;
        waits.store(true, Ordering::Relaxed);
        let answer = answer.await.map_err(|_| busy("the server is about to end"));
        waits.store(false, Ordering::Relaxed);
        answer?.map_err(|(status, message)| {
            (StatusCode::from_u16(status).unwrap_or(StatusCode::INTERNAL_SERVER_ERROR), message)
        })
    }
}

/// Single value of a header: `None` if absent, `Some(None)` if repeated or no text.
fn single_value<'h>(headers: &'h HeaderMap, name: &HeaderName) -> Option<Option<&'h str>> {
    let mut all = headers.get_all(name).iter();
    let first = all.next()?;
    Some(first.to_str().ok().filter(|_| all.next().is_none()))
}

async fn question(request: Request<Incoming>) -> Result<String, Refused> {
    let whole = body(request, MAX_BODY, "a question", "ask shorter").await?;
    let malformed = || (StatusCode::BAD_REQUEST, "ask as {\"text\": \"a few words\"}".to_owned());
    let value: Value = serde_json::from_slice(&whole).map_err(|_| malformed())?;
    let text = value["text"].as_str().unwrap_or_default().trim();
    if text.is_empty() { Err(malformed()) } else { Ok(text.to_owned()) }
}

/// Body of a request of at most `most` bytes; `name` and `advice` are for the refusals.
async fn body(request: Request<Incoming>, most: usize, name: &str, advice: &str) -> Result<Bytes, Refused> {
    let too_long = || {
        let limit = format!("the limit of {name} is {most} bytes; {advice}");
        (StatusCode::PAYLOAD_TOO_LARGE, limit)
    };
    let body = request.into_body();
    // Checked before the first byte is read.
    if body.size_hint().lower() > most as u64 {
        return Err(too_long());
    }
    let whole = timeout(ARRIVAL, Limited::new(body, most).collect())
        .await
        .map_err(|_| (StatusCode::REQUEST_TIMEOUT, format!("{name}: the request did not arrive")))?
        .map_err(|e| match e.is::<LengthLimitError>() {
            true => too_long(),
            false => (StatusCode::BAD_REQUEST, format!("{name}: the request is damaged")),
        })?;
    Ok(whole.to_bytes())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hosts_omit_port_80() {
        assert_eq!(hosts(8080), ["127.0.0.1:8080", "localhost:8080"]);
        assert_eq!(hosts(80), ["127.0.0.1:80", "localhost:80", "127.0.0.1", "localhost"]);
    }
}
