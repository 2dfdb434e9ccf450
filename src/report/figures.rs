//! Figures of a run, its curves, times, models and settings as parts of the page.
use super::chart::{self, escape};
use super::{Curve, Figure, HtmlReport, duration};
use std::fmt::Write;

/// The figures that matter with their meaning; everything else is folded.
pub(super) fn section(report: &HtmlReport) -> String {
    let (shown, folded): (Vec<&Figure>, Vec<&Figure>) = report.figures.iter().partition(|f| f.matters);
    let run = report.run;
    let kind = if run.device_is_cpu { ", which computes on the CPU" } else { "" };
    let mut rows: String = shown.into_iter().map(row).collect();
    rows += &row(&Figure::that_matters(
        "time",
        format!("{} on {}{kind}", duration(run.seconds), run.device),
        "From the photos to the finished scene.",
    ));
    let all: String = folded.into_iter().map(row).collect();
    let charts: String = report.curves.iter().map(curve).collect();
    let mut out = format!("<section><h2>Figures</h2><dl class=\"figures\">{rows}</dl>");
    out += &fold("More figures", &format!("<dl class=\"figures\">{all}</dl>"), &all);
    out += &fold("Training", &format!("<div class=\"row curves\">{charts}</div>"), &charts);
    out + &tables(report) + "</section>"
}

fn row(figure: &Figure) -> String {
    let Figure { label, value, meaning, .. } = figure;
    format!("<dt>{}</dt><dd>{}<p>{}</p></dd>", escape(label), escape(value), escape(meaning))
}

/// A folded part; nothing where `content` is empty.
fn fold(title: &str, body: &str, content: &str) -> String {
    if content.is_empty() {
        return String::new();
    }
    format!("<details><summary>{title}</summary>{body}</details>")
}

/// Chart of a curve with its last value in the caption; empty for a curve without two points.
fn curve(curve: &Curve) -> String {
    let svg = chart::line_chart(&curve.points, "step", curve.name);
    let (Some((_, last)), false) = (curve.points.last(), svg.is_empty()) else { return String::new() };
    let decimals = if last.abs() >= 1000.0 { 0 } else { 2 + usize::from(last.abs() < 1.0) };
    let unit = if curve.unit.is_empty() { String::new() } else { format!(" {}", curve.unit) };
    format!("<figure>{svg}<figcaption>at the end {last:.decimals$}{unit}</figcaption></figure>")
}

fn tables(report: &HtmlReport) -> String {
    let run = report.run;
    let mut times =
        String::from("<table class=\"time\"><tr><th>stage<th>time; bars show when<th>peak memory</tr>");
    let percent = |seconds: f64| seconds / run.seconds.max(1e-9) * 100.0;
    for s in &run.stages {
        let memory =
            if s.peak_memory > 0 { format!("{:.2} GB", s.peak_memory as f64 / 1e9) } else { "–".into() };
        let (from, share) = (percent(s.start), percent(s.seconds));
        // Writing to a String cannot fail.
        let _ = write!(
            times,
            "<tr><td>{}<td>{}<i style=\"margin-left:{from:.1}%;width:{share:.1}%\"></i><td>{memory}</tr>",
            escape(&s.name),
            duration(s.seconds)
        );
    }
    let _ = write!(
        times,
        "<tr><td>total<td>{}<td></tr></table><p class=\"small\">Stages overlap. Seed {}.</p>",
        duration(run.seconds),
        run.seed
    );
    let mut models = String::from("<table><tr><th>model<th>licence<th>sha256</tr>");
    for m in &run.models {
        let _ = write!(
            models,
            "<tr><td>{}<td>{}<td><code>{}</code></tr>",
            escape(&m.name),
            escape(&m.licence),
            escape(&m.sha256)
        );
    }
    models.push_str("</table>");
    let first = run.models.first().map_or("", |m| m.name.as_str());
    let json = |value: &serde_json::Value| {
        let text = serde_json::to_string_pretty(value).unwrap_or_default();
        format!("<pre>{}</pre>", escape(&text))
    };
    fold("Time and memory", &times, &times)
        + &fold("Models", &models, first)
        + &fold("Settings", &json(&run.config), "settings")
        + &fold("Statistics", &json(&run.statistics), "statistics")
}
