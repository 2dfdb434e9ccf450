//! Fusion of the depth maps of all views into points (docs/internals/method.md#fusion).
use super::Level;
use super::surface::{RelativePoses, Surface, neighbours, ray};
use crate::scene::PointCloud;
use glam::Vec3;
use rayon::prelude::*;
use std::sync::atomic::{AtomicBool, Ordering};

/// Relative depth step to a neighbour above which a pixel may float between two surfaces.
const FLYING: f32 = 0.06;
/// Least confidence of a matched pixel; filled ones have less.
pub const MATCHED: f32 = 0.5;
/// Distance of the points of sky, pixels.
const SKY_STEP: usize = 3;

/// Fuses matched pixels of all views first, then filled ones; within each, views by decreasing mean
/// confidence. A pixel is skipped if a kept point projects onto it at the same depth within the
/// view's tolerance. `sky` is smooth: a pixel in `SKY_STEP` per row and column suffices.
pub fn fuse(level: &Level, poses: &RelativePoses, surface: &Surface, sky: &[bool]) -> PointCloud {
    let mut order: Vec<usize> = (0..level.cameras.len()).collect();
    let mean_confidence = |view: usize| {
        let r = &level.references[view];
        let own = &surface.confidence[r.first as usize..(r.first + r.width * r.height) as usize];
        own.iter().sum::<f32>() / own.len().max(1) as f32
    };
    order.sort_by(|&a, &b| mean_confidence(b).total_cmp(&mean_confidence(a)).then(a.cmp(&b)));
    let mut cloud = PointCloud::default();
    // Kept points per view, in that view's frame.
    let mut kept: Vec<(usize, Vec<Vec3>)> = Vec::new();
    for matched in [true, false] {
        for &view in &order {
            let points = fuse_view(level, poses, surface, sky, view, matched, &kept, &mut cloud);
            kept.push((view, points));
        }
    }
    cloud
}

fn fuse_view(
    level: &Level,
    poses: &RelativePoses,
    surface: &Surface,
    sky: &[bool],
    view: usize,
    matched: bool,
    kept: &[(usize, Vec<Vec3>)],
    cloud: &mut PointCloud,
) -> Vec<Vec3> {
    let r = &level.references[view];
    let (width, height) = (r.width as usize, r.height as usize);
    let depth = super::surface::depth(level, view, surface);
    // The order in which points cover pixels does not matter.
    let covered: Vec<AtomicBool> = (0..width * height).map(|_| AtomicBool::new(false)).collect();
    let cover = |other: usize, point: Vec3| {
        let Some((u, v, z)) = poses.project(level, other, view, point) else { return };
        let (x, y) = (u as usize, v as usize);
        // A kept point covers 3 × 3 pixels, so that no gaps arise in a closer view.
        for py in y.saturating_sub(1)..(y + 2).min(height) {
            for px in x.saturating_sub(1)..(x + 2).min(width) {
                let here = depth.at(px, py);
                if (here - z).abs() < level.tolerance[view] * here {
                    covered[py * width + px].store(true, Ordering::Relaxed);
                }
            }
        }
    };
    let compared: Vec<usize> = level.neighbours(view).chain([view]).collect();
    for (other, points) in kept.iter().filter(|(other, _)| compared.contains(other)) {
        points.par_iter().with_min_len(1024).for_each(|point| cover(*other, *point));
    }
    let is_sky = |k: usize| sky[r.first as usize + k];
    let skipped = |k: usize| is_sky(k) && (k % width % SKY_STEP, k / width % SKY_STEP) != (1, 1);
    let is_new = |k: &usize| {
        let (z, confidence) = (depth.data[*k], surface.confidence[r.first as usize + k]);
        z > 0.0
            && !skipped(*k)
            && (confidence >= MATCHED) == matched
            && !covered[*k].load(Ordering::Relaxed)
            && !neighbours(*k, width, height)
                .any(|n| depth.data[n] > 0.0 && (depth.data[n] - z).abs() > FLYING * z)
    };
    let new: Vec<usize> = (0..width * height).into_par_iter().with_min_len(1024).filter(is_new).collect();
    let to_world = level.cameras[view].pose.inverse();
    let mut added = Vec::with_capacity(new.len());
    for k in new {
        let (z, confidence) = (depth.data[k], surface.confidence[r.first as usize + k]);
        let point = ray(level, view, k % width, k / width) * z;
        added.push(point);
        cloud.positions.push(to_world.transform(point.as_dvec3()).as_vec3().to_array());
        cloud.colours.push(level.guide[view].data[k]);
        cloud.confidence.push(confidence);
        cloud.view.push(view as u32);
        let pixels = if is_sky(k) { SKY_STEP as f32 } else { 1.0 };
        cloud.radius.push(pixels * z / r.intrinsics[0]);
        let normal = to_world.rotation * surface.planes[r.first as usize + k].as_dvec3();
        cloud.normals.push(normal.normalize_or_zero().as_vec3().to_array());
    }
    added
}
