//! Evaluation of a scene against ground truth: rendered from every known camera, queried for every
//! object.
use super::refine::{RefinedCamera, ViewRefiner};
use super::view::{DecodedFrame, Viewer};
use crate::Result;
use crate::eval::{EvalReport, Evaluation, RefinedView, Rendered, Split, TruthFrame, colour_fit};
use crate::gpu::Device;
use crate::pass::metrics;
use crate::progress::Progress;
use crate::query::instances::Places;
use crate::query::select::select;
use crate::query::{CanonicalCosines, QueryOptions, QueryResult, TextQuery, answer_all};
use crate::scene::{Camera, LanguageField, RgbImage, Splats};

/// Queries of an evaluation.
pub struct Questions<'a> {
    /// Queries in the order of the evaluation's phrases; none for a scene without language.
    pub queries: &'a [TextQuery],
    /// Options of the answers.
    pub options: QueryOptions,
}

/// The scene that is scored.
#[derive(Clone, Copy)]
pub struct ScoredScene<'a> {
    /// The Gaussians.
    pub splats: &'a Splats,
    /// Splats behind them; may be empty.
    pub backdrop: &'a Splats,
    /// Language; may be empty.
    pub field: &'a LanguageField,
}

/// Scores a scene under protocol `field`. With `refine`, held-out frames are scored a second time
/// from refined cameras. Every decoded frame is passed to `visit`.
pub fn score_field(
    device: &Device,
    ScoredScene { splats, backdrop, field }: ScoredScene,
    Questions { queries, options }: Questions,
    mut evaluation: Evaluation,
    refine: bool,
    progress: &dyn Progress,
    visit: &mut dyn FnMut(&TruthFrame, &DecodedFrame) -> Result<()>,
) -> Result<EvalReport> {
    let labels: Vec<u32> = evaluation.phrases().into_iter().map(|p| p.0).collect();
    let relevancy_of =
        |q: &TextQuery| CanonicalCosines::new(field, &q.canonicals).relevancy(field, q, &options);
    let relevancy = queries.iter().map(relevancy_of).collect::<Result<Vec<_>>>()?;
    let places = Places::of(splats, field);
    let instances = |relevancy: &Vec<Vec<f32>>| {
        let selection = select(&places, relevancy, &options);
        places.instances(&selection.splats, selection.level)
    };
    evaluation.add_instances(&relevancy.iter().map(instances).collect::<Vec<_>>())?;
    let mut viewer = Viewer::new(device, splats, field)?.with_backdrop(backdrop)?;
    let refiner = if refine { Some(ViewRefiner::new(device, splats)?) } else { None };
    let frames = evaluation.cameras();
    progress.begin("eval", frames.len() as u64);
    for (i, (frame, camera)) in frames.iter().enumerate() {
        progress.check()?;
        let view = viewer.view(camera)?;
        visit(frame, &view)?;
        let answer_labels = |view: &DecodedFrame| -> Result<Vec<(u32, QueryResult)>> {
            let mut answers = Vec::new();
            for (label, relevancy) in labels.iter().zip(&relevancy) {
                let found = answer_all(std::slice::from_ref(&view.maps), relevancy, &options, None)?;
                answers.extend(found.into_iter().map(|answer| (*label, answer)));
            }
            Ok(answers)
        };
        evaluation.add_frame(frame, &rendered(&view), &answer_labels(&view)?)?;
        if let Some(refiner) = refiner.as_ref().filter(|_| frame.split == Split::Test) {
            let photo = evaluation.photo(frame)?;
            let with_intrinsics = evaluation.with_scene_intrinsics(camera);
            let (closer, moved) =
                refine_view(refiner, &mut viewer, (&with_intrinsics, &view), &photo, progress)?;
            let score = RefinedView {
                frame: frame.stem.clone(),
                kept: closer.is_some(),
                rotation_degrees: moved.rotation_degrees,
                centre_fraction: moved.centre_fraction,
                focal_relative: with_intrinsics.fx / camera.fx - 1.0,
                centre_shift: [with_intrinsics.cx - camera.cx, with_intrinsics.cy - camera.cy],
            };
            let best = closer.as_ref().unwrap_or(&view);
            evaluation.add_refined(frame, score, &rendered(best), &answer_labels(best)?)?;
        }
        progress.step(i as u64 + 1, "");
    }
    progress.end();
    Ok(evaluation.finish())
}

/// The images of a frame that are scored.
pub(super) fn rendered(view: &DecodedFrame) -> Rendered {
    let frame = &view.rendered;
    let (rgb, filled) = (frame.rgb.clone(), view.filled.clone());
    Rendered { rgb, filled, alpha: frame.alpha.clone(), depth: frame.depth.clone() }
}

/// Returns the frame from the refined camera if it is closer to the photo, and the displacement of
/// the camera. `camera` is the start; `given` is the frame of the true camera.
fn refine_view(
    refiner: &ViewRefiner,
    viewer: &mut Viewer,
    (camera, given): (&Camera, &DecodedFrame),
    photo: &RgbImage,
    progress: &dyn Progress,
) -> Result<(Option<DecodedFrame>, RefinedCamera)> {
    let border = crate::photo::PlainBorder::of(photo);
    let inner = border.crop(photo);
    let fitted_psnr =
        |view: &DecodedFrame| metrics::psnr(&colour_fit(&border.crop(&view.rendered.rgb), &inner), &inner);
    let moved = refiner.refine(camera, photo, progress)?;
    let view = viewer.view(&moved.camera)?;
    Ok(((fitted_psnr(&view) > fitted_psnr(given)).then_some(view), moved))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::eval::GroundTruth;
    use crate::format::picture::write_png;
    use crate::pass::Renderer;
    use crate::progress::Silent;
    use crate::scene::Pose;
    use crate::scene::seeded;
    use glam::DVec3;
    use serde_json::json;

    #[test]
    fn refined_views_use_scene_focal_length() {
        let device = crate::gpu::open(None).unwrap();
        let (splats, camera) = seeded::small(400, 96, 72, 1, 5);
        let mut renderer = Renderer::new(&device, &splats, &[], 0).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let shifts = [DVec3::new(-0.3, 0.0, 0.0), DVec3::new(0.3, 0.1, 0.0), DVec3::ZERO];
        let (mut scene, mut frames) = (Vec::new(), Vec::new());
        for (k, shift) in shifts.into_iter().enumerate() {
            let pose = Pose::exp(shift, DVec3::ZERO).compose(&camera.pose);
            let own = Camera { name: format!("{k}.png"), pose, ..camera.clone() };
            write_png(&folder.path().join(&own.name), &renderer.render(&own).unwrap().rgb).unwrap();
            let (r, t) = (pose.rotation.transpose(), pose.translation);
            let row = |axis: DVec3, shift: f64| [axis.x, axis.y, axis.z, shift];
            let matrix = [row(r.x_axis, t.x), row(r.y_axis, t.y), row(r.z_axis, t.z), [0.0, 0.0, 0.0, 1.0]];
            // The stated focal length is an eighth longer than that of the photos.
            frames.push(json!({
                "file": own.name, "split": if k < 2 { "train" } else { "test" }, "fx": 1.125 * own.fx,
                "fy": 1.125 * own.fy, "cx": own.cx, "cy": own.cy, "world_to_camera": matrix,
            }));
            scene.extend((k < 2).then_some(own));
        }
        let text = json!({"width": 96, "height": 72, "frames": frames}).to_string();
        std::fs::write(folder.path().join("ground_truth.json"), text).unwrap();
        let evaluation = Evaluation::new(GroundTruth::read(folder.path()).unwrap(), &scene, None).unwrap();
        let field = LanguageField::default();
        let no_queries = Questions { queries: &[], options: QueryOptions::default() };
        let scene = ScoredScene { splats: &splats, backdrop: &Splats::default(), field: &field };
        let report =
            score_field(&device, scene, no_queries, evaluation, true, &Silent, &mut |_, _| Ok(())).unwrap();
        let given = report.images.iter().find(|i| i.split == Split::Test).unwrap().psnr_colour_fit;
        let refined = report.refined.unwrap();
        let (view, score) = (&refined.views[0], refined.images[0].psnr_colour_fit);
        println!("given {given:.1} dB, refined {score:.1} dB");
        assert!(view.kept && (view.focal_relative + 1.0 / 9.0).abs() < 1e-6, "{view:?}");
        // Moving the camera alone cannot undo an eighth of magnification in a scene with depth.
        assert!(score > given + 10.0 && score > 35.0, "{given} {score}");
    }

    #[test]
    fn worse_refined_camera_is_dropped() {
        let device = crate::gpu::open(None).unwrap();
        let (splats, camera) = seeded::small(400, 96, 72, 1, 5);
        let mut viewer = Viewer::new(&device, &splats, &LanguageField::default()).unwrap();
        let refiner = ViewRefiner::new(&device, &splats).unwrap();
        let given = viewer.view(&camera).unwrap();
        let photo = given.rendered.rgb.clone();
        // 9 degrees off; all steps together rotate a camera by 2 about each axis.
        let turn = Pose::exp(DVec3::ZERO, DVec3::new(0.0, 0.15, 0.0));
        let start = Camera { pose: turn.compose(&camera.pose), ..camera.clone() };
        let (closer, moved) = refine_view(&refiner, &mut viewer, (&start, &given), &photo, &Silent).unwrap();
        assert!(closer.is_none(), "{moved:?}");
    }
}
