//! `splatvk train`
use super::args::TrainArgs;
use super::kept::report_kept_stages;
use super::print::{ending, print, print_json};
use super::progress;
use crate::run::sources::SourceChoice;
use crate::run::{self, GeometryConfig, Inputs, ReconstructionConfig, RunPlan};
use crate::{Error, Result};
use serde_json::json;

pub fn train(args: &TrainArgs) -> Result<()> {
    let cameras = SourceChoice::with("cameras", &args.cameras);
    let config = ReconstructionConfig {
        geometry: GeometryConfig { init: cameras, ..GeometryConfig::default() },
        training: args.training.clone(),
        language: None,
    };
    let plan = RunPlan {
        inputs: Inputs {
            photos: vec![args.images.clone()],
            views: args.views,
            photo_masks: args.saving.photo_masks.clone(),
            points: args.points.clone(),
            ..Inputs::default()
        },
        config,
        machine: args.device.machine(),
        output: args.saving.destination(args.out.clone()),
    };
    let progress = progress::reporter();
    let outcome = run::run(&plan, progress.as_ref())?;
    report_kept_stages(progress.as_ref());
    match args.device.json {
        true => {
            let record = serde_json::to_value(run::run_record(&outcome));
            let record = record.map_err(|e| Error::work(format!("run record: {e}")))?;
            print_json(&json!({ "out": plan.output.out, "run": record }))?;
        }
        false => print(&(run::closing_table(&outcome) + &ending(&plan.output.out)))?,
    }
    Ok(())
}
