//! Candidates for the photos of a run: files and frames of videos.
use super::choose::{FoundFiles, find};
use super::decode;
use super::kind::check_name;
use super::mask::Mask;
use super::read::{self, Photo};
use super::video::Video;
use crate::progress::Progress;
use crate::scene::RgbImage;
use crate::scene::resize;
use crate::{Error, Result};
use std::path::{Path, PathBuf};
use std::sync::Arc;

#[derive(Clone, Debug)]
enum CandidateOrigin {
    File,
    /// Seconds from the start.
    Frame(Arc<Video>, f64),
}

/// A photo that has not been read yet.
#[derive(Clone, Debug)]
pub struct Candidate {
    /// Path of the file; for a frame the path of the video, extended by the name of the frame.
    pub path: PathBuf,
    source: CandidateOrigin,
    /// Replaces the stem of the path where two photos share it.
    stem: Option<String>,
    /// Path of the mask of used pixels, if any.
    pub(super) mask: Option<PathBuf>,
}

impl Candidate {
    /// A photo file.
    pub fn file(path: &Path) -> Candidate {
        Candidate { path: path.to_path_buf(), source: CandidateOrigin::File, stem: None, mask: None }
    }

    /// A photo file with another stem than that of the file.
    pub fn named(path: &Path, stem: &str) -> Candidate {
        Candidate { stem: Some(stem.to_owned()), ..Candidate::file(path) }
    }

    /// File name without folder.
    pub fn name(&self) -> String {
        self.path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default()
    }

    /// Reads the photo at working resolution, see [`super::load_at`].
    pub fn load(&self, max_size: usize, progress: &dyn Progress) -> Result<Photo> {
        let decoded = match &self.source {
            CandidateOrigin::File => decode::decode(read::read(&self.path)?, &self.path, None)?,
            CandidateOrigin::Frame(video, at) => {
                decode::decode(video.frame(*at, None, progress)?, &self.path, Some(video.code_points))?
            }
        };
        let mask = self.mask.as_deref().map(Mask::read).transpose()?;
        let photo = read::of_decoded(&self.path, decoded, mask.as_ref(), max_size)?;
        let stem = self.stem.clone().unwrap_or_else(|| photo.stem.clone());
        Ok(Photo { stem, ..photo })
    }

    /// Whether it is a file and not a frame.
    pub(super) fn is_file(&self) -> bool {
        matches!(self.source, CandidateOrigin::File)
    }

    /// Reads the upright pixels, at most `side` on the longer side; `None` past the end of a video
    /// that is shorter than stated. Only one decoded file is in memory at a time.
    pub fn thumbnail(&self, side: usize, progress: &dyn Progress) -> Result<Option<RgbImage>> {
        let (bytes, code) = match &self.source {
            CandidateOrigin::File => (read::read(&self.path)?, None),
            CandidateOrigin::Frame(video, at) => match video.frame(*at, Some(side), progress)? {
                bytes if bytes.is_empty() => return Ok(None),
                bytes => (bytes, Some(video.code_points)),
            },
        };
        let decoded = decode::decode(bytes, &self.path, code)?;
        read::check_size(&self.path, decoded.size)?;
        let (w, h) = decoded.size;
        let scale = (side as f64 / w.max(h) as f64).min(1.0);
        let scaled = |n: usize| ((n as f64 * scale).round() as usize).max(1);
        // Two samples a side for every pixel of the thumbnail; averaging all samples of a large
        // photo would take as long as decoding.
        let step = ((0.5 / scale) as usize).max(1);
        let pixel = |x: usize, y: usize| decoded.at(x * step, y * step).0;
        Ok(Some(resize::area_average((w / step, h / step), (scaled(w), scaled(h)), pixel)))
    }
}

/// Candidates of files, folders and videos, in the order of their names; frames in the order of
/// time. Warns of other files in the folders.
pub fn gather(inputs: &[PathBuf], progress: &dyn Progress) -> Result<Vec<Candidate>> {
    let found = find(inputs)?;
    let warnings = found.warnings();
    warnings.iter().for_each(|w| progress.warn(w));
    let FoundFiles { photos, videos, .. } = found;
    let mut all: Vec<Candidate> = photos.iter().map(|p| Candidate::file(p)).collect();
    for path in videos {
        let video = Arc::new(Video::open(&path, progress)?);
        let frame = |at| Candidate {
            source: CandidateOrigin::Frame(video.clone(), at),
            ..Candidate::file(&video.frame_name(at))
        };
        all.extend(video.times().into_iter().map(frame));
    }
    all.iter().try_for_each(|c| check_name(&c.path))?;
    check_count(&all, &warnings)?;
    Ok(all)
}

/// Refuses a single photo; the message lists the ignored files, which may be the others.
fn check_count(candidates: &[Candidate], left_out: &[String]) -> Result<()> {
    let [one] = candidates else { return Ok(()) };
    let besides: String = left_out.iter().map(|w| format!(" ({w})")).collect();
    Err(Error::input(format!(
        "{}: only one photo{besides}; at least 2 are needed, 3 or 4 work best",
        one.path.display()
    )))
}
