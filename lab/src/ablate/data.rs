//! Data sets of the supported layouts: frames that may be photos, labels, and cameras where known.
use crate::protocol::{self, ProtocolKind};
use crate::{Error, Result};
use serde::Serialize;
use splatvk::eval::{GroundTruth, Split, TruthFrame};
use splatvk::format::cameras;
use splatvk::photo::{Candidate, MAX_SIZE, join, sizes_of, working_size};
use splatvk::scene::{Camera, Pose};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// Layout of a data set on disk; it defines the protocol of its scores.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Layout {
    /// `ground_truth.json`, scored by protocol `field` on held-out frames.
    Own,
    /// A published layout, scored by its protocol.
    Published(ProtocolKind),
}

impl Layout {
    /// Recognises the layout of a folder.
    pub fn of(folder: &Path) -> Option<Layout> {
        let has = |name: &str| folder.join(name).exists();
        if has("ground_truth.json") {
            Some(Layout::Own)
        } else if has("segmentations/classes.txt") {
            Some(Layout::Published(ProtocolKind::Ovs))
        } else if has("label-filt") || (has("label") && has("color")) {
            Some(Layout::Published(ProtocolKind::ScanNet))
        } else {
            lerf_labels(folder).map(|_| Layout::Published(ProtocolKind::Lerf))
        }
    }

    /// Name of the data set in the paper's figures.
    pub(super) fn paper(self) -> &'static str {
        match self {
            Layout::Published(ProtocolKind::Ovs) => "3dovs",
            Layout::Published(ProtocolKind::ScanNet) => "scannet",
            // The paper has no figures on generated scenes; those on LERF take their place.
            Layout::Published(_) | Layout::Own => "lerf",
        }
    }

    /// Split of the frames of the first column: labelled photos where the authors' script scores
    /// them, else held-out views.
    pub(super) fn headline(self) -> Split {
        match self {
            Layout::Published(ProtocolKind::Lerf | ProtocolKind::Ovs) => Split::Train,
            Layout::Published(_) | Layout::Own => Split::Test,
        }
    }

    /// Number of photos in the paper's runs.
    pub(super) fn views(self) -> usize {
        match self {
            Layout::Published(ProtocolKind::Ovs) => 3,
            Layout::Published(_) | Layout::Own => splatvk::photo::DEFAULT_VIEWS,
        }
    }
}

/// A data set, with its name in measurements.
#[derive(Clone, Debug)]
pub struct DataSet {
    /// Name, distinct within a run.
    pub name: String,
    /// Layout on disk.
    pub layout: Layout,
    /// Frames and labels. A published layout has every labelled frame with a photo, all in the
    /// split `train`; rows choose their photos from them.
    pub truth: GroundTruth,
    /// Folder from which the protocol reads labels.
    pub(super) labels: PathBuf,
    /// Cameras of a published data set, if it has any.
    pub(super) known: Vec<Camera>,
}

/// Frames whose means the first columns of a table are; the same for all of its rows.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Scope {
    /// Split of these frames, whose summary a published report has.
    pub(super) headline: Split,
    /// Stems of the held-out frames that are photos of no row, or of the photos that all rows have.
    pub(super) frames: BTreeSet<String>,
}

impl Scope {
    /// Name of the column for the other split.
    pub(super) fn other(&self) -> &'static str {
        match self.headline {
            Split::Train => "mIoU held out",
            _ => "mIoU photos",
        }
    }
}

/// Folder with the labels of a LERF-OVS scene: `lerf_ovs/label/SCENE` beside `lerf_ovs/SCENE`, or
/// `label` in the scene's folder.
fn lerf_labels(folder: &Path) -> Option<PathBuf> {
    let absolute = folder.canonicalize().ok()?;
    let beside = absolute.parent().zip(absolute.file_name()).map(|(up, name)| up.join("label").join(name));
    let places = beside.into_iter().chain([folder.join("label")]);
    places.into_iter().find(|place| {
        let mut files = std::fs::read_dir(place).into_iter().flatten().flatten();
        files.any(|f| f.path().extension().is_some_and(|e| e == "json"))
    })
}

impl DataSet {
    /// Opens a folder in the given layout, or in the one that is recognised. An error where rows
    /// could not be scored: no labels, or too few frames.
    pub fn open(name: String, folder: &Path, layout: Option<Layout>) -> Result<DataSet> {
        let layout = layout.or_else(|| Layout::of(folder)).ok_or_else(|| {
            Error::input(format!(
                "{}: no ground_truth.json, no segmentations/classes.txt (3D-OVS), no label-filt/ (ScanNet) and no \
                 ../label/NAME/*.json (LERF-OVS); what docs/internals/data.md describes is needed",
                folder.display()
            ))
        })?;
        let set = match layout {
            Layout::Own => {
                let truth = GroundTruth::read(folder)?;
                DataSet { name, layout, truth, labels: folder.to_owned(), known: Vec::new() }
            }
            Layout::Published(kind) => published(name, folder, kind)?,
        };
        let folder = folder.display();
        let first = set.truth.frames.first();
        let has_depth = || first.map_or(Ok(false), |f| set.truth.depth(f).map(|depth| depth.is_some()));
        if set.truth.labels.is_empty() && !has_depth()? {
            return Err(Error::input(format!(
                "{folder}: no labels to ask for in ground_truth.json, and no depth to compare photos by"
            )));
        }
        let count = |split| set.truth.frames.iter().filter(|f| f.split == split).count();
        let (train, test) = (count(Split::Train), count(Split::Test));
        if train < 2 || (test == 0 && layout == Layout::Own) {
            return Err(Error::input(format!(
                "{folder}: {train} train and {test} test frames; ablate needs at least 2 and 1"
            )));
        }
        Ok(set)
    }
}

/// Opens a data set of a published layout.
fn published(name: String, folder: &Path, kind: ProtocolKind) -> Result<DataSet> {
    let labels = match kind {
        ProtocolKind::Lerf => lerf_labels(folder).ok_or_else(|| {
            let place = folder.display();
            Error::input(format!(
                "{place}: no label files of LERF-OVS in ../label/NAME or label/; check --layout"
            ))
        })?,
        _ => folder.to_owned(),
    };
    let read = protocol::labels(kind, &labels)?;
    let known = match read.cameras {
        own if !own.is_empty() => own,
        _ => cameras_beside(folder)?,
    };
    let names: Vec<&str> = known.iter().map(|c| c.name.as_str()).collect();
    let joined = join(&read.stems, &names).map_err(|e| Error::input(format!("{}: {e}", folder.display())))?;
    let mut frames = Vec::new();
    for (name, own) in read.stems.into_iter().zip(joined) {
        let Some(file) = photo(folder, &name) else { continue };
        let (w, h) = sizes_of(&[Candidate::file(&folder.join(&file))])[0];
        let (width, height) = working_size(w, h, MAX_SIZE);
        let (width, height) = (width as u32, height as u32);
        let own = own.map(|k| &known[k]);
        // A frame without a camera can be a photo but no held-out view.
        let camera = own.map(|c| c.resized(width, height)).unwrap_or_else(|| unknown(&name, width, height));
        frames.push(TruthFrame { file, stem: name, split: Split::Train, camera, lens: None });
    }
    let truth = GroundTruth {
        folder: folder.to_owned(),
        labels: read.phrases,
        up: None,
        frames,
        maps: Some(read.maps),
    };
    Ok(DataSet { name, layout: Layout::Published(kind), truth, labels, known })
}

/// Path of a frame's photo, relative to the scene's folder.
fn photo(folder: &Path, stem: &str) -> Option<String> {
    let names = ["images", "color"].into_iter().flat_map(|dir| {
        ["jpg", "JPG", "jpeg", "png", "PNG"].map(|extension| format!("{dir}/{stem}.{extension}"))
    });
    names.into_iter().find(|name| folder.join(name).is_file())
}

/// Cameras of `transforms.json` or of a COLMAP model in the folder of a scene.
fn cameras_beside(folder: &Path) -> Result<Vec<Camera>> {
    let model = ["sparse/0", "sparse"]
        .iter()
        .any(|n| ["images.bin", "images.txt"].iter().any(|file| folder.join(n).join(file).is_file()));
    if model || folder.join("transforms.json").is_file() { cameras::read(folder) } else { Ok(Vec::new()) }
}

/// Placeholder camera of a frame without one.
fn unknown(name: &str, width: u32, height: u32) -> Camera {
    let (fx, cx, cy) = (f64::from(width), f64::from(width) / 2.0, f64::from(height) / 2.0);
    Camera { name: name.to_owned(), width, height, fx, fy: fx, cx, cy, pose: Pose::IDENTITY }
}
