//! Photos → depth priors.
use super::cameras::{KnownGeometry, PlacedPhotos};
use super::shared;
use crate::infer::depth_prior;
use crate::infer::installed::Installed;
use crate::pipeline::{Codec, Context, Lane, Output, Stage, kept};
use crate::scene::DepthPrior;
use crate::{Error, Result};
use std::path::{Path, PathBuf};

/// Source of depth priors.
pub enum PriorOrigin {
    /// No priors.
    None,
    /// Files of a folder.
    Folder(PathBuf),
    /// A network for monocular depth or for geometry.
    Network(Box<Installed>),
}

/// Depth priors of all photos, if stereo computes their depth.
pub struct DepthPriors {
    origin: PriorOrigin,
    settings: String,
}

impl DepthPriors {
    /// Prepares priors from `origin`.
    pub fn new(origin: PriorOrigin) -> Result<DepthPriors> {
        let settings = match &origin {
            PriorOrigin::None => String::new(),
            PriorOrigin::Folder(folder) => contents(folder)?,
            PriorOrigin::Network(model) => shared::identity(model)?,
        };
        Ok(DepthPriors { origin, settings })
    }
}

/// The folder's files with their checksums.
fn contents(folder: &Path) -> Result<String> {
    let entries = std::fs::read_dir(folder).map_err(Error::io(folder))?;
    let mut files: Vec<PathBuf> = entries.flatten().map(|e| e.path()).filter(|p| p.is_file()).collect();
    files.sort();
    let sums: Vec<_> = files.iter().map(|f| crate::files::content_hash(f).ok()).collect();
    Ok(format!("{folder:?} {sums:?}"))
}

impl Stage for DepthPriors {
    const NAME: &'static str = "depth-prior";
    const LANE: Lane = Lane::Processor;
    type Inputs = (Output<PlacedPhotos>,);
    type Output = Vec<Option<DepthPrior>>;

    fn settings(&self) -> String {
        self.settings.clone()
    }

    fn codec() -> Option<Codec<Vec<Option<DepthPrior>>>> {
        kept()
    }

    fn run(self, (placed,): (&PlacedPhotos,), context: &Context) -> Result<Vec<Option<DepthPrior>>> {
        match (&placed.known, self.origin) {
            (KnownGeometry::Complete(_), _) | (_, PriorOrigin::None) => Ok(Vec::new()),
            (_, PriorOrigin::Folder(folder)) => depth_prior::of_folder(&folder, &placed.photos),
            (_, PriorOrigin::Network(model)) => {
                depth_prior::of_network(&model, &placed.photos, context.progress)
            }
        }
    }
}
