//! Photos that join a finished scene: their cameras, the surfaces that they add, and their masks
//! under the scene's codes.
use super::cameras::{KnownGeometry, PlacedPhotos};
use super::shared;
use super::shared::keypoints;
use crate::fit::{self, Preset, RgbOptions, Trained};
use crate::language::{self, BuildOptions, Language, SceneView, ViewMasks};
use crate::pass::plane_sweep::DevicePlaneSweep;
use crate::pass::renderer::Renderer;
use crate::photo::Photo;
use crate::pipeline::{Codec, Context, Lane, Output, Stage, kept};
use crate::pose::stereo::StereoOptions;
use crate::pose::{self, Geometry, SparseModel};
use crate::run::base::BaseScene;
use crate::run::view::{self, Viewer};
use crate::scene::{Camera, DepthMap, Image, Splats, Up};
use crate::{Error, Result};
use std::collections::BTreeSet;
use std::sync::Arc;

/// Registers new photos in a scene by matches with its photos; training then refines their cameras
/// against its splats.
pub struct AddedCameras {
    /// The scene.
    pub base: Arc<BaseScene>,
    /// New photos.
    pub photos: Vec<Photo>,
    /// Seed of the RANSAC samples.
    pub seed: u64,
}

impl Stage for AddedCameras {
    const NAME: &'static str = "added-cameras";
    const LANE: Lane = Lane::Device;
    type Inputs = ();
    type Output = PlacedPhotos;

    fn settings(&self) -> String {
        let names: Vec<String> = self.photos.iter().map(super::cameras::identity).collect();
        format!("{} {names:?} {}", self.base.identity, self.seed)
    }

    fn codec() -> Option<Codec<PlacedPhotos>> {
        kept()
    }

    fn run(self, (): (), context: &Context) -> Result<PlacedPhotos> {
        let pose::SolvedCameras { photos, model, left_out, method } = pose::add(
            &self.base.known,
            self.photos,
            &mut keypoints(context.registry)?,
            self.seed,
            context.progress,
        )?;
        Ok(PlacedPhotos { photos, left_out, known: KnownGeometry::Sparse(model, method) })
    }
}

/// Depth of all photos and points that the new ones add: stereo for the new photos and their
/// neighbours, rendered depth for the others.
pub struct AddedDepth {
    /// The scene.
    pub base: Arc<BaseScene>,
    /// Trade-off of time and quality.
    pub preset: Preset,
    /// Seed of the planes that stereo tries.
    pub seed: u64,
}

/// Photos of the scene that stereo matches with a new one. Together they are four, the number that
/// stereo was tuned on. Each takes as long as the new photo.
const NEIGHBOURS: usize = 3;

impl Stage for AddedDepth {
    const NAME: &'static str = "added-depth";
    const LANE: Lane = Lane::Device;
    type Inputs = (Output<PlacedPhotos>,);
    type Output = Geometry;

    fn settings(&self) -> String {
        format!("{:?}", StereoOptions::preset(self.preset).seeded(self.seed))
    }

    fn codec() -> Option<Codec<Geometry>> {
        kept()
    }

    fn run(self, (placed,): (&PlacedPhotos,), context: &Context) -> Result<Geometry> {
        let KnownGeometry::Sparse(model, method) = &placed.known else {
            return Err(Error::work("added photos have cameras and sparse points"));
        };
        let (count, all) = (self.base.known.photos.len(), placed.photos.len());
        let shown = shown_splats(&self.base, usize::MAX, context)?;
        let mut renderer = Renderer::new(context.device, &shown, &[], 0)?;
        let rendered: Vec<Image<f32>> =
            model.cameras.iter().map(|c| Ok(renderer.render(c)?.depth)).collect::<Result<_>>()?;

        let views = with_neighbours(model, count, all);
        let (photos, cameras): (Vec<Photo>, Vec<Camera>) =
            views.iter().map(|v| (placed.photos[*v].clone(), model.cameras[*v].clone())).unzip();
        let sparse = SparseModel { cameras, points: model.points.clone(), ..SparseModel::default() };
        let options = StereoOptions::preset(self.preset).seeded(self.seed);
        let priors: Vec<_> = photos.iter().map(|_| None).collect();
        let dense = pose::dense(
            &DevicePlaneSweep::new(context.device),
            &photos,
            &priors,
            sparse,
            String::new(),
            &options,
            context.progress,
        )?;

        let mut depths: Vec<DepthMap> = rendered.iter().cloned().map(DepthMap::rendered).collect();
        let mut sky = vec![0.0; all];
        for ((view, depth), share) in views.iter().zip(dense.depths).zip(dense.sky) {
            depths[*view] = depth;
            sky[*view] = share;
        }
        let new: Vec<_> = (count..all).map(|v| (&model.cameras[v], &depths[v], &rendered[v])).collect();
        let mut points = fit::new_surface(&dense.points, &new);
        points.view.iter_mut().for_each(|v| *v = views[*v as usize] as u32);
        Ok(Geometry {
            cameras: model.cameras.clone(),
            points,
            depths,
            focal_log_sigma: model.focal_log_sigma,
            fitted: model.fitted.clone(),
            sky,
            method: method.clone(),
        })
    }
}

/// The splats of a scene that its photos show, at most `most`. Its unseen surfaces are left out;
/// training extrapolates them again with the new photos.
fn shown_splats(base: &BaseScene, most: usize, context: &Context) -> Result<Splats> {
    let rows = if base.seen.pixels.is_empty() {
        let seen = view::seen(context.device, &base.splats, &base.known.cameras, context.progress)?;
        seen.most_shown(&base.splats, most)
    } else {
        base.seen.most_shown(&base.splats, most)
    };
    Ok(base.splats.picked(&rows))
}

/// New views, and for each the known views that share most points with it; ascending.
fn with_neighbours(model: &SparseModel, known: usize, all: usize) -> Vec<usize> {
    let mut views: BTreeSet<usize> = (known..all).collect();
    for new in known..all {
        let mut shared = vec![0usize; known];
        for point in model.points.iter().filter(|p| p.views.iter().any(|v| v.0 == new)) {
            point.views.iter().filter(|v| v.0 < known).for_each(|v| shared[v.0] += 1);
        }
        let mut order: Vec<usize> = (0..known).collect();
        order.sort_by_key(|v| (std::cmp::Reverse(shared[*v]), *v));
        views.extend(order.into_iter().take(NEIGHBOURS));
    }
    views.into_iter().collect()
}

/// Continues training of a scene with all photos.
pub struct TrainOn {
    /// The scene.
    pub base: Arc<BaseScene>,
    /// Options of the training.
    pub options: RgbOptions,
}

impl Stage for TrainOn {
    const NAME: &'static str = "added-splats";
    const LANE: Lane = Lane::Device;
    type Inputs = (Output<PlacedPhotos>, Output<Geometry>);
    type Output = Trained;

    fn settings(&self) -> String {
        format!("{} {:?}", self.base.identity, self.options)
    }

    fn codec() -> Option<Codec<Trained>> {
        kept()
    }

    fn run(self, (placed, geometry): (&PlacedPhotos, &Geometry), context: &Context) -> Result<Trained> {
        let (count, all) = (self.base.known.photos.len(), placed.photos.len());
        let most = self.options.init.max_points;
        let options = self.options.for_continuation(count, all - count);
        // The final number of splats on surfaces is that of a run with all photos.
        let fresh = geometry.points.len().min(options.init.max_points);
        let scene = shown_splats(&self.base, most - fresh, context)?;
        let (targets, coverage) = shared::targets(&placed.photos);
        fit::train_on(
            context.device,
            shared::posed(&targets, &geometry.cameras, Some(&geometry.depths), &coverage),
            scene,
            &geometry.points,
            &options,
            context.progress,
        )
    }
}

/// The new photos alone, for stages that the scene's own photos have passed.
pub struct OnlyAdded {
    /// Number of photos of the scene.
    pub known: usize,
}

impl Stage for OnlyAdded {
    const NAME: &'static str = "added-photos";
    const LANE: Lane = Lane::Processor;
    type Inputs = (Output<PlacedPhotos>,);
    type Output = PlacedPhotos;

    fn settings(&self) -> String {
        self.known.to_string()
    }

    fn run(self, (placed,): (&PlacedPhotos,), _: &Context) -> Result<PlacedPhotos> {
        Ok(PlacedPhotos { photos: placed.photos[self.known..].to_vec(), ..placed.clone() })
    }
}

/// Cameras and depth of the new photos alone.
pub struct OnlyAddedGeometry {
    /// Number of photos of the scene.
    pub known: usize,
}

impl Stage for OnlyAddedGeometry {
    const NAME: &'static str = "added-geometry";
    const LANE: Lane = Lane::Processor;
    type Inputs = (Output<Geometry>,);
    type Output = Geometry;

    fn settings(&self) -> String {
        self.known.to_string()
    }

    fn run(self, (geometry,): (&Geometry,), _: &Context) -> Result<Geometry> {
        Ok(Geometry {
            cameras: geometry.cameras[self.known..].to_vec(),
            depths: geometry.depths[self.known..].to_vec(),
            sky: geometry.sky[self.known..].to_vec(),
            ..geometry.clone()
        })
    }
}

/// Assigns the codes of the scene to the masks of new photos; masks that match none of its things
/// get codes of their own.
pub struct AlignAdded {
    /// The scene.
    pub base: Arc<BaseScene>,
    /// Thresholds of the alignment, length of the codes.
    pub options: BuildOptions,
}

impl Stage for AlignAdded {
    const NAME: &'static str = "added-alignment";
    const LANE: Lane = Lane::Device;
    type Inputs = (Output<Vec<ViewMasks>>, Output<Geometry>, Output<Trained>);
    type Output = Language;

    fn settings(&self) -> String {
        format!("{} {:?}", self.base.identity, self.options)
    }

    fn codec() -> Option<Codec<Language>> {
        kept()
    }

    fn run(
        self,
        (masks, geometry, trained): (&Vec<ViewMasks>, &Geometry, &Trained),
        context: &Context,
    ) -> Result<Language> {
        let (base, count) = (&self.base, self.base.known.photos.len());
        let mut viewer = Viewer::new(context.device, &base.splats, &base.field)?;
        // The scene's own photos keep training on the codes that the scene shows.
        let known = base.known.cameras.iter().map(|c| viewer.codes(c)).collect::<Result<Vec<_>>>()?;
        let new = trained.cameras[count..].iter().zip(&geometry.depths[count..]);
        let new = new
            .map(|(camera, measured)| {
                let frame = viewer.view(camera)?;
                Ok(SceneView {
                    camera: camera.clone(),
                    codes: frame.codes,
                    depth: frame.rendered.depth,
                    measured,
                })
            })
            .collect::<Result<Vec<_>>>()?;
        language::join(&base.field, known, &new, masks, &self.options, context.progress)
    }
}

/// The direction up that the scene states.
pub struct KnownUp(pub Option<Up>);

impl Stage for KnownUp {
    const NAME: &'static str = "known-up";
    const LANE: Lane = Lane::Processor;
    type Inputs = ();
    type Output = Option<Up>;

    fn settings(&self) -> String {
        format!("{:?}", self.0)
    }

    fn run(self, (): (), _: &Context) -> Result<Option<Up>> {
        Ok(self.0)
    }
}
