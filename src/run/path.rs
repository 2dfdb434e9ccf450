//! Views of a scene along a path between its photos or beside them.
use super::score::rendered;
use super::view::{DecodedFrame, Viewer};
use crate::eval::{PhotoView, ShownScore, shown_pixels, shown_score};
use crate::photo::stem;
use crate::scene::{Camera, CameraOrbit, RgbImage, World};
use crate::{Error, Result};
use glam::{DVec2, DVec3};

/// Views to render.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CameraPath {
    /// The cameras of the photos and views between them ([`CameraOrbit::between`]).
    Photos,
    /// Views beside the photos ([`CameraOrbit::beyond`]).
    Beyond,
}

/// Frames of a video from one photo to the next: a second.
pub const FRAMES_PER_SEGMENT: usize = 24;

/// The photos of a scene, rendered once.
pub struct PathViews {
    orbit: CameraOrbit,
    photos: Vec<PhotoView>,
}

impl PathViews {
    /// Renders the scene from the cameras of its photos. The point that they look at is the mean of
    /// the points at the median depth of each image's central third.
    ///
    /// # Errors
    /// Bad input for a scene without cameras, or whose cameras show nothing in the middle.
    pub fn new(viewer: &mut Viewer, cameras: &[Camera], world: &World) -> Result<PathViews> {
        if cameras.is_empty() {
            return Err(Error::input(
                "--path: the scene has no cameras of photos; give the cameras with --cameras",
            ));
        }
        let (mut targets, mut photos) = (Vec::new(), Vec::new());
        for camera in cameras {
            let view = rendered(&viewer.view(camera)?);
            targets.extend(view.depth.central_median().map(|z| {
                let middle = DVec2::new(f64::from(camera.width), f64::from(camera.height)) / 2.0;
                camera.unproject(middle, z)
            }));
            photos.push(PhotoView::new(camera.clone(), &view.rgb, view.depth));
        }
        if targets.is_empty() {
            return Err(Error::input(
                "--path: the middle of every photo is empty; give the cameras with --cameras",
            ));
        }
        let target = targets.iter().sum::<DVec3>() / targets.len() as f64;
        let up = world.up.as_ref().map_or_else(|| CameraOrbit::mean_up(cameras), |up| up.direction);
        let named: Vec<Camera> =
            cameras.iter().map(|c| Camera { name: stem(&c.name).into(), ..c.clone() }).collect();
        Ok(PathViews { orbit: CameraOrbit::new(&named, target, up.normalize_or(-DVec3::Y)), photos })
    }

    /// The point that the photos look at, and the unit vector up.
    pub fn middle(&self) -> (DVec3, DVec3) {
        (self.orbit.target(), self.orbit.up())
    }

    /// The views of a path.
    pub fn cameras(&self, path: CameraPath) -> Vec<Camera> {
        match path {
            CameraPath::Photos => self.orbit.between(),
            CameraPath::Beyond => self.orbit.beyond(),
        }
    }

    /// Cameras of a video along a path, 24 per second.
    pub fn video(&self, path: CameraPath) -> Vec<Camera> {
        self.orbit.video(path == CameraPath::Beyond, FRAMES_PER_SEGMENT)
    }

    /// Opacity and colours of a view against the scene as its photos' cameras show it; depth is the
    /// rendered one.
    pub fn score(&self, camera: &Camera, view: &DecodedFrame) -> ShownScore {
        let view = rendered(view);
        let shown = shown_pixels(camera, &view.depth, &self.photos);
        shown_score(camera, &view, &shown, &self.photos)
    }
}

/// A view that fits into `cell` pixels (width, height), with colours clipped to [0, 1].
pub fn fitted(view: &RgbImage, cell: [usize; 2]) -> RgbImage {
    let scale = (cell[0] as f64 / view.width as f64).min(cell[1] as f64 / view.height as f64);
    let [w, h] = [view.width, view.height].map(|side| ((side as f64 * scale) as usize).max(1));
    let clipped = view.data.iter().map(|c| c.map(|v| v.clamp(0.0, 1.0))).collect();
    RgbImage { data: clipped, ..*view }.resized_by_area(w, h)
}

/// Views side by side, row by row, each [`fitted`] into the same `cell`.
pub fn sheet(views: &[RgbImage], columns: usize, cell: [usize; 2]) -> RgbImage {
    let columns = columns.min(views.len()).max(1);
    let [width, height] = [cell[0] * columns, cell[1] * views.len().div_ceil(columns)];
    let mut out = RgbImage { width, height, data: vec![[1.0; 3]; width * height] };
    for (k, view) in views.iter().enumerate() {
        let [left, top] = [(k % columns) * cell[0], (k / columns) * cell[1]];
        for (y, row) in view.data.chunks_exact(view.width).enumerate() {
            let start = (top + y) * width + left;
            out.data[start..start + view.width].copy_from_slice(row);
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sheet_places_views_in_rows() {
        let view = |v: f32, width: usize| RgbImage { width, height: 4, data: vec![[v; 3]; 4 * width] };
        let views = [view(0.1, 8), view(0.2, 8), view(0.3, 2)].map(|v| fitted(&v, [4, 2]));
        let sheet = sheet(&views, 2, [4, 2]);
        assert_eq!((sheet.width, sheet.height), (8, 4));
        let value = |x, y| (sheet.at(x, y)[0] * 10.0).round();
        assert_eq!(
            [value(0, 0), value(3, 1), value(4, 0), value(0, 2), value(1, 2)],
            [1.0, 1.0, 2.0, 3.0, 10.0]
        );
        assert_eq!(value(5, 3), 10.0);
    }
}
