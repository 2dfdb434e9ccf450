//! Features of regions, and the embeddings of texts that they are compared with.
use super::table::{NO_CHECK, Source, SourceChoice, SourceKind, make};
use crate::files::content_hash;
use crate::infer::clip::Clip;
use crate::infer::installed::{Installed, Task};
use crate::infer::words::RegionWords;
use crate::infer::{PackFileKind, RegionEncoder, Registry, nearest, things};
use crate::language::dir::TextEmbeddings;
use crate::query::CANONICAL_PHRASES;
use crate::run::stages::{SharedEncoder, identity};
use crate::scene::{Plane, RgbImage};
use crate::{Error, Result};
use std::path::{Path, PathBuf};

/// File of the text embeddings in a `dir:` folder.
const TEXT_TABLE: &str = "text_embeddings.npz";

/// Space name of precomputed features.
const DIR_SPACE: &str = "dir";

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
            // The models are the default pack's, and that is part of the program.
            make: |_, registry| {
                Ok(SharedEncoder::new(Box::new(RegionWords::load(registry.clone())?), "words".to_owned()))
            },
        },
        Source {
            name: "dir",
            argument: Some("DIR"),
            about: "STEM_f.npy, text_embeddings.npz",
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
            make: |dir, _| {
                let file = dir.join(TEXT_TABLE);
                let sum = content_hash(&file).map_err(Error::io(&file))?;
                Ok(SharedEncoder::new(table_encoder(&file)?, sum))
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

/// The encoder of a choice, for queries alone.
pub fn encoder(choice: &SourceChoice, registry: &Registry) -> Result<Box<dyn RegionEncoder>> {
    make::<FeatureSources>(choice, registry, registry)?.into_inner()
}

/// The table of text embeddings of a choice that has one.
pub fn text_table(choice: &SourceChoice) -> Option<PathBuf> {
    choice.argument.as_ref().map(|dir| dir.join(TEXT_TABLE))
}

/// The encoder of a table of text embeddings.
pub fn table_encoder(path: &Path) -> Result<Box<dyn RegionEncoder>> {
    Ok(Box::new(Table { texts: TextEmbeddings::read(path)?, space: DIR_SPACE.to_owned() }))
}

/// Text embeddings of a `dir:` folder behind the encoder boundary; region features were read with the masks.
struct Table {
    texts: TextEmbeddings,
    space: String,
}

impl Table {
    /// [N, D] rows of those texts that the table has.
    fn known(&self, texts: &[String]) -> Vec<f32> {
        texts.iter().filter_map(|text| self.texts.get(text)).flatten().copied().collect()
    }
}

impl RegionEncoder for Table {
    fn space(&self) -> &str {
        &self.space
    }
    fn dim(&self) -> usize {
        self.texts.dim
    }
    fn embed_regions(&mut self, _: &RgbImage, _: &Plane<i32>, _: usize) -> Result<Vec<f32>> {
        Err(Error::work("precomputed features cannot describe new regions; give --masks dir: with them"))
    }
    fn embed_texts(&mut self, texts: &[&str]) -> Result<Vec<f32>> {
        self.texts.embed(texts)
    }
    fn holds(&self, text: &str) -> bool {
        self.texts.get(text).is_some()
    }
    fn others(&mut self, form: &str) -> Result<Vec<f32>> {
        Ok(self.known(&things::of_form(form)))
    }
    fn recoloured(&mut self, text: &str) -> Result<Vec<f32>> {
        Ok(self.known(&things::recoloured(text)))
    }
    fn names(&mut self, regions: &[f32], best: usize) -> Result<Vec<Vec<(String, f32)>>> {
        let named: Vec<_> = self.texts.iter().filter(|(p, _)| !CANONICAL_PHRASES.contains(p)).collect();
        let rows: Vec<f32> = named.iter().flat_map(|(_, v)| v.iter().copied()).collect();
        let found = nearest(regions, &rows, self.texts.dim, best);
        let text = |(i, cosine): (usize, f32)| (named[i].0.to_owned(), cosine);
        Ok(found.into_iter().map(|list| list.into_iter().map(text).collect()).collect())
    }
}
