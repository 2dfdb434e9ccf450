//! Records of a run: `run.json`, `report.html`, `previews/`, the closing table on the terminal.
mod bare;
pub mod chart;
pub mod colour;
mod contents;
mod figures;
mod html;
mod line;
mod summary;
pub mod viewer;

pub use chart::escape;
pub use contents::{
    AnswerShown, Certainty, Curve, Figure, HtmlReport, ModelUsed, QueryShown, RunRecord, ViewShown,
};
pub use html::write_html;
pub use line::{one_line, shell_quoted, thousands, visible};
pub use summary::{duration, table};

pub use crate::progress::StageRecord;

use crate::format::{create_folder, picture};
use crate::scene::{Image, RgbImage};
use crate::{Error, Result};
use rayon::prelude::*;
use std::borrow::Cow;
use std::collections::BTreeMap;
use std::path::Path;

/// A picture of a view.
enum Picture<'a> {
    Plain(&'a RgbImage),
    Depth(&'a Image<f32>),
    Labels(&'a Image<i32>),
    /// Answer to a query, over its photo.
    Heat(&'a RgbImage, &'a AnswerShown),
    /// An unsure answer: its outline only, since heat reads as a find.
    Outline(&'a RgbImage, Option<&'a Image<bool>>),
}

impl Picture<'_> {
    fn image(&self) -> Cow<'_, RgbImage> {
        match self {
            Picture::Plain(image) => Cow::Borrowed(*image),
            Picture::Depth(depth) => Cow::Owned(colour::depth_image(depth)),
            Picture::Labels(codes) => Cow::Owned(colour::label_image(codes)),
            Picture::Heat(photo, answer) => {
                Cow::Owned(colour::heat_image(photo, &answer.relevancy, answer.mask.as_ref()))
            }
            Picture::Outline(photo, mask) => Cow::Owned(colour::outline_image(photo, *mask)),
        }
    }
}

/// Writes `previews/`: render, depth and levels per view, a heat map per query and view.
pub fn write_previews(folder: &Path, report: &HtmlReport) -> Result<()> {
    let folder = folder.join("previews");
    create_folder(&folder)?;
    // By name: of two queries whose names of files are equal, the last one stays.
    let mut pictures: BTreeMap<String, Picture> = BTreeMap::new();
    for v in &report.views {
        pictures.extend(v.render.map(|render| (format!("{}_render.jpg", v.name), Picture::Plain(render))));
        pictures.extend(v.depth.map(|depth| (format!("{}_depth.jpg", v.name), Picture::Depth(depth))));
        let levels = v.levels.iter();
        pictures.extend(
            levels.map(|(name, codes)| (format!("{}_level_{name}.jpg", v.name), Picture::Labels(codes))),
        );
    }
    for q in &report.queries {
        for a in &q.answers {
            if let Some(v) = report.views.get(a.view) {
                let name = format!("query_{}_{}.jpg", file_name(q.text), v.name);
                pictures.insert(name, Picture::Heat(v.photo, a));
            }
        }
    }
    let save = |(name, picture): (&String, &Picture)| {
        let path = folder.join(name);
        std::fs::write(&path, picture::jpeg_bytes(&picture.image(), 90)?).map_err(Error::unwritable(&path))
    };
    pictures.par_iter().map(save).collect::<Vec<_>>().into_iter().collect()
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
