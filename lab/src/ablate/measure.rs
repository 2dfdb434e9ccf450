//! Figures of one row on one data set with one seed.
use super::data::Scope;
use super::runner::RowFigures;
use super::setup::{RowWork, TableRow};
use super::stages::Scored;
use super::tables::Table;
use crate::protocol::{ProtocolKind, ProtocolReport};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use splatvk::eval::Split;
use std::collections::BTreeMap;

/// Result of one row on one data set with one seed: plain data, which a later process can read.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Measurement {
    /// Name of the data set.
    pub data: String,
    /// Seed of the run.
    pub seed: u64,
    /// Name of the table.
    pub table: String,
    /// Group of the row.
    pub group: String,
    /// Name of the row in its group.
    pub label: String,
    /// Whether the other rows of the group are compared with this one.
    pub reference: bool,
    /// Setup that ran, as JSON; null where nothing ran.
    pub setup: Value,
    /// Remark for the reader, or the reason for missing figures.
    pub note: String,
    /// Whether the row ran and failed.
    pub failed: bool,
    /// Figures by column.
    pub figures: BTreeMap<String, f64>,
    /// Mean IoU per phrase on the frames of the scope.
    pub iou: BTreeMap<String, f64>,
}

impl Measurement {
    /// Makes the measurement of a row before it runs.
    pub(super) fn begun(table: &Table, row: &TableRow, data: &str, seed: u64) -> Measurement {
        let setup = match &row.runs {
            RowWork::Score(setup) => serde_json::to_value(setup),
            RowWork::Flat(flat) => Ok(json!({ "flat": flat })),
            RowWork::Nothing => Ok(Value::Null),
        };
        Measurement {
            data: data.to_owned(),
            seed,
            table: table.name.to_owned(),
            group: row.group.clone(),
            label: row.label.clone(),
            reference: false,
            // Plain numbers and texts: serialising them cannot fail.
            setup: setup.unwrap_or_default(),
            note: row.note.clone(),
            failed: false,
            figures: BTreeMap::new(),
            iou: BTreeMap::new(),
        }
    }

    /// Whether both are of the same row, data set and seed, with the same setup.
    pub fn repeats(&self, other: &Measurement) -> bool {
        let key =
            |m: &Measurement| (m.data.clone(), m.seed, m.table.clone(), m.group.clone(), m.label.clone());
        key(self) == key(other) && self.setup == other.setup
    }
}

type Figures = BTreeMap<String, f64>;

fn mean(values: impl Iterator<Item = f64>) -> Option<f64> {
    let (sum, n) = values.fold((0.0, 0usize), |(s, n), v| (s + v, n + 1));
    (n > 0).then(|| sum / n as f64)
}

/// Inserts a figure, if there is one.
fn put(out: &mut Figures, name: &str, value: Option<f64>) {
    out.extend(value.map(|v| (name.to_owned(), v)));
}

/// Scores of a row, by column.
pub(super) fn scores(scored: &Scored, scope: &Scope) -> Figures {
    let mut out = match &scored.published {
        Some(report) => published(report, scope),
        None => field(scored, scope),
    };
    let agreement = || scored.agreement.iter().filter(|m| scope.frames.contains(&m.frame));
    put(&mut out, "SIM", mean(agreement().map(|m| m.similarity)));
    put(&mut out, "MSE", mean(agreement().map(|m| m.mse)));
    out
}

/// Scores by protocol `field`.
fn field(scored: &Scored, scope: &Scope) -> Figures {
    let (report, mut out) = (&scored.report, Figures::new());
    let in_scope = |frame: &String| scope.frames.contains(frame);
    let masks = || report.masks.iter().filter(|m| in_scope(&m.frame));
    put(&mut out, "mIoU", mean(masks().map(|m| m.iou)));
    put(&mut out, "mAcc", mean(masks().map(|m| f64::from(m.localised))));
    // The models of the levels, where they differ from that of the scene.
    let models = if scored.models.is_empty() { std::slice::from_ref(report) } else { &scored.models };
    let images = || models.iter().flat_map(|m| &m.images).filter(|i| in_scope(&i.frame));
    put(&mut out, "PSNR", mean(images().map(|i| i.psnr)));
    put(&mut out, "AbsRel", mean(images().filter_map(|i| i.depth_abs_rel)));
    let others = report.masks.iter().filter(|m| m.split != scope.headline);
    put(&mut out, scope.other(), mean(others.map(|m| m.iou)));
    out
}

/// Scores by a published protocol: means over (frame, phrase) pairs, or the summary of ScanNet,
/// which counts pixels of all frames.
fn published(report: &ProtocolReport, scope: &Scope) -> Figures {
    let mut out = Figures::new();
    let summary = |split: Split| report.summary.get(split.name());
    if report.protocol == ProtocolKind::ScanNet {
        let first = summary(scope.headline).or_else(|| report.summary.values().next());
        put(&mut out, "mIoU", first.and_then(|s| s.figures.get("miou")).copied());
        put(&mut out, "mAcc", first.and_then(|s| s.figures.get("accuracy")).copied());
    } else {
        let pairs = || report.scores.iter().filter(|s| s.rule == report.main_rule);
        let first = || pairs().filter(|s| s.split == scope.headline && scope.frames.contains(&s.frame));
        put(&mut out, "mIoU", mean(first().map(|s| s.iou)));
        put(&mut out, "mAcc", mean(first().filter_map(|s| s.localised).map(f64::from)));
    }
    let rest = match scope.headline {
        Split::Train => Split::Test,
        _ => Split::Train,
    };
    put(&mut out, scope.other(), summary(rest).and_then(|s| s.figures.get("miou")).copied());
    out
}

/// Figures of a row with a scene, by column.
pub(super) fn figures(o: &RowFigures, scope: &Scope) -> Figures {
    let mut out = scores(&o.scored, scope);
    put(&mut out, "equal", o.consistency.map(|c| c.equal));
    put(&mut out, "cosine", o.consistency.map(|c| c.cosine));
    put(&mut out, "equal decoded", o.scored.decoded.map(|c| c.equal));
    put(&mut out, "needles", Some(o.shape.needles));
    put(&mut out, "growth", o.shape.growth);
    put(&mut out, "growth unseen", o.shape.growth_unseen);
    put(&mut out, "splats", Some(o.splats as f64));
    put(&mut out, "codes", Some(o.codes.iter().sum::<usize>() as f64));
    put(&mut out, "MB", Some(o.feature_bytes as f64 / 1e6));
    put(&mut out, "Tr.T", Some(o.training_seconds));
    put(&mut out, "T.T", Some(o.total_seconds));
    put(&mut out, "seconds", Some(o.seconds));
    out
}

/// Mean IoU per phrase on the frames of the scope.
pub(super) fn iou(scored: &Scored, scope: &Scope) -> Figures {
    let mut phrases: BTreeMap<String, Vec<f64>> = BTreeMap::new();
    let mut add = |frame: &String, phrase: &String, iou| {
        if scope.frames.contains(frame) {
            phrases.entry(phrase.clone()).or_default().push(iou);
        }
    };
    scored.report.masks.iter().for_each(|m| add(&m.frame, &m.phrase, m.iou));
    if let Some(report) = &scored.published {
        let pairs = report.scores.iter().filter(|s| s.rule == report.main_rule);
        pairs.for_each(|s| add(&s.frame, &s.phrase, s.iou));
    }
    phrases.into_iter().filter_map(|(k, v)| Some((k, mean(v.into_iter())?))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ablate::shape::Shape;
    use crate::ablate::stages::{EmbeddingAgreement, Scored};
    use splatvk::eval::{EvalReport, MaskScore};

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
    fn figures_use_frames_of_scope() {
        let masks = vec![
            mask("p", Split::Train, 0.9, true),
            mask("a", Split::Test, 0.2, false),
            mask("b", Split::Test, 0.6, true),
            mask("c", Split::Test, 1.0, true),
        ];
        let mut report = EvalReport::default();
        report.masks = masks;
        let agreement =
            EmbeddingAgreement { frame: "c".into(), split: Split::Test, similarity: 0.5, mse: 0.1 };
        let outcome = RowFigures {
            scored: std::sync::Arc::new(Scored { report, agreement: vec![agreement], ..Scored::default() }),
            consistency: None,
            shape: Shape::default(),
            splats: 7,
            codes: vec![1, 2],
            feature_bytes: 5_000_000,
            seconds: 1.0,
            training_seconds: 2.0,
            total_seconds: 3.0,
        };
        let scope = |frames: &[&str]| Scope {
            headline: Split::Test,
            frames: frames.iter().map(|f| (*f).to_owned()).collect(),
        };
        let f = figures(&outcome, &scope(&["b", "c"]));
        assert_eq!((f["mIoU"], f["mAcc"], f["mIoU photos"], f["codes"]), (0.8, 1.0, 0.9, 3.0));
        assert_eq!((f["MB"], f["Tr.T"], f["T.T"]), (5.0, 2.0, 3.0));
        assert_eq!(figures(&outcome, &scope(&["a", "b", "c"]))["mIoU"], 0.6);
        assert_eq!(iou(&outcome.scored, &scope(&["c"]))["x"], 1.0);
        assert!(!figures(&outcome, &scope(&[])).contains_key("mIoU"));
    }
}
