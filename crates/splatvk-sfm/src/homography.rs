//! Homographies between two photos: of a plane, or of any scene under pure rotation and zoom
//! (Hartley and Zisserman 2004, sections 4.7, 8.4 and 13.1).
use super::numeric::{minimise_small, nearest_rotation};
use crate::math::{Random, median};
use crate::scene::Pose;
use glam::{DMat3, DVec2, DVec3};
use nalgebra::{SMatrix, SVector};

/// RANSAC samples of four matches. With half of the matches on one plane, 17 in a row miss it with
/// a probability of a third.
const SAMPLES: usize = 400;

/// Transfers a point by a homography; infinite beyond the horizon of the plane.
fn transfer(h: &DMat3, x: DVec2) -> DVec2 {
    let q = *h * x.extend(1.0);
    if q.z > 1e-9 { q.truncate() / q.z } else { DVec2::INFINITY }
}

/// Homography of four matches; `None` where three of them are collinear.
fn from_four(x: [DVec2; 4], y: [DVec2; 4]) -> Option<DMat3> {
    let (mut a, mut b) = (SMatrix::<f64, 8, 8>::zeros(), SVector::<f64, 8>::zeros());
    for (k, (p, q)) in x.iter().zip(&y).enumerate() {
        for (axis, v) in [q.x, q.y].into_iter().enumerate() {
            let row = 2 * k + axis;
            for (i, value) in [p.x, p.y, 1.0].into_iter().enumerate() {
                a[(row, 3 * axis + i)] = value;
            }
            (a[(row, 6)], a[(row, 7)], b[row]) = (-v * p.x, -v * p.y, v);
        }
    }
    let h = a.lu().solve(&b)?;
    let rows = DMat3::from_cols_array(&[h[0], h[1], h[2], h[3], h[4], h[5], h[6], h[7], 1.0]);
    Some(rows.transpose()).filter(DMat3::is_finite)
}

/// Appends a residual in units of `scale`, weighted so that its square is the Cauchy loss.
fn push_robust(r: DVec2, scale: f64, out: &mut Vec<f64>) {
    // Points beyond the horizon get a large, finite residual.
    let r = if r.is_finite() { r / scale } else { DVec2::splat(1e3) };
    let r2 = r.length_squared();
    let w = if r2 > 1e-12 { (r2.ln_1p() / r2).sqrt() } else { 1.0 };
    out.extend([r.x * w, r.y * w]);
}

/// Homography with most agreement among the matches `x` → `y`, sorted best first (MSAC, then a
/// Cauchy fit). Mirroring homographies are skipped. `None` with fewer than eight matches within
/// twice `threshold`.
pub(crate) fn estimate(x: &[DVec2], y: &[DVec2], threshold: f64, seed: u64) -> Option<DMat3> {
    let n = x.len();
    if n < 8 {
        return None;
    }
    let mut rng = Random::new(seed ^ 0x0b06);
    let mut best = (f64::INFINITY, DMat3::IDENTITY);
    for k in 0..SAMPLES {
        // Better matches first, as in PROSAC.
        let reach = (n * 3 * (k + 1) / SAMPLES).clamp(n.min(40), n);
        let s = rng.sample::<4>(reach);
        let Some(h) = from_four(s.map(|i| x[i]), s.map(|i| y[i])).filter(|h| h.determinant() > 0.0) else {
            continue;
        };
        let value = truncated_cost(&h, x, y, threshold);
        if value < best.0 {
            best = (value, h);
        }
    }
    let near: Vec<usize> =
        (0..n).filter(|k| transfer(&best.1, x[*k]).distance(y[*k]) < 2.0 * threshold).collect();
    if near.len() < 8 {
        return None;
    }
    let updated = |v: &[f64; 8]| {
        let rows = DMat3::from_cols_array(&[v[0], v[1], v[2], v[3], v[4], v[5], v[6], v[7], 0.0]);
        best.1 + rows.transpose() * best.1.z_axis.z
    };
    let (v, _) = minimise_small([0.0; 8], [1e-7; 8], 20, |v, out| {
        out.clear();
        let h = updated(v);
        near.iter().for_each(|&k| push_robust(transfer(&h, x[k]) - y[k], threshold / 3.0, out));
    });
    Some(updated(&v))
}

/// Sum of the squared transfer errors in units of `threshold`, each at most 1.
fn truncated_cost(h: &DMat3, x: &[DVec2], y: &[DVec2], threshold: f64) -> f64 {
    let error =
        |(x, y): (&DVec2, &DVec2)| (transfer(h, *x).distance_squared(*y) / threshold.powi(2)).min(1.0);
    x.iter().zip(y).map(error).sum()
}

/// Largest relative change of a homography's scale from the image centre to the border: 0 where it
/// is affine, as between fronto-parallel views of a plane. `half`: half of the image's sides;
/// points are relative to the centre.
pub(crate) fn perspective(h: &DMat3, half: DVec2) -> f64 {
    let row = h.row(2);
    (row.truncate().abs().dot(half) / row.z).abs()
}

/// Homography `K₂ R K₁⁻¹` of a camera that only rotated and zoomed.
#[derive(Clone, Copy, Debug)]
pub(crate) struct RotationZoom {
    pub(crate) h: DMat3,
    /// Focal length of the second photo over that of the first.
    pub(crate) zoom: f64,
}

/// Bounds of the focal lengths of two photos, both in units of their prior.
#[derive(Clone, Copy, Debug)]
pub(crate) struct FocalRange {
    /// Largest |ln| of either.
    pub(crate) each: f64,
    /// Largest |ln| of their ratio.
    pub(crate) zoom: f64,
}

/// Fits rotation and zoom to the matches, starting from their homography. Pixels are centred and
/// divided by the prior focal length of their photo.
pub(crate) fn fit_rotation_zoom(
    h: &DMat3,
    x: &[DVec2],
    y: &[DVec2],
    threshold: f64,
    range: FocalRange,
) -> RotationZoom {
    // At the centre, a rotated camera scales areas by about the square of the zoom.
    let area = h.determinant() / h.z_axis.z.powi(3);
    let ratio = 0.5 * area.max(1e-6).ln();
    let fit_from = |mean: f64| {
        let (first, second) = range.focal_lengths(mean, ratio);
        let m = scaling(1.0 / second) * *h * scaling(first);
        let rotation = nearest_rotation(&(m / m.determinant().cbrt()));
        let updated = |v: &[f64; 5]| {
            let r = Pose::exp(DVec3::ZERO, DVec3::new(v[0], v[1], v[2])).rotation * rotation;
            let (first, second) = range.focal_lengths(mean + v[3], ratio + v[4]);
            scaling(second) * r * scaling(1.0 / first)
        };
        let (v, cost) = minimise_small([0.0; 5], [1e-7; 5], 30, |v, out| {
            out.clear();
            let h = updated(v);
            x.iter().zip(y).for_each(|(x, y)| push_robust(transfer(&h, *x) - *y, threshold / 3.0, out));
        });
        let (first, second) = range.focal_lengths(mean + v[3], ratio + v[4]);
        (cost, RotationZoom { h: updated(&v), zoom: second / first })
    };
    let starts = [-0.5, 0.0, 0.5].map(|m| fit_from(m * range.each));
    let best = starts.into_iter().min_by(|a, b| a.0.total_cmp(&b.0));
    best.map_or(RotationZoom { h: *h, zoom: 1.0 }, |b| b.1)
}

fn scaling(focal: f64) -> DMat3 {
    DMat3::from_diagonal(DVec3::new(focal, focal, 1.0))
}

impl FocalRange {
    /// Both focal lengths from ln of their geometric mean and of their ratio, within the bounds.
    fn focal_lengths(&self, mean: f64, ratio: f64) -> (f64, f64) {
        let (mean, ratio) = (mean.clamp(-self.each, self.each), ratio.clamp(-self.zoom, self.zoom));
        ((mean - 0.5 * ratio).exp(), (mean + 0.5 * ratio).exp())
    }
}

impl RotationZoom {
    /// Median transfer error of the matches.
    pub(crate) fn residual(&self, x: &[DVec2], y: &[DVec2]) -> f64 {
        let mut all: Vec<f64> = x.iter().zip(y).map(|(x, y)| transfer(&self.h, *x).distance(*y)).collect();
        median(&mut all).unwrap_or(f64::INFINITY)
    }

    /// Share of the matches with a transfer error below `threshold`.
    pub(crate) fn share(&self, x: &[DVec2], y: &[DVec2], threshold: f64) -> f64 {
        let near = x.iter().zip(y).filter(|(x, y)| transfer(&self.h, **x).distance(**y) < threshold).count();
        near as f64 / x.len().max(1) as f64
    }
}

/// Samples of two off-plane matches for the epipole: with a tenth of them right, 300 samples almost
/// surely contain a right pair.
const EPIPOLES: usize = 300;

/// Number of matches that agree with a homography, and number of off-plane ones that agree with the
/// epipolar lines of one epipole (plane + parallax, Irani and Anandan 1996), less those expected by
/// chance.
pub(crate) fn count_on_and_off_plane(
    h: &DMat3,
    x: &[DVec2],
    y: &[DVec2],
    threshold: f64,
    seed: u64,
) -> (usize, usize) {
    let moved: Vec<DVec3> = x.iter().map(|x| transfer(h, *x).extend(1.0)).collect();
    let found: Vec<DVec3> = y.iter().map(|y| y.extend(1.0)).collect();
    let (on, off): (Vec<usize>, Vec<usize>) =
        (0..x.len()).partition(|&k| moved[k].distance(found[k]) < threshold);
    let off: Vec<usize> = off.into_iter().filter(|k| moved[*k].is_finite()).collect();
    let mut rng = Random::new(seed ^ 0x0ff);
    let mut most = 0;
    for _ in 0..if off.len() < 3 { 0 } else { EPIPOLES } {
        let [a, b] = rng.sample::<2>(off.len()).map(|k| moved[off[k]].cross(found[off[k]]));
        let epipole = a.cross(b).normalize_or_zero();
        let agrees = |k: &&usize| {
            let line = epipole.cross(moved[**k]);
            line.dot(found[**k]).abs() < threshold * line.truncate().length()
        };
        most = most.max(off.iter().filter(agrees).count());
    }
    // Both sampled matches always agree, and some of the others by chance.
    let by_chance = 2.0 + CHANCE * off.len() as f64;
    (on.len(), (most as f64 - by_chance).max(0.0) as usize)
}

/// Share of wrong matches that agree by chance with the best of [`EPIPOLES`] epipoles.
const CHANCE: f64 = 0.05;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::matches_of;

    const FREE: FocalRange = FocalRange { each: 0.7, zoom: 1.2 };
    const PIXEL: f64 = 1.0 / 576.0;

    fn found(
        pose: &Pose,
        focal: [f64; 2],
        point: impl Fn(&mut Random) -> DVec3,
    ) -> (RotationZoom, Vec<DVec2>, Vec<DVec2>) {
        let (x, y) = matches_of(pose, focal.map(|f| f * PIXEL), 400, 0.5 * PIXEL, point);
        let h = estimate(&x, &y, 3.0 * PIXEL, 0).unwrap();
        (fit_rotation_zoom(&h, &x, &y, 3.0 * PIXEL, FREE), x, y)
    }

    fn deep(rng: &mut Random) -> DVec3 {
        let z = 3.0 + 2.0 * rng.uniform();
        DVec3::new(rng.uniform() - 0.5, 0.75 * (rng.uniform() - 0.5), 1.0) * z
    }

    /// On the plane z = 4.
    fn flat(rng: &mut Random) -> DVec3 {
        DVec3::new(rng.uniform() - 0.5, 0.75 * (rng.uniform() - 0.5), 1.0) * 4.0
    }

    #[test]
    fn rotation_zoom_residual_is_noise() {
        let still = Pose::IDENTITY;
        let turned = Pose::exp(DVec3::ZERO, DVec3::new(0.03, 0.12, 0.05));
        for (pose, focal) in [(still, [500.0, 900.0]), (turned, [660.0, 660.0]), (turned, [800.0, 520.0])] {
            let (t, x, y) = found(&pose, focal, deep);
            let left = t.residual(&x, &y) / PIXEL;
            println!("{left} {}", t.zoom);
            // Noise of half a pixel in each photo has a median length of 0.83, and of 1.2 enlarged
            // 1.8 times.
            assert!(left < 1.4 && (t.zoom * focal[0] / focal[1] - 1.0).abs() < 0.02, "{left} {t:?}");
        }
    }

    #[test]
    fn rotation_zoom_translation_leaves_parallax() {
        let aside = Pose::exp(DVec3::new(-0.15, 0.0, 0.0), DVec3::new(0.0, 0.03, 0.0));
        let ahead = Pose { rotation: DMat3::IDENTITY, translation: DVec3::new(0.0, 0.0, -0.6) };
        for pose in [aside, ahead] {
            let (t, x, y) = found(&pose, [600.0, 600.0], deep);
            let left = t.residual(&x, &y) / PIXEL;
            println!("{left}");
            assert!(left > 2.5, "{left}");
        }
    }

    #[test]
    fn rotation_zoom_of_plane_leaves_parallax() {
        // A poster from two sides, and flat ground from two places straight above it.
        let turn = Pose::exp(DVec3::ZERO, DVec3::new(0.0, 0.3, 0.0));
        let middle = DVec3::new(0.0, 0.0, 4.0);
        let around = Pose { translation: middle - turn.rotation * middle, ..turn };
        let above = Pose { rotation: DMat3::IDENTITY, translation: DVec3::new(-1.0, 0.1, 0.0) };
        for pose in [around, above] {
            let (t, x, y) = found(&pose, [600.0, 600.0], flat);
            let left = t.residual(&x, &y) / PIXEL;
            println!("{left}");
            assert!(left > 2.0, "{left}");
        }
    }

    #[test]
    fn perspective_of_frontal_plane_is_zero() {
        let half = DVec2::new(0.55, 0.42);
        let share = |pose: &Pose| {
            let (x, y) = matches_of(pose, [600.0 * PIXEL; 2], 400, 0.5 * PIXEL, flat);
            perspective(&estimate(&x, &y, 3.0 * PIXEL, 0).unwrap(), half)
        };
        let aside = DVec3::new(-0.8, 0.2, 0.1);
        let (above, tilted) =
            (share(&Pose::exp(aside, DVec3::Z * 0.1)), share(&Pose::exp(aside, DVec3::X * 0.4)));
        println!("{above} {tilted}");
        assert!(above < 0.02 && tilted > 0.15, "{above} {tilted}");
    }

    #[test]
    fn plane_parallax_counts_off_plane_matches() {
        let turn = Pose::exp(DVec3::ZERO, DVec3::new(0.0, 0.3, 0.0));
        let middle = DVec3::new(0.0, 0.0, 4.0);
        let pose = Pose { translation: middle - turn.rotation * middle, ..turn };
        let share = |point: &dyn Fn(&mut Random) -> DVec3| {
            let (mut x, mut y) = matches_of(&pose, [600.0 * PIXEL; 2], 400, 0.5 * PIXEL, point);
            let mut rng = Random::new(7);
            for _ in 0..200 {
                let mut wrong = || DVec2::new(rng.uniform() - 0.5, 0.75 * (rng.uniform() - 0.5));
                x.push(wrong());
                y.push(wrong());
            }
            let h = estimate(&x, &y, 3.0 * PIXEL, 0).unwrap();
            let (on, off) = count_on_and_off_plane(&h, &x, &y, 3.0 * PIXEL, 0);
            off as f64 / (on + off) as f64
        };
        let (plane, space) = (share(&flat), share(&deep));
        let third = |rng: &mut Random| if rng.uniform() < 0.3 { deep(rng) } else { flat(rng) };
        let both = share(&third);
        println!("{plane} {space} {both}");
        assert!(plane < 0.03 && space > 0.5 && (0.15..0.4).contains(&both), "{plane} {space} {both}");
    }
}
