//! `splatlab ask`
use super::args::AskArgs;
use crate::protocol::{Asked, Clicked, Counts, Kind, Named, Photographs};
use crate::{Error, Result};
use serde_json::json;
use splatvk::cli::args::EditUse;
use splatvk::cli::print::{print, print_json};
use splatvk::cli::{progress, scene};
use splatvk::gpu;
use splatvk::query::QueryOptions;
use splatvk::run::ask::QueryScene;
use splatvk::run::encoder;
use std::fmt::Write;

pub fn ask(args: &AskArgs) -> Result<()> {
    let mut scene = scene::load(&args.scene, EditUse::default())?;
    let photographs = Photographs::open(&args.labels, &scene.cameras)?;
    let encoder = encoder::of_scene(&scene, args.device.registry()?)?;
    let field = scene.language.take().ok_or_else(|| {
        Error::input(format!(
            "{}: the scene has no language; make one with splatvk run",
            args.scene.display()
        ))
    })?;
    let device = gpu::open(args.device.device.as_deref())?;
    let mut ready = QueryScene::open(&device, (&scene.splats, &scene.cameras), field, encoder)?;
    let asked = photographs.ask(&mut ready, &QueryOptions::default())?;
    let named = photographs.names(&mut ready)?;
    let clicked = photographs.clicks(&ready)?;
    ready.encoder().embedding_warning().iter().for_each(|warning| progress::print_warning(warning));
    if args.device.json {
        let counts = KINDS.map(|kind| json!({ "kind": kind, "counts": Counts::of(&asked, kind) }));
        return print_json(
            &json!({ "scene": args.scene, "asked": asked, "named": named, "clicked": clicked, "summary": counts }),
        );
    }
    print(&(table(&asked) + &names(&named) + &clicks(&clicked)))
}

fn names(named: &[Named]) -> String {
    let mut out = String::new();
    for n in named {
        let [own, next] = n.relevancy;
        let mark = if n.right { "right" } else { "wrong" };
        let _ = writeln!(out, "{:24} {mark}: {} {own:.3}, next {next:.3}", n.category, n.name);
    }
    out
}

fn clicks(clicked: &[Clicked]) -> String {
    let mut out = String::new();
    for c in clicked {
        let _ = writeln!(out, "{:24} click {:.2}, best level {:.2}", c.category, c.iou, c.best);
    }
    let mean =
        |value: fn(&Clicked) -> f64| clicked.iter().map(value).sum::<f64>() / clicked.len().max(1) as f64;
    let most = clicked.iter().filter(|c| c.iou >= 0.5).count();
    let _ = writeln!(
        out,
        "Clicks: {} things, IoU {:.2} (best level {:.2}), {most} with 0.5 or more",
        clicked.len(),
        mean(|c| c.iou),
        mean(|c| c.best),
    );
    out
}

const KINDS: [Kind; 3] = [Kind::Category, Kind::Synonym, Kind::Absent];

fn table(asked: &[Asked]) -> String {
    let mut out = String::new();
    for a in asked {
        let p = a.p_value.map_or(String::new(), |p| format!("{p:.3}"));
        let place = a.iou.map_or("absent".to_owned(), |iou| format!("{}/{} {iou:.2}", a.located, a.photos));
        let _ = writeln!(out, "{:24} {place:12} {p:6} {}", a.text, a.verdict);
    }
    for kind in KINDS {
        let c = Counts::of(asked, kind);
        let per = |sum: f64| sum / c.photos.max(1) as f64;
        let _ = writeln!(
            out,
            "{kind:?}: {} texts: {} found, {} misled, {} + {} unsure (right + wrong place), {} no sign, {} unknown; \
             located {:.2}, IoU {:.2}",
            c.texts,
            c.found,
            c.misled,
            c.unsure_placed,
            c.unsure_elsewhere,
            c.no_sign,
            c.unknown,
            per(c.located as f64),
            per(c.iou),
        );
    }
    out
}
