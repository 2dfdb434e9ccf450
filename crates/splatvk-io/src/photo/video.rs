//! Frames of a video through `ffprobe` and `ffmpeg`, as child processes: without a shell, reading
//! local files only, within bounded time and memory.
use super::code_points::{self, CodePoints};
use super::support::Support;
use crate::error::words;
use crate::progress::Progress;
use crate::{Error, Result};
use std::ffi::OsString;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// Largest number of candidate frames: one per second of a minute's walk around a thing; 60 × 60
/// pairs are compared in seconds.
const CANDIDATES: u64 = 60;

/// Time limit for a frame: one frame of 8K HEVC between two key frames ten seconds apart decodes in
/// half of this on two cores.
const LONGEST: Duration = Duration::from_secs(120);

/// Largest frame, pixels: beyond 8K.
const MAX_PIXELS: u64 = 64 << 20;

/// Containers of cameras and phones. Playlists are excluded: they name other files.
const CONTAINERS: &str = "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,mpeg,mpegts,asf";

/// Advice where the programs are missing.
const INSTALL: &str =
    "install it (tools/setup; apt-get install ffmpeg; brew install ffmpeg), or give still photos";

/// A video that can be read.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Video {
    pub path: PathBuf,
    /// Seconds.
    duration: f64,
    /// Number of frames that the file states, or that follows from its rate.
    frames: u64,
    /// Meaning of its colour values.
    pub code_points: CodePoints,
}

/// Support for videos: "ffmpeg 5.1.9", or the missing part with advice.
pub(super) fn status() -> Support {
    match (version("ffmpeg"), version("ffprobe")) {
        (Some(version), Some(_)) => Support { found: format!("ffmpeg {version}"), advice: None },
        (None, _) => Support::none("videos cannot be read", format!("ffmpeg is not there; {INSTALL}")),
        (_, None) => Support::none("videos cannot be read", format!("ffprobe is not there; {INSTALL}")),
    }
}

/// Version of an installed program.
fn version(program: &str) -> Option<String> {
    let output = Command::new(program).arg("-version").stdin(Stdio::null()).output().ok()?;
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    output.status.success().then(|| text.split_whitespace().nth(2).unwrap_or("").to_owned())
}

impl Video {
    /// Reads duration, number of frames and code points; refuses files without a usable video
    /// stream.
    pub fn open(path: &Path, progress: &dyn Progress) -> Result<Video> {
        let entries = "stream=width,height,avg_frame_rate,nb_frames,duration,color_transfer,color_primaries:\
            stream_side_data=side_data_type,projection:format=duration";
        let mut command = reader("ffprobe");
        command.args(["-select_streams", "v:0", "-show_entries", entries, "-of", "json"]);
        command.arg("-i").arg(file(path));
        // 1 MiB: one stream of a few figures.
        let text = output(command, path, 1 << 20, progress)?;
        let bad = |what: &str| Error::input(format!("{}: {what}", path.display()));
        let found: serde_json::Value =
            serde_json::from_slice(&text).map_err(|_| bad("ffprobe does not say what is in this video"))?;
        let stream = &found["streams"][0];
        let number = |v: &serde_json::Value| v.as_f64().or_else(|| v.as_str()?.parse().ok());
        let (w, h) = (stream["width"].as_u64().unwrap_or(0), stream["height"].as_u64().unwrap_or(0));
        if w * h == 0 {
            return Err(bad("there is no picture in this video"));
        }
        if w.saturating_mul(h) > MAX_PIXELS {
            return Err(bad(&format!("{w} × {h} pixels are too many for a video; scale it down")));
        }
        let sphere =
            stream["side_data_list"].as_array().into_iter().flatten().find_map(|d| d["projection"].as_str());
        if let Some(projection) = sphere.filter(|p| *p != "rectilinear") {
            return Err(bad(&format!(
                "is a 360° video (projection {projection}), which no pinhole camera shows; cut one view out of it: ffmpeg -i IN.mp4 -vf \
                 v360=e:flat:h_fov=90:v_fov=90:yaw=0:pitch=0:w=1200:h=1200 OUT.mp4"
            )));
        }
        let code_points = code_points(stream, path, progress);
        let duration = number(&stream["duration"]).or_else(|| number(&found["format"]["duration"]));
        let duration = duration.filter(|d| d.is_finite() && *d > 0.0);
        let duration =
            duration.ok_or_else(|| bad("the video does not say how long it is; save it as MP4"))?;
        let rate = stream["avg_frame_rate"].as_str().and_then(|r| r.split_once('/'));
        let rate = rate.and_then(|(n, d)| Some(n.parse::<f64>().ok()? / d.parse::<f64>().ok()?));
        let counted = number(&stream["nb_frames"]).filter(|n| *n >= 1.0);
        let guessed = rate.filter(|r| r.is_finite() && *r > 0.0).map(|r| duration * r);
        let frames = counted.or(guessed).unwrap_or(1.0).max(1.0) as u64;
        if frames < 2 {
            return Err(bad("one frame is no video; at least 2 are needed"));
        }
        Ok(Video { path: path.to_path_buf(), duration, frames, code_points })
    }

    /// Times of the candidate frames, seconds: evenly spaced from the first frame on.
    pub fn times(&self) -> Vec<f64> {
        let count = self.frames.min(CANDIDATES);
        (0..count).map(|i| self.duration * i as f64 / count as f64).collect()
    }

    /// `clip.mp4/clip_0012400` for the frame at 12.4 s. Without dots: the text after one would
    /// count as an extension.
    pub fn frame_name(&self, at: f64) -> PathBuf {
        let stem = self.path.file_stem().map(|s| s.to_string_lossy().replace('.', "_")).unwrap_or_default();
        self.path.join(format!("{stem}_{:07}", (at * 1000.0).round() as u64))
    }

    /// The frame at a time, upright, as PNG bytes; scaled to at most `side` pixels if given. Empty
    /// past the end.
    pub fn frame(&self, at: f64, side: Option<usize>, progress: &dyn Progress) -> Result<Vec<u8>> {
        let mut command = reader("ffmpeg");
        // 1 GiB at once: four times a frame of the largest size in 16 bit.
        command.args(["-nostdin", "-max_alloc", "1073741824", "-threads", "2"]);
        command.args(["-ss", &format!("{at:.6}"), "-i"]).arg(file(&self.path));
        command.args(["-map", "0:v:0", "-frames:v", "1"]);
        if let Some(side) = side {
            let fit = format!("scale='min({side},iw)':'min({side},ih)':flags=area");
            command.args(["-vf", &format!("{fit}:force_original_aspect_ratio=decrease")]);
        }
        // High dynamic range in 8 bits would show banding.
        let (format, bytes) =
            if code_points::is_hdr(self.code_points) { ("rgb48be", 6) } else { ("rgb24", 3) };
        command.args(["-c:v", "png", "-pix_fmt", format, "-f", "image2pipe", "pipe:1"]);
        // Uncompressed, plus the PNG's own framing.
        output(command, &self.path, bytes * MAX_PIXELS + (1 << 20), progress)
    }
}

/// Code points of ITU-T H.273 for the names of primaries and transfer in ffprobe; warns of unknown
/// names.
fn code_points(stream: &serde_json::Value, path: &Path, progress: &dyn Progress) -> CodePoints {
    let number = |key: &str, of: fn(&str) -> Option<u16>, what: &str| {
        let name = stream[key].as_str().unwrap_or("");
        of(name).unwrap_or_else(|| {
            progress.warn(&format!(
                "{}: states the {what} {name}, which is not known; read as that of sRGB",
                path.display()
            ));
            2
        })
    };
    let transfer = number("color_transfer", code_points::transfer_of_name, "transfer");
    [number("color_primaries", code_points::primaries_of_name, "primaries"), transfer, 0, 1]
}

/// Common options of both programs. Options of the input precede it.
fn reader(program: &str) -> Command {
    let mut command = Command::new(program);
    command.args(["-hide_banner", "-loglevel", "error"]);
    command.args(["-protocol_whitelist", "file", "-format_whitelist", CONTAINERS]);
    command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

/// The path as a URL: no file name can be read as an option or another protocol.
pub(super) fn file(path: &Path) -> OsString {
    let mut address = OsString::from("file:");
    address.push(path);
    address
}

/// Kills and reaps the program when dropped before its end.
#[derive(Debug)]
pub(super) struct Running(pub(super) Child);

impl Drop for Running {
    fn drop(&mut self) {
        // Both fail only where the child has ended already.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Reads at most `most` bytes of a pipe on a thread.
fn collect(pipe: Option<Box<dyn Read + Send>>, most: u64) -> std::thread::JoinHandle<Vec<u8>> {
    std::thread::spawn(move || {
        let mut bytes = Vec::new();
        // Output before an error is more useful than the error.
        let _ = pipe.map(|p| p.take(most).read_to_end(&mut bytes));
        bytes
    })
}

/// Standard output of a program that reads `path`, at most `most` bytes.
fn output(mut command: Command, path: &Path, most: u64, progress: &dyn Progress) -> Result<Vec<u8>> {
    let named = |what: String| format!("{}: {what}", path.display());
    let program = command.get_program().to_string_lossy().into_owned();
    let child = command.spawn().map_err(|e| match e.kind() {
        std::io::ErrorKind::NotFound => {
            Error::missing(named(format!("is a video, and {program} is not there; {INSTALL}")))
        }
        _ => Error::work(named(format!("{program} does not start ({})", words(&e)))),
    })?;
    let mut child = Running(child);
    let out = collect(child.0.stdout.take().map(|p| Box::new(p) as _), most + 1);
    // Enough for the first messages.
    let errors = collect(child.0.stderr.take().map(|p| Box::new(p) as _), 4096);
    let start = Instant::now();
    let status = loop {
        match child.0.try_wait() {
            Ok(Some(status)) => break status,
            Ok(None) if start.elapsed() > LONGEST => {
                let seconds = LONGEST.as_secs();
                return Err(Error::input(named(format!(
                    "{program} took more than {seconds} s for one frame; scale the video down, or give still photos"
                ))));
            }
            Ok(None) => progress.check()?,
            Err(e) => return Err(Error::work(named(format!("{program}: {}", words(&e))))),
        }
        // Short against the tens of milliseconds that starting the program takes.
        std::thread::sleep(Duration::from_millis(5));
    };
    let (bytes, errors) = (out.join().unwrap_or_default(), errors.join().unwrap_or_default());
    if !status.success() || bytes.len() as u64 > most {
        let message = String::from_utf8_lossy(&errors).replace(&*path.to_string_lossy(), "");
        let message = message.split_whitespace().collect::<Vec<_>>().join(" ");
        // Messages may be long; the first sentence or two suffice.
        let message: String =
            message.trim_start_matches("file:").trim_matches([':', ' ']).chars().take(160).collect();
        return Err(Error::input(named(format!(
            "the video cannot be read ({message}); copy it again, or save it as MP4"
        ))));
    }
    Ok(bytes)
}
