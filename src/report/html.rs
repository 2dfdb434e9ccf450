//! `report.html`, one self-contained file, readable on a phone.
use super::chart::escape;
use super::{
    AnswerShown, Curve, HtmlReport, Picture, QueryShown, ViewShown, chart, duration, one_line, viewer,
};
use crate::format::picture;
use crate::scene::RgbImage;
use crate::{Error, Result};
use base64::Engine;
use rayon::prelude::*;
use std::fmt::Write;
use std::path::Path;

/// Widest embedded picture, pixels: sharp on a phone, and a report of four views stays near 2 MB.
const PICTURE_WIDTH: usize = 640;

const STYLE: &str = include_str!("report.css");

/// Writes `report.html` into a scene folder.
pub fn write_html(folder: &Path, report: &HtmlReport) -> Result<()> {
    let path = folder.join("report.html");
    std::fs::write(&path, page(report)?).map_err(Error::unwritable(&path))
}

fn figure(image: &RgbImage, caption: &str) -> Result<String> {
    let width = image.width.min(PICTURE_WIDTH);
    let height = (image.height * width / image.width.max(1)).max(1);
    let small = if width < image.width { &image.resized_by_area(width, height) } else { image };
    let bytes = base64::engine::general_purpose::STANDARD.encode(picture::jpeg_bytes(small, 84)?);
    let caption = escape(caption);
    Ok(format!(
        "<figure><img src=\"data:image/jpeg;base64,{bytes}\" width=\"{width}\" height=\"{height}\" alt=\"{caption}\" \
         loading=\"lazy\"><figcaption>{caption}</figcaption></figure>"
    ))
}

fn page(report: &HtmlReport) -> Result<String> {
    // The splats and the pictures take most of the time.
    let (scene, (queries, views)) = rayon::join(
        || report.scene.as_ref().map(|scene| scene.embedded()).transpose(),
        || rayon::join(|| queries(report), || joined(report.views.par_iter().map(view_row))),
    );
    let title = escape(report.title);
    let mut body = format!("<header><h1>{title}</h1><p>{}</p></header>", escape(&report.run.program));
    if !report.run.warnings.is_empty() {
        let items: String = report.run.warnings.iter().map(|w| format!("<li>{}</li>", escape(w))).collect();
        // Writing to a String cannot fail.
        let _ = write!(body, "<section class=\"note\"><h2>Warnings</h2><ul>{items}</ul></section>");
    }
    if let Some((section, note)) = scene? {
        let _ = write!(body, "{section}<p class=\"small\">{}</p>", escape(&note));
    }
    body.push_str(&queries?);
    body.push_str("<section><h2>Views</h2>");
    body.push_str(&views?);
    body.push_str("</section>");
    body.push_str("<section><h2>Figures</h2><dl class=\"figures\">");
    // The device is below the times, and answers have their own section.
    for (label, value) in report.figures.iter().filter(|(l, _)| l != "device" && !l.starts_with('“')) {
        let _ = write!(body, "<dt>{}</dt><dd>{}</dd>", escape(label), escape(value));
    }
    body.push_str("</dl></section>");
    let charts: String = report.curves.iter().map(curve).collect();
    if !charts.is_empty() {
        let _ = write!(body, "<section><h2>Training</h2><div class=\"row curves\">{charts}</div></section>");
    }
    body.push_str(&run_tables(report));
    Ok(format!(
        "<!doctype html><html lang=\"en\"><meta charset=\"utf-8\"><meta name=\"viewport\" \
         content=\"width=device-width, initial-scale=1\"><title>{title} · splatvk</title><style>{STYLE}{}</style>\
         <main>{body}</main></html>\n",
        viewer::STYLE
    ))
}

/// Chart of a curve with its last value in the caption; empty for a curve without two points.
fn curve(curve: &Curve) -> String {
    let svg = chart::line_chart(&curve.points, "step", curve.name);
    let (Some((_, last)), false) = (curve.points.last(), svg.is_empty()) else { return String::new() };
    let decimals = if last.abs() >= 1000.0 { 0 } else { 2 + usize::from(last.abs() < 1.0) };
    let unit = if curve.unit.is_empty() { String::new() } else { format!(" {}", curve.unit) };
    format!("<figure>{svg}<figcaption>at the end {last:.decimals$}{unit}</figcaption></figure>")
}

fn view_row(v: &ViewShown) -> Result<String> {
    let light = match v.light.is_none() {
        true => String::new(),
        false => format!(", evened out: {}", v.light.summary()),
    };
    let mut pictures = vec![(Picture::Plain(v.photo), format!("photo{light}"))];
    if let Some(render) = v.render {
        let caption = v.psnr.map_or("render".to_string(), |p| format!("render, {p:.1} dB"));
        pictures.push((Picture::Plain(render), caption));
    }
    if let Some(depth) = v.depth {
        pictures.push((Picture::Depth(depth), "depth (near is warm)".to_owned()));
    }
    for (level, codes) in v.levels {
        let long = match *level {
            "s" => "subparts",
            "m" => "parts",
            "l" => "whole things",
            other => other,
        };
        pictures.push((Picture::Labels(codes), long.to_owned()));
    }
    let figures = joined(pictures.par_iter().map(|(picture, caption)| figure(&picture.image(), caption)))?;
    Ok(format!("<h3>{}</h3><div class=\"row views\">{figures}</div>", escape(v.name)))
}

/// The parts in their order, or the first error.
fn joined(parts: impl IndexedParallelIterator<Item = Result<String>>) -> Result<String> {
    parts.collect::<Vec<_>>().into_iter().collect()
}

fn queries(report: &HtmlReport) -> Result<String> {
    let mut out = String::new();
    if report.space.is_some_and(|s| s.starts_with("words")) {
        out.push_str(
            "<section class=\"note\"><p>Words come from the built-in model: an image classifier that knows about a thousand \
             everyday things, joined to texts through a small sentence model. It is a light stand-in; CLIP is the full \
             model. A thing outside its thousand classes may be confused with its nearest relative.</p></section>",
        );
    }
    if report.queries.is_empty() {
        return Ok(out);
    }
    out.push_str("<section><h2>Queries</h2>");
    out.push_str(&joined(report.queries.par_iter().map(|q| query_row(report, q)))?);
    out.push_str("</section>");
    Ok(out)
}

fn query_row(report: &HtmlReport, q: &QueryShown) -> Result<String> {
    let hits = q.answers.iter().filter(|a| a.found).count();
    let class = if hits > 0 { "yes" } else { "no" };
    let heat = |a: &AnswerShown| {
        let Some(view) = report.views.get(a.view) else { return Ok(String::new()) };
        let verdict = if a.found { "" } else { ", not found" };
        let caption = format!("{}: {:.2} at level {}{verdict}", view.name, a.score, a.level);
        figure(&Picture::Heat(view.photo, a).image(), &caption)
    };
    let figures = joined(q.answers.par_iter().map(heat))?;
    Ok(format!(
        "<h3>“{}” <span class=\"{class}\">{}</span></h3><div class=\"row\">{figures}</div>",
        escape(&one_line(q.text)),
        escape(&q.verdict)
    ))
}

fn run_tables(report: &HtmlReport) -> String {
    let run = report.run;
    let mut out = String::from(
        "<section><h2>Time and memory</h2><table class=\"time\"><tr><th>stage<th>time; bars show when<th>peak memory</tr>",
    );
    let percent = |seconds: f64| seconds / run.seconds.max(1e-9) * 100.0;
    for s in &run.stages {
        let memory =
            if s.peak_memory > 0 { format!("{:.2} GB", s.peak_memory as f64 / 1e9) } else { "–".into() };
        let (from, share) = (percent(s.start), percent(s.seconds));
        // Writing to a String cannot fail.
        let _ = write!(
            out,
            "<tr><td>{}<td>{}<i style=\"margin-left:{from:.1}%;width:{share:.1}%\"></i><td>{memory}</tr>",
            escape(&s.name),
            duration(s.seconds)
        );
    }
    let kind = if run.device_is_cpu { " (computes on the CPU)" } else { "" };
    let _ = write!(
        out,
        "<tr><td>total<td>{}<td></tr></table><p>Vulkan device: {}{kind}. Seed {}.</p>",
        duration(run.seconds),
        escape(&run.device),
        run.seed
    );
    if !run.models.is_empty() {
        out.push_str("<h2>Models</h2><table><tr><th>model<th>licence<th>sha256</tr>");
        for m in &run.models {
            let _ = write!(
                out,
                "<tr><td>{}<td>{}<td><code>{}</code></tr>",
                escape(&m.name),
                escape(&m.licence),
                escape(&m.sha256)
            );
        }
        out.push_str("</table>");
    }
    let settings = serde_json::to_string_pretty(&run.config).unwrap_or_default();
    let statistics = serde_json::to_string_pretty(&run.statistics).unwrap_or_default();
    let _ = write!(out, "<details><summary>Settings</summary><pre>{}</pre></details>", escape(&settings));
    let _ = write!(
        out,
        "<details><summary>Statistics</summary><pre>{}</pre></details></section>",
        escape(&statistics)
    );
    out
}

#[cfg(test)]
mod tests {
    use super::super::RunRecord;
    use super::*;
    use crate::photo::Light;
    use crate::progress::StageRecord;
    use crate::scene::Image;

    #[test]
    fn html_report_is_self_contained() {
        let photo = RgbImage { width: 8, height: 6, data: vec![[0.5, 0.2, 0.1]; 48] };
        let (depth, relevancy) = (Image::filled(8, 6, 2.0f32), Image::filled(8, 6, 0.9f32));
        let levels = [("l", Image::filled(8, 6, 1i32))];
        let run = RunRecord {
            program: "splatvk".into(),
            config: serde_json::json!({"views": 4}),
            seed: 7,
            device: "<device>".into(),
            device_is_cpu: true,
            models: vec![],
            stages: vec![StageRecord {
                name: "train".into(),
                start: 0.5,
                seconds: 3.0,
                peak_memory: 1 << 30,
            }],
            seconds: 3.5,
            statistics: serde_json::json!({"psnr": 31.5}),
            warnings: vec!["a < b".into()],
        };
        let view = ViewShown {
            name: "a",
            photo: &photo,
            render: Some(&photo),
            depth: Some(&depth),
            levels: &levels,
            psnr: Some(31.25),
            light: Light { gain: [1.2; 3], ..Light::NONE },
        };
        let answer =
            AnswerShown { view: 0, relevancy: &relevancy, mask: None, score: 0.9, found: true, level: "l" };
        let report = HtmlReport {
            title: "a <b> & \"c\"",
            views: vec![view],
            queries: vec![QueryShown {
                text: "<script>",
                verdict: "found in 1 of 1 photos".into(),
                answers: vec![answer],
            }],
            curves: vec![
                Curve { name: "PSNR", unit: "dB", points: vec![(1.0, 21.0), (100.0, 32.456)] },
                Curve { name: "nothing", unit: "", points: vec![(1.0, 1.0)] },
            ],
            space: Some("words/x"),
            scene: None,
            figures: vec![("splats".into(), "123".into())],
            run: &run,
        };
        let folder = tempfile::tempdir().unwrap();
        write_html(folder.path(), &report).unwrap();
        super::super::write_previews(folder.path(), &report).unwrap();
        run.write(folder.path()).unwrap();
        let html = std::fs::read_to_string(folder.path().join("report.html")).unwrap();
        // Photo, render, depth, one level, one heat map; no requests; user text is escaped.
        assert_eq!(html.matches("data:image/jpeg;base64,").count(), 5);
        assert!(!html.contains("http") && !html.contains("<script>") && html.contains("&lt;script&gt;"));
        for text in [
            "31.2 dB",
            "evened out: +0.26 EV",
            "about a thousand everyday things",
            "CLIP is the full",
            "a &lt; b",
            "1.07 GB",
            "found in 1 of 1",
            "at the end 32.46 dB",
        ] {
            assert!(html.contains(text), "{text}");
        }
        assert_eq!(html.matches("<svg").count(), 1, "a single point is no curve");
        for name in ["a_render.jpg", "a_depth.jpg", "a_level_l.jpg", "query__script__a.jpg"] {
            assert!(image::open(folder.path().join("previews").join(name)).is_ok(), "{name}");
        }
        let json: serde_json::Value =
            serde_json::from_str(&std::fs::read_to_string(folder.path().join("run.json")).unwrap()).unwrap();
        assert_eq!(json["stages"][0]["name"], "train");
    }
}
