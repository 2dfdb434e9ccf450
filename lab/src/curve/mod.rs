//! `splatlab curve`: figures of a scene against the seconds of its training, for variants of the
//! training that share photos, cameras, depth and masks.
//!
//! The masks are true and their features synthetic ([`crate::generate::regions`]), so that mIoU
//! depends on the splats alone. The clock stops while splats are copied for scoring.
mod points;
mod variant;

pub use points::{Curve, Point, mean};
pub use variant::Variant;

use crate::ablate::{DataSet, Prepared, Regime, Regions, Runner, Setup, Sources};
use crate::{Error, Result};
use splatvk::fit::{Preset, RgbOptions};
use splatvk::gpu::Device;
use splatvk::infer::Registry;
use splatvk::pipeline::{Codec, kept};
use splatvk::progress::Progress;
use splatvk::run::method::SPARSELGS;
use std::path::{Path, PathBuf};

/// Curves to measure.
#[derive(Clone, Debug)]
pub struct Plan {
    /// Photos; `None`: all train frames, at most four.
    pub views: Option<usize>,
    /// Whether the cameras are the true ones.
    pub true_cameras: bool,
    /// Preset of cameras, stereo and training.
    pub preset: Preset,
    /// Seed of cameras, stereo and training.
    pub seed: u64,
    /// Trainings to compare.
    pub variants: Vec<Variant>,
    /// Number of points per curve; the last is the end of the training.
    pub points: usize,
    /// Whether language is lifted and scored at every point.
    pub words: bool,
    /// Folder of prepared inputs. Inputs in it are used whatever program made them, so that
    /// revisions are compared on the same inputs.
    pub inputs: Option<PathBuf>,
}

/// Measures the curves of one data set.
pub fn measure(
    plan: &Plan,
    data: DataSet,
    (device, registry): (&Device, &Registry),
    progress: &dyn Progress,
    keep: &mut dyn FnMut(Curve) -> Result<()>,
) -> Result<()> {
    let name = data.name.clone();
    let mut runner = Runner::open(device, registry, data, progress);
    runner.start_seed(plan.seed);
    let Sources { init, matcher, .. } = Sources::default();
    let setup = Setup {
        regime: Regime { preset: plan.preset, ..Regime::OWN },
        views: plan.views.unwrap_or_else(|| runner.default_views()),
        init,
        true_cameras: plan.true_cameras,
        matcher,
        points: None,
        max_points: None,
        regions: Regions::Exact,
        recipe: SPARSELGS.recipe,
        iterations: 1,
        language_iterations: 0,
    };
    let file = plan.inputs.as_ref().map(|folder| folder.join(format!("{name}-{}.inputs", plan.seed)));
    let prepared = match file.as_deref().filter(|f| f.exists()) {
        Some(file) => read(file)?,
        None => {
            let prepared = runner.prepared(&setup)?;
            file.iter().try_for_each(|file| write(file, &prepared))?;
            prepared
        }
    };
    for variant in &plan.variants {
        progress.inform(&format!("{name}, {}", variant.name));
        let mut options = RgbOptions::preset(plan.preset);
        options.seed = plan.seed;
        let curve = points::curve(plan, &runner, &prepared, &variant.applied(options)?)?;
        keep(Curve { data: name.clone(), variant: variant.name.clone(), ..curve })?;
    }
    Ok(())
}

fn codec() -> Result<Codec<Prepared>> {
    kept().ok_or_else(|| Error::work("prepared inputs have no codec"))
}

fn read(file: &Path) -> Result<Prepared> {
    let bytes = std::fs::read(file).map_err(|e| Error::input(format!("{}: {e}", file.display())))?;
    (codec()?.read)(&bytes)
        .ok_or_else(|| Error::input(format!("{}: not inputs of this revision; delete it", file.display())))
}

fn write(file: &Path, prepared: &Prepared) -> Result<()> {
    let bytes = (codec()?.write)(prepared)?;
    let folder = file.parent().unwrap_or(Path::new("."));
    std::fs::create_dir_all(folder)
        .and_then(|()| std::fs::write(file, bytes))
        .map_err(Error::unwritable(file))
}
