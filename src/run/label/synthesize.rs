//! Cameras for splats without photos: in free space, looking at the mass of opacity.
use super::coverage::{Shown, most_covering, shown};
use super::space::Space;
use crate::math::Random;
use crate::pass::renderer::{RenderedFrame, Renderer};
use crate::progress::Progress;
use crate::scene::{Camera, Pose, Splats};
use crate::{Error, Result};
use glam::{DMat3, DQuat, DVec2, DVec3, Vec3};
use rayon::prelude::*;

/// Horizontal field of view, degrees: that of a phone.
const FIELD: f64 = 65.0;
/// Longest side of a view, pixels.
pub(super) const SIDE: u32 = 640;
/// Longest side of a view that is only tried, pixels.
pub(super) const TRIED_SIDE: u32 = 160;
/// Positions that are tried by rays.
const POSITIONS: usize = 2500;
/// Directions from each position: around, and (degrees) above the horizon.
const AZIMUTHS: usize = 12;
const ELEVATIONS: [f64; 3] = [-45.0, -25.0, -5.0];
/// Rays of a view along its width and height: to sort views out, and to compare them.
const FEW_RAYS: [u32; 2] = [6, 4];
const RAYS: [u32; 2] = [16, 12];
/// Views that are compared by many rays.
const COMPARED_VIEWS: usize = 3000;
/// Half of the box of the positions, in halves of the box of the splats.
const REACH: f64 = 1.8;
/// Free distance around a camera, in sides of the box.
const CLEARANCE: f64 = 0.05;
/// Views near a good one that are tried in its place.
const NEIGHBOURS: usize = 24;
/// Views that are rendered per wanted view.
const RENDERED: usize = 2;
/// Least share of the gain of the first view: later views show little that is new.
const LEAST_GAIN: f64 = 0.05;
/// Standard deviation of a sharp splat in the picture, pixels, at most: trainers leave splats of a
/// pixel to a few where photos look, and large ones where none does. On views of `breakfast` that
/// were trained, 2 to 3 % of the weight is above; on others 8 to 60 %.
const SHARP: f64 = 8.0;
/// Least alpha of a pixel that shows a surface.
const OPAQUE: f32 = 0.9;
/// Depth, in medians of the view, below which splats hang before the camera, and the most pixels of
/// them.
const CLOSE: (f32, f64) = (0.15, 0.03);
/// Least standard deviation of the luma of a view: plain surfaces show no things.
const LEAST_CONTRAST: f64 = 0.02;
/// Least quality of a rendered view, as a share of the best one.
const LEAST_QUALITY: f64 = 0.5;
/// Splats whose weights compare views.
const COMPARED: usize = 100_000;

/// A view before it is rendered.
#[derive(Clone)]
struct View {
    camera: Camera,
    /// Cells that its rays hit sharply, with the number of rays times the quality.
    hits: Shown,
    /// Share of its rays that hit sharp splats.
    quality: f64,
}

/// At most `wanted` cameras that together show the splats, most informative first. `up` is the
/// direction against gravity, a unit vector.
///
/// # Errors
/// No camera sees an opaque surface.
pub(super) fn cameras(
    renderer: &mut Renderer,
    splats: &Splats,
    up: DVec3,
    wanted: usize,
    progress: &dyn Progress,
) -> Result<Vec<Camera>> {
    let blind = || {
        Error::input(
            "no view from outside shows an opaque surface: the splats are too few or too transparent; give photos with \
             --images DIR --cameras FILE, or cameras alone with --cameras FILE",
        )
    };
    let space = Space::new(splats).ok_or_else(blind)?;
    let views = promising(&space, up, RENDERED * wanted);
    progress.begin("views", views.len() as u64);
    let (mut rendered, mut weights, mut refused) = (Vec::new(), Vec::new(), None);
    for (done, View { camera, .. }) in views.into_iter().enumerate() {
        progress.check()?;
        let small = camera.resized(TRIED_SIDE, TRIED_SIDE * camera.height / camera.width);
        // A view from far away has more splats per tile than some devices take.
        let frame = match renderer.render(&small) {
            Err(error @ Error::Gpu { source: None, .. }) => {
                refused = Some(error);
                RenderedFrame::default()
            }
            frame => frame?,
        };
        if shows_things(&frame) {
            let mut sharp = renderer.weights(&small)?;
            let share = keep_sharp(&mut sharp, splats, &camera);
            let opaque = frame.alpha.data.iter().filter(|a| **a >= OPAQUE).count();
            let quality = share * opaque as f64 / frame.alpha.data.len().max(1) as f64;
            weights.push(compared(sharp, quality));
            rendered.push((camera, quality));
        }
        progress.step(done as u64 + 1, "");
    }
    progress.end();
    let best = rendered.iter().map(|v| v.1).fold(0.0, f64::max);
    let is_good = |v: &usize| rendered[*v].1 >= LEAST_QUALITY * best;
    let kept: Vec<usize> = (0..rendered.len()).filter(is_good).collect();
    let of_kept: Vec<Shown> = kept.iter().map(|v| std::mem::take(&mut weights[*v])).collect();
    let chosen = most_covering(&of_kept, wanted, LEAST_GAIN);
    if chosen.is_empty() {
        return Err(refused.unwrap_or_else(blind));
    }
    let named = |(number, chosen): (usize, &usize)| Camera {
        name: format!("view_{:02}.png", number + 1),
        ..rendered[kept[*chosen]].0.clone()
    };
    Ok(chosen.iter().enumerate().map(named).collect())
}

/// Clears the weights of splats that are large in the picture; returns the share of the others.
fn keep_sharp(weights: &mut [f32], splats: &Splats, camera: &Camera) -> f64 {
    let sigma = |i: usize| {
        let mut scales = splats.log_scales[i].map(|s| f64::from(s).exp());
        scales.sort_by(f64::total_cmp);
        let z = camera.pose.transform(Vec3::from(splats.means[i]).as_dvec3()).z;
        (scales[1] * scales[2]).sqrt() * camera.fx / z.max(f64::MIN_POSITIVE)
    };
    let (mut sharp, mut all) = (0.0, 0.0);
    for (i, weight) in weights.iter_mut().enumerate().filter(|(_, w)| **w > 0.0) {
        all += f64::from(*weight);
        if sigma(i) <= SHARP {
            sharp += f64::from(*weight);
        } else {
            *weight = 0.0;
        }
    }
    if all > 0.0 { sharp / all } else { 0.0 }
}

/// Weights of evenly spread splats, at most [`COMPARED`], times a factor.
pub(super) fn compared(weights: Vec<f32>, factor: f64) -> Shown {
    let stride = weights.len().div_ceil(COMPARED).max(1);
    shown(weights.into_iter().step_by(stride).map(|w| w * factor as f32))
}

/// Views by rays: those that together hit most cells sharply, each moved to the best place nearby.
fn promising(space: &Space, up: DVec3, wanted: usize) -> Vec<View> {
    let mut all = tried(space, up);
    all.sort_by(|a, b| b.quality.total_cmp(&a.quality));
    all.truncate(COMPARED_VIEWS);
    let full: Vec<View> = all.par_iter().filter_map(|v| seen(space, &v.camera, RAYS)).collect();
    let hits: Vec<Shown> = full.iter().map(|view| view.hits.clone()).collect();
    let order = most_covering(&hits, wanted, 0.0);
    order.into_par_iter().map(|v| improved(space, &full[v], up, v as u64)).collect()
}

/// The best of the views near one that still hit as many cells.
fn improved(space: &Space, view: &View, up: DVec3, seed: u64) -> View {
    let mut random = Random::new(seed);
    let mut best = view.clone();
    for _ in 0..NEIGHBOURS {
        let mut draw = |most: f64| most * (2.0 * random.uniform() - 1.0);
        let side = space.side();
        let step = DVec3::new(draw(0.1), draw(0.1), draw(0.1)) * side;
        let turn = DQuat::from_axis_angle(up, draw(0.3));
        let forward = best.camera.pose.rotation.row(2);
        let lift = draw(0.2);
        let forward = (turn * forward + up * lift).normalize();
        let position = best.camera.pose.centre() + step;
        if !space.is_free(position, CLEARANCE * side) {
            continue;
        }
        let moved = seen(space, &looking(position, forward, up), RAYS);
        if let Some(moved) = moved
            && moved.quality > best.quality
            && 5 * moved.hits.len() >= 4 * view.hits.len()
        {
            best = moved;
        }
    }
    best
}

/// Views from free positions whose rays hit something.
fn tried(space: &Space, up: DVec3) -> Vec<View> {
    let (low, high) = space.bounds();
    let (middle, half) = (0.5 * (low + high), 0.5 * (high - low));
    let side = space.side();
    let mut random = Random::new(7);
    let mut draw = || 2.0 * random.uniform() - 1.0;
    let positions: Vec<DVec3> = (0..POSITIONS)
        .map(|_| middle + DVec3::new(draw(), draw(), draw()) * half.max(DVec3::splat(0.25 * side)) * REACH)
        .collect();
    let level = up.any_orthonormal_vector();
    positions
        .into_par_iter()
        .filter(|p| space.is_free(*p, CLEARANCE * side))
        .flat_map_iter(|position| {
            ELEVATIONS.into_iter().flat_map(move |elevation| {
                (0..AZIMUTHS).map(move |k| {
                    let turn = DQuat::from_axis_angle(up, std::f64::consts::TAU * k as f64 / AZIMUTHS as f64);
                    let (sin, cos) = f64::to_radians(elevation).sin_cos();
                    looking(position, turn * level * cos + up * sin, up)
                })
            })
        })
        .filter_map(|camera| seen(space, &camera, FEW_RAYS))
        .collect()
}

/// A camera of [`SIDE`] pixels at a position that looks along a unit vector.
fn looking(position: DVec3, forward: DVec3, up: DVec3) -> Camera {
    let right = forward.cross(up).normalize_or(forward.any_orthonormal_vector());
    let down = forward.cross(right);
    let rotation = DMat3::from_cols(right, down, forward).transpose();
    let (width, height) = (SIDE, SIDE * 3 / 4);
    let f = 0.5 * f64::from(width) / (0.5 * FIELD).to_radians().tan();
    Camera {
        name: String::new(),
        width,
        height,
        fx: f,
        fy: f,
        cx: 0.5 * f64::from(width),
        cy: 0.5 * f64::from(height),
        pose: Pose { rotation, translation: -(rotation * position) },
    }
}

/// The view with the cells that its rays hit sharply; `None` where no ray does.
fn seen(space: &Space, camera: &Camera, [columns, rows]: [u32; 2]) -> Option<View> {
    let (centre, turn) = (camera.pose.centre(), camera.pose.rotation.transpose());
    let ray = |k: u32| {
        let at = DVec2::new(f64::from(k % columns) + 0.5, f64::from(k / columns) + 0.5);
        let pixel = at / DVec2::new(f64::from(columns), f64::from(rows))
            * DVec2::new(f64::from(camera.width), f64::from(camera.height));
        (turn * camera.ray(pixel)).normalize()
    };
    let hit = |k: u32| space.cast(centre, ray(k)).filter(|hit| space.sigma(hit) * camera.fx <= SHARP);
    let mut cells: Vec<u32> = (0..columns * rows).filter_map(hit).map(|hit| hit.cell).collect();
    if cells.is_empty() {
        return None;
    }
    let quality = cells.len() as f64 / f64::from(columns * rows);
    let mut hits = Shown::new();
    cells.sort_unstable();
    for cell in cells {
        match hits.last_mut().filter(|last| last.0 == cell) {
            Some(last) => last.1 += quality as f32,
            None => hits.push((cell, quality as f32)),
        }
    }
    Some(View { camera: camera.clone(), hits, quality })
}

/// Whether a view has contrast and nothing right before the camera.
fn shows_things(frame: &RenderedFrame) -> bool {
    let pixels = frame.alpha.data.len().max(1) as f64;
    let mut depths: Vec<f32> = frame.depth.data.iter().copied().filter(|z| *z > 0.0).collect();
    depths.sort_by(f32::total_cmp);
    let median = depths.get(depths.len() / 2).copied().unwrap_or(0.0);
    let close = depths.iter().filter(|z| **z < CLOSE.0 * median).count();
    let opaque = frame.rgb.data.iter().zip(&frame.alpha.data).filter(|(_, a)| **a >= OPAQUE);
    let luma = opaque.map(|(c, _)| f64::from(0.299 * c[0] + 0.587 * c[1] + 0.114 * c[2]));
    let (sum, squares, count) = luma.fold((0.0, 0.0, 0.0), |(s, q, n), l| (s + l, q + l * l, n + 1.0));
    let count = f64::max(count, 1.0);
    let contrast = (squares / count - (sum / count).powi(2)).max(0.0).sqrt();
    close as f64 <= CLOSE.1 * pixels && contrast >= LEAST_CONTRAST
}

/// Largest angle between the direction up and −y of the file's axes, degrees.
const MOST_TILT: f64 = 45.0;
/// Splats whose normals are counted.
const COUNTED: usize = 50_000;
/// Angle between normals of one surface, degrees.
const SAME_NORMAL: f64 = 8.0;

/// Direction against gravity of splats in right, down, forward axes, as most files have them: the
/// most common normal of flat splats near −y, or −y itself. A guess that only orients views.
pub(super) fn likely_up(splats: &Splats) -> DVec3 {
    let stride = splats.len().div_ceil(COUNTED).max(1);
    let normals: Vec<(DVec3, f64)> =
        (0..splats.len()).step_by(stride).filter_map(|i| upward_normal(splats, i)).collect();
    let near = SAME_NORMAL.to_radians().cos();
    let support = |n: DVec3| -> f64 {
        normals.iter().filter(|(other, _)| other.dot(n) > near).map(|(_, weight)| weight).sum()
    };
    let tried: Vec<DVec3> = normals.iter().step_by(normals.len().div_ceil(400).max(1)).map(|n| n.0).collect();
    let best = tried.into_par_iter().map(|n| (support(n), n)).max_by(|a, b| a.0.total_cmp(&b.0));
    let Some((_, direction)) = best else { return DVec3::NEG_Y };
    let agreeing = normals.iter().filter(|(n, _)| n.dot(direction) > near);
    agreeing.map(|(n, weight)| *n * *weight).sum::<DVec3>().normalize_or(DVec3::NEG_Y)
}

/// Normal of a flat, opaque splat with the sign nearer to −y, and its area; `None` for others.
fn upward_normal(splats: &Splats, i: usize) -> Option<(DVec3, f64)> {
    let scales = Vec3::from(splats.log_scales[i]).exp().as_dvec3();
    let thin = (0..3).min_by(|a, b| scales[*a].total_cmp(&scales[*b]))?;
    let others = scales[(thin + 1) % 3] * scales[(thin + 2) % 3];
    let is_flat = scales[thin].powi(2) < 0.1 * others && splats.opacity_logits[i] > 0.0;
    let [w, x, y, z] = splats.quats[i].map(f64::from);
    let normal = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize()).col(thin);
    let normal = if normal.y > 0.0 { -normal } else { normal };
    (is_flat && -normal.y > MOST_TILT.to_radians().cos()).then_some((normal, others))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn camera_looks_level() {
        let up = DVec3::new(0.1, -0.9, 0.2).normalize();
        let forward = up.any_orthonormal_vector();
        let camera = looking(DVec3::new(1.0, 2.0, 3.0), forward, up);
        assert!((camera.pose.centre() - DVec3::new(1.0, 2.0, 3.0)).length() < 1e-12);
        assert!((camera.pose.rotation * up - DVec3::NEG_Y).length() < 1e-12, "up is up in the picture");
        assert!((camera.pose.rotation * forward - DVec3::Z).length() < 1e-12);
        assert!((camera.pose.rotation.determinant() - 1.0).abs() < 1e-12);
    }

    #[test]
    fn up_follows_a_tilted_floor() {
        let tilt = DQuat::from_axis_angle(DVec3::Z, 0.3);
        let mut splats = Splats::default();
        for i in 0..400 {
            // Two thirds lie on the floor, the others on a wall.
            let turn = if i % 3 == 0 { DQuat::from_rotation_x(1.5) } else { DQuat::IDENTITY };
            let [x, y, z, w] = (tilt * turn).to_array().map(|v| v as f32);
            splats.means.push([0.0; 3]);
            splats.quats.push([w, x, y, z]);
            splats.log_scales.push([-3.0, -6.0, -3.0]);
            splats.opacity_logits.push(2.0);
        }
        assert!(likely_up(&splats).angle_between(tilt * DVec3::NEG_Y).to_degrees() < 1.0);
        assert_eq!(likely_up(&Splats::default()), DVec3::NEG_Y);
    }

    /// A wall whose left half has fine splats, and whose right half has coarse ones. Both block the
    /// light: of fine ones, twelve lie at each place.
    fn half_sharp() -> Splats {
        let mut splats = Splats::default();
        for (x, y) in (-40..40).flat_map(|x| (-30..30).map(move |y| (x, y))) {
            let (sigma, copies) = if x < 0 { (0.006f32, 12) } else { (0.2, 1) };
            for _ in 0..copies {
                splats.means.push([0.025 * x as f32, 0.025 * y as f32, 0.0]);
                splats.log_scales.push([sigma.ln(), sigma.ln(), -9.0]);
                splats.quats.push([1.0, 0.0, 0.0, 0.0]);
                splats.opacity_logits.push(9.0);
            }
        }
        splats
    }

    #[test]
    fn views_look_at_sharp_splats() {
        let splats = half_sharp();
        let space = Space::new(&splats).unwrap();
        let views = promising(&space, DVec3::NEG_Y, 6);
        assert!(!views.is_empty());
        for view in &views {
            // The middle of the picture is in the left half.
            let (centre, forward) = (view.camera.pose.centre(), view.camera.pose.rotation.row(2));
            let hit = centre - forward * (centre.z / forward.z);
            assert!(hit.x < 0.1 && forward.z * centre.z < 0.0, "{} at {hit}", view.quality);
        }
    }
}
