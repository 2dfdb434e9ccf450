//! A scene from a camera that swings around what the photo in the middle shows:
//! `cargo run --release --example render -- out/kitchen orbit`.
use glam::{DMat3, DVec2};
use splatvk::format::{picture, scene_dir};
use splatvk::gpu;
use splatvk::pass::Renderer;
use splatvk::scene::{Camera, Pose};
use splatvk::{Error, Result};
use std::path::Path;
use std::process::ExitCode;

/// Pictures of a swing to either side and back.
const FRAMES: usize = 8;
/// To either side, radians.
const SWING: f64 = 0.2;

/// The camera turned by an angle around a vertical axis through the point at `depth` before it.
fn orbit(camera: &Camera, depth: f64, angle: f64) -> Camera {
    let middle = DVec2::new(camera.cx, camera.cy);
    let centre = camera.unproject(middle, depth);
    // Photos are taken upright: the camera's y axis points down.
    let down = camera.pose.rotation.transpose().y_axis;
    let turn = DMat3::from_axis_angle(down, angle);
    let about_centre = Pose { rotation: turn, translation: centre - turn * centre };
    Camera { pose: camera.pose.compose(&about_centre), ..camera.clone() }
}

fn render(scene: &Path, out: &Path) -> Result<()> {
    let scene = scene_dir::load(scene)?;
    let middle = scene.cameras.get(scene.cameras.len() / 2);
    let middle = middle.ok_or_else(|| Error::input("the scene has no cameras"))?;
    let mut renderer = Renderer::new(&gpu::open(None)?, &scene.splats, &[], 0)?;
    std::fs::create_dir_all(out).map_err(Error::unwritable(out))?;
    let seen = renderer.render(middle)?;
    let mut depths: Vec<f32> = seen.depth.data.iter().copied().filter(|z| *z > 0.0).collect();
    depths.sort_by(f32::total_cmp);
    let depth = depths.get(depths.len() / 2).copied().unwrap_or(1.0);
    for k in 0..FRAMES {
        let angle = SWING * (std::f64::consts::TAU * k as f64 / FRAMES as f64).sin();
        let frame = renderer.render(&orbit(middle, f64::from(depth), angle))?;
        let path = out.join(format!("{k:02}.png"));
        picture::write_png(&path, &frame.rgb)?;
        println!("{}", path.display());
    }
    Ok(())
}

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [scene, out] = arguments.as_slice() else {
        eprintln!("usage: render SCENE OUT");
        return ExitCode::from(2);
    };
    match render(Path::new(scene), Path::new(out)) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("{error}");
            ExitCode::from(error.exit_code())
        }
    }
}
