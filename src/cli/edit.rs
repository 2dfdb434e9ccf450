//! `splatvk edit`
use super::args::DeviceArgs;
use super::print::{print, print_json};
use super::progress;
use crate::format::edits::{Combine, Edit, EditList, Operation, Pick, Term};
use crate::run::edit::expression::{colour, displacement, terms, texts};
use crate::run::edit::{Editor, Selected};
use crate::run::live::LiveScene;
use crate::{Error, Result, gpu};
use clap::{Args, ValueEnum};
use serde_json::{Value, json};
use std::fmt::Write;
use std::path::PathBuf;

/// Rule of `--floaters`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum FloaterRule {
    /// Those that are on no surface of a photo
    Conservative,
    /// Also those on the surface of one photo that more photos look through
    Thorough,
}

/// `splatvk edit`
#[derive(Debug, Args)]
pub struct EditArgs {
    /// Scene directory
    pub scene: PathBuf,
    /// Remove what is selected: words, ids of `splatvk objects` (id:o3), ranges (opacity<0.1,
    /// size>5cm, reliability<0.3, seen<1), the thing at a pixel of a photo (at:a.jpg:320,240), an
    /// outline there (in:a.jpg:0,0 9,0 9,9), joined with " + ", " - " or " & "
    #[arg(long, value_name = "SELECTION")]
    pub delete: Vec<String>,
    /// Keep only what is selected
    #[arg(long, value_name = "SELECTION")]
    pub isolate: Option<String>,
    /// Give a selection a colour, and keep its shading
    #[arg(long, visible_alias = "recolor", value_name = "SELECTION=#RRGGBB")]
    pub recolour: Vec<String>,
    /// Move a selection: units of the scene, or with m, cm or mm, along its axes or upright ("up 5cm")
    #[arg(long = "move", value_name = "SELECTION=X,Y,Z", allow_hyphen_values = true)]
    pub moves: Vec<String>,
    /// Remove splats that float in front of the surfaces
    #[arg(long, value_enum, value_name = "RULE", num_args = 0..=1, default_missing_value = "conservative")]
    pub floaters: Option<FloaterRule>,
    /// Let words select more (above 0) or less (below 0), −1 to 1
    #[arg(long, default_value_t = 0.0, value_name = "AMOUNT", allow_hyphen_values = true)]
    pub grow: f32,
    /// Edit also where the scene may not contain the words
    #[arg(long)]
    pub force: bool,
    /// Only say what would be selected
    #[arg(long)]
    pub dry_run: bool,
    /// Undo the last edit, or the last N
    #[arg(long, value_name = "N", num_args = 0..=1, default_missing_value = "1", conflicts_with_all = CHANGES, value_parser = super::args::whole::<usize>(1..=1_000_000))]
    pub undo: Option<usize>,
    /// Apply the edit that was undone last, or the last N
    #[arg(long, value_name = "N", num_args = 0..=1, default_missing_value = "1", conflicts_with_all = CHANGES, conflicts_with = "undo", value_parser = super::args::whole::<usize>(1..=1_000_000))]
    pub redo: Option<usize>,
    /// List the edits of the scene
    #[arg(long)]
    pub list: bool,
    /// Write the edited scene as a scene of its own
    #[arg(long, value_name = "DIR")]
    pub bake: Option<PathBuf>,
    /// Device and models
    #[command(flatten)]
    pub device: DeviceArgs,
}

/// Options that add edits.
const CHANGES: [&str; 5] = ["delete", "isolate", "recolour", "moves", "floaters"];

pub fn edit(args: &EditArgs) -> Result<()> {
    let mut editor = Editor::open(&args.scene, &args.device.machine())?;
    let mut made = Vec::new();
    // All selections come before the first change: a refused one changes nothing, and the order of
    // the options does not matter.
    for (operation, terms) in asked(args, &editor)? {
        let selected = editor.select(&terms)?;
        if let Some(doubt) = selected.doubts.first().filter(|_| !args.force && !args.dry_run) {
            return Err(Error::input(format!(
                "{doubt}; nothing is changed: --force edits anyway, --dry-run says how much, splatvk query shows it"
            )));
        }
        made.push((operation, selected));
    }
    let steps = step(args, &mut editor)?;
    if made.is_empty() && steps.is_none() && !args.list && args.bake.is_none() {
        return Err(Error::input(
            "give an edit, for example --delete \"chair\", or --list, --undo, --redo, --bake",
        ));
    }
    let lines: Vec<String> = made.iter().map(|(operation, selected)| line(operation, selected)).collect();
    let records: Vec<Value> = made.iter().map(|(operation, selected)| record(operation, selected)).collect();
    let along = match args.dry_run || made.is_empty() {
        true => 0,
        false => editor.push(made)?,
    };
    if let Some(out) = &args.bake {
        let device = gpu::open(args.device.device.as_deref())?;
        let mut baked = LiveScene::loaded(&device, editor.scene().clone(), &args.device.registry()?)?;
        baked.save(&out.join(""), args.force)?;
    }
    if args.device.json {
        let list = editor.list();
        return print_json(&json!({
            "scene": args.scene, "dry_run": args.dry_run, "made": records, "along": along, "undone_now": steps,
            "edits": entries(&list.edits), "undone": entries(&list.undone), "baked": args.bake,
        }));
    }
    let mut text = lines.concat();
    if along > 0 {
        let _ = writeln!(text, "{along} splats behind the deleted ones went along: no photo shows them");
    }
    if let Some(steps) = steps {
        let verb = if args.undo.is_some() { "undone" } else { "redone" };
        let _ = writeln!(text, "{steps} {verb}");
    }
    if args.list {
        text += &listing(editor.list());
    }
    if let Some(out) = &args.bake {
        let _ = writeln!(text, "{}: {} splats", out.display(), editor.scene().splats.len());
    }
    print(&text)
}

/// The edits of the command line with their selections.
fn asked(args: &EditArgs, editor: &Editor) -> Result<Vec<(Operation, Vec<Term>)>> {
    let scene = editor.scene();
    let read = |text: &str| terms(text, scene, args.grow);
    let mut asked = Vec::new();
    for text in &args.delete {
        asked.push((Operation::Delete {}, read(text)?));
    }
    if let Some(text) = &args.isolate {
        asked.push((Operation::Isolate {}, read(text)?));
    }
    for text in &args.recolour {
        let (selection, value) = value_of(text, "--recolour \"blue mug=#c33\"")?;
        asked.push((Operation::Recolour { colour: colour(value)? }, read(selection)?));
    }
    for text in &args.moves {
        let (selection, value) = value_of(text, "--move \"lemon=0,-5cm,0\"")?;
        asked.push((Operation::Move { by: displacement(value, scene)? }, read(selection)?));
    }
    if let Some(rule) = args.floaters {
        let pick = Pick::Floaters { thorough: rule == FloaterRule::Thorough };
        asked.push((Operation::Delete {}, vec![Term { combine: Combine::Add, pick }]));
    }
    Ok(asked)
}

/// Selection and value around the last equals sign.
fn value_of<'t>(text: &'t str, example: &str) -> Result<(&'t str, &'t str)> {
    text.rsplit_once('=').ok_or_else(|| Error::input(format!("\"{text}\": no value; write {example}")))
}

/// Undoes or redoes as many edits as asked, and returns their number.
fn step(args: &EditArgs, editor: &mut Editor) -> Result<Option<usize>> {
    let (count, step): (usize, fn(&mut Editor) -> Result<bool>) = match (args.undo, args.redo) {
        (Some(count), _) => (count, Editor::undo),
        (None, Some(count)) => (count, Editor::redo),
        (None, None) => return Ok(None),
    };
    for done in 0..count {
        if !step(editor)? {
            let verb = if args.undo.is_some() { "undo" } else { "redo" };
            if done == 0 {
                return Err(Error::input(format!("{}: there is nothing to {verb}", args.scene.display())));
            }
            progress::print_warning(&format!("there were only {done} edits to {verb}"));
            return Ok(Some(done));
        }
    }
    Ok(Some(count))
}

/// Name of an operation, with its value.
fn name(operation: &Operation) -> String {
    match operation {
        Operation::Delete {} => "delete".to_owned(),
        Operation::Isolate {} => "isolate".to_owned(),
        Operation::Recolour { colour } => {
            let hex = colour.map(|v| format!("{:02x}", (255.0 * v).round() as u8));
            format!("recolour #{}", hex.concat())
        }
        Operation::Move { by: [x, y, z] } => format!("move by {x:.4}, {y:.4}, {z:.4}"),
    }
}

fn line(operation: &Operation, selected: &Selected) -> String {
    let doubts: String = selected.doubts.iter().map(|doubt| format!("; {doubt}")).collect();
    format!(
        "{} {}: {} splats, {:.1} % of the scene{doubts}\n",
        name(operation),
        texts(&selected.terms),
        selected.count,
        100.0 * selected.share
    )
}

fn record(operation: &Operation, selected: &Selected) -> Value {
    json!({
        "operation": operation, "selection": selected.terms, "splats": selected.count, "share": selected.share,
        "doubts": selected.doubts,
    })
}

/// Edits without their splats.
fn entries(edits: &[Edit]) -> Vec<Value> {
    let entry =
        |e: &Edit| json!({ "operation": e.operation, "selection": e.selection, "splats": e.splats.count() });
    edits.iter().map(entry).collect()
}

/// A line per edit, those that were undone below.
fn listing(list: &EditList) -> String {
    if list.edits.is_empty() && list.undone.is_empty() {
        return "no edits\n".to_owned();
    }
    let row = |(k, e): (usize, &Edit)| format!("{:>3}. {}\n", k + 1, entry(e));
    let edits: String = list.edits.iter().enumerate().map(row).collect();
    let undone: String = list.undone.iter().rev().map(|e| format!("  undone: {}\n", entry(e))).collect();
    edits + &undone
}

/// An edit in a line.
pub fn entry(edit: &Edit) -> String {
    format!("{} {}: {} splats", name(&edit.operation), texts(&edit.selection), edit.splats.count())
}
