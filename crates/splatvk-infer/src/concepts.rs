//! Networks that find all instances of a text in a photo (SAM 3, Carion et al. 2025): an image
//! encoder, a text encoder and a decoder, with CLIP's `tokenizer.json` beside them.
use std::collections::BTreeMap;

use rayon::prelude::*;

use super::cache::OutputKey;
use super::contract::Part;
use super::graph::Graph;
use super::installed::Installed;
use super::prepare::prepare;
use super::runtime::{Input, Tensor};
use super::tokens::Tokens;
use crate::scene::{Affine, Image, RgbImage};
use crate::{Error, Result};

/// Least score of an instance: that of the network's own post-processing.
pub const LEAST_SCORE: f32 = 0.5;

/// Roles of the feature maps that go from the image encoder to the decoder.
const LEVELS: [&str; 4] = ["level0", "level1", "level2", "position2"];

/// Numbers of [`Detections::packed`] before the instances.
const HEAD: usize = 7;

/// A concept network. Its graphs are loaded when first needed: the text encoder, then the other
/// two.
pub struct Concepts {
    model: Installed,
    tokens: Tokens,
    texts: BTreeMap<String, EncodedText>,
    image: Option<(Graph, Graph)>,
}

/// Text inputs of the decoder.
struct EncodedText {
    /// [1, L, E] features of the tokens.
    features: Tensor,
    /// [1, L] 1 for tokens of the text.
    mask: Vec<i64>,
}

/// Image inputs of the decoder.
struct EncodedImage {
    levels: Vec<(&'static str, Tensor)>,
    /// Photo pixels → share of the network's input.
    from_photo: Affine,
}

/// One instance of a text in a photo.
#[derive(Clone, Debug, PartialEq)]
pub struct Instance {
    /// Probability of the instance times that of the text's presence, in [`LEAST_SCORE`]..1.
    pub score: f32,
    /// [h, w] logits of its mask at the resolution of the network.
    pub logits: Image<f32>,
}

/// Instances of a text in a photo.
#[derive(Clone, Debug, PartialEq)]
pub struct Detections {
    /// Instances with at least [`LEAST_SCORE`] and a pixel, best first.
    pub instances: Vec<Instance>,
    /// Best score of all candidates, 0 to 1.
    pub best: f32,
    /// Photo pixels → mask pixels.
    from_photo: Affine,
}

impl Concepts {
    /// Reads the tokenizer of a model.
    pub fn load(model: Installed) -> Result<Concepts> {
        let tokens = Tokens::of(&model, Part::ConceptText)?;
        Ok(Concepts { model, tokens, texts: BTreeMap::new(), image: None })
    }

    /// Name of the model.
    pub fn name(&self) -> &str {
        &self.model.name
    }

    /// Finds every one of `texts` in a photo. Results are cached by the content of photo and model.
    pub fn find(&mut self, photo: &RgbImage, texts: &[&str]) -> Result<Vec<Detections>> {
        let mut encoded = None;
        let mut all = Vec::with_capacity(texts.len());
        for text in texts {
            let mut key = OutputKey::new("concepts").text(text).values(&photo.data);
            for part in [Part::ConceptImage, Part::ConceptText, Part::ConceptDecoder] {
                key = key.model(self.model.graph(part)?)?;
            }
            let key = key.values(&[photo.width as u64]).values(&[LEAST_SCORE]);
            let compute = self.model.compute();
            let packed = compute.remember(key, || {
                // The weights of both encoders need not be in memory at once.
                self.encode_texts(texts)?;
                let image = match encoded.take() {
                    Some(image) => image,
                    None => self.encode(photo)?,
                };
                let found = self.decode(encoded.insert(image), text)?;
                Ok(found.packed())
            })?;
            let found = Detections::unpacked(&packed);
            all.push(
                found.ok_or_else(|| {
                    Error::work("the cache of networks is damaged; splatvk clean removes it")
                })?,
            );
        }
        Ok(all)
    }

    /// Encodes texts that were not asked before, and frees the text encoder.
    fn encode_texts(&mut self, texts: &[&str]) -> Result<()> {
        let new: Vec<&str> = texts.iter().filter(|t| !self.texts.contains_key(**t)).copied().collect();
        if new.is_empty() {
            return Ok(());
        }
        let mut graph = self.model.graph(Part::ConceptText)?.load()?;
        for text in new {
            let (ids, mask) = self.tokens.padded(text)?;
            let shape = || vec![1, ids.len()];
            let inputs = vec![
                ("tokens", Input::I64(shape(), ids.clone())),
                ("mask", Input::I64(shape(), mask.clone())),
            ];
            let mut outputs = graph.run(inputs)?;
            // A graph that gives the mask of its features knows which of them count.
            let own = outputs.maybe("text_mask");
            let mask = own.map_or(mask, |own| own.data.iter().map(|v| i64::from(*v != 0.0)).collect());
            self.texts.insert(text.to_owned(), EncodedText { features: outputs.take("text")?, mask });
        }
        Ok(())
    }

    fn graphs(&mut self) -> Result<&mut (Graph, Graph)> {
        let pair = match self.image.take() {
            Some(pair) => pair,
            None => {
                let load = |part| self.model.graph(part)?.load();
                (load(Part::ConceptImage)?, load(Part::ConceptDecoder)?)
            }
        };
        Ok(self.image.insert(pair))
    }

    fn encode(&mut self, photo: &RgbImage) -> Result<EncodedImage> {
        let (encoder, _) = self.graphs()?;
        let file = &encoder.file;
        let spec =
            file.binding.image.as_ref().ok_or_else(|| {
                Error::work(format!("{}: its adapter has no image range", file.path.display()))
            })?;
        let ready = prepare(photo, file, spec, "image");
        let mut outputs = encoder.run(vec![("image", ready.input())])?;
        let take = |role| Ok((role, outputs.take(role)?));
        let levels = LEVELS.into_iter().map(take).collect::<Result<_>>()?;
        let share = Affine { scale: [1.0 / ready.width as f64, 1.0 / ready.height as f64], offset: [0.0; 2] };
        Ok(EncodedImage { levels, from_photo: ready.from_photo.then(&share) })
    }

    fn decode(&mut self, image: &EncodedImage, text: &str) -> Result<Detections> {
        let Some(EncodedText { features, mask }) = self.texts.remove(text) else {
            return Err(Error::work(format!("text {text:?} was not encoded")));
        };
        let fed = |t: &Tensor| Input::F32(t.shape.clone(), t.data.clone());
        let mut inputs: Vec<_> = image.levels.iter().map(|(role, t)| (*role, fed(t))).collect();
        inputs.push(("text", fed(&features)));
        inputs.push(("text_mask", Input::I64(vec![1, mask.len()], mask.clone())));
        self.texts.insert(text.to_owned(), EncodedText { features, mask });
        let (_, decoder) = self.graphs()?;
        let mut outputs = decoder.run(inputs)?;
        let (masks, scores) = (outputs.take("masks")?, outputs.take("scores")?);
        // Exports without the presence head leave the scores as they are.
        let presence = outputs.maybe("presence").and_then(|t| t.data.first().copied()).unwrap_or(1.0);
        if let Some(bad) = scores.data.iter().chain([&presence]).find(|s| !(0.0..=1.0).contains(*s)) {
            let path = decoder.file.path.display();
            return Err(Error::missing_model(
                path.to_string(),
                format!(
                    "{path}: a score of {bad} is no probability; state apply.scores and apply.presence in its adapter"
                ),
            ));
        }
        Detections::new(&masks, &scores.data, presence, image.from_photo)
    }
}

impl Detections {
    /// Selects the instances of masks [1, Q, h, w] with scores [1, Q].
    fn new(masks: &Tensor, scores: &[f32], presence: f32, from_photo: Affine) -> Result<Detections> {
        let [_, _, height, width] = masks.shape[..] else {
            return Err(Error::work("masks without four axes"));
        };
        let maps = masks.data.chunks_exact((width * height).max(1));
        let mut instances: Vec<Instance> = maps
            .zip(scores)
            .map(|(map, score)| (map, score * presence))
            .filter(|(map, score)| *score >= LEAST_SCORE && map.iter().any(|v| *v > 0.0))
            .map(|(map, score)| Instance { score, logits: Image { width, height, data: map.to_vec() } })
            .collect();
        instances.sort_by(|a, b| b.score.total_cmp(&a.score));
        let best = scores.iter().fold(0f32, |best, score| best.max(score * presence));
        let mask_pixels = Affine { scale: [width as f64, height as f64], offset: [0.0; 2] };
        Ok(Detections { instances, best, from_photo: from_photo.then(&mask_pixels) })
    }

    /// [H, W] pixels of a photo in any of the instances: those whose logit, interpolated
    /// bilinearly, is positive.
    pub fn mask(&self, width: usize, height: usize) -> Image<bool> {
        let inside = |p: usize| {
            let pixel = [(p % width) as f64 + 0.5, (p / width) as f64 + 0.5];
            let at = self.from_photo.apply(pixel).map(|u| u - 0.5);
            self.instances.iter().any(|i| bilinear(&i.logits, at) > 0.0)
        };
        Image { width, height, data: (0..width * height).into_par_iter().map(inside).collect() }
    }

    /// Numbers for the cache.
    fn packed(&self) -> Vec<f32> {
        let (width, height) = self.instances.first().map_or((0, 0), |i| (i.logits.width, i.logits.height));
        let Affine { scale, offset } = self.from_photo;
        let map = [scale[0], scale[1], offset[0], offset[1]].map(|v| v as f32);
        let mut all = vec![self.best, width as f32, height as f32];
        all.extend(map);
        for instance in &self.instances {
            all.push(instance.score);
            all.extend_from_slice(&instance.logits.data);
        }
        all
    }

    fn unpacked(packed: &[f32]) -> Option<Detections> {
        let (head, rest) = packed.split_first_chunk::<HEAD>()?;
        let [best, width, height, ..] = *head;
        let (width, height) = (width as usize, height as usize);
        let map = [3, 4, 5, 6].map(|k| f64::from(head[k]));
        let instance = |values: &[f32]| Instance {
            score: values[0],
            logits: Image { width, height, data: values[1..].to_vec() },
        };
        Some(Detections {
            instances: rest.chunks_exact(1 + width * height).map(instance).collect(),
            best,
            from_photo: Affine { scale: [map[0], map[1]], offset: [map[2], map[3]] },
        })
    }
}

/// Value of a map between its pixels; (0, 0) is the centre of the first. The border continues
/// outside.
fn bilinear(map: &Image<f32>, at: [f64; 2]) -> f32 {
    let axis = |u: f64, size: usize| {
        let u = u.clamp(0.0, (size - 1) as f64);
        let first = (u as usize).min(size.saturating_sub(2));
        (first, (first + 1).min(size - 1), (u - first as f64) as f32)
    };
    let ((x0, x1, a), (y0, y1, b)) = (axis(at[0], map.width), axis(at[1], map.height));
    let row = |y: usize| map.at(x0, y) * (1.0 - a) + map.at(x1, y) * a;
    row(y0) * (1.0 - b) + row(y1) * b
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two maps of 4 × 2 pixels: the left half, and a candidate without a score.
    fn halves(presence: f32) -> Detections {
        let left = [1.0, 1.0, -1.0, -1.0].repeat(2);
        let masks = Tensor { shape: vec![1, 2, 2, 4], data: [left, vec![1.0; 8]].concat() };
        let share = Affine { scale: [1.0 / 16.0, 1.0 / 8.0], offset: [0.0; 2] };
        Detections::new(&masks, &[0.9, 0.3], presence, share).unwrap()
    }

    #[test]
    fn presence_scales_scores() {
        let found = halves(0.8);
        assert!((found.best - 0.72).abs() < 1e-6 && found.instances.len() == 1, "{found:?}");
        let mask = found.mask(16, 8);
        // The logit crosses zero in the middle of the photo.
        assert!((0..128).all(|p| mask.data[p] == (p % 16 < 8)), "{mask:?}");
        let absent = halves(0.1);
        assert!((absent.best - 0.09).abs() < 1e-6 && absent.instances.is_empty());
        assert!(!absent.mask(16, 8).data.contains(&true));
        // A candidate with a score and without a pixel is no instance.
        let empty = Tensor { shape: vec![1, 1, 1, 2], data: vec![-1.0; 2] };
        let empty = Detections::new(&empty, &[0.9], 1.0, Affine::IDENTITY).unwrap();
        assert!(empty.instances.is_empty() && empty.best == 0.9);
    }

    #[test]
    fn unpacked_equals_packed() {
        for found in [halves(1.0), halves(0.1)] {
            assert_eq!(Detections::unpacked(&found.packed()), Some(found));
        }
    }

    #[test]
    fn bilinear_interpolates_and_continues() {
        let map = Image { width: 2, height: 2, data: vec![0.0, 1.0, 2.0, 3.0] };
        for (at, value) in [([0.5, 0.5], 1.5), ([-3.0, 1.0], 2.0), ([9.0, 9.0], 3.0)] {
            assert_eq!(bilinear(&map, at), value, "{at:?}");
        }
        assert_eq!(bilinear(&Image { width: 1, height: 1, data: vec![4.0] }, [0.3, 0.0]), 4.0);
    }
}
