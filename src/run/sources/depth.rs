//! Depth priors for photos whose depth stereo measures.
use super::table::{GraphBuilder, NO_CHECK, Source, SourceKind};
use crate::Result;
use crate::infer::depth_prior;
use crate::infer::installed::{Installed, Task};
use crate::pipeline::Output;
use crate::run::stages::{DepthPriors, PlacedPhotos, PriorOrigin};
use crate::scene::DepthPrior;

/// `--depth-prior`
pub struct DepthSources;

impl SourceKind for DepthSources {
    const OPTION: &'static str = "depth-prior";
    const ABOUT: &'static str = "Depth suggested where photos cannot be matched";
    const TASK: Task = Task::Depth;
    const SOURCES: &'static [Source<Self>] = &[
        Source {
            name: "none",
            argument: None,
            about: "stereo alone",
            needs: &[],
            check: NO_CHECK,
            make: |_, input| add_priors(input, PriorOrigin::None),
        },
        Source {
            name: "dir",
            argument: Some("DIR"),
            about: "STEM_depth.npy or STEM_inverse_depth.npy",
            needs: &[],
            check: |dir, given| depth_prior::of_folder(dir, given.photos).map(drop),
            make: |dir, input| add_priors(input, PriorOrigin::Folder(dir.to_path_buf())),
        },
    ];
    type Input<'i> = (&'i mut GraphBuilder, Output<PlacedPhotos>);
    type Output = Output<Vec<Option<DepthPrior>>>;

    fn network(model: Installed, input: Self::Input<'_>) -> Result<Self::Output> {
        add_priors(input, PriorOrigin::Network(Box::new(model)))
    }
}

fn add_priors(
    (build, placed): (&mut GraphBuilder, Output<PlacedPhotos>),
    origin: PriorOrigin,
) -> Result<Output<Vec<Option<DepthPrior>>>> {
    Ok(build.graph.add(DepthPriors::new(origin)?, (placed,)))
}
