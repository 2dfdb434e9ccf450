//! Networks that no public ONNX file holds: their checkpoint is exported by a script of
//! `tools/export`, which this program carries, in a Python environment that exists only meanwhile.
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

/// The folders of an export below the one of its work.
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

/// One command of an export: what it is for, and its words.
struct Step {
    name: &'static str,
    words: Vec<String>,
}

/// The commands of an export as a shell would take them, in order; what `--dry-run` shows.
pub fn commands(recipe: &Recipe, work: &Path, out: &Path) -> Vec<String> {
    steps(recipe, &Places::of(work, out)).into_iter().map(|s| s.words.join(" ")).collect()
}

fn steps(recipe: &Recipe, at: &Places) -> Vec<Step> {
    let text = |p: &Path| p.display().to_string();
    let python = text(&at.environment.join("bin/python"));
    let pip = |more: &[&str], packages: &[&String]| {
        let fixed = [python.as_str(), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"];
        fixed
            .iter()
            .chain(more)
            .map(|w| w.to_string())
            .chain(packages.iter().map(|p| p.to_string()))
            .collect()
    };
    let words = |list: &[&str]| list.iter().map(|w| w.to_string()).collect::<Vec<_>>();
    let mut steps =
        vec![Step { name: "environment", words: words(&["python3", "-m", "venv", &text(&at.environment)]) }];
    let packages: Vec<&String> = common_packages().iter().chain(&recipe.packages).collect();
    steps.push(Step { name: "packages", words: pip(&[], &packages) });
    if !recipe.bare_packages.is_empty() {
        let bare: Vec<&String> = recipe.bare_packages.iter().collect();
        steps.push(Step { name: "packages", words: pip(&["--no-deps"], &bare) });
    }
    if let Some(code) = &recipe.code {
        let flags =
            ["git", "clone", "--quiet", "--depth", "1", "--recurse-submodules", "--shallow-submodules"];
        let mut clone = words(&flags);
        clone.extend([code.clone(), text(&at.code)]);
        steps.push(Step { name: "code", words: clone });
    }
    let mut export = vec![python, text(&at.scripts.join(&recipe.script))];
    export.extend(recipe.arguments.iter().cloned());
    export.extend(["--out".to_owned(), text(&at.out)]);
    steps.push(Step { name: "export", words: export });
    steps
}

/// Downloads the checkpoints and writes the model's files with them.
pub(super) fn export(
    entry: &CatalogueEntry,
    recipe: &Recipe,
    staging: &Staging,
    client: &Client,
    progress: &dyn Progress,
) -> Result<Vec<Fetched>> {
    let at = Places::of(&staging.work(), &staging.model());
    let mut weights = Vec::new();
    for source in &recipe.weights {
        let to = at.work.join(&source.name);
        weights.push(client.download(source, entry.ceiling(), &at.work, &to, progress)?);
    }
    // What a killed export left: cheap to make again next to finding out whether it is whole.
    staging.clear_model()?;
    remove(&at)?;
    let done = make(recipe, &at, progress);
    let removed = remove(&at);
    done.and(removed).map(|()| weights)
}

fn make(recipe: &Recipe, at: &Places, progress: &dyn Progress) -> Result<()> {
    std::fs::create_dir_all(&at.scripts).map_err(Error::unwritable(&at.scripts))?;
    for (name, text) in SCRIPTS {
        let path = at.scripts.join(name);
        std::fs::write(&path, text).map_err(Error::unwritable(&path))?;
    }
    for step in steps(recipe, at) {
        progress.begin(step.name, 1);
        run(&step, at, progress)?;
        progress.step(1, "");
        progress.end();
    }
    Ok(())
}

/// Environment, scripts and code; checkpoints stay until the model is installed.
fn remove(at: &Places) -> Result<()> {
    for folder in [&at.environment, &at.scripts, &at.code].into_iter().filter(|f| f.exists()) {
        std::fs::remove_dir_all(folder).map_err(Error::io(folder))?;
    }
    Ok(())
}

fn run(step: &Step, at: &Places, progress: &dyn Progress) -> Result<()> {
    let Some((program, arguments)) = step.words.split_first() else { return Ok(()) };
    let mut child = Command::new(program)
        .args(arguments)
        // Checkpoints are named without their folder.
        .current_dir(&at.work)
        .env("PYTHONPATH", &at.code)
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
    // Read on a thread of its own, or a full pipe would stop the child.
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
            // Commands of minutes; Ctrl-C should seem to act at once.
            None => std::thread::sleep(Duration::from_millis(100)),
        }
    };
    let said = reader.join().unwrap_or_default();
    if status.success() {
        return Ok(());
    }
    let last = said.lines().rev().find(|l| !l.trim().is_empty()).unwrap_or("it says nothing");
    Err(Error::work(format!("{}: {} failed: {}", step.name, step.words.join(" "), last.trim())))
}
