//! Runs an installed network on built-in images, checks it against its contract, and measures time
//! and memory.
mod parallax;
mod pictures;
#[cfg(test)]
mod tests;
mod views;

use std::path::Path;
use std::time::Instant;

use glam::DMat3;

use super::clip::Clip;
use super::concepts::Concepts;
use super::contract::Part;
use super::graph::GraphFile;
use super::installed::{Installed, Task};
use super::runtime::Input;
use super::sam::{BATCH, MASKS, Sam};
use super::{RegionEncoder, depth_prior};
use crate::format::npy::{self, NpyData};
use crate::progress::{Silent, peak_memory, reset_peak_memory};
use crate::scene::{Image, RgbImage};
use crate::{Error, Result};

/// Largest difference to the reference, relative to its largest value: the effect of another order
/// of float32 sums.
const TOLERANCE: f32 = 1e-3;

/// Measurements of one step.
#[derive(Clone, Debug, serde::Serialize)]
pub struct Measured {
    /// Description of the step.
    pub step: String,
    /// Wall seconds.
    pub seconds: f64,
    /// Peak resident memory of the process during the step, bytes; 0 if unknown.
    pub peak_memory: u64,
    /// Largest difference to the answer that the step repeats, relative to its largest value:
    /// PyTorch's, or the graph's own to the same photos in another order.
    pub error: Option<f32>,
    /// Other figures of the step.
    pub figures: Vec<Figure>,
    /// Reason for doubt in a network that otherwise works, one line.
    pub warning: Option<String>,
}

/// A figure of one step.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct Figure {
    /// Its name.
    pub name: &'static str,
    /// NaN where nothing could be measured.
    pub value: f64,
    /// "°", "%", "px", "extents" (of the cameras), or "" for a ratio.
    pub unit: &'static str,
}

impl Figure {
    fn new(name: &'static str, value: f64, unit: &'static str) -> Figure {
        Figure { name, value, unit }
    }
}

/// Figures with the conclusion from them.
struct Finding {
    figures: Vec<Figure>,
    verdict: Verdict,
}

enum Verdict {
    Sound,
    /// A right network may give this.
    Doubt(String),
    /// No right network gives this.
    Fault(String),
}

fn measured<T>(step: String, steps: &mut Vec<Measured>, work: impl FnOnce() -> Result<T>) -> Result<T> {
    reset_peak_memory();
    let began = Instant::now();
    let done = work()?;
    let seconds = began.elapsed().as_secs_f64();
    let peak_memory = peak_memory();
    steps.push(Measured { step, seconds, peak_memory, error: None, figures: Vec::new(), warning: None });
    Ok(done)
}

/// Repeats the reference run of every graph that has one, then runs the model's tasks on two
/// built-in images. An error names the file and the fault. The registry must be uncached
/// ([`super::Registry::uncached`]), since the steps are measured.
pub fn check(model: &Installed) -> Result<Vec<Measured>> {
    let mut steps = Vec::new();
    for graph in model.graphs.values() {
        let reference = graph.path.with_extension("reference.npz");
        if reference.is_file() {
            let step = format!("{}, as the export ran it", graph.binding.part.name());
            let error = measured(step, &mut steps, || repeat(graph, &reference))?;
            if let Some(last) = steps.last_mut() {
                last.error = Some(error);
            }
        }
    }
    let photos = pictures::pictures(2);
    for task in &model.tasks {
        match task {
            Task::Geometry => match model.graph(Part::MultiView) {
                Ok(graph) => views::check(model, graph, &mut steps)?,
                Err(_) => parallax::of_pair_network(model, &mut steps)?,
            },
            Task::Matcher => parallax::of_matcher(model, &mut steps)?,
            Task::Masks => masks(model, &photos[0].image, &mut steps)?,
            Task::Features => features(model, &photos[0].image, &mut steps)?,
            // Texts run with the features; depth comes from the geometry.
            Task::Text => {}
            Task::Concepts => concepts(model, &photos[0].image, &mut steps)?,
            Task::Depth if model.tasks.contains(&Task::Geometry) => {}
            Task::Depth => {
                measured("depth of 2 photos".to_string(), &mut steps, || {
                    depth_prior::of_network(model, &photos, &Silent)
                })?;
            }
        }
    }
    Ok(steps)
}

/// Adds a finding to the last step. Outputs of untrained networks mean nothing, so there is no
/// verdict on them.
fn record(model: &Installed, steps: &mut [Measured], finding: Finding) -> Result<()> {
    let Some(last) = steps.last_mut() else { return Ok(()) };
    last.figures.extend(finding.figures);
    match finding.verdict {
        _ if model.untrained() => Ok(()),
        Verdict::Sound => Ok(()),
        Verdict::Doubt(reason) => {
            last.warning = Some(reason);
            Ok(())
        }
        Verdict::Fault(fault) => Err(refuse(model, &fault)),
    }
}

/// The error for a network with a fault.
fn refuse(model: &Installed, fault: &str) -> Error {
    let export = match model.catalogue_entry().map(|k| k.export.as_str()) {
        Some(script) if script.ends_with(".py") => script,
        _ => "a script of tools/export",
    };
    let (folder, name) = (model.folder.display(), &model.name);
    Error::missing_model(name, format!("{folder}: model {name}: {fault}; export it again with {export}"))
}

/// Angle between two rotations, degrees: 2 asin(‖A − B‖ / √8), which is exact for small angles too.
fn rotation_degrees(a: &DMat3, b: &DMat3) -> f64 {
    let squares: f64 = (*a - *b).to_cols_array().iter().map(|v| v * v).sum();
    2.0 * (squares / 8.0).sqrt().min(1.0).asin().to_degrees()
}

/// The largest relative difference between the graph's outputs and the reference beside it.
fn repeat(file: &GraphFile, reference: &Path) -> Result<f32> {
    let arrays = npy::read_npz(reference)?;
    let mut graph = file.load()?;
    let mut inputs = Vec::new();
    for (role, bound) in &file.binding.ports {
        let Some(array) = arrays.get(&format!("in.{}", bound.name)) else { continue };
        let shape = array.shape.clone();
        let whole = !matches!(array.data, NpyData::F16(_) | NpyData::F32(_) | NpyData::F64(_));
        inputs.push((
            *role,
            match whole {
                true => Input::I64(shape, array.to_i32().into_iter().map(i64::from).collect()),
                false => Input::F32(shape, array.to_f32()),
            },
        ));
    }
    let mut outputs = graph.run(inputs)?;
    let mut worst = 0f32;
    for (role, bound) in &file.binding.ports {
        let Some(wanted) = arrays.get(&format!("out.{}", bound.name)) else { continue };
        // Only the toy graphs of the tests have other layouts than the contract; exports use the
        // contract's, up to the channel axis of warps.
        let given = outputs.take(role)?;
        let raw = super::graph::relayout(
            given,
            file.binding.part.contract().slot(role).map_or("", |s| s.shape),
            bound.layout.unwrap_or_default(),
        );
        let wanted = activated(file, role, wanted.to_f32());
        let given = raw.map(|t| t.data).unwrap_or_default();
        if given.len() != wanted.len() {
            return Err(Error::work(format!(
                "{}: output {} has another size than its reference",
                file.path.display(),
                bound.name
            )));
        }
        let largest = wanted.iter().fold(f32::MIN_POSITIVE, |m, v| m.max(v.abs()));
        let apart = wanted.iter().zip(&given).fold(0f32, |m, (a, b)| m.max((a - b).abs()));
        worst = worst.max(apart / largest);
    }
    if worst > TOLERANCE {
        return Err(Error::missing_model(
            file.path.display(),
            format!(
                "{}: differs from its reference by {worst:.1e} of the largest value (at most {TOLERANCE:.0e}); export it again",
                file.path.display()
            ),
        ));
    }
    Ok(worst)
}

/// Applies the activation of a role to its reference values.
fn activated(file: &GraphFile, role: &str, data: Vec<f32>) -> Vec<f32> {
    let mut tensor = super::Tensor { shape: vec![data.len()], data };
    if let Some(activation) = file.binding.activation(role) {
        activation.apply(&mut tensor);
    }
    tensor.data
}

fn masks(model: &Installed, image: &RgbImage, steps: &mut Vec<Measured>) -> Result<()> {
    let mut net = measured("encoder and decoder loaded".to_string(), steps, || Sam::load(model))?;
    let encoded = measured("photo encoded".to_string(), steps, || net.encode(image))?;
    let (w, h) = (image.width as f64, image.height as f64);
    let points: Vec<[f64; 2]> = (0..BATCH).map(|k| [(k as f64 + 0.5) * w / BATCH as f64, h / 2.0]).collect();
    let found = measured(format!("{BATCH} prompts decoded"), steps, || net.decode(&encoded, &points))?;
    if found.scores.len() != MASKS * BATCH || found.logits.len() != MASKS * BATCH * found.width * found.height
    {
        return Err(Error::work(format!("model {}: wrong number of masks", model.name)));
    }
    Ok(())
}

fn features(model: &Installed, image: &RgbImage, steps: &mut Vec<Measured>) -> Result<()> {
    let step = "towers loaded and introduced".to_string();
    let mut net = measured(step, steps, || Clip::load(model.clone()))?;
    let half = |p: usize| i32::from(p % image.width >= image.width / 2);
    let data = (0..image.width * image.height).map(half).collect();
    let labels = Image { width: image.width, height: image.height, data };
    let rows = measured("2 regions".to_string(), steps, || net.embed_regions(image, &labels, 2, &Silent))?;
    let unit = |row: &[f32]| (row.iter().map(|v| v * v).sum::<f32>() - 1.0).abs() < 1e-3;
    if !rows.chunks_exact(net.dim()).all(unit) {
        return Err(Error::work(format!("model {}: a region without direction", model.name)));
    }
    measured("1 text".to_string(), steps, || net.embed_texts(&["a blue mug"])).map(drop)
}

/// Finds a text and the photo's masks with all three graphs.
fn concepts(model: &Installed, image: &RgbImage, steps: &mut Vec<Measured>) -> Result<()> {
    let mut net = Concepts::load(model.clone())?;
    measured("1 text in 1 photo".to_string(), steps, || net.find(image, &["a blue mug"])).map(drop)
}
