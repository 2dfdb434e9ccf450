//! Features in 2D, without a scene (the rows "LSeg" and "SAM + LSeg" of the paper's comparison with
//! LSM): an encoder's features of the cells of a grid, or of the masks of a photo. Every cell or
//! mask is a code of its own, so that the rules of the protocols apply unchanged.
use super::data::DataSet;
use super::stages::{Scored, queries_for};
use crate::Result;
use crate::protocol::{self, CodeScores, DecodedView, ProtocolKind};
use splatvk::eval::{Evaluation, GroundTruth, Rendered, Split, TruthFrame};
use splatvk::language::ViewMasks;
use splatvk::progress::Progress;
use splatvk::query::{QueryOptions, TextQuery, answer_with, field_relevancy};
use splatvk::run::stages::SharedEncoder;
use splatvk::scene::{Camera, Codebook, Image, LanguageField, LevelField, RgbImage};

/// Side of a cell, pixels. LSeg's features have half the size of its input, which has about half
/// the size of a LERF photo.
const CELL: usize = 4;

/// A photo with features of its own pixels.
pub(super) struct FlatPhoto {
    field: LanguageField,
    /// Code per level and pixel, −1 = none.
    codes: Vec<Image<i32>>,
}

/// Computes the features of the cells of a photo; the field has one level.
pub(super) fn of_cells(
    image: &RgbImage,
    encoder: &SharedEncoder,
    progress: &dyn Progress,
) -> Result<FlatPhoto> {
    let (columns, rows) = (image.width.div_ceil(CELL), image.height.div_ceil(CELL));
    let cell_index = |p: usize| (p / image.width / CELL * columns + p % image.width / CELL) as i32;
    let labels = Image {
        width: image.width,
        height: image.height,
        data: (0..image.width * image.height).map(cell_index).collect(),
    };
    let (embedding_dim, embeddings) =
        encoder.with(|e| e.embed_regions(image, &labels, columns * rows, progress).map(|f| (e.dim(), f)))?;
    let codebook = Codebook { embedding_dim, embeddings, ..Codebook::default() };
    let level = LevelField { codebook, ..LevelField::default() };
    let field = LanguageField { levels: vec![level], space: encoder.space().to_owned() };
    Ok(FlatPhoto { field, codes: vec![labels] })
}

/// The features of the masks of a photo, on every level.
pub(super) fn of_masks(masks: ViewMasks, space: &str) -> FlatPhoto {
    let (mut levels, mut codes) = (Vec::new(), Vec::new());
    for level in masks.levels {
        let embedding_dim = level.features.len().checked_div(level.quality.len()).unwrap_or(0);
        let codebook = Codebook { embedding_dim, embeddings: level.features, ..Codebook::default() };
        levels.push(LevelField { codebook, ..LevelField::default() });
        codes.push(level.labels);
    }
    FlatPhoto { field: LanguageField { levels, space: space.to_owned() }, codes }
}

/// Scores every frame by protocol `field`.
pub(super) fn field(
    truth: &GroundTruth,
    queries: &[TextQuery],
    progress: &dyn Progress,
    photo_of: &mut dyn FnMut(&TruthFrame) -> Result<FlatPhoto>,
) -> Result<Scored> {
    let train = truth.frames.iter().filter(|f| f.split == Split::Train);
    let cameras: Vec<Camera> = train.map(|f| f.camera.clone()).collect();
    let mut evaluation = Evaluation::new(truth.clone(), &cameras, None)?;
    let labels: Vec<u32> = evaluation.phrases().into_iter().map(|p| p.0).collect();
    progress.begin("eval", truth.frames.len() as u64);
    for (k, frame) in truth.frames.iter().enumerate() {
        progress.check()?;
        let rgb = truth.image(frame)?;
        let FlatPhoto { field, codes } = photo_of(frame)?;
        let mut answers = Vec::new();
        for (label, query) in labels.iter().zip(queries) {
            let relevancy = field_relevancy(&field, query)?;
            answers.push((*label, answer_with(&codes, &relevancy, &QueryOptions::default())?));
        }
        let depth = Image::filled(rgb.width, rgb.height, 0.0);
        let alpha = Image::filled(rgb.width, rgb.height, 1.0);
        evaluation.add_frame(frame, &Rendered { rgb, filled: None, alpha, depth }, &answers)?;
        progress.step(k as u64 + 1, "");
    }
    progress.end();
    // Nothing was rendered: these figures compare photos with themselves.
    let mut report = evaluation.finish();
    report.images.clear();
    Ok(Scored { report, ..Scored::default() })
}

/// Scores every labelled photo by a published protocol.
pub(super) fn published(
    data: &DataSet,
    kind: ProtocolKind,
    queries: &[TextQuery],
    progress: &dyn Progress,
    photo_of: &mut dyn FnMut(&TruthFrame) -> Result<FlatPhoto>,
) -> Result<Scored> {
    // Each photo is its own view; its pose does not matter.
    let cameras: Vec<Camera> =
        data.truth.frames.iter().map(|f| Camera { name: f.stem.clone(), ..f.camera.clone() }).collect();
    let mut protocol = protocol::open(kind, &data.labels, &cameras, &[])?;
    let queries = queries_for(&protocol.prompts(), queries);
    let views = protocol.views().to_vec();
    progress.begin("eval", views.len() as u64);
    for (k, view) in views.iter().enumerate() {
        progress.check()?;
        let Some(frame) = data.truth.frames.iter().find(|f| f.stem == view.stem) else { continue };
        let FlatPhoto { field, codes } = photo_of(frame)?;
        let scores = CodeScores::new(&field, &queries)?;
        protocol.add(k, &DecodedView { codes: &codes, scores: &scores })?;
        progress.step(k as u64 + 1, "");
    }
    progress.end();
    Ok(Scored { published: Some(protocol.finish()), ..Scored::default() })
}

#[cfg(test)]
mod tests {
    use super::super::data::{DataSet, Layout};
    use super::*;
    use splatvk::infer::RegionEncoder;
    use splatvk::language::dir::normalise_rows;
    use splatvk::progress::Silent;

    /// Encoder whose feature of a region is its normalised mean colour.
    struct Colours;

    impl RegionEncoder for Colours {
        fn space(&self) -> &str {
            "colours"
        }
        fn dim(&self) -> usize {
            3
        }
        fn embed_regions(
            &mut self,
            image: &RgbImage,
            labels: &Image<i32>,
            count: usize,
            _: &dyn Progress,
        ) -> Result<Vec<f32>> {
            let mut rows = vec![0.0; 3 * count];
            for (pixel, label) in image.data.iter().zip(&labels.data) {
                (0..3).for_each(|c| rows[3 * *label as usize + c] += pixel[c]);
            }
            normalise_rows(&mut rows, 3);
            Ok(rows)
        }
        fn embed_texts(&mut self, _: &[&str]) -> Result<Vec<f32>> {
            Ok(Vec::new())
        }
    }

    #[test]
    fn published_scores_photos_by_their_pixels() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name);
        std::fs::create_dir_all(path("images")).unwrap();
        let side = 120;
        for stem in ["0", "1"] {
            // Red left of the middle, blue right of it: 7200 pixels each, and no cell across the
            // border.
            let is_red = |x: u32| x < side / 2;
            let photo = image::RgbImage::from_fn(side, side, |x, _| {
                image::Rgb(if is_red(x) { [250, 0, 0] } else { [0, 0, 250] })
            });
            photo.save(path(&format!("images/{stem}.png"))).unwrap();
            std::fs::create_dir_all(path(&format!("segmentations/{stem}"))).unwrap();
            for (class, red) in [("red half", true), ("blue half", false)] {
                let mask = image::GrayImage::from_fn(side, side, |x, _| {
                    image::Luma([if is_red(x) == red { 255 } else { 0 }])
                });
                mask.save(path(&format!("segmentations/{stem}/{class}.png"))).unwrap();
            }
        }
        std::fs::write(path("segmentations/classes.txt"), "red half\nblue half\n").unwrap();
        let data = DataSet::open("halves".into(), folder.path(), None).unwrap();
        assert_eq!(data.layout, Layout::Published(ProtocolKind::Ovs));
        let query = |text: &str, embedding: [f32; 3]| TextQuery {
            text: text.into(),
            embedding: embedding.into(),
            canonicals: vec![0.0, 1.0, 0.0],
            alternatives: Default::default(),
            reading: Default::default(),
        };
        let encoder = SharedEncoder::new(Box::new(Colours), String::new());
        let miou = |red: [f32; 3]| {
            let queries = [query("blue half", [0.0, 0.0, 1.0]), query("red half", red)];
            let mut photo_of = |frame: &TruthFrame| of_cells(&data.truth.image(frame)?, &encoder, &Silent);
            let scored = published(&data, ProtocolKind::Ovs, &queries, &Silent, &mut photo_of).unwrap();
            scored.published.unwrap().summary["train"].figures["miou"]
        };
        assert_eq!(miou([1.0, 0.0, 0.0]), 1.0);
        assert_eq!(miou([0.0, 0.0, 1.0]), 0.5, "the embedding of the other half finds the other half");
    }
}
