//! Step G: filtered depth maps at working resolution, and points without duplicates.
use super::adjust::Adjustment;
use super::canonical::Canonical;
use crate::Geometry;
use crate::math::quantile;
use crate::scene::{Camera, DepthMap, Image, ModelView, PointCloud, Pointmaps};
use glam::DVec2;

/// A less confident point this much before another surface is a floater; depth noise is about as
/// large.
const CLEAN_TOLERANCE: f64 = 0.005;
/// A larger relative jump to a neighbour is an occlusion edge: the network interpolates across it.
const EDGE_JUMP: f64 = 0.06;
/// Points of two views closer than this in depth are the same point.
const SAME_DEPTH: f64 = 0.01;
/// Share of least confident pixels that give no points, at any scale of the confidence.
const UNUSED_SHARE: f64 = 0.2;

/// Confidence below which a pixel has no depth; that of the least confident point is 1. The sky has
/// any depth.
const LEAST_DEPTH: f64 = 0.5;

/// Depth and confidence of one view at model resolution.
struct Layer {
    camera: Camera,
    depth: Vec<f64>,
    confidence: Vec<f64>,
}

pub(super) fn output(maps: &Pointmaps, canonical: &[Canonical], a: &Adjustment) -> Geometry {
    let views = &maps.views;
    let mut layers: Vec<Layer> = (0..views.len()).map(|v| layer(&views[v], &canonical[v], a, v)).collect();
    remove_floaters(&mut layers, &paired_views(maps));
    for l in &mut layers {
        mask_edges(l);
    }
    // The canonical confidence starts at 0.
    let least = least_confidence(&layers, maps.confidence_floor.map(|c| c - 1.0));
    // From here on the least confident point has confidence 1, at any scale of the network.
    layers.iter_mut().flat_map(|l| &mut l.confidence).for_each(|c| *c /= least);
    let depths = views.iter().zip(&layers).map(|(v, l)| to_working_size(v, l)).collect();
    let cameras = (0..views.len()).map(|v| views[v].working_camera(a.focal(v), &a.state.poses[v])).collect();
    Geometry {
        cameras,
        depths,
        points: fuse(views, &layers),
        focal_log_sigma: Some(a.focal_log_sigma),
        fitted: Vec::new(),
        sky: Vec::new(),
        method: "pointmap".into(),
    }
}

fn layer(view: &ModelView, c: &Canonical, a: &Adjustment, index: usize) -> Layer {
    let principal_point = view.centre();
    let f = a.focal(index);
    let depth = (0..view.width * view.height)
        .map(|k| {
            let p = DVec2::new((k % view.width) as f64 + 0.5, (k / view.width) as f64 + 0.5);
            c.points[k].z.max(0.0) * a.log_correction(index, p).exp()
        })
        .collect();
    Layer {
        camera: Camera {
            name: view.name.clone(),
            width: view.width as u32,
            height: view.height as u32,
            fx: f,
            fy: f,
            cx: principal_point.x,
            cy: principal_point.y,
            pose: a.state.poses[index],
        },
        depth,
        confidence: c.confidence.clone(),
    }
}

impl Layer {
    fn width(&self) -> usize {
        self.camera.width as usize
    }
    fn unproject(&self, k: usize) -> glam::DVec3 {
        let p = DVec2::new((k % self.width()) as f64 + 0.5, (k / self.width()) as f64 + 0.5);
        self.camera.unproject(p, self.depth[k])
    }
    /// Pixel index and depth of a world point, if it projects into the view.
    fn project(&self, world: glam::DVec3) -> Option<(usize, f64)> {
        let (p, z) = self.camera.project(world);
        let inside = z > 0.0
            && p.x >= 0.0
            && p.y >= 0.0
            && p.x < self.camera.width as f64
            && p.y < self.camera.height as f64;
        inside.then(|| (p.y as usize * self.width() + p.x as usize, z))
    }
}

/// Views that share a pair with each view: those of large overlap.
fn paired_views(maps: &Pointmaps) -> Vec<Vec<usize>> {
    let mut all = vec![Vec::new(); maps.views.len()];
    for pair in &maps.pairs {
        all[pair.first].push(pair.second);
        all[pair.second].push(pair.first);
    }
    all
}

/// Removes points in front of a more confident surface of a view of their pairs.
fn remove_floaters(layers: &mut [Layer], partners: &[Vec<usize>]) {
    let removed: Vec<Vec<usize>> = (0..layers.len())
        .map(|i| {
            let l = &layers[i];
            (0..l.depth.len())
                .filter(|&k| l.depth[k] > 0.0)
                .filter(|&k| {
                    let x = l.unproject(k);
                    partners[i].iter().map(|j| &layers[*j]).any(|other| {
                        other.project(x).is_some_and(|(m, z)| {
                            z < (1.0 - CLEAN_TOLERANCE) * other.depth[m]
                                && l.confidence[k] < other.confidence[m]
                        })
                    })
                })
                .collect()
        })
        .collect();
    for (l, r) in layers.iter_mut().zip(removed) {
        for k in r {
            l.confidence[k] = 0.0;
        }
    }
}

fn mask_edges(l: &mut Layer) {
    let (w, h) = (l.width(), l.camera.height as usize);
    let edges: Vec<usize> = (0..w * h)
        .filter(|&k| {
            let (x, y, z) = (k % w, k / w, l.depth[k]);
            (x > 0 && is_jump(z, l.depth[k - 1]))
                || (x + 1 < w && is_jump(z, l.depth[k + 1]))
                || (y > 0 && is_jump(z, l.depth[k - w]))
                || (y + 1 < h && is_jump(z, l.depth[k + w]))
        })
        .collect();
    for k in edges {
        l.confidence[k] = 0.0;
    }
}

fn is_jump(a: f64, b: f64) -> bool {
    a > 0.0 && b > 0.0 && (a - b).abs() > EDGE_JUMP * a.min(b)
}

/// Depth at working size: bilinear within a surface, nearest across edges, 0 outside the crop.
fn to_working_size(view: &ModelView, l: &Layer) -> DepthMap {
    let (w, h) = (view.image.width, view.image.height);
    let mut out = DepthMap { depth: Image::filled(w, h, 0f32), confidence: Image::filled(w, h, 0f32) };
    for y in 0..h {
        for x in 0..w {
            let [u, v] = view.from_working.apply([x as f64 + 0.5, y as f64 + 0.5]);
            let (mw, mh) = (view.width, view.height);
            if u < 0.0 || v < 0.0 || u >= mw as f64 || v >= mh as f64 {
                continue;
            }
            let nearest = v as usize * mw + u as usize;
            let (a, b) = ((u - 0.5).max(0.0), (v - 0.5).max(0.0));
            let (i, j) = ((a as usize).min(mw.saturating_sub(2)), (b as usize).min(mh.saturating_sub(2)));
            let (fx, fy) = ((a - i as f64).min(1.0), (b - j as f64).min(1.0));
            let mut z = l.depth[nearest];
            if mw > 1 && mh > 1 {
                let k = [j * mw + i, j * mw + i + 1, (j + 1) * mw + i, (j + 1) * mw + i + 1];
                let wt = [(1.0 - fx) * (1.0 - fy), fx * (1.0 - fy), (1.0 - fx) * fy, fx * fy];
                if k.iter().all(|&k| (l.depth[k] - z).abs() < EDGE_JUMP * z) {
                    z = k.iter().zip(wt).map(|(&k, w)| w * l.depth[k]).sum();
                }
            }
            if l.confidence[nearest] >= LEAST_DEPTH && z > 0.0 {
                out.depth.data[y * w + x] = z as f32;
                out.confidence.data[y * w + x] = l.confidence[nearest] as f32;
            }
        }
    }
    out
}

/// Least confidence of a point: the quantile [`UNUSED_SHARE`] or the floor, whichever is larger.
fn least_confidence(layers: &[Layer], floor: Option<f64>) -> f64 {
    let mut all: Vec<f64> =
        layers.iter().flat_map(|l| l.confidence.iter().copied()).filter(|c| *c > 0.0).collect();
    let least = quantile(&mut all, UNUSED_SHARE).unwrap_or(1.0);
    floor.map_or(least, |f| least.max(f))
}

/// Points of confidence 1 and above; pixels that a kept point of another view covers are skipped.
fn fuse(views: &[ModelView], layers: &[Layer]) -> PointCloud {
    let mut order: Vec<usize> = (0..layers.len()).collect();
    order
        .sort_by(|a, b| mean_confidence(&layers[*b]).total_cmp(&mean_confidence(&layers[*a])).then(a.cmp(b)));
    let mut covered: Vec<Vec<bool>> = layers.iter().map(|l| vec![false; l.depth.len()]).collect();
    let mut cloud = PointCloud::default();
    for v in order {
        let (l, view) = (&layers[v], &views[v]);
        let back = view.from_working.inverse();
        for k in 0..l.depth.len() {
            if l.confidence[k] < 1.0 || l.depth[k] <= 0.0 || covered[v][k] {
                continue;
            }
            let world = l.unproject(k);
            for (j, other) in layers.iter().enumerate().filter(|(j, _)| *j != v) {
                if let Some((m, z)) = other.project(world) {
                    covered[j][m] |= (z - other.depth[m]).abs() < SAME_DEPTH * z;
                }
            }
            let [x, y] = back.apply([(k % view.width) as f64 + 0.5, (k / view.width) as f64 + 0.5]);
            let x = (x.max(0.0) as usize).min(view.image.width - 1);
            let y = (y.max(0.0) as usize).min(view.image.height - 1);
            cloud.positions.push(world.as_vec3().to_array());
            cloud.colours.push(view.image.at(x, y));
            cloud.confidence.push(l.confidence[k] as f32);
            cloud.view.push(v as u32);
            cloud.radius.push((l.depth[k] / l.camera.fx) as f32);
        }
    }
    cloud
}

fn mean_confidence(l: &Layer) -> f64 {
    l.confidence.iter().sum::<f64>() / l.confidence.len().max(1) as f64
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::Pose;

    #[test]
    fn remove_floaters_before_confident_surface() {
        let (name, pose) = (String::new(), Pose::IDENTITY);
        let camera = Camera { name, width: 4, height: 3, fx: 4.0, fy: 4.0, cx: 2.0, cy: 1.5, pose };
        let layer = |confidence: f64| Layer {
            camera: camera.clone(),
            depth: vec![4.0; 12],
            confidence: vec![confidence; 12],
        };
        let mut layers = [layer(1.0), layer(5.0)];
        // Before the other view's surface, within the noise of that, and behind it.
        layers[0].depth[5..8].copy_from_slice(&[2.0, 3.99, 5.0]);
        remove_floaters(&mut layers, &[vec![1], vec![0]]);
        let removed: Vec<usize> = (0..12).filter(|k| layers[0].confidence[*k] == 0.0).collect();
        assert_eq!(removed, [5]);
        assert_eq!(layers[1].confidence, [5.0; 12], "it is before another surface itself, but surer");
    }
}
