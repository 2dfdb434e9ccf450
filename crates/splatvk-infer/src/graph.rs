//! A loaded graph with inputs and outputs by role: layouts, element types and activations are
//! handled here.
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use super::adapter::{Adapter, Binding};
use super::cache::{OutputKey, fingerprint};
use super::compute::Compute;
use super::contract::{Slot, reorder, unify};
use super::onnx::{self, Dim, Header};
use super::runtime::{Input, Session, Tensor};
use crate::{Error, Result};

/// A file with its checksum.
#[derive(Clone, Debug, PartialEq)]
pub struct HashedFile {
    /// Its path.
    pub path: PathBuf,
    /// Its sha256 in hexadecimal digits.
    pub sha256: String,
}

/// A model file that was recognised, not yet loaded.
#[derive(Clone, Debug)]
pub struct GraphFile {
    /// Its path.
    pub path: PathBuf,
    /// Its part, and the roles of its tensors.
    pub binding: Binding,
    /// Checkpoint that the adapter names.
    pub checkpoint: Option<String>,
    /// Whether the weights are untrained.
    pub untrained: bool,
    /// Number of weights.
    pub parameters: u64,
    /// Version of the operators.
    pub opset: i64,
    /// Files with the rest of the weights.
    pub external: Vec<PathBuf>,
    /// The sha256 that the adapter pins of these files.
    pub pinned: Vec<HashedFile>,
    /// Execution settings.
    pub compute: Compute,
}

impl GraphFile {
    /// Reads the file's header and finds its part; the error names the file and the remedy.
    pub fn recognise(path: &Path) -> Result<GraphFile> {
        let header: Header = onnx::read(path)?;
        let adapter = Adapter::of_file(path)?;
        let binding = adapter.fit(path, &header)?;
        if let Some(absent) = header.external.iter().find(|p| !p.is_file()) {
            return Err(Error::missing_model(
                path.display(),
                format!(
                    "{}: its weights are in {}, which is missing; put that file beside it under the same name",
                    path.display(),
                    absent.display()
                ),
            ));
        }
        let pin = |p: &PathBuf| {
            let name = p.file_name()?.to_str()?;
            Some(HashedFile { path: p.clone(), sha256: adapter.sha256.get(name)?.to_ascii_lowercase() })
        };
        let own = path.to_path_buf();
        Ok(GraphFile {
            pinned: std::iter::once(&own).chain(&header.external).filter_map(pin).collect(),
            path: own,
            binding,
            checkpoint: adapter.checkpoint,
            untrained: adapter.untrained,
            parameters: header.parameters,
            opset: header.opset,
            external: header.external,
            compute: Compute::default(),
        })
    }

    /// Size of this file and those with its weights, bytes.
    pub fn bytes(&self) -> u64 {
        let size = |p: &PathBuf| std::fs::metadata(p).map_or(0, |m| m.len());
        size(&self.path) + self.external.iter().map(size).sum::<u64>()
    }

    /// The length of an axis of a role's tensor, if the file fixes it.
    pub fn fixed(&self, role: &str, axis: &str) -> Option<usize> {
        let bound = self.binding.ports.get(role)?;
        let place = super::contract::axes(bound.layout?).position(|a| a == axis)?;
        bound.dims.as_ref()?.get(place)?.length()
    }

    /// Selects the first layout that the lengths of an output allow and in which `axis` has
    /// `length`, if there is one.
    pub(super) fn fix_axis(&mut self, role: &str, axis: &str, length: usize) {
        let Some(slot) = self.binding.part.contract().slot(role) else { return };
        let Some(bound) = self.binding.ports.get_mut(role) else { return };
        let Some(dims) = &bound.dims else { return };
        let lengths: Vec<Option<usize>> = dims.iter().map(Dim::length).collect();
        let has = |layout: &&&'static str| unify(layout, &lengths, &mut vec![(axis, length)]);
        let own = bound.layout;
        if let Some(layout) = own.iter().chain(std::iter::once(&slot.shape)).chain(slot.layouts).find(has) {
            bound.layout = Some(*layout);
        }
    }

    /// Whether the graph has a tensor for the role.
    pub fn has(&self, role: &str) -> bool {
        self.binding.ports.contains_key(role)
    }

    /// Checks the pinned sha256 of the files and loads the graph.
    pub fn load(&self) -> Result<Graph> {
        for HashedFile { path: file, sha256: wanted } in &self.pinned {
            let found = fingerprint(file).map_err(Error::io(file))?;
            if found != *wanted {
                return Err(Error::missing_model(
                    file.display(),
                    format!(
                        "{}: has sha256 {found}, its adapter pins {wanted}; copy or export it again",
                        file.display()
                    ),
                ));
            }
        }
        let session = Session::load_sized(&self.path, self.bytes(), &self.compute).map_err(|e| match e {
            Error::MissingModel { model, message: text } if text.contains("pset") => Error::missing_model(model, format!(
                "{text}; the file asks for operator set {}: export it with opset_version=17, or install a newer ONNX Runtime",
                self.opset
            )),
            e => e,
        })?;
        Ok(Graph { session, file: self.clone() })
    }
}

/// A loaded graph. Dropping it frees its memory.
pub struct Graph {
    session: Session,
    /// Its file.
    pub file: GraphFile,
}

/// Outputs of a graph, by role.
#[derive(Debug, Default)]
pub struct Outputs {
    values: BTreeMap<&'static str, Tensor>,
    file: String,
}

impl Outputs {
    /// Takes the tensor of a role that the contract demands.
    pub fn take(&mut self, role: &str) -> Result<Tensor> {
        self.values.remove(role).ok_or_else(|| Error::work(format!("{}: gave no {role}", self.file)))
    }

    /// Takes the tensor of an optional role.
    pub fn maybe(&mut self, role: &str) -> Option<Tensor> {
        self.values.remove(role)
    }
}

impl Graph {
    /// Runs the graph on tensors in the layout of the contract; roles that the graph lacks are
    /// ignored.
    pub fn run(&mut self, inputs: Vec<(&'static str, Input)>) -> Result<Outputs> {
        let contract = self.file.binding.part.contract();
        let name = self.file.path.display().to_string();
        let mut fed = Vec::with_capacity(inputs.len());
        let mut known = Vec::new();
        for (role, input) in inputs {
            let (Some(bound), Some(slot)) = (self.file.binding.ports.get(role), contract.slot(role)) else {
                continue;
            };
            let lengths: Vec<Option<usize>> = input.shape().iter().map(|n| Some(*n)).collect();
            // Inputs fix the axes that outputs share with them.
            unify(slot.shape, &lengths, &mut known);
            let input = match bound.layout {
                Some(layout) if layout != slot.shape => input.relaid(slot.shape, layout),
                _ => Some(input),
            };
            let input = input.ok_or_else(|| Error::work(format!("{name}: {role} has the wrong shape")))?;
            fed.push((bound.name.clone(), input));
        }
        let wanted: Vec<(&'static Slot, &str)> = contract
            .outputs
            .iter()
            .filter_map(|s| self.file.binding.ports.get(s.role).map(|b| (s, b.name.as_str())))
            .collect();
        let names: Vec<&str> = wanted.iter().map(|w| w.1).collect();
        let tensors = self.session.run(fed, &names)?;
        let mut values = BTreeMap::new();
        for ((slot, tensor_name), tensor) in wanted.into_iter().zip(tensors) {
            let mut tensor = self.canonical(slot, tensor_name, tensor, &mut known)?;
            if let Some(bad) = tensor.data.iter().find(|v| !v.is_finite()) {
                return Err(Error::work(format!(
                    "{name}: output {tensor_name} holds {bad}; export the model in float32 and check it against PyTorch"
                )));
            }
            if let Some(activation) = self.file.binding.activation(slot.role) {
                activation.apply(&mut tensor);
            }
            values.insert(slot.role, tensor);
        }
        Ok(Outputs { values, file: name })
    }

    /// Converts a tensor from any known layout to the contract's.
    fn canonical<'s>(
        &self,
        slot: &'static Slot,
        name: &str,
        tensor: Tensor,
        known: &mut Vec<(&'s str, usize)>,
    ) -> Result<Tensor>
    where
        'static: 's,
    {
        let shape = tensor.shape.clone();
        let lengths: Vec<Option<usize>> = shape.iter().map(|n| Some(*n)).collect();
        let bound = self.file.binding.ports.get(slot.role).and_then(|b| b.layout);
        let candidates: Vec<&'static str> = match bound {
            Some(layout) => vec![layout],
            None => std::iter::once(slot.shape).chain(slot.layouts.iter().copied()).collect(),
        };
        let layout = candidates.into_iter().find(|l| unify(l, &lengths, known));
        layout.and_then(|l| relayout(tensor, l, slot.shape)).ok_or_else(|| {
            Error::work(format!(
                "{}: output {name} came as {shape:?}, which cannot be {} [{}]; are two outputs swapped?",
                self.file.path.display(),
                slot.role,
                slot.shape
            ))
        })
    }
}

impl OutputKey {
    /// Adds the content of a model's files and their adapters.
    pub fn model(mut self, graph: &GraphFile) -> Result<OutputKey> {
        for file in std::iter::once(&graph.path).chain(&graph.external) {
            self = self.text(&fingerprint(file).map_err(crate::Error::io(file))?);
        }
        Ok(self.text(&format!("{:?}", graph.binding)))
    }
}

/// [`reorder`] of a tensor.
pub fn relayout(tensor: Tensor, from: &str, to: &str) -> Option<Tensor> {
    let (shape, data) = reorder(tensor.shape, tensor.data, from, to)?;
    Some(Tensor { shape, data })
}

#[cfg(test)]
mod tests {
    use super::*;
    use splatvk_test_support::onnx::{FLOAT, Onnx};

    #[test]
    fn output_key_depends_on_adapter() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("graph.onnx");
        Onnx::new()
            .input("pixel_values", FLOAT, "batch 3 16 16")
            .output("image_embeds", "batch 3")
            .write(&path);
        let key = || OutputKey::new("test").model(&GraphFile::recognise(&path).unwrap()).unwrap().short();
        let plain = key();
        assert_eq!(key(), plain);
        // The same file with another input range.
        let adapter = "family = \"clip\"\n[[graph]]\npart = \"image-tower\"\n\
                       image = { mean = [0.5, 0.5, 0.5], std = [0.5, 0.5, 0.5], size = 16 }";
        std::fs::write(path.with_extension("toml"), adapter).unwrap();
        assert_ne!(key(), plain);
    }
}
