//! A compute pass of one's own on a rendered frame, without a copy to the host: contour lines of
//! the depth. `cargo run --release -p own_pass -- out/kitchen contours.png`.
use splatvk::format::{picture, scene_dir};
use splatvk::gpu::{self, Recorder};
use splatvk::pass::Renderer;
use splatvk::scene::RgbImage;
use splatvk::{Error, Result};
use std::path::Path;
use std::process::ExitCode;

/// Generated from `shaders/contours.comp`.
mod shaders {
    include!(concat!(env!("OUT_DIR"), "/shaders.rs"));
}

/// Distance of the contour lines, in units of the scene.
const SPACING: f32 = 0.05;

fn contours(scene: &Path, out: &Path) -> Result<()> {
    use shaders::contours::{Bindings, Push, call};
    let device = gpu::open(None)?;
    let scene = scene_dir::load(scene)?;
    let camera = scene.cameras.first().ok_or_else(|| Error::input("the scene has no cameras"))?;
    let mut renderer = Renderer::new(&device, &scene.splats, &[], 0)?;
    let frame = renderer.draw(camera)?.frame();
    let (width, height) = (frame.width, frame.height);

    let image = device.buffer::<f32>("contours", 3 * (width * height) as usize)?;
    let mut recorder = Recorder::new(&device, "contours");
    let bindings = Bindings { planes: &frame.planes, transmittance: &frame.transmittance, picture: &image };
    let push = Push { width, height, spacing: SPACING };
    recorder.dispatch_threads(call(&bindings, &push), [width * height, 1, 1]);
    recorder.download(&image);
    recorder.run()?;

    let data = image.read()?.chunks_exact(3).map(|c| [c[0], c[1], c[2]]).collect();
    picture::write_png(out, &RgbImage { width: width as usize, height: height as usize, data })
}

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [scene, out] = arguments.as_slice() else {
        eprintln!("usage: own_pass SCENE OUT.png");
        return ExitCode::from(2);
    };
    match contours(Path::new(scene), Path::new(out)) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("{error}");
            ExitCode::from(error.exit_code())
        }
    }
}
