//! Consistency of the matched pixels between views, and local plane fits to the consistent ones.
use super::Level;
use super::views::{DEPTH_TOLERANCE, REPROJECTION_TOLERANCE};
use crate::scene::Image;
use glam::{DMat3, DVec2, DVec3, Vec3, Vec4};
use rayon::prelude::*;

/// Matched planes of all views with the confidence of each pixel, at one resolution.
#[derive(Clone, Debug)]
pub struct Surface {
    /// `π` per pixel (`1/z = π·ray`), all views one after the other.
    pub planes: Vec<Vec3>,
    /// Confidence per pixel; 0 = rejected.
    pub confidence: Vec<f32>,
}

/// Views with a larger relative depth tolerance confirm nothing: [`REPROJECTION_TOLERANCE`] is a
/// large depth difference at small parallax …
const MAX_CONFIRMING_TOLERANCE: f32 = 0.06;
/// … unless it is below this multiple of the view's typical tolerance.
const TYPICAL_TOLERANCE_FACTOR: f32 = 1.5;
/// A point nearer than another view's surface by this share would occlude it: it cannot exist.
pub const FREE_SPACE_TOLERANCE: f32 = 0.03;

/// [`FREE_SPACE_TOLERANCE`], larger for views of less accurate depth.
pub fn free_space_tolerance(level: &Level, view: usize) -> f32 {
    FREE_SPACE_TOLERANCE.max(2.0 * level.tolerance[view])
}

/// Aggregated cost above which a pixel is rejected: half way between a perfect match in one view
/// (0.4 + geometric limits) and none (1.0 and more).
const COST_TOLERANCE: f32 = 0.75;
/// Connected areas of consistent pixels below this share of the image are matched by chance.
const SPECKLE_SHARE: f32 = 6e-4;
/// Confidence by number of agreeing views.
const CONFIDENCE: [f32; 3] = [0.0, 0.6, 0.9];
/// Confidence of a pixel that only its surroundings confirm: it shapes the surface but is no
/// measurement.
const PLAUSIBLE: f32 = 0.45;
/// Aggregated cost above which such a pixel is rejected: hardly any correlation in any view.
const PLAUSIBLE_COST: f32 = 0.95;
/// Share of the surroundings that must lie on a plausible pixel's plane; chance matches scatter.
const SUPPORT: f32 = 0.6;
/// Radius of the surroundings in taps: 9 × 9 of every second pixel.
const SUPPORT_TAPS: i32 = 4;

/// Visibility of a point in another view.
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub enum Visibility {
    /// Outside the image, or without depth there.
    Outside,
    /// The other view has the same surface.
    Agrees,
    /// The other view has a nearer surface.
    Occluded,
    /// The other view has a farther surface: the point lies in its free space.
    FreeSpace,
}

/// Relative poses between the cameras of a level, in f32.
pub struct RelativePoses {
    /// `to[a * views + b]`: rotation and translation of frame a → frame b.
    to: Vec<(glam::Mat3, Vec3)>,
    views: usize,
}

impl RelativePoses {
    /// Computes the poses of all pairs.
    pub fn new(level: &Level) -> RelativePoses {
        let views = level.cameras.len();
        let mut to = Vec::with_capacity(views * views);
        for a in &level.cameras {
            for b in &level.cameras {
                let relative = b.pose.compose(&a.pose.inverse());
                let r: DMat3 = relative.rotation;
                to.push((r.as_mat3(), relative.translation.as_vec3()));
            }
        }
        RelativePoses { to, views }
    }

    /// Pixel and depth in view `b` of a point of frame `a`, if it projects into the image.
    pub fn project(&self, level: &Level, a: usize, b: usize, point: Vec3) -> Option<(f32, f32, f32)> {
        let (r, t) = self.to[a * self.views + b];
        let p = r * point + t;
        let [fx, fy, cx, cy] = level.references[b].intrinsics;
        let (u, v) = (fx * p.x / p.z + cx, fy * p.y / p.z + cy);
        let inside = p.z > 0.0
            && u >= 0.0
            && v >= 0.0
            && u < level.references[b].width as f32
            && v < level.references[b].height as f32;
        inside.then_some((u, v, p.z))
    }

    /// Plane `π·X = 1` of frame `a` in frame `b`; undefined if it contains the centre of `b`.
    pub fn plane(&self, a: usize, b: usize, plane: Vec3) -> Vec3 {
        let (r, t) = self.to[b * self.views + a];
        (r.transpose() * plane) / (1.0 - plane.dot(t))
    }

    /// Relative depth difference from which view `b` contradicts a point of frame `a`: a shift of
    /// its image by [`REPROJECTION_TOLERANCE`], at least [`DEPTH_TOLERANCE`].
    fn tolerance(&self, level: &Level, a: usize, b: usize, point: Vec3) -> f32 {
        let (r, t) = self.to[a * self.views + b];
        let along = r * point;
        let p = along + t;
        let [fx, fy, ..] = level.references[b].intrinsics;
        // d(u, v) / d ln z along the ray of `a`.
        let du = fx * (along.x * p.z - p.x * along.z) / (p.z * p.z);
        let dv = fy * (along.y * p.z - p.y * along.z) / (p.z * p.z);
        (REPROJECTION_TOLERANCE / du.hypot(dv).max(1e-6)).max(DEPTH_TOLERANCE)
    }

    /// Visibility in view `b` of a point of frame `a`, whose image in `a` is `pixel`.
    pub fn visibility(
        &self,
        level: &Level,
        surface: &Surface,
        a: usize,
        b: usize,
        pixel: [f32; 2],
        point: Vec3,
    ) -> Visibility {
        let Some((u, v, z)) = self.project(level, a, b, point) else { return Visibility::Outside };
        let r = &level.references[b];
        let index = r.first as usize + v as usize * r.width as usize + u as usize;
        if surface.confidence[index] <= 0.0 {
            return Visibility::Outside;
        }
        let [fx, fy, cx, cy] = r.intrinsics;
        let ray = Vec3::new((u - cx) / fx, (v - cy) / fy, 1.0);
        let surface_depth = 1.0 / surface.planes[index].dot(ray).max(1e-9);
        let tolerance = self.tolerance(level, a, b, point);
        let free = FREE_SPACE_TOLERANCE.max(2.0 * tolerance);
        if z < surface_depth * (1.0 - free) {
            return Visibility::FreeSpace;
        }
        if z > surface_depth * (1.0 + free) {
            return Visibility::Occluded;
        }
        let agrees = tolerance < MAX_CONFIRMING_TOLERANCE.max(TYPICAL_TOLERANCE_FACTOR * level.tolerance[a])
            && (z - surface_depth).abs() < tolerance * surface_depth
            && self.project(level, b, a, ray * surface_depth).is_some_and(|(x, y, _)| {
                let (dx, dy) = (x - pixel[0], y - pixel[1]);
                dx * dx + dy * dy < REPROJECTION_TOLERANCE * REPROJECTION_TOLERANCE
            });
        if agrees { Visibility::Agrees } else { Visibility::Outside }
    }
}

/// Ray through a pixel's centre in the camera's frame, z = 1.
pub fn ray(level: &Level, view: usize, x: usize, y: usize) -> Vec3 {
    let [fx, fy, cx, cy] = level.references[view].intrinsics;
    Vec3::new((x as f32 + 0.5 - cx) / fx, (y as f32 + 0.5 - cy) / fy, 1.0)
}

/// The x of [`ray`] per column of a view and its y per row.
fn rays(level: &Level, view: usize) -> (Vec<f32>, Vec<f32>) {
    let r = &level.references[view];
    let x = |column| ray(level, view, column, 0).x;
    let y = |row| ray(level, view, 0, row).y;
    ((0..r.width as usize).map(x).collect(), (0..r.height as usize).map(y).collect())
}

/// Results of `f(view, x, y, index)` in parallel for all pixels of all views, in buffer order.
pub fn map_pixels<T: Send>(level: &Level, f: impl Fn(usize, usize, usize, usize) -> T + Sync) -> Vec<T> {
    let mut out = Vec::with_capacity(level.pixels());
    for (view, r) in level.references.iter().enumerate() {
        let (width, first) = (r.width as usize, r.first as usize);
        let values: Vec<T> = (0..width * r.height as usize)
            .into_par_iter()
            .map(|k| f(view, k % width, k / width, first + k))
            .collect();
        out.extend(values);
    }
    out
}

/// Keeps pixels with at least one agreeing view and more agreeing than contradicting ones.
pub fn consistent_surface(
    level: &Level,
    poses: &RelativePoses,
    matched: &[Vec4],
    void: &[bool],
    weak: &[bool],
) -> Surface {
    let mut surface = Surface {
        planes: matched.iter().map(|p| p.truncate()).collect(),
        confidence: matched
            .iter()
            .zip(void)
            .map(|(p, v)| if *v || p.w > COST_TOLERANCE { 0.0 } else { 1.0 })
            .collect(),
    };
    // In the second round only confirmed pixels confirm or contradict.
    for round in 0..2 {
        surface.confidence = map_pixels(level, |view, x, y, k| {
            if surface.confidence[k] <= 0.0 {
                return 0.0;
            }
            let ray = ray(level, view, x, y);
            let inverse = surface.planes[k].dot(ray);
            if inverse <= 0.0 {
                return 0.0;
            }
            let (mut agree, mut against) = (0usize, 0usize);
            for other in level.neighbours(view) {
                let pixel = [x as f32 + 0.5, y as f32 + 0.5];
                match poses.visibility(level, &surface, view, other, pixel, ray / inverse) {
                    Visibility::Agrees => agree += 1,
                    Visibility::FreeSpace => against += 1,
                    _ => {}
                }
            }
            if agree == 0 || (round > 0 && against >= agree) { 0.0 } else { CONFIDENCE[agree.min(2)] }
        });
    }
    let mut surface = with_plausible(level, poses, &surface, matched, void, weak);
    remove_speckles(level, &mut surface);
    surface
}

/// Adds unconfirmed pixels in views of little parallax, where few are confirmed: pixels that match
/// in some view, lie on one plane with their surroundings and in no other view's free space. With
/// ample parallax a missing confirmation means occlusion or error. On weak texture the smoothness
/// of the search makes surroundings agree on any plane.
fn with_plausible(
    level: &Level,
    poses: &RelativePoses,
    confirmed: &Surface,
    matched: &[Vec4],
    void: &[bool],
    weak: &[bool],
) -> Surface {
    let confidence = map_pixels(level, |view, x, y, k| {
        let plane = matched[k].truncate();
        let ample = level.tolerance[view] <= DEPTH_TOLERANCE;
        if confirmed.confidence[k] > 0.0 || ample || void[k] || weak[k] || matched[k].w > PLAUSIBLE_COST {
            return confirmed.confidence[k];
        }
        let ray = ray(level, view, x, y);
        let inverse = plane.dot(ray);
        if inverse <= 0.0 || support(level, matched, view, x, y, plane) < SUPPORT {
            return 0.0;
        }
        let pixel = [x as f32 + 0.5, y as f32 + 0.5];
        let against = level.neighbours(view).any(|o| {
            poses.visibility(level, confirmed, view, o, pixel, ray / inverse) == Visibility::FreeSpace
        });
        if against { 0.0 } else { PLAUSIBLE }
    });
    Surface { planes: confirmed.planes.clone(), confidence }
}

/// Share of the pixels around (x, y) that lie on a plane.
fn support(level: &Level, matched: &[Vec4], view: usize, x: usize, y: usize, plane: Vec3) -> f32 {
    let r = &level.references[view];
    let (mut total, mut near) = (0u32, 0u32);
    for dy in -SUPPORT_TAPS..=SUPPORT_TAPS {
        for dx in -SUPPORT_TAPS..=SUPPORT_TAPS {
            let (px, py) = (x as i32 + 2 * dx, y as i32 + 2 * dy);
            if px < 0 || py < 0 || px >= r.width as i32 || py >= r.height as i32 {
                continue;
            }
            let there = ray(level, view, px as usize, py as usize);
            let index = r.first as usize + py as usize * r.width as usize + px as usize;
            let other = matched[index].truncate().dot(there);
            total += 1;
            near += u32::from((plane.dot(there) - other).abs() < level.tolerance[view] * other);
        }
    }
    near as f32 / total as f32
}

/// Depth map of a view from its planes; 0 where rejected.
pub fn depth(level: &Level, view: usize, surface: &Surface) -> Image<f32> {
    let r = &level.references[view];
    let (width, height) = (r.width as usize, r.height as usize);
    let mut out = Image::filled(width, height, 0.0);
    out.data.par_chunks_mut(width.max(1)).enumerate().for_each(|(y, row)| {
        for (x, depth) in row.iter_mut().enumerate() {
            let k = r.first as usize + y * width + x;
            let inverse = surface.planes[k].dot(ray(level, view, x, y));
            if surface.confidence[k] > 0.0 && inverse > 0.0 {
                *depth = 1.0 / inverse;
            }
        }
    });
    out
}

/// Rejects small areas of connected depth.
fn remove_speckles(level: &Level, surface: &mut Surface) {
    let views = 0..level.cameras.len();
    let of_view = |view| speckles(level, view, surface);
    for k in views.into_par_iter().flat_map_iter(of_view).collect::<Vec<_>>() {
        surface.confidence[k] = 0.0;
    }
}

/// Pixels of the small areas of connected depth of one view.
fn speckles(level: &Level, view: usize, surface: &Surface) -> Vec<usize> {
    let depth = depth(level, view, surface);
    let (first, tolerance) = (level.references[view].first as usize, free_space_tolerance(level, view));
    let smallest = (SPECKLE_SHARE * depth.data.len() as f32) as usize;
    let mut done = vec![false; depth.data.len()];
    let (mut area, mut rejected) = (Vec::new(), Vec::new());
    for start in 0..depth.data.len() {
        if done[start] || depth.data[start] <= 0.0 {
            continue;
        }
        area.clear();
        area.push(start);
        done[start] = true;
        let mut next = 0;
        while next < area.len() {
            let k = area[next];
            next += 1;
            for n in neighbours(k, depth.width, depth.height) {
                let (a, b) = (depth.data[k], depth.data[n]);
                if !done[n] && b > 0.0 && (a - b).abs() < tolerance * a {
                    done[n] = true;
                    area.push(n);
                }
            }
        }
        if area.len() < smallest {
            rejected.extend(area.iter().map(|k| first + k));
        }
    }
    rejected
}

/// Up to four direct neighbours of a pixel index.
pub fn neighbours(k: usize, width: usize, height: usize) -> impl Iterator<Item = usize> {
    let (x, y) = (k % width, k / width);
    [
        (x > 0).then(|| k - 1),
        (x + 1 < width).then_some(k + 1),
        (y > 0).then(|| k - width),
        (y + 1 < height).then_some(k + width),
    ]
    .into_iter()
    .flatten()
}

/// Smooths each consistent pixel: a least-squares plane, in inverse depth (affine over the image),
/// of the consistent pixels within `radius` that lie on its plane.
pub fn smoothed(level: &Level, surface: &Surface, radius: i32) -> Surface {
    let inverses = map_pixels(level, |view, x, y, k| surface.planes[k].dot(ray(level, view, x, y)));
    let rays: Vec<(Vec<f32>, Vec<f32>)> = (0..level.references.len()).map(|v| rays(level, v)).collect();
    let planes = map_pixels(level, |view, x, y, k| {
        if surface.confidence[k] <= 0.0 {
            return surface.planes[k];
        }
        let (r, (columns, rows)) = (&level.references[view], &rays[view]);
        let (plane, inverse) = (surface.planes[k], inverses[k]);
        // Normal equations of 1/z = a + b dx + c dy, relative to the value at the centre.
        let (mut m, mut rhs) = ([0.0f64; 6], [0.0f64; 3]);
        for dy in -radius..=radius {
            for dx in -radius..=radius {
                let (px, py) = (x as i32 + dx, y as i32 + dy);
                if px < 0 || py < 0 || px >= r.width as i32 || py >= r.height as i32 {
                    continue;
                }
                let n = r.first as usize + py as usize * r.width as usize + px as usize;
                if surface.confidence[n] <= 0.0 {
                    continue;
                }
                let there = Vec3::new(columns[px as usize], rows[py as usize], 1.0);
                let value = inverses[n];
                if (value - plane.dot(there)).abs() > level.tolerance[view] * inverse {
                    continue;
                }
                let (u, v, w) = (dx as f64, dy as f64, (value - inverse) as f64);
                for (slot, product) in m.iter_mut().zip([1.0, u, v, u * u, u * v, v * v]) {
                    *slot += product;
                }
                for (slot, product) in rhs.iter_mut().zip([w, u * w, v * w]) {
                    *slot += product;
                }
            }
        }
        let matrix = DMat3::from_cols(
            DVec3::new(m[0], m[1], m[2]),
            DVec3::new(m[1], m[3], m[4]),
            DVec3::new(m[2], m[4], m[5]),
        );
        // Fewer than a dozen pixels, or collinear ones: the matched plane is better than the fit.
        if m[0] < 12.0 || matrix.determinant() < 1e-3 * m[0] * m[3] * m[5] {
            return plane;
        }
        let fit = matrix.inverse() * DVec3::from(rhs);
        let [fx, fy, cx, cy] = r.intrinsics;
        let centre = DVec2::new((x as f32 + 0.5 - cx) as f64, (y as f32 + 0.5 - cy) as f64);
        // 1/z(u, v) = w₀ + b (u − u₀) + c (v − v₀) as π·ray.
        let constant = inverse as f64 + fit.x - fit.y * centre.x - fit.z * centre.y;
        DVec3::new(fit.y * fx as f64, fit.z * fy as f64, constant).as_vec3()
    });
    Surface { planes, confidence: surface.confidence.clone() }
}
