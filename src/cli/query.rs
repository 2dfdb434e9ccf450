//! `splatvk query`
use super::args::QueryArgs;
use super::outputs::WrittenFiles;
use super::print::{print, print_json};
use super::progress;
use super::views;
use crate::format::ply::{self, PlyOptions};
use crate::format::{cameras, picture, scene_dir, write_json};
use crate::gpu::Device;
use crate::query::QueryResult;
use crate::query::presence::{Evidence, Presence};
use crate::report::{colour, file_name};
use crate::run::Compat;
use crate::run::ask::{self, QueryScene};
use crate::run::encoder;
use crate::run::view::DecodedFrame;
use crate::scene::{Camera, LEVEL_NAMES, RgbImage, World};
use crate::{Error, Result};
use glam::DVec2;
use serde_json::{Value, json};
use std::fmt::Write;
use std::time::Instant;

/// Cameras whose frames are kept at a time.
const AT_ONCE: usize = 16;

pub fn query(args: &QueryArgs) -> Result<()> {
    let mut scene = scene_dir::load(&args.scene)?;
    let no_language = || {
        Error::input(format!(
            "{}: the scene has no language; make one with splatvk run",
            args.scene.display()
        ))
    };
    if scene.language.is_none() {
        return Err(no_language());
    }
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
    let registry = args.device.registry()?;
    let encoder = encoder::of_scene(&scene, registry)?;
    let mut out = WrittenFiles::open(&args.out)?;
    let device = Device::open(args.device.device.as_deref())?;
    let field = scene.language.take().ok_or_else(no_language)?;
    let mut ready = QueryScene::open(&device, &scene.splats, field, encoder)?;
    let options = Compat::answers(args.compat.as_deref(), &args.scene)?;
    let progress = progress::reporter();
    progress.begin("query", cameras.len() as u64);
    let mut views: Vec<Vec<Value>> = vec![Vec::new(); args.texts.len()];
    let mut latency = vec![0.0; args.texts.len()];
    let mut evidence: Vec<Vec<Evidence>> = vec![Vec::new(); args.texts.len()];
    for (part, (cameras, stems)) in cameras.chunks(AT_ONCE).zip(stems.chunks(AT_ONCE)).enumerate() {
        progress.check()?;
        ready.set_views(cameras)?;
        for (q, text) in args.texts.iter().enumerate() {
            let clock = Instant::now();
            let answers = ready.ask(text, &options)?;
            latency[q] += 1e3 * clock.elapsed().as_secs_f64();
            evidence[q].extend(answers.evidence);
            for (((frame, stem), camera), answer) in
                ready.frames().iter().zip(stems).zip(cameras).zip(&answers.views)
            {
                write(&mut out, stem, &folders[q], &frame.rendered.rgb, answer)?;
                views[q].push(to_json(
                    stem,
                    &folders[q],
                    answer,
                    &place(frame, camera, answer, &scene.world),
                ));
            }
        }
        progress.step((part * AT_ONCE + cameras.len()) as u64, "");
    }
    progress.end();
    let (mut queries, mut verdicts) = (Vec::new(), Vec::new());
    for (q, text) in args.texts.iter().enumerate() {
        // Of cameras that were answered apart, the part that shows most of it.
        let best = evidence[q].iter().min_by(|a, b| a.p_value.total_cmp(&b.p_value));
        let mut entry = json!({
            "text": text, "presence": best.map(|e| e.presence), "p_value": best.map(|e| e.p_value),
            "milliseconds": latency[q], "embedded_by": ready.encoder().embedded_by(text), "views": views[q],
        });
        let presence = best.map(|e| e.presence);
        verdicts.push(presence);
        if args.splats {
            let chosen = ready.select(text, &options)?;
            let name = format!("{}/splats.ply", folders[q]);
            ply::write_splats(
                &out.file(&name)?,
                &ready.field().levels[chosen.level].carrier(&scene.splats).picked(&chosen.splats),
                PlyOptions::default(),
            )?;
            entry["splats"] = json!({
                "count": chosen.splats.len(), "level": LEVEL_NAMES[chosen.level],
                "found": chosen.found && presence != Some(Presence::Absent), "file": name,
            });
        }
        queries.push(entry);
    }
    ready.encoder().doubt().iter().for_each(|doubt| progress.warn(doubt));
    let report = json!({ "scene": args.scene, "out": args.out, "world": scene.world, "queries": queries });
    write_json(&out.file("answers.json")?, &report)?;
    out.keep();
    if args.device.json {
        print_json(&report)
    } else {
        print(&table(&args.texts, &views, &verdicts, &latency, args))
    }
}

fn write(
    out: &mut WrittenFiles,
    stem: &str,
    folder: &str,
    picture: &RgbImage,
    a: &QueryResult,
) -> Result<()> {
    let name = |kind: &str| format!("{folder}/{stem}_{kind}");
    let heat = colour::heat_image(picture, &a.relevancy, Some(&a.mask));
    picture::write_png(&out.file(&name("heat.png"))?, &heat)?;
    picture::write_mask_png(&out.file(&name("mask.png"))?, &a.mask)?;
    let size = (a.relevancy.width, a.relevancy.height);
    picture::write_npy(&out.file(&name("relevancy.npy"))?, size, None, &a.relevancy.data)
}

/// Where the location is in space, and how far from the camera; null where the scene shows nothing.
fn place(frame: &DecodedFrame, camera: &Camera, a: &QueryResult, world: &World) -> Value {
    let (x, y) = a.location;
    let depth = f64::from(frame.rendered.depth.at(x, y));
    if depth <= 0.0 {
        return Value::Null;
    }
    let at = camera.unproject(DVec2::new(x as f64 + 0.5, y as f64 + 0.5), depth);
    let distance = at.distance(camera.pose.centre());
    let metres = world.scale.as_ref().map(|s| distance * s.metres_per_unit);
    json!({ "position": at.to_array(), "distance": distance, "distance_metres": metres })
}

fn to_json(stem: &str, folder: &str, a: &QueryResult, place: &Value) -> Value {
    json!({
        "place": place,
        "view": stem, "found": a.found, "score": a.score, "level": LEVEL_NAMES[a.level],
        // Pixel position of the most relevant pixel's centre; the first pixel's is (0.5, 0.5).
        "location": [a.location.0 as f64 + 0.5, a.location.1 as f64 + 0.5],
        "mask_pixels": a.mask.data.iter().filter(|m| **m).count(),
        "heat": format!("{folder}/{stem}_heat.png"), "mask": format!("{folder}/{stem}_mask.png"),
        "relevancy": format!("{folder}/{stem}_relevancy.npy"),
    })
}

fn table(
    texts: &[String],
    answers: &[Vec<Value>],
    verdicts: &[Option<Presence>],
    latency: &[f64],
    args: &QueryArgs,
) -> String {
    let mut text = String::new();
    // Writing to a String cannot fail.
    for (((query, views), ms), presence) in texts.iter().zip(answers).zip(latency).zip(verdicts) {
        let found = views.iter().filter(|v| v["found"] == true).count();
        let verdict = ask::verdict(*presence, found, views.len());
        let _ = writeln!(text, "“{query}”: {verdict}, answered in {ms:.0} ms");
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
