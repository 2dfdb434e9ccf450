//! ScanNet with the eight labels of LSM (paper, "Comparison with Feed-forward LSM").
use super::labels::{Labels, numbered};
use super::score::{
    DecodedView, LabelledView, Masks, Protocol, ProtocolKind, ProtocolReport, ProtocolSummary, Score,
    labelled_views, nearest,
};
use crate::{Error, Result};
use glam::{DMat3, DVec3};
use splatvk::eval::{ObjectMaps, Split};
use splatvk::photo::{self, stem};
use splatvk::scene::{Camera, Image, Pose};
use splatvk_types::files;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// The label space; the prompts are these words.
pub const LABELS: [&str; 8] = ["wall", "floor", "ceiling", "chair", "table", "sofa", "bed", "other"];

/// Index in [`LABELS`] of an NYU40 id; 0 is unlabelled.
pub(super) fn from_nyu40(id: u32) -> Option<usize> {
    match id {
        0 => None,
        1 => Some(0),
        2 => Some(1),
        22 => Some(2),
        5 => Some(3),
        7 => Some(4),
        6 => Some(5),
        4 => Some(6),
        _ => Some(7),
    }
}

/// Labels, and the counts so far.
pub(super) struct ScanNet {
    files: LabelFiles,
    views: Vec<LabelledView>,
    /// [truth][predicted] pixels per split; the last column is "no code".
    confusion: BTreeMap<&'static str, [[u64; 9]; 8]>,
    scores: Vec<Score>,
}

impl ScanNet {
    pub fn open(folder: &Path, scene: &[Camera], known: &[Camera]) -> Result<Self> {
        let scan = Scan::open(folder)?;
        let own = if known.is_empty() { cameras(folder, &scan.stems)? } else { known.to_vec() };
        Ok(ScanNet {
            views: labelled_views(&scan.stems, scene, &own)?,
            files: scan.files,
            confusion: BTreeMap::new(),
            scores: Vec::new(),
        })
    }
}

/// The label files of a scan.
#[derive(Debug)]
struct LabelFiles {
    folder: PathBuf,
    /// Raw id → NYU40 id; `None` if the files hold NYU40 ids.
    table: Option<BTreeMap<u32, u32>>,
}

struct Scan {
    files: LabelFiles,
    /// Labelled frames in the order of the scan.
    stems: Vec<String>,
}

impl Scan {
    fn open(folder: &Path) -> Result<Scan> {
        let labels = ["label-filt", "label"].iter().map(|n| folder.join(n)).find(|p| p.is_dir());
        let labels = labels.ok_or_else(|| {
            Error::input(format!(
                "{}: no label-filt/ folder; --protocol scannet wants an unpacked ScanNet scene (color, label-filt, pose, \
                 intrinsic)",
                folder.display()
            ))
        })?;
        let mut stems = Vec::new();
        for entry in std::fs::read_dir(&labels).map_err(Error::io(&labels))? {
            let path = entry.map_err(Error::io(&labels))?.path();
            if path.extension().is_some_and(|e| e == "png") {
                stems.push(stem(&path.to_string_lossy()).to_string());
            }
        }
        stems.sort_by_key(|s| (s.len(), s.clone()));
        Ok(Scan { files: LabelFiles { folder: labels, table: table(folder)? }, stems })
    }
}

impl LabelFiles {
    /// Index in [`LABELS`] per pixel, −1 = unlabelled.
    fn truth(&self, stem: &str) -> Result<Image<i32>> {
        let path = self.folder.join(format!("{stem}.png"));
        let image = photo::stored_pixels(&path)?.to_luma16();
        let mut out = Image::filled(image.width() as usize, image.height() as usize, -1);
        for (slot, pixel) in out.data.iter_mut().zip(image.pixels()) {
            let id = u32::from(pixel.0[0]);
            let nyu = match &self.table {
                Some(table) => table.get(&id).copied().unwrap_or(0),
                None if id <= 40 => id,
                None => {
                    return Err(Error::input(format!(
                        "{}: id {id} is no NYU40 class; put scannetv2-labels.combined.tsv beside the scene",
                        path.display()
                    )));
                }
            };
            *slot = from_nyu40(nyu).map_or(-1, |k| k as i32);
        }
        Ok(out)
    }
}

impl ObjectMaps for LabelFiles {
    fn objects(&self, stem: &str) -> Result<Option<Image<u32>>> {
        let Image { width, height, data } = self.truth(stem)?;
        Ok(Some(Image { width, height, data: data.into_iter().map(|k| (k + 1) as u32).collect() }))
    }
}

/// Reads the labels as one image of object indices per frame, and the scan's cameras.
pub(super) fn labels(folder: &Path) -> Result<Labels> {
    let Scan { files, stems } = Scan::open(folder)?;
    let cameras = cameras(folder, &stems)?;
    Ok(Labels { phrases: numbered(LABELS.map(String::from)), maps: Arc::new(files), cameras, stems })
}

/// `id` → `nyu40id` of `scannetv2-labels.combined.tsv` in the folder or one of the two above it.
fn table(folder: &Path) -> Result<Option<BTreeMap<u32, u32>>> {
    let name = "scannetv2-labels.combined.tsv";
    let Some(path) = folder.ancestors().take(3).map(|p| p.join(name)).find(|p| p.is_file()) else {
        return Ok(None);
    };
    let text = files::read_text(&path)?;
    let mut lines = text.lines();
    let header: Vec<&str> = lines.next().unwrap_or("").split('\t').collect();
    let column = |name: &str| header.iter().position(|h| h.trim() == name);
    let (Some(id), Some(nyu)) = (column("id"), column("nyu40id")) else {
        return Err(Error::input(format!("{}: no columns id and nyu40id", path.display())));
    };
    let rows = lines.map(|l| l.split('\t').collect::<Vec<_>>());
    Ok(Some(rows.filter_map(|c| Some((number_in(&c, id)?, number_in(&c, nyu)?))).collect()))
}

fn number_in(cells: &[&str], column: usize) -> Option<u32> {
    cells.get(column).and_then(|c| c.trim().parse().ok())
}

/// Numbers of a text matrix, row by row.
fn matrix(path: &Path) -> Result<Option<[f64; 16]>> {
    if !path.is_file() {
        return Ok(None);
    }
    let text = files::read_text(path)?;
    let values: Vec<f64> = text.split_whitespace().filter_map(|v| v.parse().ok()).collect();
    let values = <[f64; 16]>::try_from(values)
        .map_err(|_| Error::input(format!("{}: not a 4x4 matrix of numbers", path.display())))?;
    // Frames that ScanNet could not track are written as -inf.
    Ok(values.iter().all(|v| v.is_finite()).then_some(values))
}

/// The scan's own cameras: `pose/<frame>.txt` (camera to world) and
/// `intrinsic/intrinsic_color.txt`.
fn cameras(folder: &Path, stems: &[String]) -> Result<Vec<Camera>> {
    let Some(k) = matrix(&folder.join("intrinsic/intrinsic_color.txt"))? else { return Ok(Vec::new()) };
    let mut out = Vec::new();
    for name in stems {
        let Some(m) = matrix(&folder.join("pose").join(format!("{name}.txt")))? else { continue };
        let photo = ["jpg", "png"].map(|e| folder.join("color").join(format!("{name}.{e}")));
        let Some(file) = photo.iter().find(|p| p.is_file()) else { continue };
        let (width, height) = photo::dimensions(file)?;
        let column = |c: usize| DVec3::new(m[c], m[4 + c], m[8 + c]);
        let to_world =
            Pose { rotation: DMat3::from_cols(column(0), column(1), column(2)), translation: column(3) };
        let pose = to_world.inverse();
        let camera =
            Camera { name: name.clone(), width, height, fx: k[0], fy: k[5], cx: k[2], cy: k[6], pose };
        let camera = camera.checked();
        out.push(camera.map_err(|e| Error::input(format!("{}: {e}", folder.join("pose").display())))?);
    }
    Ok(out)
}

impl Protocol for ScanNet {
    fn views(&self) -> &[LabelledView] {
        &self.views
    }

    fn prompts(&self) -> Vec<String> {
        LABELS.map(String::from).to_vec()
    }

    fn add(&mut self, index: usize, decoded: &DecodedView) -> Result<Masks> {
        let view = self.views[index].clone();
        let (truth, best) = (self.files.truth(&view.stem)?, decoded.best_prompt()?);
        let mut counts = [[0u64; 9]; 8];
        for y in 0..truth.height {
            for x in 0..truth.width {
                let Ok(t) = usize::try_from(truth.at(x, y)) else { continue };
                let p = nearest(&best, (x, y), (truth.width, truth.height));
                counts[t][usize::try_from(p).unwrap_or(8)] += 1;
            }
        }
        for (label, iou) in ious(&counts).into_iter().enumerate() {
            let Some(iou) = iou else { continue };
            self.scores.push(Score {
                frame: view.stem.clone(),
                split: view.split,
                phrase: LABELS[label].to_string(),
                rule: ARGMAX,
                iou,
                level: None,
                localised: None,
                substituted: false,
            });
        }
        let total = self.confusion.entry(view.split.name()).or_insert([[0; 9]; 8]);
        for (row, more) in total.iter_mut().zip(&counts) {
            row.iter_mut().zip(more).for_each(|(a, b)| *a += b);
        }
        let mask = |k: usize| {
            let data = best.data.iter().map(|&b| b == k as i32).collect();
            (LABELS[k].to_string(), Image { width: best.width, height: best.height, data })
        };
        Ok((0..LABELS.len()).map(mask).collect())
    }

    fn finish(self: Box<Self>) -> ProtocolReport {
        let mut summary = BTreeMap::new();
        for split in [Split::Train, Split::Test] {
            if let Some(counts) = self.confusion.get(split.name()) {
                summary.insert(split.name().to_string(), figures(counts));
            }
        }
        ProtocolReport {
            protocol: ProtocolKind::ScanNet,
            definitions: [
                "eight labels from NYU40: wall 1, floor 2, ceiling 22, chair 5, table 7, sofa 6, bed 4, other = the rest; \
                 id 0 is unlabelled and left out",
                "every pixel goes to the label word with the highest cosine at any level (ties: the earlier label)",
                "miou: mean over the labels that the truth shows of IoU over the pixels of all frames; accuracy: share of \
                 labelled pixels with the right label",
                "train: photos that the scene was made from; test: other frames of the scan, placed by its own poses",
            ]
            .map(String::from)
            .to_vec(),
            main_rule: ARGMAX,
            scores: self.scores,
            summary,
        }
    }
}

const ARGMAX: &str = "argmax";

/// IoU per label that the truth shows.
fn ious(counts: &[[u64; 9]; 8]) -> [Option<f64>; 8] {
    std::array::from_fn(|k| {
        let truth: u64 = counts[k].iter().sum();
        let predicted: u64 = counts.iter().map(|row| row[k]).sum();
        (truth > 0).then(|| counts[k][k] as f64 / (truth + predicted - counts[k][k]) as f64)
    })
}

fn figures(counts: &[[u64; 9]; 8]) -> ProtocolSummary {
    let per_label = ious(counts);
    let shown: Vec<f64> = per_label.iter().flatten().copied().collect();
    let pixels: u64 = counts.iter().flatten().sum();
    let right: u64 = (0..8).map(|k| counts[k][k]).sum();
    let mut out = ProtocolSummary::default();
    out.figures.insert("pixels".into(), pixels as f64);
    if pixels > 0 {
        out.figures.insert("miou".into(), shown.iter().sum::<f64>() / shown.len() as f64);
        out.figures.insert("accuracy".into(), right as f64 / pixels as f64);
    }
    let named = LABELS.iter().zip(per_label);
    out.iou = named.filter_map(|(name, iou)| iou.map(|v| (name.to_string(), v))).collect();
    out
}
