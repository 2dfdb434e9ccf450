//! `splatvk doctor`: state of this machine, with advice on missing parts.
use super::args::DoctorArgs;
use super::models;
use super::print::{print, print_json};
use super::progress;
use crate::check::choose::{self, Choice, LIMIT, Timing};
use crate::check::{self, Row};
use crate::gpu::report::{Line, Status, vulkan};
use crate::gpu::{self, Device, FolderCache, Options};
use crate::infer;
use crate::infer::installed::{Task, inventory};
use crate::photo::{self, Support};
use crate::run::sources;
use crate::{Error, Result};
use serde_json::json;
use std::collections::BTreeSet;
use std::fmt::Write;
use std::time::Instant;

pub fn doctor(args: &DoctorArgs) -> Result<()> {
    if args.check {
        return check_passes(args);
    }
    let registry = args.device.registry()?;
    let mut lines = vulkan(args.device.device.as_deref());
    lines.push(match infer::runtime().and_then(|path| Ok((path, registry.compute().name()?))) {
        Ok((path, provider)) => {
            line("ONNX Runtime", Status::Ok, format!("{} · provider {provider}", path.display()), None)
        }
        Err(error) => line("ONNX Runtime", Status::Missing, "not usable".to_owned(), Some(error.to_string())),
    });
    let notes = registry.compute().notes().unwrap_or_default();
    lines.extend(notes.into_iter().map(|n| line("ONNX Runtime", Status::Note, n, None)));
    let status = registry.status();
    for m in &status {
        let found = format!(
            "{} · {:.1} MB · {} · sha256 {}",
            m.file.display(),
            m.bytes as f64 / 1e6,
            m.licence,
            m.sha256
        );
        let state = if m.installed { Status::Ok } else { Status::Missing };
        lines.push(line(&format!("model {}", m.name), state, found, m.fix.clone()));
    }
    let networks = inventory(&registry);
    lines.extend(
        sources::list(&networks).into_iter().map(|(option, found)| line(&option, Status::Ok, found, None)),
    );
    let lacking: Vec<&str> = [Task::Geometry, Task::Masks, Task::Features]
        .into_iter()
        .filter(|task| networks.best(*task).is_none())
        .map(Task::name)
        .collect();
    if !lacking.is_empty() {
        // The built-in sources need no networks.
        let advice = "splatvk models fetch open gets those that are recommended".to_owned();
        lines.push(line("networks", Status::Note, format!("none for {}", lacking.join(", ")), Some(advice)));
    }
    // Other photo formats work without it, so the machine is still ready.
    let Support { found, advice } = photo::heif_support();
    lines.push(line("HEIC, AVIF", if advice.is_some() { Status::Note } else { Status::Ok }, found, advice));
    let Support { found, advice } = photo::video_support();
    lines.push(line("video", if advice.is_some() { Status::Note } else { Status::Ok }, found, advice));
    let missing = lines.iter().filter(|l| l.status == Status::Missing).count();
    let next = next(&lines);
    if args.device.json {
        let lines: Vec<_> = lines
            .iter()
            .map(|l| json!({ "topic": l.topic, "status": word(l.status), "found": l.found, "advice": l.advice }))
            .collect();
        let models: Vec<_> = status.iter().map(models::to_json).collect();
        print_json(&json!({ "ready": missing == 0, "next": next, "lines": lines, "models": models }))?;
    } else {
        print(&format!("{}\nnext: {next}\n", table(&lines)))?;
    }
    match missing {
        0 => Ok(()),
        n => Err(Error::missing(format!("{n} required parts are missing; next: {next}"))),
    }
}

/// Compares every pass with its CPU reference, disables wrong kernel variants that have a
/// replacement, and times the others.
fn check_passes(args: &DoctorArgs) -> Result<()> {
    // No variant is disabled, and without the cache the driver compiles every shader.
    let options =
        Options { cache: None, disabled: BTreeSet::new(), ..gpu::options(args.device.device.as_deref()) };
    let device = Device::open(&options)?;
    let info = device.info();
    let (low, high) = info.subgroup_sizes;
    let about = format!(
        "splatvk {} · {} · {} · Vulkan {}.{}.{} · subgroups {} ({low} to {high}) · float atomics {}",
        env!("CARGO_PKG_VERSION"),
        info.name,
        info.driver,
        info.api_version.0,
        info.api_version.1,
        info.api_version.2,
        info.subgroup_size,
        if info.float_atomics { "native" } else { "emulated" },
    );
    let json = args.device.json;
    if !json {
        print(&format!("{about}\n"))?;
    }
    let rows = check::run(&device, &options, &mut |row| {
        progress::reporter().check()?;
        if json { Ok(()) } else { print(&text(row)) }
    })?;
    let off = check::wrong_variants(&rows);
    let names: Vec<&str> = off.iter().map(|v| v.name()).collect();
    let cache = FolderCache::own();
    if let Some(cache) = &cache {
        device.disable(cache, &check::names(&off)).map_err(Error::io(cache.path()))?;
    }
    let choices = time_variants(&device, &options, &rows, cache.as_ref())?;
    let fatal = rows.iter().filter(|r| check::is_fatal(r, &off)).count();
    if json {
        let rows: Vec<_> = rows.iter().map(to_json).collect();
        let timed: Vec<_> = choices.iter().map(choice_to_json).collect();
        print_json(&json!({
            "device": about, "right": fatal == 0, "switched_off": names, "passes": rows, "timed": timed
        }))?;
    } else {
        if !off.is_empty() {
            print(&format!("switched off on this device with this driver: {}\n", names.join(", ")))?;
        }
        choices.iter().try_for_each(|choice| print(&choice_text(choice)))?;
    }
    match fatal {
        0 => Ok(()),
        n => Err(Error::gpu(format!(
            "{n} of {} passes give wrong results on {}, and nothing replaces them: update the driver or use another --device, and \
             please report the table above",
            rows.len(),
            info.name
        ))),
    }
}

fn text(row: &Row) -> String {
    let (word, found) = match &row.outcome {
        Ok(found) => ("ok", found),
        Err(problem) => ("WRONG", problem),
    };
    let pass = row.variant.map_or(row.pass.to_owned(), |variant| format!("{}, {}", row.pass, variant.name()));
    format!("{word:<6} {pass:<52} {:>6} ms  {found}\n", row.time.as_millis())
}

/// Times the kernel variants and keeps the names of those that were faster than the defaults;
/// nothing where native code replaces the shaders, or under validation, which takes longer for some
/// shaders than for others.
fn time_variants(
    device: &Device,
    options: &Options,
    rows: &[Row],
    cache: Option<&FolderCache>,
) -> Result<Vec<Choice>> {
    if options.validation || gpu::replaces_shaders(device.info(), &gpu::options(None).disabled) {
        return Ok(Vec::new());
    }
    let remembered = cache.and_then(|cache| device.preferred(cache)).unwrap_or_default();
    let (wrong, until) = (check::wrong(rows), Instant::now() + LIMIT);
    let mut stop = || progress::reporter().check();
    let choices = check::time_variants(options, None, &remembered, &wrong, until, &mut stop)?;
    if let Some(cache) = cache {
        let preferred = choose::preferred(&choices);
        device.prefer(cache, Some(&preferred)).map_err(Error::io(cache.path()))?;
    }
    Ok(choices)
}

fn choice_text(choice: &Choice) -> String {
    let [a, b] = choice.variants.map(|v| v.name());
    let pair = match choice.timing {
        Timing::Measured(times) => {
            let [of_a, of_b] = times.medians;
            format!("{a} {of_a:.3} ms, {b} {of_b:.3} ms, {:.2}×", times.ratio)
        }
        Timing::Wrong => format!("{a}, {b}: one is wrong"),
        Timing::Unusable => format!("{a}, {b}: the device runs one only"),
        Timing::OutOfTime => format!("{a}, {b}: no time left"),
    };
    format!("timed  {pair:<80} → {}\n", choice.chosen.name())
}

fn choice_to_json(choice: &Choice) -> serde_json::Value {
    let times = match choice.timing {
        Timing::Measured(times) => Some(times),
        _ => None,
    };
    json!({
        "ways": choice.variants.map(|v| v.name()),
        "milliseconds": times.map(|t| t.medians),
        "ratio": times.map(|t| t.ratio),
        "chosen": choice.chosen.name(),
    })
}

fn to_json(row: &Row) -> serde_json::Value {
    json!({
        "pass": row.pass,
        "way": row.variant.map(|v| v.name()),
        "right": row.outcome.is_ok(),
        "found": row.outcome.as_ref().unwrap_or_else(|problem| problem),
        "seconds": row.time.as_secs_f64(),
    })
}

fn line(topic: &str, status: Status, found: String, advice: Option<String>) -> Line {
    Line { topic: topic.to_owned(), status, found, advice }
}

fn word(status: Status) -> &'static str {
    match status {
        Status::Ok => "ok",
        Status::Note => "note",
        Status::Missing => "MISSING",
    }
}

/// The command to run next: it mends the first missing part, or makes a first scene.
fn next(lines: &[Line]) -> &'static str {
    let missing =
        |topic: &str| lines.iter().any(|l| l.status == Status::Missing && l.topic.starts_with(topic));
    let in_python = || {
        let program = std::env::current_exe().unwrap_or_default();
        program.file_name().is_some_and(|name| name.to_string_lossy().starts_with("python"))
    };
    if missing("Vulkan") {
        "sudo apt install libvulkan1 mesa-vulkan-drivers"
    } else if missing("ONNX Runtime") || missing("model") {
        if in_python() { "pip install --force-reinstall splatvk splatvk-models" } else { "tools/setup" }
    } else if lines.iter().any(|l| l.status == Status::Missing) {
        "follow the advice above"
    } else {
        "splatvk demo"
    }
}

fn table(lines: &[Line]) -> String {
    let mut text = String::new();
    for l in lines {
        // Writing to a String cannot fail.
        let _ = writeln!(text, "{:<8} {:<28} {}", word(l.status), l.topic, l.found);
        if let Some(advice) = &l.advice {
            let _ = writeln!(text, "{:<8} {:<28} → {advice}", "", "");
        }
    }
    text
}
