//! One file over HTTP: resumed where it was cut off, tried again where that can help, held to its
//! size and checksum on the way.
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

/// Replaces scheme and host of every address of the catalogue.
pub const MIRROR: &str = "SPLATVK_MODELS_MIRROR";

/// How long to wait for what.
#[derive(Clone, Copy, Debug)]
pub struct Limits {
    /// For a connection.
    pub connect: Duration,
    /// For the next bytes.
    pub stall: Duration,
    /// Tries in a row that bring nothing new before it is given up.
    pub tries: u32,
    /// Before the second try; twice as long before each further one.
    pub pause: Duration,
}

impl Default for Limits {
    fn default() -> Self {
        // A line that is silent for half a minute is dead, as browsers and curl's own advice have
        // it; five tries with pauses of 1, 2, 4 and 8 s bridge a router that restarts its line, and
        // keep somebody without a network for a quarter of a minute only.
        let seconds = Duration::from_secs;
        Limits { connect: seconds(15), stall: seconds(30), tries: 5, pause: seconds(1) }
    }
}

/// Longest pause between two tries, also where the server asks for a longer one.
const LONGEST_PAUSE: Duration = Duration::from_secs(60);

/// Downloads files.
pub struct Client {
    agent: ureq::Agent,
    mirror: Option<String>,
    limits: Limits,
}

/// A file that is there, whole.
#[derive(Clone, Debug, Serialize)]
pub struct Fetched {
    /// Name as installed.
    pub name: String,
    /// The catalogue's address.
    pub from: String,
    /// Its size.
    pub bytes: u64,
    /// Its content, in hexadecimal digits.
    pub sha256: String,
    /// Bytes that this process downloaded of it.
    pub downloaded: u64,
}

/// What is known of a file whose download has begun; beside it on disk.
#[derive(Clone, Debug, Default, PartialEq, Deserialize, Serialize)]
struct Begun {
    from: String,
    /// Proves that the rest belongs to what is there: a strong ETag, else the time of the last
    /// change.
    validator: Option<String>,
    total: Option<u64>,
    /// Once it is whole.
    sha256: Option<String>,
}

/// Why a try ended.
enum Trouble {
    /// May pass: the line, or a server that is busy for as long as it says.
    Passing(String, Option<Duration>),
    Final(Error),
}

impl From<Error> for Trouble {
    fn from(e: Error) -> Self {
        Trouble::Final(e)
    }
}

impl Client {
    /// With [`MIRROR`] and, where `SSL_CERT_FILE` is set, its root certificates in the place of
    /// Mozilla's. Proxies are those of `ALL_PROXY`, `HTTPS_PROXY`, `HTTP_PROXY` and `NO_PROXY`.
    pub fn from_environment() -> Result<Client> {
        let set = |name: &str| std::env::var(name).ok().filter(|v| !v.is_empty());
        Client::new(
            set(MIRROR).as_deref(),
            set("SSL_CERT_FILE").map(PathBuf::from).as_deref(),
            Limits::default(),
        )
    }

    /// Every address with scheme and host of `mirror`, root certificates from a file.
    pub fn new(mirror: Option<&str>, certificates: Option<&Path>, limits: Limits) -> Result<Client> {
        let mirror = mirror.map(|m| m.trim_end_matches('/').to_owned());
        let plain = mirror.as_ref().is_some_and(|m| m.starts_with("http://"));
        if let Some(m) = mirror.iter().find(|m| !plain && !m.starts_with("https://")) {
            return Err(Error::input(format!("{MIRROR}={m}: must begin with http:// or https://")));
        }
        let mut tls = TlsConfig::builder();
        if let Some(file) = certificates {
            tls = tls.root_certs(roots(file)?);
        }
        let config = ureq::Agent::config_builder()
            .http_status_as_error(false)
            // A redirect must not lead from https to http; a plain mirror is somebody's own choice.
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

    /// Where a file is really asked for.
    pub fn address(&self, source: &Source) -> String {
        let path = |from: &str| {
            let after = from.split_once("://").map_or(from, |(_, rest)| rest);
            after.find('/').map_or(String::new(), |at| after[at..].to_owned())
        };
        self.mirror.as_ref().map_or(source.from.clone(), |m| format!("{m}{}", path(&source.from)))
    }

    /// Makes `to`, through a partial file in `work` that a later call goes on with. `ceiling`
    /// bounds a file of unknown size, bytes.
    pub fn download(
        &self,
        source: &Source,
        ceiling: u64,
        work: &Path,
        to: &Path,
        progress: &dyn Progress,
    ) -> Result<Fetched> {
        let mut one =
            Download { client: self, source, ceiling, work, to, meter: Meter::new(source, progress) };
        if let Some(there) = one.already()? {
            return Ok(there);
        }
        let (mut tries, mut pause) = (0, self.limits.pause);
        loop {
            let before = one.kept();
            let (why, wanted) = match one.attempt() {
                Ok(done) => return Ok(done),
                Err(Trouble::Final(e)) => return Err(e),
                Err(Trouble::Passing(why, wanted)) => (why, wanted),
            };
            if one.kept() > before {
                (tries, pause) = (0, self.limits.pause);
            }
            tries += 1;
            if tries >= self.limits.tries {
                let here = match one.kept() {
                    0 => "check the network".to_owned(),
                    bytes => format!(
                        "the same command goes on from the {:.1} MB that are here",
                        bytes as f64 / 1e6
                    ),
                };
                return Err(Error::work(format!(
                    "{}: {why}, {tries} times in a row; {here}",
                    self.address(source)
                )));
            }
            let wait = wanted.unwrap_or(pause).min(LONGEST_PAUSE);
            progress.inform(&format!("{}: {why}; again in {:.1} s", source.name, wait.as_secs_f64()));
            sleep(wait, progress)?;
            pause *= 2;
        }
    }
}

fn roots(file: &Path) -> Result<RootCerts> {
    let text = files::read(file)?;
    let found: Vec<_> = ureq::tls::parse_pem(&text)
        .filter_map(|item| match item {
            Ok(PemItem::Certificate(one)) => Some(one),
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
        // Short enough that Ctrl-C seems to act at once.
        std::thread::sleep(left.min(Duration::from_millis(100)));
    }
}

/// One file on its way.
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

    fn notes(&self) -> PathBuf {
        self.work.join(format!("{}.json", self.source.name))
    }

    /// Bytes of it that are on disk.
    fn kept(&self) -> u64 {
        std::fs::metadata(self.partial()).map_or(0, |m| m.len())
    }

    /// What is on disk belongs to this address.
    fn begun(&self) -> Option<Begun> {
        let begun: Begun = files::read_json(&self.notes(), "").ok()?;
        (begun.from == self.source.from).then_some(begun)
    }

    fn note(&self, begun: &Begun) -> Result<()> {
        let text =
            serde_json::to_vec(begun).map_err(|e| Error::work(format!("{}: {e}", self.source.name)))?;
        files::write(&self.notes(), &[&text]).map_err(Error::unwritable(self.notes()))
    }

    fn forget(&self) {
        // What cannot be removed is refused again by its content.
        let _ = std::fs::remove_file(self.partial());
        let _ = std::fs::remove_file(self.notes());
    }

    /// The file as an earlier, interrupted command finished it.
    fn already(&mut self) -> Result<Option<Fetched>> {
        if !self.to.is_file() {
            return Ok(None);
        }
        let (mut digest, mut file) = (Sha256::new(), File::open(self.to).map_err(Error::io(self.to))?);
        let bytes = hash(&mut file, u64::MAX, &mut digest).map_err(Error::io(self.to))?;
        let sha256 = hex(&digest.finalize());
        let wanted = self.begun().and_then(|b| b.sha256);
        let pinned = self.source.sha256.as_ref().is_none_or(|s| *s == sha256);
        if pinned && wanted.is_some_and(|w| w == sha256) {
            return Ok(Some(self.fetched(bytes, sha256, 0)));
        }
        std::fs::remove_file(self.to).map_err(Error::io(self.to))?;
        self.forget();
        Ok(None)
    }

    fn fetched(&self, bytes: u64, sha256: String, downloaded: u64) -> Fetched {
        let (name, from) = (self.source.name.clone(), self.source.from.clone());
        Fetched { name, from, bytes, sha256, downloaded }
    }

    fn attempt(&mut self) -> Result<Fetched, Trouble> {
        let address = self.client.address(self.source);
        let begun = self.begun();
        let mut have = if begun.is_some() { self.kept() } else { 0 };
        let mut begun = begun.unwrap_or_default();
        // Killed between the last byte and the renaming.
        if have > 0 && begun.total == Some(have) {
            return self.finish(begun, have, 0, None);
        }
        // Without a validator only the checksum can tell whether the pieces belong together.
        if begun.validator.is_none() && self.source.sha256.is_none() {
            have = 0;
        }
        let mut request = self.client.agent.get(&address);
        if have > 0 {
            request = request.header("Range", format!("bytes={have}-"));
            if let Some(validator) = &begun.validator {
                request = request.header("If-Range", validator);
            }
        }
        let response = request.call().map_err(|e| trouble(&address, &e))?;
        let status = response.status();
        // No file of a model is one; a network that wants a login first sends one in the place of
        // everything.
        if status.is_success()
            && header(&response, "content-type").is_some_and(|t| t.starts_with("text/html"))
        {
            return Err(Trouble::Final(Error::missing(format!(
                "{address}: a web page came in the place of the file; open the address in a browser to see what it wants"
            ))));
        }
        let (start, total) = match status {
            StatusCode::OK => (0, number(&response, "content-length")),
            StatusCode::PARTIAL_CONTENT => match range(&response) {
                Some((first, total)) if first == have && have > 0 => (have, total),
                _ => {
                    self.forget();
                    return Err(Trouble::Passing("another part than the one asked for came".into(), None));
                }
            },
            StatusCode::RANGE_NOT_SATISFIABLE if have > 0 => {
                self.forget();
                return Err(Trouble::Passing("the file there is another one than before".into(), None));
            }
            _ => return Err(self.refusal(&address, &response)),
        };
        let limit = self.limit(&address, total)?;
        begun =
            Begun { from: self.source.from.clone(), validator: validator(&response), total, sha256: None };
        self.note(&begun)?;
        self.receive(response, begun, start, limit)
    }

    /// The most bytes that the file may have.
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

    fn refusal<B>(&self, address: &str, response: &Response<B>) -> Trouble {
        let status = response.status();
        let text = format!("HTTP {} {}", status.as_u16(), status.canonical_reason().unwrap_or_default());
        if matches!(status.as_u16(), 408 | 425 | 429 | 500..=599) {
            return Trouble::Passing(text, number(response, "retry-after").map(Duration::from_secs));
        }
        let advice = match status.as_u16() {
            401 | 403 => "its owner asks for a login or its terms; download it in a browser",
            404 | 410 => "it is no longer there; see the model's own page",
            _ => "see the model's own page",
        };
        Trouble::Final(Error::missing(format!(
            "{address}: {text}: {advice}, and put the files into a folder of the model's name (splatvk models path)"
        )))
    }

    /// Appends the body to what is there.
    fn receive(
        &mut self,
        response: Response<ureq::Body>,
        begun: Begun,
        start: u64,
        limit: u64,
    ) -> Result<Fetched, Trouble> {
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
        self.meter.begin(received, begun.total.or(self.source.bytes));
        let mut body = response.into_body().into_reader();
        // As large as the pieces in which the system hands over what came.
        let mut block = vec![0u8; 1 << 17];
        loop {
            self.meter.progress.check()?;
            let count = body.read(&mut block).map_err(|e| Trouble::Passing(cut(&e), None))?;
            if count == 0 {
                break;
            }
            received += count as u64;
            if received > limit {
                self.forget();
                return Err(self.too_long(&self.client.address(self.source)).into());
            }
            file.write_all(&block[..count]).map_err(Error::io(&partial))?;
            digest.update(&block[..count]);
            self.meter.step(received);
        }
        if begun.total.or(self.source.bytes).is_some_and(|total| received < total) {
            return Err(Trouble::Passing(format!("the connection ended after {received} bytes"), None));
        }
        file.sync_all().map_err(Error::io(&partial))?;
        self.meter.end();
        self.finish(begun, received, received - start, Some(hex(&digest.finalize())))
    }

    /// Holds what came to its checksum and moves it to its place.
    fn finish(
        &mut self,
        mut begun: Begun,
        bytes: u64,
        downloaded: u64,
        sha256: Option<String>,
    ) -> Result<Fetched, Trouble> {
        let partial = self.partial();
        let sha256 = match sha256 {
            Some(known) => known,
            None => files::content_hash(&partial).map_err(Error::io(&partial))?,
        };
        if let Some(wanted) = self.source.sha256.as_ref().filter(|w| **w != sha256) {
            self.forget();
            if downloaded < bytes {
                // The fault may be in the part that was there before.
                return Err(Trouble::Passing(
                    "the pieces do not belong together, from the start".into(),
                    None,
                ));
            }
            return Err(Trouble::Final(Error::missing(format!(
                "{}: has sha256 {sha256}, the catalogue says {wanted}; the file there has changed or was altered on its way, and is \
                 not kept",
                self.client.address(self.source)
            ))));
        }
        begun.sha256 = Some(sha256.clone());
        self.note(&begun)?;
        std::fs::rename(&partial, self.to).map_err(Error::io(self.to))?;
        Ok(self.fetched(bytes, sha256, downloaded))
    }
}

/// Feeds the first `most` bytes to a checksum; how many there were.
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

/// First byte and length of the whole, of `Content-Range: bytes 5-9/10`.
fn range<B>(response: &Response<B>) -> Option<(u64, Option<u64>)> {
    let (part, total) = header(response, "content-range")?.strip_prefix("bytes ")?.split_once('/')?;
    Some((part.split_once('-')?.0.parse().ok()?, total.parse().ok()))
}

/// What `If-Range` may name: weak ETags say nothing about single bytes.
fn validator<B>(response: &Response<B>) -> Option<String> {
    let strong = header(response, "etag").filter(|e| !e.starts_with("W/"));
    strong.or_else(|| header(response, "last-modified")).map(str::to_owned)
}

fn cut(e: &std::io::Error) -> String {
    format!("the connection broke ({})", words(e))
}

fn one_line(e: &dyn std::fmt::Display) -> String {
    e.to_string().split_whitespace().collect::<Vec<_>>().join(" ")
}

/// What cannot be reached may be reachable in a moment; what was refused will be refused again.
fn trouble(address: &str, e: &ureq::Error) -> Trouble {
    use std::io::ErrorKind as K;
    let refused = |why: &str| Trouble::Final(Error::missing(format!("{address}: {}{why}", one_line(e))));
    match e {
        ureq::Error::TooManyRedirects => refused("; the address leads in a circle"),
        ureq::Error::RequireHttpsOnly(_) => refused("; an address of https must not lead to one of http"),
        ureq::Error::Tls(_) | ureq::Error::Rustls(_) | ureq::Error::Pem(_) => refused(CERTIFICATES),
        ureq::Error::Io(io) if io.kind() == K::InvalidData => refused(CERTIFICATES),
        ureq::Error::BadUri(_) | ureq::Error::InvalidProxyUrl | ureq::Error::Http(_) => refused(""),
        ureq::Error::Io(io) => Trouble::Passing(format!("no answer ({})", words(io)), None),
        _ => Trouble::Passing(format!("no answer ({})", one_line(e)), None),
    }
}

const CERTIFICATES: &str =
    "; where a proxy has certificates of its own, SSL_CERT_FILE names the file with them";
