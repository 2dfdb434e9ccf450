//! Networks that predict masks at point prompts (SAM, SAM 2 and networks with their interfaces).
use super::contract::Part;
use super::graph::{Graph, GraphFile};
use super::installed::Installed;
use super::prepare::{Prepared, prepare};
use super::runtime::{Input, Tensor};
use crate::scene::RgbImage;
use crate::{Error, Result};

/// Prompts per decoder call: 16 keep ViT-B's decoder below 0.5 GB; more are no faster on a CPU.
pub const BATCH: usize = 16;

/// Encoder and decoder, both loaded.
pub struct Sam {
    encoder: Graph,
    decoder: Graph,
}

/// Encoder outputs of an image.
pub struct Encoded {
    ready: Prepared,
    tensors: Vec<(&'static str, Tensor)>,
}

/// Decoder outputs of some points: three masks each, subpart, part and whole.
pub struct Proposals {
    /// Logit maps [points][3], each `width` × `height`.
    pub logits: Vec<f32>,
    /// Predicted IoU [points][3].
    pub scores: Vec<f32>,
    /// Columns of a map.
    pub width: usize,
    /// Rows of a map.
    pub height: usize,
    /// Share of the columns and rows that shows the image; the rest is padding.
    pub filled: [f64; 2],
}

/// Masks of a point. A decoder with four gives a single best mask first.
pub const MASKS: usize = 3;

impl Sam {
    /// Loads both graphs; refuses a decoder with a single mask per point, which cannot give three
    /// levels.
    pub fn load(model: &Installed) -> Result<Sam> {
        let decoder = model.graph(Part::MaskDecoder)?;
        if decoder.fixed("scores", "M").or(decoder.fixed("masks", "M")).is_some_and(|m| m < MASKS) {
            return Err(too_few(decoder));
        }
        Ok(Sam { encoder: model.graph(Part::MaskEncoder)?.load()?, decoder: decoder.load()? })
    }

    /// Encodes an image.
    pub fn encode(&mut self, image: &RgbImage) -> Result<Encoded> {
        let file = &self.encoder.file;
        let spec =
            file.binding.image.as_ref().ok_or_else(|| {
                Error::work(format!("{}: its adapter has no image range", file.path.display()))
            })?;
        let ready = prepare(image, file, spec, "image");
        let mut outputs = self.encoder.run(vec![("image", ready.input())])?;
        let mut tensors = vec![("embedding", outputs.take("embedding")?)];
        for role in ["high0", "high1", "position"] {
            tensors.extend(outputs.maybe(role).map(|t| (role, t)));
        }
        Ok(Encoded { ready, tensors })
    }

    /// Predicts masks at points of the encoded image (pixels, centre of the first at 0.5); at most
    /// [`BATCH`].
    pub fn decode(&mut self, image: &Encoded, points: &[[f64; 2]]) -> Result<Proposals> {
        let at_once = self.decoder.file.fixed("points", "P").unwrap_or(points.len()).max(1);
        let mut all = Proposals {
            logits: Vec::new(),
            scores: Vec::new(),
            width: 0,
            height: 0,
            filled: [0, 1]
                .map(|k| image.ready.filled[k] as f64 / [image.ready.width, image.ready.height][k] as f64),
        };
        for some in points.chunks(at_once) {
            self.decode_some(image, some, at_once, &mut all)?;
        }
        Ok(all)
    }

    fn decode_some(
        &mut self,
        image: &Encoded,
        points: &[[f64; 2]],
        rows: usize,
        all: &mut Proposals,
    ) -> Result<()> {
        let file = &self.decoder.file;
        // SAM was trained with a padding point after a single point; some graphs add it themselves.
        let padding = usize::from(!file.binding.pads);
        let count = 1 + padding;
        let rows = if file.fixed("points", "P").is_some() { rows } else { points.len() };
        let (mut coords, mut labels) = (vec![0f32; rows * count * 2], vec![-1i64; rows * count]);
        for (k, point) in points.iter().enumerate() {
            let at = image.ready.from_photo.apply(*point);
            coords[2 * k * count] = at[0] as f32;
            coords[2 * k * count + 1] = at[1] as f32;
            labels[k * count] = 1;
        }
        let side = |axis, or: usize| file.fixed("mask", axis).unwrap_or(or);
        let low = [side("m", 256), side("n", 256)];
        let mask_rows = file.fixed("mask", "b").unwrap_or(rows);
        let mut fed = vec![
            ("points", Input::F32(vec![rows, count, 2], coords)),
            ("labels", Input::I64(vec![rows, count], labels)),
            // No boxes; the batch is one image.
            ("boxes", Input::F32(vec![1, 0, 4], Vec::new())),
            ("mask", Input::F32(vec![mask_rows, 1, low[0], low[1]], vec![0.0; mask_rows * low[0] * low[1]])),
            ("has_mask", Input::F32(vec![1], vec![0.0])),
            // Only the low-resolution logits are used; the graph's own enlargement is kept small.
            ("size", Input::F32(vec![2], vec![low[0] as f32, low[1] as f32])),
        ];
        for (role, tensor) in &image.tensors {
            fed.push((*role, Input::F32(tensor.shape.clone(), tensor.data.clone())));
        }
        let mut outputs = self.decoder.run(fed)?;
        let (masks, scores) = (outputs.take("masks")?, outputs.take("scores")?);
        let ([p, m, h, w], [_, n]) = (&masks.shape[..], &scores.shape[..]) else { return Ok(()) };
        let (p, m, h, w) = (*p, *m, *h, *w);
        if m < MASKS || *n != m || p < points.len() {
            return Err(too_few(&self.decoder.file));
        }
        (all.width, all.height) = (w, h);
        for k in 0..points.len() {
            let first = k * m + (m - MASKS);
            all.logits.extend_from_slice(&masks.data[first * w * h..(first + MASKS) * w * h]);
            all.scores.extend_from_slice(&scores.data[first..first + MASKS]);
        }
        Ok(())
    }
}

fn too_few(decoder: &GraphFile) -> Error {
    Error::missing_model(
        decoder.path.display(),
        format!(
            "{}: gives fewer than three masks per point, but the three levels need them; export it without --return-single-mask",
            decoder.path.display()
        ),
    )
}
