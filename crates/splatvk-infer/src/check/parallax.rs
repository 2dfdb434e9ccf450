//! Known parallax: signs and sizes that geometry networks and matchers must find in two built-in
//! pictures.
//!
//! A reversed sign is a fault: no imprecision turns displacements of 20 and 60 pixels around, but
//! inverted poses, inverse depth and swapped outputs do. A wrong size is only a doubt, because
//! trained networks also judge by appearance, and the pictures show no real wall.
use glam::{DMat3, DVec3, Vec3};
use nalgebra::Matrix3;

use super::pictures::{HEIGHT, Surface, WIDTH, pictures, surface};
use super::{Figure, Finding, Measured, Verdict, measured, record, rotation_degrees};
use crate::Result;
use crate::installed::Installed;
use crate::math::median;
use crate::progress::Silent;
use crate::scene::{Affine, DenseWarp, Pose};
use crate::{pairs, warp};

/// Largest angle between the second camera's direction and the x axis without a doubt, degrees. A
/// baseline of two pictures that is short against the depth leaves it uncertain.
const DIRECTION: f64 = 30.0;
/// Largest rotation without a doubt, degrees: a pan of 6° moves the whole picture by 60 pixels.
const ROTATION: f64 = 10.0;
/// Ratio of the depths of wall and box without a doubt; the truth is 3.
const RATIO: [f64; 2] = [1.5, 6.0];
/// Least distance of the cameras, in depths of the box. It is 60 pixels over the focal length in
/// truth, so 0.05 to 0.19 for fields of view from 30° to 90°; a tenth of that is no baseline.
const BASELINE: f64 = 0.005;
/// Largest median error of matches without a doubt, pixels: the step of matched descriptors.
const MATCH: f64 = 4.0;

/// Two cameras and the depths that the first one sees.
pub(super) struct TwoViews {
    /// First camera → second camera.
    pub pose: Pose,
    /// Median camera z of the wall in the first view.
    pub wall: f64,
    /// Median camera z of the box in the first view.
    pub near: f64,
}

impl TwoViews {
    /// `depth` returns camera z of the first view at a pixel of the network's input.
    pub fn new(pose: Pose, from_photo: &Affine, size: [usize; 2], depth: impl Fn(usize) -> f64) -> TwoViews {
        let of = |wanted: Surface| {
            let seen = |(x, y): &(f64, f64)| surface(0, *x, *y) == Some(wanted);
            let value = |(x, y): (f64, f64)| {
                let [u, v] = from_photo.apply([x, y]);
                let inside = u >= 0.0 && v >= 0.0 && u < size[0] as f64 && v < size[1] as f64;
                inside.then(|| depth(v as usize * size[0] + u as usize))
            };
            let mut values: Vec<f64> = samples().filter(seen).filter_map(value).collect();
            median(&mut values).unwrap_or(f64::NAN)
        };
        TwoViews { pose, wall: of(Surface::Wall), near: of(Surface::Box) }
    }

    /// Compares with the truth: the second camera is to the right of the first, not turned, and the
    /// wall is three times as far away as the box.
    pub fn judge(&self) -> Finding {
        let centre = self.pose.centre();
        let direction = centre.angle_between(DVec3::X).to_degrees();
        let rotation = rotation_degrees(&self.pose.rotation, &DMat3::IDENTITY);
        let ratio = self.wall / self.near;
        let baseline = centre.length() / self.near.abs();
        let figures = vec![
            Figure::new("direction", direction, "°"),
            Figure::new("rotation", rotation, "°"),
            Figure::new("depth ratio", ratio, ""),
            Figure::new("baseline", baseline, ""),
        ];
        let fault = |text: String| Verdict::Fault(format!("two built-in pictures: {text}"));
        // Comparisons with NaN are false, so that NaN is a fault.
        let (ahead, apart) = (self.wall > 0.0 && self.near > 0.0, baseline >= BASELINE);
        let verdict = if !ahead {
            fault("the depth of most pixels is not positive".to_owned())
        } else if !apart {
            fault(format!(
                "the cameras stand at one place (baseline {baseline:.1e} of the depth), so the graph does not compare its photos"
            ))
        } else if direction > 90.0 {
            fault(format!(
                "the second camera lies {direction:.0}° from its true direction, so poses are inverted or mirrored; if the graph \
                 gives camera-to-world, say apply.extrinsics = \"invert\" in its adapter"
            ))
        } else if ratio * RATIO[0] < 1.0 {
            fault(format!(
                "the wall has {ratio:.2} times the depth of the box before it, in truth 3, as if the graph gave inverse depth"
            ))
        } else if direction > DIRECTION || rotation > ROTATION || !(RATIO[0]..=RATIO[1]).contains(&ratio) {
            Verdict::Doubt(format!(
                "its geometry of two built-in pictures is rough; in truth direction 0° (at most {DIRECTION}°), rotation 0° (at \
                 most {ROTATION}°), depth ratio 3 ({} to {})",
                RATIO[0], RATIO[1]
            ))
        } else {
            Verdict::Sound
        };
        Finding { figures, verdict }
    }
}

/// Runs a pair network on two pictures.
pub(super) fn of_pair_network(model: &Installed, steps: &mut Vec<Measured>) -> Result<()> {
    let photos = pictures(2);
    let step = "geometry of 2 photos".to_string();
    let maps = measured(step, steps, || pairs::pointmaps(model, &photos, &Silent))?;
    let (Some(pair), Some(view)) = (maps.pairs.first(), maps.views.first()) else { return Ok(()) };
    let pose = second_camera(&pair.x22.points, &pair.x21.points);
    let depth = |k: usize| f64::from(pair.x11.points[k][2]);
    let found = TwoViews::new(pose, &view.from_working, [view.width, view.height], depth);
    record(model, steps, found.judge())
}

/// First camera → second camera, in the unit of `first`: the similarity between the second view's
/// points in the second camera and in the first one, by least squares (Umeyama 1991). The two may
/// have different scales, since they are decoded apart.
fn second_camera(second: &[[f32; 3]], first: &[[f32; 3]]) -> Pose {
    let count = second.len().max(1) as f64;
    let point = |p: &[f32; 3]| Vec3::from(*p).as_dvec3();
    let [p0, q0] = [second, first].map(|list| list.iter().map(point).sum::<DVec3>() / count);
    let centred = || second.iter().zip(first).map(|(p, q)| (point(p) - p0, point(q) - q0));
    let covariance = centred().fold(DMat3::ZERO, |sum, (p, q)| sum + outer(q, p));
    let rotation = nearest_rotation(&covariance);
    let dot: f64 = centred().map(|(p, q)| q.dot(rotation * p)).sum();
    let norm: f64 = centred().map(|(p, _)| p.length_squared()).sum();
    let scale = if norm > 0.0 { dot / norm } else { 1.0 };
    Pose { rotation, translation: q0 - scale * (rotation * p0) }.inverse()
}

/// `a bᵀ`
fn outer(a: DVec3, b: DVec3) -> DMat3 {
    DMat3::from_cols(a * b.x, a * b.y, a * b.z)
}

fn nearest_rotation(m: &DMat3) -> DMat3 {
    let svd = Matrix3::from_column_slice(&m.to_cols_array()).svd(true, true);
    let (Some(u), Some(v)) = (svd.u, svd.v_t) else { return DMat3::IDENTITY };
    let sign = (u * v).determinant().signum();
    let r = u * Matrix3::from_diagonal(&[1.0, 1.0, sign].into()) * v;
    DMat3::from_cols_slice(r.as_slice())
}

/// Runs a matcher on two pictures and compares its matches with the known ones.
pub(super) fn of_matcher(model: &Installed, steps: &mut Vec<Measured>) -> Result<()> {
    let photos = pictures(2);
    let step = "matches of a pair, both ways".to_string();
    let found = measured(step, steps, || warp::warps(model, &photos, &Silent))?;
    let Some((there, back)) = found.first() else { return Ok(()) };
    record(model, steps, judge_matches([there, back]))
}

/// Warps from the first picture to the second and back.
fn judge_matches(warps: [&DenseWarp; 2]) -> Finding {
    let of = |surface| [0, 1].map(|k| Matched::new(warps[k], k, surface));
    let (wall, near) = (of(Surface::Wall), of(Surface::Box));
    let worst = |all: &[Matched; 2]| all[0].error.max(all[1].error);
    let figures =
        vec![Figure::new("wall error", worst(&wall), "px"), Figure::new("box error", worst(&near), "px")];
    let reversed = |k: &usize| wall[*k].disparity < 0.0 || near[*k].disparity < wall[*k].disparity;
    if let Some(k) = [0, 1].iter().find(|k| reversed(k)) {
        let text = format!(
            "two built-in pictures: from picture {} its matches move the wall by {:.1} px and the box by {:.1} px, in truth by {} \
             and {}, as if its adapter swapped image1 and image2, or warp12 and warp21",
            k + 1,
            wall[*k].disparity,
            near[*k].disparity,
            Surface::Wall.disparity(),
            Surface::Box.disparity()
        );
        return Finding { figures, verdict: Verdict::Fault(text) };
    }
    // Comparisons with NaN, the error of no match, are false.
    let verdict = match worst(&wall) <= MATCH && worst(&near) <= MATCH {
        true => Verdict::Sound,
        false => Verdict::Doubt(format!(
            "its matches of two built-in pictures are rough; errors of up to {MATCH} px are usual"
        )),
    };
    Finding { figures, verdict }
}

/// Matches on one surface.
struct Matched {
    /// Median displacement against the motion of the camera, pixels; positive in truth. NaN if
    /// nothing matches.
    disparity: f64,
    /// Median distance from the true matches, pixels; infinite if nothing matches.
    error: f64,
}

impl Matched {
    fn new(warp: &DenseWarp, picture: usize, wanted: Surface) -> Matched {
        let left = [1.0, -1.0][picture];
        let (mut moved, mut errors) = (Vec::new(), Vec::new());
        for (x, y) in samples().filter(|(x, y)| surface(picture, *x, *y) == Some(wanted)) {
            let p = y as usize * WIDTH + x as usize;
            if warp.certainty.data[p] > 0.0 {
                let [u, v] = warp.target.data[p].map(f64::from);
                let disparity = left * (x + 0.5 - u);
                moved.push(disparity);
                errors.push((disparity - wanted.disparity()).hypot(v - y - 0.5));
            }
        }
        Matched {
            disparity: median(&mut moved).unwrap_or(f64::NAN),
            error: median(&mut errors).unwrap_or(f64::INFINITY),
        }
    }
}

/// Every fourth pixel in both directions.
fn samples() -> impl Iterator<Item = (f64, f64)> {
    (0..HEIGHT).step_by(4).flat_map(|y| (0..WIDTH).step_by(4).map(move |x| (x as f64, y as f64)))
}
