//! Surfaces continued beyond the photo borders.
//!
//! Between a few views, a camera soon sees past what any photo shows, and finds black there. Planes have an inverse depth
//! that is affine in the pixel position, so floors, tables and walls continue exactly: around every photo, coarse flat
//! splats extend the plane nearest to the border in its mean colour. No training view sees them, so they change no loss.
use super::init::SH_C0;
use super::schedule::Random;
use crate::scene::{Camera, DepthMap, RgbImage, Splats};
use glam::{DMat3, DQuat, DVec2, DVec3};
use std::collections::HashSet;

/// Grid of the margin in units of the longer image side: only the mean colour is known, so finer splats tell no more.
const STEP: f64 = 0.01;
/// Half-width of the first window that a plane is fitted in, same unit; doubled up to twice where depth is missing.
const WINDOW: f64 = 0.06;
/// Relative inverse-depth difference that still counts as the same plane: above stereo noise, below object sizes.
const INLIER: f64 = 0.01;
/// Standard deviation in units of the grid: neighbours at 0.7 blend without gaps.
const OVERLAP: f64 = 0.7;
/// Opacity logit of margin splats: about 0.98.
const LOGIT: f32 = 4.0;

/// A plane seen at a border position: inverse depth `w + slope·(pixel − at)`.
struct Anchor {
    at: DVec2,
    w: f64,
    slope: DVec2,
    colour: [f32; 3],
}

/// One splat to be.
struct Candidate {
    view: usize,
    distance: f64,
    position: DVec3,
    /// World steps of one grid cell along x and y.
    steps: [DVec3; 2],
    colour: [f32; 3],
}

/// Flat splats around all photos up to `reach` times the longer side; depth counts from `min_confidence` on.
pub fn margin_splats(
    images: &[RgbImage],
    cameras: &[Camera],
    depths: &[DepthMap],
    reach: f64,
    min_confidence: f32,
    seed: u64,
) -> Splats {
    let mut random = Random::new(seed ^ 0x3a61);
    let mut all = Vec::new();
    for view in 0..images.len().min(depths.len()) {
        candidates(
            view,
            &images[view],
            &cameras[view],
            &depths[view],
            reach,
            min_confidence,
            &mut random,
            &mut all,
        );
    }
    all.retain(|c| !(0..depths.len()).any(|v| v != c.view && in_the_way(c, &cameras[v], &depths[v])));
    // Where several photos continue one surface, the nearest border knows best.
    all.sort_by(|a, b| a.distance.total_cmp(&b.distance));
    let mut taken = HashSet::new();
    let mut splats = Splats::default();
    for c in &all {
        let size = c.steps[0].length().min(c.steps[1].length()).max(1e-12);
        let octave = size.log2().round();
        let cell = (c.position / (octave.exp2() * 1.5)).floor().as_i64vec3();
        if taken.insert((octave as i64, cell)) {
            push(&mut splats, c);
        }
    }
    splats
}

/// True where a candidate would stand before, or on, what another photo shows (or should show).
fn in_the_way(c: &Candidate, camera: &Camera, depth: &DepthMap) -> bool {
    let (pixel, z) = camera.project(c.position);
    let (w, h) = (f64::from(camera.width), f64::from(camera.height));
    if z <= 0.0 || pixel.x < 0.0 || pixel.y < 0.0 || pixel.x >= w || pixel.y >= h {
        return false;
    }
    let known = f64::from(depth.depth.at(pixel.x as usize, pixel.y as usize));
    known <= 0.0 || z < 1.05 * known
}

fn candidates(
    view: usize,
    image: &RgbImage,
    camera: &Camera,
    depth: &DepthMap,
    reach: f64,
    min_confidence: f32,
    random: &mut Random,
    out: &mut Vec<Candidate>,
) {
    let (w, h) = (image.width as f64, image.height as f64);
    let step = STEP * w.max(h);
    let anchors = anchors(image, depth, step, min_confidence, random);
    let rings = (reach * w.max(h) / step).ceil() as i64;
    let (columns, rows) = ((w / step).ceil() as i64, (h / step).ceil() as i64);
    for row in -rings..rows + rings {
        for column in -rings..columns + rings {
            let pixel = DVec2::new(column as f64 + 0.5, row as f64 + 0.5) * step;
            let border = pixel.clamp(DVec2::ZERO, DVec2::new(w, h));
            let distance = pixel.distance(border);
            if distance <= 0.0 || distance > reach * w.max(h) {
                continue;
            }
            let near = |a: &&Anchor| a.at.distance_squared(border);
            let Some(anchor) = anchors.iter().min_by(|a, b| near(a).total_cmp(&near(b))) else { return };
            out.extend(candidate(view, camera, anchor, pixel, distance, step));
        }
    }
}

/// The splat that continues an anchor's plane at a pixel outside the photo; `None` near or past the horizon.
fn candidate(
    view: usize,
    camera: &Camera,
    anchor: &Anchor,
    pixel: DVec2,
    distance: f64,
    step: f64,
) -> Option<Candidate> {
    let inverse = |p: DVec2| anchor.w + anchor.slope.dot(p - anchor.at);
    // Beyond three times the border's distance, or nearer than half of it, a plane is a guess too far.
    let value = inverse(pixel);
    if value < anchor.w / 3.0 || value > anchor.w * 2.0 {
        return None;
    }
    let world = |p: DVec2| camera.unproject(p, 1.0 / inverse(p).max(anchor.w / 4.0));
    let position = world(pixel);
    let steps = [DVec2::X, DVec2::Y].map(|e| world(pixel + 0.5 * step * e) - world(pixel - 0.5 * step * e));
    Some(Candidate { view, distance, position, steps, colour: anchor.colour })
}

/// Planes along the border, one per grid step, where depth allows.
fn anchors(
    image: &RgbImage,
    depth: &DepthMap,
    step: f64,
    min_confidence: f32,
    random: &mut Random,
) -> Vec<Anchor> {
    let (w, h) = (image.width as f64, image.height as f64);
    let along = |length: f64| (0..=(length / step).ceil() as i64).map(move |i| (i as f64 * step).min(length));
    let horizontal = along(w).flat_map(|x| [DVec2::new(x, 0.0), DVec2::new(x, h)]);
    let vertical = along(h).flat_map(|y| [DVec2::new(0.0, y), DVec2::new(w, y)]);
    let positions: Vec<DVec2> = horizontal.chain(vertical).collect();
    positions.into_iter().filter_map(|at| anchor(image, depth, at, min_confidence, random)).collect()
}

fn anchor(
    image: &RgbImage,
    depth: &DepthMap,
    at: DVec2,
    min_confidence: f32,
    random: &mut Random,
) -> Option<Anchor> {
    let half = WINDOW * image.width.max(image.height) as f64;
    // 30 samples of a stride-3 grid: a tenth of the window at a straight border.
    let samples = [1.0, 2.0, 4.0]
        .into_iter()
        .map(|grow| samples(image, depth, at, half * grow, min_confidence))
        .find(|s| s.len() >= 30)?;
    let (w, slope) = fit_plane(&samples, random)?;
    let mut colour = [0.0f64; 3];
    let mut total = 0.0;
    for s in &samples {
        if ((w + slope.dot(s.offset)) / s.inverse - 1.0).abs() < 2.0 * INLIER {
            (0..3).for_each(|c| colour[c] += s.weight * f64::from(s.colour[c]));
            total += s.weight;
        }
    }
    (total > 0.0).then(|| Anchor { at, w, slope, colour: colour.map(|c| (c / total) as f32) })
}

struct Sample {
    offset: DVec2,
    inverse: f64,
    weight: f64,
    colour: [f32; 3],
}

/// Confident pixels in a window around `at`, weighted towards it.
fn samples(image: &RgbImage, depth: &DepthMap, at: DVec2, half: f64, min_confidence: f32) -> Vec<Sample> {
    let range = |centre: f64, length: usize| {
        ((centre - half).max(0.0) as usize, ((centre + half).max(0.0) as usize).min(length))
    };
    let ((x0, x1), (y0, y1)) = (range(at.x, image.width), range(at.y, image.height));
    // At most about 400 samples however large the photo.
    let stride = (half / 10.0).ceil().max(1.0) as usize;
    let mut out = Vec::new();
    for y in (y0..y1).step_by(stride) {
        for x in (x0..x1).step_by(stride) {
            let z = depth.depth.at(x, y);
            if z > 0.0 && z.is_finite() && depth.confidence.at(x, y) >= min_confidence {
                let offset = DVec2::new(x as f64 + 0.5, y as f64 + 0.5) - at;
                let weight = (-2.0 * offset.length_squared() / (half * half)).exp();
                out.push(Sample { offset, inverse: 1.0 / f64::from(z), weight, colour: image.at(x, y) });
            }
        }
    }
    out
}

/// The plane with the most weight near the border: the best of 60 triples (99 % sure to hit a plane with half of the
/// samples, with a margin for noise), then least squares over its inliers.
fn fit_plane(samples: &[Sample], random: &mut Random) -> Option<(f64, DVec2)> {
    let agrees =
        |s: &Sample, p: DVec3| ((p.x + p.y * s.offset.x + p.z * s.offset.y) / s.inverse - 1.0).abs() < INLIER;
    let row = |s: &Sample| DVec3::new(1.0, s.offset.x, s.offset.y);
    let mut best = (0.0, None);
    for _ in 0..60 {
        let pick = [0; 3].map(|_| &samples[random.below(samples.len())]);
        let matrix = DMat3::from_cols(row(pick[0]), row(pick[1]), row(pick[2])).transpose();
        if matrix.determinant().abs() < 1e-6 {
            continue;
        }
        let plane = matrix.inverse() * DVec3::new(pick[0].inverse, pick[1].inverse, pick[2].inverse);
        let score: f64 = samples.iter().filter(|s| agrees(s, plane)).map(|s| s.weight).sum();
        if score > best.0 {
            best = (score, Some(plane));
        }
    }
    let plane = best.1?;
    let (mut normal, mut right) = (DMat3::ZERO, DVec3::ZERO);
    for s in samples.iter().filter(|s| agrees(s, plane)) {
        let r = row(s);
        normal += DMat3::from_cols(r * r.x, r * r.y, r * r.z) * s.weight;
        right += r * (s.weight * s.inverse);
    }
    let refined = if normal.determinant() > 1e-9 { normal.inverse() * right } else { plane };
    (refined.x > 0.0 && refined.is_finite()).then(|| (refined.x, DVec2::new(refined.y, refined.z)))
}

/// A flat splat that spans one grid cell of the plane.
fn push(splats: &mut Splats, c: &Candidate) {
    let (long, short) = if c.steps[0].length() >= c.steps[1].length() {
        (c.steps[0], c.steps[1])
    } else {
        (c.steps[1], c.steps[0])
    };
    let x = long.normalize_or(DVec3::X);
    let normal = x.cross(short).normalize_or(x.any_orthonormal_vector());
    let y = normal.cross(x);
    let q = DQuat::from_mat3(&DMat3::from_cols(x, y, normal));
    let (sx, sy) = (OVERLAP * long.length(), OVERLAP * short.dot(y).abs());
    // A tenth of the short side keeps the splat visible from a grazing camera and below the needle limit of 8 ... 10.
    let sizes = [sx, sy.max(sx / 8.0), (0.1 * sy).max(sx / 8.0)];
    splats.means.push(c.position.as_vec3().into());
    splats.log_scales.push(sizes.map(|s| s.max(1e-12).ln() as f32));
    splats.quats.push([q.w as f32, q.x as f32, q.y as f32, q.z as f32]);
    splats.opacity_logits.push(LOGIT);
    splats.sh.extend(c.colour.map(|v| (v - 0.5) / SH_C0));
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{Plane, Pose};

    fn camera() -> Camera {
        Camera {
            name: "a".into(),
            width: 160,
            height: 120,
            fx: 140.0,
            fy: 140.0,
            cx: 80.0,
            cy: 60.0,
            pose: Pose::exp(DVec3::new(0.1, -0.2, 0.3), DVec3::new(0.2, 0.1, -0.1)),
        }
    }

    /// Depth of the world plane n·p = offset, with a small nearer object in the middle of the lower border.
    fn scene(n: DVec3, offset: f64) -> (RgbImage, DepthMap) {
        let camera = camera();
        let centre = camera.pose.centre();
        let mut image = RgbImage { width: 160, height: 120, data: Vec::new() };
        let mut depth = Plane::filled(160, 120, 0.0f32);
        for i in 0..160 * 120 {
            let pixel = DVec2::new((i % 160) as f64 + 0.5, (i / 160) as f64 + 0.5);
            let ray = camera.pose.inverse().rotation * camera.ray(pixel);
            let object = pixel.distance(DVec2::new(80.0, 118.0)) < 5.0;
            let z = (offset - n.dot(centre)) / n.dot(ray);
            depth.data[i] = (if object { 0.7 * z } else { z }) as f32;
            image.data.push(if object { [1.0, 0.0, 0.0] } else { [0.2, 0.5, 0.7] });
        }
        let confidence = Plane::filled(160, 120, 1.0);
        (image, DepthMap { depth, confidence })
    }

    #[test]
    fn a_plane_continues_as_itself() {
        let n = DVec3::new(0.1, -0.3, 1.0).normalize();
        let (image, depth) = scene(n, 3.0);
        let splats = margin_splats(&[image], &[camera()], &[depth], 0.2, 0.5, 0);
        // 32 px around 160 × 120 on a grid of 1.6 px is about 7000 cells (rounded corners).
        assert!(splats.len() > 2500, "{}", splats.len());
        let mut off = 0;
        for i in 0..splats.len() {
            let p = DVec3::from(splats.means[i].map(f64::from));
            let (pixel, _) = camera().project(p);
            let inside = pixel.x > 0.0 && pixel.y > 0.0 && pixel.x < 160.0 && pixel.y < 120.0;
            assert!(!inside, "no margin inside the photo");
            off +=
                usize::from((n.dot(p) - 3.0).abs() > 0.01 || (splats.sh[3 * i] * SH_C0 + 0.3).abs() > 0.02);
            let [w, x, y, z] = splats.quats[i].map(f64::from);
            let normal = DQuat::from_xyzw(x, y, z, w) * DVec3::Z;
            off += usize::from(normal.dot(n).abs() < 0.99);
        }
        // The object may continue itself at its own 10 of the 560 border pixels, 1.8 %.
        assert!(off <= splats.len() / 50, "{off} of {} leave the plane or its colour", splats.len());
    }

    #[test]
    fn nothing_stands_in_front_of_another_photo() {
        let n = DVec3::Z;
        let (image, depth) = scene(n, 3.0);
        let mut beside = camera();
        // Turned by 17°: it sees part of the margin of the first.
        beside.pose = Pose::exp(DVec3::ZERO, DVec3::new(0.0, 0.3, 0.0)).compose(&beside.pose);
        let images = [image.clone(), image];
        let splats =
            margin_splats(&images, &[camera(), beside.clone()], &[depth.clone(), depth.clone()], 0.2, 0.5, 0);
        assert!(splats.len() > 1000);
        for p in &splats.means {
            let c = Candidate {
                view: 9,
                distance: 0.0,
                position: DVec3::from(p.map(f64::from)),
                steps: [DVec3::X; 2],
                colour: [0.0; 3],
            };
            // A splat belongs to one view and must not disturb the other; its own photo it cannot reach.
            assert!(!in_the_way(&c, &beside, &depth) && !in_the_way(&c, &camera(), &depth));
        }
    }
}
