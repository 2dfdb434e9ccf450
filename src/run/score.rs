//! A scene scored against ground truth: rendered from every known camera, asked for every object.
use super::view::{DecodedFrame, Viewer};
use crate::Result;
use crate::gpu::Device;
use crate::progress::Progress;
use crate::query::eval::{Evaluation, Frame, Rendered, Report};
use crate::query::{QueryOptions, TextQuery, answer_with, field_relevancy};
use crate::scene::{LanguageField, Splats};

/// The figures of protocol `field`. `queries` are the evaluation's phrases in order, or empty for a scene without
/// language. `look` sees every decoded frame.
pub fn score_field(
    device: &Device,
    splats: &Splats,
    field: &LanguageField,
    queries: &[TextQuery],
    mut evaluation: Evaluation,
    progress: &dyn Progress,
    look: &mut dyn FnMut(&Frame, &DecodedFrame) -> Result<()>,
) -> Result<Report> {
    let labels: Vec<u32> = evaluation.phrases().into_iter().map(|p| p.0).collect();
    let options = QueryOptions::default();
    let relevancy = queries.iter().map(|q| field_relevancy(field, q)).collect::<Result<Vec<_>>>()?;
    let mut viewer = Viewer::new(device, splats, field)?;
    let frames = evaluation.cameras();
    progress.begin("eval", frames.len() as u64);
    for (i, (frame, camera)) in frames.iter().enumerate() {
        progress.check()?;
        let view = viewer.view(camera)?;
        look(frame, &view)?;
        let answers = labels
            .iter()
            .zip(&relevancy)
            .map(|(label, r)| Ok((*label, answer_with(&view.codes, r, &options)?)))
            .collect::<Result<Vec<_>>>()?;
        let rendered = Rendered { rgb: view.frame.rgb, alpha: view.frame.alpha, depth: view.frame.depth };
        evaluation.add_frame(frame, &rendered, &answers)?;
        progress.step(i as u64 + 1, "");
    }
    progress.end();
    Ok(evaluation.finish())
}
