//! A scene scored against ground truth: rendered from every known camera, asked for every object.
use super::refine::{Moved, ViewRefiner};
use super::view::{DecodedFrame, Viewer};
use crate::Result;
use crate::gpu::Device;
use crate::pass::metrics;
use crate::progress::Progress;
use crate::query::eval::{Evaluation, Frame, RefinedView, Rendered, Report, Split, colour_fit};
use crate::query::{QueryOptions, QueryResult, TextQuery, answer_with, field_relevancy};
use crate::scene::{Camera, LanguageField, RgbImage, Splats};

/// The figures of protocol `field`. `queries` are the evaluation's phrases in order, or empty for a scene without
/// language. With `refine`, held-out frames are scored a second time from refined cameras. `look` sees every decoded
/// frame.
pub fn score_field(
    device: &Device,
    splats: &Splats,
    field: &LanguageField,
    queries: &[TextQuery],
    mut evaluation: Evaluation,
    refine: bool,
    progress: &dyn Progress,
    look: &mut dyn FnMut(&Frame, &DecodedFrame) -> Result<()>,
) -> Result<Report> {
    let labels: Vec<u32> = evaluation.phrases().into_iter().map(|p| p.0).collect();
    let options = QueryOptions::default();
    let relevancy = queries.iter().map(|q| field_relevancy(field, q)).collect::<Result<Vec<_>>>()?;
    let mut viewer = Viewer::new(device, splats, field)?;
    let refiner = if refine { Some(ViewRefiner::new(device, splats)?) } else { None };
    let frames = evaluation.cameras();
    progress.begin("eval", frames.len() as u64);
    for (i, (frame, camera)) in frames.iter().enumerate() {
        progress.check()?;
        let view = viewer.view(camera)?;
        look(frame, &view)?;
        let answer_all = |view: &DecodedFrame| -> Result<Vec<(u32, QueryResult)>> {
            let pairs = labels.iter().zip(&relevancy);
            pairs.map(|(label, r)| Ok((*label, answer_with(&view.codes, r, &options)?))).collect()
        };
        evaluation.add_frame(frame, &rendered(&view), &answer_all(&view)?)?;
        if let Some(refiner) = refiner.as_ref().filter(|_| frame.split == Split::Test) {
            let photo = evaluation.photo(frame)?;
            let believed = evaluation.as_believed(camera);
            let (closer, moved) = refined(refiner, &mut viewer, (&believed, &view), &photo, progress)?;
            let score = RefinedView {
                frame: frame.stem.clone(),
                kept: closer.is_some(),
                rotation_degrees: moved.rotation_degrees,
                centre_fraction: moved.centre_fraction,
                focal_relative: believed.fx / camera.fx - 1.0,
                centre_shift: [believed.cx - camera.cx, believed.cy - camera.cy],
            };
            let shown = closer.as_ref().unwrap_or(&view);
            evaluation.add_refined(frame, score, &rendered(shown), &answer_all(shown)?)?;
        }
        progress.step(i as u64 + 1, "");
    }
    progress.end();
    Ok(evaluation.finish())
}

fn rendered(view: &DecodedFrame) -> Rendered {
    let frame = &view.frame;
    Rendered { rgb: frame.rgb.clone(), alpha: frame.alpha.clone(), depth: frame.depth.clone() }
}

/// The frame from its refined camera, if that is closer to the photo, and how the camera moved. `camera` is the start,
/// `given` what the true one shows.
fn refined(
    refiner: &ViewRefiner,
    viewer: &mut Viewer,
    (camera, given): (&Camera, &DecodedFrame),
    photo: &RgbImage,
    progress: &dyn Progress,
) -> Result<(Option<DecodedFrame>, Moved)> {
    let border = crate::photo::Frame::of(photo);
    let inner = border.crop(photo);
    let closeness =
        |view: &DecodedFrame| metrics::psnr(&colour_fit(&border.crop(&view.frame.rgb), &inner), &inner);
    let moved = refiner.refine(camera, photo, progress)?;
    let view = viewer.view(&moved.camera)?;
    Ok(((closeness(&view) > closeness(given)).then_some(view), moved))
}
