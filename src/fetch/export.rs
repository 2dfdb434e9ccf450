//! Export of networks without a public ONNX file: a script of `tools/export`, included in this
//! program, exports their checkpoint in a temporary Python environment.
use std::io::Read;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;

use super::download::{Client, Fetched};
use super::staging::Staging;
use crate::error::words;
use crate::infer::catalogue::{CatalogueEntry, Recipe, common_packages};
use crate::progress::Progress;
use crate::{Error, Result};

macro_rules! scripts {
    ($($name:literal),*) => {
        [$(($name, include_str!(concat!("../../tools/export/", $name)))),*]
    };
}

const SCRIPTS: [(&str, &str); 12] = scripts![
    "common.py",
    "multiview.py",
    "export_clip.py",
    "export_da3.py",
    "export_dust3r.py",
    "export_mast3r.py",
    "export_mobile_sam.py",
    "export_roma.py",
    "export_romav2.py",
    "export_sam.py",
    "export_sam2.py",
    "export_vggt.py"
];

/// Folders of an export below its work folder.
struct Places {
    work: PathBuf,
    environment: PathBuf,
    scripts: PathBuf,
    code: PathBuf,
    out: PathBuf,
}

impl Places {
    fn of(work: &Path, out: &Path) -> Places {
        Places {
            work: work.to_path_buf(),
            environment: work.join("environment"),
            scripts: work.join("scripts"),
            code: work.join("code"),
            out: out.to_path_buf(),
        }
    }
}

/// One command of an export.
struct Step {
    name: &'static str,
    words: Vec<String>,
}

/// Commands of an export as a shell would take them, in order, for `--dry-run`.
pub fn commands(recipe: &Recipe, work: &Path, out: &Path) -> Vec<String> {
    steps(recipe, &Places::of(work, out)).into_iter().map(|s| s.words.join(" ")).collect()
}

fn steps(recipe: &Recipe, places: &Places) -> Vec<Step> {
    let python = text(&places.environment.join("bin/python"));
    let pip = |more: &[&str], packages: &[&String]| {
        let fixed = [python.as_str(), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"];
        fixed
            .iter()
            .chain(more)
            .map(|w| w.to_string())
            .chain(packages.iter().map(|p| p.to_string()))
            .collect()
    };
    let environment = ["python3", "-m", "venv", &text(&places.environment)];
    let mut steps = vec![Step { name: "environment", words: owned(&environment) }];
    let packages: Vec<&String> = common_packages().iter().chain(&recipe.packages).collect();
    steps.push(Step { name: "packages", words: pip(&[], &packages) });
    if !recipe.bare_packages.is_empty() {
        let bare: Vec<&String> = recipe.bare_packages.iter().collect();
        steps.push(Step { name: "packages", words: pip(&["--no-deps"], &bare) });
    }
    if let Some(code) = &recipe.code {
        let flags =
            ["git", "clone", "--quiet", "--depth", "1", "--recurse-submodules", "--shallow-submodules"];
        let mut clone = owned(&flags);
        clone.extend([code.clone(), text(&places.code)]);
        steps.push(Step { name: "code", words: clone });
    }
    let mut export = vec![python, text(&places.scripts.join(&recipe.script))];
    export.extend(recipe.arguments.iter().cloned());
    export.extend(["--out".to_owned(), text(&places.out)]);
    steps.push(Step { name: "export", words: export });
    steps
}

fn text(path: &Path) -> String {
    path.display().to_string()
}

fn owned(words: &[&str]) -> Vec<String> {
    words.iter().map(|w| w.to_string()).collect()
}

/// Downloads the checkpoints and writes the model's files with them.
pub(super) fn export(
    entry: &CatalogueEntry,
    recipe: &Recipe,
    staging: &Staging,
    client: &Client,
    progress: &dyn Progress,
) -> Result<Vec<Fetched>> {
    let places = Places::of(&staging.work(), &staging.model());
    let mut weights = Vec::new();
    for source in &recipe.weights {
        let to = places.work.join(&source.name);
        weights.push(client.download(source, entry.ceiling(), &places.work, &to, progress)?);
    }
    // A killed export is made again: cheaper than to verify whether it is complete.
    staging.clear_model()?;
    remove(&places)?;
    let done = make(recipe, &places, progress);
    let removed = remove(&places);
    done.and(removed).map(|()| weights)
}

fn make(recipe: &Recipe, places: &Places, progress: &dyn Progress) -> Result<()> {
    std::fs::create_dir_all(&places.scripts).map_err(Error::unwritable(&places.scripts))?;
    for (name, text) in SCRIPTS {
        let path = places.scripts.join(name);
        std::fs::write(&path, text).map_err(Error::unwritable(&path))?;
    }
    for step in steps(recipe, places) {
        progress.begin(step.name, 1);
        run(&step, places, progress)?;
        progress.step(1, "");
        progress.end();
    }
    Ok(())
}

/// Removes environment, scripts and code; checkpoints stay until the model is installed.
fn remove(places: &Places) -> Result<()> {
    for folder in [&places.environment, &places.scripts, &places.code].into_iter().filter(|f| f.exists()) {
        std::fs::remove_dir_all(folder).map_err(Error::io(folder))?;
    }
    Ok(())
}

fn run(step: &Step, places: &Places, progress: &dyn Progress) -> Result<()> {
    let Some((program, arguments)) = step.words.split_first() else { return Ok(()) };
    let mut child = Command::new(program)
        .args(arguments)
        // Checkpoints are named without their folder.
        .current_dir(&places.work)
        .env("PYTHONPATH", &places.code)
        .env("PYTHONWARNINGS", "ignore")
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .map_err(|e| {
            Error::missing(format!(
                "{program}: cannot be started ({}); an export needs Python 3.9 or newer with venv, and git",
                words(&e)
            ))
        })?;
    // A separate thread reads, because a full pipe would block the child.
    let pipe = child.stderr.take();
    let reader = std::thread::spawn(move || {
        let mut text = Vec::new();
        pipe.map(|mut p| p.read_to_end(&mut text));
        String::from_utf8_lossy(&text).into_owned()
    });
    let status = loop {
        if progress.cancelled() {
            let _ = child.kill().and_then(|()| child.wait());
            return Err(Error::Cancelled);
        }
        match child.try_wait().map_err(Error::io(program))? {
            Some(status) => break status,
            // Commands take minutes; Ctrl-C is to act at once.
            None => std::thread::sleep(Duration::from_millis(100)),
        }
    };
    let errors = reader.join().unwrap_or_default();
    if status.success() {
        return Ok(());
    }
    let last = errors.lines().rev().find(|l| !l.trim().is_empty()).unwrap_or("it says nothing");
    Err(Error::work(format!("{}: {} failed: {}", step.name, step.words.join(" "), last.trim())))
}
