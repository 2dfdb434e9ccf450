//! Geometry networks: DUSt3R and MASt3R take two photos at a time, VGGT and similar ones all
//! photos. Both give pointmaps of pairs ([`PairPointmaps`]), which `pose::pointmap` of splatvk
//! aligns.
use super::best_pairs::BestPairs;
use super::cache::OutputKey;
use super::contract::Part;
use super::graph::{Graph, GraphFile, Outputs};
use super::installed::Installed;
use super::prepare::{Prepared, inputs, views};
use super::runtime::{Input, Tensor};
use crate::math::median;
use crate::photo::Photo;
use crate::progress::Progress;
use crate::scene::{Descriptors, PairPointmaps, Pointmap, Pointmaps};
use crate::{Error, Result};

/// Pointmaps of pairs of photos, for `pose::pointmap::reconstruct` of splatvk: all pairs of up to
/// four photos, of more those with the largest overlap.
pub fn pointmaps(model: &Installed, photos: &[Photo], progress: &dyn Progress) -> Result<Pointmaps> {
    if let Ok(graph) = model.graph(Part::MultiView) {
        let _turn = graph.compute.turn();
        return super::multiview::pointmaps(graph, photos, progress);
    }
    let prepared = inputs_of(model, photos)?;
    let views = views(photos, &prepared, progress);
    let mut pairs = BestPairs::new(&views);
    decode_all(model, &prepared, progress, |pair| pairs.add(pair))?;
    let pairs = pairs.finish();
    let graph = model.graph(Part::Pair).or_else(|_| model.graph(Part::PairDecoder))?;
    Ok(Pointmaps { views, pairs, cameras: Vec::new(), confidence_floor: graph.binding.confidence_floor })
}

/// The photos as inputs of a pair network.
pub(super) fn inputs_of(model: &Installed, photos: &[Photo]) -> Result<Vec<Prepared>> {
    match model.graph(Part::Pair) {
        Ok(graph) => inputs(graph, "image1", photos),
        Err(_) => inputs(model.graph(Part::PairEncoder)?, "image", photos),
    }
}

/// Runs a pair network on every pair of photos in both orders and passes the pairs to `take`.
pub(super) fn decode_all(
    model: &Installed,
    prepared: &[Prepared],
    progress: &dyn Progress,
    mut take: impl FnMut(PairPointmaps),
) -> Result<()> {
    let compute = model.compute();
    let _turn = compute.turn();
    let count = prepared.len();
    let mut network = Network::new(model, prepared);
    let mut check = OutputCheck { model, compared: 0, swapped: 0 };
    let ordered = (count * count.saturating_sub(1)) as u64;
    progress.begin("pointmaps", ordered);
    let mut done = 0;
    for i in 0..count {
        for j in i + 1..count {
            let mut decode = |a: usize, b: usize| {
                progress.check()?;
                let decoded = network.decode(a, b)?;
                done += 1;
                progress.step(done, "");
                Ok::<_, Error>(decoded)
            };
            let (one, two) = (decode(i, j)?, decode(j, i)?);
            let ([d11, d21], [d22, d12]) = (one.descriptors, two.descriptors);
            let descriptors = match (d11, d21, d12, d22) {
                (Some(a), Some(b), Some(c), Some(d)) => Some([a, b, c, d]),
                _ => None,
            };
            let ([x11, x21], [x22, x12]) = (one.maps, two.maps);
            let pair = PairPointmaps { first: i, second: j, x11, x21, x22, x12, descriptors };
            if !model.untrained() {
                check.add(&pair, [&prepared[i], &prepared[j]])?;
            }
            take(pair);
        }
    }
    progress.end();
    check.finish()
}

/// One decoding: first and second view, both in the first camera.
struct Decoded {
    maps: [Pointmap; 2],
    descriptors: [Option<Descriptors>; 2],
}

/// A pair network of one or two graphs; loaded when an output is not in the cache.
struct Network<'a> {
    model: &'a Installed,
    prepared: &'a [Prepared],
    graph: Option<Graph>,
    tokens: Vec<Option<Tensor>>,
}

impl<'a> Network<'a> {
    fn new(model: &'a Installed, prepared: &'a [Prepared]) -> Self {
        Network { model, prepared, graph: None, tokens: vec![None; prepared.len()] }
    }

    fn decode(&mut self, i: usize, j: usize) -> Result<Decoded> {
        let (a, b) = (&self.prepared[i], &self.prepared[j]);
        let mut key =
            OutputKey::new("pair").values(&[a.width, a.height, b.width, b.height].map(|n| n as u64));
        for graph in self.model.graphs.values() {
            key = key.model(graph)?;
        }
        let key = key.values(&a.data).values(&b.data);
        let values = self.model.compute().remember(key, || pack(self.forward(i, j)?))?;
        unpack(&values, [a, b]).ok_or_else(|| {
            let size = format!("{}×{} and {}×{}", a.width, a.height, b.width, b.height);
            Error::work(format!(
                "model {}: its pointmaps do not have the size of its input ({size})",
                self.model.name
            ))
        })
    }

    fn forward(&mut self, i: usize, j: usize) -> Result<Outputs> {
        if let Ok(file) = self.model.graph(Part::Pair) {
            let graph = loaded(&mut self.graph, file)?;
            let (a, b) = (&self.prepared[i], &self.prepared[j]);
            return graph.run(vec![
                ("image1", a.input()),
                ("image2", b.input()),
                ("shape1", true_shape(a)),
                ("shape2", true_shape(b)),
            ]);
        }
        self.encode_all()?;
        let file = self.model.graph(Part::PairDecoder)?;
        let graph = loaded(&mut self.graph, file)?;
        let mut fed = Vec::new();
        for (k, tokens, position) in [(i, "tokens1", "position1"), (j, "tokens2", "position2")] {
            let Some(t) = &self.tokens[k] else {
                return Err(Error::work(format!("photo {k} was not encoded")));
            };
            fed.push((tokens, Input::F32(t.shape.clone(), t.data.clone())));
            fed.push((position, positions(&self.prepared[k])));
        }
        graph.run(fed)
    }

    /// Encodes every photo once, with only the encoder in memory.
    fn encode_all(&mut self) -> Result<()> {
        if self.tokens.iter().all(Option::is_some) {
            return Ok(());
        }
        let mut encoder = self.model.graph(Part::PairEncoder)?.load()?;
        for (slot, ready) in self.tokens.iter_mut().zip(self.prepared) {
            let inputs = vec![("image", ready.input()), ("shape", true_shape(ready))];
            *slot = Some(encoder.run(inputs)?.take("tokens")?);
        }
        Ok(())
    }
}

fn loaded<'g>(slot: &'g mut Option<Graph>, file: &GraphFile) -> Result<&'g mut Graph> {
    let graph = match slot.take() {
        Some(graph) => graph,
        None => file.load()?,
    };
    Ok(slot.insert(graph))
}

/// Height and width of an input, [1, 2].
fn true_shape(ready: &Prepared) -> Input {
    Input::I64(vec![1, 2], vec![ready.height as i64, ready.width as i64])
}

/// (row, column) of every patch, for graphs with this input.
fn positions(ready: &Prepared) -> Input {
    // Every network of this kind has patches of 16 pixels.
    let (columns, rows) = (ready.width / 16, ready.height / 16);
    let at = (0..rows as i64).flat_map(|y| (0..columns as i64).flat_map(move |x| [y, x])).collect();
    Input::I64(vec![1, rows * columns, 2], at)
}

/// Outputs → one row of values: length of a descriptor, then per view points, confidence,
/// descriptors, their confidence.
fn pack(mut outputs: Outputs) -> Result<Vec<f32>> {
    let views = [("points1", "conf1", "desc1", "desc_conf1"), ("points2", "conf2", "desc2", "desc_conf2")];
    let mut all = vec![0.0];
    for (points, conf, desc, desc_conf) in views {
        let conf = outputs.take(conf)?.data;
        all.extend(outputs.take(points)?.data);
        if let Some(d) = outputs.maybe(desc) {
            all[0] = d.shape.last().copied().unwrap_or_default() as f32;
            // Without its own confidence a descriptor has that of its point.
            let desc_conf = outputs.maybe(desc_conf).map_or_else(|| conf.clone(), |t| t.data);
            all.extend(&conf);
            all.extend(d.data);
            all.extend(desc_conf);
        } else {
            all.extend(&conf);
        }
    }
    Ok(all)
}

fn unpack(values: &[f32], size: [&Prepared; 2]) -> Option<Decoded> {
    let (dim, mut rest) = (*values.first()? as usize, values.get(1..)?);
    let mut take_values = |n: usize| {
        let (head, tail) = rest.split_at_checked(n)?;
        rest = tail;
        Some(head.to_vec())
    };
    let mut take_view = |p: &Prepared| {
        let pixels = p.width * p.height;
        let points = bytemuck::pod_collect_to_vec(&take_values(3 * pixels)?);
        let map = Pointmap { points, confidence: take_values(pixels)? };
        if dim == 0 {
            return Some((map, None));
        }
        let mut data = take_values(dim * pixels)?;
        data.chunks_exact_mut(dim).for_each(super::text::normalise);
        Some((map, Some(Descriptors { dim, data, confidence: take_values(pixels)? })))
    };
    let ((a, da), (b, db)) = (take_view(size[0])?, take_view(size[1])?);
    rest.is_empty().then_some(Decoded { maps: [a, b], descriptors: [da, db] })
}

/// Detects outputs that a trained network cannot give: an activation is missing in the export, or
/// outputs are swapped.
struct OutputCheck<'a> {
    model: &'a Installed,
    compared: usize,
    swapped: usize,
}

impl OutputCheck<'_> {
    fn error(&self, fault: &str, remedy: &str) -> Error {
        let message =
            format!("{}: model {}: {fault}; {remedy}", self.model.folder.display(), self.model.name);
        Error::missing_model(&self.model.name, message)
    }

    fn add(&mut self, pair: &PairPointmaps, size: [&Prepared; 2]) -> Result<()> {
        let raw = "either two outputs are swapped or the export left an activation to the program: say apply.points = \
                   \"expm1-norm\" and apply.conf = \"one-plus-exp\" in its adapter (docs/use/models.md)";
        for map in [&pair.x11, &pair.x21, &pair.x22, &pair.x12] {
            // 1 + e^x rounds to 1 at least.
            if map.confidence.iter().any(|c| *c < 0.999) {
                return Err(self.error("a confidence is below 1", raw));
            }
        }
        for (own, other, ready) in [(&pair.x11, &pair.x21, size[0]), (&pair.x22, &pair.x12, size[1])] {
            let ahead = own.points.iter().filter(|p| p[2] > 0.0).count();
            if 2 * ahead < own.points.len() {
                return Err(self.error("most points lie behind the camera that sees them", raw));
            }
            if own.points.len() == other.points.len() {
                // Seen from the first camera, only the first view's points lie on the rays of its
                // pixels.
                let [a, b] = [own, other].map(|m| ray_residual(m, ready.width, ready.height));
                self.compared += 1;
                self.swapped += usize::from(b < 0.05 && a > 2.0 * b);
            }
        }
        Ok(())
    }

    fn finish(&self) -> Result<()> {
        if 2 * self.swapped <= self.compared {
            return Ok(());
        }
        let remedy = "swap names.points1 with names.points2 in its adapter, and with them conf and desc (docs/use/models.md)";
        Err(self
            .error("the second view's points lie on the first view's rays, so the two are swapped", remedy))
    }
}

/// Median distance of projected points from their own pixels with the best focal length, in image
/// widths.
fn ray_residual(map: &Pointmap, width: usize, height: usize) -> f64 {
    let centre = [0.5 * width as f64, 0.5 * height as f64];
    // (slopes of the point's ray, pixel from the centre)
    let rays: Vec<([f64; 2], [f64; 2])> = map
        .points
        .iter()
        .enumerate()
        .filter(|(_, p)| p[2] > 0.0)
        .map(|(k, p)| {
            let pixel = [(k % width) as f64 + 0.5 - centre[0], (k / width) as f64 + 0.5 - centre[1]];
            ([0, 1].map(|c| f64::from(p[c] / p[2])), pixel)
        })
        .collect();
    let dot = |a: [f64; 2], b: [f64; 2]| a[0] * b[0] + a[1] * b[1];
    // The ray along the optical axis gives no finite ratio.
    let mut ratios: Vec<f64> = rays.iter().map(|(s, p)| dot(*s, *p) / dot(*s, *s)).collect();
    ratios.retain(|r| r.is_finite());
    let Some(focal) = median(&mut ratios) else { return f64::INFINITY };
    let apart = |(s, p): &([f64; 2], [f64; 2])| (focal * s[0] - p[0]).hypot(focal * s[1] - p[1]);
    let mut distances: Vec<f64> = rays.iter().map(apart).collect();
    median(&mut distances).unwrap_or(f64::INFINITY) / width as f64
}

#[cfg(test)]
mod tests {
    use super::super::Registry;
    use super::super::installed::Task;
    use super::*;
    use crate::progress::Silent;
    use crate::scene::{Camera, Pose, RgbImage};
    use splatvk_test_support::breakfast;
    use splatvk_test_support::onnx::{Attribute, FLOAT, Onnx};
    use splatvk_test_support::toys::photo;

    /// Graph that gives pointmaps of 64 × 48 pixels at `ports`: the points of the dark or of the
    /// light view, selected by the brightness of its first input, in their own camera and in the
    /// other's, all with one confidence.
    fn graph(own: &[Vec<f32>; 2], other: &[Vec<f32>; 2], ports: [&str; 2], sure: f32) -> Onnx {
        let dims = [1, 48, 64, 3];
        let mut graph = Onnx::new().input("img1", FLOAT, "1 3 48 64").input("img2", FLOAT, "1 3 48 64");
        for (name, [dark, light]) in [("own", own), ("other", other)] {
            let step: Vec<f32> = light.iter().zip(dark).map(|(b, a)| b - a).collect();
            let (start, step_name) = (format!("{name}_0"), format!("{name}_step"));
            graph = graph.weight(&start, &dims, dark).weight(&step_name, &dims, &step);
        }
        graph = graph.node("ReduceMean", "img1", "light", &[("keepdims", Attribute::Int(1))]);
        for (name, port) in ["own", "other"].into_iter().zip(ports) {
            graph = graph
                .output(port, "1 48 64 3")
                .node("Mul", &format!("{name}_step light"), &format!("{name}_more"), &[])
                .node("Add", &format!("{name}_0 {name}_more"), port, &[]);
        }
        for k in ["conf_1", "conf_2"] {
            graph = graph
                .output(k, "1 48 64")
                .weight(&format!("sure_{k}"), &[1, 48, 64], &[sure; 48 * 64])
                .node("Identity", &format!("sure_{k}"), k, &[]);
        }
        graph
    }

    /// Photos that are 0 and 1 after the network's normalisation to [−1, 1].
    fn dark_and_light() -> [Photo; 2] {
        let plain = |v: f32| RgbImage { width: 640, height: 480, data: vec![[v; 3]; 640 * 480] };
        [photo("dark", plain(0.5)), photo("light", plain(1.0))]
    }

    /// The true pointmaps of two breakfast views.
    #[test]
    fn pointmaps_swapped_outputs_are_refused() {
        let views = breakfast::train_views();
        let (w, h) = (64usize, 48);
        // View k in the camera of view c, every tenth pixel.
        let points = |k: usize, c: usize| -> Vec<f32> {
            let to = views[c].camera.pose.compose(&views[k].camera.pose.inverse());
            let point = |p: usize| {
                let (x, y) = (10 * (p % w) + 5, 10 * (p / w) + 5);
                let camera = Camera { pose: Pose::IDENTITY, ..views[k].camera.clone() };
                let pixel = glam::DVec2::new(x as f64 + 0.5, y as f64 + 0.5);
                to.transform(camera.unproject(pixel, f64::from(views[k].depth.at(x, y)))).as_vec3().to_array()
            };
            (0..w * h).flat_map(point).collect()
        };
        let [own, other] = [[points(0, 0), points(1, 1)], [points(1, 0), points(0, 1)]];
        let dir = tempfile::tempdir().unwrap();
        let run_with = |ports: [&str; 2]| {
            graph(&own, &other, ports, 5.0).write(&dir.path().join("dust3r/model.onnx"));
            let model = Registry::of(&[dir.path()]).installed(Task::Geometry, "dust3r").unwrap();
            pointmaps(&model, &dark_and_light(), &Silent).map(drop)
        };
        run_with(["pts3d_1", "pts3d_2"]).unwrap();
        let error = run_with(["pts3d_2", "pts3d_1"]).unwrap_err().to_string();
        assert!(error.contains("swap names.points1 with names.points2"), "{error}");
    }

    #[test]
    fn pointmaps_raw_confidence_is_refused() {
        let points = vec![1.0; 3 * 48 * 64];
        let ahead = [points.clone(), points];
        let dir = tempfile::tempdir().unwrap();
        graph(&ahead, &ahead, ["pts3d_1", "pts3d_2"], 0.5).write(&dir.path().join("dust3r/model.onnx"));
        let model = Registry::of(&[dir.path()]).installed(Task::Geometry, "dust3r").unwrap();
        let error = pointmaps(&model, &dark_and_light(), &Silent).map(drop).unwrap_err().to_string();
        assert!(error.contains("below 1") && error.contains("apply.conf = \"one-plus-exp\""), "{error}");
    }

    /// A tilted wall in front of two cameras, every point on the ray through the centre of its
    /// pixel; an offset of half a network pixel would be five pixels of the photo.
    #[test]
    fn pointmaps_use_pixel_centres() {
        let (w, h) = (64usize, 48);
        let camera = |centre: f64, angle: f64| {
            let rotation = glam::DMat3::from_rotation_y(angle);
            let pose = Pose { rotation, translation: -(rotation * glam::DVec3::X * centre) };
            let name = String::new();
            Camera { name, width: 640, height: 480, fx: 700.0, fy: 700.0, cx: 320.0, cy: 240.0, pose }
        };
        let cameras = [camera(0.0, 0.0), camera(0.6, 0.15)];
        // World points of the plane z = 4 + 0.4 x that the centres of the network's pixels show.
        let world = |k: usize, p: usize| {
            let pixel = glam::DVec2::new((p % w) as f64 + 0.5, (p / w) as f64 + 0.5) * 10.0;
            let (from, to) = (cameras[k].pose.centre(), cameras[k].unproject(pixel, 1.0));
            let ray = to - from;
            from + ray * ((4.0 + 0.4 * from.x - from.z) / (ray.z - 0.4 * ray.x))
        };
        let points = |k: usize, c: usize| -> Vec<f32> {
            let seen = |p: usize| cameras[c].pose.transform(world(k, p)).as_vec3().to_array();
            (0..w * h).flat_map(seen).collect()
        };
        let [own, other] = [[points(0, 0), points(1, 1)], [points(1, 0), points(0, 1)]];
        let dir = tempfile::tempdir().unwrap();
        graph(&own, &other, ["pts3d_1", "pts3d_2"], 5.0).write(&dir.path().join("dust3r/model.onnx"));
        let model = Registry::of(&[dir.path()]).installed(Task::Geometry, "dust3r").unwrap();
        let maps = pointmaps(&model, &dark_and_light(), &Silent).unwrap();
        let pair = &maps.pairs[0];
        for (map, of, by) in [(&pair.x11, 0, 0), (&pair.x21, 1, 0), (&pair.x22, 1, 1), (&pair.x12, 0, 1)] {
            let photo = maps.views[of].from_working.inverse();
            for p in (0..w * h).step_by(31) {
                let x = cameras[by].pose.inverse().transform(map.point(p));
                let centre = photo.apply([(p % w) as f64 + 0.5, (p / w) as f64 + 0.5]);
                let shown = cameras[of].project(x).0 - glam::DVec2::from(centre);
                assert!(shown.length() < 1e-2, "{of} {by} {p}: {shown}");
            }
        }
    }
}
