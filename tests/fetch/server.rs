//! A web server on 127.0.0.1 that misbehaves on demand, built on sockets only.
use std::io::{BufRead, BufReader, Write};
use std::net::{TcpListener, TcpStream};
use std::sync::{Arc, Mutex};
use std::time::Duration;

/// Request of a client; header names in lower case.
#[derive(Clone, Debug)]
pub struct Request {
    pub path: String,
    headers: Vec<(String, String)>,
}

impl Request {
    pub fn header(&self, name: &str) -> Option<&str> {
        self.headers.iter().find(|(n, _)| n == name).map(|(_, v)| v.as_str())
    }

    /// First requested byte.
    pub fn first(&self) -> Option<usize> {
        self.header("range")?.strip_prefix("bytes=")?.strip_suffix('-')?.parse().ok()
    }
}

pub struct Server {
    pub address: String,
    log: Arc<Mutex<Vec<Request>>>,
}

impl Server {
    /// `answer` gets every request with the number of earlier ones, and writes to the connection,
    /// which is closed afterwards.
    pub fn start(answer: impl Fn(&Request, usize, &mut TcpStream) + Send + Sync + 'static) -> Server {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = format!("http://{}", listener.local_addr().unwrap());
        let (log, answer) = (Arc::new(Mutex::new(Vec::new())), Arc::new(answer));
        let seen = log.clone();
        std::thread::spawn(move || {
            for mut stream in listener.incoming().flatten() {
                let (seen, answer) = (seen.clone(), answer.clone());
                std::thread::spawn(move || {
                    let Some(request) = read(&stream) else { return };
                    let count = {
                        let mut seen = seen.lock().unwrap();
                        seen.push(request.clone());
                        seen.len() - 1
                    };
                    answer(&request, count, &mut stream);
                });
            }
        });
        Server { address, log }
    }

    /// Requests since the last call.
    pub fn requests(&self) -> Vec<Request> {
        std::mem::take(&mut self.log.lock().unwrap())
    }
}

fn read(stream: &TcpStream) -> Option<Request> {
    let mut lines = BufReader::new(stream).lines();
    let first = lines.next()?.ok()?;
    let mut words = first.split(' ').map(str::to_owned);
    let path = words.nth(1)?;
    let mut headers = Vec::new();
    for line in lines {
        match line.ok()?.split_once(": ") {
            Some((name, value)) => headers.push((name.to_lowercase(), value.to_owned())),
            None => break,
        }
    }
    Some(Request { path, headers })
}

/// A served file and its faults.
#[derive(Clone)]
pub struct File {
    pub body: Arc<Vec<u8>>,
    pub etag: &'static str,
    /// Whether range requests are supported.
    pub ranges: bool,
    /// Closes the connection after this many bytes of the body.
    pub cut: Option<usize>,
    /// Pause between pieces of 256 KiB.
    pub pause: Duration,
}

impl File {
    pub fn new(body: &[u8]) -> File {
        let body = Arc::new(body.to_vec());
        File { body, etag: "\"one\"", ranges: true, cut: None, pause: Duration::ZERO }
    }

    pub fn cut(self, bytes: usize) -> File {
        File { cut: Some(bytes), ..self }
    }

    /// Sends the file, or the requested part of it.
    pub fn send(&self, request: &Request, stream: &mut TcpStream) {
        let same = request.header("if-range").is_none_or(|v| v == self.etag);
        let first = request.first().filter(|_| self.ranges && same);
        let (etag, total) = (self.etag, self.body.len());
        let head = match first {
            Some(first) if first >= total => {
                return plain(stream, "416 Range Not Satisfiable", &[]);
            }
            Some(first) => format!(
                "HTTP/1.1 206 Partial Content\r\nContent-Range: bytes {first}-{}/{total}\r\nContent-Length: {}\r\n",
                total - 1,
                total - first
            ),
            None => format!("HTTP/1.1 200 OK\r\nContent-Length: {total}\r\n"),
        };
        let body = &self.body[first.unwrap_or(0)..];
        let body = &body[..self.cut.unwrap_or(body.len()).min(body.len())];
        // Clients that disconnect are part of the tests.
        let mut send = || {
            write!(stream, "{head}ETag: {etag}\r\nConnection: close\r\n\r\n")?;
            for piece in body.chunks(1 << 18) {
                stream.write_all(piece)?;
                std::thread::sleep(self.pause);
            }
            stream.flush()
        };
        let _ = send();
    }
}

/// Sends a response without a file.
pub fn plain(stream: &mut TcpStream, status: &str, headers: &[&str]) {
    let headers: String = headers.iter().map(|h| format!("{h}\r\n")).collect();
    let _ = write!(stream, "HTTP/1.1 {status}\r\n{headers}Content-Length: 0\r\nConnection: close\r\n\r\n");
}
