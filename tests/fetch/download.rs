//! Download of one file: failures of networks and disks.
use super::server::{File, Request, Server, plain};
use super::sha256;
use splatvk::Error;
use splatvk::fetch::{Client, Fetched, Limits};
use splatvk::infer::catalogue::Source;
use splatvk::progress::Silent;
use std::io::Write;
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Limits short enough for tests.
const LIMITS: Limits = Limits {
    connect: Duration::from_secs(5),
    stall: Duration::from_millis(300),
    tries: 3,
    pause: Duration::from_millis(10),
};

/// URL of the test's file in the catalogue; the server replaces the host.
const FROM: &str = "https://models.example/some/file.bin";

fn content(length: usize) -> Vec<u8> {
    (0..length).map(|k| (k * k % 251) as u8).collect()
}

/// A folder, a server and the download of one file from it.
struct Trial {
    folder: tempfile::TempDir,
    server: Server,
    source: Source,
}

impl Trial {
    fn new(answer: impl Fn(&Request, usize, &mut TcpStream) + Send + Sync + 'static) -> Trial {
        let source = Source { from: FROM.into(), name: "file.bin".into(), bytes: None, sha256: None };
        Trial { folder: tempfile::tempdir().unwrap(), server: Server::start(answer), source }
    }

    fn pinned(mut self, content: &[u8]) -> Trial {
        (self.source.bytes, self.source.sha256) = (Some(content.len() as u64), Some(sha256(content)));
        self
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn get(&self) -> Result<Fetched, Error> {
        let client = Client::new(Some(&self.server.address), None, LIMITS).unwrap();
        let to = self.path("whole.bin");
        client.download(&self.source, 10_000_000, self.folder.path(), &to, &Silent)
    }

    /// Expects the whole file and no partial one.
    fn got(&self, content: &[u8]) -> Fetched {
        let done = self.get().unwrap();
        assert!(std::fs::read(self.path("whole.bin")).unwrap() == content, "another content");
        assert_eq!((done.bytes, &done.sha256), (content.len() as u64, &sha256(content)));
        assert!(!self.path("file.bin.partial").exists());
        done
    }

    /// Expects a failure; returns its one line.
    fn fails(&self, words: &[&str]) -> String {
        let text = self.get().unwrap_err().to_string();
        assert!(words.iter().all(|w| text.contains(w)) && !text.contains('\n'), "{words:?}: {text}");
        assert!(!self.path("whole.bin").exists());
        text
    }
}

#[test]
fn download_follows_redirects_without_loops() {
    let body = content(300_000);
    let file = File::new(&body);
    let trial = Trial::new(move |r, _, s| match r.path.as_str() {
        "/some/file.bin" => plain(s, "302 Found", &["Location: /elsewhere?key=1"]),
        "/elsewhere?key=1" => file.send(r, s),
        _ => plain(s, "404 Not Found", &[]),
    });
    assert_eq!(trial.got(&body).downloaded, 300_000);

    let circle = Trial::new(|_, _, s| plain(s, "302 Found", &["Location: /some/file.bin"]));
    circle.fails(&["circle", "/some/file.bin"]);
    assert!(circle.server.requests().len() < 15, "refused, not tried again");
}

#[test]
fn download_retries_busy_but_not_missing() {
    let gone = Trial::new(|_, _, s| plain(s, "404 Not Found", &[]));
    gone.fails(&["HTTP 404", "no longer there", "models path"]);
    assert_eq!(gone.server.requests().len(), 1);
    let closed = Trial::new(|_, _, s| plain(s, "403 Forbidden", &[]));
    closed.fails(&["HTTP 403", "login"]);

    let body = content(1000);
    let file = File::new(&body);
    let busy = Trial::new(move |r, count, s| match count {
        0 => plain(s, "503 Service Unavailable", &["Retry-After: 0"]),
        1 => plain(s, "429 Too Many Requests", &[]),
        _ => file.send(r, s),
    });
    busy.got(&body);
    let never = Trial::new(|_, _, s| plain(s, "503 Service Unavailable", &[]));
    never.fails(&["HTTP 503", "3 times"]);
    // No server at all.
    let mut nobody = Trial::new(|_, _, _| ());
    nobody.server.address = "http://127.0.0.1:9".into();
    nobody.fails(&["no answer", "3 times", "check the network"]);
}

#[test]
fn download_resumes_after_break() {
    let body = content(900_000);
    let file = File::new(&body);
    // Five pieces: more attempts than are permitted without progress.
    let trial = Trial::new(move |r, _, s| file.clone().cut(200_000).send(r, s));
    trial.got(&body);
    let asked: Vec<_> = trial.server.requests().iter().map(Request::first).collect();
    assert_eq!(asked, [None, Some(200_000), Some(400_000), Some(600_000), Some(800_000)]);

    // Another process continues, too, and proves that it is the same file.
    let file = File::new(&body);
    let trial = Trial::new(move |r, count, s| match count {
        0..3 => file.clone().cut(if count == 0 { 500_000 } else { 0 }).send(r, s),
        _ => file.send(r, s),
    });
    trial.fails(&["3 times", "0.5 MB that are here"]);
    assert_eq!(std::fs::metadata(trial.path("file.bin.partial")).unwrap().len(), 500_000);
    assert_eq!(trial.got(&body).downloaded, 400_000);
    let last = trial.server.requests().pop().unwrap();
    assert_eq!((last.first(), last.header("if-range")), (Some(500_000), Some("\"one\"")));
}

#[test]
fn download_never_mixes_files() {
    let (old, new) = (content(600_000), content(700_000).into_iter().rev().collect::<Vec<_>>());
    // The file changed in between, with a new ETag.
    let (first, second) = (File::new(&old), File { etag: "\"two\"", ..File::new(&new) });
    let changed = Trial::new(move |r, count, s| match count {
        0 => first.clone().cut(300_000).send(r, s),
        _ => second.send(r, s),
    });
    changed.got(&new);
    assert_eq!(changed.server.requests()[1].first(), Some(300_000), "it was asked to go on");

    // A weak ETag does not guarantee equal bytes: a partial file under one is not continued.
    let file = File { etag: "W/\"one\"", ..File::new(&old) };
    let weak = Trial::new(move |r, count, s| match count {
        0 => file.clone().cut(300_000).send(r, s),
        _ => file.send(r, s),
    });
    weak.got(&old);
    assert_eq!(weak.server.requests()[1].first(), None, "it was asked for all of it");

    // A server without ranges sends the whole file again.
    let file = File { ranges: false, ..File::new(&old) };
    let whole = Trial::new(move |r, count, s| match count {
        0 => file.clone().cut(300_000).send(r, s),
        _ => file.send(r, s),
    });
    whole.got(&old);

    // A server that responds with another range than the requested one.
    let file = File::new(&old);
    let odd = Trial::new(move |r, count, s| match (count, r.first()) {
        (0, _) => file.clone().cut(300_000).send(r, s),
        (_, Some(_)) => plain(s, "206 Partial Content", &["Content-Range: bytes 7-9/600000"]),
        _ => file.send(r, s),
    });
    odd.got(&old);

    // A server with a wrong ETag: the checksum of the catalogue detects it, and the download
    // restarts from the first byte.
    let file = File::new(&new);
    let lying = Trial::new(move |r, _, s| file.send(r, s)).pinned(&new);
    std::fs::write(lying.path("file.bin.partial"), [1; 1000]).unwrap();
    let notes = format!(r#"{{"from": "{FROM}", "validator": "\"one\"", "total": 700000}}"#);
    std::fs::write(lying.path("file.bin.json"), notes).unwrap();
    lying.got(&new);
    let asked: Vec<_> = lying.server.requests().iter().map(Request::first).collect();
    assert_eq!(asked, [Some(1000), None]);
}

#[test]
fn download_refuses_wrong_content() {
    let (body, other) = (content(100_000), content(100_001));
    let file = File::new(&other);
    let larger = Trial::new(move |r, _, s| file.send(r, s)).pinned(&body);
    larger.fails(&["has 100001 bytes", "says 100000"]);

    let mut altered = body.clone();
    altered[50_000] ^= 1;
    let file = File::new(&altered);
    let wrong = Trial::new(move |r, _, s| file.send(r, s)).pinned(&body);
    wrong.fails(&[&sha256(&altered), &sha256(&body), "altered"]);
    assert!(!wrong.path("file.bin.partial").exists());
    assert_eq!(wrong.server.requests().len(), 1);

    // A web page instead of the file.
    let page = Trial::new(|_, _, s| {
        let _ = s.write_all(b"HTTP/1.1 200 OK\r\nContent-Type: text/html\r\nContent-Length: 6\r\n\r\nlog in");
    });
    page.fails(&["a web page came"]);
    // Without a length: only the catalogue reveals that the file is incomplete.
    Trial::new(send_part).pinned(&body).fails(&["ended after 1000 bytes", "3 times"]);
    // Without a length or an end.
    Trial::new(send_endlessly).pinned(&body).fails(&["longer than it can be (0.1 MB)"]);
    let unknown = Trial::new(send_endlessly);
    unknown.fails(&["longer than it can be (10.0 MB)"]);
    assert!(!unknown.path("file.bin.partial").exists());
    let huge = File::new(&content(10_000_001));
    Trial::new(move |r, _, s| huge.send(r, s)).fails(&["longer than it can be"]);
}

/// Sends chunks until the client closes the connection.
fn send_endlessly(_: &Request, _: usize, s: &mut TcpStream) {
    let _ = s.write_all(b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n");
    while write!(s, "10000\r\n")
        .and_then(|()| s.write_all(&[7; 0x10000]))
        .and_then(|()| s.write_all(b"\r\n"))
        .is_ok()
    {}
}

/// Sends 1000 bytes of content and closes the connection.
fn send_part(_: &Request, _: usize, s: &mut TcpStream) {
    let _ =
        s.write_all(b"HTTP/1.1 200 OK\r\nConnection: close\r\n\r\n").and_then(|()| s.write_all(&[7; 1000]));
}

#[test]
fn download_retries_silent_server() {
    let body = content(600_000);
    let file = File::new(&body);
    let trial = Trial::new(move |r, count, s| match count {
        0 => std::thread::sleep(Duration::from_secs(3)),
        1 => {
            // A part of the body, then nothing.
            let slow = File { pause: Duration::from_secs(3), ..file.clone() };
            slow.send(r, s);
        }
        _ => file.send(r, s),
    });
    let began = std::time::Instant::now();
    trial.got(&body);
    assert!(began.elapsed() < Duration::from_secs(2), "waited for {:?}", began.elapsed());
    assert_eq!(trial.server.requests()[2].first(), Some(1 << 18));
    // Slow is not stalled.
    let file = File { pause: Duration::from_millis(150), ..File::new(&body) };
    let slow = Trial::new(move |r, _, s| file.send(r, s));
    slow.got(&body);
    assert_eq!(slow.server.requests().len(), 1);
}

#[test]
fn download_names_full_disk() {
    let body = content(500_000);
    let file = File::new(&body);
    let trial = Trial::new(move |r, _, s| file.send(r, s));
    if Path::new("/dev/full").exists() {
        std::os::unix::fs::symlink("/dev/full", trial.path("file.bin.partial")).unwrap();
        let error = trial.get().unwrap_err();
        let text = error.to_string();
        assert!(error.exit_code() == 4 && text.contains("file.bin.partial"), "{text}");
        assert!(text.contains("free some space"), "{text}");
        std::fs::remove_file(trial.path("file.bin.partial")).unwrap();
    }
    trial.got(&body);
    trial.server.requests();
    assert_eq!(trial.got(&body).downloaded, 0);
    // Killed between the last byte and the renaming.
    std::fs::rename(trial.path("whole.bin"), trial.path("file.bin.partial")).unwrap();
    assert_eq!(trial.got(&body).downloaded, 0);
    assert!(trial.server.requests().is_empty());
    // The file was changed meanwhile.
    std::fs::write(trial.path("whole.bin"), b"something else").unwrap();
    assert_eq!(trial.got(&body).downloaded, 500_000);
}
