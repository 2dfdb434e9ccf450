//! `run.json`: request, course and figures of a run, with types to write it and to read it back.
use super::answer::Answers;
use super::outcome::{LanguageOutcome, RunOutcome};
use super::plan::RunPlan;
use super::summary::confidence;
use super::view::DecodedFrame;
use crate::fit::{CurvePoint, LanguagePoint, Preset};
use crate::infer::ModelStatus;
use crate::photo::Photo;
use crate::pose::{Confidence, Fitted};
use crate::report::{self, Curve, ModelUsed};
use crate::scene::{Camera, LEVEL_NAMES, Lens, LevelField};
use crate::{Error, Result, files};
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value, json};
use std::path::Path;

/// The content of `run.json`.
pub type RunRecord = report::RunRecord<ConfigRecord, Statistics>;

/// The run as requested, with the choices that were left to the device.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct ConfigRecord {
    /// The plan, with method and code length resolved.
    pub plan: RunPlan,
    /// The preset that was used.
    pub preset: Option<Preset>,
    /// The execution provider of the networks.
    pub provider: Option<String>,
}

/// Figures of the run; those beside the geometry are free-form.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct Statistics {
    /// How the cameras were found.
    pub geometry: GeometryRecord,
    /// Photos, light, splats, curves, levels, alignment and queries.
    #[serde(flatten)]
    pub other: Map<String, Value>,
}

/// Cameras and points before training.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct GeometryRecord {
    /// The method.
    pub method: String,
    /// Number of points.
    pub points: usize,
    /// Focal length per photo, working pixels.
    pub focal_px: Vec<f64>,
    /// One standard deviation of ln f, where it was estimated.
    pub focal_log_sigma: Option<f64>,
    /// Share of each photo that was taken for sky; empty where none was looked for.
    pub sky: Vec<f32>,
    /// One entry per photo with estimated intrinsics.
    pub optics: Vec<IntrinsicsRecord>,
}

/// Estimated intrinsics of one photo, in pixels of its file.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct IntrinsicsRecord {
    /// Stem of the photo.
    pub photo: String,
    /// Focal length.
    pub focal_px: f64,
    /// Principal point, x.
    pub cx: f64,
    /// Principal point, y.
    pub cy: f64,
    /// Radial distortion.
    pub k1: f64,
    /// Radial distortion.
    pub k2: f64,
    /// One standard deviation of each; 0 = held fixed.
    pub sigma: SigmaRecord,
    /// Median reprojection error, working pixels.
    pub residual_px: f64,
    /// Share of the two-view inliers that agree with the cameras.
    pub agreement: f64,
    /// Camera id; photos of one id share intrinsics.
    pub camera: usize,
    /// One standard deviation of the rotation against the first photo.
    pub rotation_sigma_degrees: f64,
    /// Confidence in the camera.
    pub confidence: Option<Confidence>,
}

/// Standard deviations of intrinsics.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct SigmaRecord {
    /// σ of ln f.
    pub log_focal: f64,
    /// σ of k1.
    pub k1: f64,
    /// σ of k2.
    pub k2: f64,
    /// σ of the principal point's x, pixels of the file.
    pub cx: f64,
    /// σ of the principal point's y, pixels of the file.
    pub cy: f64,
}

/// Builds the record of a finished run, with the paths as typed.
pub fn run_record(o: &RunOutcome) -> RunRecord {
    let mut plan = o.plan.clone();
    let preset = plan.config.training.preset;
    if let Some(language) = &mut plan.config.language {
        language.feature_dim = Some(language.feature_dim(preset));
        language.method = Some(language.method(preset));
    }
    RunRecord {
        program: format!("splatvk {}", env!("CARGO_PKG_VERSION")),
        seed: plan.config.training.seed,
        config: ConfigRecord { plan, preset: Some(o.preset), provider: o.provider.map(str::to_owned) },
        device: o.device.name.clone(),
        device_is_cpu: o.device.is_cpu,
        models: o
            .models
            .iter()
            .filter(|m: &&ModelStatus| m.installed)
            .map(|m| ModelUsed { name: m.name.clone(), sha256: m.sha256.clone(), licence: m.licence.clone() })
            .chain(o.networks.iter().cloned())
            .collect(),
        seconds: o.seconds,
        stages: o.stages.clone(),
        statistics: statistics(o),
        warnings: o.warnings.clone(),
    }
}

/// Reads `run.json` of a scene directory; `remedy` ends the message of an error.
///
/// # Errors
/// A missing file, or one without a run record.
pub fn read(scene: &Path, remedy: &str) -> Result<RunRecord> {
    let path = scene.join("run.json");
    if !path.is_file() {
        return Err(Error::input(format!("{}: missing; {remedy}", path.display())));
    }
    files::read_json(&path, remedy)
}

fn statistics(o: &RunOutcome) -> Statistics {
    let language = o.language.as_ref();
    let levels: Vec<Value> = language.map_or_else(Vec::new, |l| levels_json(l, &o.frames));
    let answers = language.map_or(&[][..], |l| &l.answers);
    let other = json!({
        "photos": o.photos.iter().map(|p| p.path.display().to_string()).collect::<Vec<_>>(),
        "choice": o.choice,
        "ignored": o.ignored,
        "left_out": o.left_out,
        "added": added(o),
        "working_sizes": working_sizes(&o.photos),
        "world": o.world,
        "light": super::light::record(&o.photos),
        "splats": { "start": o.rgb.splats[0], "end": o.splats.len(), "unseen": o.seen.unseen() },
        "view_dependence": o.rgb.view_dependence,
        "psnr_train": o.psnr, "poses_refined": o.rgb.poses_refined,
        "loss": o.rgb.curve.iter().map(|p| json!([p.step, p.loss])).collect::<Vec<_>>(),
        "curves": curves(o),
        "levels": levels,
        "alignment": language.map(|l| &l.alignment.report),
        "queries": answers.iter().map(|a| answer_json(a, o)).collect::<Vec<_>>(),
    });
    let geometry = GeometryRecord {
        method: o.geometry.method.clone(),
        points: o.geometry.points.len(),
        focal_px: o.cameras.iter().map(|c| c.fx).collect(),
        focal_log_sigma: o.geometry.focal_log_sigma,
        sky: o.geometry.sky.clone(),
        optics: intrinsics(o),
    };
    let other = match other {
        Value::Object(other) => other,
        _ => Map::new(),
    };
    Statistics { geometry, other }
}

fn levels_json(language: &LanguageOutcome, frames: &[DecodedFrame]) -> Vec<Value> {
    let levels = LEVEL_NAMES.iter().zip(&language.field.levels).enumerate();
    levels
        .map(|(index, (name, level))| {
            json!({
                "level": name, "codes": level.codebook.len(), "min_chord": level.codebook.min_chord,
                "decode_accuracy": decode_accuracy(level, index, frames),
            })
        })
        .collect()
}

/// Share of the labelled pixels of the photos that decode to their label; `None` without any.
fn decode_accuracy(level: &LevelField, index: usize, frames: &[DecodedFrame]) -> Option<f64> {
    let pairs = level.targets.iter().zip(frames).flat_map(|(t, f)| t.data.iter().zip(&f.codes[index].data));
    let (right, labelled) = pairs
        .filter(|(label, _)| **label >= 0)
        .fold((0usize, 0usize), |(right, n), (label, code)| (right + usize::from(label == code), n + 1));
    (labelled > 0).then(|| right as f64 / labelled as f64)
}

/// Figures of the photos that joined a scene; `None` for a new scene.
fn added(o: &RunOutcome) -> Option<serde_json::Value> {
    let scene = o.plan.inputs.add.as_ref()?;
    let photos: Vec<_> = (o.known..o.photos.len()).map(|view| added_photo(o, view)).collect();
    Some(json!({ "scene": scene.display().to_string(), "photos": photos }))
}

fn added_photo(o: &RunOutcome, view: usize) -> Value {
    let fitted = &o.geometry.fitted[view];
    json!({
        "photo": o.photos[view].stem, "confidence": confidence(fitted, &o.psnr), "agreement": fitted.agreement,
        "rotation_sigma_degrees": fitted.rotation_sigma.to_degrees(), "psnr": o.psnr.get(view),
    })
}

fn intrinsics(o: &RunOutcome) -> Vec<IntrinsicsRecord> {
    let photos = o.photos.iter().zip(&o.cameras).zip(&o.geometry.fitted);
    photos.map(|((photo, camera), fitted)| intrinsics_of(photo, camera, fitted, &o.psnr)).collect()
}

fn intrinsics_of(photo: &Photo, camera: &Camera, fitted: &Fitted, psnr: &[f64]) -> IntrinsicsRecord {
    let original = photo.original_camera(camera);
    let [log_focal, k1, k2, cx, cy] = fitted.sigmas;
    IntrinsicsRecord {
        photo: photo.stem.clone(),
        focal_px: original.fx,
        cx: original.cx,
        cy: original.cy,
        k1: fitted.lens.k1,
        k2: fitted.lens.k2,
        sigma: SigmaRecord { log_focal, k1, k2, cx, cy },
        residual_px: fitted.residual,
        agreement: fitted.agreement,
        camera: fitted.camera,
        rotation_sigma_degrees: fitted.rotation_sigma.to_degrees(),
        confidence: Some(confidence(fitted, psnr)),
    }
}

impl RunRecord {
    /// Fit of a photo's camera; a camera without estimated intrinsics was given and counts as
    /// exact.
    pub(super) fn fitted(&self, stem: &str) -> Fitted {
        let Some(record) = self.statistics.geometry.optics.iter().find(|o| o.photo == stem) else {
            return Fitted { agreement: 1.0, ..Fitted::default() };
        };
        let SigmaRecord { log_focal, k1, k2, cx, cy } = record.sigma;
        Fitted {
            lens: Lens::radial(record.k1, record.k2),
            sigmas: [log_focal, k1, k2, cx, cy],
            residual: record.residual_px,
            agreement: record.agreement,
            // Other reasons for doubt are not recorded separately.
            unconfirmed: record.confidence == Some(Confidence::Low),
            rotation_sigma: record.rotation_sigma_degrees.to_radians(),
            camera: record.camera,
        }
    }
}

/// Curves over the steps of the colour stage and of the language stage, if there was one.
pub(super) fn curves(o: &RunOutcome) -> Vec<Curve> {
    let (rgb, language) = (&o.rgb, o.language.as_ref().map_or(&[][..], |l| &l.curve));
    let colour_curve = |name, unit, get: fn(&CurvePoint) -> f64| Curve {
        name,
        unit,
        points: rgb.curve.iter().map(|p| (p.step as f64, get(p))).collect(),
    };
    let language_curve = |name, unit, get: fn(&LanguagePoint) -> Option<f64>| {
        let points = language.iter().filter_map(|p| Some((p.step as f64, get(p)?)));
        Curve { name, unit, points: points.collect() }
    };
    vec![
        colour_curve("loss", "", |p| p.loss),
        colour_curve("PSNR of render and photo", "dB", |p| p.psnr),
        Curve {
            name: "SSIM of render and photo",
            unit: "",
            points: rgb.curve.iter().filter_map(|p| Some((p.step as f64, p.ssim?))).collect(),
        },
        colour_curve("splats", "", |p| p.splats as f64),
        // The first measurement of a model precedes every step and has no loss.
        language_curve("language loss", "", |p| (p.loss > 0.0).then_some(p.loss)),
        language_curve("pixels that decode to their label", "%", |p| Some(100.0 * p.mean_accuracy())),
    ]
}

fn answer_json(a: &Answers, o: &RunOutcome) -> serde_json::Value {
    let views: Vec<_> = a
        .views
        .iter()
        .zip(&a.view_reliability)
        .map(|(v, reliability)| {
            json!({
                "found": v.found, "score": v.score, "level": LEVEL_NAMES[v.level],
                "location": [v.location.0, v.location.1], "reliability": reliability,
            })
        })
        .collect();
    let stems: Vec<String> = o.photos.iter().map(|p| p.stem.clone()).collect();
    let mut entry = a.record(&stems, &o.world);
    (entry["found"], entry["views"]) = (a.found().into(), views.into());
    entry
}

/// Working and original (width, height) per photo.
fn working_sizes(photos: &[Photo]) -> serde_json::Value {
    let size = |p: &Photo| json!({ "working": [p.image.width, p.image.height], "original": [p.original_size.0, p.original_size.1] });
    photos.iter().map(size).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::run::sources::SourceChoice;
    use crate::run::{LanguageConfig, ReconstructionConfig};

    #[test]
    fn record_survives_json_round_trip() {
        let mut plan = RunPlan::default();
        plan.inputs.photos = vec!["a.jpg".into()];
        plan.config.training.seed = 7;
        let statistics = Statistics {
            geometry: GeometryRecord {
                optics: vec![IntrinsicsRecord { photo: "a".into(), k1: 0.1, ..Default::default() }],
                ..Default::default()
            },
            other: Map::from_iter([("loss".to_owned(), json!([1.5]))]),
        };
        let config = ConfigRecord { plan, preset: Some(Preset::Paper), provider: None };
        let record = RunRecord { config, statistics, ..RunRecord::default() };
        let text = serde_json::to_string(&record).unwrap();
        let back: RunRecord = serde_json::from_str(&text).unwrap();
        assert_eq!(serde_json::to_string(&back).unwrap(), text);
        assert_eq!(back.config.plan.config, record.config.plan.config);
        assert_eq!(back.fitted("a").lens, Lens::radial(0.1, 0.0));
        assert_eq!(back.fitted("b").agreement, 1.0);
    }

    #[test]
    fn missing_language_stays_missing() {
        let config = ReconstructionConfig { language: None, ..ReconstructionConfig::default() };
        let plan = RunPlan { config, ..RunPlan::default() };
        let back: RunPlan = serde_json::from_value(json!(plan)).unwrap();
        assert_eq!(back.config.language, None);
        let bare: RunPlan = serde_json::from_value(json!({ "masks": "dir:there" })).unwrap();
        let masks = SourceChoice::from("dir:there");
        assert_eq!(bare.config.language, Some(LanguageConfig { masks, ..LanguageConfig::default() }));
    }
}
