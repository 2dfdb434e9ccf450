//! A compute pass of one's own on what the engine has rendered, without a way over the host: contour lines of the depth.
//! `cargo run --release --example own_pass -- out/kitchen contours.png`.
use splatvk::format::{picture, scene_dir};
use splatvk::gpu::{Access, Binding, Call, Device, Family, Module, Recorder};
use splatvk::pass::Renderer;
use splatvk::scene::RgbImage;
use splatvk::{Error, Result};
use std::path::Path;
use std::process::ExitCode;

const READ: Access = Access { read: true, write: false };
const WRITTEN: Access = Access { read: false, write: true };

/// `own_pass.comp` with what the host must know of it: barriers follow from the access that is stated here.
static CONTOURS: Family = Family {
    name: "contours",
    axes: &[],
    modules: &[Module {
        name: "contours",
        variant: &[],
        subgroup_size: None,
        float_atomics: None,
        workgroup: [128, 1, 1],
        push_bytes: 12,
        capabilities: &[],
        bindings: &[
            Binding { number: 0, name: "planes", access: READ, element: "f32" },
            Binding { number: 1, name: "transmittance", access: READ, element: "f32" },
            Binding { number: 2, name: "picture", access: WRITTEN, element: "f32" },
        ],
        spirv: include_bytes!("own_pass.spv"),
    }],
};

fn contours(scene: &Path, out: &Path) -> Result<()> {
    let device = Device::open(None)?;
    let scene = scene_dir::load(scene)?;
    let camera = scene.cameras.first().ok_or_else(|| Error::input("the scene has no cameras"))?;
    let mut renderer = Renderer::new(&device, &scene.splats, &[], 0)?;
    let frame = renderer.draw(camera)?.frame();
    let (width, height) = (frame.width, frame.height);
    let image = device.buffer::<f32>("contours", 3 * (width * height) as usize)?;

    let mut recorder = Recorder::new(&device, "contours");
    // The layout of `Push` in the shader; lines a twentieth of the scene's unit apart.
    let push = [width.to_le_bytes(), height.to_le_bytes(), 0.05f32.to_le_bytes()].concat();
    let buffers = vec![(0, frame.planes.cast()), (1, frame.transmittance.cast()), (2, image.cast())];
    recorder.dispatch_threads(Call::new(&CONTOURS, vec![], buffers, push), [width * height, 1, 1]);
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
