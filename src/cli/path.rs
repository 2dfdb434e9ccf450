//! `splatvk render --path`: views between and beside the photos, with their figures.
use super::args::PathKind;
use crate::Result;
use crate::eval::ShownScore;
use crate::format::picture;
use crate::photo::VideoWriter;
use crate::progress::Progress;
use crate::run::outputs::WrittenFiles;
use crate::run::path::{CameraPath, FRAMES_PER_SEGMENT, PathViews, fitted, sheet};
use crate::run::view::{DecodedFrame, Viewer};
use crate::scene::{Camera, RgbImage};
use serde::Serialize;
use std::fmt::Write;

/// Longer side of a view in the sheet, pixels.
const CELL: f64 = 400.0;
/// File of the sheet.
const SHEET: &str = "sheet.png";

impl From<PathKind> for CameraPath {
    fn from(kind: PathKind) -> CameraPath {
        match kind {
            PathKind::Photos => CameraPath::Photos,
            PathKind::Beyond => CameraPath::Beyond,
            // An orbit is a film (film.rs) and no views of this path.
            PathKind::Orbit => CameraPath::Photos,
        }
    }
}

/// Figures of a view.
#[derive(Serialize)]
struct ViewRow {
    view: String,
    #[serde(flatten)]
    score: ShownScore,
}

/// The views of a path while they are rendered.
pub struct PathOutput {
    path: CameraPath,
    views: PathViews,
    cameras: Vec<Camera>,
    /// Size of a view in the sheet, pixels.
    cell: [usize; 2],
    /// The views at that size.
    images: Vec<RgbImage>,
    rows: Vec<ViewRow>,
}

impl PathOutput {
    pub fn new(path: CameraPath, views: PathViews) -> PathOutput {
        let cameras = views.cameras(path);
        let size = |side: fn(&Camera) -> u32| cameras.iter().map(side).max().map_or(1.0, f64::from);
        let (width, height) = (size(|c| c.width), size(|c| c.height));
        let scale = (CELL / width.max(height)).min(1.0);
        let cell = [width, height].map(|side| ((side * scale) as usize).max(1));
        PathOutput { path, views, cameras, cell, images: Vec::new(), rows: Vec::new() }
    }

    pub fn cameras(&self) -> &[Camera] {
        &self.cameras
    }

    pub fn add(&mut self, camera: &Camera, view: &DecodedFrame) {
        self.rows.push(ViewRow { view: camera.name.clone(), score: self.views.score(camera, view) });
        self.images.push(fitted(view.picture(), self.cell));
    }

    /// Writes the sheet: four views per row, a photo and those up to the next one.
    pub fn write_sheet(&self, out: &mut WrittenFiles) -> Result<()> {
        picture::write_png(&out.file(SHEET)?, &sheet(&self.images, 4, self.cell))
    }

    /// Renders and writes `path.mp4`.
    pub fn write_video(
        &self,
        viewer: &mut Viewer,
        out: &mut WrittenFiles,
        progress: &dyn Progress,
    ) -> Result<()> {
        let cameras = self.views.video(self.path);
        let Some(first) = cameras.first() else { return Ok(()) };
        let size = (first.width as usize, first.height as usize);
        let mut video = VideoWriter::open(&out.file("path.mp4")?, size, FRAMES_PER_SEGMENT)?;
        progress.begin("video", cameras.len() as u64);
        for (i, camera) in cameras.iter().enumerate() {
            progress.check()?;
            video.frame(viewer.view(camera)?.picture())?;
            progress.step(i as u64 + 1, "");
        }
        progress.end();
        video.finish()
    }

    /// The figures of every view, for `--json`.
    pub fn json(&self) -> serde_json::Value {
        serde_json::json!(self.rows)
    }

    /// The figures of every view as a table.
    pub fn table(&self) -> String {
        let width = self.rows.iter().map(|r| r.view.len()).max().unwrap_or(0).max(8);
        let mut out = format!(
            "{:<width$}{:>13}{:>12}{:>12}{:>10}\n",
            "view", "alpha<0.9", "of shown", "alpha<0.5", "confetti"
        );
        let percent = |share: f64| format!("{:.2} %", 100.0 * share);
        for ViewRow { view, score } in &self.rows {
            let _ = writeln!(
                out,
                "{view:<width$}{:>13}{:>12}{:>12}{:>10}",
                percent(score.transparent),
                percent(score.alpha_below_90),
                percent(score.alpha_below_50),
                percent(score.confetti)
            );
        }
        out
    }
}
