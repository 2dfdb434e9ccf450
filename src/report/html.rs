//! `report.html`, one self-contained file, readable on a phone.
use super::chart::escape;
use super::{AnswerShown, Certainty, HtmlReport, Picture, QueryShown, ViewShown, figures, one_line, viewer};
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
    let (scene, (words, views)) = rayon::join(
        || report.scene.as_ref().map(|scene| scene.embedded()).transpose(),
        || rayon::join(|| words(report), || joined(report.views.par_iter().map(view_row))),
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
    body.push_str(&words?);
    body.push_str("<section><h2>Photos</h2>");
    body.push_str(&views?);
    body.push_str("</section>");
    body.push_str(&figures::section(report));
    Ok(format!(
        "<!doctype html><html lang=\"en\"><meta charset=\"utf-8\"><meta name=\"viewport\" \
         content=\"width=device-width, initial-scale=1\"><title>{title} · splatvk</title><style>{STYLE}{}</style>\
         <main>{body}</main></html>\n",
        viewer::STYLE
    ))
}

/// A photo beside its render; depth and levels are folded.
fn view_row(v: &ViewShown) -> Result<String> {
    let light = match v.light.is_none() {
        true => String::new(),
        false => format!(", evened out: {}", v.light.summary()),
    };
    let mut pair = vec![(Picture::Plain(v.photo), format!("photo{light}"))];
    if let Some(render) = v.render {
        let caption = v.psnr.map_or("the scene".to_string(), |p| format!("the scene, PSNR {p:.1} dB"));
        pair.push((Picture::Plain(render), caption));
    }
    let mut more = Vec::new();
    if let Some(depth) = v.depth {
        more.push((Picture::Depth(depth), "depth (near is warm)".to_owned()));
    }
    for (level, codes) in v.levels {
        let long = match *level {
            "s" => "subparts",
            "m" => "parts",
            "l" => "things",
            other => other,
        };
        more.push((Picture::Labels(codes), long.to_owned()));
    }
    let figures = |pictures: &[(Picture, String)]| {
        joined(pictures.par_iter().map(|(picture, caption)| figure(&picture.image(), caption)))
    };
    let folded = match more.is_empty() {
        true => String::new(),
        false => format!(
            "<details><summary>Depth and parts</summary><div class=\"row\">{}</div></details>",
            figures(&more)?
        ),
    };
    let name = escape(v.name);
    Ok(format!("<h3>{name}</h3><div class=\"row pair\">{}</div>{folded}", figures(&pair)?))
}

/// The parts in their order, or the first error.
fn joined(parts: impl IndexedParallelIterator<Item = Result<String>>) -> Result<String> {
    parts.collect::<Vec<_>>().into_iter().collect()
}

/// Answers of the run, the things to click, which the viewer's script lists, and what the words
/// are.
fn words(report: &HtmlReport) -> Result<String> {
    let mut out = String::new();
    if !report.queries.is_empty() {
        out.push_str("<section><h2>Words</h2>");
        out.push_str(&joined(report.queries.par_iter().map(|q| query_row(report, q)))?);
        out.push_str("</section>");
    }
    if report.scene.is_some() && report.space.is_some() {
        out.push_str(
            "<section id=\"v-things\" hidden><h2>Things</h2><p class=\"small\">What the scene is divided into, \
             largest first. Click one, here or in the scene. It has a name only where one is clear.</p>\
             <div class=\"things\"></div></section>",
        );
    }
    if report.space.is_some_and(|s| s.starts_with("words")) {
        out.push_str(
            "<p class=\"small\">Words come from the built-in model: an image classifier of about a thousand \
             everyday things and eight surfaces such as wall and floor, joined to English nouns. It is a light stand-in; \
             CLIP is the full model.</p>",
        );
    }
    Ok(out)
}

fn query_row(report: &HtmlReport, q: &QueryShown) -> Result<String> {
    let class = match q.certainty {
        Certainty::Found => "yes",
        Certainty::Unsure => "unsure",
        Certainty::Nothing => "no",
    };
    let heat = |a: &AnswerShown| {
        let Some(view) = report.views.get(a.view) else { return Ok(String::new()) };
        let (picture, what) = match (q.certainty, a.found) {
            (Certainty::Nothing, _) => (Picture::Heat(view.photo, a), "nearest is warm"),
            (_, false) => (Picture::Outline(view.photo, None), "not seen"),
            (Certainty::Unsure, true) => {
                (Picture::Outline(view.photo, a.mask.as_ref()), "perhaps what is outlined")
            }
            (Certainty::Found, true) => (Picture::Heat(view.photo, a), "outlined"),
        };
        figure(&picture.image(), &format!("{}: {what}", view.name))
    };
    let figures = joined(q.answers.par_iter().map(heat))?;
    let mut row = format!("<div class=\"row\">{figures}</div>");
    if q.certainty == Certainty::Nothing {
        row = format!("<details><summary>What is nearest to these words</summary>{row}</details>");
    }
    let text = escape(&one_line(q.text));
    Ok(format!(
        "<h3><button type=\"button\" data-ask=\"{}\" title=\"Show it in the scene\">“{text}”</button> \
         <span class=\"{class}\">{}</span></h3>{row}",
        escape(q.text),
        escape(&q.verdict)
    ))
}

#[cfg(test)]
mod tests {
    use super::super::{Curve, Figure, RunRecord};
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
        let mask = Image::filled(8, 6, true);
        let answer =
            |found| AnswerShown { view: 0, relevancy: relevancy.clone(), mask: Some(mask.clone()), found };
        let query = |text, verdict: &str, certainty| QueryShown {
            text,
            verdict: verdict.into(),
            certainty,
            answers: vec![answer(certainty != Certainty::Nothing)],
        };
        let report = HtmlReport {
            title: "a <b> & \"c\"",
            views: vec![view],
            queries: vec![
                query("<script>", "found in 1 of 1 photos", Certainty::Found),
                query("tree", "unsure; if it is here, in 1 of 1 photos", Certainty::Unsure),
                query("moon", "no sign of it", Certainty::Nothing),
            ],
            curves: vec![
                Curve { name: "PSNR", unit: "dB", points: vec![(1.0, 21.0), (100.0, 32.456)] },
                Curve { name: "nothing", unit: "", points: vec![(1.0, 1.0)] },
            ],
            space: Some("words/x"),
            scene: None,
            figures: vec![
                Figure::new("splats", "123".into(), "How many."),
                Figure::that_matters("cameras", "high confidence".into(), "Where the photos stand."),
            ],
            run: &run,
        };
        let folder = tempfile::tempdir().unwrap();
        write_html(folder.path(), &report).unwrap();
        super::super::write_previews(folder.path(), &report).unwrap();
        run.write(folder.path()).unwrap();
        let html = std::fs::read_to_string(folder.path().join("report.html")).unwrap();
        // Photo, render, depth, one level, three answers; no requests; user text is escaped.
        assert_eq!(html.matches("data:image/jpeg;base64,").count(), 7);
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
            "class=\"yes\">found",
            "class=\"unsure\">unsure; if it is here",
            "a: perhaps what is outlined",
            "class=\"no\">no sign of it",
            "Where the photos stand.",
        ] {
            assert!(html.contains(text), "{text}");
        }
        // Words, photos, figures; details are folded.
        let at = |text: &str| html.find(text).unwrap_or_else(|| panic!("{text}"));
        let order =
            ["<h2>Words", "thousand everyday", "<h2>Photos", "<h2>Figures", "<dt>cameras", "<dt>splats"];
        assert!(order.windows(2).all(|pair| at(pair[0]) < at(pair[1])));
        assert!(
            at("<summary>More figures") < at("<dt>splats") && at("<dt>cameras") < at("<summary>More figures")
        );
        assert_eq!(html.matches("<svg").count(), 1, "a single point is no curve");
        for name in ["a_render.jpg", "a_depth.jpg", "a_level_l.jpg", "query__script__a.jpg"] {
            assert!(image::open(folder.path().join("previews").join(name)).is_ok(), "{name}");
        }
        let json: serde_json::Value =
            serde_json::from_str(&std::fs::read_to_string(folder.path().join("run.json")).unwrap()).unwrap();
        assert_eq!(json["stages"][0]["name"], "train");
    }
}
