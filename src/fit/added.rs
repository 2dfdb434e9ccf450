//! Training of a scene with photos added later (docs/internals/method.md#photos-added-later): its
//! splats are trained further, and surfaces that it lacks become new splats.
use super::bounds::Bounds;
use super::init::splats_from_points;
use super::options::RgbOptions;
use super::photos::Photos;
use super::rgb::{Trained, fit_with_unseen};
use super::scale::SceneScale;
use super::unseen::continued_surfaces;
use crate::Result;
use crate::gpu::Device;
use crate::progress::Progress;
use crate::scene::{Camera, DepthMap, Image, PointCloud, Splats};
use glam::DVec3;

/// Relative depth difference from which a point is on another surface than the rendered one: the
/// tolerance of occlusion tests between views (docs/internals/method.md#reprojection).
const SAME_SURFACE: f64 = 0.05;

/// Fewest points that become splats.
const MIN_POINTS: usize = 4;

/// Points on surfaces that a scene lacks: those that a new view measures where the scene renders
/// nothing, or a surface that is clearly nearer or farther. `views` are new cameras, each with its
/// measured depth and the depth that the scene renders.
pub fn new_surface(points: &PointCloud, views: &[(&Camera, &DepthMap, &Image<f32>)]) -> PointCloud {
    let is_new = |i: usize| {
        let p = DVec3::from(points.positions[i].map(f64::from));
        views.iter().any(|(camera, measured, rendered)| {
            let (pixel, z) = camera.project(p);
            let inside = |v: f64, size: u32| (0.0..f64::from(size)).contains(&v);
            if z <= 0.0 || !inside(pixel.x, camera.width) || !inside(pixel.y, camera.height) {
                return false;
            }
            let (x, y) = (pixel.x as usize, pixel.y as usize);
            let same = |d: f64| (d / z - 1.0).abs() < SAME_SURFACE;
            same(f64::from(measured.depth.at(x, y))) && !same(f64::from(rendered.at(x, y)))
        })
    };
    let rows: Vec<usize> = (0..points.len()).filter(|i| is_new(*i)).collect();
    points.picked(&rows)
}

/// Continues training: `scene` are the splats that photos show, `fresh` the points of new surfaces.
/// `photos` begin with those of the scene.
pub(crate) fn train_on(
    device: &Device,
    photos: Photos,
    scene: Splats,
    fresh: &PointCloud,
    options: &RgbOptions,
    progress: &dyn Progress,
) -> Result<Trained> {
    let mut start = scene;
    if fresh.len() >= MIN_POINTS {
        start.append_raised(splats_from_points(fresh, &options.init, options.seed)?);
    }
    let surfaces = start.means.clone();
    let cameras = photos.cameras;
    let mut unseen = continued_surfaces(&photos, options);
    if options.bounded {
        let bounds = Bounds::new(cameras, &surfaces);
        (start, unseen) = (bounds.clamp_to_bounds(start), bounds.clamp_to_bounds(unseen));
    }
    let scale = SceneScale::measure(cameras, &surfaces);
    let trained = fit_with_unseen(device, photos, start, unseen, scale, options, progress)?;
    Ok(trained.with_backdrop(&photos, options))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::Pose;

    #[test]
    fn new_surface_excludes_rendered_surfaces() {
        let camera = Camera {
            name: String::new(),
            width: 4,
            height: 1,
            fx: 4.0,
            fy: 4.0,
            cx: 0.0,
            cy: 0.5,
            pose: Pose::IDENTITY,
        };
        // Pixel 0 is rendered at the measured depth, 1 behind it, 2 not at all; the point of 3 is
        // not at the measured depth.
        let measured = DepthMap {
            depth: Image { width: 4, height: 1, data: vec![2.0, 2.0, 2.0, 1.0] },
            confidence: Image { width: 4, height: 1, data: vec![0.9; 4] },
        };
        let rendered = Image { width: 4, height: 1, data: vec![2.05, 3.0, 0.0, 0.0] };
        let mut points = PointCloud::default();
        for x in 0..4 {
            let p = camera.unproject(glam::DVec2::new(f64::from(x) + 0.5, 0.5), 2.0);
            points.positions.push(p.as_vec3().to_array());
            points.colours.push([0.5; 3]);
            points.confidence.push(0.9);
            points.view.push(0);
            points.radius.push(0.5);
        }
        let found = new_surface(&points, &[(&camera, &measured, &rendered)]);
        assert_eq!(found.positions, points.positions[1..3]);
    }
}
