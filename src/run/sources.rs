//! Masks, features and text embeddings from wherever the plan says they come from.
use super::{FeatureSource, MaskSource};
use crate::files::content_hash;
use crate::infer::clip::Clip;
use crate::infer::hed::Hed;
use crate::infer::installed::{Duty, Installed};
use crate::infer::words::RegionWords;
use crate::infer::xfeat::{DenseFeatures, XFeat};
use crate::infer::{RegionEncoder, Registry, nearest, warp};
use crate::language::align::{PairLinks, links_from_warps};
use crate::language::dir::{self, TextEmbeddings};
use crate::language::{ViewMasks, graph, matcher};
use crate::photo::Photo;
use crate::pose::Geometry;
use crate::progress::Progress;
use crate::query::{CANONICAL_PHRASES, TextQuery};
use crate::scene::{Plane, RgbImage};
use crate::{Error, Result};
use rayon::prelude::*;
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};

/// File of the text embeddings in a `dir:` folder.
pub const TEXT_TABLE: &str = "text_embeddings.npz";

/// Masks from a folder, with their features if those come from a folder too; `None` for built-in masks.
pub fn given_masks(
    masks: &MaskSource,
    features: &FeatureSource,
    photos: &[Photo],
) -> Result<Option<Vec<ViewMasks>>> {
    let (masks, features) = match (masks, features) {
        (MaskSource::Dir(m), FeatureSource::Dir(f)) => (m, Some(f)),
        (MaskSource::Dir(m), FeatureSource::Words | FeatureSource::Network(_)) => (m, None),
        (MaskSource::Graph | MaskSource::Network(_), FeatureSource::Words | FeatureSource::Network(_)) => {
            return Ok(None);
        }
        (MaskSource::Graph | MaskSource::Network(_), FeatureSource::Dir(f)) => {
            return Err(Error::input(format!(
                "--features dir:{0}: precomputed features belong to precomputed masks; add --masks dir:{0}",
                f.display()
            )));
        }
    };
    if features.is_some_and(|f| f != masks) {
        return Err(Error::input("--masks and --features: give the same dir: folder for both"));
    }
    photos.iter().map(|p| dir::read_view(masks, p, features.is_some())).collect::<Result<_>>().map(Some)
}

/// Text embeddings of a `dir:` folder behind the encoder boundary; region features were read with the masks.
struct Table {
    texts: TextEmbeddings,
    space: String,
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
    fn names(&mut self, regions: &[f32], best: usize) -> Result<Vec<Vec<(String, f32)>>> {
        let named: Vec<_> = self.texts.iter().filter(|(p, _)| !CANONICAL_PHRASES.contains(p)).collect();
        let rows: Vec<f32> = named.iter().flat_map(|(_, v)| v.iter().copied()).collect();
        let found = nearest(regions, &rows, self.texts.dim, best);
        let text = |(i, cosine): (usize, f32)| (named[i].0.to_owned(), cosine);
        Ok(found.into_iter().map(|list| list.into_iter().map(text).collect()).collect())
    }
}

/// Space name of precomputed features.
pub const DIR_SPACE: &str = "dir";

/// The encoder behind `--features`.
pub fn encoder(source: &FeatureSource, registry: &Registry) -> Result<Box<dyn RegionEncoder>> {
    match source {
        FeatureSource::Words => Ok(Box::new(RegionWords::load(registry.clone())?)),
        FeatureSource::Dir(dir) => table(&dir.join(TEXT_TABLE)),
        FeatureSource::Network(name) => Ok(Box::new(Clip::load(registry.installed(Duty::Features, name)?)?)),
    }
}

/// What [`encoder`] loads: checksums of the models; those of the default pack are part of the program.
pub fn encoder_identity(source: &FeatureSource, registry: &Registry) -> Result<String> {
    match source {
        FeatureSource::Words => Ok("words".to_owned()),
        FeatureSource::Dir(dir) => {
            let file = dir.join(TEXT_TABLE);
            content_hash(&file).map_err(Error::io(&file))
        }
        FeatureSource::Network(name) => {
            Ok(format!("{:?}", registry.installed(Duty::Features, name)?.files()?))
        }
    }
}

/// The encoder of a table of text embeddings.
pub fn table(path: &Path) -> Result<Box<dyn RegionEncoder>> {
    Ok(Box::new(Table { texts: TextEmbeddings::read(path)?, space: DIR_SPACE.to_owned() }))
}

/// Embeds texts for [`crate::query::answer`].
pub fn queries(texts: &[String], encoder: &mut dyn RegionEncoder) -> Result<Vec<TextQuery>> {
    if texts.is_empty() {
        return Ok(Vec::new());
    }
    let canonicals = encoder.embed_texts(&CANONICAL_PHRASES)?;
    let list: Vec<&str> = texts.iter().map(String::as_str).collect();
    let rows = encoder.embed_texts(&list)?;
    let query = |(text, row): (&String, &[f32])| TextQuery {
        text: text.clone(),
        embedding: row.to_vec(),
        canonicals: canonicals.clone(),
    };
    Ok(texts.iter().zip(rows.chunks_exact(encoder.dim())).map(query).collect())
}

/// Learned contours of every photo, for [`graph_masks`].
pub fn edges(images: &[RgbImage], registry: &Registry, progress: &dyn Progress) -> Result<Vec<Plane<f32>>> {
    progress.begin("edges", images.len() as u64);
    let mut hed = Hed::load(registry)?;
    let mut edges = Vec::with_capacity(images.len());
    for image in images {
        progress.check()?;
        edges.push(hed.edges(image)?);
        progress.step(edges.len() as u64, "");
    }
    progress.end();
    Ok(edges)
}

/// The built-in masks, helped by learned edges and stereo depth.
pub fn graph_masks(
    images: &[RgbImage],
    edges: &[Plane<f32>],
    geometry: &Geometry,
    progress: &dyn Progress,
) -> Result<Vec<ViewMasks>> {
    progress.begin("masks", images.len() as u64);
    let done = AtomicU64::new(0);
    let options = graph::GraphOptions::default();
    let one = |i: usize| {
        progress.check()?;
        let depth = Some((&geometry.cameras[i], &geometry.depths[i]));
        let masks = graph::segment(&images[i], edges.get(i), depth, &options)?;
        progress.step(done.fetch_add(1, Ordering::Relaxed) + 1, "");
        Ok(masks)
    };
    let masks = (0..images.len()).into_par_iter().map(one).collect::<Result<_>>()?;
    progress.end();
    Ok(masks)
}

/// Fills in the features that no folder gave.
pub fn with_features(
    mut masks: Vec<ViewMasks>,
    images: &[RgbImage],
    encoder: &mut dyn RegionEncoder,
    progress: &dyn Progress,
) -> Result<Vec<ViewMasks>> {
    progress.begin("regions", masks.iter().map(|m| m.levels.len() as u64).sum());
    let mut done = 0;
    for (view, image) in masks.iter_mut().zip(images) {
        for level in &mut view.levels {
            progress.check()?;
            if level.features.is_empty() && !level.quality.is_empty() {
                level.features = encoder.embed_regions(image, &level.labels, level.quality.len())?;
            }
            done += 1;
            progress.step(done, "");
        }
    }
    progress.end();
    Ok(masks)
}

/// Links of every unordered pair from a dense matching network.
pub fn network_matches(
    model: &Installed,
    photos: &[Photo],
    progress: &dyn Progress,
) -> Result<Vec<PairLinks>> {
    let mut warps = warp::warps(model, photos, progress)?.into_iter();
    let views = photos.len();
    let pairs = (0..views).flat_map(|i| (i + 1..views).map(move |j| (i, j)));
    Ok(pairs.zip(&mut warps).map(|((i, j), (there, back))| links_from_warps(i, j, &there, &back)).collect())
}

/// Dense features of every photo, for [`matches`].
pub fn dense(
    images: &[RgbImage],
    registry: &Registry,
    progress: &dyn Progress,
) -> Result<Vec<DenseFeatures>> {
    progress.begin("descriptors", images.len() as u64);
    let mut xfeat = XFeat::load(registry)?;
    let mut dense = Vec::with_capacity(images.len());
    for image in images {
        progress.check()?;
        dense.push(xfeat.dense(image)?);
        progress.step(dense.len() as u64, "");
    }
    progress.end();
    Ok(dense)
}

/// Dense matches of every unordered pair of views, for step 1 of the alignment.
pub fn matches(
    dense: &[DenseFeatures],
    geometry: &Geometry,
    progress: &dyn Progress,
) -> Result<Vec<PairLinks>> {
    let views = dense.len();
    let pairs: Vec<(usize, usize)> = (0..views).flat_map(|i| (i + 1..views).map(move |j| (i, j))).collect();
    progress.begin("match", pairs.len() as u64);
    let mut links = Vec::with_capacity(pairs.len());
    for (i, j) in pairs {
        progress.check()?;
        let cameras = (&geometry.cameras[i], &geometry.cameras[j]);
        let (forward, backward) = matcher::xfeat(&dense[i], &dense[j], cameras);
        links.push(links_from_warps(i, j, &forward, &backward));
        progress.step(links.len() as u64, "");
    }
    progress.end();
    Ok(links)
}
