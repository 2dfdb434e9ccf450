//! Finished tables as text, JSON and a chart.
use super::data::{DataSet, Layout};
use super::measure::Measurement;
use super::paper;
use super::setup::Regime;
use super::spread::{Difference, Spread, Verdict};
use super::tables::{Column, Table};
use serde_json::{Map, Value, json};
use splatvk::report::chart::{Bar, bar_chart};
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write;

/// Column by which rows are compared.
const HEADLINE: &str = "mIoU";

/// A row over all scenes and seeds.
#[derive(Clone, Debug)]
pub struct FinishedRow {
    /// Group; rows are compared within their group.
    pub group: String,
    /// Name of the row in its group.
    pub label: String,
    /// Remarks for the reader, failures included.
    pub note: String,
    /// Figures by column.
    pub figures: BTreeMap<String, Spread>,
    /// Difference in mIoU from the group's reference row; `None` for that row itself.
    pub difference: Option<Difference>,
    /// The paper's figures of this row, by column.
    pub paper: Vec<(&'static str, f64)>,
    /// Setup of the first measurement, as JSON.
    setup: Value,
    /// mIoU by scene, and the paper's.
    by_scene: BTreeMap<String, Spread>,
    paper_by_scene: BTreeMap<String, f64>,
    /// Mean IoU per phrase.
    iou: BTreeMap<String, f64>,
}

/// A table over all scenes and seeds.
#[non_exhaustive]
pub struct FinishedTable {
    /// The table.
    pub table: &'static Table,
    /// Rows in order.
    pub rows: Vec<FinishedRow>,
    /// Whether there is more than one scene or seed.
    several: bool,
}

/// Columns of every table, before and after its own.
const FIRST: [Column; 2] = [(HEADLINE, 3), ("mAcc", 3)];
const LAST: [Column; 4] = [("mIoU photos", 3), ("mIoU held out", 3), ("Tr.T", 0), ("T.T", 0)];

/// Data sets that select the paper's figures of a table. There are some where the rows measure the
/// same as the paper: its method with its networks on its data sets.
#[derive(Clone, Debug)]
pub struct PaperSet {
    layout: Layout,
    scenes: Vec<String>,
    published: bool,
}

impl PaperSet {
    /// Selects the figures of data sets of one layout.
    pub fn of<'s>(layout: Layout, sets: impl Iterator<Item = &'s DataSet>, regime: Regime) -> PaperSet {
        PaperSet { layout, scenes: sets.map(|s| s.name.clone()).collect(), published: regime.published }
    }

    /// Whether the paper has figures of these rows.
    fn applies(&self) -> bool {
        self.published && self.layout != Layout::Own
    }

    /// Name of a scene in the paper's figures.
    fn scene(&self, name: &str) -> String {
        format!("{}/{}", self.layout.paper(), name.rsplit('/').next().unwrap_or(name))
    }

    /// The paper's figures of a row: those of the scene if there is only one, else of the data set,
    /// else of the scene that the paper shows.
    fn figures(&self, table: &str, row: &str) -> Vec<(&'static str, f64)> {
        if !self.applies() {
            return Vec::new();
        }
        let set = self.layout.paper();
        let mut names = vec![set.to_owned(), format!("{set}/teatime")];
        if let [scene] = &self.scenes[..] {
            names.insert(0, self.scene(scene));
        }
        paper::figures(table, row, &names)
    }

    /// The paper's mIoU of a row by scene, for the scenes that it has.
    fn by_scene(&self, table: &str, row: &str) -> BTreeMap<String, f64> {
        let miou = |scene: &String| {
            let all = paper::figures(table, row, &[self.scene(scene)]);
            Some((scene.clone(), all.iter().find(|f| f.0 == HEADLINE)?.1))
        };
        self.scenes.iter().filter(|_| self.applies()).filter_map(miou).collect()
    }
}

/// Values per key of the entries of all measurements.
fn gathered<'m>(
    measurements: &[&'m Measurement],
    entries: fn(&'m Measurement) -> &'m BTreeMap<String, f64>,
) -> BTreeMap<String, Vec<f64>> {
    let mut all: BTreeMap<String, Vec<f64>> = BTreeMap::new();
    for (name, value) in measurements.iter().flat_map(|m| entries(m)) {
        all.entry(name.clone()).or_default().push(*value);
    }
    all
}

/// Spread of the values of each key.
fn spreads(all: BTreeMap<String, Vec<f64>>) -> BTreeMap<String, Spread> {
    all.into_iter().filter_map(|(name, values)| Some((name, Spread::of(&values)?))).collect()
}

impl FinishedRow {
    fn of(row: &[&Measurement], reference: Option<&[&Measurement]>, paper: &PaperSet) -> Self {
        let mut scenes: BTreeMap<String, Vec<f64>> = BTreeMap::new();
        for m in row {
            scenes.entry(m.data.clone()).or_default().extend(m.figures.get(HEADLINE));
        }
        let pairs = reference.into_iter().flatten().filter_map(|other| {
            let own = row.iter().find(|m| m.data == other.data && m.seed == other.seed)?;
            Some((own.data.as_str(), own.figures.get(HEADLINE)? - other.figures.get(HEADLINE)?))
        });
        let first = row.first();
        let (table, name) = first.map_or(("", ""), |m| (m.table.as_str(), m.label.as_str()));
        FinishedRow {
            group: first.map(|m| m.group.clone()).unwrap_or_default(),
            label: first.map(|m| m.label.clone()).unwrap_or_default(),
            note: note(row),
            figures: spreads(gathered(row, |m| &m.figures)),
            difference: Difference::of(&pairs.collect::<Vec<_>>()),
            paper: paper.figures(table, name),
            paper_by_scene: paper.by_scene(table, name),
            setup: first.map(|m| m.setup.clone()).unwrap_or_default(),
            by_scene: spreads(scenes),
            iou: spreads(gathered(row, |m| &m.iou)).into_iter().map(|(k, s)| (k, s.mean)).collect(),
        }
    }

    /// Text of a column: mean, standard deviation, and the paper's figure in brackets.
    fn cell(&self, (name, decimals): Column) -> String {
        let paper = self.paper.iter().find(|p| p.0 == name);
        let bracket = paper.map_or(String::new(), |p| format!(" ({:.decimals$})", p.1));
        match self.figures.get(name) {
            Some(Spread { mean, sd: Some(sd), .. }) => {
                format!("{mean:.decimals$} ± {sd:.decimals$}{bracket}")
            }
            Some(Spread { mean, .. }) => format!("{mean:.decimals$}{bracket}"),
            None => format!("-{bracket}"),
        }
    }

    fn json(&self) -> Value {
        let map = |entries: Vec<(String, Value)>| Value::Object(entries.into_iter().collect::<Map<_, _>>());
        let means = self.figures.iter().map(|(k, s)| (k.clone(), json!(s.mean)));
        let paper = self.paper.iter().map(|p| (p.0.to_owned(), json!(p.1)));
        json!({
            "group": self.group, "label": self.label, "note": self.note, "setup": self.setup,
            "figures": map(means.collect()), "spread": self.figures, "difference": self.difference,
            "verdict": self.difference.and_then(|d| d.verdict()), "paper": map(paper.collect()),
            "scenes": self.by_scene, "paper_scenes": self.paper_by_scene, "iou": self.iou,
        })
    }

    /// Text of the difference with its interval and verdict.
    fn compared(&self) -> String {
        match &self.difference {
            Some(d @ Difference { mean, half: Some(half), .. }) => {
                let verdict = match d.verdict() {
                    Some(Verdict::Better) => "better".to_owned(),
                    Some(Verdict::Worse) => "worse".to_owned(),
                    Some(Verdict::Equal) => "equal".to_owned(),
                    Some(Verdict::Open(scenes)) => format!("open: {scenes} scenes"),
                    None => String::new(),
                };
                format!("{mean:+.3} ± {half:.3} {verdict}")
            }
            Some(Difference { mean, .. }) => format!("{mean:+.3}"),
            None => String::new(),
        }
    }
}

/// Distinct notes of a row, and the number of its failures with the first reason.
fn note(row: &[&Measurement]) -> String {
    let failed: Vec<&&Measurement> = row.iter().filter(|m| m.failed).collect();
    let mut notes: Vec<String> = Vec::new();
    for m in row.iter().filter(|m| !m.failed && !m.note.is_empty()) {
        if !notes.contains(&m.note) {
            notes.push(m.note.clone());
        }
    }
    if let Some(m) = failed.first() {
        notes.push(match row.len() {
            1 => m.note.clone(),
            n => format!("{} of {n} failed, first {} with seed {}: {}", failed.len(), m.data, m.seed, m.note),
        });
    }
    notes.join("; ")
}

impl FinishedTable {
    /// Summarises the measurements of a table among all measurements.
    pub fn of(table: &'static Table, all: &[Measurement], paper: &PaperSet) -> FinishedTable {
        let own: Vec<&Measurement> = all.iter().filter(|m| m.table == table.name).collect();
        let mut keys: Vec<(&str, &str)> = Vec::new();
        for m in &own {
            if !keys.contains(&(&m.group, &m.label)) {
                keys.push((&m.group, &m.label));
            }
        }
        // Keeps groups together where scenes have different rows.
        let order: Vec<&str> = keys.iter().map(|k| k.0).collect();
        keys.sort_by_key(|k| order.iter().position(|g| *g == k.0));
        let rows = keys.iter().map(|(group, label)| {
            let row: Vec<&Measurement> =
                own.iter().filter(|m| m.group == *group && m.label == *label).copied().collect();
            let reference: Vec<&Measurement> =
                own.iter().filter(|m| m.group == *group && m.reference).copied().collect();
            let differs = !row.iter().any(|m| m.reference);
            FinishedRow::of(&row, differs.then_some(&reference), paper)
        });
        let runs: BTreeSet<(&str, u64)> = own.iter().map(|m| (m.data.as_str(), m.seed)).collect();
        FinishedTable { table, rows: rows.collect(), several: runs.len() > 1 }
    }

    /// Columns that have a figure in at least one row.
    fn columns(&self) -> Vec<Column> {
        let all = FIRST.iter().chain(self.table.columns).chain(&LAST).copied();
        let has_figure = |row: &FinishedRow, name: &str| {
            row.figures.contains_key(name) || row.paper.iter().any(|p| p.0 == name)
        };
        all.filter(|c| self.rows.iter().any(|row| has_figure(row, c.0))).collect()
    }

    /// Table as text, with the paper's figures in brackets.
    pub fn text(&self) -> String {
        let columns = self.columns();
        let names = columns.iter().map(|c| c.0.to_owned());
        let mut header: Vec<String> = std::iter::once(self.table.name.to_owned()).chain(names).collect();
        if self.several {
            header.extend(["n", "Δ mIoU"].map(String::from));
        }
        let mut cells = vec![header];
        let mut group = "";
        for row in &self.rows {
            if row.group != group {
                group = &row.group;
                cells.push(vec![format!("[{group}]")]);
            }
            let mut line = vec![format!("  {}", row.label)];
            line.extend(columns.iter().map(|c| row.cell(*c)));
            if self.several {
                let n = row.figures.get(HEADLINE).map_or(0, |s| s.n);
                line.extend([n.to_string(), row.compared()]);
            }
            line.extend((!row.note.is_empty()).then(|| row.note.clone()));
            cells.push(line);
        }
        let mut text = aligned(&cells);
        if self.several {
            text += "± standard deviation over scenes and seeds (n runs); Δ: mean difference to the row without one, same \
                     scenes and seeds, ± half of its 95 % interval over scenes; equal: within a point; open: about so many scenes \
                     would decide within a point\n";
        }
        text
    }

    /// Table as JSON, with all figures.
    pub fn json(&self) -> Value {
        json!({ "table": self.table, "rows": self.rows.iter().map(FinishedRow::json).collect::<Vec<_>>() })
    }

    /// Bar chart of the mIoU of every row with its standard deviation; ticks are the paper's.
    pub fn svg(&self) -> String {
        let bar = |row: &FinishedRow| {
            let Spread { mean, sd, .. } = *row.figures.get(HEADLINE)?;
            Some(Bar {
                group: row.group.clone(),
                label: row.label.clone(),
                value: mean,
                error: sd,
                reference: row.paper.iter().find(|p| p.0 == HEADLINE).map(|p| p.1),
            })
        };
        let bars: Vec<Bar> = self.rows.iter().filter_map(bar).collect();
        bar_chart(&bars, &format!("{}: mIoU, tick = paper", self.table.name))
    }
}

/// Pads columns to their widest cell; lines of one cell are headings.
fn aligned(cells: &[Vec<String>]) -> String {
    let wide = cells.iter().filter(|l| l.len() > 1);
    let count = cells.first().map_or(0, Vec::len);
    let width =
        |c: usize| wide.clone().filter_map(|l| l.get(c)).map(|s| s.chars().count()).max().unwrap_or(0);
    let widths: Vec<usize> = (0..count).map(width).collect();
    let mut text = String::new();
    for line in cells {
        let pad = |(c, s): (usize, &String)| match widths.get(c) {
            Some(&w) if c > 0 => format!("{s:>w$}"),
            Some(&w) if line.len() > 1 => format!("{s:<w$}"),
            _ => s.clone(),
        };
        let padded: Vec<String> = line.iter().enumerate().map(pad).collect();
        // Writing to a String cannot fail.
        let _ = writeln!(text, "{}", padded.join("  ").trim_end());
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ablate::tables::table;
    use crate::protocol::ProtocolKind;

    fn measured(data: &str, seed: u64, label: &str, miou: Option<f64>) -> Measurement {
        Measurement {
            data: data.into(),
            seed,
            table: "alignment".into(),
            group: "g".into(),
            label: label.into(),
            reference: label == "steps 1, 2, 3",
            setup: Value::Null,
            note: if miou.is_none() { "no cameras".into() } else { String::new() },
            failed: miou.is_none(),
            figures: miou.into_iter().map(|v| ("mIoU".to_owned(), v)).collect(),
            iou: BTreeMap::new(),
        }
    }

    fn finished(all: &[Measurement]) -> FinishedTable {
        let lerf = Layout::Published(ProtocolKind::Lerf);
        let own = PaperSet { layout: lerf, scenes: vec!["a".into()], published: true };
        FinishedTable::of(table("alignment").unwrap(), all, &own)
    }

    #[test]
    fn finished_rows_compare_pairs_of_measurements() {
        let mut all = Vec::new();
        for (scene, ours) in [("a", 0.9), ("b", 0.5), ("c", 0.7)] {
            for seed in 0..2 {
                let ours = ours + 0.01 * seed as f64;
                all.push(measured(scene, seed, "none", Some(ours - 0.1)));
                all.push(measured(scene, seed, "steps 1, 2, 3", Some(ours)));
            }
        }
        all.push(measured("d", 0, "none", None));
        let done = finished(&all);
        let (none, reference) = (&done.rows[0], &done.rows[1]);
        assert!((none.figures["mIoU"].mean - 0.605).abs() < 1e-9 && none.figures["mIoU"].n == 6);
        // Scenes differ by 0.2, the rows by 0.1 in every scene.
        let d = none.difference.unwrap();
        assert!((d.mean + 0.1).abs() < 1e-9 && d.verdict() == Some(Verdict::Worse) && d.scenes == 3, "{d:?}");
        assert!(none.figures["mIoU"].sd.unwrap() > 0.15 && reference.difference.is_none());
        assert_eq!(none.note, "1 of 7 failed, first d with seed 0: no cameras");
        let text = done.text();
        assert!(text.contains("0.605 ± 0.179 (0.496)") && text.contains("-0.100 ± 0.000"), "{text}");
        let json = done.json();
        assert_eq!(json["rows"][0]["spread"]["mIoU"]["n"], 6);
        assert_eq!(
            (json["rows"][0]["verdict"].as_str(), json["rows"][0]["scenes"]["a"]["n"].as_u64()),
            (Some("worse"), Some(2))
        );
        assert!(done.svg().contains("none"));
    }

    #[test]
    fn paper_set_selects_figures_of_scenes() {
        let paper = |layout, scenes: &[&str], table: &str, row: &str| {
            let scenes = scenes.iter().map(|s| (*s).to_owned()).collect();
            let set = PaperSet { layout, scenes, published: true };
            (set.figures(table, row).first().map(|f| f.1), set.by_scene(table, row).len())
        };
        let lerf = Layout::Published(ProtocolKind::Lerf);
        assert_eq!(paper(lerf, &["teatime"], "methods", "sparselgs"), (Some(0.713), 1));
        assert_eq!(paper(lerf, &["teatime", "ramen", "mine"], "methods", "sparselgs"), (Some(0.538), 2));
        assert_eq!(paper(lerf, &["teatime", "ramen"], "views", "2 views").0, Some(0.7341));
        assert_eq!(paper(Layout::Own, &["teatime"], "methods", "sparselgs"), (None, 0));
        let draft = PaperSet { layout: lerf, scenes: vec!["teatime".into()], published: false };
        assert_eq!(
            (draft.figures("methods", "sparselgs"), draft.by_scene("methods", "sparselgs").len()),
            (vec![], 0)
        );
        let scannet = Layout::Published(ProtocolKind::ScanNet);
        assert_eq!(paper(scannet, &["a"], "feed-forward", "true segmentation").0, Some(0.5977));
        assert_eq!(paper(scannet, &["a"], "feed-forward", "lsm").0, None);
        let ovs = Layout::Published(ProtocolKind::Ovs);
        assert_eq!(paper(ovs, &["x/room"], "methods", "langsplat").0, Some(0.004));
    }

    #[test]
    fn finished_table_of_one_run_has_no_spread() {
        let done = finished(&[measured("a", 0, "step 1", Some(0.8)), measured("a", 0, "step 3", None)]);
        let text = done.text();
        assert!(
            text.contains("0.800 (0.511)") && text.contains("no cameras") && text.contains("[g]"),
            "{text}"
        );
        assert!(!text.contains('±') && !text.contains("failed"), "{text}");
        assert_eq!(done.json()["rows"][0]["figures"]["mIoU"], 0.8);
        assert!(done.svg().contains("step 1") && !done.svg().contains("step 3"));
    }
}
