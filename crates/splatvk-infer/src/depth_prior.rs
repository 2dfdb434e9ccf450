//! Depth priors of photos, from a network or a folder of files. Scale and shift are unknown;
//! `pose::stereo` of splatvk estimates them.
use std::path::Path;

use glam::DVec2;

use super::cache::OutputKey;
use super::contract::Part;
use super::graph::{Graph, GraphFile};
use super::installed::Installed;
use crate::format::npy;
use crate::photo::Photo;
use crate::progress::Progress;
use crate::scene::{DepthPrior, Image, PairPointmaps, Pointmap, PriorKind};
use crate::{Error, Result};

/// One prior per photo, at its working size, from a monocular depth network or a geometry network.
pub fn of_network(
    model: &Installed,
    photos: &[Photo],
    progress: &dyn Progress,
) -> Result<Vec<Option<DepthPrior>>> {
    let Ok(file) = model.graph(Part::Depth) else { return of_pointmaps(model, photos, progress) };
    let _turn = file.compute.turn();
    let prepared = super::prepare::inputs(file, "image", photos)?;
    let (role, kind) = output(file);
    let mut graph: Option<Graph> = None;
    progress.begin("depth prior", photos.len() as u64);
    let mut priors = Vec::with_capacity(photos.len());
    for (photo, ready) in photos.iter().zip(&prepared) {
        progress.check()?;
        let key = OutputKey::new("depth").model(file)?.values(&[ready.width as u64, ready.height as u64]);
        let values = file.compute.remember(key.values(&ready.data), || {
            let net = match graph.take() {
                Some(net) => net,
                None => file.load()?,
            };
            let tensor = graph.insert(net).run(vec![("image", ready.input())])?.take(role)?;
            let [_, height, width] = tensor.shape[..] else { return Ok(Vec::new()) };
            Ok([vec![width as f32, height as f32], tensor.data].concat())
        })?;
        let map = match &values[..] {
            [w, h, data @ ..] if !data.is_empty() && data.len() == (*w as usize) * (*h as usize) => {
                Image { width: *w as usize, height: *h as usize, data: data.to_vec() }
            }
            _ => return Err(Error::work(format!("{}: gave no depth map", file.path.display()))),
        };
        let map = with_horizon(map, kind);
        // The output covers the same part of the photo as the input and may be smaller.
        let shrunk = [map.width as f64 / ready.width as f64, map.height as f64 / ready.height as f64];
        let place = |p: DVec2| {
            let [u, v] = ready.from_photo.apply(p.to_array());
            DVec2::new(u * shrunk[0], v * shrunk[1])
        };
        priors.push(Some(DepthPrior { values: resampled(&map, photo, place), kind }));
        progress.step(priors.len() as u64, &photo.stem);
    }
    progress.end();
    Ok(priors)
}

/// Role and kind of the graph's output.
fn output(file: &GraphFile) -> (&'static str, PriorKind) {
    match file.has("depth") {
        true => ("depth", PriorKind::Depth),
        false => ("inverse_depth", PriorKind::InverseDepth),
    }
}

/// Lower limit of inverse depth, as a share of the largest: networks give 0 or slightly less for
/// the sky.
const HORIZON: f32 = 1e-4;

fn with_horizon(mut map: Image<f32>, kind: PriorKind) -> Image<f32> {
    if kind == PriorKind::InverseDepth {
        let least = HORIZON * map.data.iter().fold(0f32, |m, v| m.max(*v));
        map.data.iter_mut().for_each(|v| *v = v.max(least));
    }
    map
}

/// Depth of each photo from the pair with the largest confidence.
fn of_pointmaps(
    model: &Installed,
    photos: &[Photo],
    progress: &dyn Progress,
) -> Result<Vec<Option<DepthPrior>>> {
    let maps = super::pairs::pointmaps(model, photos, progress)?;
    let prior = |(view, photo): (usize, &Photo)| {
        let (seen, map) = (&maps.views[view], most_confident(&maps.pairs, view)?);
        let depth = map.points.iter().map(|p| p[2]).collect();
        let depth = Image { width: seen.width, height: seen.height, data: depth };
        let place = |p: DVec2| DVec2::from_array(seen.from_working.apply(p.to_array()));
        Some(DepthPrior { values: resampled(&depth, photo, place), kind: PriorKind::Depth })
    };
    Ok(photos.iter().enumerate().map(prior).collect())
}

/// Pointmap of a view in its own frame, from the pair with the largest confidence.
fn most_confident(pairs: &[PairPointmaps], view: usize) -> Option<&Pointmap> {
    let first = |p: &PairPointmaps| p.first == view;
    let of_view = pairs.iter().filter(|p| first(p) || p.second == view);
    let confidence = |m: &Pointmap| m.confidence.iter().map(|c| f64::from(*c)).sum::<f64>();
    of_view
        .map(|p| if first(p) { &p.x11 } else { &p.x22 })
        .max_by(|a, b| confidence(a).total_cmp(&confidence(b)))
}

/// File names of a photo's priors, behind its stem.
const FILES: [(&str, PriorKind); 2] =
    [("depth.npy", PriorKind::Depth), ("inverse_depth.npy", PriorKind::InverseDepth)];
/// Largest relative difference of the aspect ratios of a map and its photo: a pixel of a map 64
/// pixels high.
const ASPECT: f64 = 0.016;

/// The priors of a folder: per photo `<stem>_depth.npy` or `<stem>_inverse_depth.npy`, H × W floats
/// of the whole upright photo at any size; 0 or less, or not finite, is unknown. Photos without a
/// file have no prior.
pub fn of_folder(folder: &Path, photos: &[Photo]) -> Result<Vec<Option<DepthPrior>>> {
    let priors: Vec<Option<DepthPrior>> = photos.iter().map(|p| of_file(folder, p)).collect::<Result<_>>()?;
    if priors.iter().all(Option::is_none) {
        let stem = photos.first().map_or("photo", |p| &p.stem);
        return Err(Error::input(format!(
            "{}: no depth prior for any photo; name them as {stem}_depth.npy or {stem}_inverse_depth.npy",
            folder.display()
        )));
    }
    Ok(priors)
}

fn of_file(folder: &Path, photo: &Photo) -> Result<Option<DepthPrior>> {
    let found = FILES.map(|(name, kind)| (folder.join(format!("{}_{name}", photo.stem)), kind));
    let mut there = found.iter().filter(|(path, _)| path.exists());
    let Some((path, kind)) = there.next() else { return Ok(None) };
    if let Some((other, _)) = there.next() {
        let (a, b) = (path.display(), other.display());
        return Err(Error::input(format!("{a} and {b}: two priors of one photo; keep one of them")));
    }
    let array = npy::read(path)?;
    let (height, width) = match array.shape[..] {
        [height, width] if height > 0 && width > 0 => (height, width),
        _ => {
            return Err(Error::input(format!(
                "{}: shape {:?}; a depth prior is one H x W map of numbers",
                path.display(),
                array.shape
            )));
        }
    };
    let (w, h) = (f64::from(photo.original_size.0), f64::from(photo.original_size.1));
    if (width as f64 * h / (height as f64 * w) - 1.0).abs() > ASPECT {
        return Err(Error::input(format!(
            "{}: {width}x{height}, the photo is {w}x{h}; a depth prior has the aspect of its upright photo",
            path.display()
        )));
    }
    let data = array.to_f32();
    if data.len() != width * height || !data.iter().any(|v| v.is_finite() && *v > 0.0) {
        return Err(Error::input(format!(
            "{}: no number above 0; depth is camera z, inverse depth 1 / z, each up to scale and shift",
            path.display()
        )));
    }
    let map = Image { width, height, data };
    let back = photo.to_working.inverse();
    let place = |p: DVec2| {
        let [u, v] = back.apply(photo.source(p).to_array());
        DVec2::new(u * width as f64 / w, v * height as f64 / h)
    };
    Ok(Some(DepthPrior { values: resampled(&map, photo, place), kind: *kind }))
}

/// Resamples a map to the photo's working pixels; `place` gives their positions in the map.
/// Bilinear between known values, nearest beside unknown ones; 0 outside and where unknown.
fn resampled(map: &Image<f32>, photo: &Photo, place: impl Fn(DVec2) -> DVec2) -> Image<f32> {
    let (width, height) = (photo.image.width, photo.image.height);
    let pixel = |k: usize| DVec2::new((k % width) as f64 + 0.5, (k / width) as f64 + 0.5);
    let values = (0..width * height).map(|k| interpolate(map, place(pixel(k))));
    Image { width, height, data: values.collect() }
}

/// Value of a map at a position; 0 = unknown.
fn interpolate(map: &Image<f32>, p: DVec2) -> f32 {
    let (w, h) = (map.width as f64, map.height as f64);
    if p.x < 0.0 || p.y < 0.0 || p.x >= w || p.y >= h {
        return 0.0;
    }
    let known = |v: f32| if v.is_finite() && v > 0.0 { v } else { 0.0 };
    let (x, y) = ((p.x - 0.5).clamp(0.0, w - 1.0), (p.y - 0.5).clamp(0.0, h - 1.0));
    let (x0, y0) = (x as usize, y as usize);
    let (x1, y1) = ((x0 + 1).min(map.width - 1), (y0 + 1).min(map.height - 1));
    let four = [(x0, y0), (x1, y0), (x0, y1), (x1, y1)].map(|(x, y)| known(map.at(x, y)));
    if four.contains(&0.0) {
        return known(map.at(p.x as usize, p.y as usize));
    }
    let (fx, fy) = (x.fract() as f32, y.fract() as f32);
    let mix = |a: f32, b: f32, t: f32| a + t * (b - a);
    mix(mix(four[0], four[1], fx), mix(four[2], four[3], fx), fy)
}

#[cfg(test)]
mod tests {
    use super::super::Registry;
    use super::super::installed::Task;
    use super::*;
    use crate::format::npy::NpyArray;
    use crate::progress::Silent;
    use crate::scene::RgbImage;
    use splatvk_test_support::onnx::{Attribute, FLOAT, Onnx};
    use splatvk_test_support::toys::photo;

    /// Dark on the left, bright on the right.
    fn picture(stem: &str) -> Photo {
        let (width, height) = (56, 28);
        let data = (0..width * height).map(|k| [if k % width < width / 2 { 0.6 } else { 0.9 }; 3]).collect();
        photo(stem, RgbImage { width, height, data })
    }

    #[test]
    fn network_prior_kind_follows_adapter() {
        let dir = tempfile::tempdir().unwrap();
        let graph = Onnx::new()
            .input("pixel_values", FLOAT, "batch 3 height width")
            .output("predicted_depth", "batch height width")
            .node(
                "ReduceMean",
                "pixel_values",
                "predicted_depth",
                &[("axes", Attribute::Ints(&[1])), ("keepdims", Attribute::Int(0))],
            );
        graph.write(&dir.path().join("depth_anything_v2_small/model.onnx"));
        let prior = || {
            let model =
                Registry::of(&[dir.path()]).installed(Task::Depth, "depth_anything_v2_small").unwrap();
            of_network(&model, &[picture("a")], &Silent).unwrap().remove(0).unwrap()
        };
        let relative = prior();
        assert_eq!(
            (relative.kind, relative.values.width, relative.values.height),
            (PriorKind::InverseDepth, 56, 28)
        );
        let (left, right) = (relative.values.at(8, 14), relative.values.at(48, 14));
        // The mean over the channels of (value − mean) / deviation.
        let mean_input = |v: f32| {
            [(0.485, 0.229), (0.456, 0.224), (0.406, 0.225)].map(|(m, s)| (v - m) / s).iter().sum::<f32>()
                / 3.0
        };
        assert!(
            (left - mean_input(0.6)).abs() < 1e-3 && (right - mean_input(0.9)).abs() < 1e-3,
            "{left} {right}"
        );
        std::fs::write(dir.path().join("depth_anything_v2_small/adapter.toml"), "family = \"metric-depth\"")
            .unwrap();
        assert_eq!(prior().kind, PriorKind::Depth);
    }

    #[test]
    fn folder_priors_refuse_wrong_files() {
        let dir = tempfile::tempdir().unwrap();
        let photos = [picture("a"), picture("b")];
        let refused = |says: &str| {
            let error = of_folder(dir.path(), &photos).unwrap_err();
            let text = error.to_string();
            assert!(error.exit_code() == 2 && text.contains(says) && !text.contains('\n'), "{text}");
        };
        let put = |name: &str, shape: &[usize], data: Vec<f32>| {
            npy::write(dir.path().join(name), &NpyArray::f32(shape, data)).unwrap();
        };
        refused("a_depth.npy or a_inverse_depth.npy");
        put("a_depth.npy", &[1, 14, 28], vec![1.0; 392]);
        refused("one H x W map");
        put("a_depth.npy", &[14, 14], vec![1.0; 196]);
        refused("aspect");
        put("a_depth.npy", &[14, 28], vec![0.0; 392]);
        refused("no number above 0");
        // Half the photo's size; unknown in one corner.
        let map: Vec<f32> = (0..392).map(|k| if k == 0 { f32::NAN } else { 1.0 + (k % 28) as f32 }).collect();
        put("a_depth.npy", &[14, 28], map.clone());
        let read = of_folder(dir.path(), &photos).unwrap();
        assert!(read[1].is_none());
        let prior = read[0].as_ref().unwrap();
        assert_eq!((prior.kind, prior.values.at(0, 0)), (PriorKind::Depth, 0.0));
        // The centre of column 20 of 56 lies at 10.25 of 28, a quarter from the centre of column 10
        // to that of 9.
        assert!((prior.values.at(20, 14) - 10.75).abs() < 1e-4, "{}", prior.values.at(20, 14));
        put("a_inverse_depth.npy", &[14, 28], map);
        refused("two priors of one photo");
    }
}
