//! `splatlab alignment`
use super::args::AlignmentArgs;
use crate::alignment::{Agreement, FAULTS, STEPS, Scored, TruthScene};
use crate::{Error, Result};
use rayon::prelude::*;
use serde_json::json;
use splatvk::cli::print::{print, print_json};
use splatvk::cli::progress;
use std::fmt::Write;

/// Width and height of the photos, pixels.
const SIZE: (u32, u32) = (320, 240);

pub fn alignment(args: &AlignmentArgs) -> Result<()> {
    if args.scenes == 0 {
        return Err(Error::input("--scenes: at least 1"));
    }
    let progress = progress::reporter();
    progress.begin("scenes", FAULTS.len() as u64);
    let seeds: Vec<u64> = (0..args.scenes).map(|k| args.first + k).collect();
    let scenes = seeds.par_iter().map(|seed| TruthScene::new(*seed, SIZE)).collect::<Result<Vec<_>>>()?;
    let mut all: Vec<Vec<Scored>> = Vec::new();
    for (k, fault) in FAULTS.iter().enumerate() {
        progress.check()?;
        all.push(scenes.par_iter().map(|scene| scene.score(fault)).collect::<Result<Vec<_>>>()?);
        progress.step(k as u64 + 1, fault.name);
    }
    progress.end();
    if args.json {
        let steps = STEPS.map(|(name, _)| name);
        let faults: Vec<_> =
            FAULTS.iter().zip(&all).map(|(f, scored)| json!({ "fault": f.name, "scenes": scored })).collect();
        return print_json(&json!({ "steps": steps, "size": SIZE, "faults": faults }));
    }
    print(&table(&all))
}

/// Mean adjusted Rand index per fault and steps, of level l and of the mean of s and m, and the mean
/// change by each step over the scenes, with its standard error.
fn table(all: &[Vec<Scored>]) -> String {
    let rand = |a: &Agreement| a.rand;
    let mut out = String::new();
    for (title, of) in [
        ("things (level l)", &(|a: &[Agreement; 3]| rand(&a[2])) as &dyn Fn(&[Agreement; 3]) -> f64),
        ("parts (levels s and m)", &|a: &[Agreement; 3]| 0.5 * (rand(&a[0]) + rand(&a[1]))),
    ] {
        let _ = write!(out, "\n{title}: adjusted Rand index by steps\n{:36}", "error");
        STEPS.iter().for_each(|(name, _)| out.push_str(&format!("{name:>9}")));
        out.push_str("   2 adds to 1, 3       3 adds to 1, 2\n");
        for (fault, scored) in FAULTS.iter().zip(all) {
            let column = |k: usize| scored.iter().map(move |s| of(&s.steps[k])).collect::<Vec<f64>>();
            let columns: Vec<Vec<f64>> = (0..STEPS.len()).map(column).collect();
            let _ = write!(out, "{:36}", fault.name);
            columns.iter().for_each(|c| out.push_str(&format!("{:>9.3}", mean(c))));
            for (with, without) in [(3, 2), (3, 1)] {
                let change: Vec<f64> =
                    columns[with].iter().zip(&columns[without]).map(|(a, b)| a - b).collect();
                let spread = change.iter().map(|c| (c - mean(&change)).powi(2)).sum::<f64>();
                let error = spread.sqrt() / change.len() as f64;
                let _ = write!(out, "   {:>+8.4} ± {error:.4}", mean(&change));
            }
            out.push('\n');
        }
    }
    out
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len().max(1) as f64
}
