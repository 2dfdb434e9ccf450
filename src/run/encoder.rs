//! The text encoder of a scene's embedding space.
use super::sources::{self, SourceChoice};
use crate::format::scene_dir::{Scene, TEXT_EMBEDDINGS};
use crate::infer::{RegionEncoder, Registry};
use crate::{Error, Result};

/// Loads the text encoder of a scene: for precomputed features the scene's table of text embeddings
/// with a network, else the model that the scene was made with.
pub fn of_scene(scene: &Scene, registry: Registry) -> Result<Box<dyn RegionEncoder>> {
    if scene.path.as_os_str().is_empty() {
        return Err(Error::input("the scene is not stored anywhere; save it first, its words are there"));
    }
    let table = scene.path.join(TEXT_EMBEDDINGS);
    let levels = scene.language.iter().flat_map(|l| &l.levels);
    let dim = levels.map(|l| l.codebook.embedding_dim).find(|dim| *dim > 0);
    let space = scene.language.as_ref().map_or("", |l| l.space.as_str());
    if table.symlink_metadata().is_ok() || space == sources::DIR_SPACE {
        return sources::dir_encoder(&table, dim, &registry);
    }
    // "clip:0123456789abcdef" names a network of the family clip.
    let source = match space.split_once(':') {
        Some((family, _)) => SourceChoice::named(family),
        None => sources::default::<sources::FeatureSources>(),
    };
    let mut encoder = sources::encoder(&source, &registry)?;
    if !encoder.use_space(space) {
        return Err(Error::input(format!(
            "{}: its features are of the space \"{space}\", the installed text model speaks \"{}\"; put {TEXT_EMBEDDINGS} \
             (phrase → vector) into the scene, or make it again",
            scene.path.display(),
            encoder.space()
        )));
    }
    Ok(encoder)
}
