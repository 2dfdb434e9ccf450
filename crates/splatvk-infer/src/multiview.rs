//! Geometry networks that take all photos in one call (VGGT, Depth Anything 3, MapAnything): depth
//! and cameras, from which the pointmaps of every pair follow.
use glam::{DMat3, DQuat, DVec2, DVec3};

use super::best_pairs::BestPairs;
use super::cache::OutputKey;
use super::graph::{Graph, GraphFile, Outputs};
use super::prepare::Prepared;
use super::runtime::Input;
use crate::photo::Photo;
use crate::progress::Progress;
use crate::scene::{Camera, PairPointmaps, Pointmap, Pointmaps, Pose};
use crate::{Error, Result};

/// Answer of a network for a list of photos.
pub(super) struct Estimate {
    /// One per photo, at the size of the input; world and unit are the network's.
    pub cameras: Vec<Camera>,
    /// [N, H, W] camera z.
    pub depth: Vec<f32>,
    /// [N, H, W] on the network's own scale.
    pub confidence: Vec<f32>,
}

impl Estimate {
    /// Depth of one photo, [H, W].
    pub fn depth_of(&self, view: usize) -> &[f32] {
        let pixels = self.depth.len() / self.cameras.len().max(1);
        &self.depth[view * pixels..(view + 1) * pixels]
    }
}

pub(super) fn pointmaps(graph: &GraphFile, photos: &[Photo], progress: &dyn Progress) -> Result<Pointmaps> {
    let count = photos.len();
    if let Some(n) = graph.fixed("images", "N").filter(|n| *n != count) {
        return Err(Error::input(format!(
            "{}: was exported for {n} photos, here are {count}; use --views {n} or export it with a free number",
            graph.path.display()
        )));
    }
    progress.begin("pointmaps", 1);
    let prepared = same_size(graph, photos)?;
    let views = super::prepare::views(photos, &prepared, progress);
    let (width, height) = prepared.first().map_or((0, 0), |p| (p.width, p.height));
    let mut key = OutputKey::new("views").model(graph)?.values(&[width as u64, height as u64]);
    for p in &prepared {
        key = key.values(&p.data);
    }
    let pixels = width * height;
    let values = graph.compute.remember(key, || forward(&mut graph.load()?, &prepared))?;
    let mut found = estimate(graph, &prepared, &values)?;
    for (camera, view) in found.cameras.iter_mut().zip(&views) {
        camera.name.clone_from(&view.name);
    }
    let Estimate { cameras, depth, confidence } = found;
    let worlds: Vec<Vec<DVec3>> = cameras
        .iter()
        .zip(depth.chunks_exact(pixels))
        .map(|(camera, depth)| {
            let unproject = |(p, z): (usize, &f32)| {
                let pixel = DVec2::new((p % width) as f64 + 0.5, (p / width) as f64 + 0.5);
                camera.unproject(pixel, f64::from(*z))
            };
            depth.iter().enumerate().map(unproject).collect()
        })
        .collect();
    // The alignment expects confidences from 1 on; a scale that starts below is shifted.
    let lift = 1.0 - confidence.iter().fold(1f32, |least, c| least.min(*c));
    let pointmap = |seen: usize, by: usize| Pointmap {
        points: worlds[seen].iter().map(|x| cameras[by].pose.transform(*x).as_vec3().to_array()).collect(),
        confidence: confidence[seen * pixels..(seen + 1) * pixels].iter().map(|c| c + lift).collect(),
    };
    let mut pairs = BestPairs::new(&views);
    for (i, j) in (0..count).flat_map(|i| (i + 1..count).map(move |j| (i, j))) {
        progress.check()?;
        pairs.add(PairPointmaps {
            first: i,
            second: j,
            x11: pointmap(i, i),
            x21: pointmap(j, i),
            x22: pointmap(j, j),
            x12: pointmap(i, j),
            descriptors: None,
        });
    }
    let pairs = pairs.finish();
    progress.end();
    let confidence_floor = graph.binding.confidence_floor.map(|c| c + f64::from(lift));
    Ok(Pointmaps { views, pairs, cameras, confidence_floor })
}

/// Runs the network on a list of photos: 16 values per camera, then all depth, then all confidence.
pub(super) fn forward(graph: &mut Graph, prepared: &[Prepared]) -> Result<Vec<f32>> {
    let count = prepared.len();
    let (width, height) = prepared.first().map_or((0, 0), |p| (p.width, p.height));
    let data = prepared.iter().flat_map(|p| p.data.iter().copied()).collect();
    let mut outputs = graph.run(vec![("images", Input::F32(vec![1, count, 3, height, width], data))])?;
    let mut all = cameras(&mut outputs, &graph.file, count, (width, height))?;
    all.extend(outputs.take("depth")?.data);
    all.extend(outputs.take("confidence")?.data);
    Ok(all)
}

/// Splits the values of [`forward`].
pub(super) fn estimate(graph: &GraphFile, prepared: &[Prepared], values: &[f32]) -> Result<Estimate> {
    let count = prepared.len();
    let (width, height) = prepared.first().map_or((0, 0), |p| (p.width, p.height));
    let pixels = width * height;
    let (cameras, maps) = values.split_at_checked(16 * count).unwrap_or_default();
    let cameras: Vec<Camera> = cameras.chunks_exact(16).map(|c| camera(c, width, height)).collect();
    let (depth, confidence) = maps.split_at_checked(pixels * count).unwrap_or_default();
    if confidence.len() != pixels * count || cameras.len() != count {
        return Err(Error::work(format!(
            "{}: its depth does not have the size of its input",
            graph.path.display()
        )));
    }
    Ok(Estimate { cameras, depth: depth.to_vec(), confidence: confidence.to_vec() })
}

/// Preprocesses all photos; sizes must be equal, since they share a tensor.
pub(super) fn same_size(graph: &GraphFile, photos: &[Photo]) -> Result<Vec<Prepared>> {
    let mut prepared = super::prepare::inputs(graph, "images", photos)?;
    let Some((width, height)) = prepared.first().map(|p| (p.width, p.height)) else { return Ok(prepared) };
    for (ready, photo) in prepared.iter_mut().zip(photos) {
        if (ready.width, ready.height) != (width, height) {
            return Err(Error::input(format!(
                "{}: photos of different shapes ({} is {}×{} for the network, the first {width}×{height}); this network \
                 takes photos of one aspect",
                graph.path.display(),
                photo.stem,
                ready.width,
                ready.height
            )));
        }
    }
    Ok(prepared)
}

/// Per photo 16 values: rotation world → camera (row by row), translation, fx, fy, cx, cy.
fn cameras(outputs: &mut Outputs, graph: &GraphFile, count: usize, size: (usize, usize)) -> Result<Vec<f32>> {
    let (w, h) = (size.0 as f32, size.1 as f32);
    let mut all = Vec::with_capacity(16 * count);
    if let Some(code) = outputs.maybe("pose_code") {
        for c in code.data.chunks_exact(9) {
            let q = DQuat::from_xyzw(c[3].into(), c[4].into(), c[5].into(), c[6].into()).normalize();
            let rows = DMat3::from_quat(q).transpose();
            all.extend(rows.to_cols_array().map(|v| v as f32));
            all.extend_from_slice(&c[..3]);
            all.extend([0.5 * w / (0.5 * c[8]).tan(), 0.5 * h / (0.5 * c[7]).tan(), 0.5 * w, 0.5 * h]);
        }
    } else {
        let (pose, intrinsics) = (outputs.take("extrinsics")?, outputs.take("intrinsics")?);
        let stride = pose.data.len() / count.max(1);
        for (p, k) in pose.data.chunks_exact(stride.max(12)).zip(intrinsics.data.chunks_exact(9)) {
            all.extend((0..3).flat_map(|r| p[4 * r..4 * r + 3].to_vec()));
            all.extend([p[3], p[7], p[11]]);
            let offset = (0.5 - graph.binding.pixel_centre) as f32;
            all.extend([k[0], k[4], k[2] + offset, k[5] + offset]);
        }
    }
    if all.len() != 16 * count || all.iter().any(|v| !v.is_finite()) {
        return Err(Error::work(format!("{}: its cameras are not usable", graph.path.display())));
    }
    Ok(all)
}

fn camera(c: &[f32], width: usize, height: usize) -> Camera {
    let v = |k: usize| f64::from(c[k]);
    let rows = DMat3::from_cols(
        DVec3::new(v(0), v(1), v(2)),
        DVec3::new(v(3), v(4), v(5)),
        DVec3::new(v(6), v(7), v(8)),
    );
    let pose = Pose { rotation: rows.transpose(), translation: DVec3::new(v(9), v(10), v(11)) };
    Camera {
        name: String::new(),
        width: width as u32,
        height: height as u32,
        fx: v(12),
        fy: v(13),
        cx: v(14),
        cy: v(15),
        pose,
    }
}
