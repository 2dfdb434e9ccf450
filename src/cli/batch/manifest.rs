//! The rows of a batch: JSON lines, a table `id,input`, or a folder of folders.
use crate::error::words;
use crate::files;
use crate::{Error, Result};
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};
use std::collections::HashMap;
use std::io::Read;
use std::path::{Path, PathBuf};

/// Longest `id`; folders of attempts add a key and a number to it.
const LONGEST_ID: usize = 100;

/// One capture. Paths are relative to the folder of the manifest.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Row {
    /// Name of the result's folder.
    pub id: String,
    /// Photos, folders, patterns such as `kitchen/*.jpg`, or a video.
    #[serde(deserialize_with = "one_or_more")]
    pub input: Vec<String>,
    /// Options of `splatvk run`, with underscores.
    #[serde(default)]
    pub options: Map<String, Value>,
    /// Texts to ask the finished scene.
    #[serde(default)]
    pub queries: Vec<String>,
    /// Files to export: endings, formats (`colmap`), or names with an ending.
    #[serde(default)]
    pub exports: Vec<String>,
}

/// The rows of a batch, with unique ids.
#[derive(Debug)]
pub struct Manifest {
    /// The rows, in their order.
    pub rows: Vec<Row>,
    /// The folder that paths are relative to.
    pub base: PathBuf,
}

impl Manifest {
    /// Reads a file of rows, standard input (`-`), or a folder, whose folders become rows, but not
    /// that of the results, `out`.
    ///
    /// # Errors
    /// A file that cannot be read, no row, or a wrong one; the message has its line.
    pub fn read(place: &Path, out: &Path) -> Result<Manifest> {
        let base = match place.parent() {
            _ if place == Path::new("-") => PathBuf::from("."),
            _ if place.is_dir() => place.to_path_buf(),
            Some(parent) if parent != Path::new("") => parent.to_path_buf(),
            _ => PathBuf::from("."),
        };
        let rows = if place == Path::new("-") {
            let mut text = String::new();
            std::io::stdin().read_to_string(&mut text).map_err(Error::io("standard input"))?;
            json_lines(&text, place)?
        } else if place.is_dir() {
            folders(place, out)?
        } else if place.extension().is_some_and(|e| e.eq_ignore_ascii_case("csv")) {
            table(&files::read_text(place)?, place)?
        } else {
            json_lines(&files::read_text(place)?, place)?
        };
        if rows.is_empty() {
            return Err(Error::input(format!(
                "{}: no row; give lines of JSON with id and input, a .csv with these columns, or a folder of folders of photos",
                place.display()
            )));
        }
        unique(&rows, place)?;
        let base = std::path::absolute(&base).map_err(Error::io(&base))?;
        Ok(Manifest { rows, base })
    }
}

/// A row per line; empty lines are left out.
fn json_lines(text: &str, place: &Path) -> Result<Vec<Row>> {
    let lines = text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty());
    let read = |(i, line): (usize, &str)| {
        let row = files::parse_json::<Row>(line.as_bytes()).and_then(checked);
        row.map_err(|e| Error::input(format!("{}, line {}: {e}", place.display(), i + 1)))
    };
    lines.map(read).collect()
}

/// A table with the columns `id` and `input`.
fn table(text: &str, place: &Path) -> Result<Vec<Row>> {
    let wrong = |line: u64, e: &str| Error::input(format!("{}, line {line}: {e}", place.display()));
    let mut reader = csv::ReaderBuilder::new().trim(csv::Trim::All).from_reader(text.as_bytes());
    let header = reader.headers().map_err(|e| wrong(1, &e.to_string()))?.clone();
    let column = |name: &str| {
        let mut found = header.iter().enumerate().filter(|(_, h)| *h == name).map(|(i, _)| i);
        match (found.next(), found.next()) {
            (Some(i), None) => Ok(i),
            (None, _) => Err(wrong(1, &format!("there is no column {name}"))),
            _ => Err(wrong(1, &format!("there are two columns {name}"))),
        }
    };
    let (id, input) = (column("id")?, column("input")?);
    if let Some(other) = header.iter().find(|h| *h != "id" && *h != "input") {
        return Err(wrong(1, &format!("column `{other}` has no meaning; options need lines of JSON")));
    }
    let mut rows = Vec::new();
    for record in reader.records() {
        let record =
            record.map_err(|e| wrong(e.position().map_or(0, csv::Position::line), &e.to_string()))?;
        let field = |i: usize| record.get(i).unwrap_or_default().to_owned();
        let row = checked(Row {
            id: field(id),
            input: vec![field(input)],
            options: Map::new(),
            queries: Vec::new(),
            exports: Vec::new(),
        });
        rows.push(row.map_err(|e| wrong(record.position().map_or(0, csv::Position::line), &e))?);
    }
    Ok(rows)
}

/// A row per folder; hidden ones and `out` are left out.
fn folders(place: &Path, out: &Path) -> Result<Vec<Row>> {
    let out = out.canonicalize().ok();
    let entries = std::fs::read_dir(place).map_err(Error::io(place))?;
    let mut rows = Vec::new();
    for entry in entries {
        let path = entry.map_err(Error::io(place))?.path();
        let Some(name) = path.file_name().filter(|_| path.is_dir()) else { continue };
        let name = name.to_string_lossy().into_owned();
        if name.starts_with('.') || out.is_some() && path.canonicalize().ok() == out {
            continue;
        }
        let row = checked(Row {
            id: name.clone(),
            input: vec![name.clone()],
            options: Map::new(),
            queries: Vec::new(),
            exports: Vec::new(),
        });
        rows.push(row.map_err(|e| Error::input(format!("{}: {e}; rename the folder", path.display())))?);
    }
    rows.sort_by(|a, b| a.id.cmp(&b.id));
    Ok(rows)
}

/// The row, unless its id is no name of a folder or its input is empty.
fn checked(row: Row) -> Result<Row, String> {
    let allowed = |c: char| c.is_ascii_alphanumeric() || "._-".contains(c);
    let id = &row.id;
    if id.is_empty() || id.len() > LONGEST_ID || id.starts_with(['.', '_', '-']) || !id.chars().all(allowed) {
        return Err(format!(
            "id {id:?}: give 1 to {LONGEST_ID} of the letters a to z, digits, dots, dashes and underscores, beginning with a letter or digit"
        ));
    }
    if ["index.html", "summary.csv", "events.jsonl"].contains(&id.to_lowercase().as_str()) {
        return Err(format!("id {id:?}: a file of the batch has this name; give another"));
    }
    if row.input.iter().all(|i| i.is_empty()) || row.input.iter().any(|i| i.is_empty()) {
        return Err(format!("row {id}: input is empty"));
    }
    Ok(row)
}

/// File systems may not tell the case of letters apart.
fn unique(rows: &[Row], place: &Path) -> Result<()> {
    let mut seen: HashMap<String, &str> = HashMap::new();
    for row in rows {
        if let Some(other) = seen.insert(row.id.to_lowercase(), &row.id) {
            let alike = if *other == *row.id { String::new() } else { format!(" (and {other})") };
            return Err(Error::input(format!(
                "{}: two rows have the id {}{alike}; give each its own",
                place.display(),
                row.id
            )));
        }
    }
    Ok(())
}

fn one_or_more<'de, D: serde::Deserializer<'de>>(from: D) -> Result<Vec<String>, D::Error> {
    #[derive(Deserialize)]
    #[serde(untagged)]
    enum Input {
        One(String),
        More(Vec<String>),
    }
    let input = Input::deserialize(from);
    input.map_err(|_| serde::de::Error::custom("input: give a path, or a list of paths")).map(|i| match i {
        Input::One(one) => vec![one],
        Input::More(more) => more,
    })
}

/// Files and folders of the input of a row, of which the current folder is the base.
///
/// # Errors
/// A pattern that is wrong or matches nothing.
pub fn inputs(row: &Row) -> Result<Vec<PathBuf>> {
    let mut found = Vec::new();
    for input in &row.input {
        let path = PathBuf::from(input);
        // A file may have a name that looks like a pattern.
        if !input.contains(['*', '?', '[']) || path.exists() {
            found.push(path);
            continue;
        }
        let wrong = |e: &str| Error::input(format!("{input}: {e}"));
        let paths = glob::glob(input).map_err(|e| wrong(&format!("no pattern of file names: {e}")))?;
        let before = found.len();
        for path in paths {
            found.push(path.map_err(|e| wrong(&words(e.error())))?);
        }
        if found.len() == before {
            return Err(wrong("no file has such a name"));
        }
    }
    Ok(found)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn manifest(name: &str, text: &str) -> Result<Manifest> {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join(name);
        std::fs::write(&file, text).unwrap();
        Manifest::read(&file, Path::new("out"))
    }

    fn refused(name: &str, text: &str) -> String {
        let error = manifest(name, text).unwrap_err();
        assert_eq!(error.exit_code(), 2);
        error.to_string()
    }

    #[test]
    fn rows_of_json_and_of_a_table() {
        let text = r#"{"id": "a", "input": "x/*.jpg"}

            {"id": "b", "input": ["1.jpg", "2.jpg"], "options": {"views": 2}, "queries": ["mug"], "exports": ["glb"]}"#;
        let rows = manifest("captures.jsonl", text).unwrap().rows;
        assert_eq!(rows.len(), 2);
        assert_eq!((rows[0].input.len(), rows[1].input.len()), (1, 2));
        assert_eq!(rows[1].options["views"], 2);
        let rows = manifest("captures.csv", "id,input\na,\"x, y\"\nb,z\n").unwrap().rows;
        assert_eq!((rows[0].input[0].as_str(), rows[1].id.as_str()), ("x, y", "b"));
    }

    #[test]
    fn wrong_rows_are_refused_with_their_line() {
        let row = r#"{"id": "a", "input": "x"}"#;
        for (line, says) in [
            (r#"{"id": "b", "input": "x", "query": ["mug"]}"#, "unknown field `query`"),
            (r#"{"id": "b", "id": "c", "input": "x"}"#, "duplicate field `id`"),
            (r#"{"input": "x"}"#, "missing field `id`"),
            (r#"{"id": "b", "input": 3}"#, "give a path, or a list of paths"),
            (r#"{"id": "../b", "input": "x"}"#, "id \"../b\""),
            (r#"{"id": "_b", "input": "x"}"#, "beginning with a letter"),
            (r#"{"id": "b", "input": []}"#, "input is empty"),
            ("{", "EOF"),
        ] {
            let message = refused("c.jsonl", &format!("{row}\n{line}\n"));
            assert!(message.contains("c.jsonl, line 2: ") && message.contains(says), "{message}");
        }
        assert!(refused("c.jsonl", "\n").contains("no row"));
        assert!(refused("c.jsonl", &format!("{row}\n{row}")).contains("two rows have the id a;"));
        let alike = refused(
            "c.jsonl",
            r#"{"id": "a", "input": "x"}
            {"id": "A", "input": "x"}"#,
        );
        assert!(alike.contains("the id A (and a)"), "{alike}");
        assert!(refused("c.csv", "id,photos\n").contains("no column input"));
        assert!(refused("c.csv", "id,input,views\n").contains("`views` has no meaning"));
        assert!(refused("c.csv", "id,input\na,x\nb\n").contains("line 3"));
    }

    #[test]
    fn folder_of_folders_has_a_row_each() {
        let folder = tempfile::tempdir().unwrap();
        for name in ["b", "a", ".hidden"] {
            std::fs::create_dir(folder.path().join(name)).unwrap();
        }
        std::fs::write(folder.path().join("notes.txt"), "x").unwrap();
        std::fs::create_dir(folder.path().join("results")).unwrap();
        let read = || Manifest::read(folder.path(), &folder.path().join("results"));
        let made = read().unwrap();
        let ids: Vec<&str> = made.rows.iter().map(|r| r.id.as_str()).collect();
        assert_eq!((ids.as_slice(), made.base.as_path()), (&["a", "b"][..], folder.path()));
        std::fs::create_dir(folder.path().join("c d")).unwrap();
        assert!(read().unwrap_err().to_string().contains("rename the folder"));
    }
}
