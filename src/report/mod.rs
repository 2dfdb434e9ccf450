//! Records of a run: `run.json`, `report.html`, `previews/`, the closing table on the terminal.
mod bare;
pub mod chart;
pub mod colour;
mod contents;
mod html;
mod line;
mod summary;
pub mod viewer;

pub use contents::{AnswerShown, Curve, HtmlReport, ModelUsed, QueryShown, RunRecord, ViewShown};
pub use html::write_html;
pub use line::{one_line, visible};
pub use summary::{duration, table};

pub use crate::progress::StageRecord;

use crate::format::{create_folder, picture};
use crate::scene::RgbImage;
use crate::{Error, Result};
use std::path::Path;

/// Writes `previews/`: render, depth and levels per view, a heat map per query and view.
pub fn write_previews(folder: &Path, report: &HtmlReport) -> Result<()> {
    let folder = folder.join("previews");
    create_folder(&folder)?;
    let save = |name: String, image: &RgbImage| {
        let path = folder.join(name);
        std::fs::write(&path, picture::jpeg_bytes(image, 90)?).map_err(Error::unwritable(&path))
    };
    for v in &report.views {
        if let Some(render) = v.render {
            save(format!("{}_render.jpg", v.name), render)?;
        }
        if let Some(depth) = v.depth {
            save(format!("{}_depth.jpg", v.name), &colour::depth_image(depth))?;
        }
        for (level, codes) in v.levels {
            save(format!("{}_level_{level}.jpg", v.name), &colour::label_image(codes))?;
        }
    }
    for q in &report.queries {
        for a in &q.answers {
            if let Some(v) = report.views.get(a.view) {
                let heat = colour::heat_image(v.photo, a.relevancy, a.mask);
                save(format!("query_{}_{}.jpg", file_name(q.text), v.name), &heat)?;
            }
        }
    }
    Ok(())
}

/// Converts a text to a part of a file name: letters and digits stay, other characters become `_`.
pub fn file_name(text: &str) -> String {
    let mut safe = String::new();
    for c in text.trim().chars().map(|c| if c.is_alphanumeric() { c } else { '_' }).take(60) {
        // File names have at most 255 bytes, and also contain the name of a view.
        if safe.len() + c.len_utf8() > 120 {
            break;
        }
        safe.push(c);
    }
    if safe.is_empty() { "_".into() } else { safe }
}
