//! Features of regions, and the embeddings of texts that they are compared with.
use super::table::{NO_CHECK, Source, SourceChoice, SourceKind, make};
use super::texts::dir_encoder;
use crate::files::content_hash;
use crate::format::npy;
use crate::infer::clip::Clip;
use crate::infer::installed::{Installed, Task};
use crate::infer::words::RegionWords;
use crate::infer::{PackFileKind, RegionEncoder, Registry};
use crate::query::CANONICAL_PHRASES;
use crate::run::stages::{SharedEncoder, identity};
use crate::{Error, Result};
use std::path::{Path, PathBuf};

/// File of the text embeddings in a `dir:` folder.
const TEXT_TABLE: &str = "text_embeddings.npz";

/// `--features`
pub struct FeatureSources;

impl SourceKind for FeatureSources {
    const OPTION: &'static str = "features";
    const ABOUT: &'static str = "Region features";
    const TASK: Task = Task::Features;
    const SOURCES: &'static [Source<Self>] = &[
        Source {
            name: "words",
            argument: None,
            about: "the built-in classifier and sentence encoder",
            needs: &[
                PackFileKind::Classifier,
                PackFileKind::Classes,
                PackFileKind::Text,
                PackFileKind::Tokenizer,
            ],
            check: NO_CHECK,
            // The models are those of the default pack, which is part of the program.
            make: |_, registry| {
                Ok(SharedEncoder::new(Box::new(RegionWords::load(registry.clone())?), "words".to_owned()))
            },
        },
        Source {
            name: "dir",
            argument: Some("DIR"),
            about: "STEM_f.npy; texts by text_embeddings.npz, then by an installed text model",
            needs: &[],
            check: |dir, given| match given.masks {
                SourceChoice { name, argument: Some(masks) } if name == "dir" && masks == dir => Ok(()),
                SourceChoice { name, .. } if name == "dir" => {
                    Err(Error::input("--masks and --features: give the same dir: folder for both"))
                }
                _ => Err(Error::input(format!(
                    "--features dir:{0}: precomputed features belong to precomputed masks; add --masks dir:{0}",
                    dir.display()
                ))),
            },
            make: |dir, registry| {
                let file = dir.join(TEXT_TABLE);
                let encoder = dir_encoder(&file, feature_length(dir), registry)?;
                Ok(SharedEncoder::new(encoder, content_hash(&file).unwrap_or_default()))
            },
        },
    ];
    type Input<'i> = &'i Registry;
    type Output = SharedEncoder;

    fn network(model: Installed, _: &Registry) -> Result<SharedEncoder> {
        let identity = identity(&model)?;
        Ok(SharedEncoder::new(Box::new(Clip::load(model)?), identity))
    }
}

/// The encoder of a choice, for queries only.
pub fn encoder(choice: &SourceChoice, registry: &Registry) -> Result<Box<dyn RegionEncoder>> {
    make::<FeatureSources>(choice, registry, registry)?.into_inner()
}

/// Refuses, before work on the photos, texts without embedding and a table without the canonical
/// phrases that every answer is compared with.
pub fn check_texts(choice: &SourceChoice, queries: &[String], registry: &Registry) -> Result<()> {
    let has_table = text_table(choice).is_some();
    if choice.name != "dir" || (!has_table && queries.is_empty()) {
        return Ok(());
    }
    let texts: Vec<&str> = CANONICAL_PHRASES.into_iter().chain(queries.iter().map(String::as_str)).collect();
    encoder(choice, registry)?.embed_texts(&texts).map(drop)
}

/// The table of text embeddings of a choice, if it has one.
pub fn text_table(choice: &SourceChoice) -> Option<PathBuf> {
    choice.argument.as_ref().map(|dir| dir.join(TEXT_TABLE)).filter(|file| file.is_file())
}

/// Length of the features in a `dir:` folder.
fn feature_length(dir: &Path) -> Option<usize> {
    let files = std::fs::read_dir(dir).ok()?.flatten().map(|e| e.path());
    let mut features = files.filter(|f| f.to_string_lossy().ends_with("_f.npy"));
    npy::read(features.next()?).ok()?.shape.get(1).copied()
}
