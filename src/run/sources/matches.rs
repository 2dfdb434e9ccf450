//! Dense matches between every pair of photos, for step 1 of the alignment.
use super::table::{GraphBuilder, NO_CHECK, PosedPhotos, Source, SourceKind};
use crate::Result;
use crate::infer::PackFileKind;
use crate::infer::installed::{Installed, Task};
use crate::language::align::PairLinks;
use crate::pipeline::Output;
use crate::run::stages::{DescriptorMatches, Descriptors, NetworkMatches};

/// `--matcher`
pub struct MatchSources;

impl SourceKind for MatchSources {
    const OPTION: &'static str = "matcher";
    const ABOUT: &'static str = "Dense matches for the alignment of masks";
    const TASK: Task = Task::Matcher;
    const SOURCES: &'static [Source<Self>] = &[Source {
        name: "xfeat",
        argument: None,
        about: "descriptors compared along epipolar lines",
        needs: &[PackFileKind::Keypoints],
        check: NO_CHECK,
        make: |_, (build, photos)| {
            let descriptors = build.graph.add(Descriptors, (photos.placed,));
            Ok(build.graph.add(DescriptorMatches, (descriptors, photos.geometry)))
        },
    }];
    type Input<'i> = (&'i mut GraphBuilder, PosedPhotos);
    type Output = Output<Vec<PairLinks>>;

    fn network(model: Installed, (build, photos): Self::Input<'_>) -> Result<Self::Output> {
        Ok(build.graph.add(NetworkMatches::new(model)?, (photos.placed,)))
    }
}
