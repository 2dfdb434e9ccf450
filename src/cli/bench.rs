//! `splatvk bench`
use super::args::{BenchArgs, BenchPart, EditUse};
use super::models::check_text;
use super::print::{listing, print};
use super::progress;
use super::scene;
use crate::bench::{self, Bench, BenchReport, Budget, Workload, compare};
use crate::format::{scene_dir, write_json};
use crate::gpu;
use crate::infer::check::check as check_model;
use crate::infer::installed::inventory;
use crate::infer::{RegionEncoder, Registry};
use crate::run::encoder;
use crate::run::outputs::{WrittenFile, WrittenFiles};
use crate::{Error, Result};
use std::path::Path;

pub fn bench(args: &BenchArgs) -> Result<()> {
    if let Some([a, b]) = args.compare.as_deref() {
        return print(&compare::table(&BenchReport::read(a)?, &BenchReport::read(b)?));
    }
    let budget = check(args)?;
    if let Some(folder) = &args.write_scene {
        let workload = workload(args)?;
        let inputs = [args.scene.as_deref(), args.camera.as_deref()];
        let inputs: Vec<&Path> = inputs.into_iter().flatten().collect();
        let out = WrittenFiles::open(folder, args.force, &inputs)?;
        workload.write(&gpu::open(args.device.as_deref())?, out.folder())?;
        return listing(&out.keep()?, false);
    }
    let has = |part| args.parts.contains(&part);
    if has(BenchPart::Cameras) {
        return cameras(args);
    }
    if has(BenchPart::Masks) {
        return masks(args);
    }
    if has(BenchPart::Models) {
        if args.parts == [BenchPart::Models] && args.json.is_some() {
            return Err(Error::input(
                "--json: bench models prints a table and writes no report; leave --json out",
            ));
        }
        models(&args.registry()?.uncached())?;
        if args.parts == [BenchPart::Models] {
            return Ok(());
        }
    }
    // All input is validated before the first measurement.
    let workload =
        if has(BenchPart::Training) || !args.sweep.is_empty() { Some(workload(args)?) } else { None };
    let queried = if has(BenchPart::Query) { Some(scene_and_encoder(args)?) } else { None };
    let out = report_file(args)?;
    let device = gpu::open(args.device.as_deref())?;
    let mut bench = Bench::new(&device, budget)?;
    if let Some(workload) = &workload {
        if has(BenchPart::Training) {
            bench.training(workload, args.features)?;
        }
        if !args.sweep.is_empty() {
            bench.growth(&args.sweep, workload)?;
        }
    }
    if has(BenchPart::Sort) {
        bench.sort(args.keys)?;
    }
    if let Some((scene, encoder)) = queried {
        let field = scene.language.ok_or_else(|| Error::work("the scene lost its language"))?;
        bench.query((&scene.splats, field, &scene.cameras), encoder, &args.query)?;
    }
    write_report(out, &bench.report)?;
    print(&bench.report.table())
}

/// Validates options beyond clap's checks; returns the budget of each measurement.
fn check(args: &BenchArgs) -> Result<Budget> {
    if !(args.seconds > 0.0 && args.seconds.is_finite()) {
        return Err(Error::input(format!("--seconds {}: give a positive number", args.seconds)));
    }
    if args.repeats == Some(0) {
        return Err(Error::input("--repeats 0: give at least 1"));
    }
    if args.keys == 0 || u32::try_from(args.keys).is_err() {
        return Err(Error::input(format!("--keys {}: give 1 to {}", args.keys, u32::MAX)));
    }
    if args.sweep.contains(&0) {
        return Err(Error::input("--sweep 0: a scene needs at least one splat"));
    }
    if args.query.trim().is_empty() {
        return Err(Error::input("--query: give a few words"));
    }
    bench::check_features(args.features)?;
    Ok(Budget { seconds: args.seconds, repeats: args.repeats })
}

fn workload(args: &BenchArgs) -> Result<Workload> {
    match &args.scene {
        Some(scene) => Workload::load(scene, args.camera.as_deref(), args.sh_degree),
        None => {
            Workload::seeded(args.splats, args.width, args.height, args.sh_degree.unwrap_or(0), args.seed)
        }
    }
}

/// Measures seconds and peak memory per step of every installed network.
fn models(registry: &Registry) -> Result<()> {
    let found = inventory(registry);
    if found.models.is_empty() {
        return Err(Error::input("bench models: no network is installed; see splatvk models list"));
    }
    for model in &found.models {
        print(&check_text(model, Some(&check_model(model)?)))?;
    }
    Ok(())
}

/// Measures photos → cameras on data with ground truth; needs no device.
fn cameras(args: &BenchArgs) -> Result<()> {
    let (registry, out) = data_options(args, "cameras")?;
    let input =
        bench::cameras::PhotoInput { max_size: args.max_size, copies: args.copies, pairs: args.pairs };
    let progress = progress::reporter();
    let mut header = Some(bench::cameras::header());
    let mut show =
        |row: &bench::cameras::CameraRow| print(&(header.take().unwrap_or_default() + &row.text()));
    let report = bench::cameras::measure(&args.data, input, &registry, progress.as_ref(), &mut show)?;
    write_report(out, &report)?;
    print(&report.text())
}

/// Measures photos → masks on data with ground truth; needs no device.
fn masks(args: &BenchArgs) -> Result<()> {
    let (registry, out) = data_options(args, "masks")?;
    let progress = progress::reporter();
    let mut header = Some(bench::masks::header());
    let mut show = |row: &bench::masks::MaskRow| print(&(header.take().unwrap_or_default() + &row.text()));
    let report = bench::masks::measure(&args.data, args.max_size, &registry, progress.as_ref(), &mut show)?;
    write_report(out, &report)?;
    print(&report.text())
}

/// Validates the options of a part that reads folders with ground truth and runs alone.
fn data_options(args: &BenchArgs, part: &str) -> Result<(Registry, Option<WrittenFile>)> {
    if args.parts.len() > 1 {
        return Err(Error::input(format!("bench {part}: runs alone; leave the other parts out")));
    }
    if args.data.is_empty() {
        return Err(Error::input(format!(
            "bench {part}: give folders with ground_truth.json with --data DIR..."
        )));
    }
    Ok((args.registry()?, report_file(args)?))
}

/// Writes the report to the file of `--json`.
fn write_report(out: Option<WrittenFile>, report: &impl serde::Serialize) -> Result<()> {
    out.map_or(Ok(()), |out| out.keep(|file| write_json(file, report)))
}

/// The scene and the text encoder of its space.
fn scene_and_encoder(args: &BenchArgs) -> Result<(scene_dir::Scene, Box<dyn RegionEncoder>)> {
    let Some(path) = &args.scene else {
        return Err(Error::input("bench query: give a scene with language with --scene DIR"));
    };
    let scene = scene::load(path, EditUse::default())?;
    if scene.language.is_none() {
        let path = path.display();
        return Err(Error::input(format!("{path}: the scene has no language; make one with splatvk run")));
    }
    let encoder = encoder::of_scene(&scene, args.registry()?)?;
    Ok((scene, encoder))
}

/// Reserves the file of `--json` before the measurements.
fn report_file(args: &BenchArgs) -> Result<Option<WrittenFile>> {
    let inputs: Vec<&Path> = [args.scene.as_deref(), args.camera.as_deref()].into_iter().flatten().collect();
    args.json.as_deref().map(|file| WrittenFile::open(file, args.force, &inputs)).transpose()
}
