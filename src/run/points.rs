//! Given points as a start, instead of stereo.
use crate::format::ply;
use crate::format::{CameraFile, colmap};
use crate::photo::Photo;
use crate::pose::{self, Geometry};
use crate::progress::Progress;
use crate::scene::{Camera, PointCloud};
use crate::{Error, Result};
use std::path::Path;

/// Builds the geometry of given cameras and points; removes the distortion of the photos.
pub(super) fn geometry(
    photos: &mut [Photo],
    known: &CameraFile,
    cloud: PointCloud,
    progress: &dyn Progress,
) -> Result<Geometry> {
    known.warnings.iter().for_each(|w| progress.warn(w));
    let cameras = pose::assign(photos, &known.cameras, progress)?;
    photos.iter_mut().for_each(|p| p.fine = None);
    let points = with_footprints(cloud, &cameras, progress)?;
    Ok(Geometry {
        points,
        cameras,
        depths: Vec::new(),
        focal_log_sigma: None,
        fitted: Vec::new(),
        sky: Vec::new(),
        method: "cameras+points".into(),
    })
}

/// Reads points of a `.ply`, a COLMAP model folder or a data set that holds one.
pub(super) fn read(path: &Path, progress: &dyn Progress) -> Result<PointCloud> {
    if path.is_dir() {
        return colmap::read_points(path);
    }
    let (points, notes) = ply::read_points(path)?;
    notes.iter().for_each(|note| progress.warn(note));
    Ok(points)
}

/// Sets the footprint that initialisation needs: `z / f` in the camera that sees the point nearest.
/// Points outside all cameras are dropped.
pub fn with_footprints(cloud: PointCloud, cameras: &[Camera], progress: &dyn Progress) -> Result<PointCloud> {
    let mut kept = PointCloud::default();
    // Values that are not finite would spread in training.
    let is_finite = |i: &usize| cloud.positions[*i].iter().chain(&cloud.colours[*i]).all(|v| v.is_finite());
    let dropped = cloud.len() - (0..cloud.len()).filter(is_finite).count();
    if dropped > 0 {
        progress.warn(&format!(
            "--points: {dropped} of {} points are left out: they have numbers that are not finite",
            cloud.len()
        ));
    }
    for i in (0..cloud.len()).filter(is_finite) {
        let p = glam::Vec3::from_array(cloud.positions[i]).as_dvec3();
        let footprints = cameras.iter().enumerate().filter_map(|(v, c)| {
            let (pixel, z) = c.project(p);
            let inside =
                pixel.x >= 0.0 && pixel.y >= 0.0 && pixel.x < c.width as f64 && pixel.y < c.height as f64;
            (z > 0.0 && inside).then_some((v, (z / c.fx) as f32))
        });
        if let Some((view, radius)) = footprints.min_by(|a, b| a.1.total_cmp(&b.1)) {
            kept.positions.push(cloud.positions[i]);
            kept.colours.push(cloud.colours[i]);
            kept.confidence.push(cloud.confidence[i]);
            kept.view.push(view as u32);
            kept.radius.push(radius);
        }
    }
    if kept.is_empty() {
        return Err(Error::input(
            "--points: no point with a colour is seen by any camera; are both in the same coordinates?",
        ));
    }
    Ok(kept)
}
