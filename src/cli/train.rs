//! `splatvk train`
use super::args::TrainArgs;
use super::plan;
use super::print::{print, print_json};
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
        iterations: args.iterations,
        sh_degree: args.making.sh_degree,
        seed: args.seed,
        max_size: plan::max_size(args.max_size)?,
        device: args.device.device.clone(),
        deterministic: args.deterministic,
        models: args.device.models.clone(),
        provider: args.device.provider.clone(),
    };
    let trained = run(&plan, progress::reporter().as_ref())?;
    if args.device.json {
        return print_json(&json!({ "out": plan.out, "run": trained.record }));
    }
    print(&trained.table)
}
