//! Data sets in their own layouts, as the runner takes them: frames that may be photos, labels, and
//! cameras where known.
use crate::{Error, Result};
use serde::Serialize;
use splatvk::eval::protocol::{self, ProtocolKind};
use splatvk::eval::{GroundTruth, Split, TruthFrame};
use splatvk::format::cameras;
use splatvk::photo::{Candidate, MAX_SIZE, join, sizes_of, working_size};
use splatvk::scene::{Camera, Pose};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// How a data set lies on disk, and by which protocol it is scored.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Layout {
    /// `ground_truth.json`, scored by protocol `field` on held-out frames.
    Own,
    /// One of the published ones, scored by its protocol.
    Published(ProtocolKind),
}

impl Layout {
    /// What lies in a folder.
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

    /// What the paper's figures are filed under.
    pub(super) fn paper(self) -> &'static str {
        match self {
            Layout::Published(ProtocolKind::Ovs) => "3dovs",
            Layout::Published(ProtocolKind::ScanNet) => "scannet",
            // The paper has no figures on generated scenes: those on LERF stand beside them.
            Layout::Published(_) | Layout::Own => "lerf",
        }
    }

    /// The frames of the first column: the authors' script scores labelled photos, and everything
    /// else held-out views.
    pub(super) fn headline(self) -> Split {
        match self {
            Layout::Published(ProtocolKind::Lerf | ProtocolKind::Ovs) => Split::Train,
            Layout::Published(_) | Layout::Own => Split::Test,
        }
    }

    /// Photos of the paper's runs.
    pub(super) fn views(self) -> usize {
        match self {
            Layout::Published(ProtocolKind::Ovs) => 3,
            Layout::Published(_) | Layout::Own => splatvk::photo::DEFAULT_VIEWS,
        }
    }
}

/// A data set with the name that its measurements carry.
#[derive(Clone, Debug)]
pub struct DataSet {
    /// Distinct within a run.
    pub name: String,
    /// How it lies on disk.
    pub layout: Layout,
    /// Frames and labels. Of a published layout every labelled frame with a photo, all of them in
    /// the split `train`: which are photos of a scene is the row's choice.
    pub truth: GroundTruth,
    /// Where its protocol reads labels.
    pub(super) labels: PathBuf,
    /// Its own cameras, if it states any.
    pub(super) known: Vec<Camera>,
}

/// The frames that the first columns of a table are means over: the same for all of its rows.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Scope {
    /// The split of these frames, which a published report sums up.
    pub(super) headline: Split,
    /// Stems: held-out frames that no row has seen as photos, or photos that all rows have.
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

/// Labels of a LERF-OVS scene: `lerf_ovs/label/SCENE` beside `lerf_ovs/SCENE`, or in the scene's
/// own folder.
fn lerf_labels(folder: &Path) -> Option<PathBuf> {
    let whole = folder.canonicalize().ok()?;
    let beside = whole.parent().zip(whole.file_name()).map(|(up, name)| up.join("label").join(name));
    let places = beside.into_iter().chain([folder.join("label")]);
    places.into_iter().find(|place| {
        let mut files = std::fs::read_dir(place).into_iter().flatten().flatten();
        files.any(|f| f.path().extension().is_some_and(|e| e == "json"))
    })
}

impl DataSet {
    /// Opens a folder, in the given layout or in that of what lies there; refuses what no row could
    /// be scored on.
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
        if set.truth.labels.is_empty() {
            return Err(Error::input(format!("{folder}: no labels to ask for in ground_truth.json")));
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
        // A frame without a camera of its own can be a photo, and is held out of nothing.
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

/// The photo of a frame, relative to the scene's folder.
fn photo(folder: &Path, stem: &str) -> Option<String> {
    let names = ["images", "color"].into_iter().flat_map(|dir| {
        ["jpg", "JPG", "jpeg", "png", "PNG"].map(|extension| format!("{dir}/{stem}.{extension}"))
    });
    names.into_iter().find(|name| folder.join(name).is_file())
}

/// `transforms.json` or a COLMAP model in the folder of a scene.
fn cameras_beside(folder: &Path) -> Result<Vec<Camera>> {
    let model = ["sparse/0", "sparse"]
        .iter()
        .any(|n| ["images.bin", "images.txt"].iter().any(|file| folder.join(n).join(file).is_file()));
    if model || folder.join("transforms.json").is_file() { cameras::read(folder) } else { Ok(Vec::new()) }
}

fn unknown(name: &str, width: u32, height: u32) -> Camera {
    let (fx, cx, cy) = (f64::from(width), f64::from(width) / 2.0, f64::from(height) / 2.0);
    Camera { name: name.to_owned(), width, height, fx, fy: fx, cx, cy, pose: Pose::IDENTITY }
}
