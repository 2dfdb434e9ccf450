//! A mesh against true depth maps.
use crate::distance::{Nearest, samples};
use glam::{DVec2, DVec3, Vec3};
use rayon::prelude::*;
use splatvk_types::math::median;
use splatvk_types::scene::{Camera, Image, Mesh};

/// A view with its true depth.
#[derive(Clone, Debug)]
pub struct TrueView {
    /// Its camera.
    pub camera: Camera,
    /// [H, W] camera z; 0 = unknown.
    pub depth: Image<f32>,
}

/// Figures of a mesh; shares are in 0..1.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Accuracy {
    /// Median distance to the true surface of the mesh where two photos see it, world units.
    pub median: f64,
    /// Mean of these distances.
    pub mean: f64,
    /// Diagonal of the box around the true points that two photos see.
    pub size: f64,
    /// At 1 % and at 2 % of depth.
    pub within: [Within; 2],
    /// Share of the area of the mesh that two photos see.
    pub seen_by_two: f64,
}

/// Shares within a distance.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Within {
    /// Share of the mesh, where two photos see it, near the true surface.
    pub precision: f64,
    /// Share of the whole mesh near the true surface; what no true view shows counts as far.
    pub precision_all: f64,
    /// Share of the true points that two photos see near the mesh.
    pub recall: f64,
    /// Harmonic mean of precision and recall.
    pub f1: f64,
}

/// Distances of [`Accuracy::within`], shares of depth.
pub const WITHIN: [f64; 2] = [0.01, 0.02];
/// Points on the mesh.
const SAMPLES: usize = 200_000;
/// Pixels between true points, and between the corners of the true surface.
const STEP: usize = 4;
const GRID: usize = 2;
/// Largest ratio of depths of neighbours on one surface.
const JUMP: f32 = 1.03;
/// Difference of depth up to which two views show the same point.
const SAME: f64 = 0.01;

/// Compares a mesh with the true depth of the photos, and with the surfaces of `others`, which count
/// as true, too. All in the same axes and units; `None` without a surface on either side.
pub fn accuracy(mesh: &Mesh, photos: &[TrueView], others: &[TrueView]) -> Option<Accuracy> {
    let own = Nearest::new(&mesh.positions, &mesh.triangles)?;
    let (positions, triangles) = true_surface(photos.iter().chain(others));
    let truth = Nearest::new(&positions, &triangles)?;
    let points = samples(mesh, SAMPLES);
    let distances = truth.distances(&points);
    let seen: Vec<bool> = points.par_iter().map(|p| seen_by(&own, photos, *p) >= 2).collect();
    let targets: Vec<[f32; 3]> = true_points(photos);
    let missed = own.distances(&targets);
    let mut shown: Vec<f64> =
        distances.iter().zip(&seen).filter(|(_, seen)| **seen).map(|(d, _)| f64::from(*d)).collect();
    let within = WITHIN.map(|share| {
        let near = |(p, d): (&[f32; 3], &f32)| f64::from(*d) <= share * depth(photos, *p);
        let ours: Vec<bool> = points.iter().zip(&distances).map(near).collect();
        let precision = part(ours.iter().zip(&seen).filter(|(_, seen)| **seen).map(|(near, _)| *near));
        let recall = part(targets.iter().zip(&missed).map(near));
        let f1 = 2.0 * precision * recall / (precision + recall).max(1e-12);
        Within { precision, precision_all: part(ours.iter().copied()), recall, f1 }
    });
    Some(Accuracy {
        mean: shown.iter().sum::<f64>() / shown.len().max(1) as f64,
        median: median(&mut shown).unwrap_or_default(),
        size: diagonal(&targets),
        within,
        seen_by_two: part(seen.iter().copied()),
    })
}

fn part(found: impl Iterator<Item = bool>) -> f64 {
    let (mut yes, mut all) = (0usize, 0usize);
    for is in found {
        yes += usize::from(is);
        all += 1;
    }
    yes as f64 / all.max(1) as f64
}

/// Pixel and depth of a point in a view; `None` outside of the image.
fn projected(camera: &Camera, point: DVec3) -> Option<(usize, f64)> {
    let (DVec2 { x, y }, z) = camera.project(point);
    let inside =
        z > 0.0 && x >= 0.0 && y >= 0.0 && x < f64::from(camera.width) && y < f64::from(camera.height);
    inside.then(|| (y as usize * camera.width as usize + x as usize, z))
}

fn world(point: [f32; 3]) -> DVec3 {
    Vec3::from_array(point).as_dvec3()
}

/// Least depth of a point among the photos that have it in their image; of all photos where none
/// has.
fn depth(photos: &[TrueView], point: [f32; 3]) -> f64 {
    let point = world(point);
    let least = |values: &mut dyn Iterator<Item = f64>| values.fold(f64::MAX, f64::min);
    let inside = least(&mut photos.iter().filter_map(|v| Some(projected(&v.camera, point)?.1)));
    match inside < f64::MAX {
        true => inside,
        false => least(&mut photos.iter().map(|v| v.camera.pose.centre().distance(point))),
    }
}

/// Number of photos that see a point of the mesh, which itself may hide it.
fn seen_by(mesh: &Nearest, photos: &[TrueView], point: [f32; 3]) -> usize {
    let point = world(point);
    let sees = |view: &&TrueView| {
        projected(&view.camera, point).is_some() && mesh.is_free(view.camera.pose.centre(), point, SAME)
    };
    photos.iter().filter(sees).count()
}

/// True points of the photos that at least two of them see.
fn true_points(photos: &[TrueView]) -> Vec<[f32; 3]> {
    let of_view = |view: &TrueView| {
        let (w, h) = (view.depth.width, view.depth.height);
        let pixels = (0..h).step_by(STEP).flat_map(move |y| (0..w).step_by(STEP).map(move |x| (x, y)));
        let points = pixels.filter_map(|(x, y)| point(view, x, y));
        points.filter(|p| photos.iter().filter(|v| shows(v, *p)).count() >= 2).collect::<Vec<DVec3>>()
    };
    photos.iter().flat_map(of_view).map(|p| p.as_vec3().to_array()).collect()
}

fn point(view: &TrueView, x: usize, y: usize) -> Option<DVec3> {
    let z = f64::from(view.depth.at(x, y));
    (z > 0.0).then(|| view.camera.unproject(DVec2::new(x as f64 + 0.5, y as f64 + 0.5), z))
}

fn shows(view: &TrueView, point: DVec3) -> bool {
    projected(&view.camera, point).is_some_and(|(pixel, z)| {
        let there = f64::from(view.depth.data[pixel]);
        there > 0.0 && (there - z).abs() <= SAME * there
    })
}

/// Triangles between neighbouring pixels, not across jumps of depth.
fn true_surface<'a>(views: impl Iterator<Item = &'a TrueView>) -> (Vec<[f32; 3]>, Vec<[u32; 3]>) {
    let (mut positions, mut triangles) = (Vec::new(), Vec::new());
    for view in views {
        let (w, h) = (view.depth.width / GRID, view.depth.height / GRID);
        let first = positions.len() as u32;
        let mut depths = Vec::with_capacity(w * h);
        for (y, x) in (0..h).flat_map(|y| (0..w).map(move |x| (y * GRID, x * GRID))) {
            depths.push(view.depth.at(x, y));
            positions.push(point(view, x, y).unwrap_or_default().as_vec3().to_array());
        }
        for (y, x) in (1..h).flat_map(|y| (1..w).map(move |x| (y, x))) {
            let [a, b, c, d] = [(y - 1) * w + x - 1, (y - 1) * w + x, y * w + x - 1, y * w + x];
            for corners in [[a, c, b], [b, c, d]] {
                let (low, high) = corners
                    .iter()
                    .fold((f32::MAX, 0.0f32), |(low, high), i| (low.min(depths[*i]), high.max(depths[*i])));
                if low > 0.0 && high < JUMP * low {
                    triangles.push(corners.map(|i| first + i as u32));
                }
            }
        }
    }
    (positions, triangles)
}

fn diagonal(points: &[[f32; 3]]) -> f64 {
    let side = |k: usize| {
        let mut values: Vec<f32> = points.iter().map(|p| p[k]).collect();
        values.sort_by(f32::total_cmp);
        let at = values.len() / 100;
        let ends = values.get(at).zip(values.get(values.len().max(1) - 1 - at));
        ends.map_or(0.0, |(low, high)| f64::from(high - low))
    };
    DVec3::new(side(0), side(1), side(2)).length()
}
