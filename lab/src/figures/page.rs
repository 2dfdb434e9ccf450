//! Sections of pictures as a page.
use splatvk::report::chart::escape;
use splatvk::scene::RgbImage;
use std::fmt::Write;

/// A table of pictures.
pub struct Section {
    /// Beginning of its file names.
    pub name: &'static str,
    /// Subject of the pictures.
    pub about: String,
    /// Headings.
    pub columns: Vec<String>,
    /// One row per question or photo.
    pub rows: Vec<Row>,
}

/// A row of pictures.
pub struct Row {
    /// Phrase or photo.
    pub name: String,
    /// One picture per column.
    pub tiles: Vec<Tile>,
}

/// A picture.
pub struct Tile {
    /// The picture.
    pub image: RgbImage,
    /// A few words below it; may be empty.
    pub caption: String,
}

impl Tile {
    pub(super) fn plain(image: RgbImage) -> Tile {
        Tile { image, caption: String::new() }
    }
}

const STYLE: &str = "body{font:15px system-ui,sans-serif;margin:2em;color:#222;background:#fff}\
table{border-collapse:collapse;margin-bottom:2.5em}th{font-weight:600;text-align:left;padding:.2em .4em}\
td{padding:.2em .4em;vertical-align:top}img{width:12em;display:block}td span{font-size:13px;color:#555}";

impl Section {
    /// File of a picture, relative to the page.
    pub fn file(&self, row: usize, column: usize) -> String {
        format!("{}/{}-{}.png", self.name, row + 1, column + 1)
    }

    fn table(&self) -> String {
        let mut out = format!("<h2>{}</h2><p>{}</p><table><tr><th></th>", self.name, escape(&self.about));
        self.columns.iter().for_each(|c| push(&mut out, format_args!("<th>{}</th>", escape(c))));
        out.push_str("</tr>");
        for (r, row) in self.rows.iter().enumerate() {
            push(&mut out, format_args!("<tr><th>{}</th>", escape(&row.name)));
            for (c, tile) in row.tiles.iter().enumerate() {
                let (file, caption) = (self.file(r, c), escape(&tile.caption));
                let name = escape(&format!("{}, {}", row.name, self.columns[c]));
                push(
                    &mut out,
                    format_args!("<td><img src=\"{file}\" alt=\"{name}\"><span>{caption}</span></td>"),
                );
            }
            out.push_str("</tr>");
        }
        out + "</table>"
    }
}

/// Writing to a String cannot fail.
fn push(out: &mut String, text: std::fmt::Arguments) {
    let _ = out.write_fmt(text);
}

/// The page of a data set.
pub fn page(title: &str, sections: &[Section]) -> String {
    let title = escape(title);
    let body: String = sections.iter().map(Section::table).collect();
    format!(
        "<!doctype html><html lang=\"en\"><meta charset=\"utf-8\"><title>{title}</title><style>{STYLE}</style>\
         <h1>{title}</h1>{body}</html>\n"
    )
}
