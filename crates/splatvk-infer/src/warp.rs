//! Dense matches from networks: for every pixel of one photo its position in another, with a
//! certainty. RoMa v1 and v2 give warps; descriptors of MASt3R are matched by nearest neighbours.
use rayon::prelude::*;

use super::cache::OutputKey;
use super::contract::Part;
use super::graph::{Graph, GraphFile};
use super::installed::Installed;
use super::prepare::Prepared;
use super::runtime::Tensor;
use crate::photo::Photo;
use crate::progress::Progress;
use crate::scene::{DenseWarp, Descriptors, Image};
use crate::{Error, Result};

/// Both directions for every unordered pair (i, j), i < j, in order.
pub fn warps(
    model: &Installed,
    photos: &[Photo],
    progress: &dyn Progress,
) -> Result<Vec<(DenseWarp, DenseWarp)>> {
    let Ok(file) = model.graph(Part::Warp) else { return by_descriptors(model, photos, progress) };
    let _turn = file.compute.turn();
    let prepared = super::prepare::inputs(file, "image1", photos)?;
    let both = is_symmetric(file);
    let mut graph: Option<Graph> = None;
    let count = photos.len();
    progress.begin("match", (count * count.saturating_sub(1) / 2) as u64);
    let mut all = Vec::new();
    for i in 0..count {
        for j in i + 1..count {
            progress.check()?;
            let mut found = forward(file, &mut graph, [&prepared[i], &prepared[j]])?;
            if !both {
                found.extend(forward(file, &mut graph, [&prepared[j], &prepared[i]])?);
            }
            let [there, back] = &found[..] else {
                return Err(Error::work(format!("{}: gave no warp", file.path.display())));
            };
            let (a, b) = ((&photos[i], &prepared[i]), (&photos[j], &prepared[j]));
            all.push((there.at_working_size(a, b), back.at_working_size(b, a)));
            progress.step(all.len() as u64, "");
        }
    }
    progress.end();
    Ok(all)
}

/// Whether a graph gives both directions.
fn is_symmetric(file: &GraphFile) -> bool {
    file.has("warp21") && file.has("certainty21")
}

/// Runs the graph, which is loaded if an output is not cached, on two inputs.
fn forward(file: &GraphFile, graph: &mut Option<Graph>, [a, b]: [&Prepared; 2]) -> Result<Vec<Field>> {
    let key = OutputKey::new("warp").model(file)?.values(&a.data).values(&b.data);
    let values = file.compute.remember(key, || {
        let net = match graph.take() {
            Some(net) => net,
            None => file.load()?,
        };
        let mut outputs = graph.insert(net).run(vec![("image1", a.input()), ("image2", b.input())])?;
        let mut all = Vec::new();
        let directions = [("warp12", "certainty12"), ("warp21", "certainty21")];
        for (warp, certainty) in directions.into_iter().take(if is_symmetric(file) { 2 } else { 1 }) {
            all.extend(field_values(outputs.take(warp)?, outputs.take(certainty)?, file)?);
        }
        Ok(all)
    })?;
    Ok(fields(&values))
}

/// Warps from nearest neighbours of a pair network's descriptors, every [`STEP`] of its pixels.
fn by_descriptors(
    model: &Installed,
    photos: &[Photo],
    progress: &dyn Progress,
) -> Result<Vec<(DenseWarp, DenseWarp)>> {
    let prepared = super::pairs::inputs_of(model, photos)?;
    let mut pairs = Vec::new();
    super::pairs::decode_all(model, &prepared, progress, |pair| pairs.push(pair))?;
    progress.begin("match", pairs.len() as u64);
    let mut all = Vec::new();
    for pair in &pairs {
        progress.check()?;
        let Some([first, second, _, _]) = &pair.descriptors else {
            return Err(Error::missing_model(
                &model.name,
                format!(
                    "{}: model {} gives no descriptors, so it cannot match; choose another --matcher",
                    model.folder.display(),
                    model.name
                ),
            ));
        };
        let (i, j) = (pair.first, pair.second);
        let there = Field::nearest((first, &prepared[i]), (second, &prepared[j]));
        let back = Field::nearest((second, &prepared[j]), (first, &prepared[i]));
        let (a, b) = ((&photos[i], &prepared[i]), (&photos[j], &prepared[j]));
        all.push((there.at_working_size(a, b), back.at_working_size(b, a)));
        progress.step(all.len() as u64, "");
    }
    progress.end();
    Ok(all)
}

/// Step between matched pixels: a search for every pixel takes minutes per pair on a CPU.
const STEP: usize = 4;

/// A warp at the network's resolution: (x, y) in [−1, 1] of the second input, certainty.
struct Field {
    width: usize,
    height: usize,
    data: Vec<[f32; 3]>,
}

/// [width, height, (x, y, certainty)…]
fn field_values(warp: Tensor, certainty: Tensor, file: &GraphFile) -> Result<Vec<f32>> {
    let [_, height, width, _] = warp.shape[..] else { return Ok(Vec::new()) };
    if certainty.data.len() != width * height {
        return Err(Error::work(format!("{}: warp and certainty differ in size", file.path.display())));
    }
    if let Some(odd) = certainty.data.iter().find(|c| !(-1e-3..=1.001).contains(*c)) {
        return Err(Error::missing_model(
            file.path.display(),
            format!(
                "{}: a certainty of {odd} is no probability; if the graph gives logits say apply.certainty = \"sigmoid\" in its \
             adapter (docs/use/models.md)",
                file.path.display()
            ),
        ));
    }
    let mut all = vec![width as f32, height as f32];
    for (xy, c) in warp.data.chunks_exact(2).zip(&certainty.data) {
        let inside = xy.iter().all(|v| v.abs() <= 1.0);
        all.extend([xy[0], xy[1], if inside { *c } else { 0.0 }]);
    }
    Ok(all)
}

fn fields(mut values: &[f32]) -> Vec<Field> {
    let mut all = Vec::new();
    while let [w, h, rest @ ..] = values {
        let (width, height) = (*w as usize, *h as usize);
        let Some((body, next)) = rest.split_at_checked(3 * width * height) else { break };
        all.push(Field { width, height, data: bytemuck::pod_collect_to_vec(body) });
        values = next;
    }
    all
}

impl Field {
    /// Warp to the nearest descriptors, with certainty 1; the caller tests forward-backward
    /// consistency.
    fn nearest(from: (&Descriptors, &Prepared), to: (&Descriptors, &Prepared)) -> Field {
        let (width, height) = (from.1.width / STEP, from.1.height / STEP);
        let seed =
            |cell: usize| (cell / width * STEP + STEP / 2) * from.1.width + cell % width * STEP + STEP / 2;
        let seeds: Vec<usize> = (0..width * height).map(seed).collect();
        // The centre of a cell lies half a pixel before that of its seed, and so does its target.
        let share = |at: usize, of: usize| 2.0 * at as f32 / of as f32 - 1.0;
        let end = |q: usize| [share(q % to.1.width, to.1.width), share(q / to.1.width, to.1.height), 1.0];
        let found = from.0.nearest(&seeds, to.0);
        Field { width, height, data: found.into_iter().map(end).collect() }
    }

    /// Interpolates bilinearly, with pixel centres at half-integers and the border repeated.
    fn sample(&self, x: f64, y: f64) -> [f32; 3] {
        let ((x0, x1, fx), (y0, y1, fy)) = (linear_taps(x, self.width), linear_taps(y, self.height));
        let value = |x: usize, y: usize| self.data[y * self.width + x];
        let mix = |a: [f32; 3], b: [f32; 3], t: f32| [0, 1, 2].map(|k| a[k] + t * (b[k] - a[k]));
        mix(mix(value(x0, y0), value(x1, y0), fx), mix(value(x0, y1), value(x1, y1), fx), fy)
    }

    /// Warp from every pixel of the first photo to pixels of the second.
    fn at_working_size(&self, from: (&Photo, &Prepared), to: (&Photo, &Prepared)) -> DenseWarp {
        let (width, height) = (from.0.image.width, from.0.image.height);
        let back = to.1.from_photo.inverse();
        let mut target = Image::filled(width, height, [-1.0f32; 2]);
        let mut certainty = Image::filled(width, height, 0.0f32);
        let rows = target.data.par_chunks_mut(width).zip(certainty.data.par_chunks_mut(width)).enumerate();
        rows.for_each(|(y, (target, certainty))| {
            for x in 0..width {
                let [u, v] = from.1.from_photo.apply([x as f64 + 0.5, y as f64 + 0.5]);
                let cell = [
                    u * self.width as f64 / from.1.width as f64,
                    v * self.height as f64 / from.1.height as f64,
                ];
                let [a, b, sure] = self.sample(cell[0], cell[1]);
                let seen = [
                    (f64::from(a) + 1.0) / 2.0 * to.1.width as f64,
                    (f64::from(b) + 1.0) / 2.0 * to.1.height as f64,
                ];
                target[x] = back.apply(seen).map(|v| v as f32);
                certainty[x] = sure.clamp(0.0, 1.0);
            }
        });
        DenseWarp { target, certainty }
    }
}

/// The two neighbours of a coordinate among `n` pixels, and the weight of the second.
fn linear_taps(v: f64, n: usize) -> (usize, usize, f32) {
    let v = (v - 0.5).clamp(0.0, (n - 1) as f64);
    (v as usize, (v as usize + 1).min(n - 1), v.fract() as f32)
}
