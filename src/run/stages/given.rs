//! Splats of another program in place of trained ones, with views that show them.
use super::cameras::{KnownGeometry, PlacedPhotos, identity};
use super::language::TrainLanguage;
use crate::Result;
use crate::fit::{Trained, TrainedLanguage};
use crate::language::Language;
use crate::language::align::{PairLinks, links_from_depth};
use crate::pass::renderer::RenderedFrame;
use crate::photo::Photo;
use crate::pipeline::{Context, Lane, Output, Stage};
use crate::pose::Geometry;
use crate::scene::{Splats, Up};
use rayon::prelude::*;

/// Splats, and pictures of them with cameras and rendered depth.
pub struct GivenViews {
    /// Checksum of the splats.
    pub identity: String,
    /// The splats without direction-dependent colour.
    pub splats: Splats,
    /// Pictures: photos, or renders.
    pub photos: Vec<Photo>,
    /// Whether the pictures are photos, whose edges and cameras are evidence of the direction up.
    pub shows_photos: bool,
    /// Cameras, depth and points.
    pub geometry: Geometry,
    /// Renders of the splats in full colour, one per picture.
    pub frames: Vec<RenderedFrame>,
    /// Direction up, if it is known.
    pub up: Option<Up>,
}

/// The pictures as placed photos.
pub struct GivenPhotos {
    photos: Vec<Photo>,
    geometry: Geometry,
    settings: String,
}

impl GivenPhotos {
    /// Takes the pictures and the geometry out of `views`.
    pub fn new(views: &mut GivenViews) -> GivenPhotos {
        let photos = std::mem::take(&mut views.photos);
        let geometry = std::mem::take(&mut views.geometry);
        let pictures: Vec<String> = photos.iter().map(identity).collect();
        let settings = format!("{} {pictures:?} {:?}", views.identity, geometry.cameras);
        GivenPhotos { photos, geometry, settings }
    }

    /// Photos before their cameras are estimated, for the stages of masks and features.
    pub fn unplaced(photos: Vec<Photo>) -> GivenPhotos {
        let identities: Vec<String> = photos.par_iter().map(identity).collect();
        GivenPhotos { photos, geometry: Geometry::default(), settings: format!("{identities:?}") }
    }
}

impl Stage for GivenPhotos {
    const NAME: &'static str = "given-photos";
    const LANE: Lane = Lane::Processor;
    type Inputs = ();
    type Output = PlacedPhotos;

    fn settings(&self) -> String {
        self.settings.clone()
    }

    fn run(self, (): (), _: &Context) -> Result<PlacedPhotos> {
        let known = KnownGeometry::Complete(self.geometry);
        Ok(PlacedPhotos { photos: self.photos, left_out: Vec::new(), known })
    }
}

/// The geometry of placed photos whose depth is known.
pub struct GivenGeometry;

impl Stage for GivenGeometry {
    const NAME: &'static str = "given-geometry";
    const LANE: Lane = Lane::Processor;
    type Inputs = (Output<PlacedPhotos>,);
    type Output = Geometry;

    fn settings(&self) -> String {
        String::new()
    }

    fn run(self, (placed,): (&PlacedPhotos,), _: &Context) -> Result<Geometry> {
        match &placed.known {
            KnownGeometry::Complete(geometry) => Ok(geometry.clone()),
            KnownGeometry::Sparse(..) => Err(crate::Error::work("given splats have depth")),
        }
    }
}

/// The splats in place of trained ones.
pub struct GivenSplats {
    /// Checksum of the splats.
    pub identity: String,
    /// The splats.
    pub splats: Splats,
}

impl Stage for GivenSplats {
    const NAME: &'static str = "given-splats";
    const LANE: Lane = Lane::Processor;
    type Inputs = (Output<Geometry>,);
    type Output = Trained;

    fn settings(&self) -> String {
        self.identity.clone()
    }

    fn run(self, (geometry,): (&Geometry,), _: &Context) -> Result<Trained> {
        Ok(Trained::given(self.splats, geometry.cameras.clone()))
    }
}

/// Matches by reprojection. The depth of all views is that of the same splats, so that it links more
/// pixels than descriptors do, in less time.
pub struct ReprojectedMatches;

impl Stage for ReprojectedMatches {
    const NAME: &'static str = "reprojected-matches";
    const LANE: Lane = Lane::Processor;
    type Inputs = (Output<Geometry>,);
    type Output = Vec<PairLinks>;

    fn settings(&self) -> String {
        String::new()
    }

    fn run(self, (geometry,): (&Geometry,), context: &Context) -> Result<Vec<PairLinks>> {
        let (cameras, depths) = (&geometry.cameras, &geometry.depths);
        let views = cameras.len();
        let pairs = (0..views).flat_map(|i| (i + 1..views).map(move |j| (i, j)));
        context.progress.begin("match", (views * views.saturating_sub(1) / 2) as u64);
        let mut links = Vec::new();
        for (i, j) in pairs {
            context.progress.check()?;
            links.push(links_from_depth(i, j, (&cameras[i], &cameras[j]), (&depths[i], &depths[j])));
            context.progress.step(links.len() as u64, "");
        }
        context.progress.end();
        Ok(links)
    }
}

/// [`TrainLanguage`] whose output is not kept on disk: lifting takes less time than a file of
/// millions of splats.
pub struct LiftLanguage(pub TrainLanguage);

impl Stage for LiftLanguage {
    const NAME: &'static str = "lift";
    const LANE: Lane = Lane::Device;
    type Inputs = (Output<PlacedPhotos>, Output<Trained>, Output<Language>);
    type Output = TrainedLanguage;

    fn settings(&self) -> String {
        self.0.settings()
    }

    fn run(self, inputs: (&PlacedPhotos, &Trained, &Language), context: &Context) -> Result<TrainedLanguage> {
        self.0.run(inputs, context)
    }
}
