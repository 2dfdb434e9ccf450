//! `splatvk bench`
use super::args::BenchArgs;
use super::print;
use crate::bench::{self, Budget, Options, Report, Workload, compare};
use crate::format::write_json;
use crate::gpu::Device;
use crate::{Error, Result};
use std::path::Path;

pub fn bench(args: &BenchArgs) -> Result<()> {
    if let Some([a, b]) = args.compare.as_deref() {
        return print(&compare::table(&Report::read(a)?, &Report::read(b)?));
    }
    let options = options(args)?;
    let workload = workload(args)?;
    if let Some(folder) = &args.write_scene {
        let files = workload.write(folder)?;
        return print(&files.map(|f| format!("{}\n", f.display())).concat());
    }
    writable(args.json.as_deref())?;
    let device = Device::open(args.device.as_deref())?;
    let report = bench::training(&device, &workload, &options)?;
    if let Some(file) = &args.json {
        write_json(file, &report)?;
    }
    print(&report.table())
}

fn options(args: &BenchArgs) -> Result<Options> {
    if !(args.seconds > 0.0 && args.seconds.is_finite()) {
        return Err(Error::input(format!("--seconds {}: give a positive number", args.seconds)));
    }
    if args.repeats == Some(0) {
        return Err(Error::input("--repeats 0: give at least 1"));
    }
    bench::check_features(args.features)?;
    let budget = Budget { seconds: args.seconds, repeats: args.repeats };
    Ok(Options { budget, features: args.features })
}

fn workload(args: &BenchArgs) -> Result<Workload> {
    match &args.scene {
        Some(scene) => Workload::load(scene, args.camera.as_deref(), args.sh_degree),
        None => {
            Workload::seeded(args.splats, args.width, args.height, args.sh_degree.unwrap_or(0), args.seed)
        }
    }
}

/// Finds out before the measurements take their time whether the result can be kept.
fn writable(file: Option<&Path>) -> Result<()> {
    let Some(file) = file else { return Ok(()) };
    std::fs::File::create(file).map(drop).map_err(|e| {
        Error::input(format!("--json {}: cannot write there ({e}); choose another file", file.display()))
    })
}
