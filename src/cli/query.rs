//! `splatvk query`
use super::args::QueryArgs;
use super::encoder;
use super::outputs::Outputs;
use super::progress::Terminal;
use super::{print, print_json, views};
use crate::format::{cameras, picture, scene_dir, write_json};
use crate::gpu::Device;
use crate::infer::Registry;
use crate::progress::Progress;
use crate::query::{QueryOptions, QueryResult};
use crate::report::{colour, file_name};
use crate::run::sources;
use crate::run::view::Viewer;
use crate::scene::LEVEL_NAMES;
use crate::{Error, Result};
use serde_json::{Value, json};
use std::fmt::Write;

pub fn query(args: &QueryArgs) -> Result<()> {
    let scene = scene_dir::load(&args.scene)?;
    let field = scene.language.as_ref().ok_or_else(|| {
        Error::input(format!(
            "{}: the scene has no language; make one with splatvk run",
            args.scene.display()
        ))
    })?;
    let cameras = match &args.cameras {
        Some(file) => cameras::read(file)?,
        None => scene.cameras.clone(),
    };
    let stems = views::stems(&cameras)?;
    let folders: Vec<String> = args.texts.iter().map(|t| file_name(t)).collect();
    for (i, folder) in folders.iter().enumerate() {
        if args.texts[i].trim().is_empty() {
            return Err(Error::input("an empty query; give a few words"));
        }
        if folders[..i].contains(folder) {
            return Err(Error::input(format!(
                "\"{}\" is asked twice (its files would be the same); ask once",
                args.texts[i]
            )));
        }
    }
    let registry = Registry::open(args.device.models.as_deref())?;
    let mut encoder = encoder::of_scene(&scene, registry)?;
    let queries = sources::queries(&args.texts, encoder.as_mut())?;
    let mut out = Outputs::open(&args.out)?;
    let device = Device::open(args.device.device.as_deref())?;
    let mut viewer = Viewer::new(&device, &scene.splats, field)?;
    let progress = Terminal::new();
    progress.begin("query", cameras.len() as u64);
    let mut answers: Vec<Vec<Value>> = vec![Vec::new(); queries.len()];
    for (i, (camera, stem)) in cameras.iter().zip(&stems).enumerate() {
        progress.check()?;
        let view = viewer.view(camera)?;
        for (q, query) in queries.iter().enumerate() {
            let answer = crate::query::answer(&view.codes, field, query, &QueryOptions::default())?;
            let name = |kind: &str| format!("{}/{stem}_{kind}", folders[q]);
            let heat = colour::heat_image(&view.frame.rgb, &answer.relevancy, Some(&answer.mask));
            picture::write_png(&out.file(&name("heat.png"))?, &heat)?;
            picture::write_mask_png(&out.file(&name("mask.png"))?, &answer.mask)?;
            let size = (answer.relevancy.width, answer.relevancy.height);
            picture::write_npy(&out.file(&name("relevancy.npy"))?, size, None, &answer.relevancy.data)?;
            answers[q].push(to_json(stem, &folders[q], &answer));
        }
        progress.step(i as u64 + 1, "");
    }
    progress.end();
    let queries = args.texts.iter().zip(&answers).map(|(t, a)| json!({ "text": t, "views": a }));
    let report = json!({ "scene": args.scene, "out": args.out, "queries": queries.collect::<Vec<_>>() });
    write_json(&out.file("answers.json")?, &report)?;
    out.keep();
    if args.device.json { print_json(&report) } else { print(&table(&args.texts, &answers, args)) }
}

fn to_json(stem: &str, folder: &str, a: &QueryResult) -> Value {
    json!({
        "view": stem, "found": a.found, "score": a.score, "level": LEVEL_NAMES[a.level],
        // Pixel position of the most relevant pixel's centre; the first pixel's is (0.5, 0.5).
        "location": [a.location.0 as f64 + 0.5, a.location.1 as f64 + 0.5],
        "mask_pixels": a.mask.data.iter().filter(|m| **m).count(),
        "heat": format!("{folder}/{stem}_heat.png"), "mask": format!("{folder}/{stem}_mask.png"),
        "relevancy": format!("{folder}/{stem}_relevancy.npy"),
    })
}

fn table(texts: &[String], answers: &[Vec<Value>], args: &QueryArgs) -> String {
    let mut text = String::new();
    // Writing to a String cannot fail.
    for (query, views) in texts.iter().zip(answers) {
        let found = views.iter().filter(|v| v["found"] == true).count();
        let _ = writeln!(text, "“{query}”: found in {found} of {} views", views.len());
        for v in views {
            let verdict = if v["found"] == true { "" } else { "  not found" };
            let _ = writeln!(
                text,
                "  {:<16} {:.2} at level {}, pixel {:.0}, {:.0}{verdict}",
                v["view"].as_str().unwrap_or(""),
                v["score"].as_f64().unwrap_or(0.0),
                v["level"].as_str().unwrap_or(""),
                v["location"][0].as_f64().unwrap_or(0.0),
                v["location"][1].as_f64().unwrap_or(0.0)
            );
        }
    }
    let _ = writeln!(text, "heat maps and masks are in {}", args.out.display());
    text
}
