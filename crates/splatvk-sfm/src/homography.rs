//! Homographies between two photos: a plane seen from two places, or anything seen by a camera that
//! only turned or zoomed (Hartley and Zisserman 2004, sections 4.7, 8.4 and 13.1).
use super::numeric::{minimise_small, nearest_rotation};
use crate::math::{Random, median};
use crate::scene::Pose;
use glam::{DMat3, DVec2, DVec3};
use nalgebra::{SMatrix, SVector};

/// Samples of four matches: of matches of which half lie on one plane, 17 in a row miss it as
/// rarely as once in three.
const SAMPLES: usize = 400;

/// Where a homography shows a point.
fn shown(h: &DMat3, x: DVec2) -> DVec2 {
    let q = *h * x.extend(1.0);
    // Beyond its horizon a plane shows nothing.
    if q.z > 1e-9 { q.truncate() / q.z } else { DVec2::INFINITY }
}

/// The homography of four matches; `None` where three of them lie on a line.
fn of_four(x: [DVec2; 4], y: [DVec2; 4]) -> Option<DMat3> {
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

/// Robust residual (Cauchy) of a vector, in two components.
fn robust(r: DVec2, scale: f64, out: &mut Vec<f64>) {
    // What a trial sends beyond the horizon is as far off as can be.
    let r = if r.is_finite() { r / scale } else { DVec2::splat(1e3) };
    let r2 = r.length_squared();
    let w = if r2 > 1e-12 { (r2.ln_1p() / r2).sqrt() } else { 1.0 };
    out.extend([r.x * w, r.y * w]);
}

/// The homography on which most matches `x` → `y`, sorted best first, agree within `threshold`;
/// `None` where it shows the scene mirrored or fewer than eight agree.
pub(crate) fn homography(x: &[DVec2], y: &[DVec2], threshold: f64, seed: u64) -> Option<DMat3> {
    let n = x.len();
    if n < 8 {
        return None;
    }
    let mut rng = Random::new(seed ^ 0x0b06);
    let score = |h: &DMat3| -> f64 {
        let miss =
            |(x, y): (&DVec2, &DVec2)| (shown(h, *x).distance_squared(*y) / threshold.powi(2)).min(1.0);
        x.iter().zip(y).map(miss).sum()
    };
    let mut best = (f64::INFINITY, DMat3::IDENTITY);
    for k in 0..SAMPLES {
        // Better matches first, as in PROSAC.
        let reach = (n * 3 * (k + 1) / SAMPLES).clamp(n.min(40), n);
        let s = rng.sample::<4>(reach);
        let Some(h) = of_four(s.map(|i| x[i]), s.map(|i| y[i])).filter(|h| h.determinant() > 0.0) else {
            continue;
        };
        let value = score(&h);
        if value < best.0 {
            best = (value, h);
        }
    }
    let near: Vec<usize> =
        (0..n).filter(|k| shown(&best.1, x[*k]).distance(y[*k]) < 2.0 * threshold).collect();
    if near.len() < 8 {
        return None;
    }
    let at = |v: &[f64; 8]| {
        let rows = DMat3::from_cols_array(&[v[0], v[1], v[2], v[3], v[4], v[5], v[6], v[7], 0.0]);
        best.1 + rows.transpose() * best.1.z_axis.z
    };
    let (v, _) = minimise_small([0.0; 8], [1e-7; 8], 20, |v, out| {
        out.clear();
        let h = at(v);
        near.iter().for_each(|&k| robust(shown(&h, x[k]) - y[k], threshold / 3.0, out));
    });
    Some(at(&v))
}

/// Largest change of a homography's scale along the picture, as a share of that in the middle: 0
/// where it is affine, as between photos of a plane that both see straight on. `half`: half of the
/// picture's sides, from whose middle points are counted.
pub(crate) fn perspective(h: &DMat3, half: DVec2) -> f64 {
    let row = h.row(2);
    (row.truncate().abs().dot(half) / row.z).abs()
}

/// A camera that turned and zoomed where it stood: `K₂ R K₁⁻¹` with two focal lengths.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Turn {
    pub(crate) h: DMat3,
    /// Focal length of the second photo over that of the first.
    pub(crate) zoom: f64,
}

/// What is known of the focal lengths of two photos, both in units of their prior.
#[derive(Clone, Copy, Debug)]
pub(crate) struct FocalRange {
    /// Largest |ln| of either.
    pub(crate) each: f64,
    /// Largest |ln| of their ratio.
    pub(crate) zoom: f64,
}

/// The turn in place that explains the matches best, starting from their homography. Pixels are
/// centred and divided by the prior focal length of their photo.
pub(crate) fn turn(h: &DMat3, x: &[DVec2], y: &[DVec2], threshold: f64, range: FocalRange) -> Turn {
    let k = |m: f64| DMat3::from_diagonal(DVec3::new(m, m, 1.0));
    let within = |mean: f64, ratio: f64| {
        let (mean, ratio) = (mean.clamp(-range.each, range.each), ratio.clamp(-range.zoom, range.zoom));
        ((mean - 0.5 * ratio).exp(), (mean + 0.5 * ratio).exp())
    };
    let of = |rotation: &DMat3, mean: f64, ratio: f64| {
        let (first, second) = within(mean, ratio);
        k(second) * *rotation * k(1.0 / first)
    };
    // A turned camera shows areas in the middle larger by the square of the zoom, nearly.
    let area = |h: &DMat3| h.determinant() / h.z_axis.z.powi(3);
    let ratio = 0.5 * area(h).max(1e-6).ln();
    let start = |mean: f64| {
        let (first, second) = within(mean, ratio);
        let m = k(1.0 / second) * *h * k(first);
        nearest_rotation(&(m / m.determinant().cbrt()))
    };
    let fit = |mean: f64| {
        let rotation = start(mean);
        let turned = |v: &[f64; 5]| {
            let r = Pose::exp(DVec3::ZERO, DVec3::new(v[0], v[1], v[2])).rotation * rotation;
            of(&r, mean + v[3], ratio + v[4])
        };
        let (v, cost) = minimise_small([0.0; 5], [1e-7; 5], 30, |v, out| {
            out.clear();
            let h = turned(v);
            x.iter().zip(y).for_each(|(x, y)| robust(shown(&h, *x) - *y, threshold / 3.0, out));
        });
        let (first, second) = within(mean + v[3], ratio + v[4]);
        (cost, Turn { h: turned(&v), zoom: second / first })
    };
    let starts = [-0.5, 0.0, 0.5].map(|m| fit(m * range.each));
    let best = starts.into_iter().min_by(|a, b| a.0.total_cmp(&b.0));
    best.map_or(Turn { h: *h, zoom: 1.0 }, |b| b.1)
}

impl Turn {
    /// Median distance between where it shows the matches and where they are.
    pub(crate) fn residual(&self, x: &[DVec2], y: &[DVec2]) -> f64 {
        let mut all: Vec<f64> = x.iter().zip(y).map(|(x, y)| shown(&self.h, *x).distance(*y)).collect();
        median(&mut all).unwrap_or(f64::INFINITY)
    }

    /// Share of the matches that it shows within `threshold`.
    pub(crate) fn share(&self, x: &[DVec2], y: &[DVec2], threshold: f64) -> f64 {
        let near = x.iter().zip(y).filter(|(x, y)| shown(&self.h, **x).distance(**y) < threshold).count();
        near as f64 / x.len().max(1) as f64
    }
}

/// Pairs of matches off the plane that are tried for the epipole: of those of which a tenth is
/// right, 300 hold two right ones almost surely.
const EPIPOLES: usize = 300;

/// How many matches agree with a homography and, off its plane, with the epipolar lines of one
/// epipole (plane and parallax: Irani and Anandan 1996), less what chance brings near those.
pub(crate) fn on_and_off_plane(
    h: &DMat3,
    x: &[DVec2],
    y: &[DVec2],
    threshold: f64,
    seed: u64,
) -> (usize, usize) {
    let moved: Vec<DVec3> = x.iter().map(|x| shown(h, *x).extend(1.0)).collect();
    let seen: Vec<DVec3> = y.iter().map(|y| y.extend(1.0)).collect();
    let (on, off): (Vec<usize>, Vec<usize>) =
        (0..x.len()).partition(|&k| moved[k].distance(seen[k]) < threshold);
    let off: Vec<usize> = off.into_iter().filter(|k| moved[*k].is_finite()).collect();
    let mut rng = Random::new(seed ^ 0x0ff);
    let mut most = 0;
    for _ in 0..if off.len() < 3 { 0 } else { EPIPOLES } {
        let [a, b] = rng.sample::<2>(off.len()).map(|k| moved[off[k]].cross(seen[off[k]]));
        let epipole = a.cross(b).normalize_or_zero();
        let meets = |k: &&usize| {
            let line = epipole.cross(moved[**k]);
            line.dot(seen[**k]).abs() < threshold * line.truncate().length()
        };
        most = most.max(off.iter().filter(meets).count());
    }
    // The two that it was drawn from, and those that chance brings near.
    let by_chance = 2.0 + CHANCE * off.len() as f64;
    (on.len(), (most as f64 - by_chance).max(0.0) as usize)
}

/// Share of wrong matches near the epipolar lines of the best of so many epipoles.
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
    ) -> (Turn, Vec<DVec2>, Vec<DVec2>) {
        let (x, y) = matches_of(pose, focal.map(|f| f * PIXEL), 400, 0.5 * PIXEL, point);
        let h = homography(&x, &y, 3.0 * PIXEL, 0).unwrap();
        (turn(&h, &x, &y, 3.0 * PIXEL, FREE), x, y)
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
    fn turns_and_zooms_leave_only_noise() {
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
    fn moves_leave_parallax() {
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
    fn planes_are_told_from_turns() {
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
    fn planes_seen_straight_on_have_no_perspective() {
        let half = DVec2::new(0.55, 0.42);
        let share = |pose: &Pose| {
            let (x, y) = matches_of(pose, [600.0 * PIXEL; 2], 400, 0.5 * PIXEL, flat);
            perspective(&homography(&x, &y, 3.0 * PIXEL, 0).unwrap(), half)
        };
        let aside = DVec3::new(-0.8, 0.2, 0.1);
        let (above, tilted) =
            (share(&Pose::exp(aside, DVec3::Z * 0.1)), share(&Pose::exp(aside, DVec3::X * 0.4)));
        println!("{above} {tilted}");
        assert!(above < 0.02 && tilted > 0.15, "{above} {tilted}");
    }

    #[test]
    fn parallax_off_a_plane_is_counted() {
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
            let h = homography(&x, &y, 3.0 * PIXEL, 0).unwrap();
            let (on, off) = on_and_off_plane(&h, &x, &y, 3.0 * PIXEL, 0);
            off as f64 / (on + off) as f64
        };
        let (plane, space) = (share(&flat), share(&deep));
        let third = |rng: &mut Random| if rng.uniform() < 0.3 { deep(rng) } else { flat(rng) };
        let both = share(&third);
        println!("{plane} {space} {both}");
        assert!(plane < 0.03 && space > 0.5 && (0.15..0.4).contains(&both), "{plane} {space} {both}");
    }
}
