//! The results of a batch for people and spreadsheets: `summary.csv` and `index.html`.
use super::manifest::Manifest;
use super::store::Store;
use crate::report::escape;
use crate::{Error, Result};
use serde_json::Value;
use std::fmt::Write;

/// A row with its last result.
pub struct RowState<'a> {
    /// Row.
    pub id: &'a str,
    /// "done", a kind of failure, or "open".
    pub state: &'static str,
    /// `_SUCCESS.json` of a finished row.
    pub success: Option<Value>,
    /// Reason of a failure.
    pub error: String,
}

/// The states of all rows of the manifest.
pub fn states<'a>(manifest: &'a Manifest, store: &Store) -> Vec<RowState<'a>> {
    let state = |id: &'a str| match (store.success(id), store.failure(id)) {
        // A changed row that failed keeps its earlier result, which is not that of the manifest.
        (success, Some(failure)) => {
            RowState { id, state: failure.kind.name(), success, error: failure.message }
        }
        (Some(success), None) => RowState { id, state: "done", success: Some(success), error: String::new() },
        (None, None) => RowState { id, state: "open", success: None, error: String::new() },
    };
    manifest.rows.iter().map(|row| state(&row.id)).collect()
}

/// Columns of the table.
const COLUMNS: [&str; 12] = [
    "id",
    "state",
    "seconds",
    "device",
    "photos",
    "psnr",
    "rotation_sigma_degrees",
    "splats",
    "answers_found",
    "warnings",
    "error",
    "scene",
];

/// Writes the table and the page of all rows.
pub fn write(manifest: &Manifest, store: &Store) -> Result<()> {
    // Shards may end at the same moment: the last to write has seen the rows of all.
    store.alone(|| {
        let states = states(manifest, store);
        store.write("summary.csv", &csv(&states)?)?;
        store.write("index.html", page(&states).as_bytes())
    })
}

fn csv(states: &[RowState<'_>]) -> Result<Vec<u8>> {
    let wrong = |e: csv::Error| Error::work(format!("summary.csv: {e}"));
    let mut table = csv::Writer::from_writer(Vec::new());
    table.write_record(COLUMNS).map_err(wrong)?;
    for row in states {
        let of = |field: &str| row.success.as_ref().map_or(&Value::Null, |s| &s[field]);
        let number = |field: &str, digits: usize| {
            of(field).as_f64().map(|v| format!("{v:.digits$}")).unwrap_or_default()
        };
        let device = of("device")["name"].as_str().unwrap_or_default().to_owned();
        let scene = row.success.as_ref().map(|s| format!("{}/scene", folder(row.id, s))).unwrap_or_default();
        let (found, warnings) = (found(of("answers")), of("warnings").as_array().map_or(0, Vec::len));
        let counts = row.success.as_ref().map(|_| (found.to_string(), warnings.to_string()));
        let (found, warnings) = counts.unwrap_or_default();
        table
            .write_record([
                row.id,
                row.state,
                &number("seconds", 1),
                &device,
                &number("photos", 0),
                &number("psnr", 2),
                &number("rotation_sigma_degrees", 3),
                &number("splats", 0),
                &found,
                &warnings,
                &row.error,
                &scene,
            ])
            .map_err(wrong)?;
    }
    table.into_inner().map_err(|e| Error::work(format!("summary.csv: {e}")))
}

/// Folder of the scene and the exports below that of the batch. A cluster writes them to one of its
/// own.
fn folder(id: &str, success: &Value) -> String {
    match success["at"].as_str().filter(|at| *at != ".") {
        Some(at) => format!("{id}/{at}"),
        None => id.to_owned(),
    }
}

/// Number of queries that were found.
fn found(answers: &Value) -> usize {
    answers.as_array().map_or(0, |all| all.iter().filter(|a| a["found"] == true).count())
}

const STYLE: &str = "body{font:16px/1.4 system-ui,sans-serif;margin:2rem;color:#222;background:#fff}\
 ul{list-style:none;padding:0;display:grid;grid-template-columns:repeat(auto-fill,minmax(15rem,1fr));gap:1rem}\
 li{border:1px solid #ccc;border-radius:8px;overflow:hidden}\
 a{color:inherit;text-decoration:none;display:block}a:hover{background:#f3f3f3}\
 img,.none{width:100%;aspect-ratio:4/3;object-fit:cover;background:#eee;display:block}\
 p{margin:.5rem .75rem}small{color:#555}b.bad{color:#a00}\
 @media(prefers-color-scheme:dark){body{color:#ddd;background:#161616}li{border-color:#444}\
 a:hover{background:#222}.none,img{background:#222}small{color:#aaa}b.bad{color:#f88}}";

/// A page with a picture per row that links its report.
fn page(states: &[RowState<'_>]) -> String {
    let done = states.iter().filter(|s| s.state == "done").count();
    let failed = states.iter().filter(|s| !["done", "open"].contains(&s.state)).count();
    let mut page = format!(
        "<!doctype html><html lang=\"en\"><meta charset=\"utf-8\"><meta name=\"viewport\" content=\"width=device-width\">\
         <title>{done} of {} captures</title><style>{STYLE}</style><h1>{done} of {} captures are done{}</h1><ul>\n",
        states.len(),
        states.len(),
        if failed > 0 { format!(", {failed} failed") } else { String::new() }
    );
    for row in states {
        page.push_str("<li>");
        page.push_str(&card(row));
        page.push_str("</li>\n");
    }
    page.push_str("</ul></html>\n");
    page
}

fn card(row: &RowState<'_>) -> String {
    let id = escape(row.id);
    let mut card = String::new();
    let Some(success) = &row.success else {
        let class = if row.state == "open" { "" } else { " class=\"bad\"" };
        let error = escape(&row.error);
        return format!(
            "<div class=\"none\"></div><p><b{class}>{id}: {}</b><br><small>{error}</small></p>",
            row.state
        );
    };
    let place = escape(&folder(row.id, success));
    let files = success["files"].as_array().into_iter().flatten();
    let mut pictures = files.filter_map(|f| f["path"].as_str()).filter(|p| p.ends_with("_render.jpg"));
    let picture = pictures.next().map_or_else(
        || "<div class=\"none\"></div>".to_owned(),
        |path| format!("<img loading=\"lazy\" alt=\"\" src=\"{place}/{}\">", escape(path)),
    );
    let _ = write!(card, "<a href=\"{place}/scene/report.html\">{picture}<p><b>{id}</b><br><small>");
    let figure = |field: &str| success[field].as_f64();
    let psnr = figure("psnr").map(|v| format!("{v:.1} dB · ")).unwrap_or_default();
    let _ = write!(
        card,
        "{} photos · {psnr}{:.0} s",
        figure("photos").unwrap_or(0.0),
        figure("seconds").unwrap_or(0.0)
    );
    for answer in success["answers"].as_array().into_iter().flatten() {
        let text = |field: &str| escape(answer[field].as_str().unwrap_or_default());
        let _ = write!(card, "<br>{}: {}", text("text"), text("presence"));
    }
    for warning in success["warnings"].as_array().into_iter().flatten().filter_map(Value::as_str) {
        let _ = write!(card, "<br>⚠ {}", escape(warning));
    }
    card.push_str("</small>");
    if row.state != "done" {
        let _ =
            write!(card, "<br><b class=\"bad\">{}</b><br><small>{}</small>", row.state, escape(&row.error));
    }
    card.push_str("</p></a>");
    card
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn rows() -> Vec<RowState<'static>> {
        let success = json!({
            "seconds": 12.34, "psnr": 30.126, "photos": 4, "splats": 1000, "device": { "name": "GPU <1>" },
            "answers": [{ "text": "mug", "presence": "present", "found": true }, { "text": "<b>", "presence": "absent", "found": false }],
            "warnings": ["a & b"], "files": [{ "path": "scene/previews/x_render.jpg" }],
        });
        let row = |id, state, success, error: &str| RowState { id, state, success, error: error.to_owned() };
        vec![
            row("a", "done", Some(success), ""),
            row("b", "refused", None, "no \"overlap\", <x>"),
            row("c", "open", None, ""),
        ]
    }

    #[test]
    fn table_has_a_record_per_row() {
        let text = String::from_utf8(csv(&rows()).unwrap()).unwrap();
        let lines: Vec<&str> = text.lines().collect();
        assert_eq!(lines[1], "a,done,12.3,GPU <1>,4,30.13,,1000,1,1,,a/scene");
        assert_eq!(lines[2], "b,refused,,,,,,,,,\"no \"\"overlap\"\", <x>\",");
        assert_eq!(lines.len(), 4);
    }

    #[test]
    fn page_escapes_what_it_shows() {
        let page = page(&rows());
        assert!(page.contains("1 of 3 captures are done, 1 failed"));
        assert!(page.contains("src=\"a/scene/previews/x_render.jpg\"") && page.contains("mug: present"));
        assert!(page.contains("a &amp; b") && !page.contains("<x>") && !page.contains("<b>:"));
    }
}
