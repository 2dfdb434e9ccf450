//! CLIP (Radford et al. 2021; OpenCLIP): image regions and texts in one space, any embedding width.
//! A model is an image tower or a network with a feature per pixel (LSeg), a text tower, and
//! `tokenizer.json` beside it.
use rayon::prelude::*;

use super::cache::OutputKey;
use super::classify::{crop, extents};
use super::contract::Part;
use super::graph::{Graph, GraphFile};
use super::installed::Installed;
use super::prepare::prepare;
use super::runtime::Input;
use super::text::normalise;
use super::tokens::Tokens;
use super::{RegionEncoder, things};
use crate::progress::{Progress, Silent};
use crate::scene::{Image, RgbImage};
use crate::{Error, Result};

/// Crops per forward pass: ViT-B/16 takes 0.2 GB for eight, and more are no faster on a CPU.
const BATCH: usize = 8;

/// The pair of towers. Each is loaded when first needed.
pub struct Clip {
    model: Installed,
    space: String,
    tokens: Tokens,
    image: Option<Graph>,
    text: Option<Graph>,
    dim: usize,
}

impl Clip {
    /// Checks that the towers belong together; after that they are loaded when first used.
    pub fn load(mut model: Installed) -> Result<Clip> {
        let text = model.graph(Part::TextTower)?.clone();
        if let (Some(dense), Some(dim)) =
            (model.graphs.get_mut(&Part::DenseFeatures), text.fixed("embedding", "D"))
        {
            // With a fixed image size several layouts may fit; the width of text embeddings
            // determines the feature axis.
            dense.fix_axis("features", "D", dim);
        }
        let (visual, axis) = match model.graph(Part::ImageTower) {
            Ok(tower) => (tower.clone(), "embedding"),
            Err(_) => (model.graph(Part::DenseFeatures)?.clone(), "features"),
        };
        let widths = (visual.fixed(axis, "D"), text.fixed("embedding", "D"));
        if let (Some(a), Some(b)) = widths
            && a != b
        {
            return Err(towers_differ(&visual, &text, &format!("embeddings of {a} and {b} values")));
        }
        let tokens = Tokens::of(&model, Part::TextTower)?;
        // The weights define the space: features and texts of other weights are not comparable.
        let space =
            format!("{}:{}", model.family, OutputKey::new("space").model(&visual)?.model(&text)?.short());
        let mut clip = Clip { model, space, tokens, image: None, text: None, dim: 0 };
        clip.dim = match widths.0.or(widths.1) {
            Some(dim) => dim,
            None => clip.embed_texts(&["a"])?.len(),
        };
        if !clip.model.untrained() {
            clip.check_towers_match(&visual, &text)?;
        }
        Ok(clip)
    }

    /// Refuses towers of different checkpoints: plain red, green and blue squares must each be
    /// nearest to their own name. Chance passes one pair of unrelated towers in 512.
    fn check_towers_match(&mut self, visual: &GraphFile, text: &GraphFile) -> Result<()> {
        const COLOURS: [(&str, [f32; 3]); 3] = [
            ("a red square", [0.9, 0.05, 0.05]),
            ("a green square", [0.05, 0.7, 0.1]),
            ("a blue square", [0.05, 0.1, 0.9]),
        ];
        const OTHERS: [&str; 5] =
            ["a dog", "a city street at night", "a page of text", "a person on a bicycle", "a plate of food"];
        let key = OutputKey::new("towers").model(visual)?.model(text)?;
        let seen = visual.compute.remember(key, || {
            let texts: Vec<&str> = COLOURS.iter().map(|c| c.0).chain(OTHERS).collect();
            let names = self.embed_texts(&texts)?;
            let mut cosines = Vec::new();
            for (_, rgb) in COLOURS {
                let image = RgbImage { width: 224, height: 224, data: vec![rgb; 224 * 224] };
                let shown = self.embed_regions(&image, &Image::filled(224, 224, 0), 1, &Silent)?;
                let to = |name: &[f32]| name.iter().zip(&shown).map(|(a, b)| a * b).sum::<f32>();
                cosines.extend(names.chunks_exact(self.dim.max(1)).map(to));
            }
            Ok(cosines)
        })?;
        let own = |(k, row): (usize, &[f32])| (0..row.len()).all(|j| j == k || row[j] < row[k]);
        if seen.len() == 24 && seen.chunks_exact(8).enumerate().all(own) {
            return Ok(());
        }
        Err(towers_differ(visual, text, "a red, a green and a blue square are not nearest to their names"))
    }

    fn visual(&mut self) -> Result<&mut Graph> {
        let graph = match self.image.take() {
            Some(graph) => graph,
            None => match self.model.graph(Part::ImageTower) {
                Ok(tower) => tower.load()?,
                Err(_) => self.model.graph(Part::DenseFeatures)?.load()?,
            },
        };
        Ok(self.image.insert(graph))
    }

    /// Token ids of a text with its start and end marks, cut to the context with the end mark last.
    pub fn tokens(&self, text: &str) -> Result<Vec<i64>> {
        self.tokens.ids(text)
    }

    /// Embeds every region from its own crop on black.
    fn crop_features(
        &mut self,
        image: &RgbImage,
        labels: &Image<i32>,
        count: usize,
        progress: &dyn Progress,
    ) -> Result<Vec<f32>> {
        let dim = self.dim;
        let graph = self.visual()?;
        let Some(spec) = graph.file.binding.image.clone() else {
            return Err(Error::work(format!("{}: no image range in its adapter", graph.file.path.display())));
        };
        let side = graph.file.fixed("image", "W").unwrap_or(spec.size);
        let batch = graph.file.fixed("image", "B").unwrap_or(BATCH);
        let present: Vec<_> =
            extents(labels, count).into_iter().enumerate().filter_map(|(i, e)| Some((i, e?))).collect();
        let mut all = vec![0f32; count * dim];
        for regions in present.chunks(batch) {
            progress.check()?;
            let mut crops: Vec<f32> = regions
                .par_iter()
                .flat_map_iter(|(i, e)| {
                    let mut planes = crop(image, labels, *i as i32, *e, side, 0.0);
                    for (c, plane) in planes.chunks_exact_mut(side * side).enumerate() {
                        plane.iter_mut().for_each(|v| *v = (*v - spec.mean[c]) / spec.std[c]);
                    }
                    planes
                })
                .collect();
            // A fixed batch is filled up with zeros.
            let rows = if graph.file.fixed("image", "B").is_some() { batch } else { regions.len() };
            crops.resize(rows * 3 * side * side, 0.0);
            let embedding = graph
                .run(vec![("image", Input::F32(vec![rows, 3, side, side], crops))])?
                .take("embedding")?;
            for ((i, _), row) in regions.iter().zip(embedding.data.chunks_exact(dim)) {
                all[i * dim..(i + 1) * dim].copy_from_slice(row);
            }
        }
        Ok(all)
    }

    /// Embeds every region as the sum of its pixels' features, which the caller normalises.
    fn pixel_features(&mut self, image: &RgbImage, labels: &Image<i32>, count: usize) -> Result<Vec<f32>> {
        let dim = self.dim;
        let graph = self.visual()?;
        let Some(spec) = graph.file.binding.image.clone() else {
            return Err(Error::work(format!("{}: no image range in its adapter", graph.file.path.display())));
        };
        let ready = prepare(image, &graph.file, &spec, "image");
        let features = graph.run(vec![("image", ready.input())])?.take("features")?;
        let [_, rows, columns, _] = features.shape[..] else { return Ok(vec![0.0; count * dim]) };
        let mut all = vec![0f32; count * dim];
        for (p, label) in labels.data.iter().enumerate() {
            let Some(sum) = usize::try_from(*label).ok().and_then(|l| all.chunks_exact_mut(dim).nth(l))
            else {
                continue;
            };
            let at = [(p % labels.width) as f64 + 0.5, (p / labels.width) as f64 + 0.5];
            let [u, v] = ready.from_photo.apply(at);
            let (x, y) = (cell_index(u, columns, ready.width), cell_index(v, rows, ready.height));
            let start = (y * columns + x) * dim;
            sum.iter_mut().zip(&features.data[start..]).for_each(|(s, f)| *s += f);
        }
        Ok(all)
    }
}

impl RegionEncoder for Clip {
    fn space(&self) -> &str {
        &self.space
    }

    fn dim(&self) -> usize {
        self.dim
    }

    fn embed_regions(
        &mut self,
        image: &RgbImage,
        labels: &Image<i32>,
        count: usize,
        progress: &dyn Progress,
    ) -> Result<Vec<f32>> {
        let dense = self.model.graph(Part::ImageTower).is_err();
        let graph = self.model.graph(if dense { Part::DenseFeatures } else { Part::ImageTower })?;
        let key = OutputKey::new("features").model(graph)?.values(&image.data).values(&labels.data);
        let key = key.values(&[image.width as u64, count as u64]);
        let compute = graph.compute.clone();
        let mut rows = compute.remember(key, || {
            if dense {
                self.pixel_features(image, labels, count)
            } else {
                self.crop_features(image, labels, count, progress)
            }
        })?;
        rows.chunks_exact_mut(self.dim.max(1)).for_each(normalise);
        Ok(rows)
    }

    fn embed_texts(&mut self, texts: &[&str]) -> Result<Vec<f32>> {
        let padded = texts.iter().map(|t| self.tokens.padded(t)).collect::<Result<Vec<_>>>()?;
        let file = self.model.graph(Part::TextTower)?.clone();
        let graph = match self.text.take() {
            Some(graph) => graph,
            None => file.load()?,
        };
        let graph = self.text.insert(graph);
        let mut all = Vec::new();
        // One at a time: a text's embedding must not depend on its neighbours, and some exports fix
        // the batch at 1.
        for (ids, mask) in padded {
            let shape = || vec![1, ids.len()];
            let inputs =
                vec![("tokens", Input::I64(shape(), ids.clone())), ("mask", Input::I64(shape(), mask))];
            let mut row = graph.run(inputs)?.take("embedding")?.data;
            normalise(&mut row);
            all.extend(row);
        }
        Ok(all)
    }

    fn embed_other_things(&mut self, form: &str) -> Result<Vec<f32>> {
        let texts = things::of_form(form);
        let graph = self.model.graph(Part::TextTower)?;
        let key = OutputKey::new("other-things").model(graph)?.text(&texts.join("\n"));
        let compute = graph.compute.clone();
        compute.remember(key, || self.embed_texts(&texts.iter().map(String::as_str).collect::<Vec<_>>()))
    }
}

/// Index of the cell of a coordinate, with `cells` over `pixels`.
fn cell_index(u: f64, cells: usize, pixels: usize) -> usize {
    ((u * cells as f64 / pixels as f64) as usize).min(cells - 1)
}

fn towers_differ(visual: &GraphFile, text: &GraphFile, why: &str) -> Error {
    Error::missing_model(
        visual.path.display(),
        format!(
            "{} and {} do not belong together ({why}); export both towers from one checkpoint",
            visual.path.display(),
            text.path.display()
        ),
    )
}

#[cfg(test)]
mod tests {
    use super::super::installed::Task;
    use super::super::{Compute, Registry};
    use super::*;
    use splatvk_test_support::toys::clip_in;

    #[test]
    fn cached_features_depend_on_masks() {
        let dir = tempfile::tempdir().unwrap();
        clip_in(dir.path(), [0, 1, 2]);
        let registry = Registry::with(Some(dir.path()), Compute::by(Some("cpu"))).unwrap();
        let mut clip = Clip::load(registry.installed(Task::Features, "clip").unwrap()).unwrap();
        // Red above, blue below, and a mask of each half; then with the masks exchanged.
        let data = (0..640).map(|p| if p < 320 { [1.0, 0.0, 0.0] } else { [0.0, 0.0, 1.0] }).collect();
        let image = RgbImage { width: 32, height: 20, data };
        let mut first_is_red = |labels: [i32; 2]| {
            let data = (0..640).map(|p| labels[p / 320]).collect();
            let labels = Image { width: 32, height: 20, data };
            let rows = clip.embed_regions(&image, &labels, 2, &Silent).unwrap();
            rows[0] > rows[2]
        };
        assert_eq!((first_is_red([0, 1]), first_is_red([1, 0])), (true, false));
    }

    /// A tokenizer of SentencePiece with a mark at the end of a text, as SigLIP's.
    const UNIGRAM: &str = r#"{"version": "1.0", "truncation": null, "padding": null, "normalizer": null,
        "added_tokens": [{"id": 1, "content": "</s>", "single_word": false, "lstrip": false, "rstrip": false,
                          "normalized": false, "special": true}],
        "pre_tokenizer": {"type": "Whitespace"}, "decoder": null,
        "post_processor": {"type": "TemplateProcessing", "pair": [],
            "single": [{"Sequence": {"id": "A", "type_id": 0}}, {"SpecialToken": {"id": "</s>", "type_id": 0}}],
            "special_tokens": {"</s>": {"id": "</s>", "ids": [1], "tokens": ["</s>"]}}},
        "model": {"type": "Unigram", "unk_id": 0, "byte_fallback": false,
                  "vocab": [["[UNK]", 0.0], ["</s>", 0.0], ["a", -1.0], ["red", -1.0]]}}"#;

    #[test]
    fn unknown_tokenizer_is_refused_unless_described() {
        let dir = tempfile::tempdir().unwrap();
        clip_in(dir.path(), [0, 1, 2]);
        let at = |name: &str| dir.path().join("clip_toy").join(name);
        std::fs::write(at("tokenizer.json"), UNIGRAM).unwrap();
        let load = || {
            let registry = Registry::with(Some(dir.path()), Compute::by(Some("cpu"))).unwrap();
            Clip::load(registry.installed(Task::Features, "clip").unwrap()).map(|clip| clip.tokens("Red, a!"))
        };
        let refused = load().err().unwrap().to_string();
        assert!(refused.contains("has 4 tokens") && refused.contains("49408"), "{refused}");
        let describe = |end: u32| {
            let texts = format!(
                "{{ vocabulary = 4, context = 8, pad = 1, end = {end}, lower = true, punctuation = false }}"
            );
            let graph = format!("[[graph]]\npart = \"text-tower\"\ntexts = [{texts}]\n");
            let adapter = format!("family = \"clip\"\nuntrained = true\n{graph}");
            std::fs::write(at("adapter.toml"), adapter).unwrap();
        };
        describe(1);
        assert_eq!(load().unwrap().unwrap(), [3, 2, 1]);
        describe(2);
        let refused = load().err().unwrap().to_string();
        assert!(refused.contains("does not end a text with token 2"), "{refused}");
    }
}
