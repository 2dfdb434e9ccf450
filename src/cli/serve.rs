//! The HTTP server of `splatvk view`: one page with its data, and questions, for the browser of the
//! user who started it.
//!
//! It takes what any process of this machine may send: other pages of the same browser, other
//! users, requests that never end. All connections share one thread that waits for none of them, so
//! that no one holds up another.
use crate::error::words;
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
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::time::Duration;
use tokio::net::TcpStream;
use tokio::sync::oneshot;
use tokio::task::AbortHandle;
use tokio::time::{sleep, timeout};

/// Longest request body, bytes: a question is a few words.
const MAX_BODY: usize = 4096;
/// Longest head of a request, bytes; browsers send one or two thousand.
const MAX_HEAD: usize = 32 << 10;
/// How long a request may take to arrive, head and body each. On one machine it takes milliseconds.
const ARRIVAL: Duration = Duration::from_secs(5);
/// How long a connection may stay, with its answer and a browser that reads it slowly.
const CONNECTION: Duration = Duration::from_secs(300);
/// Connections at a time: fewer than the 1,024 files that systems let a process open.
const MAX_OPEN: usize = 256;
/// Questions that wait for their turn; a browser asks one at a time.
const MAX_WAITING: usize = 16;
/// How long to wait after the system refused a connection, for want of files or memory.
const REFUSED: Duration = Duration::from_millis(50);

/// What the page may do: run what it carries, ask its own server, and nothing else.
const CONTENT_SECURITY_POLICY: &str = "default-src 'none'; script-src 'unsafe-inline' data:; worker-src data:; style-src 'unsafe-inline'; \
                      img-src data: blob:; connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

/// A JSON text, or status and message of what is refused.
pub type Answer = Result<String, (u16, String)>;

/// A question and where its answer goes.
pub struct Question {
    /// What is asked: not empty.
    pub text: String,
    /// Closed once nobody waits any more.
    pub reply: oneshot::Sender<Answer>,
}

/// What is served.
pub struct Site {
    /// The page.
    pub page: String,
    /// Name under which the page asks for the scene.
    pub scene_path: &'static str,
    /// The scene.
    pub scene: Vec<u8>,
    /// Whether questions are answered.
    pub asks: bool,
}

/// A port that is taken, and an address that only this process and who reads its output know.
pub struct Place {
    listener: TcpListener,
    port: u16,
    /// First part of every path: other users of the machine can connect, but not guess it.
    secret: String,
}

impl Place {
    /// Takes a port of 127.0.0.1, which no other machine can reach; 0 = a free one.
    pub fn take(port: u16) -> Result<Place> {
        let refused = |e: std::io::Error| {
            let why = words(&e);
            Error::input(format!("--port {port}: {why}; give another, or leave it out to take a free one"))
        };
        let listener = TcpListener::bind(SocketAddrV4::new(Ipv4Addr::LOCALHOST, port)).map_err(refused)?;
        listener.set_nonblocking(true).map_err(refused)?;
        let port = listener.local_addr().map_err(refused)?.port();
        let mut random = [0u8; 16];
        getrandom::fill(&mut random).map_err(|e| Error::work(format!("no random numbers: {e}")))?;
        Ok(Place { listener, port, secret: random.iter().map(|b| format!("{b:02x}")).collect() })
    }

    /// Of the page.
    pub fn address(&self) -> String {
        format!("http://127.0.0.1:{}/{}/", self.port, self.secret)
    }
}

/// Serves in a thread of its own until the process ends; questions come out of what is returned,
/// one after the other.
pub fn serve(place: Place, site: Site) -> Result<Receiver<Question>> {
    let (questions, asked) = sync_channel(MAX_WAITING);
    let failed = |e: std::io::Error| Error::work(format!("the server cannot start: {}", words(&e)));
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().map_err(failed)?;
    let Place { listener, port, secret } = place;
    let shared = Arc::new(Shared {
        page: site.page.into(),
        scene_path: site.scene_path,
        scene: site.scene.into(),
        questions: site.asks.then_some(questions),
        hosts: hosts(port),
        secret,
    });
    let listener = {
        let _inside = runtime.enter();
        tokio::net::TcpListener::from_std(listener).map_err(failed)?
    };
    let all = move || runtime.block_on(accept(&listener, &shared));
    std::thread::Builder::new().name("server".into()).spawn(all).map_err(failed)?;
    Ok(asked)
}

/// One connection.
struct Open {
    task: AbortHandle,
    /// Whether it waits for the answer to a question.
    waits: Arc<AtomicBool>,
}

async fn accept(listener: &tokio::net::TcpListener, shared: &Arc<Shared>) {
    let mut open: VecDeque<Open> = VecDeque::new();
    loop {
        let Ok((stream, _)) = listener.accept().await else {
            sleep(REFUSED).await;
            continue;
        };
        open.retain(|c| !c.task.is_finished());
        // The oldest that has not come as far as a question goes: it is slow, or does not read.
        if open.len() >= MAX_OPEN
            && let Some(at) = open.iter().position(|c| !c.waits.load(Ordering::Relaxed))
            && let Some(oldest) = open.remove(at)
        {
            oldest.task.abort();
        }
        let waits = Arc::new(AtomicBool::new(false));
        let task = tokio::spawn(connection(stream, shared.clone(), waits.clone())).abort_handle();
        open.push_back(Open { task, waits });
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
    // What a browser that went away would have read is lost to nobody.
    let _ = timeout(CONNECTION, served).await;
}

struct Shared {
    page: Bytes,
    scene_path: &'static str,
    scene: Bytes,
    questions: Option<SyncSender<Question>>,
    /// As `Host` may name this server.
    hosts: Vec<String>,
    secret: String,
}

/// As `Host` names a server at a port: browsers leave out that of http, 80.
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
            Err((status, message)) => {
                (status, "application/json", Bytes::from(json!({ "error": message }).to_string()))
            }
        };
        // The server leaves the body of an answer to HEAD out, and says how long it would be.
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
        let nothing = || (StatusCode::NOT_FOUND, "there is nothing here".to_owned());
        let name = self.name(request.uri().path()).ok_or_else(nothing)?.to_owned();
        match (request.method(), name.as_str()) {
            (&Method::GET | &Method::HEAD, "") => Ok(("text/html; charset=utf-8", self.page.clone())),
            (&Method::GET | &Method::HEAD, name) if name == self.scene_path => {
                Ok(("application/octet-stream", self.scene.clone()))
            }
            (&Method::POST, "query") => {
                let text = question(request).await?;
                waits.store(true, Ordering::Relaxed);
                let answer = self.ask(text).await;
                waits.store(false, Ordering::Relaxed);
                Ok(("application/json", answer?.into()))
            }
            _ => Err(nothing()),
        }
    }

    /// What stands behind the secret. All of it is compared whatever differs, so that the time
    /// tells nothing.
    fn name<'p>(&self, path: &'p str) -> Option<&'p str> {
        let (first, name) = path.strip_prefix('/')?.split_once('/')?;
        let differs = first.bytes().zip(self.secret.bytes()).fold(0, |all, (a, b)| all | (a ^ b));
        (first.len() == self.secret.len() && differs == 0).then_some(name)
    }

    /// Other pages in the same browser can reach this address too. A host name of theirs that
    /// resolves to it shows in `Host`, and a request that their script makes in `Origin`.
    fn is_own(&self, request: &Request<Incoming>) -> bool {
        let ours = |host: &str| self.hosts.iter().any(|own| own == host);
        let host = only(request.headers(), &header::HOST).is_some_and(|h| h.is_some_and(ours));
        let origin = only(request.headers(), &header::ORIGIN)
            .is_none_or(|o| o.and_then(|o| o.strip_prefix("http://")).is_some_and(ours));
        let named = request.uri().authority().is_none_or(|a| ours(a.as_str()));
        host && origin && named
    }

    async fn ask(&self, text: String) -> Result<String, Refused> {
        let questions = self.questions.as_ref();
        let questions =
            questions.ok_or_else(|| (StatusCode::NOT_FOUND, "this scene answers no questions".to_owned()))?;
        let busy = |what: &str| (StatusCode::SERVICE_UNAVAILABLE, what.to_owned());
        let (reply, answer) = oneshot::channel();
        questions
            .try_send(Question { text, reply })
            .map_err(|_| busy("too many questions at once; ask again in a moment"))?;
        let answer = answer.await.map_err(|_| busy("the server is about to end"))?;
        answer.map_err(|(status, message)| {
            (StatusCode::from_u16(status).unwrap_or(StatusCode::INTERNAL_SERVER_ERROR), message)
        })
    }
}

/// The one value of a header: `None` where it is not there, `Some(None)` where it is there twice or
/// no text.
fn only<'h>(headers: &'h HeaderMap, name: &HeaderName) -> Option<Option<&'h str>> {
    let mut all = headers.get_all(name).iter();
    let first = all.next()?;
    Some(first.to_str().ok().filter(|_| all.next().is_none()))
}

async fn question(request: Request<Incoming>) -> Result<String, Refused> {
    let too_long =
        || (StatusCode::PAYLOAD_TOO_LARGE, format!("a question has at most {MAX_BODY} bytes; ask shorter"));
    let body = request.into_body();
    // Known before the first byte of it is read.
    if body.size_hint().lower() > MAX_BODY as u64 {
        return Err(too_long());
    }
    let malformed = || (StatusCode::BAD_REQUEST, "ask as {\"text\": \"a few words\"}".to_owned());
    let whole = timeout(ARRIVAL, Limited::new(body, MAX_BODY).collect())
        .await
        .map_err(|_| (StatusCode::REQUEST_TIMEOUT, "the question did not arrive".to_owned()))?
        .map_err(|e| if e.is::<LengthLimitError>() { too_long() } else { malformed() })?;
    let value: Value = serde_json::from_slice(&whole.to_bytes()).map_err(|_| malformed())?;
    let text = value["text"].as_str().unwrap_or_default().trim();
    if text.is_empty() { Err(malformed()) } else { Ok(text.to_owned()) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_port_of_http_may_be_left_out() {
        assert_eq!(hosts(8080), ["127.0.0.1:8080", "localhost:8080"]);
        assert_eq!(hosts(80), ["127.0.0.1:80", "localhost:80", "127.0.0.1", "localhost"]);
    }
}
