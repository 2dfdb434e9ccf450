//! `splatvk train`
use super::args::TrainArgs;
use super::kept::tell_of_kept_stages;
use super::plan;
use super::print::{ending, print, print_json};
use super::progress;
use crate::Result;
use crate::run::train::{TrainPlan, train as run};
use serde_json::json;

pub fn train(args: &TrainArgs) -> Result<()> {
    let plan = TrainPlan {
        images: args.images.clone(),
        cameras: args.cameras.clone(),
        views: args.views,
        points: args.points.clone(),
        out: args.out.clone(),
        force: args.making.force,
        photo_masks: args.making.photo_masks.clone(),
        resume: args.making.resume,
        checkpoint_seconds: args.making.checkpoint_seconds,
        preset: args.making.preset.map(plan::preset),
        iterations: args.making.iterations,
        sh_degree: args.making.sh_degree,
        seed: args.making.seed,
        max_size: args.making.max_size,
        device: args.device.device.clone(),
        deterministic: args.making.deterministic,
        models: args.device.models.clone(),
        provider: args.device.provider.clone(),
    };
    let progress = progress::reporter();
    let trained = run(&plan, progress.as_ref())?;
    match args.device.json {
        true => print_json(&json!({ "out": plan.out, "run": trained.record }))?,
        false => print(&(trained.table + &ending(&plan.out)))?,
    }
    tell_of_kept_stages(progress.as_ref());
    Ok(())
}
