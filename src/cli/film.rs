//! `splatvk render --path … --out FILE.mp4`: a film along a path, or its frames as PNG.
use super::args::{PathKind, RenderArgs};
use super::print::{listing, print, print_json};
use super::progress;
use super::scene;
use crate::format::picture;
use crate::format::scene_dir::Scene;
use crate::gpu;
use crate::photo::VideoWriter;
use crate::run::orbit::Orbit;
use crate::run::outputs::{WrittenFile, WrittenFiles};
use crate::run::path::{CameraPath, PathViews};
use crate::run::view::{UnseenShare, Viewer};
use crate::scene::{Camera, LanguageField, RgbImage};
use crate::{Error, Result};
use glam::DVec3;
use serde_json::json;
use std::f64::consts::TAU;
use std::path::Path;

/// Size of a film of a scene without photos, pixels.
const SIZE: (u32, u32) = (1280, 720);
/// The guessed share is measured in one of so many frames.
const MEASURED: usize = 10;

/// Whether the arguments ask for a film: an .mp4, or an orbit.
pub fn is_wanted(args: &RenderArgs) -> bool {
    is_mp4(&args.out) || args.path == Some(PathKind::Orbit)
}

fn is_mp4(out: &Path) -> bool {
    out.extension().is_some_and(|e| e.eq_ignore_ascii_case("mp4"))
}

/// Where the frames go.
enum Frames {
    Film(VideoWriter),
    Pictures(Box<WrittenFiles>),
}

impl Frames {
    fn add(&mut self, name: &str, image: &RgbImage) -> Result<()> {
        match self {
            Frames::Film(video) => video.frame(image),
            Frames::Pictures(out) => picture::write_png(&out.file(&format!("{name}.png"))?, image),
        }
    }
}

pub fn film(args: &RenderArgs) -> Result<()> {
    let Some(kind) = args.path else {
        return Err(Error::input("--out FILE.mp4: a film follows a path; add --path orbit or --path photos"));
    };
    let inputs = [args.scene.as_path()];
    if !is_mp4(&args.out) {
        let out = WrittenFiles::open(&args.out, args.force, &inputs)?;
        let mut frames = Frames::Pictures(Box::new(out));
        let about = Shot::open(args, kind)?.render(&mut frames)?;
        let files = match frames {
            Frames::Pictures(out) => out.keep()?,
            Frames::Film(_) => Vec::new(),
        };
        return told(args, &files, &about);
    }
    let instead = "or give a folder: --out DIR --path orbit writes the frames as PNG";
    VideoWriter::check(&args.out.display().to_string(), instead)?;
    let file = WrittenFile::open(&args.out, args.force, &inputs)?;
    let mut shot = Shot::open(args, kind)?;
    let mut about = None;
    file.keep(|path| {
        let mut frames = Frames::Film(VideoWriter::open(path, shot.size()?, args.fps as usize)?);
        about = Some(shot.render(&mut frames)?);
        match frames {
            Frames::Film(video) => video.finish(),
            Frames::Pictures(_) => Ok(()),
        }
    })?;
    about.map_or(Ok(()), |about| told(args, std::slice::from_ref(&args.out), &about))
}

fn told(args: &RenderArgs, files: &[std::path::PathBuf], about: &About) -> Result<()> {
    if args.device.json {
        return print_json(&json!({
            "files": files, "frames": about.frames, "fps": args.fps, "degrees": about.degrees,
            "guessed": about.guessed.map(|(mean, most)| json!({ "mean": mean, "most": most })),
        }));
    }
    progress::reporter().inform(&about.text(args.fps));
    match files {
        [file] => print(&format!("{}\n", file.display())),
        files => listing(files, false),
    }
}

/// Figures of a rendered film.
struct About {
    frames: usize,
    /// Angle of an orbit.
    degrees: Option<f64>,
    /// Mean and largest share of a frame that no photo shows, where that is known.
    guessed: Option<(f64, f64)>,
}

impl About {
    fn text(&self, fps: u32) -> String {
        let seconds = self.frames as f64 / f64::from(fps);
        let path = match self.degrees {
            Some(degrees) if degrees >= 359.9 => "once around".to_owned(),
            Some(degrees) => format!(
                "a swing of {degrees:.0}°, as far as the photos are around the scene; --degrees 360 goes around it"
            ),
            None => "along the photos".to_owned(),
        };
        let guessed = self.guessed.map_or_else(String::new, |(mean, most)| {
            format!("; {:.1} % of the pictures is guessed, {:.1} % of the worst", 100.0 * mean, 100.0 * most)
        });
        format!("{} frames, {seconds:.1} s: {path}{guessed}", self.frames)
    }
}

/// The cameras of a film and the scene in front of them.
struct Shot {
    cameras: Vec<Camera>,
    degrees: Option<f64>,
    viewer: Viewer,
    unseen: Option<UnseenShare>,
}

impl Shot {
    fn open(args: &RenderArgs, kind: PathKind) -> Result<Shot> {
        let scene = scene::load(&args.scene, args.edits)?;
        let device = gpu::open(args.device.device.as_deref())?;
        let viewer = Viewer::new(&device, &scene.splats, &LanguageField::default())?;
        let mut viewer = viewer.with_backdrop(&scene.backdrop)?.with_holes(&scene.holes)?;
        let frames = (args.seconds * f64::from(args.fps)).round().max(1.0) as usize;
        let (cameras, degrees) = match kind {
            PathKind::Orbit => {
                let orbit = orbit(&scene, &mut viewer, args.degrees.map(f64::to_radians))?;
                (orbit.cameras(frames), Some(orbit.span().to_degrees()))
            }
            PathKind::Photos | PathKind::Beyond => {
                let path = CameraPath::from(kind);
                let views = PathViews::new(&mut viewer, &scene.cameras, &scene.world)?;
                (picked(&views.video(path), frames), None)
            }
        };
        let known = !scene.seen.pixels.is_empty();
        let unseen = known.then(|| UnseenShare::new(&device, &scene.splats, &scene.seen)).transpose()?;
        Ok(Shot { cameras, degrees, viewer, unseen })
    }

    /// Width and height of a frame.
    fn size(&self) -> Result<(usize, usize)> {
        let first = self.cameras.first().ok_or_else(|| Error::input("--path: the path has no views"))?;
        Ok((first.width as usize, first.height as usize))
    }

    fn render(&mut self, frames: &mut Frames) -> Result<About> {
        let progress = progress::reporter();
        progress.begin("film", self.cameras.len() as u64);
        let mut shares = Vec::new();
        for (i, camera) in self.cameras.iter().enumerate() {
            progress.check()?;
            frames.add(&format!("frame_{i:04}"), self.viewer.view(camera)?.picture())?;
            if let Some(unseen) = self.unseen.as_mut().filter(|_| i % MEASURED == 0) {
                let share = unseen.view(camera)?;
                let sum: f64 = share.data.iter().map(|v| f64::from(*v)).sum();
                shares.push(sum / share.data.len().max(1) as f64);
            }
            progress.step(i as u64 + 1, "");
        }
        progress.end();
        let mean = shares.iter().sum::<f64>() / shares.len().max(1) as f64;
        let most = shares.iter().copied().fold(0.0, f64::max);
        let guessed = (!shares.is_empty()).then_some((mean, most));
        Ok(About { frames: self.cameras.len(), degrees: self.degrees, guessed })
    }
}

/// An orbit along the photos of a scene, or around a file of Gaussians.
fn orbit(scene: &Scene, viewer: &mut Viewer, span: Option<f64>) -> Result<Orbit> {
    let nothing = || Error::input("--path orbit: no splats to go around");
    if scene.cameras.is_empty() {
        let up = scene.world.up.as_ref().map_or(-DVec3::Y, |up| up.direction);
        return Orbit::around(&scene.splats, up, span, SIZE).ok_or_else(nothing);
    }
    let views = PathViews::new(viewer, &scene.cameras, &scene.world)?;
    let (target, up) = views.middle();
    Orbit::of_photos(&scene.cameras, target, up, span.map(|s| s.min(TAU))).ok_or_else(nothing)
}

/// So many of the cameras of a path, evenly from the first to the last.
fn picked(path: &[Camera], frames: usize) -> Vec<Camera> {
    let last = path.len().saturating_sub(1) as f64;
    let at = |k: usize| (k as f64 / (frames.max(2) - 1) as f64 * last).round() as usize;
    (0..frames).filter_map(|k| path.get(at(k)).cloned()).collect()
}
