//! The server of `splatvk view` with other clients on the machine: other pages, other users,
//! requests that never end.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // a panic is how a test fails
mod fixture;

use fixture::view::{Server, breakfast};
use serde_json::{Value, json};
use std::io::{BufRead, BufReader};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::OnceLock;
use std::time::{Duration, Instant};

/// One scene for all tests, in the target folder: statics are never dropped.
fn scene() -> &'static PathBuf {
    static SCENE: OnceLock<PathBuf> = OnceLock::new();
    SCENE.get_or_init(|| {
        let folder = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join("view");
        let _ = std::fs::remove_dir_all(&folder);
        std::fs::create_dir_all(&folder).unwrap();
        breakfast(&folder)
    })
}

/// Expects a prompt answer to an ordinary request.
fn assert_answers(server: &Server) {
    let clock = Instant::now();
    let (status, body) = server.request("POST", "query", "", &json!({ "text": "lemon" }).to_string());
    assert_eq!(status, 200, "{body}");
    let took = clock.elapsed();
    assert!(took < Duration::from_secs(3), "{took:?}");
}

#[test]
fn server_answers_only_own_page() {
    let server = Server::start(scene());
    let port = server.host.split_once(':').unwrap().1;
    for name in ["", "scene.bin", "query", "none"] {
        for header in [
            "Host: evil.example\r\n".to_owned(),
            format!("Host: evil.example:{port}\r\n"),
            "Host: 127.0.0.1:1\r\n".to_owned(),
            "Origin: http://evil.example\r\n".to_owned(),
            "Origin: null\r\n".to_owned(),
            format!("Origin: https://{}\r\n", server.host),
        ] {
            for method in ["GET", "POST"] {
                let (status, body) = server.request(method, name, &header, "");
                assert_eq!(status, 403, "{method} {name} {header}: {body}");
            }
        }
        let path = format!("{}{name}", server.base);
        for head in [
            format!("GET {path} HTTP/1.0\r\n\r\n"),
            format!("GET {path} HTTP/1.1\r\nHost: {0}\r\nHost: evil.example\r\n\r\n", server.host),
            format!("GET http://evil.example{path} HTTP/1.1\r\nHost: {}\r\n\r\n", server.host),
        ] {
            let reply = server.raw(head.as_bytes());
            assert!(reply.contains(" 403 ") || reply.contains(" 400 "), "{head}: {reply}");
        }
    }
    assert_eq!(server.request("GET", "", &format!("Host: localhost:{port}\r\n"), "").0, 200);
    assert_eq!(server.request("GET", "../Cargo.toml", "", "").0, 404);
    assert_eq!(server.request("DELETE", "", "", "").0, 404);
    // HEAD replies with the headers of GET, without the body.
    for name in ["", "scene.bin", "none"] {
        let (status, body) = server.request("GET", name, "", "");
        let reply = server
            .raw(format!("HEAD {}{name} HTTP/1.1\r\nHost: {}\r\n\r\n", server.base, server.host).as_bytes());
        let (head, nothing) = reply.split_once("\r\n\r\n").unwrap();
        assert!(head.starts_with(&format!("HTTP/1.1 {status} ")) && nothing.is_empty(), "{reply}");
        let length = head.to_lowercase();
        // The body of the scene is no text, and its length here is not that of its bytes.
        assert!(name == "scene.bin" || length.contains(&format!("content-length: {}", body.len())), "{head}");
    }
    assert_eq!(server.request("POST", "query", "", "lemon").0, 400);
    let (status, body) = server.request("POST", "query", "", "{\"text\": \"unicorn\"}");
    assert!(status == 422 && body.contains("no text embedding for 'unicorn'"), "{status} {body}");
    let (status, body) = server.request("POST", "query", "", "{\"text\": \"lemon\"}");
    assert_eq!(status, 200);
    let answer: Value = serde_json::from_str(body.trim()).unwrap();
    assert_eq!((&answer["level"], &answer["codes"], &answer["found"]), (&json!(2), &json!([6]), &json!(2)));
}

/// Other users of the machine can connect, but they lack the address.
#[test]
fn server_needs_secret_path() {
    let (server, other) = (Server::start(scene()), Server::start(scene()));
    let secret = server.base.trim_matches('/');
    assert!(secret.len() == 32 && secret.bytes().all(|b| b.is_ascii_hexdigit()), "{secret}");
    assert_ne!(server.base, other.base);
    let ask = json!({ "text": "lemon" }).to_string();
    for folder in ["/".to_owned(), "//".to_owned(), format!("/{}/", "0".repeat(32)), other.base.clone()] {
        for name in ["", "scene.bin", "query"] {
            assert_eq!(server.at("GET", &format!("{folder}{name}"), "", "").0, 404, "{folder}{name}");
            assert_eq!(server.at("POST", &format!("{folder}{name}"), "", &ask).0, 404, "{folder}{name}");
        }
    }
    for path in [format!("/{secret}"), format!("/{secret}0/"), format!("/{}/", &secret[..31])] {
        assert_eq!(server.at("GET", &path, "", "").0, 404, "{path}");
    }
    let (status, page) = server.request("GET", "", "", "");
    assert!(status == 200 && page.contains("v-manifest") && !page.contains(secret));
    assert_eq!(server.request("GET", "scene.bin", "", "").0, 200);
}

/// An answer to a page must not be interpreted as a page.
#[test]
fn server_answers_are_data() {
    let server = Server::start(scene());
    let body = json!({ "text": "<script>alert(1)</script>" }).to_string();
    let head = format!("POST {}query HTTP/1.1\r\nHost: {}\r\n", server.base, server.host);
    let reply =
        server.raw(format!("{head}Content-Length: {}\r\n\r\n{body}", body.len()).as_bytes()).to_lowercase();
    assert!(reply.contains("content-type: application/json\r\n"), "{reply}");
    assert!(reply.contains("x-content-type-options: nosniff\r\n"), "{reply}");
    assert!(reply.contains("content-security-policy: default-src 'none'"), "{reply}");
    let error: Value = serde_json::from_str(reply.split_once("\r\n\r\n").unwrap().1).unwrap();
    assert!(error["error"].as_str().unwrap().contains("<script>alert(1)</script>"));
}

#[test]
fn server_refuses_huge_and_endless_bodies() {
    let server = Server::start(scene());
    let head = format!("POST {}query HTTP/1.1\r\nHost: {}\r\n", server.base, server.host);
    let too_long = |rest: String| {
        let reply = server.raw(format!("{head}{rest}").as_bytes());
        assert!(reply.starts_with("HTTP/1.1 413 "), "{reply}");
    };
    too_long("Content-Length: 99999999999999\r\n\r\n".into());
    too_long(format!("Content-Length: 5000\r\n\r\n{}", "x".repeat(5000)));
    too_long(format!("Transfer-Encoding: chunked\r\n\r\n1388\r\n{}\r\n0\r\n\r\n", "x".repeat(5000)));
    // Not even for a path without a body.
    let reply = server.raw(
        format!("POST / HTTP/1.1\r\nHost: {}\r\nContent-Length: 99999999999999\r\n\r\n", server.host)
            .as_bytes(),
    );
    assert!(reply.starts_with("HTTP/1.1 404 "), "{reply}");
    let begun = Instant::now();
    let unfinished: Vec<TcpStream> = [
        format!("{head}Content-Length: 2000\r\n\r\n{{"),
        format!("{head}Transfer-Encoding: chunked\r\n\r\n1\r\n{{"),
        head.clone(),
        "PO".to_owned(),
        String::new(),
    ]
    .iter()
    .map(|bytes| server.open(bytes.as_bytes()))
    .collect();
    assert_answers(&server);
    for mut stream in unfinished {
        // Ended by the server, with or without a reply.
        let _ = std::io::Read::read_to_end(&mut stream, &mut Vec::new());
    }
    let took = begun.elapsed();
    assert!(took > Duration::from_secs(3) && took < Duration::from_secs(15), "{took:?}");
    assert_answers(&server);
}

#[test]
fn server_survives_malformed_requests() {
    let server = Server::start(scene());
    let big = format!("GET / HTTP/1.1\r\nHost: {}\r\nX: {}\r\n\r\n", server.host, "x".repeat(100_000));
    let many: String = (0..5000).map(|k| format!("X-{k}: 1\r\n")).collect();
    for bytes in [
        b"\0\xff\xfe\r\n\r\n".to_vec(),
        b"GET\r\n\r\n".to_vec(),
        b"GET / HTTP/9.9\r\n\r\n".to_vec(),
        b"GET / HTTP/1.1\r\nContent-Length: -1\r\n\r\n".to_vec(),
        b"POST / HTTP/1.1\r\nContent-Length: 1\r\nContent-Length: 2\r\n\r\nab".to_vec(),
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03".to_vec(),
        big.into_bytes(),
        format!("GET / HTTP/1.1\r\n{many}\r\n").into_bytes(),
    ] {
        let reply = server.raw(&bytes);
        assert!(reply.is_empty() || reply.starts_with("HTTP/1.1 4"), "{reply}");
    }
    assert_answers(&server);
}

/// More connections than the server keeps open: it must close idle ones, and continue.
#[test]
fn server_survives_thousand_connections() {
    let server = Server::start(scene());
    let half = format!("POST {}query HTTP/1.1\r\nHost: {}\r\n", server.base, server.host);
    let body = format!("{half}Content-Length: 2000\r\n\r\n{{");
    let kinds = [String::new(), half, body];
    let open: Vec<TcpStream> = (0..1000).map(|k| server.open(kinds[k % 3].as_bytes())).collect();
    assert_answers(&server);
    drop(open);
    // Then a thousand complete requests, eight at a time.
    std::thread::scope(|scope| {
        for _ in 0..8 {
            scope.spawn(|| {
                for _ in 0..125 {
                    assert_eq!(server.request("GET", "none", "", "").0, 404);
                }
            });
        }
    });
    let _open: Vec<TcpStream> = (0..100).map(|k| server.open(kinds[k % 3].as_bytes())).collect();
    let (status, took) = server.stop("-TERM");
    assert_eq!(status.code(), Some(0));
    assert!(took < Duration::from_secs(2), "{took:?}");
}

/// Names in a scene lead only to pictures of the scene.
#[test]
fn server_shows_only_scene_pictures() {
    let folder = tempfile::tempdir().unwrap();
    let scene = breakfast(folder.path());
    let shows = || Server::start(&scene).request("GET", "", "", "").1.contains("data:image/jpeg");
    assert!(shows());
    let file = scene.join("cameras/transforms.json");
    let text = std::fs::read_to_string(&file).unwrap();
    let secret = folder.path().join("secret.png");
    std::fs::copy(scene.join("cameras/images/train_00.png"), &secret).unwrap();
    for name in [secret.to_str().unwrap(), "../../secret.png"] {
        std::fs::write(&file, text.replace("images/train_00.png", name)).unwrap();
        assert!(!shows(), "{name}");
    }
    #[cfg(unix)]
    {
        std::os::unix::fs::symlink(&secret, scene.join("cameras/images/link.png")).unwrap();
        std::fs::write(&file, text.replace("images/train_00.png", "images/link.png")).unwrap();
        assert!(!shows(), "through a link");
    }
}

#[test]
fn server_stops_twice_without_failure() {
    let server = Server::start(scene());
    let id = server.child.id().to_string();
    let mut server = server;
    assert!(Command::new("kill").args(["-INT", &id]).status().unwrap().success());
    // It may have ended by then.
    let _ = Command::new("kill").args(["-INT", &id]).stderr(Stdio::null()).status();
    assert_eq!(server.child.wait().unwrap().code(), Some(0));
}

#[test]
fn server_ends_with_parent() {
    for signal in ["-HUP", "-INT", "-TERM"] {
        let server = Server::start(scene());
        let _open = server.open(b"POST / HT");
        let (status, took) = server.stop(signal);
        assert_eq!(status.code(), Some(0), "{signal}");
        assert!(took < Duration::from_secs(2), "{signal}: {took:?}");
    }
    if !cfg!(target_os = "linux") {
        return;
    }
    let mut server = Server::start_with(scene(), Stdio::piped());
    assert_answers(&server);
    assert!(server.child.try_wait().unwrap().is_none());
    drop(server.child.stdin.take());
    let closed = Instant::now();
    assert_eq!(server.child.wait().unwrap().code(), Some(0));
    assert!(closed.elapsed() < Duration::from_secs(2));
    // A pipe without a reader: closed from the beginning.
    let (reader, writer) = std::io::pipe().unwrap();
    drop(writer);
    let mut server = Server::start_with(scene(), reader.into());
    std::thread::sleep(Duration::from_millis(500));
    assert!(server.child.try_wait().unwrap().is_none());
    assert_answers(&server);
}

#[test]
fn server_reports_taken_port() {
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let port = taken.local_addr().unwrap().port().to_string();
    let mut command = Command::new(env!("CARGO_BIN_EXE_splatvk"));
    let output = command.arg("view").arg(scene()).args(["--port", &port]).output().unwrap();
    assert_eq!(output.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&output.stderr).contains("--port"));
}

/// A run whose training outlasts the test. It is ended by its process number.
struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// A training with a preview, its message about it, and the later events.
fn training(out: &Path) -> (Running, Value, impl Iterator<Item = Value>) {
    let (images, cameras, points) = fixture::small_views();
    let mut train = Command::new(env!("CARGO_BIN_EXE_splatvk"));
    train.arg("train").arg("--images").arg(images).arg("--cameras").arg(cameras).arg("--points").arg(points);
    train
        .args(["--iterations", "30000", "--force", "--log", "json", "--out"])
        .arg(out)
        .stderr(Stdio::piped());
    let mut run = Running(train.spawn().unwrap());
    let lines = BufReader::new(run.0.stderr.take().unwrap()).lines().map_while(Result::ok);
    let mut events = lines.map(|line| serde_json::from_str::<Value>(&line).unwrap());
    let offer = events.find(|e| e["message"].as_str().is_some_and(|m| m.contains("preview"))).unwrap();
    (run, offer, events)
}

/// Waits until the server reports the end of the run.
fn wait_for_end(server: &Server) {
    let begun = Instant::now();
    while !server.request("GET", "state", "", "").1.contains("ended without a scene") {
        assert!(begun.elapsed() < Duration::from_secs(30), "the page is told that the run ended");
        std::thread::sleep(Duration::from_millis(100));
    }
}

#[test]
fn view_of_running_run_is_a_preview() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("a scene");
    let (run, offer, mut events) = training(&out);
    assert_eq!(
        offer["message"],
        format!("look at a preview meanwhile: splatvk view '{}'", out.display()),
        "to copy, in the quotes of a shell"
    );
    let step = events.find(|e| e["event"] == "step" && e["stage"] == "splats").unwrap();
    // Photos, features, cameras, stereo and surfaces, which given cameras skip, and initial splats.
    assert_eq!((&step["stage_number"], &step["stages"]), (&json!(7), &json!(10)));
    assert!(step["seconds_left"].as_f64().unwrap() > 1.0, "{step}");
    let server = Server::start(&out);
    assert!(!out.exists(), "the scene comes later");
    let (status, page) = server.request("GET", "", "", "");
    assert!(status == 200 && page.contains("\"renews\":true"), "{status}");
    drop(run);
    assert_eq!(server.request("GET", "scene.bin", "", "").0, 200, "the preview stays in memory");
    wait_for_end(&server);
    // A stopped run has no preview: the next command says that there is no scene.
    let view = Command::new(env!("CARGO_BIN_EXE_splatvk")).arg("view").arg(&out).output().unwrap();
    assert_eq!(view.status.code(), Some(2));
}

#[test]
fn view_takes_no_old_scene_for_that_of_the_run() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("scene");
    let copied = Command::new("cp").arg("-r").arg(scene()).arg(&out).status().unwrap();
    assert!(copied.success());
    let (run, ..) = training(&out);
    let server = Server::start(&out);
    drop(run);
    wait_for_end(&server);
    let (_, page) = server.request("GET", "", "", "");
    assert!(page.contains("\"renews\":true"), "the preview stays");
}
