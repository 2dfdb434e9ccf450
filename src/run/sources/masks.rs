//! Masks of the photos on three levels.
use super::table::{GraphBuilder, NO_CHECK, PosedPhotos, Source, SourceKind};
use crate::Result;
use crate::infer::PackFileKind;
use crate::infer::installed::{Installed, Task};
use crate::language::{ViewMasks, dir};
use crate::pipeline::Output;
use crate::run::stages::{ContourMaps, GivenMasks, GraphMasks, MasksOrFallback, NetworkMasks};

/// `--masks`
pub struct MaskSources;

impl SourceKind for MaskSources {
    const OPTION: &'static str = "masks";
    const ABOUT: &'static str = "Masks on three levels";
    const TASK: Task = Task::Masks;
    const SOURCES: &'static [Source<Self>] = &[
        Source {
            name: "graph",
            argument: None,
            about: "segmentation by colour and learned edges",
            needs: &[PackFileKind::Edges],
            check: NO_CHECK,
            make: |_, (build, photos)| Ok(graph_masks(build, photos)),
        },
        Source {
            name: "dir",
            argument: Some("DIR"),
            about: "STEM_s.npy",
            needs: &[],
            check: |dir, given| {
                let features = given.features.name == "dir";
                let mut masks = dir::DirMasks::new(dir, features);
                given.photos.iter().try_for_each(|p| masks.read(p).map(drop))
            },
            make: |dir, (build, photos)| {
                let features = build.given_features;
                Ok(build.graph.add(GivenMasks { dir: dir.to_path_buf(), features }, (photos.placed,)))
            },
        },
    ];
    type Input<'i> = (&'i mut GraphBuilder, PosedPhotos);
    type Output = Output<Vec<ViewMasks>>;

    fn network(model: Installed, (build, photos): Self::Input<'_>) -> Result<Self::Output> {
        let untrained = model.untrained();
        let found = build.graph.add(NetworkMasks::new(model, build.sam)?, (photos.placed,));
        if !untrained {
            return Ok(found);
        }
        let built_in = graph_masks(build, photos);
        Ok(build.graph.add(MasksOrFallback, (found, built_in)))
    }
}

fn graph_masks(build: &mut GraphBuilder, photos: PosedPhotos) -> Output<Vec<ViewMasks>> {
    let edges = build.graph.add(ContourMaps, (photos.placed,));
    build.graph.add(GraphMasks, (photos.placed, edges))
}
