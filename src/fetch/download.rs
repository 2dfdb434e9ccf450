//! Download of one file over HTTP: resumes partial files, retries after transient errors, and
//! verifies size and checksum.
use std::fs::File;
use std::io::{Read, Seek, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use ureq::http::{Response, StatusCode};
use ureq::tls::{PemItem, RootCerts, TlsConfig};

use super::meter::Meter;
use crate::error::words;
use crate::files::{self, hex};
use crate::infer::catalogue::Source;
use crate::progress::Progress;
use crate::{Error, Result};

/// Environment variable that replaces scheme and host of every address of the catalogue.
pub const MIRROR: &str = "SPLATVK_MODELS_MIRROR";

/// Time limits and retries.
#[derive(Clone, Copy, Debug)]
pub struct Limits {
    /// Time limit of a connection.
    pub connect: Duration,
    /// Time limit for the next bytes.
    pub stall: Duration,
    /// Maximum number of successive tries without new bytes.
    pub tries: u32,
    /// Pause before the second try; it doubles before each further one.
    pub pause: Duration,
}

impl Default for Limits {
    fn default() -> Self {
        // A connection that is silent for half a minute is dead, by the practice of browsers and
        // curl's advice; five tries with pauses of 1, 2, 4 and 8 s bridge a restarting router, and
        // take only a quarter of a minute without a network.
        let seconds = Duration::from_secs;
        Limits { connect: seconds(15), stall: seconds(30), tries: 5, pause: seconds(1) }
    }
}

/// Maximum pause between two tries, even if the server asks for a longer one.
const LONGEST_PAUSE: Duration = Duration::from_secs(60);

/// Downloads files.
pub struct Client {
    agent: ureq::Agent,
    mirror: Option<String>,
    limits: Limits,
}

/// A complete file.
#[derive(Clone, Debug, Serialize)]
pub struct Fetched {
    /// Name as installed.
    pub name: String,
    /// Address in the catalogue.
    pub from: String,
    /// Size of the file.
    pub bytes: u64,
    /// Checksum of the content, hexadecimal.
    pub sha256: String,
    /// Bytes downloaded by this process.
    pub downloaded: u64,
}

/// State of a started download, stored beside it.
#[derive(Clone, Debug, Default, PartialEq, Deserialize, Serialize)]
struct DownloadState {
    from: String,
    /// Validator of the partial file: a strong ETag, else the time of the last change.
    validator: Option<String>,
    total: Option<u64>,
    /// Checksum of the complete file.
    sha256: Option<String>,
}

/// Failure of a try.
enum Failure {
    /// A transient failure: the connection, or a busy server, with the pause that it requested.
    Transient(String, Option<Duration>),
    Final(Error),
}

impl From<Error> for Failure {
    fn from(e: Error) -> Self {
        Failure::Final(e)
    }
}

impl Client {
    /// Creates a client with the mirror of [`MIRROR`] and the root certificates of `SSL_CERT_FILE`,
    /// instead of Mozilla's, if set. Proxies are those of `ALL_PROXY`, `HTTPS_PROXY`, `HTTP_PROXY`
    /// and `NO_PROXY`.
    pub fn from_environment() -> Result<Client> {
        Client::new(
            variable(MIRROR).as_deref(),
            variable("SSL_CERT_FILE").map(PathBuf::from).as_deref(),
            Limits::default(),
        )
    }

    /// Creates a client with scheme and host of `mirror` for every address, and root certificates
    /// from a file.
    pub fn new(mirror: Option<&str>, certificates: Option<&Path>, limits: Limits) -> Result<Client> {
        let mirror = mirror.map(|m| m.trim_end_matches('/').to_owned());
        let plain = mirror.as_ref().is_some_and(|m| m.starts_with("http://"));
        if let Some(m) = mirror.iter().find(|m| !plain && !m.starts_with("https://")) {
            return Err(Error::input(format!("{MIRROR}={m}: must begin with http:// or https://")));
        }
        let mut tls = TlsConfig::builder();
        if let Some(file) = certificates {
            tls = tls.root_certs(root_certificates(file)?);
        }
        let config = ureq::Agent::config_builder()
            .http_status_as_error(false)
            // A redirect must not lead from https to http; a plain mirror is the user's choice.
            .https_only(!plain)
            .accept_encoding("identity")
            .user_agent(concat!("splatvk/", env!("CARGO_PKG_VERSION")))
            .timeout_resolve(Some(limits.connect))
            .timeout_connect(Some(limits.connect))
            .timeout_recv_response(Some(limits.stall))
            .timeout_per_read(Some(limits.stall))
            .timeout_per_write(Some(limits.stall))
            .tls_config(tls.build())
            .build();
        Ok(Client { agent: config.new_agent(), mirror, limits })
    }

    /// Effective address of a file.
    pub fn address(&self, source: &Source) -> String {
        self.mirror.as_ref().map_or(source.from.clone(), |m| format!("{m}{}", path_of(&source.from)))
    }

    /// Downloads to `to`, through a partial file in `work` that a later call resumes. `ceiling`
    /// bounds a file of unknown size, bytes.
    pub fn download(
        &self,
        source: &Source,
        ceiling: u64,
        work: &Path,
        to: &Path,
        progress: &dyn Progress,
    ) -> Result<Fetched> {
        let mut download =
            Download { client: self, source, ceiling, work, to, meter: Meter::new(source, progress) };
        if let Some(complete) = download.completed_before()? {
            return Ok(complete);
        }
        let (mut tries, mut pause) = (0, self.limits.pause);
        loop {
            let before = download.partial_size();
            let (reason, requested_pause) = match download.attempt() {
                Ok(complete) => return Ok(complete),
                Err(Failure::Final(e)) => return Err(e),
                Err(Failure::Transient(reason, pause)) => (reason, pause),
            };
            if download.partial_size() > before {
                (tries, pause) = (0, self.limits.pause);
            }
            tries += 1;
            if tries >= self.limits.tries {
                let advice = match download.partial_size() {
                    0 => "check the network".to_owned(),
                    bytes => format!(
                        "the same command goes on from the {:.1} MB that are here",
                        bytes as f64 / 1e6
                    ),
                };
                return Err(Error::work(format!(
                    "{}: {reason}, {tries} times in a row; {advice}",
                    self.address(source)
                )));
            }
            let wait = requested_pause.unwrap_or(pause).min(LONGEST_PAUSE);
            progress.inform(&format!("{}: {reason}; again in {:.1} s", source.name, wait.as_secs_f64()));
            sleep(wait, progress)?;
            pause *= 2;
        }
    }
}

/// Value of an environment variable; `None` if it is empty.
fn variable(name: &str) -> Option<String> {
    std::env::var(name).ok().filter(|v| !v.is_empty())
}

/// Path of an address, with its leading slash.
fn path_of(address: &str) -> &str {
    let rest = address.split_once("://").map_or(address, |(_, rest)| rest);
    rest.find('/').map_or("", |start| &rest[start..])
}

fn root_certificates(file: &Path) -> Result<RootCerts> {
    let text = files::read(file)?;
    let found: Vec<_> = ureq::tls::parse_pem(&text)
        .filter_map(|item| match item {
            Ok(PemItem::Certificate(certificate)) => Some(certificate),
            _ => None,
        })
        .collect();
    match found.is_empty() {
        true => {
            Err(Error::input(format!("SSL_CERT_FILE={}: holds no certificate in PEM form", file.display())))
        }
        false => Ok(RootCerts::new_with_certs(&found)),
    }
}

fn sleep(time: Duration, progress: &dyn Progress) -> Result<()> {
    let until = Instant::now() + time;
    loop {
        progress.check()?;
        let left = until.saturating_duration_since(Instant::now());
        if left.is_zero() {
            return Ok(());
        }
        // Short, so that Ctrl-C acts at once.
        std::thread::sleep(left.min(Duration::from_millis(100)));
    }
}

/// A download in progress.
struct Download<'a> {
    client: &'a Client,
    source: &'a Source,
    ceiling: u64,
    work: &'a Path,
    to: &'a Path,
    meter: Meter<'a>,
}

impl Download<'_> {
    fn partial(&self) -> PathBuf {
        self.work.join(format!("{}.partial", self.source.name))
    }

    fn state_file(&self) -> PathBuf {
        self.work.join(format!("{}.json", self.source.name))
    }

    /// Size of the partial file, bytes.
    fn partial_size(&self) -> u64 {
        std::fs::metadata(self.partial()).map_or(0, |m| m.len())
    }

    /// State of the partial file, if it is from this address.
    fn state(&self) -> Option<DownloadState> {
        let state: DownloadState = files::read_json(&self.state_file(), "").ok()?;
        (state.from == self.source.from).then_some(state)
    }

    fn write_state(&self, state: &DownloadState) -> Result<()> {
        let text =
            serde_json::to_vec(state).map_err(|e| Error::work(format!("{}: {e}", self.source.name)))?;
        files::write(&self.state_file(), &[&text]).map_err(Error::unwritable(self.state_file()))
    }

    fn discard(&self) {
        // Files that cannot be removed are refused by their content later.
        let _ = std::fs::remove_file(self.partial());
        let _ = std::fs::remove_file(self.state_file());
    }

    /// Returns the file if an earlier, interrupted command completed it.
    fn completed_before(&mut self) -> Result<Option<Fetched>> {
        if !self.to.is_file() {
            return Ok(None);
        }
        let (mut digest, mut file) = (Sha256::new(), File::open(self.to).map_err(Error::io(self.to))?);
        let bytes = hash(&mut file, u64::MAX, &mut digest).map_err(Error::io(self.to))?;
        let sha256 = hex(&digest.finalize());
        let recorded = self.state().and_then(|b| b.sha256);
        let as_pinned = self.source.sha256.as_ref().is_none_or(|s| *s == sha256);
        if as_pinned && recorded.is_some_and(|r| r == sha256) {
            return Ok(Some(self.fetched(bytes, sha256, 0)));
        }
        std::fs::remove_file(self.to).map_err(Error::io(self.to))?;
        self.discard();
        Ok(None)
    }

    fn fetched(&self, bytes: u64, sha256: String, downloaded: u64) -> Fetched {
        let (name, from) = (self.source.name.clone(), self.source.from.clone());
        Fetched { name, from, bytes, sha256, downloaded }
    }

    fn attempt(&mut self) -> Result<Fetched, Failure> {
        let address = self.client.address(self.source);
        let state = self.state();
        let mut start = if state.is_some() { self.partial_size() } else { 0 };
        let mut state = state.unwrap_or_default();
        // An earlier process was killed between the last byte and the renaming.
        if start > 0 && state.total == Some(start) {
            return self.finish(state, start, 0, None);
        }
        // Without a validator or a checksum, parts cannot be verified.
        if state.validator.is_none() && self.source.sha256.is_none() {
            start = 0;
        }
        let mut request = self.client.agent.get(&address);
        if start > 0 {
            request = request.header("Range", format!("bytes={start}-"));
            if let Some(validator) = &state.validator {
                request = request.header("If-Range", validator);
            }
        }
        let response = request.call().map_err(|e| classify(&address, &e))?;
        let status = response.status();
        // No model file is HTML; captive portals answer every request with HTML.
        if status.is_success()
            && header(&response, "content-type").is_some_and(|t| t.starts_with("text/html"))
        {
            return Err(Failure::Final(Error::missing(format!(
                "{address}: a web page came in the place of the file; open the address in a browser to see what it wants"
            ))));
        }
        let (start, total) = match status {
            StatusCode::OK => (0, number(&response, "content-length")),
            StatusCode::PARTIAL_CONTENT => match range(&response) {
                Some((first, total)) if first == start && start > 0 => (start, total),
                _ => {
                    self.discard();
                    return Err(Failure::Transient("another part than the one asked for came".into(), None));
                }
            },
            StatusCode::RANGE_NOT_SATISFIABLE if start > 0 => {
                self.discard();
                return Err(Failure::Transient("the file there is another one than before".into(), None));
            }
            _ => return Err(self.refusal(&address, &response)),
        };
        let limit = self.limit(&address, total)?;
        state = DownloadState {
            from: self.source.from.clone(),
            validator: validator(&response),
            total,
            sha256: None,
        };
        self.write_state(&state)?;
        self.receive(response, state, start, limit)
    }

    /// Maximum size of the file, bytes.
    fn limit(&self, address: &str, total: Option<u64>) -> Result<u64> {
        match (self.source.bytes, total) {
            (Some(wanted), Some(total)) if wanted != total => Err(Error::missing(format!(
                "{address}: has {total} bytes, the catalogue says {wanted}; it is not the file that this version of splatvk knows"
            ))),
            (Some(wanted), _) => Ok(wanted),
            (None, Some(total)) if total > self.ceiling => Err(self.too_long(address)),
            (None, total) => Ok(total.unwrap_or(self.ceiling)),
        }
    }

    fn too_long(&self, address: &str) -> Error {
        Error::missing(format!(
            "{address}: is longer than it can be ({:.1} MB); it is not the file that this version of splatvk knows",
            self.source.bytes.unwrap_or(self.ceiling) as f64 / 1e6
        ))
    }

    fn refusal<B>(&self, address: &str, response: &Response<B>) -> Failure {
        let status = response.status();
        let text = format!("HTTP {} {}", status.as_u16(), status.canonical_reason().unwrap_or_default());
        if matches!(status.as_u16(), 408 | 425 | 429 | 500..=599) {
            return Failure::Transient(text, number(response, "retry-after").map(Duration::from_secs));
        }
        let advice = match status.as_u16() {
            401 | 403 => "its owner asks for a login or its terms; download it in a browser",
            404 | 410 => "it is no longer there; see the model's own page",
            _ => "see the model's own page",
        };
        Failure::Final(Error::missing(format!(
            "{address}: {text}: {advice}, and put the files into a folder of the model's name (splatvk models path)"
        )))
    }

    /// Appends the body to the partial file.
    fn receive(
        &mut self,
        response: Response<ureq::Body>,
        state: DownloadState,
        start: u64,
        limit: u64,
    ) -> Result<Fetched, Failure> {
        let partial = self.partial();
        let mut options = File::options();
        let mut file = options
            .read(true)
            .write(true)
            .create(true)
            .truncate(start == 0)
            .open(&partial)
            .map_err(Error::unwritable(&partial))?;
        let mut digest = Sha256::new();
        let mut received = hash(&mut file, start, &mut digest).map_err(Error::io(&partial))?;
        file.seek(std::io::SeekFrom::Start(received)).map_err(Error::io(&partial))?;
        self.meter.begin(received, state.total.or(self.source.bytes));
        let mut body = response.into_body().into_reader();
        // As large as the parts that the system delivers.
        let mut block = vec![0u8; 1 << 17];
        loop {
            self.meter.progress.check()?;
            let count = body.read(&mut block).map_err(|e| Failure::Transient(broken_connection(&e), None))?;
            if count == 0 {
                break;
            }
            received += count as u64;
            if received > limit {
                self.discard();
                return Err(self.too_long(&self.client.address(self.source)).into());
            }
            file.write_all(&block[..count]).map_err(Error::io(&partial))?;
            digest.update(&block[..count]);
            self.meter.step(received);
        }
        if state.total.or(self.source.bytes).is_some_and(|total| received < total) {
            return Err(Failure::Transient(format!("the connection ended after {received} bytes"), None));
        }
        file.sync_all().map_err(Error::io(&partial))?;
        self.meter.end();
        self.finish(state, received, received - start, Some(hex(&digest.finalize())))
    }

    /// Verifies the checksum and moves the file to its place.
    fn finish(
        &mut self,
        mut state: DownloadState,
        bytes: u64,
        downloaded: u64,
        sha256: Option<String>,
    ) -> Result<Fetched, Failure> {
        let partial = self.partial();
        let sha256 = match sha256 {
            Some(known) => known,
            None => files::content_hash(&partial).map_err(Error::io(&partial))?,
        };
        if let Some(wanted) = self.source.sha256.as_ref().filter(|w| **w != sha256) {
            self.discard();
            if downloaded < bytes {
                // The fault may be in the part of an earlier try.
                return Err(Failure::Transient(
                    "the pieces do not belong together, from the start".into(),
                    None,
                ));
            }
            return Err(Failure::Final(Error::missing(format!(
                "{}: has sha256 {sha256}, the catalogue says {wanted}; the file there has changed or was altered on its way, and is \
                 not kept",
                self.client.address(self.source)
            ))));
        }
        state.sha256 = Some(sha256.clone());
        self.write_state(&state)?;
        std::fs::rename(&partial, self.to).map_err(Error::io(self.to))?;
        Ok(self.fetched(bytes, sha256, downloaded))
    }
}

/// Feeds at most the first `most` bytes to a checksum; returns their number.
fn hash(file: &mut File, most: u64, digest: &mut Sha256) -> std::io::Result<u64> {
    let (mut part, mut block, mut bytes) = (file.take(most), vec![0u8; 1 << 18], 0);
    loop {
        match part.read(&mut block)? {
            0 => return Ok(bytes),
            n => {
                digest.update(&block[..n]);
                bytes += n as u64;
            }
        }
    }
}

fn header<'r, B>(response: &'r Response<B>, name: &str) -> Option<&'r str> {
    response.headers().get(name)?.to_str().ok()
}

fn number<B>(response: &Response<B>, name: &str) -> Option<u64> {
    header(response, name)?.trim().parse().ok()
}

/// First byte and total length in `Content-Range: bytes 5-9/10`.
fn range<B>(response: &Response<B>) -> Option<(u64, Option<u64>)> {
    let (part, total) = header(response, "content-range")?.strip_prefix("bytes ")?.split_once('/')?;
    Some((part.split_once('-')?.0.parse().ok()?, total.parse().ok()))
}

/// Value for `If-Range`; weak ETags do not guarantee equal bytes.
fn validator<B>(response: &Response<B>) -> Option<String> {
    let strong = header(response, "etag").filter(|e| !e.starts_with("W/"));
    strong.or_else(|| header(response, "last-modified")).map(str::to_owned)
}

fn broken_connection(e: &std::io::Error) -> String {
    format!("the connection broke ({})", words(e))
}

fn one_line(e: &dyn std::fmt::Display) -> String {
    e.to_string().split_whitespace().collect::<Vec<_>>().join(" ")
}

/// Classifies an error: connection failures are transient, refusals are final.
fn classify(address: &str, e: &ureq::Error) -> Failure {
    use std::io::ErrorKind as K;
    let refused =
        |advice: &str| Failure::Final(Error::missing(format!("{address}: {}{advice}", one_line(e))));
    match e {
        ureq::Error::TooManyRedirects => refused("; the address leads in a circle"),
        ureq::Error::RequireHttpsOnly(_) => refused("; an address of https must not lead to one of http"),
        ureq::Error::Tls(_) | ureq::Error::Rustls(_) | ureq::Error::Pem(_) => refused(CERTIFICATES),
        ureq::Error::Io(io) if io.kind() == K::InvalidData => refused(CERTIFICATES),
        ureq::Error::BadUri(_) | ureq::Error::InvalidProxyUrl | ureq::Error::Http(_) => refused(""),
        ureq::Error::Io(io) => Failure::Transient(format!("no answer ({})", words(io)), None),
        _ => Failure::Transient(format!("no answer ({})", one_line(e)), None),
    }
}

const CERTIFICATES: &str =
    "; where a proxy has certificates of its own, SSL_CERT_FILE names the file with them";
