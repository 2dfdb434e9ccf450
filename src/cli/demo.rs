//! `splatvk demo`: four photos that the program carries, their scene, and words in it.
use super::args::{DeviceArgs, EditUse};
use super::print::{print, print_json};
use super::progress;
use super::view::{Content, Shown};
use crate::files;
use crate::gpu;
use crate::progress::Progress;
use crate::report::{duration, shell_quoted};
use crate::run::{self, Destination, Inputs, ReconstructionConfig, RunPlan, TrainingConfig, preview};
use crate::{Error, Result};
use clap::Args;
use splatvk_gpu::DeviceInfo;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;

/// Rendered for this project; objects from robosuite (MIT).
const PHOTOS: [(&str, &[u8]); 4] = [
    ("table_1.jpg", include_bytes!("../../tests/data/breakfast/images/train_00.jpg")),
    ("table_2.jpg", include_bytes!("../../tests/data/breakfast/images/train_01.jpg")),
    ("table_3.jpg", include_bytes!("../../tests/data/breakfast/images/train_02.jpg")),
    ("table_4.jpg", include_bytes!("../../tests/data/breakfast/images/train_03.jpg")),
];
/// Three things on the table, and one that is not there.
const QUERIES: [&str; 4] = ["yellow lemon", "loaf of bread", "blue mug", "green apple"];

/// Longer side of the working images on a CPU device, pixels: a quarter of the work of the photos'.
const CPU_SIZE: usize = 320;
/// Training steps on a CPU device.
const CPU_STEPS: usize = 90;
/// Seconds on a CPU device with one core, the first time: compiling shaders is a fifth of them.
const CPU_CORE_SECONDS: f64 = 170.0;
/// Seconds on a GPU: an H200 takes less, an integrated one more.
const GPU_SECONDS: f64 = 15.0;

/// `splatvk demo`
#[derive(Debug, Args)]
pub struct DemoArgs {
    /// Folder for the photos and the scene
    #[arg(long, value_name = "DIR", default_value = "splatvk-demo")]
    pub out: PathBuf,
    /// Make the scene, answer four words here, and end: no page, no browser
    #[arg(long)]
    pub no_open: bool,
    /// Make the scene again, if it is there
    #[arg(long)]
    pub force: bool,
    /// Device and models
    #[command(flatten)]
    pub device: DeviceArgs,
}

pub fn demo(args: &DemoArgs) -> Result<()> {
    let scene = args.out.join("scene");
    let made = scene.join("run.json").is_file() && !args.force;
    let show = !args.no_open && !args.device.json;
    if made && show {
        print(&format!("{} was made before (--force makes it again)\n", scene.display()))?;
    }
    let plan = (!made || !show).then(|| plan(args, &scene)).transpose()?;
    if !show {
        return plan.as_ref().map_or(Ok(()), |plan| make(args, plan));
    }
    std::thread::scope(|scope| {
        let run = plan.as_ref().map(|plan| scope.spawn(|| make(args, plan)));
        let ended = || run.as_ref().is_none_or(std::thread::ScopedJoinHandle::is_finished);
        while !ended() && preview::of_running(&scene).is_none() {
            std::thread::sleep(Duration::from_millis(200));
        }
        // The thread's error is the reason why there is nothing to show.
        let (finished, running) = match run {
            Some(run) if run.is_finished() => (Some(run), None),
            running => (None, running),
        };
        joined(finished)?;
        let queries = QUERIES.map(str::to_owned);
        let content = Content {
            path: &scene,
            edits: EditUse::default(),
            device: &args.device,
            suggested: &queries,
            budget: usize::MAX,
            mesh: None,
        };
        let shown = Shown::open(0, content)?;
        open_browser(&shown.url());
        shown.serve(false)?;
        joined(running)
    })
}

/// The result of the thread that makes the scene.
fn joined(run: Option<std::thread::ScopedJoinHandle<'_, Result<()>>>) -> Result<()> {
    let ended = run.map(std::thread::ScopedJoinHandle::join).unwrap_or(Ok(Ok(())));
    ended.unwrap_or_else(|_| Err(Error::work("the run of the demo ended early")))
}

/// Writes the photos, prints how long the run takes, and returns the plan of the run.
fn plan(args: &DemoArgs, scene: &Path) -> Result<RunPlan> {
    let survey = splatvk_gpu::survey(&gpu::options(args.device.device.as_deref()))?;
    let info = survey.chosen?;
    let photos = args.out.join("photos");
    // A folder of the user's own photos is no place for these.
    let is_photo = |name: &str| PHOTOS.iter().any(|(photo, _)| name.strip_prefix("photos/") == Some(photo));
    let own = |name: &str, _: bool| {
        ["photos", "scene"].contains(&name) || name.starts_with("scene/") || is_photo(name)
    };
    let others = if args.out.exists() { files::foreign(&args.out, &own) } else { Vec::new() };
    if !others.is_empty() {
        let out = args.out.display();
        return Err(Error::input(format!("{out}: holds {}; choose another --out", files::listed(&others))));
    }
    std::fs::create_dir_all(&photos).map_err(Error::unwritable(&photos))?;
    for (name, bytes) in PHOTOS {
        let place = photos.join(name);
        std::fs::write(&place, bytes).map_err(Error::unwritable(&place))?;
    }
    let text = format!(
        "Four photos of a breakfast table, in {}, become a scene.\n{}\n",
        photos.display(),
        about(&info)
    );
    if !args.device.json {
        print(&text)?;
    }
    let training = TrainingConfig {
        max_size: info.is_cpu.then_some(CPU_SIZE),
        iterations: info.is_cpu.then_some(CPU_STEPS),
        preset: Some(crate::fit::Preset::Draft),
        ..TrainingConfig::default()
    };
    let config = ReconstructionConfig { training, ..ReconstructionConfig::default() };
    let machine = args.device.machine();
    let config = config.resolved(&crate::infer::installed::inventory(&machine.registry()?))?;
    Ok(RunPlan {
        inputs: Inputs {
            photos: vec![photos],
            queries: QUERIES.map(str::to_owned).to_vec(),
            ..Inputs::default()
        },
        config,
        machine,
        output: Destination { out: scene.to_path_buf(), force: args.force, ..Destination::default() },
    })
}

/// The device and the time that it takes.
fn about(info: &DeviceInfo) -> String {
    if !info.is_cpu {
        return format!("On {}: about {}.", info.name, duration(GPU_SECONDS));
    }
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let seconds = (CPU_CORE_SECONDS / cores.min(8) as f64).max(GPU_SECONDS);
    format!(
        "On the processor ({cores} cores): about {}. No graphics driver was found; with one it takes seconds (splatvk doctor).",
        duration(seconds)
    )
}

/// Makes the scene and prints the answers.
fn make(args: &DemoArgs, plan: &RunPlan) -> Result<()> {
    let reporter = progress::reporter();
    let outcome = run::run(plan, reporter.as_ref() as &dyn Progress)?;
    if args.device.json {
        let record = serde_json::to_value(run::run_record(&outcome));
        return print_json(&record.map_err(|e| Error::work(format!("run record: {e}")))?);
    }
    let mut text = format!("Done in {}.\n", duration(outcome.seconds));
    for answer in outcome.language.iter().flat_map(|l| &l.answers) {
        text += &format!("  {:15} {}\n", answer.text, answer.verdict());
    }
    if args.no_open {
        text += &format!("Look around:     splatvk view {}\n", shell_quoted(&plan.output.out));
    }
    text += "Your own photos: splatvk run FOLDER\n";
    print(&text)
}

/// Opens an address with the program of the desktop, where there is one.
fn open_browser(url: &str) {
    let program = if cfg!(target_os = "macos") {
        "open"
    } else if cfg!(windows) {
        "explorer"
    } else {
        "xdg-open"
    };
    let quiet = Command::new(program)
        .arg(url)
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn();
    // The address is printed in any case. Other users of the machine see it among the arguments of
    // processes; the photos and the scene of the demo are public.
    if let Ok(mut child) = quiet {
        std::thread::spawn(move || child.wait());
    }
}
