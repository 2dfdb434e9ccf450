//! One attempt at a row: its key, its scene and its exports. It runs in a process of its own, whose
//! current folder is that of the manifest.
use super::manifest::{Row, inputs};
use super::store;
use crate::cli::args::ExportArgs;
use crate::cli::progress;
use crate::cli::{export, print};
use crate::files::{self, content_hash};
use crate::photo;
use crate::run::{self, Machine, RunOutcome, RunPlan};
use crate::{Error, Result};
use clap::{Args, Parser};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use sha2::{Digest, Sha256};
use std::collections::BTreeSet;
use std::io::Read;
use std::path::{Path, PathBuf};

/// Version of the key: other contents of it get another number.
const KEY_VERSION: u32 = 1;
/// Options of a row beside those of a configuration.
const INPUT_OPTIONS: [&str; 3] = ["views", "photo_masks", "points"];

/// `splatvk batch-row`
#[derive(Debug, Args)]
pub struct BatchRowArgs {
    /// Folder of the result, which must not exist: scene, exports, and _SUCCESS.json last
    #[arg(long, value_name = "DIR", required_unless_present = "key")]
    pub out: Option<PathBuf>,
    /// Print the key of the row and the files that it reads; no device is opened
    #[arg(long, conflicts_with = "out")]
    pub key: bool,
    /// Vulkan device
    #[arg(long, value_name = "DEVICE")]
    pub device: Option<String>,
    /// Largest side of the working images, where an attempt ran out of memory; the key stays
    #[arg(long, value_name = "N", value_parser = crate::run::config::whole::<usize>(photo::SMALLEST_SIDE as u64..))]
    pub max_size: Option<usize>,
}

/// A file that a row reads.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct InputFile {
    /// Below the folder that the row names, or the name of the file.
    pub path: String,
    /// Bytes.
    pub bytes: u64,
    /// Lower-case hexadecimal digits.
    pub sha256: String,
}

/// Key of a row, and its meaning.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct RowKey {
    /// SHA-256 of contents, options and versions.
    pub key: String,
    /// Version of the program.
    pub splatvk: String,
    /// Photos and other files of the row.
    pub inputs: Vec<InputFile>,
    /// Photos that were found; 0 for a video.
    pub photos: usize,
}

/// Reads a row from standard input; prints its key, or makes its result.
pub fn batch_row(args: &BatchRowArgs) -> Result<()> {
    let mut text = String::new();
    std::io::stdin().read_to_string(&mut text).map_err(Error::io("standard input"))?;
    let row: Row = files::parse_json(text.as_bytes()).map_err(|e| Error::input(format!("row: {e}")))?;
    let planned = PlannedRow::new(&row)?;
    match &args.out {
        None => print::print_json(&to_json(&planned.key()?)?),
        Some(out) => planned.make(args, out),
    }
}

/// A row whose options, queries and exports are valid.
struct PlannedRow<'a> {
    row: &'a Row,
    plan: RunPlan,
}

impl PlannedRow<'_> {
    fn new(row: &Row) -> Result<PlannedRow<'_>> {
        let mut plan = RunPlan::with_options(&row.options, &INPUT_OPTIONS)?;
        plan.inputs.photos = inputs(row)?;
        plan.inputs.queries.clone_from(&row.queries);
        plan.inputs.check()?;
        let planned = PlannedRow { row, plan };
        planned.exports(Path::new(""))?;
        Ok(planned)
    }

    /// The exports of a scene in `folder`: `glb`, `colmap`, or `kitchen.spz`.
    fn exports(&self, folder: &Path) -> Result<Vec<ExportArgs>> {
        let mut names = BTreeSet::new();
        let parsed = self.row.exports.iter().map(|name| {
            let wrong = |e: &str| Error::input(format!("export {name}: {e}"));
            if name.is_empty() || name.starts_with(['.', '-']) || name.contains(['/', '\\']) {
                return Err(wrong("give a format, or a name with its ending"));
            }
            let file = if name.contains('.') || run::export::is_folder(name) {
                name.clone()
            } else if name == "transforms" {
                "transforms.json".to_owned()
            } else {
                format!("{}.{name}", self.row.id)
            };
            if !names.insert(file.to_lowercase()) {
                return Err(wrong("named twice"));
            }
            let out = folder.join("exports").join(&file);
            let mut line = vec!["export".into(), folder.join("scene").into_os_string()];
            line.extend(["--out".into(), out.into_os_string()]);
            if !name.contains('.') {
                line.extend(["--format".into(), name.into()]);
            }
            let args = ExportLine::try_parse_from(line)
                .map_err(|e| {
                    wrong(e.to_string().lines().next().unwrap_or_default().trim_start_matches("error: "))
                })?
                .args;
            args.check()?;
            Ok(args)
        });
        parsed.collect()
    }

    fn key(&self) -> Result<RowKey> {
        let mut inputs = Vec::new();
        for path in self.plan.read() {
            digest(path, &mut inputs)?;
        }
        inputs.sort();
        let found = photo::find(&self.plan.inputs.photos)?;
        if let ([photo], []) = (found.photos.as_slice(), found.videos.as_slice()) {
            let photo = photo.display();
            return Err(Error::input(format!(
                "{photo}: only one photo; a scene needs two or more of one place"
            )));
        }
        if found.videos.is_empty() {
            photo::photo_count(found.photos.len(), self.plan.inputs.views)?;
        }
        for photo in &found.photos {
            photo::dimensions(photo)?;
        }
        let models = run::models_used(&self.plan)?;
        let models: Vec<_> = models.iter().map(|m| json!([m.name, m.sha256])).collect();
        let contents: Vec<_> = inputs.iter().map(|i| json!([i.path, i.sha256])).collect();
        let splatvk = env!("CARGO_PKG_VERSION");
        let whole = json!([
            KEY_VERSION,
            splatvk,
            self.row.options,
            self.row.queries,
            self.row.exports,
            contents,
            models
        ]);
        let key = files::hex(&Sha256::digest(whole.to_string()));
        Ok(RowKey { key, splatvk: splatvk.to_owned(), inputs, photos: found.photos.len() })
    }

    fn make(mut self, args: &BatchRowArgs, out: &Path) -> Result<()> {
        let RowKey { key, splatvk, inputs, .. } = self.key()?;
        std::fs::create_dir(out).map_err(Error::unwritable(out))?;
        self.plan.machine = Machine { device: args.device.clone(), ..Machine::default() };
        self.plan.output.out = out.join("scene");
        self.plan.config.training.max_size = args.max_size.or(self.plan.config.training.max_size);
        let progress = progress::reporter();
        let outcome = run::run(&self.plan, progress.as_ref())?;
        let exports = self.exports(out)?;
        if !exports.is_empty() {
            let folder = out.join("exports");
            std::fs::create_dir(&folder).map_err(Error::unwritable(&folder))?;
        }
        exports.iter().try_for_each(|args| export::write(args).map(drop))?;
        let mut written = Vec::new();
        digest(out, &mut written)?;
        written.sort();
        let mut record = json!({
            "id": self.row.id, "key": key, "splatvk": splatvk, "at": ".",
            "input": self.row.input, "options": self.row.options, "queries": self.row.queries,
            "exports": self.row.exports, "inputs": inputs, "files": written,
        });
        figures(&outcome, &mut record);
        if let Some(size) = args.max_size {
            record["smaller_max_size"] = size.into();
        }
        store::write(&out.join(store::SUCCESS), format!("{record:#}\n").as_bytes())
    }
}

/// Figures of a scene for the table of a batch.
fn figures(outcome: &RunOutcome, record: &mut Value) {
    let run = run::run_record(outcome);
    let psnr = &outcome.psnr;
    record["device"] = json!({
        "name": outcome.device.name, "uuid": outcome.device.uuid, "pci": outcome.device.pci,
    });
    record["seconds"] = outcome.seconds.into();
    record["photos"] = outcome.photos.len().into();
    record["left_out"] = json!(outcome.left_out.iter().map(|l| &l.photo).collect::<Vec<_>>());
    record["psnr"] = json!((!psnr.is_empty()).then(|| psnr.iter().sum::<f64>() / psnr.len() as f64));
    record["splats"] = outcome.splats.len().into();
    let worst = run.statistics.geometry.optics.iter().map(|o| o.rotation_sigma_degrees).reduce(f64::max);
    record["rotation_sigma_degrees"] = json!(worst);
    let answers = run.statistics.other.get("queries").and_then(Value::as_array);
    let short = |a: &Value| {
        let things = a["instances"].as_array().map_or(0, Vec::len);
        json!({
            "text": a["text"], "presence": a["presence"], "p_value": a["p_value"], "found": a["found"],
            "things": things,
        })
    };
    record["answers"] = answers.into_iter().flatten().map(short).collect();
    record["warnings"] = json!(outcome.warnings);
}

/// The parser of one export.
#[derive(Parser)]
struct ExportLine {
    #[command(flatten)]
    args: ExportArgs,
}

/// Digests of a file, or of the files of a folder; hidden ones are left out.
fn digest(path: &Path, into: &mut Vec<InputFile>) -> Result<()> {
    let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    if !path.is_dir() {
        return digest_file(path, name, into);
    }
    let mut folders = vec![(path.to_path_buf(), String::new())];
    while let Some((folder, below)) = folders.pop() {
        for entry in std::fs::read_dir(&folder).map_err(Error::io(&folder))? {
            let entry = entry.map_err(Error::io(&folder))?;
            let name = entry.file_name().to_string_lossy().into_owned();
            if name.starts_with('.') {
                continue;
            }
            let name = format!("{below}{name}");
            let kind = entry.file_type().map_err(Error::io(entry.path()))?;
            // A link to a folder may lead in a circle.
            if kind.is_dir() {
                folders.push((entry.path(), format!("{name}/")));
            } else if entry.path().is_file() {
                digest_file(&entry.path(), name, into)?;
            }
        }
    }
    Ok(())
}

fn digest_file(path: &Path, name: String, into: &mut Vec<InputFile>) -> Result<()> {
    let bytes = std::fs::metadata(path).map_err(Error::io(path))?.len();
    let sha256 = content_hash(path).map_err(Error::io(path))?;
    into.push(InputFile { path: name, bytes, sha256 });
    Ok(())
}

fn to_json(value: &impl Serialize) -> Result<Value> {
    serde_json::to_value(value).map_err(|e| Error::work(format!("JSON: {e}")))
}
