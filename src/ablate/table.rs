//! Finished rows as text, JSON and a chart.
use super::runner::RowFigures;
use super::tables::{Column, RowWork, Table, TableRow};
use crate::query::eval::Split;
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::fmt::Write;

/// A row and what it gave.
pub struct FinishedRow {
    /// What it was.
    pub row: TableRow,
    /// What it gave; none for a row without a setup.
    pub outcome: Option<RowFigures>,
    /// Bytes of the features in training.
    pub bytes: Option<u64>,
}

/// A table that ran.
#[non_exhaustive]
pub struct FinishedTable {
    /// Which.
    pub table: &'static Table,
    /// Frames that no row may be scored on, because some row has seen them as photos.
    pub seen: Vec<String>,
    /// Rows in order.
    pub rows: Vec<FinishedRow>,
}

fn columns(table: &Table) -> Vec<Column> {
    let (first, last) = ([("mIoU", 3), ("mAcc", 3)], [("mIoU photos", 3), ("seconds", 0)]);
    first.iter().chain(table.columns).chain(&last).copied().collect()
}

fn mean(values: impl Iterator<Item = f64>) -> Option<f64> {
    let (sum, n) = values.fold((0.0, 0usize), |(s, n), v| (s + v, n + 1));
    (n > 0).then(|| sum / n as f64)
}

/// The figures of a row on the frames that count.
pub fn figures(done: &FinishedRow, seen: &[String]) -> BTreeMap<&'static str, f64> {
    let mut out = BTreeMap::new();
    let mut put = |name: &'static str, value: Option<f64>| {
        out.extend(value.map(|v| (name, v)));
    };
    put("MB", done.bytes.map(|b| b as f64 / 1e6));
    let Some(o) = &done.outcome else { return out };
    let held_out = |split: Split, frame: &String| split == Split::Test && !seen.contains(frame);
    let masks = || o.scored.report.masks.iter().filter(|m| held_out(m.split, &m.frame));
    put("mIoU", mean(masks().map(|m| m.iou)));
    put("mAcc", mean(masks().map(|m| f64::from(m.localised))));
    let images = o.scored.report.images.iter().filter(|i| held_out(i.split, &i.frame));
    put("PSNR", mean(images.map(|i| i.psnr)));
    let agreement = || o.scored.agreement.iter().filter(|m| held_out(m.split, &m.frame));
    put("SIM", mean(agreement().map(|m| m.similarity)));
    put("MSE", mean(agreement().map(|m| m.mse)));
    put("mIoU photos", mean(o.scored.report.masks.iter().filter(|m| m.split == Split::Train).map(|m| m.iou)));
    put("splats", Some(o.splats as f64));
    put("codes", Some(o.codes.iter().sum::<usize>() as f64));
    put("seconds", Some(o.seconds));
    out
}

impl FinishedTable {
    /// As text, the paper's figure in brackets beside ours.
    pub fn text(&self) -> String {
        let columns = columns(self.table);
        let mut cells: Vec<Vec<String>> = vec![
            std::iter::once(self.table.name.to_owned()).chain(columns.iter().map(|c| c.0.into())).collect(),
        ];
        let mut group = String::new();
        for done in &self.rows {
            if done.row.group != group {
                group.clone_from(&done.row.group);
                cells.push(vec![format!("[{group}]")]);
            }
            let ours = figures(done, &self.seen);
            let mut line = vec![format!("  {}", done.row.label)];
            for (name, decimals) in &columns {
                let paper = done.row.paper.iter().find(|p| p.0 == *name);
                let bracket = paper.map_or(String::new(), |p| format!(" ({:.*})", *decimals, p.1));
                line.push(match ours.get(name) {
                    Some(v) => format!("{v:.decimals$}{bracket}"),
                    None => format!("-{bracket}"),
                });
            }
            if !done.row.note.is_empty() {
                line.push(done.row.note.clone());
            }
            cells.push(line);
        }
        let widths: Vec<usize> = (0..=columns.len())
            .map(|c| {
                cells.iter().filter(|l| l.len() > 1).filter_map(|l| l.get(c)).map(|s| s.chars().count()).max()
            })
            .map(|w| w.unwrap_or(0))
            .collect();
        let mut text = String::new();
        for line in cells {
            let padded: Vec<String> = line
                .iter()
                .enumerate()
                .map(|(c, s)| match widths.get(c) {
                    Some(&w) if c > 0 => format!("{s:>w$}"),
                    Some(&w) if line.len() > 1 => format!("{s:<w$}"),
                    _ => s.clone(),
                })
                .collect();
            // Writing to a String cannot fail.
            let _ = writeln!(text, "{}", padded.join("  ").trim_end());
        }
        text
    }

    /// Everything, for other programs.
    pub fn json(&self) -> Value {
        let row = |done: &FinishedRow| {
            let setup = match &done.row.runs {
                RowWork::Score(setup) => Some(setup),
                RowWork::MemoryOnly(_) | RowWork::Nothing => None,
            };
            json!({
                "group": done.row.group, "label": done.row.label, "note": done.row.note, "setup": setup,
                "figures": figures(done, &self.seen),
                "paper": done.row.paper.iter().map(|p| (p.0.to_owned(), json!(p.1))).collect::<serde_json::Map<_, _>>(),
                "iou": done.outcome.as_ref().and_then(|o| o.scored.report.summary.get("test")).map(|s| s.iou.clone()),
            })
        };
        json!({
            "table": self.table, "scored_without": self.seen,
            "rows": self.rows.iter().map(row).collect::<Vec<_>>(),
        })
    }

    /// mIoU of every row as bars, the paper's as a tick.
    pub fn svg(&self) -> String {
        let bars: Vec<crate::report::chart::Bar> = self
            .rows
            .iter()
            .filter_map(|done| {
                let value = *figures(done, &self.seen).get("mIoU")?;
                let paper = done.row.paper.iter().find(|p| p.0 == "mIoU").map(|p| p.1);
                Some(crate::report::chart::Bar {
                    group: done.row.group.clone(),
                    label: done.row.label.clone(),
                    value,
                    reference: paper,
                })
            })
            .collect();
        crate::report::chart::bar_chart(
            &bars,
            &format!("{}: mIoU on held-out views, tick = paper", self.table.name),
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ablate::stages::{EmbeddingAgreement, Scored};
    use crate::ablate::tables::table;
    use crate::query::eval::{EvalReport, MaskScore};

    fn mask(frame: &str, split: Split, iou: f64, localised: bool) -> MaskScore {
        MaskScore {
            frame: frame.into(),
            split,
            label: 1,
            phrase: "x".into(),
            iou,
            localised,
            level: 0,
            score: 1.0,
            found: true,
        }
    }

    #[test]
    fn figures_leave_out_photos_and_frames_that_any_row_has_seen() {
        let masks = vec![
            mask("p", Split::Train, 0.9, true),
            mask("a", Split::Test, 0.2, false),
            mask("b", Split::Test, 0.6, true),
            mask("c", Split::Test, 1.0, true),
        ];
        let agreement =
            EmbeddingAgreement { frame: "c".into(), split: Split::Test, similarity: 0.5, mse: 0.1 };
        let outcome = RowFigures {
            scored: std::sync::Arc::new(Scored {
                report: EvalReport { masks, ..EvalReport::default() },
                agreement: vec![agreement],
            }),
            splats: 7,
            codes: vec![1, 2],
            feature_bytes: 5_000_000,
            seconds: 1.0,
        };
        let row = |label: &str, paper: Vec<(&'static str, f64)>| TableRow {
            label: label.into(),
            group: "g".into(),
            runs: RowWork::Nothing,
            note: String::new(),
            paper,
        };
        let done = FinishedRow {
            row: row("one", vec![("mIoU", 0.538)]),
            outcome: Some(outcome),
            bytes: Some(5_000_000),
        };
        let f = figures(&done, &["a".to_string()]);
        assert_eq!((f["mIoU"], f["mAcc"], f["mIoU photos"], f["codes"]), (0.8, 1.0, 0.9, 3.0));
        assert_eq!(figures(&done, &[])["mIoU"], 0.6);
        let none = FinishedRow {
            row: TableRow { note: "why".into(), ..row("two", vec![]) },
            outcome: None,
            bytes: Some(1),
        };
        let finished = FinishedTable {
            table: table("alignment").unwrap(),
            seen: vec!["a".into()],
            rows: vec![done, none],
        };
        let text = finished.text();
        assert!(text.contains("0.800 (0.538)") && text.contains("why") && text.contains("[g]"), "{text}");
        let json = finished.json();
        assert_eq!(json["rows"][0]["figures"]["mIoU"], 0.8);
        assert!(finished.svg().contains("one") && !finished.svg().contains("two"));
    }
}
