//! Depth maps of all views to one set of points (docs/internals/method.md#fusion).
use super::Level;
use super::surface::{RelativePoses, Surface, neighbours, ray};
use crate::scene::PointCloud;
use glam::Vec3;

/// Relative depth step to a neighbour above which a pixel may float between two surfaces
/// (docs/internals/method.md#fusion).
const FLYING: f32 = 0.06;
/// Confidence from which a pixel counts as matched rather than filled.
pub const MATCHED: f32 = 0.5;

/// Matched pixels of all views first, filled ones after; within each, views by decreasing mean
/// confidence. A pixel is skipped when a point already kept projects onto it at the same depth,
/// within the view's tolerance.
pub fn fuse(level: &Level, links: &RelativePoses, surface: &Surface) -> PointCloud {
    let mut order: Vec<usize> = (0..level.cameras.len()).collect();
    let mean = |view: usize| {
        let r = &level.references[view];
        let own = &surface.confidence[r.first as usize..(r.first + r.width * r.height) as usize];
        own.iter().sum::<f32>() / own.len().max(1) as f32
    };
    order.sort_by(|&a, &b| mean(b).total_cmp(&mean(a)).then(a.cmp(&b)));
    let mut cloud = PointCloud::default();
    // Kept points per view, in that view's frame.
    let mut kept: Vec<(usize, Vec<Vec3>)> = Vec::new();
    for matched in [true, false] {
        for &view in &order {
            let points = fuse_view(level, links, surface, view, matched, &kept, &mut cloud);
            kept.push((view, points));
        }
    }
    cloud
}

fn fuse_view(
    level: &Level,
    links: &RelativePoses,
    surface: &Surface,
    view: usize,
    matched: bool,
    kept: &[(usize, Vec<Vec3>)],
    cloud: &mut PointCloud,
) -> Vec<Vec3> {
    let r = &level.references[view];
    let (width, height) = (r.width as usize, r.height as usize);
    let depth = super::surface::depth(level, view, surface);
    let mut covered = vec![false; width * height];
    for (other, points) in kept {
        for &point in points {
            let Some((u, v, z)) = links.project(level, *other, view, point) else { continue };
            let (x, y) = (u as usize, v as usize);
            // A kept point stands for the 3 × 3 pixels around it: its neighbours' gaps when seen
            // closer by.
            for py in y.saturating_sub(1)..(y + 2).min(height) {
                for px in x.saturating_sub(1)..(x + 2).min(width) {
                    let here = depth.at(px, py);
                    if (here - z).abs() < level.tolerance[view] * here {
                        covered[py * width + px] = true;
                    }
                }
            }
        }
    }
    let to_world = level.cameras[view].pose.inverse();
    let mut added = Vec::new();
    for k in 0..width * height {
        let (z, confidence) = (depth.data[k], surface.confidence[r.first as usize + k]);
        let flying = neighbours(k, width, height)
            .any(|n| depth.data[n] > 0.0 && (depth.data[n] - z).abs() > FLYING * z);
        if z <= 0.0 || covered[k] || flying || (confidence >= MATCHED) != matched {
            continue;
        }
        let point = ray(level, view, k % width, k / width) * z;
        added.push(point);
        cloud.positions.push(to_world.transform(point.as_dvec3()).as_vec3().to_array());
        cloud.colours.push(level.guide[view].data[k]);
        cloud.confidence.push(confidence);
        cloud.view.push(view as u8);
        cloud.radius.push(z / r.intrinsics[0]);
    }
    added
}
