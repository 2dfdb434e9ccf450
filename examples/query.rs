//! Where a scene shows the thing that a text names:
//! `cargo run --release --example query -- out/kitchen "blue mug" masks`.
use splatvk::format::picture;
use splatvk::gpu;
use splatvk::infer::Registry;
use splatvk::run::live::LiveScene;
use splatvk::scene::LEVEL_NAMES;
use splatvk::{Error, Result};
use std::path::Path;
use std::process::ExitCode;

fn query(scene: &Path, text: &str, out: &Path) -> Result<()> {
    let mut scene = LiveScene::load(&gpu::open(None)?, scene, &Registry::open(None)?)?;
    std::fs::create_dir_all(out).map_err(Error::unwritable(out))?;
    for camera in scene.cameras().to_vec() {
        let answers = scene.ask(text, &camera)?;
        let answer = &answers.views[0];
        let name = Path::new(&camera.name).file_stem().unwrap_or_default().to_string_lossy().into_owned();
        if !answer.found {
            println!("{name}: not found, best score {:.2}; {}", answer.score, answers.sentence());
            continue;
        }
        let (x, y) = answer.location;
        let path = out.join(format!("{name}.png"));
        picture::write_mask_png(&path, &answer.mask())?;
        let pixels = answer.mask_pixels();
        println!(
            "{name}: at ({x}, {y}), score {:.2}, level {}, {pixels} pixels in {}",
            answer.score,
            LEVEL_NAMES[answer.level],
            path.display()
        );
    }
    Ok(())
}

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [scene, text, out] = arguments.as_slice() else {
        eprintln!("usage: query SCENE TEXT OUT");
        return ExitCode::from(2);
    };
    match query(Path::new(scene), text, Path::new(out)) {
        Ok(()) => ExitCode::SUCCESS,
        // A program that downloads models would do so here.
        Err(Error::MissingModel { model, message }) => {
            eprintln!("{model} is needed: {message}");
            ExitCode::from(2)
        }
        Err(error) => {
            eprintln!("{error}");
            ExitCode::from(error.exit_code())
        }
    }
}
