//! Benchmark of photos → cameras on data with true cameras, without training: errors of the
//! cameras, and calibration of the stated uncertainty of the focal length.
use crate::eval::{GroundTruth, Split, TruthFrame};
use crate::infer::Registry;
use crate::photo;
use crate::pose::align::pose_errors;
use crate::pose::relative::{auc, pair_errors};
use crate::pose::{self, Confidence, SolvedCameras};
use crate::progress::{Progress, Recorded};
use crate::scene::Lens;
use crate::{Error, Result};
use serde::Serialize;
use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Result of one data set.
#[derive(Clone, Debug, Serialize)]
pub struct CameraRow {
    /// Its folder.
    pub data: PathBuf,
    /// Photos used, by stem.
    pub photos: Vec<String>,
    /// Wall time from files to cameras, seconds.
    pub seconds: f64,
    /// Warnings of a run.
    pub warnings: Vec<String>,
    /// Figures, or the reason of a failure.
    #[serde(flatten)]
    pub outcome: CameraOutcome,
}

/// Largest error of a relative rotation of usable cameras, degrees: beyond it, occluded surfaces
/// are reconstructed in the wrong place.
const WRONG_ROTATION: f64 = 2.0;
/// Largest relative error of the focal length of usable cameras: depth is stretched by as much.
const WRONG_FOCAL: f64 = 0.1;
/// Largest distance of cameras in one place, over the mean depth.
const ONE_PLACE: f64 = 1e-4;
/// Largest error of a centre of usable cameras, over the mean depth.
const WRONG_CENTRE: f64 = 0.05;

/// Figures or a failure.
#[derive(Clone, Debug, Serialize)]
#[serde(rename_all = "snake_case")]
#[non_exhaustive]
pub enum CameraOutcome {
    /// Cameras were found.
    Figures(Box<CameraFigures>),
    /// Error that a run would end with.
    Failure(String),
}

/// Errors of the cameras of one data set.
#[derive(Clone, Debug, Serialize)]
pub struct CameraFigures {
    /// f / f_true − 1, mean over the photos.
    pub focal_error: f64,
    /// The largest |f / f_true − 1| of any photo.
    pub worst_focal_error: f64,
    /// Whether all photos were taken from one place, so that no depth can be right.
    pub one_place: bool,
    /// Stated standard deviation of ln f.
    pub focal_sigma: Option<f64>,
    /// |ln f − ln f_true| over that.
    pub focal_sigmas: Option<f64>,
    /// Worst rotation after the similarity that maps all cameras onto the true ones, degrees.
    pub rotation_degrees: f64,
    /// Worst distance of a centre after it, over the mean depth.
    pub centre_fraction: f64,
    /// Worst angle between the relative rotations of a pair, degrees.
    pub pair_rotation_degrees: f64,
    /// Worst angle between the baseline directions of a pair, degrees.
    pub pair_direction_degrees: f64,
    /// Area under the recall curve up to 3, 5 and 30 degrees.
    pub auc: [Option<f64>; 3],
    /// Worst offset of the principal point from the true one, over the width.
    pub principal_point: f64,
    /// Worst stated standard deviation of a rotation against the first photo, degrees.
    pub rotation_sigma_degrees: f64,
    /// Lowest confidence of a camera.
    pub confidence: Option<Confidence>,
    /// Photos without a camera, by stem, each with a warning.
    pub left_out: Vec<String>,
    /// Estimated lens of the first photo.
    pub lens: Lens,
    /// True lens, if the data state it.
    pub true_lens: Option<Lens>,
}

impl CameraFigures {
    /// Whether an error exceeds its limit.
    fn wrong(&self) -> bool {
        self.one_place
            || self.pair_rotation_degrees > WRONG_ROTATION
            || self.worst_focal_error > WRONG_FOCAL
            || self.centre_fraction > WRONG_CENTRE
    }
}

/// Results of all data sets, with a summary.
#[derive(Clone, Debug, Serialize)]
#[non_exhaustive]
pub struct CameraReport {
    /// Results in the order given.
    pub rows: Vec<CameraRow>,
    /// Number of data sets without cameras.
    pub failures: usize,
    /// Number of data sets with wrong cameras: a relative rotation by more than 2 degrees, a focal
    /// length by more than 10 %, a centre by more than 5 % of the mean depth, or any cameras of
    /// photos from one place.
    pub wrong: usize,
    /// Data sets with wrong cameras without a warning; warnings of left-out photos do not count.
    pub wrong_without_warning: Vec<PathBuf>,
    /// Share of the sets with a stated σ of the focal length whose error is within 2 σ.
    pub within_2_sigma: Option<f64>,
    /// Median of |f / f_true − 1|.
    pub median_focal_error: Option<f64>,
    /// Median over the sets of the worst rotation, degrees.
    pub median_rotation_degrees: Option<f64>,
    /// Median over the sets of the worst centre.
    pub median_centre_fraction: Option<f64>,
    /// Mean AUC up to 3, 5 and 30 degrees; a set without cameras counts 0.
    pub mean_auc: [Option<f64>; 3],
    /// Sets by the lowest confidence of a camera, with their worst pair.
    pub by_confidence: Vec<ConfidenceRow>,
}

/// Accuracy of the sets of one level of confidence.
#[derive(Clone, Debug, Serialize)]
pub struct ConfidenceRow {
    /// Level of confidence.
    pub confidence: Confidence,
    /// Number of sets with this lowest confidence.
    pub sets: usize,
    /// Number of these sets with all relative rotations within one degree.
    pub within_one_degree: usize,
    /// Worst angle between relative rotations of these sets, degrees.
    pub worst_rotation_degrees: f64,
}

/// Photos and pixels of the benchmark.
#[derive(Clone, Copy, Debug)]
pub struct PhotoInput {
    /// Longer side of the working image, pixels.
    pub max_size: usize,
    /// Whether only the working image is used, as if the files were no larger.
    pub copies: bool,
    /// Whether every pair of train frames is a set of its own.
    pub pairs: bool,
}

/// Limits of the area under the recall curve, degrees.
const AUC_DEGREES: [f64; 3] = [3.0, 5.0, 30.0];

/// Estimates the cameras of the train frames of every set.
pub fn measure(
    sets: &[PathBuf],
    input: PhotoInput,
    registry: &Registry,
    progress: &dyn Progress,
    done: &mut dyn FnMut(&CameraRow) -> Result<()>,
) -> Result<CameraReport> {
    let truths = sets.iter().map(|s| GroundTruth::read(s)).collect::<Result<Vec<_>>>()?;
    let mut rows = Vec::new();
    for truth in &truths {
        let train: Vec<&TruthFrame> = truth.frames.iter().filter(|f| f.split == Split::Train).collect();
        let first = |i: usize| train[i + 1..].iter().map(move |b| (i, *b));
        let pairs = (0..train.len()).flat_map(first).map(|(i, b)| vec![train[i], b]);
        let used: Vec<Vec<&TruthFrame>> = if input.pairs { pairs.collect() } else { vec![train.clone()] };
        for frames in &used {
            let row = measure_set(truth, frames, input, registry, progress)?;
            done(&row)?;
            rows.push(row);
        }
    }
    Ok(summarise(rows))
}

fn measure_set(
    truth: &GroundTruth,
    frames: &[&TruthFrame],
    input: PhotoInput,
    registry: &Registry,
    progress: &dyn Progress,
) -> Result<CameraRow> {
    let clock = Instant::now();
    let recorded = Recorded::new(progress);
    let found = find_cameras(&truth.folder, frames, input, registry, &recorded);
    let seconds = clock.elapsed().as_secs_f64();
    let outcome = match found {
        Ok(placed) => CameraOutcome::Figures(Box::new(figures(truth, frames, &placed)?)),
        Err(Error::Cancelled) => return Err(Error::Cancelled),
        Err(e) => CameraOutcome::Failure(e.to_string()),
    };
    let photos = frames.iter().map(|f| f.stem.clone()).collect();
    Ok(CameraRow { data: truth.folder.clone(), photos, seconds, warnings: recorded.warnings(), outcome })
}

/// Estimates cameras as the stages of a run before the first dense one.
fn find_cameras(
    folder: &Path,
    frames: &[&TruthFrame],
    input: PhotoInput,
    registry: &Registry,
    progress: &dyn Progress,
) -> Result<SolvedCameras> {
    let load = |f: &&TruthFrame| photo::load_at(&folder.join(&f.file), input.max_size);
    let mut photos = frames.iter().map(load).collect::<Result<Vec<_>>>()?;
    if input.copies {
        photos.iter_mut().for_each(|p| p.fine = None);
    }
    photo::cut_bars(&mut photos, progress);
    pose::place(photos, None, &mut crate::run::stages::keypoints(registry)?, 0, progress)
}

fn figures(truth: &GroundTruth, frames: &[&TruthFrame], placed: &SolvedCameras) -> Result<CameraFigures> {
    let model = &placed.model;
    let joined: Vec<(usize, &TruthFrame)> = placed
        .photos
        .iter()
        .enumerate()
        .filter_map(|(k, p)| Some((k, *frames.iter().find(|f| f.stem == p.stem)?)))
        .collect();
    // Cameras of the whole files, as in the truth.
    let estimated: Vec<_> =
        joined.iter().map(|(k, _)| placed.photos[*k].original_camera(&model.cameras[*k])).collect();
    let known: Vec<_> = joined.iter().map(|(_, f)| f.camera.clone()).collect();
    let depth = truth.mean_depth(frames)?;
    let errors = pose_errors(&estimated, &known, depth);
    let pairs = pair_errors(&estimated, &known);
    let all_pairs = frames.len() * frames.len().saturating_sub(1) / 2;
    let n = joined.len().max(1) as f64;
    let both = || estimated.iter().zip(&known);
    let logs: Vec<f64> =
        both().map(|(e, t)| (e.fx / f64::from(e.width) * f64::from(t.width) / t.fx).ln()).collect();
    let log_error = logs.iter().sum::<f64>() / n;
    let from_first = |c: &crate::scene::Camera| {
        c.pose.centre().distance(known.first().map_or(glam::DVec3::ZERO, |f| f.pose.centre()))
    };
    let apart = known.iter().map(from_first).fold(0.0, f64::max);
    let offset = both().map(|(e, t)| {
        let relative = |c: &crate::scene::Camera| (c.cx / f64::from(c.width), c.cy / f64::from(c.width));
        let ((x, y), (tx, ty)) = (relative(e), relative(t));
        (x - tx).hypot(y - ty)
    });
    let worst = |values: &[f64]| values.iter().copied().fold(0.0, f64::max);
    let of_pairs =
        |value: &dyn Fn(&pose::relative::PairError) -> f64| pairs.iter().map(value).fold(0.0, f64::max);
    Ok(CameraFigures {
        focal_error: log_error.exp() - 1.0,
        worst_focal_error: logs.iter().map(|l| (l.exp() - 1.0).abs()).fold(0.0, f64::max),
        one_place: apart < ONE_PLACE * depth,
        focal_sigma: model.focal_log_sigma,
        focal_sigmas: model.focal_log_sigma.map(|s| log_error.abs() / s),
        rotation_degrees: worst(&errors.rotation_degrees),
        centre_fraction: worst(&errors.centre),
        pair_rotation_degrees: of_pairs(&|p| p.rotation_degrees),
        pair_direction_degrees: of_pairs(&|p| p.direction_degrees.unwrap_or(0.0)),
        auc: AUC_DEGREES.map(|d| auc(&pairs, all_pairs - pairs.len().min(all_pairs), d)),
        principal_point: offset.fold(0.0, f64::max),
        rotation_sigma_degrees: worst(
            &model.fitted.iter().map(|f| f.rotation_sigma.to_degrees()).collect::<Vec<_>>(),
        ),
        confidence: model.fitted.iter().map(pose::Fitted::confidence).min(),
        left_out: placed.left_out.iter().map(|l| l.photo.clone()).collect(),
        lens: model.fitted.first().map_or(Lens::NONE, |f| f.lens),
        true_lens: frames.first().and_then(|f| f.lens),
    })
}

fn summarise(rows: Vec<CameraRow>) -> CameraReport {
    let good: Vec<&CameraFigures> = rows
        .iter()
        .filter_map(|r| match &r.outcome {
            CameraOutcome::Figures(f) => Some(f.as_ref()),
            CameraOutcome::Failure(_) => None,
        })
        .collect();
    let median = |value: &dyn Fn(&CameraFigures) -> f64| {
        let mut values: Vec<f64> = good.iter().map(|f| value(f)).collect();
        values.sort_by(f64::total_cmp);
        let n = values.len();
        (n > 0).then(|| (values[n / 2] + values[(n - 1) / 2]) / 2.0)
    };
    let stated: Vec<f64> = good.iter().filter_map(|f| f.focal_sigmas).collect();
    let within = stated.iter().filter(|s| **s <= 2.0).count();
    let mean_auc = [0, 1, 2].map(|k| {
        let sum: f64 = good.iter().filter_map(|f| f.auc[k]).sum();
        (!rows.is_empty()).then(|| sum / rows.len() as f64)
    });
    let row_of_level = |confidence: Confidence| {
        let own = good.iter().filter(|f| f.confidence == Some(confidence)).map(|f| f.pair_rotation_degrees);
        let errors: Vec<f64> = own.collect();
        ConfidenceRow {
            confidence,
            sets: errors.len(),
            within_one_degree: errors.iter().filter(|e| **e <= 1.0).count(),
            worst_rotation_degrees: errors.iter().copied().fold(0.0, f64::max),
        }
    };
    let wrong = || rows.iter().filter_map(CameraRow::wrong);
    let silent = wrong().filter(|(r, f)| r.warnings.len() <= f.left_out.len()).map(|(r, _)| r.data.clone());
    let silent = silent.collect();
    let levels = [Confidence::High, Confidence::Medium, Confidence::Low];
    CameraReport {
        by_confidence: levels.map(row_of_level).into_iter().filter(|r| r.sets > 0).collect(),
        failures: rows.len() - good.len(),
        wrong: wrong().count(),
        wrong_without_warning: silent,
        within_2_sigma: (!stated.is_empty()).then(|| within as f64 / stated.len() as f64),
        median_focal_error: median(&|f| f.focal_error.abs()),
        median_rotation_degrees: median(&|f| f.rotation_degrees),
        median_centre_fraction: median(&|f| f.centre_fraction),
        mean_auc,
        rows,
    }
}

/// Column heads of [`CameraRow::text`].
pub fn header() -> String {
    format!(
        "{:<32}{:>9}{:>9}{:>6}{:>10}{:>9}{:>11}{:>9}{:>11}{:>7}{:>7}{:>7}{:>8}\n",
        "data",
        "focal %",
        "sigma %",
        "/ s",
        "rotation",
        "centre %",
        "pair rot.",
        "rot. s.",
        "pair dir.",
        "@3",
        "@5",
        "@30",
        "seconds"
    )
}

impl CameraRow {
    /// This row with its figures, if its cameras are wrong.
    fn wrong(&self) -> Option<(&CameraRow, &CameraFigures)> {
        match &self.outcome {
            CameraOutcome::Figures(f) if f.wrong() => Some((self, f)),
            _ => None,
        }
    }

    /// One line of the table.
    pub fn text(&self) -> String {
        let name = self
            .data
            .file_name()
            .map_or_else(|| self.data.display().to_string(), |n| n.to_string_lossy().into());
        let name = match self.photos.as_slice() {
            [a, b] => format!("{name} {a} {b}"),
            _ => name,
        };
        let f = match &self.outcome {
            CameraOutcome::Failure(why) => return format!("{name:<32}no cameras: {why}\n"),
            CameraOutcome::Figures(f) => f,
        };
        let number =
            |v: Option<f64>, digits: usize| v.map_or_else(|| "-".into(), |v| format!("{v:.digits$}"));
        format!(
            "{name:<32}{:>9.2}{:>9}{:>6}{:>10.3}{:>9.2}{:>11.3}{:>9.3}{:>11.3}{:>7}{:>7}{:>7}{:>8.1}\n",
            100.0 * f.focal_error,
            number(f.focal_sigma.map(|s| 100.0 * s), 2),
            number(f.focal_sigmas, 1),
            f.rotation_degrees,
            100.0 * f.centre_fraction,
            f.pair_rotation_degrees,
            f.rotation_sigma_degrees,
            f.pair_direction_degrees,
            number(f.auc[0], 3),
            number(f.auc[1], 3),
            number(f.auc[2], 3),
            self.seconds,
        )
    }
}

impl CameraReport {
    /// The lines below the table.
    pub fn text(&self) -> String {
        let number =
            |v: Option<f64>, digits: usize| v.map_or_else(|| "-".into(), |v| format!("{v:.digits$}"));
        let hundred = |v: Option<f64>| v.map(|v| 100.0 * v);
        let mut out = String::new();
        let _ = writeln!(
            out,
            "{} sets, {} without cameras; focal length within 2 sigma in {} % of those that state it; median focal error {} %, \
             rotation {} degrees, centre {} %; mean AUC@3 {} @5 {} @30 {}",
            self.rows.len(),
            self.failures,
            number(hundred(self.within_2_sigma), 0),
            number(hundred(self.median_focal_error), 2),
            number(self.median_rotation_degrees, 3),
            number(hundred(self.median_centre_fraction), 2),
            number(self.mean_auc[0], 3),
            number(self.mean_auc[1], 3),
            number(self.mean_auc[2], 3),
        );
        let names: Vec<String> =
            self.wrong_without_warning.iter().map(|p| format!(" {}", p.display())).collect();
        let _ = writeln!(
            out,
            "wrong by more than {WRONG_ROTATION} degrees, {:.0} % of the focal length or {:.0} % of the depth: {}, without a \
             warning {}{}{}",
            100.0 * WRONG_FOCAL,
            100.0 * WRONG_CENTRE,
            self.wrong,
            names.len(),
            if names.is_empty() { "" } else { ":" },
            names.concat()
        );
        for r in &self.by_confidence {
            let _ = writeln!(
                out,
                "{} confidence: {} sets, all rotations within 1 degree in {}, worst {:.2} degrees",
                r.confidence.name(),
                r.sets,
                r.within_one_degree,
                r.worst_rotation_degrees
            );
        }
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::progress::Silent;

    #[test]
    #[ignore = "takes long: tools/test-long"]
    fn cameras_of_identical_photos_are_failures() {
        let registry = Registry::open(None).unwrap();
        let breakfast = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/breakfast");
        // Two train frames with the same photo, which have no cameras.
        let dir = tempfile::tempdir().unwrap();
        let mut truth: serde_json::Value =
            serde_json::from_str(&std::fs::read_to_string(breakfast.join("ground_truth.json")).unwrap())
                .unwrap();
        let frames = truth["frames"].as_array_mut().unwrap();
        frames.truncate(2);
        std::fs::create_dir(dir.path().join("images")).unwrap();
        for f in frames.iter() {
            let to = dir.path().join(f["file"].as_str().unwrap());
            std::fs::copy(breakfast.join("images/train_00.jpg"), to).unwrap();
        }
        std::fs::write(dir.path().join("ground_truth.json"), truth.to_string()).unwrap();
        let mut seen = Vec::new();
        let input = PhotoInput { max_size: crate::photo::MAX_SIZE_CPU, copies: false, pairs: false };
        let report = measure(&[breakfast, dir.path().into()], input, &registry, &Silent, &mut |row| {
            seen.push(row.text());
            Ok(())
        })
        .unwrap();
        let CameraOutcome::Figures(f) = &report.rows[0].outcome else { panic!("{}", seen[0]) };
        assert!(
            f.rotation_degrees < 0.03 && f.centre_fraction < 0.0005 && f.focal_error.abs() < 0.002,
            "{f:?}"
        );
        assert!(
            f.auc[0].unwrap() > 0.97 && f.pair_direction_degrees < 0.1 && f.principal_point < 1e-9,
            "{f:?}"
        );
        assert!(
            (f.focal_sigmas.unwrap() - f.focal_error.ln_1p().abs() / f.focal_sigma.unwrap()).abs() < 1e-9
        );
        assert_eq!((report.failures, report.rows.len()), (1, 2));
        assert!(seen[1].contains("identical photos"), "{}", seen[1]);
        assert!((report.mean_auc[0].unwrap() - f.auc[0].unwrap() / 2.0).abs() < 1e-12);
        assert!(report.text().contains("2 sets, 1 without cameras"));
    }

    #[test]
    fn wrong_cameras_without_warning_are_listed() {
        let row = |data: &str, degrees: f64, warnings: &[&str]| CameraRow {
            data: data.into(),
            photos: Vec::new(),
            seconds: 1.0,
            warnings: warnings.iter().map(|w| w.to_string()).collect(),
            outcome: CameraOutcome::Figures(Box::new(CameraFigures {
                focal_error: 0.0,
                worst_focal_error: 0.0,
                one_place: false,
                focal_sigma: None,
                focal_sigmas: None,
                rotation_degrees: degrees,
                centre_fraction: 0.0,
                pair_rotation_degrees: degrees,
                pair_direction_degrees: 0.0,
                auc: [None; 3],
                principal_point: 0.0,
                rotation_sigma_degrees: 0.0,
                confidence: None,
                left_out: vec!["b".into()],
                lens: Lens::NONE,
                true_lens: None,
            })),
        };
        let left_out = "b is left out";
        let rows = vec![
            row("right", 0.1, &[left_out]),
            row("warned", 5.0, &[left_out, "little parallax"]),
            row("silent", 5.0, &[left_out]),
        ];
        let report = summarise(rows);
        assert_eq!(
            (report.wrong, report.wrong_without_warning.as_slice()),
            (2, &[PathBuf::from("silent")][..])
        );
        assert!(report.text().contains("2, without a warning 1: silent"));
    }
}
