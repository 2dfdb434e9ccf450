//! Splats that float in front of the surfaces that the photos show.
use crate::format::scene_dir::Scene;
use crate::scene::{Camera, Image};
use crate::{Error, Result};
use glam::DVec3;
use rayon::prelude::*;

/// Relative difference of depth from which a splat is off a surface.
const OFF: f64 = 0.06;

/// Relation of a splat to the surface of a view.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Side {
    /// Outside of the view, behind its surface, or where it shows none.
    Unknown,
    On,
    InFront,
}

/// Splats in the free space between a photo's camera and its surface that lie on the surface of no
/// photo; `thorough`: of at most one, where more photos look through them.
///
/// # Errors
/// A scene without cameras.
pub(super) fn find(scene: &Scene, depths: &[Image<f32>], thorough: bool) -> Result<Vec<usize>> {
    if scene.cameras.is_empty() {
        return Err(Error::input(format!(
            "{}: no cameras, so no surfaces that floaters are in front of",
            scene.path.display()
        )));
    }
    let floats = |i: &usize| {
        let mean = DVec3::from_array(scene.splats.means[*i].map(f64::from));
        let sides = scene.cameras.iter().zip(depths).map(|(camera, depth)| side(mean, camera, depth));
        let (on, front) = sides.fold((0, 0), |(on, front), side| match side {
            Side::Unknown => (on, front),
            Side::On => (on + 1, front),
            Side::InFront => (on, front + 1),
        });
        front > on && (on == 0 || thorough && on == 1)
    };
    Ok((0..scene.splats.len()).into_par_iter().filter(floats).collect())
}

fn side(mean: DVec3, camera: &Camera, depth: &Image<f32>) -> Side {
    let inside = |v: f64, size: u32| (0.0..f64::from(size)).contains(&v);
    let (pixel, z) = camera.project(mean);
    if z <= 0.0 || !inside(pixel.x, camera.width) || !inside(pixel.y, camera.height) {
        return Side::Unknown;
    }
    let surface = f64::from(depth.at(pixel.x as usize, pixel.y as usize));
    match (z - surface) / surface {
        _ if surface <= 0.0 => Side::Unknown,
        off if off < -OFF => Side::InFront,
        off if off <= OFF => Side::On,
        _ => Side::Unknown,
    }
}
