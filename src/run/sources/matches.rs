//! Dense matches between every two photos, for step 1 of the alignment.
use super::table::{Build, Kind, NO_CHECK, PosedPhotos, Source};
use crate::Result;
use crate::infer::Role;
use crate::infer::installed::{Duty, Installed};
use crate::language::align::PairLinks;
use crate::pipeline::Output;
use crate::run::stages::{DescriptorMatches, Descriptors, NetworkMatches};

/// `--matcher`
pub struct Matches;

impl Kind for Matches {
    const OPTION: &'static str = "matcher";
    const ABOUT: &'static str = "Dense matches for the alignment of masks";
    const DUTY: Duty = Duty::Matcher;
    const SOURCES: &'static [Source<Self>] = &[Source {
        name: "xfeat",
        argument: None,
        about: "descriptors compared along epipolar lines",
        needs: &[Role::Keypoints],
        check: NO_CHECK,
        make: |_, (build, photos)| {
            let descriptors = build.graph.add(Descriptors, (photos.placed,));
            Ok(build.graph.add(DescriptorMatches, (descriptors, photos.geometry)))
        },
    }];
    type Input<'i> = (&'i mut Build, PosedPhotos);
    type Output = Output<Vec<PairLinks>>;

    fn network(model: Installed, (build, photos): Self::Input<'_>) -> Result<Self::Output> {
        Ok(build.graph.add(NetworkMatches::new(model)?, (photos.placed,)))
    }
}
