//! The text encoder of a scene's embedding space.
use super::sources::{self, SourceChoice};
use crate::format::scene_dir::{Scene, TEXT_EMBEDDINGS};
use crate::infer::{RegionEncoder, Registry};
use crate::{Error, Result};

/// The table of text embeddings that the scene carries, or the built-in model when the scene was made with it.
pub fn of_scene(scene: &Scene, registry: Registry) -> Result<Box<dyn RegionEncoder>> {
    let table = scene.path.join(TEXT_EMBEDDINGS);
    if table.is_file() {
        return sources::table_encoder(&table);
    }
    let space = scene.language.as_ref().map_or("", |l| l.space.as_str());
    // "clip:0123456789abcdef" was made with a network of the family clip.
    let source = match space.split_once(':') {
        Some((family, _)) => SourceChoice::named(family),
        None => sources::default::<sources::FeatureSources>(),
    };
    let encoder = sources::encoder(&source, &registry)?;
    if encoder.space() != space {
        return Err(Error::input(format!(
            "{}: its features are of the space \"{space}\", the installed text model speaks \"{}\"; put {TEXT_EMBEDDINGS} \
             (phrase → vector) into the scene, or make it again",
            scene.path.display(),
            encoder.space()
        )));
    }
    Ok(encoder)
}
