//! Photos → masks with features.
use super::cameras::PlacedPhotos;
use super::language::SharedEncoder;
use super::shared;
use crate::Result;
use crate::infer::hed::Hed;
use crate::infer::installed::Installed;
use crate::infer::words;
use crate::language::sam::{self, SamOptions};
use crate::language::surfaces::Surfaces;
use crate::language::{ViewMasks, dir, graph};
use crate::photo::Photo;
use crate::pipeline::{Codec, Context, Lane, Output, Stage, kept};
use crate::pose::{Geometry, upright};
use crate::progress::Progress;
use crate::scene::{CameraOrbit, Image, RgbImage};
use rayon::prelude::*;
use std::path::PathBuf;
use std::sync::atomic::{AtomicU64, Ordering};

/// Learned contours of every photo, for [`GraphMasks`].
pub struct ContourMaps;

impl Stage for ContourMaps {
    const NAME: &'static str = "edges";
    const LANE: Lane = Lane::Processor;
    type Inputs = (Output<PlacedPhotos>,);
    type Output = Vec<Image<f32>>;

    fn settings(&self) -> String {
        String::new()
    }

    fn codec() -> Option<Codec<Vec<Image<f32>>>> {
        kept()
    }

    fn run(self, (placed,): (&PlacedPhotos,), context: &Context) -> Result<Vec<Image<f32>>> {
        let progress = context.progress;
        progress.begin("edges", placed.photos.len() as u64);
        let mut network = Hed::load(context.registry)?;
        let mut edges = Vec::with_capacity(placed.photos.len());
        for photo in &placed.photos {
            progress.check()?;
            edges.push(network.edges(&photo.image)?);
            progress.step(edges.len() as u64, "");
        }
        progress.end();
        Ok(edges)
    }
}

/// The built-in masks, from graph segmentation with learned edges.
pub struct GraphMasks;

impl Stage for GraphMasks {
    const NAME: &'static str = "graph-masks";
    const LANE: Lane = Lane::Processor;
    type Inputs = (Output<PlacedPhotos>, Output<Vec<Image<f32>>>);
    type Output = Vec<ViewMasks>;

    fn settings(&self) -> String {
        String::new()
    }

    fn run(
        self,
        (placed, edges): (&PlacedPhotos, &Vec<Image<f32>>),
        context: &Context,
    ) -> Result<Vec<ViewMasks>> {
        let progress = context.progress;
        progress.begin("masks", placed.photos.len() as u64);
        let done = AtomicU64::new(0);
        let options = graph::GraphOptions::default();
        let segment = |(photo, edges): (&Photo, &Image<f32>)| {
            progress.check()?;
            let masks = graph::segment(&photo.image, edges, &options)?;
            progress.step(done.fetch_add(1, Ordering::Relaxed) + 1, "");
            Ok(masks)
        };
        let masks = placed.photos.par_iter().zip(edges).map(segment).collect::<Result<_>>()?;
        progress.end();
        Ok(masks)
    }
}

/// A network's masks, or the built-in ones if it gave none: untrained weights rarely give a stable
/// mask, and the later stages need some.
pub struct MasksOrFallback;

impl Stage for MasksOrFallback {
    const NAME: &'static str = "masks-or";
    const LANE: Lane = Lane::Processor;
    type Inputs = (Output<Vec<ViewMasks>>, Output<Vec<ViewMasks>>);
    type Output = Vec<ViewMasks>;

    fn settings(&self) -> String {
        String::new()
    }

    fn run(
        self,
        (network, built_in): (&Vec<ViewMasks>, &Vec<ViewMasks>),
        context: &Context,
    ) -> Result<Vec<ViewMasks>> {
        if network.iter().flat_map(|m| &m.levels).any(|l| !l.quality.is_empty()) {
            return Ok(network.clone());
        }
        context.progress.warn("no mask passes in untrained weights; built-in masks instead");
        Ok(built_in.clone())
    }
}

/// Masks of a network.
pub struct NetworkMasks {
    model: Installed,
    options: SamOptions,
    settings: String,
}

impl NetworkMasks {
    /// Prepares masks by a network with these prompts.
    pub fn new(model: Installed, options: SamOptions) -> Result<NetworkMasks> {
        let settings = format!("{} {options:?}", shared::identity(&model)?);
        Ok(NetworkMasks { model, options, settings })
    }
}

impl Stage for NetworkMasks {
    const NAME: &'static str = "network-masks";
    const LANE: Lane = Lane::Processor;
    type Inputs = (Output<PlacedPhotos>,);
    type Output = Vec<ViewMasks>;

    fn settings(&self) -> String {
        self.settings.clone()
    }

    fn codec() -> Option<Codec<Vec<ViewMasks>>> {
        kept()
    }

    fn run(self, (placed,): (&PlacedPhotos,), context: &Context) -> Result<Vec<ViewMasks>> {
        sam::masks(&self.model, &shared::images(&placed.photos), &self.options, context.progress)
    }
}

/// Masks from a folder, with their features if it has them.
pub struct GivenMasks {
    /// The folder.
    pub dir: PathBuf,
    /// Whether the folder's features are read as well.
    pub features: bool,
}

impl Stage for GivenMasks {
    const NAME: &'static str = "given-masks";
    const LANE: Lane = Lane::Processor;
    type Inputs = (Output<PlacedPhotos>,);
    type Output = Vec<ViewMasks>;

    fn settings(&self) -> String {
        // The masks are not stored, but later outputs are, so the files count.
        let sums: Vec<Option<String>> =
            files_in(&self.dir).iter().map(|f| crate::files::content_hash(f).ok()).collect();
        format!("{:?} {} {sums:?}", self.dir, self.features)
    }

    fn run(self, (placed,): (&PlacedPhotos,), _: &Context) -> Result<Vec<ViewMasks>> {
        let mut masks = dir::DirMasks::new(&self.dir, self.features);
        placed.photos.iter().map(|p| masks.read(p)).collect()
    }
}

fn files_in(dir: &std::path::Path) -> Vec<PathBuf> {
    let mut files: Vec<PathBuf> = std::fs::read_dir(dir)
        .into_iter()
        .flatten()
        .flatten()
        .map(|e| e.path())
        .filter(|p| p.is_file())
        .collect();
    files.sort();
    files
}

/// Computes features of the masks that have none.
pub struct RegionFeatures {
    /// Encoder of the features.
    pub encoder: SharedEncoder,
}

impl Stage for RegionFeatures {
    const NAME: &'static str = "regions";
    const LANE: Lane = Lane::Processor;
    type Inputs = (Output<PlacedPhotos>, Output<Vec<ViewMasks>>);
    type Output = Vec<ViewMasks>;

    fn settings(&self) -> String {
        self.encoder.identity().to_owned()
    }

    fn codec() -> Option<Codec<Vec<ViewMasks>>> {
        kept()
    }

    fn run(
        self,
        (placed, masks): (&PlacedPhotos, &Vec<ViewMasks>),
        context: &Context,
    ) -> Result<Vec<ViewMasks>> {
        let (mut masks, images) = (masks.clone(), placed.photos.iter().map(|p| &p.image));
        for (view, photo) in masks.iter_mut().zip(&placed.photos).filter(|(_, p)| p.coverage.is_some()) {
            view.levels.iter_mut().for_each(|level| level.keep(|i| photo.uses(i)));
        }
        describe(&mut masks, images, &self.encoder, context.progress)?;
        Ok(masks)
    }
}

/// Adds the shapes of the masks' surfaces to their features.
pub struct SurfaceFeatures {
    /// Encoder of the features.
    pub encoder: SharedEncoder,
}

impl Stage for SurfaceFeatures {
    const NAME: &'static str = "surfaces";
    const LANE: Lane = Lane::Processor;
    type Inputs = (Output<PlacedPhotos>, Output<Vec<ViewMasks>>, Output<Geometry>);
    type Output = Vec<ViewMasks>;

    fn settings(&self) -> String {
        self.encoder.identity().to_owned()
    }

    fn run(
        self,
        (placed, masks, geometry): (&PlacedPhotos, &Vec<ViewMasks>, &Geometry),
        context: &Context,
    ) -> Result<Vec<ViewMasks>> {
        let mut masks = masks.clone();
        if !words::is_space(self.encoder.space()) {
            return Ok(masks);
        }
        let images: Vec<&RgbImage> = placed.photos.iter().map(|p| &p.image).collect();
        let gravity: Vec<_> = placed.photos.iter().map(|p| p.gravity).collect();
        let up = upright::up(&images, &geometry.cameras, &geometry.points, &gravity).map(|up| up.direction);
        let up = up.unwrap_or_else(|| CameraOrbit::mean_up(&geometry.cameras).normalize_or_zero());
        let surfaces = Surfaces::new(&images, &geometry.cameras, &geometry.depths, up);
        for (view, view_masks) in masks.iter_mut().enumerate() {
            for level in &mut view_masks.levels {
                context.progress.check()?;
                let shapes = surfaces.of_regions(view, &level.labels, level.quality.len());
                self.encoder.with(|e| e.add_surfaces(&mut level.features, &shapes))?;
            }
        }
        Ok(masks)
    }
}

/// Computes features of the masks that have none.
pub fn describe<'i>(
    masks: &mut [ViewMasks],
    images: impl Iterator<Item = &'i RgbImage>,
    encoder: &SharedEncoder,
    progress: &dyn Progress,
) -> Result<()> {
    progress.begin("regions", masks.iter().map(|m| m.levels.len() as u64).sum());
    let mut done = 0;
    for (view, image) in masks.iter_mut().zip(images) {
        for level in &mut view.levels {
            progress.check()?;
            let count = level.quality.len();
            let whole = std::mem::take(&mut level.whole);
            if level.features.is_empty() && count > 0 {
                let maps = if whole.is_empty() { std::slice::from_ref(&level.labels) } else { &whole };
                for map in maps {
                    let rows = encoder.with(|e| e.embed_regions(image, map, count, progress))?;
                    // Each mask is in one map; its row in the others is zero.
                    level.features.resize(rows.len(), 0.0);
                    level.features.iter_mut().zip(rows).for_each(|(sum, v)| *sum += v);
                }
            }
            done += 1;
            progress.step(done, "");
        }
    }
    progress.end();
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::infer::RegionEncoder;
    use crate::language::LevelMasks;
    use crate::progress::Silent;

    /// Encodes a region as its number of pixels.
    struct PixelCounter;

    impl RegionEncoder for PixelCounter {
        fn space(&self) -> &str {
            "count"
        }
        fn dim(&self) -> usize {
            1
        }
        fn embed_regions(
            &mut self,
            _: &RgbImage,
            labels: &Image<i32>,
            count: usize,
            progress: &dyn Progress,
        ) -> Result<Vec<f32>> {
            progress.check()?;
            let pixels = |k: usize| labels.data.iter().filter(|l| **l == k as i32).count() as f32;
            Ok((0..count).map(pixels).collect())
        }
        fn embed_texts(&mut self, texts: &[&str]) -> Result<Vec<f32>> {
            Ok(vec![1.0; texts.len()])
        }
    }

    #[test]
    fn describe_embeds_occluded_masks_whole() {
        let image = RgbImage { width: 4, height: 1, data: vec![[0.5; 3]; 4] };
        let map = |data: [i32; 4]| Image { width: 4, height: 1, data: data.to_vec() };
        // Mask 0 is three pixels long, mask 1 lies on two of them.
        let level = LevelMasks {
            labels: map([0, 1, 1, -1]),
            quality: vec![1.0; 2],
            whole: vec![map([0, 0, 0, -1]), map([-1, 1, 1, -1])],
            ..LevelMasks::default()
        };
        let plain = LevelMasks { whole: Vec::new(), ..level.clone() };
        let mut masks = [ViewMasks { levels: vec![level, plain] }];
        let encoder = SharedEncoder::new(Box::new(PixelCounter), String::new());
        describe(&mut masks, [&image].into_iter(), &encoder, &Silent).unwrap();
        assert_eq!(masks[0].levels[0].features, [3.0, 2.0]);
        assert_eq!(masks[0].levels[1].features, [1.0, 2.0]);
        assert!(masks[0].levels[0].whole.is_empty(), "of no use any more");
    }
}
