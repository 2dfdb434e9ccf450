//! `splatlab alignment`
use super::args::AlignmentArgs;
use crate::alignment::{Agreement, FAULTS, Fault, SPACES, STEPS, Scored, TruthScene};
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
    if args.spaces {
        let mut rows = Vec::new();
        for (k, name) in SPACE_FAULTS.iter().enumerate() {
            progress.check()?;
            let Some(fault) = Fault::named(name) else { continue };
            let scored = scenes.par_iter().map(|scene| scene.score_spaces(&fault));
            rows.push((*name, scored.collect::<Result<Vec<_>>>()?));
            progress.step(k as u64 + 1, name);
        }
        progress.end();
        if args.json {
            let faults: Vec<_> =
                rows.iter().map(|(name, scored)| json!({ "fault": name, "scenes": scored })).collect();
            let spaces = SPACES.map(|(name, _)| name);
            return print_json(&json!({ "spaces": spaces, "by": ["cosine", "rank"], "faults": faults }));
        }
        return print(&spaces_table(&rows));
    }
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

/// Errors under which feature spaces are compared.
const SPACE_FAULTS: [&str; 7] = [
    "none",
    "masks cut",
    "masks merged",
    "features of others",
    "noisy features",
    "matches missing 97 %",
    "look-alikes match 30 %",
];

/// Agreements of one scene per space, by cosines and by ranks.
type BySpace = [Vec<[Agreement; 3]>; 2];

/// Mean adjusted Rand index per fault and space, of level l and of the mean of s and m, by cosines
/// and by their ranks; then the mean change by ranks over the scenes, with its standard error.
fn spaces_table(rows: &[(&str, Vec<BySpace>)]) -> String {
    let mut out = String::new();
    for (title, of) in LEVELS {
        let _ = write!(out, "\n{title}: adjusted Rand index\n{:36}", "error");
        for (by, (space, _)) in ["cosine", "rank"].iter().flat_map(|by| SPACES.map(|space| (by, space))) {
            let _ = write!(out, "{:>15}", format!("{space}, {by}"));
        }
        out.push('\n');
        for (fault, scored) in rows {
            let column =
                |by: usize, space: usize| scored.iter().map(move |s| of(&s[by][space])).collect::<Vec<f64>>();
            let _ = write!(out, "{fault:36}");
            for (by, space) in (0..2).flat_map(|by| (0..SPACES.len()).map(move |space| (by, space))) {
                let _ = write!(out, "{:>15.3}", mean(&column(by, space)));
            }
            for space in 0..SPACES.len() {
                let (change, error) = change(&column(1, space), &column(0, space));
                let _ = write!(out, "   {change:>+7.4} ± {error:.4}");
            }
            out.push('\n');
        }
    }
    out
}

/// Things and parts, with the index of a scene.
const LEVELS: [(&str, fn(&[Agreement; 3]) -> f64); 2] =
    [("things (level l)", |a| a[2].rand), ("parts (levels s and m)", |a| 0.5 * (a[0].rand + a[1].rand))];

/// Mean of the differences, and its standard error.
fn change(with: &[f64], without: &[f64]) -> (f64, f64) {
    let change: Vec<f64> = with.iter().zip(without).map(|(a, b)| a - b).collect();
    let spread = change.iter().map(|c| (c - mean(&change)).powi(2)).sum::<f64>();
    (mean(&change), spread.sqrt() / change.len().max(1) as f64)
}

/// Mean adjusted Rand index per fault and steps, of level l and of the mean of s and m, and the
/// mean change by each step over the scenes, with its standard error.
fn table(all: &[Vec<Scored>]) -> String {
    let mut out = String::new();
    for (title, of) in LEVELS {
        let _ = write!(out, "\n{title}: adjusted Rand index by steps\n{:36}", "error");
        STEPS.iter().for_each(|(name, _)| out.push_str(&format!("{name:>9}")));
        out.push_str("   2 adds to 1, 3       3 adds to 1, 2\n");
        for (fault, scored) in FAULTS.iter().zip(all) {
            let column = |k: usize| scored.iter().map(move |s| of(&s.steps[k])).collect::<Vec<f64>>();
            let columns: Vec<Vec<f64>> = (0..STEPS.len()).map(column).collect();
            let _ = write!(out, "{:36}", fault.name);
            columns.iter().for_each(|c| out.push_str(&format!("{:>9.3}", mean(c))));
            for (with, without) in [(3, 2), (3, 1)] {
                let (change, error) = change(&columns[with], &columns[without]);
                let _ = write!(out, "   {change:>+8.4} ± {error:.4}");
            }
            out.push('\n');
        }
    }
    out
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len().max(1) as f64
}
