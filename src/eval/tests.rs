use super::*;
use crate::query::AnswerImages;
use glam::{DMat3, DVec3};

fn breakfast() -> GroundTruth {
    GroundTruth::read(Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/tests/data/breakfast"))).unwrap()
}

/// The true train cameras in another world: `truth = s R scene + t`.
fn moved() -> (GroundTruth, Vec<Camera>, Similarity) {
    let truth = breakfast();
    let turn = Pose::exp(DVec3::ZERO, DVec3::new(0.4, -0.2, 0.9)).rotation;
    let similarity = Similarity { scale: 0.37, rotation: turn, translation: DVec3::new(1.0, -2.0, 0.5) };
    let train = truth.frames.iter().filter(|f| f.split == Split::Train);
    let cameras = train
        .map(|f| Camera { name: format!("in/{}.JPG", f.stem), ..to_scene(&f.camera, &similarity) })
        .collect();
    (truth, cameras, similarity)
}

#[test]
fn evaluation_scores_perfect_scene_perfectly() {
    let (truth, scene, similarity) = moved();
    let dir = tempfile::tempdir().unwrap();
    let mut eval = Evaluation::new(truth.clone(), &scene, Some(dir.path())).unwrap();
    assert_eq!(eval.phrases().len(), 8);
    for (frame, camera) in
        eval.cameras().into_iter().filter(|(f, _)| f.stem.ends_with("3") || f.stem == "test_05")
    {
        // The scene camera projects a true point to the same pixel, at a depth in scene units.
        let point = DVec3::new(0.1, 0.2, 0.05);
        let x = similarity.rotation.transpose() * (point - similarity.translation) / similarity.scale;
        let ((a, za), (b, zb)) = (camera.project(x), frame.camera.project(point));
        // The file's rotations are orthonormal to f32 rounding only.
        assert!((a - b).length() < 1e-3 && (za * similarity.scale - zb).abs() < 1e-5);
        let mut depth = truth.depth(&frame).unwrap().unwrap();
        depth.data.iter_mut().for_each(|z| *z /= similarity.scale as f32);
        let rgb = truth.image(&frame).unwrap();
        let alpha = Image::filled(640, 480, 1.0);
        let objects = truth.objects(&frame).unwrap().unwrap();
        let answers: Vec<(u32, QueryResult)> = eval
            .phrases()
            .into_iter()
            .map(|(label, _)| {
                let mask: Vec<bool> = objects.data.iter().map(|&o| o == label).collect();
                let p = mask.iter().position(|&m| m).unwrap_or(0);
                let mask = Image { width: 640, height: 480, data: mask };
                let images = AnswerImages::of_mask(mask);
                let location = (p % 640, p / 640);
                (label, QueryResult { images, location, found: true, ..QueryResult::default() })
            })
            .collect();
        eval.add_frame(&frame, &Rendered { rgb, filled: None, alpha, depth }, &answers).unwrap();
    }
    let direction = similarity.rotation.transpose() * truth.up.unwrap();
    let up = Some(Up { direction, sigma_degrees: 1.0, evidence: Vec::new() });
    eval.add_world(&World { up, scale: None });
    let report = eval.finish();
    assert!(report.up_degrees.unwrap() < 1e-2, "{:?}", report.up_degrees);
    assert_eq!(report.poses.len(), 4);
    for p in &report.poses {
        assert!(p.rotation_degrees < 1e-3 && p.centre_fraction < 1e-5 && p.focal_relative < 1e-12);
    }
    let (train, test) = (&report.summary["train"], &report.summary["test"]);
    assert_eq!((train.miou, test.miou, test.localisation), (Some(1.0), Some(1.0), Some(1.0)));
    assert!(train.psnr.unwrap() > 60.0 && train.ssim.unwrap() > 0.999);
    // f16 depth, divided and multiplied again in f32.
    assert!(train.depth_median_relative.unwrap() < 1e-5);
    assert!(train.depth_abs_rel.unwrap() < 1e-4 && train.depth_delta.unwrap() > 0.999);
    assert!(train.psnr_colour_fit.unwrap() >= train.psnr.unwrap() - 1e-6);
    let frames: Vec<&str> = report.shown.iter().map(|s| s.frame.as_str()).collect();
    assert_eq!(frames, ["train_03", "test_05", "out_13"]);
    for FrameShown { psnr, psnr_white, score, .. } in &report.shown {
        assert!(*psnr > 60.0 && psnr == psnr_white, "{psnr} {psnr_white}");
        assert!(
            score.alpha_below_99 == 0.0 && score.transparent == 0.0 && score.confetti < 0.01,
            "{score:?}"
        );
    }
    let shares: Vec<f64> = report.shown.iter().map(|s| s.score.shown).collect();
    assert!(
        shares[0] > 0.999 && (0.8..1.0).contains(&shares[1]) && (0.5..0.9).contains(&shares[2]),
        "{shares:?}"
    );
    assert!(report.summary["out"].psnr_shown.unwrap() > 60.0);
    assert_eq!(report.relative_poses.pairs.len(), 6);
    assert!(report.relative_poses.auc_3.unwrap() > 0.999 && report.refined.is_none());
    let mask = image::open(dir.path().join("masks/7/test_05.png")).unwrap().to_luma8();
    let frame = truth.frames.iter().find(|f| f.stem == "test_05").unwrap();
    let objects = truth.objects(frame).unwrap().unwrap();
    assert!(mask.pixels().zip(&objects.data).all(|(m, &o)| (m.0[0] > 127) == (o == 7)));
    assert!(dir.path().join("renders/train_03.png").exists());
}

#[test]
fn iou_counts_pixels_and_resamples_masks() {
    let objects = Image { width: 4, height: 2, data: vec![1, 1, 0, 0, 1, 1, 0, 2] };
    let mask = |data: Vec<bool>, width| Image { width, height: data.len() / width, data };
    let m = mask(vec![true, false, false, false, true, true, true, false], 4);
    assert_eq!(iou(&m, &objects, 1).unwrap(), 3.0 / 5.0);
    assert_eq!(iou(&mask(vec![true, false], 2), &objects, 1).unwrap(), 1.0);
    assert_eq!(iou(&mask(vec![false; 8], 4), &objects, 9).unwrap(), 0.0);
    assert!(iou(&mask(vec![], 1), &objects, 1).is_err());
}

#[test]
fn evaluation_refuses_another_scenes_truth() {
    let (truth, mut scene, _) = moved();
    scene.iter_mut().for_each(|c| c.name = format!("x{}", c.name.len()));
    let text = Evaluation::new(truth, &scene, None).err().unwrap().to_string();
    assert!(text.contains("0 of its train frames"), "{text}");
    let text = GroundTruth::read(Path::new("/nonexistent")).unwrap_err().to_string();
    assert!(text.contains("ground_truth.json"), "{text}");
    let same = Similarity { scale: 1.0, rotation: DMat3::IDENTITY, translation: DVec3::ZERO };
    let camera = breakfast().frames[0].camera.clone();
    assert_eq!(to_scene(&camera, &same), camera);
}

#[test]
fn held_out_frames_take_scene_intrinsics() {
    let (truth, mut scene, _) = moved();
    for c in &mut scene {
        // A scene at half the size whose focal length is a tenth too short and whose principal
        // point is off by 2 %.
        *c = c.resized(320, 240);
        (c.fx, c.fy, c.cx) = (0.9 * c.fx, 0.9 * c.fy, c.cx + 0.02 * 320.0);
    }
    let eval = Evaluation::new(truth, &scene, None).unwrap();
    let (frame, camera) = eval.cameras().into_iter().find(|(f, _)| f.split == Split::Test).unwrap();
    let with_intrinsics = eval.with_scene_intrinsics(&camera);
    assert!((with_intrinsics.fx / frame.camera.fx - 0.9).abs() < 1e-9 && with_intrinsics.pose == camera.pose);
    assert!((with_intrinsics.cx - frame.camera.cx - 0.02 * 640.0).abs() < 1e-6);
    assert!((with_intrinsics.cy - frame.camera.cy).abs() < 1e-6);
}
