//! Adapters map the tensor names, layouts and value ranges of a file to the roles of a
//! [`Contract`]. They are TOML files: the built-in ones cover public exports; a user's adapter lies
//! beside the model (`adapter.toml` in its folder, or `NAME.toml` beside `NAME.onnx`) and states
//! only the differences from the built-in one of its family.
use std::collections::BTreeMap;
use std::path::Path;

use serde::Deserialize;

use super::contract::{Contract, Part, Slot, unify};
use super::onnx::{Dim, ElementType, Header, Port, listed};
use super::runtime::Tensor;
use crate::scene::MAX_SIDE;
use crate::{Error, Result, files};

const BUILT_IN: [(&str, &str); 16] = [
    ("clip", include_str!("adapters/clip.toml")),
    ("lseg", include_str!("adapters/lseg.toml")),
    ("siglip", include_str!("adapters/siglip.toml")),
    ("sam", include_str!("adapters/sam.toml")),
    ("sam-transformers", include_str!("adapters/sam-transformers.toml")),
    ("sam2", include_str!("adapters/sam2.toml")),
    ("sam2-transformers", include_str!("adapters/sam2-transformers.toml")),
    ("dust3r", include_str!("adapters/dust3r.toml")),
    ("mast3r", include_str!("adapters/mast3r.toml")),
    ("vggt", include_str!("adapters/vggt.toml")),
    ("depth-anything-3", include_str!("adapters/depth-anything-3.toml")),
    ("roma", include_str!("adapters/roma.toml")),
    ("roma2", include_str!("adapters/roma2.toml")),
    ("depth-anything", include_str!("adapters/depth-anything.toml")),
    ("metric-depth", include_str!("adapters/metric-depth.toml")),
    ("sam3", include_str!("adapters/sam3.toml")),
];

/// Preprocessing of a photo for a network.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ImageSpec {
    /// Subtracted from values in [0, 1].
    pub mean: [f32; 3],
    /// Divisor after the subtraction.
    pub std: [f32; 3],
    /// Length of the longer side, pixels, if the graph does not fix it.
    pub size: usize,
    /// Both sides are multiples of this.
    #[serde(default = "default_multiple")]
    pub multiple: usize,
    /// Fit of the photo to that size.
    #[serde(default)]
    pub fit: Fit,
    /// Resampling filter.
    #[serde(default)]
    pub filter: Filter,
}

/// Preparation of texts for the tokenizer and the text tower of a family.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TextSpec {
    /// Number of tokens of the tokenizer, by which it is recognised.
    pub vocabulary: usize,
    /// Tokens of a text, if the graph does not fix their number.
    pub context: usize,
    /// Id that fills a text up.
    pub pad: i64,
    /// Id of the mark at the end of a text.
    pub end: i64,
    /// Whether the model was trained on lower-case texts that the tokenizer does not make.
    #[serde(default)]
    pub lower: bool,
    /// Whether texts keep their punctuation.
    #[serde(default = "default_punctuation")]
    pub punctuation: bool,
}

fn default_punctuation() -> bool {
    true
}

fn default_multiple() -> usize {
    1
}

impl ImageSpec {
    /// Refuses values with which no image can be prepared.
    fn check(&self) -> Result<(), String> {
        let numbers = self.mean.iter().chain(&self.std).all(|v| v.is_finite());
        if !numbers || self.std.iter().any(|v| *v <= 0.0) {
            return Err("image.mean must be finite and image.std positive".to_owned());
        }
        let side = 1..=MAX_SIDE as usize;
        if !side.contains(&self.size) || !side.contains(&self.multiple) {
            return Err(format!("image.size and image.multiple must be between 1 and {MAX_SIDE} pixels"));
        }
        Ok(())
    }
}

/// Fit of a photo to an input of another aspect ratio.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Fit {
    /// Scales the longer side to the size; nothing is cut or added.
    #[default]
    Resize,
    /// As `Resize`, then black below and to the right (after normalisation).
    Pad,
    /// Scales both sides to the size.
    Squash,
    /// As `Resize`, then cut symmetrically to the multiple or the fixed size.
    Crop,
}

/// Resampling filter; kernels widen with the reduction, as in Pillow.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
#[non_exhaustive]
pub enum Filter {
    /// Triangle.
    Bilinear,
    /// Cubic with a = −0.5.
    #[default]
    Bicubic,
    /// Three lobes to shrink, cubic to enlarge (DUSt3R).
    Lanczos,
}

/// Post-processing that a graph leaves to the program.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub enum Activation {
    /// 1 / (1 + e^−x): logits → probability.
    Sigmoid,
    /// x · (e^|x| − 1) / |x| of each point.
    Expm1Norm,
    /// 1 + e^x.
    OnePlusExp,
    /// e^x.
    Exp,
    /// Camera-to-world matrices are inverted.
    Invert,
}

impl Activation {
    /// Applies it to an output in the contract's layout.
    pub fn apply(self, tensor: &mut Tensor) {
        let data = &mut tensor.data;
        match self {
            Activation::Sigmoid => data.iter_mut().for_each(|v| *v = 1.0 / (1.0 + (-*v).exp())),
            Activation::Exp => data.iter_mut().for_each(|v| *v = v.exp()),
            Activation::OnePlusExp => data.iter_mut().for_each(|v| *v = 1.0 + v.exp()),
            Activation::Expm1Norm => {
                for p in data.chunks_exact_mut(3) {
                    let d = p.iter().map(|v| v * v).sum::<f32>().sqrt().max(1e-8);
                    p.iter_mut().for_each(|v| *v *= d.exp_m1() / d);
                }
            }
            Activation::Invert => {
                let rows = tensor.shape.iter().rev().nth(1).copied().unwrap_or(3);
                for m in data.chunks_exact_mut(4 * rows) {
                    let old: Vec<f32> = m.to_vec();
                    for r in 0..3 {
                        (0..3).for_each(|c| m[4 * r + c] = old[4 * c + r]);
                        m[4 * r + 3] = -(0..3).map(|k| old[4 * k + r] * old[4 * k + 3]).sum::<f32>();
                    }
                }
            }
        }
    }
}

/// A file's name for a role, or several that occur.
#[derive(Clone, Debug, Deserialize)]
#[serde(untagged)]
enum Names {
    One(String),
    Any(Vec<String>),
}

impl Names {
    fn list(&self) -> &[String] {
        match self {
            Names::One(name) => std::slice::from_ref(name),
            Names::Any(names) => names,
        }
    }
}

/// One graph of an adapter.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct GraphSpec {
    part: Part,
    #[serde(default)]
    names: BTreeMap<String, Names>,
    #[serde(default)]
    layouts: BTreeMap<String, String>,
    image: Option<ImageSpec>,
    #[serde(default)]
    texts: Vec<TextSpec>,
    #[serde(default)]
    apply: BTreeMap<String, Activation>,
    /// Optional roles of the contract that this model must have.
    #[serde(default)]
    needs: Vec<String>,
    /// A mask decoder that adds the padding point to a prompt itself; most do not.
    pads: Option<bool>,
    /// Least confidence of a usable point, on the scale of the network after `apply`.
    confidence_floor: Option<f64>,
    /// Coordinate of the first pixel's centre in `intrinsics`: 0.5, or 0 with integer pixel
    /// centres.
    pixel_centre: Option<f64>,
    #[serde(skip)]
    family: String,
}

/// An adapter file.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Adapter {
    /// Family of the model; built-in adapters of the same family complete this one.
    #[serde(default)]
    pub family: String,
    /// Identifies the weights: graphs with different values are not combined.
    pub checkpoint: Option<String>,
    /// Whether the weights are untrained: outputs are meaningless and are not checked.
    #[serde(default)]
    pub untrained: bool,
    /// Required sha256 of the files beside it, by name; files without an entry are not checked.
    #[serde(default)]
    pub sha256: BTreeMap<String, String>,
    /// Addresses that the files were fetched from, by name.
    #[serde(default)]
    pub source: BTreeMap<String, String>,
    #[serde(default)]
    graph: Vec<GraphSpec>,
}

impl Adapter {
    /// Reads the adapter of a model file: `NAME.toml` beside it, else `adapter.toml` in its folder,
    /// else an empty one.
    pub fn of_file(model: &Path) -> Result<Adapter> {
        for path in [model.with_extension("toml"), model.with_file_name("adapter.toml")] {
            if path.is_file() {
                let text = files::read_text(&path)?;
                return Adapter::parse(&text).map_err(|e| Error::input(format!("{}: {e}", path.display())));
            }
        }
        Ok(Adapter::default())
    }

    fn parse(text: &str) -> Result<Adapter, String> {
        let one_line = |e: toml::de::Error| e.to_string().split_whitespace().collect::<Vec<_>>().join(" ");
        let mut adapter: Adapter = toml::from_str(text).map_err(one_line)?;
        for graph in &mut adapter.graph {
            graph.family.clone_from(&adapter.family);
            graph.image.as_ref().map_or(Ok(()), ImageSpec::check)?;
            let contract = graph.part.contract();
            for role in graph.names.keys().chain(graph.layouts.keys()) {
                contract.slot(role).ok_or_else(|| unknown_role(contract, role))?;
            }
        }
        Ok(adapter)
    }

    /// Candidate descriptions of a graph: the adapter's own ones, completed from built-in ones,
    /// then the built-in ones.
    fn specs(&self) -> Result<Vec<GraphSpec>> {
        let mut built_in = Vec::new();
        for (name, text) in BUILT_IN {
            let adapter =
                Adapter::parse(text).map_err(|e| Error::work(format!("built-in adapter {name}: {e}")))?;
            built_in.extend(adapter.graph);
        }
        if !self.family.is_empty() && built_in.iter().any(|g| g.family == self.family) {
            built_in.retain(|g| g.family == self.family);
        }
        let mut specs = Vec::new();
        for own in &self.graph {
            let mut same_family =
                built_in.iter().filter(|g| g.part == own.part && g.family == self.family).peekable();
            if same_family.peek().is_none() {
                specs.push(own.clone());
            }
            specs.extend(same_family.map(|base| own.completed_from(base)));
        }
        specs.extend(built_in.into_iter().map(|g| GraphSpec {
            family: if self.family.is_empty() { g.family } else { self.family.clone() },
            ..g
        }));
        Ok(specs)
    }

    /// Identifies the part of a graph and the role of each tensor. The error states the nearest
    /// part.
    pub fn fit(&self, model: &Path, header: &Header) -> Result<Binding> {
        let mut best: Option<Binding> = None;
        let mut nearest: Option<(usize, String)> = None;
        for spec in self.specs()? {
            match spec.fit(header) {
                Ok(binding) => {
                    if best.as_ref().is_none_or(|b| binding.ports.len() > b.ports.len()) {
                        best = Some(binding);
                    }
                }
                Err(misfit) => {
                    // With equally many misfits, the contract with more bound roles is nearer.
                    let distance = 100 * misfit.complaints.len() + 99 - misfit.bound.min(99);
                    if nearest.as_ref().is_none_or(|(d, _)| distance < *d) {
                        let complaints = misfit.complaints.join("; ");
                        let text = format!("{} ({}): {complaints}", spec.part.name(), spec.family);
                        nearest = Some((distance, text));
                    }
                }
            }
        }
        best.ok_or_else(|| {
            Error::input(format!(
                "{}: fits no known model: inputs {}; outputs {}; nearest is {}; if a name differs, say so in {} (docs/use/models.md)",
                model.display(),
                listed(&header.inputs),
                listed(&header.outputs),
                nearest.map(|n| n.1).unwrap_or_default(),
                model.with_extension("toml").display(),
            ))
        })
    }
}

fn unknown_role(contract: &Contract, role: &str) -> String {
    let roles: Vec<&str> = contract.inputs.iter().chain(contract.outputs).map(|s| s.role).collect();
    format!("{} has no role \"{role}\"; it has {}", contract.name, roles.join(", "))
}

/// The tensor behind a role.
#[derive(Clone, Debug, PartialEq)]
pub struct Bound {
    /// Its name in the graph.
    pub name: String,
    /// Its layout, as far as the file states it.
    pub layout: Option<&'static str>,
    /// Its axes.
    pub dims: Option<Vec<Dim>>,
}

/// A graph whose tensors all have roles.
#[derive(Clone, Debug)]
pub struct Binding {
    /// Its part of a model.
    pub part: Part,
    /// Family of the model.
    pub family: String,
    /// Role → tensor.
    pub ports: BTreeMap<&'static str, Bound>,
    /// Preprocessing of photos.
    pub image: Option<ImageSpec>,
    /// Preparation of texts, by the tokenizers that may lie beside a text tower.
    pub texts: Vec<TextSpec>,
    /// Role → activation that the program applies.
    pub apply: BTreeMap<String, Activation>,
    /// Whether a mask decoder adds the padding point to a prompt itself.
    pub pads: bool,
    /// Least confidence of a usable point, if the adapter states it.
    pub confidence_floor: Option<f64>,
    /// Coordinate of the first pixel's centre in `intrinsics`.
    pub pixel_centre: f64,
}

impl Binding {
    /// Activation that the program applies to a role's output. "points" stands for points1 and
    /// points2.
    pub fn activation(&self, role: &str) -> Option<Activation> {
        let stem = role.trim_end_matches(|c: char| c.is_ascii_digit());
        self.apply.get(role).or_else(|| self.apply.get(stem)).copied()
    }
}

struct Misfit {
    bound: usize,
    complaints: Vec<String>,
}

impl GraphSpec {
    /// Completes this description from `base`.
    fn completed_from(&self, base: &GraphSpec) -> GraphSpec {
        let mut spec = base.clone();
        spec.family.clone_from(&self.family);
        spec.names.extend(self.names.clone());
        spec.layouts.extend(self.layouts.clone());
        spec.apply.extend(self.apply.clone());
        spec.needs.extend(self.needs.clone());
        spec.pads = self.pads.or(spec.pads);
        spec.confidence_floor = self.confidence_floor.or(spec.confidence_floor);
        spec.pixel_centre = self.pixel_centre.or(spec.pixel_centre);
        spec.image = self.image.clone().or(spec.image);
        if !self.texts.is_empty() {
            spec.texts.clone_from(&self.texts);
        }
        spec
    }

    fn fit(&self, header: &Header) -> Result<Binding, Misfit> {
        let contract = self.part.contract();
        let (mut ports, mut complaints) = (BTreeMap::new(), Vec::new());
        let mut known = Vec::new();
        let sides =
            [("input", contract.inputs, &header.inputs), ("output", contract.outputs, &header.outputs)];
        for (side, slots, given) in sides {
            for slot in slots {
                match self.bind(side, slot, given, &mut known) {
                    Ok(Some(bound)) => {
                        ports.insert(slot.role, bound);
                    }
                    Ok(None) => {}
                    Err(complaint) => complaints.push(complaint),
                }
            }
        }
        for input in &header.inputs {
            if !ports.values().any(|b: &Bound| b.name == input.name)
                && !complaints.iter().any(|c| c.contains(&input.name))
            {
                complaints.push(format!("nothing to feed to input {input}"));
            }
        }
        if !complaints.is_empty() {
            return Err(Misfit { bound: ports.len(), complaints });
        }
        Ok(Binding {
            part: self.part,
            family: self.family.clone(),
            ports,
            image: self.image.clone(),
            texts: self.texts.clone(),
            apply: self.apply.clone(),
            pads: self.pads.unwrap_or_default(),
            confidence_floor: self.confidence_floor,
            pixel_centre: self.pixel_centre.unwrap_or(0.5),
        })
    }

    fn bind<'s>(
        &self,
        side: &str,
        slot: &'static Slot,
        given: &[Port],
        known: &mut Vec<(&'s str, usize)>,
    ) -> Result<Option<Bound>, String>
    where
        'static: 's,
    {
        let names = self.names.get(slot.role).map(Names::list).unwrap_or_default();
        let Some(port) = names.iter().find_map(|n| given.iter().find(|p| p.name == *n)) else {
            if slot.optional && !self.needs.iter().any(|n| n == slot.role) {
                return Ok(None);
            }
            return Err(format!("no {side} for {} [{}]", slot.role, slot.shape));
        };
        let kind_fits = match port.kind {
            ElementType::Float => true,
            ElementType::Integer | ElementType::Truth => slot.integer,
            ElementType::Other => false,
        };
        if !kind_fits {
            return Err(format!("{side} {port} for {} has an element type that it cannot have", slot.role));
        }
        let Some(dims) = &port.dims else {
            return Ok(Some(Bound { name: port.name.clone(), layout: None, dims: None }));
        };
        let lengths: Vec<Option<usize>> = dims.iter().map(Dim::length).collect();
        let wanted = self.layouts.get(slot.role);
        let layout = std::iter::once(&slot.shape)
            .chain(slot.layouts)
            .filter(|l| wanted.is_none_or(|w| w == **l))
            .find(|l| unify(l, &lengths, known));
        match layout {
            Some(layout) => {
                Ok(Some(Bound { name: port.name.clone(), layout: Some(*layout), dims: Some(dims.clone()) }))
            }
            None => Err(format!("{side} {port} cannot be {} [{}]", slot.role, slot.shape)),
        }
    }
}
