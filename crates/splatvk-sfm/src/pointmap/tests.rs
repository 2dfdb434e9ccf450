mod equations;
mod many;
mod network;

use super::*;
use crate::align::{PoseErrors, pose_errors};
use crate::math::Random;
use crate::numeric::rotation_angle;
use crate::progress::Silent;
use crate::scene::{Affine, Camera, Pointmap};
use crate::testing::{self, Truth};
use glam::{DVec2, DVec3};

/// Errors of the simulated pointmaps and matches.
#[derive(Clone, Copy)]
struct Faults {
    depth: f64,
    pixels: f64,
    outliers: f64,
    /// σ of ln scale of a decoding.
    scale: f64,
}

const FAULTS: Faults = Faults { depth: 0.01, pixels: 1.0, outliers: 0.2, scale: 0.7 };

struct Case {
    views: Vec<ModelView>,
    /// Model resolution.
    cameras: Vec<Camera>,
    depths: Vec<Vec<f64>>,
}

/// The breakfast views as input of a network of half their resolution.
fn case() -> (Case, Truth) {
    let truth = testing::train(&testing::folder());
    let (mut views, mut cameras, mut depths) = (Vec::new(), Vec::new(), Vec::new());
    for (p, c) in truth.photos.iter().zip(&truth.cameras) {
        let (w, h) = (p.image.width / 2, p.image.height / 2);
        let full = testing::depth(&truth.folder, &p.stem);
        let width = p.image.width;
        // The centre of a model pixel is the corner of four photo pixels; inverse depth is linear
        // on planes.
        let mean_depth = |k: usize| {
            let i = k / w * 2 * width + k % w * 2;
            4.0 / [i, i + 1, i + width, i + width + 1].iter().map(|i| 1.0 / full[*i] as f64).sum::<f64>()
        };
        depths.push((0..w * h).map(mean_depth).collect());
        cameras.push(c.resized(w as u32, h as u32));
        views.push(ModelView {
            name: p.stem.clone(),
            image: p.image.clone(),
            width: w,
            height: h,
            from_working: Affine::resize((width as u32, p.image.height as u32), (w as u32, h as u32)),
            exif_focal: None,
            camera_group: 0,
        });
    }
    (Case { views, cameras, depths }, truth)
}

impl Case {
    fn world(&self, v: usize, k: usize, stretch: f64) -> DVec3 {
        let w = self.views[v].width;
        let p = DVec2::new((k % w) as f64 + 0.5, (k / w) as f64 + 0.5);
        self.cameras[v].unproject(p, self.depths[v][k] * stretch)
    }

    /// Pixels of `v` as points in camera `frame`, scaled, with depth noise.
    fn map(&self, v: usize, frame: usize, scale: f64, noise: f64, rng: &mut Random) -> Pointmap {
        let n = self.depths[v].len();
        let points = (0..n)
            .map(|k| {
                let x = self.cameras[frame].pose.transform(self.world(v, k, 1.0 + noise * rng.normal()));
                (x * scale).as_vec3().to_array()
            })
            .collect();
        Pointmap { points, confidence: (0..n).map(|_| 4.0 + 4.0 * rng.uniform() as f32).collect() }
    }

    fn pair(&self, i: usize, j: usize, f: Faults, rng: &mut Random) -> (PairPointmaps, PairMatches) {
        let mut scale = || (f.scale * rng.normal()).exp();
        let (s, t) = (scale(), scale());
        let pair = PairPointmaps {
            first: i,
            second: j,
            x11: self.map(i, i, s, f.depth, rng),
            x21: self.map(j, i, s, f.depth, rng),
            x22: self.map(j, j, t, f.depth, rng),
            x12: self.map(i, j, t, f.depth, rng),
            descriptors: None,
        };
        let (w, h) = (self.views[j].width, self.views[j].height);
        let mut matches = Vec::new();
        while matches.len() < 1500 {
            let k = rng.below(self.depths[i].len());
            let p = DVec2::new((k % w) as f64 + 0.5, (k / w) as f64 + 0.5);
            if rng.uniform() < f.outliers {
                let q = DVec2::new(rng.uniform() * w as f64, rng.uniform() * h as f64);
                matches.push(PixelMatch { a: p, b: q, weight: 1.0 });
                continue;
            }
            let (q, z) = self.cameras[j].project(self.world(i, k, 1.0));
            let inside = q.x >= 2.0 && q.y >= 2.0 && q.x < w as f64 - 2.0 && q.y < h as f64 - 2.0;
            if inside && (self.depths[j][q.y as usize * w + q.x as usize] / z - 1.0).abs() < 0.01 {
                let q = q + DVec2::new(rng.normal(), rng.normal()) * f.pixels;
                matches.push(PixelMatch { a: p, b: q, weight: 1.0 });
            }
        }
        (pair, PairMatches { matches })
    }

    fn input(&self, f: Faults) -> (Vec<PairPointmaps>, Vec<PairMatches>) {
        let mut rng = Random::new(12);
        let n = self.views.len();
        (0..n)
            .flat_map(|i| (i + 1..n).map(move |j| (i, j)))
            .map(|(i, j)| self.pair(i, j, f, &mut rng))
            .unzip()
    }
}

/// Pointmaps as a network returns them.
fn network_output(views: &[ModelView], pairs: &[PairPointmaps]) -> Pointmaps {
    Pointmaps { views: views.to_vec(), pairs: pairs.to_vec(), ..Pointmaps::default() }
}

/// Cameras for all views.
fn aligned(views: &[ModelView], pairs: &[PairPointmaps], matches: &[PairMatches]) -> Geometry {
    let found = align(network_output(views, pairs), matches.to_vec(), 0, &Silent).unwrap();
    assert!(found.left_out.is_empty());
    found.geometry
}

fn errors(g: &Geometry, truth: &Truth) -> PoseErrors {
    pose_errors(&g.cameras, &truth.cameras, truth.mean_depth)
}

#[test]
fn align_recovers_cameras_from_noisy_pointmaps() {
    let (case, truth) = case();
    let (pairs, matches) = case.input(FAULTS);
    let start = std::time::Instant::now();
    let g = aligned(&case.views, &pairs, &matches);
    let e = errors(&g, &truth);
    println!(
        "rotation {:.3?}° centre {:.3?} focal {:.4} ± {:.4}, {} points, {:.1} s",
        e.rotation_degrees,
        e.centre,
        e.focal[0],
        g.focal_log_sigma.unwrap(),
        g.points.len(),
        start.elapsed().as_secs_f64()
    );
    assert!(e.rotation_degrees.iter().all(|v| *v < 0.1), "{:?}", e.rotation_degrees);
    assert!(e.centre.iter().all(|v| *v < 0.005), "{:?}", e.centre);
    assert!(e.focal.iter().all(|v| *v < 0.01), "{:?}", e.focal);
    for (v, d) in g.depths.iter().enumerate() {
        let full = testing::depth(&truth.folder, &case.views[v].name);
        let mut errors: Vec<f64> = d
            .depth
            .data
            .iter()
            .zip(&full)
            .filter(|(z, _)| **z > 0.0)
            .map(|(z, t)| (*z as f64 * e.similarity.scale / *t as f64 - 1.0).abs())
            .collect();
        assert!(errors.len() * 10 > full.len() * 4, "view {v}: {} of {}", errors.len(), full.len());
        let middle = crate::math::median(&mut errors).unwrap();
        assert!(middle < 0.01, "view {v}: {middle}");
    }
    assert!(g.points.len() > 30_000, "{}", g.points.len());
}

/// Largest difference between two reconstructions of the same views in the same order: angle,
/// centre, ln f.
fn difference(a: &[Camera], b: &[Camera]) -> f64 {
    let relative = |c: &[Camera], v: usize| c[v].pose.compose(&c[0].pose.inverse());
    let unit = |c: &[Camera]| relative(c, 1).translation.length();
    (0..a.len())
        .map(|v| {
            let (p, q) = (relative(a, v), relative(b, v));
            let turn = rotation_angle(&(p.rotation * q.rotation.transpose()));
            let shift = (p.translation / unit(a) - q.translation / unit(b)).length();
            turn.max(shift).max((a[v].fx / b[v].fx).ln().abs())
        })
        .fold(0.0, f64::max)
}

#[test]
#[ignore = "takes long: tools/test-long"]
fn align_invariant_to_order_and_scale() {
    let (mut case, _) = case();
    // Three views keep the three solutions short.
    case.views.truncate(3);
    let (pairs, matches) = case.input(FAULTS);
    let base = aligned(&case.views, &pairs, &matches);
    let mut scaled = pairs.clone();
    // A power of two, so that f32 storage itself changes nothing.
    let pair = &mut scaled[1];
    for m in [&mut pair.x11, &mut pair.x21] {
        m.points.iter_mut().flatten().for_each(|v| *v *= 4.0);
    }
    let g = aligned(&case.views, &scaled, &matches);
    assert!(difference(&base.cameras, &g.cameras) < 1e-6, "{}", difference(&base.cameras, &g.cameras));
    // View k becomes view order[k].
    let order = [2usize, 0, 1];
    let mut views = case.views.clone();
    for (k, v) in case.views.iter().enumerate() {
        views[order[k]] = v.clone();
    }
    let renamed: Vec<PairPointmaps> = pairs
        .iter()
        .map(|p| PairPointmaps { first: order[p.first], second: order[p.second], ..p.clone() })
        .collect();
    let g = aligned(&views, &renamed, &matches);
    let back: Vec<Camera> = order.iter().map(|k| g.cameras[*k].clone()).collect();
    let d = difference(&base.cameras, &back);
    println!("permuted: {d:e}");
    assert!(d < 1e-6, "{d}");
}

#[test]
fn of_pair_without_descriptors_matches_points() {
    let (case, _) = case();
    let mut rng = Random::new(3);
    let exact = Faults { depth: 0.0, pixels: 0.0, outliers: 0.0, scale: 0.7 };
    let (pair, _) = case.pair(0, 1, exact, &mut rng);
    let found = matches::of_pair(&case.views[0], &case.views[1], &pair);
    assert!(found.matches.len() > 400, "{}", found.matches.len());
    let w = case.views[0].width;
    let mut errors: Vec<f64> = found
        .matches
        .iter()
        .map(|m| {
            let x = case.world(0, m.a.y as usize * w + m.a.x as usize, 1.0);
            (case.cameras[1].project(x).0 - m.b).length()
        })
        .collect();
    // Nearest pixels are up to 0.71 px off by rounding.
    assert!(crate::math::median(&mut errors).unwrap() < 0.75);
}

#[test]
fn align_rejects_views_without_geometry() {
    let (case, _) = case();
    let (pairs, matches) = case.input(FAULTS);
    // Two disjoint pairs: 0–1 and 2–3.
    let keep = [0usize, 5];
    let (p, m) =
        keep.iter().map(|k| (pairs[*k].clone(), matches[*k].clone())).unzip::<_, _, Vec<_>, Vec<_>>();
    let error = align(network_output(&case.views, &p), m, 0, &Silent).unwrap_err();
    assert!(error.exit_code() == 2 && error.to_string().contains("train_00–train_02"), "{error}");
    // Identical photos: every map in the same frame.
    let mut rng = Random::new(5);
    let twin =
        Case { cameras: vec![case.cameras[0].clone(); 2], depths: vec![case.depths[0].clone(); 2], ..case };
    let (p, m) = twin.pair(0, 1, FAULTS, &mut rng);
    let error = align(network_output(&twin.views[..2], &[p]), vec![m], 0, &Silent).unwrap_err();
    assert!(error.exit_code() == 2 && error.to_string().contains("no parallax"), "{error}");
    // A map of the wrong size.
    let (mut p, m) = twin.pair(0, 1, FAULTS, &mut rng);
    p.x21.points.pop();
    assert!(
        align(network_output(&twin.views[..2], &[p]), vec![m], 0, &Silent)
            .unwrap_err()
            .to_string()
            .contains("wrong model output")
    );
}
