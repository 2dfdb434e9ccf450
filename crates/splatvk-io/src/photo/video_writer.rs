//! Writes videos through `ffmpeg`, as a child process without a shell.
use super::video::{Running, file};
use crate::scene::RgbImage;
use crate::{Error, Result};
use std::io::{Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

/// Advice where the program is missing.
const INSTALL: &str = "install it (tools/setup; apt-get install ffmpeg; brew install ffmpeg)";

/// Writer of an H.264 video in an MP4 file, frame by frame. Dropped without
/// [`VideoWriter::finish`], it ends the program, and the file is not playable.
#[derive(Debug)]
pub struct VideoWriter {
    child: Running,
    path: PathBuf,
    size: (usize, usize),
}

impl VideoWriter {
    /// Refuses a machine without ffmpeg or without its encoder, before any work. `asked` names what
    /// needs it, and `instead` the way without it.
    pub fn check(asked: &str, instead: &str) -> Result<()> {
        let encoders =
            Command::new("ffmpeg").args(["-hide_banner", "-encoders"]).stdin(Stdio::null()).output();
        match encoders {
            Err(_) => Err(Error::missing(format!("{asked}: ffmpeg is not there; {INSTALL}, {instead}"))),
            Ok(o) if !String::from_utf8_lossy(&o.stdout).contains("libx264") => {
                Err(Error::missing(format!("{asked}: this ffmpeg has no libx264; {INSTALL}, {instead}")))
            }
            Ok(_) => Ok(()),
        }
    }

    /// Starts a video of `size` (width, height, pixels; the last column or row of an odd size is
    /// left out, as the format demands).
    ///
    /// # Errors
    /// Bad input where ffmpeg is missing.
    pub fn open(path: &Path, size: (usize, usize), frames_per_second: usize) -> Result<VideoWriter> {
        let mut command = Command::new("ffmpeg");
        command.args(["-hide_banner", "-loglevel", "error", "-y", "-f", "rawvideo", "-pix_fmt", "rgb24"]);
        command.args(["-s", &format!("{}x{}", size.0, size.1), "-r", &frames_per_second.to_string()]);
        // Every browser plays 4:2:0 with the index at the front.
        command.args(["-i", "pipe:0", "-vf", "crop=trunc(iw/2)*2:trunc(ih/2)*2", "-c:v", "libx264"]);
        command.args(["-crf", "18", "-pix_fmt", "yuv420p", "-movflags", "+faststart", "-f", "mp4"]);
        command.arg(file(path)).stdin(Stdio::piped()).stdout(Stdio::null()).stderr(Stdio::piped());
        let child = command.spawn().map_err(|e| match e.kind() {
            std::io::ErrorKind::NotFound => {
                Error::missing(format!("{}: ffmpeg is not there; {INSTALL}", path.display()))
            }
            _ => Error::work(format!("{}: ffmpeg does not start: {e}", path.display())),
        })?;
        Ok(VideoWriter { child: Running(child), path: path.to_path_buf(), size })
    }

    /// Adds a frame of the video's size; colours are clipped to [0, 1].
    pub fn frame(&mut self, image: &RgbImage) -> Result<()> {
        if (image.width, image.height) != self.size {
            return Err(Error::work(format!("{}: a frame of another size", self.path.display())));
        }
        let bytes: Vec<u8> =
            image.data.iter().flatten().map(|v| (v.clamp(0.0, 1.0) * 255.0).round() as u8).collect();
        let written = self.child.0.stdin.as_mut().is_some_and(|stdin| stdin.write_all(&bytes).is_ok());
        if written { Ok(()) } else { Err(self.failure()) }
    }

    /// Completes the file.
    pub fn finish(mut self) -> Result<()> {
        drop(self.child.0.stdin.take());
        match self.child.0.wait() {
            Ok(status) if status.success() => Ok(()),
            _ => Err(self.failure()),
        }
    }

    /// The error that ffmpeg reports.
    fn failure(&mut self) -> Error {
        drop(self.child.0.stdin.take());
        let mut bytes = Vec::new();
        if let Some(stderr) = self.child.0.stderr.as_mut() {
            // 4 KiB: one line is used.
            let _ = stderr.take(4096).read_to_end(&mut bytes);
        }
        let text = String::from_utf8_lossy(&bytes);
        let line = text.lines().next().unwrap_or("it ended without a message").trim().to_owned();
        Error::work(format!("{}: ffmpeg does not write the video: {line}", self.path.display()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn video_has_all_frames() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a video.mp4");
        // An odd height.
        let mut video = match VideoWriter::open(&path, (32, 25), 24) {
            Err(Error::Missing(_)) => return eprintln!("skipped: no ffmpeg"),
            video => video.unwrap(),
        };
        let grey = |v: f32| RgbImage { width: 32, height: 25, data: vec![[v; 3]; 32 * 25] };
        (0..6).for_each(|k| video.frame(&grey(k as f32 / 4.0)).unwrap());
        let other = RgbImage { width: 8, height: 8, data: vec![[0.0; 3]; 64] };
        assert!(video.frame(&other).unwrap_err().to_string().contains("another size"));
        video.finish().unwrap();
        let mut probe = Command::new("ffprobe");
        probe.args(["-v", "error", "-count_frames", "-show_entries", "stream=nb_read_frames,width,height"]);
        let output = probe.args(["-of", "csv=p=0"]).arg(&path).output().unwrap();
        assert_eq!(String::from_utf8_lossy(&output.stdout).trim(), "32,24,6");
        let nowhere = folder.path().join("missing/video.mp4");
        let mut video = VideoWriter::open(&nowhere, (32, 25), 24).unwrap();
        let outcome = video.frame(&grey(0.5)).and_then(|()| video.finish());
        assert!(outcome.unwrap_err().to_string().contains("ffmpeg does not write"));
    }
}
