//! Records of a finished run: `run.json`, the report and the closing table, made from
//! [`RunOutcome`].
use super::answer::Answers;
use super::outcome::RunOutcome;
use super::plan::RunPlan;
use crate::Result;
use crate::fit::{self, CurvePoint, FitStats, LanguagePoint, ViewDependence};
use crate::photo::Photo;
use crate::pose::{Confidence, Fitted};
use crate::report::viewer::Scene3d;
use crate::report::{self, AnswerShown, Curve, HtmlReport, ModelUsed, QueryShown, RunRecord, ViewShown};
use crate::scene::{Camera, LEVEL_NAMES, RgbImage, Seen, Splats, World};
use serde_json::json;
use std::path::Path;

/// What `run.json` holds, with the paths as they were typed.
pub fn run_record(o: &RunOutcome) -> RunRecord {
    let used = |m: &&crate::infer::ModelStatus| m.installed;
    let plan = RunPlan { method: Some(o.plan.method()), ..o.plan.clone() };
    RunRecord {
        program: format!("splatvk {}", env!("CARGO_PKG_VERSION")),
        config: json!({ "plan": plan, "preset": o.preset, "provider": o.provider }),
        seed: o.plan.seed,
        device: o.device.name.clone(),
        device_is_cpu: o.device.is_cpu,
        models: o
            .models
            .iter()
            .filter(used)
            .map(|m| ModelUsed { name: m.name.clone(), sha256: m.sha256.clone(), licence: m.licence.clone() })
            .chain(o.networks.iter().cloned())
            .collect(),
        seconds: o.seconds,
        stages: o.stages.clone(),
        statistics: statistics(o),
        warnings: o.warnings.clone(),
    }
}

fn statistics(o: &RunOutcome) -> serde_json::Value {
    let curves = curves(&o.rgb, &o.language_curve);
    let levels: Vec<_> = LEVEL_NAMES
        .iter()
        .zip(&o.field.levels)
        .enumerate()
        .map(|(at, (name, level))| {
            json!({
                "level": name, "codes": level.codebook.len(), "min_chord": level.codebook.min_chord,
                "decode_accuracy": fit::decode_accuracy(&o.language_curve, at),
            })
        })
        .collect();
    json!({
        "photos": o.photos.iter().map(|p| p.path.display().to_string()).collect::<Vec<_>>(),
        "choice": o.choice,
        "left_out": o.left_out,
        "added": added(o),
        "working_sizes": working_sizes(&o.photos),
        "geometry": {
            "method": o.geometry.method, "points": o.geometry.points.len(),
            "focal_px": o.cameras.iter().map(|c| c.fx).collect::<Vec<_>>(),
            "focal_log_sigma": o.geometry.focal_log_sigma,
            "optics": optics(o),
        },
        "world": o.world,
        "light": super::light::record(&o.photos),
        "splats": { "start": o.rgb.splats[0], "end": o.splats.len(), "unseen": o.seen.unseen() },
        "view_dependence": o.rgb.view_dependence,
        "psnr_train": o.psnr, "poses_refined": o.rgb.poses_refined,
        "loss": o.rgb.curve.iter().map(|p| json!([p.step, p.loss])).collect::<Vec<_>>(),
        "curves": curves,
        "levels": levels,
        "alignment": o.alignment.report,
        "queries": o.answers.iter().map(|a| answer_json(a, o)).collect::<Vec<_>>(),
    })
}

/// What is known of the photos that joined a scene; `None` where the scene is a new one.
fn added(o: &RunOutcome) -> Option<serde_json::Value> {
    let one = |v: usize| {
        let fitted = &o.geometry.fitted[v];
        json!({
            "photo": o.photos[v].stem, "confidence": confidence(fitted, &o.psnr), "agreement": fitted.agreement,
            "rotation_sigma_degrees": fitted.rotation_sigma.to_degrees(), "psnr": o.psnr.get(v),
        })
    };
    let scene = o.plan.add.as_ref()?;
    let photos: Vec<_> = (o.known..o.photos.len()).map(one).collect();
    Some(json!({ "scene": scene.display().to_string(), "photos": photos }))
}

/// A line per photo that joined a scene.
fn added_figures(o: &RunOutcome) -> Vec<(String, String)> {
    if o.known == 0 {
        return Vec::new();
    }
    let one = |v: usize| {
        let confidence = confidence(&o.geometry.fitted[v], &o.psnr).name();
        let psnr = o.psnr.get(v).copied().unwrap_or(0.0);
        ("added".to_owned(), format!("{}: {confidence} confidence, {psnr:.2} dB", o.photos[v].stem))
    };
    (o.known..o.photos.len()).map(one).collect()
}

/// Per photo what was found of its lens, and the camera of its file.
fn optics(o: &RunOutcome) -> Vec<serde_json::Value> {
    let one = |((photo, camera), fitted): ((&Photo, &Camera), &Fitted)| {
        let taken = photo.original_camera(camera);
        json!({
            "photo": photo.stem, "focal_px": taken.fx, "cx": taken.cx, "cy": taken.cy,
            "k1": fitted.lens.k1, "k2": fitted.lens.k2,
            "sigma": { "log_focal": fitted.sigmas[0], "k1": fitted.sigmas[1], "k2": fitted.sigmas[2],
                "cx": fitted.sigmas[3], "cy": fitted.sigmas[4] },
            "residual_px": fitted.residual, "agreement": fitted.agreement, "camera": fitted.camera,
            "rotation_sigma_degrees": fitted.rotation_sigma.to_degrees(),
            "confidence": confidence(fitted, &o.psnr),
        })
    };
    o.photos.iter().zip(&o.cameras).zip(&o.geometry.fitted).map(one).collect()
}

/// The focal length of every camera that the photos were taken with, as far as it was measured.
fn focal_figure(photos: &[Photo], cameras: &[Camera], fitted: &[Fitted]) -> Option<String> {
    let mut groups: Vec<(usize, String, Vec<&str>)> = Vec::new();
    for ((photo, camera), fitted) in photos.iter().zip(cameras).zip(fitted) {
        match groups.iter_mut().find(|c| c.0 == fitted.camera) {
            Some(known) => known.2.push(&photo.stem),
            None => {
                let text = format!("{:.1} px ± {:.2} %", camera.fx, 100.0 * fitted.sigmas[0]);
                groups.push((fitted.camera, text, vec![&photo.stem]));
            }
        }
    }
    match groups.as_slice() {
        [] => None,
        [(_, text, _)] => Some(text.clone()),
        several => {
            let each = several.iter().map(|(_, text, photos)| format!("{text} ({})", photos.join(", ")));
            Some(each.collect::<Vec<_>>().join("; "))
        }
    }
}

/// Trust in the camera of a photo: what the cameras say of themselves, and no more than how well
/// the scene shows the photos.
fn confidence(fitted: &Fitted, psnr: &[f64]) -> Confidence {
    fitted.confidence().min(super::fidelity::ceiling(psnr))
}

/// How far the cameras are to be trusted: that of the worst, and which are worse than the best.
fn confidence_figure(photos: &[Photo], fitted: &[Fitted], psnr: &[f64]) -> Option<String> {
    let levels: Vec<Confidence> = fitted.iter().map(|f| confidence(f, psnr)).collect();
    let (worst, best) = (levels.iter().min()?, levels.iter().max()?);
    let named = photos.iter().zip(&levels).filter(|(_, l)| *l < best).map(|(p, _)| p.stem.as_str());
    let named: Vec<&str> = named.collect();
    let which = if named.is_empty() { String::new() } else { format!(" ({})", named.join(", ")) };
    Some(format!("{} confidence{which}", worst.name()))
}

/// What was assumed about the lens: the strongest distortion taken out, and how far the principal
/// point is from the middle.
fn lens_figure(o: &RunOutcome) -> Option<String> {
    let corner = |(photo, camera): (&Photo, &Camera)| {
        let half = glam::DVec2::new(0.5 * camera.width as f64, 0.5 * camera.height as f64) / camera.fx;
        (photo.lens().distort(half).length() / half.length() - 1.0, photo.lens())
    };
    let all = o.photos.iter().zip(&o.cameras).map(corner);
    let (share, lens) = all.max_by(|a, b| a.0.abs().total_cmp(&b.0.abs()))?;
    let camera = o.cameras.first()?;
    let shift = [camera.cx / camera.width as f64 - 0.5, camera.cy / camera.height as f64 - 0.5];
    let bend = match lens.is_none() {
        true => "no distortion seen".to_owned(),
        false => {
            format!("k1 {:.3}, k2 {:.3} ({:+.1} % at the corner), taken out", lens.k1, lens.k2, 100.0 * share)
        }
    };
    let centre = match shift.iter().all(|s| s.abs() < 1e-9) {
        true => String::new(),
        false => format!("; centre off by {:+.1}, {:+.1} %", 100.0 * shift[0], 100.0 * shift[1]),
    };
    (!o.geometry.fitted.is_empty()).then(|| bend + &centre)
}

/// Figures over the steps of the colour stage and, where there was one, of the language stage.
pub(super) fn curves(rgb: &FitStats, language: &[LanguagePoint]) -> Vec<Curve> {
    let colour = |name, unit, get: fn(&CurvePoint) -> f64| Curve {
        name,
        unit,
        points: rgb.curve.iter().map(|p| (p.step as f64, get(p))).collect(),
    };
    let words = |name, unit, get: fn(&LanguagePoint) -> Option<f64>| {
        let points = language.iter().filter_map(|p| Some((p.step as f64, get(p)?)));
        Curve { name, unit, points: points.collect() }
    };
    vec![
        colour("loss", "", |p| p.loss),
        colour("PSNR of render and photo", "dB", |p| p.psnr),
        colour("SSIM of render and photo", "", |p| p.ssim),
        colour("splats", "", |p| p.splats as f64),
        // The first measurement of a model comes before any step, and so before any loss.
        words("language loss", "", |p| (p.loss > 0.0).then_some(p.loss)),
        words("pixels that decode to their label", "%", |p| Some(100.0 * p.mean_accuracy())),
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

/// Figures for the head of the report and the closing table: (label, value).
fn figures(o: &RunOutcome) -> Vec<(String, String)> {
    let cpu = if o.device.is_cpu { " (CPU)" } else { "" };
    // Which, and why, is said when they are chosen, and in run.json.
    let mut chosen = o.choice.as_ref().map_or(String::new(), |c| {
        format!("; {} chosen of {}", c.used.len(), c.used.len() + c.left_out.len())
    });
    if !o.left_out.is_empty() {
        let names: Vec<&str> = o.left_out.iter().map(|l| l.photo.as_str()).collect();
        chosen += &format!("; left out: {}", names.join(", "));
    }
    let mut list = vec![
        ("device".to_owned(), format!("{}{cpu}", o.device.name)),
        ("photos".to_owned(), sizes(&o.photos) + &chosen),
        splats_figure(&o.splats, &o.seen),
        super::fidelity::figure(&o.psnr),
    ];
    list.extend(view_dependence_figure(&o.rgb.view_dependence));
    list.extend(added_figures(o));
    list.extend(
        focal_figure(&o.photos, &o.cameras, &o.geometry.fitted).map(|text| ("focal length".to_owned(), text)),
    );
    list.extend(
        confidence_figure(&o.photos, &o.geometry.fitted, &o.psnr).map(|text| ("cameras".to_owned(), text)),
    );
    list.extend(lens_figure(o).map(|text| ("lens".to_owned(), text)));
    list.push(up_figure(&o.world));
    list.extend(super::light::figure(&o.photos));
    let codes = |k: usize| o.field.levels.get(k).map_or(0, |l| l.codebook.len());
    list.push(("things s/m/l".to_owned(), format!("{} / {} / {}", codes(0), codes(1), codes(2))));
    for a in &o.answers {
        list.push((format!("“{}”", report::one_line(&a.text)), a.verdict()));
    }
    list
}

/// How many splats there are, and how many of them are guessed.
pub(super) fn splats_figure(splats: &Splats, seen: &Seen) -> (String, String) {
    let guessed = match seen.unseen() {
        0 => String::new(),
        n => format!(", {n} of them where no photo looks"),
    };
    ("splats".to_owned(), format!("{}{guessed}", splats.len()))
}

/// The SH degree of the colours, if it is not 0, and what photos say of it.
pub(super) fn view_dependence_figure(found: &ViewDependence) -> Option<(String, String)> {
    let text = match (found.degree, found.trials.last()) {
        (0, _) => return None,
        (degree, Some(t)) if t.supported() => {
            format!("SH degree {degree}: photos left out are shown {:.1} dB better by it", t.gain)
        }
        (degree, _) => format!("SH degree {degree}"),
    };
    Some(("colours".to_owned(), text))
}

/// Which way is up, and what says so.
pub(super) fn up_figure(world: &World) -> (String, String) {
    let text = match &world.up {
        Some(up) => {
            let evidence: Vec<&str> = up.evidence.iter().map(|e| e.text()).collect();
            format!("± {:.1}° ({})", up.sigma_degrees, evidence.join(", "))
        }
        None => "not known: too few edges and surfaces agree on one direction".to_owned(),
    };
    ("up".to_owned(), text)
}

/// Per photo its working and its original (width, height).
pub(super) fn working_sizes(photos: &[Photo]) -> serde_json::Value {
    let size = |p: &Photo| json!({ "working": [p.image.width, p.image.height], "original": [p.original_size.0, p.original_size.1] });
    photos.iter().map(size).collect()
}

/// How many photos were used, at which size, and how to change that where they were scaled down.
pub(super) fn sizes(photos: &[Photo]) -> String {
    #[derive(PartialEq)]
    struct Sizes {
        working: (usize, usize),
        original: (usize, usize),
    }
    let mut pairs: Vec<Sizes> = Vec::new();
    for p in photos {
        let original = (p.original_size.0 as usize, p.original_size.1 as usize);
        let pair = Sizes { working: (p.image.width, p.image.height), original };
        if !pairs.contains(&pair) {
            pairs.push(pair);
        }
    }
    let scaled = |s: &Sizes| s.working != s.original;
    let one = |s: &Sizes| {
        let ((w, h), (original_w, original_h)) = (s.working, s.original);
        match scaled(s) {
            true => format!("{w} × {h} of {original_w} × {original_h}"),
            false => format!("{w} × {h}"),
        }
    };
    // More than a few sizes would not fit a line; run.json has them all.
    let shown: Vec<String> = pairs.iter().take(3).map(one).collect();
    let more = if pairs.len() > 3 { ", …" } else { "" };
    let hint = if photos.iter().any(|p| p.zoom() < 1.0) { " (--max-size changes it)" } else { "" };
    format!("{} at {}{more}{hint}", photos.len(), shown.join(", "))
}

/// The table that ends `splatvk run`; where the scene is of doubtful quality that stands first.
pub fn closing_table(o: &RunOutcome) -> String {
    super::fidelity::heading(&o.psnr) + &report::table(&o.stages, o.seconds, &figures(o))
}

/// Writes `run.json`, `report.html` and `previews/`.
pub(super) fn write(folder: &Path, o: &RunOutcome) -> Result<()> {
    let record = run_record(o).without_folders(o.plan.read().chain([o.plan.out.as_path()]));
    record.write(folder)?;
    let levels: Vec<Vec<_>> =
        o.frames.iter().map(|f| LEVEL_NAMES.into_iter().zip(f.codes.iter().cloned()).collect()).collect();
    // What renders are compared with.
    let targets: Vec<RgbImage> = o.photos.iter().map(Photo::target).collect();
    let views = o
        .photos
        .iter()
        .enumerate()
        .map(|(i, p)| ViewShown {
            name: &p.stem,
            photo: &targets[i],
            render: Some(&o.frames[i].rendered.rgb),
            depth: Some(&o.frames[i].rendered.depth),
            levels: &levels[i],
            psnr: o.psnr.get(i).copied(),
            light: p.light,
        })
        .collect();
    let title = o.plan.out.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
    let report = HtmlReport {
        title: &title,
        views,
        queries: o.answers.iter().map(shown).collect(),
        curves: curves(&o.rgb, &o.language_curve),
        space: Some(&o.field.space),
        scene: Some(scene(&title, &targets, o)),
        figures: figures(o),
        run: &record,
    };
    report::write_html(folder, &report)?;
    report::write_previews(folder, &report)
}

fn scene<'a>(title: &'a str, photos: &'a [RgbImage], o: &'a RunOutcome) -> Scene3d<'a> {
    Scene3d {
        title,
        splats: &o.splats,
        seen: &o.seen,
        cameras: &o.cameras,
        world: &o.world,
        photos: photos.iter().collect(),
        language: Some(&o.field),
        names: &o.names,
        answers: o.answers.iter().map(Answers::shown).collect(),
    }
}

fn shown(a: &Answers) -> QueryShown<'_> {
    let answers = a
        .views
        .iter()
        .enumerate()
        .map(|(view, v)| AnswerShown {
            view,
            relevancy: &v.relevancy,
            mask: Some(&v.mask),
            score: v.score,
            found: v.found,
            level: LEVEL_NAMES[v.level],
        })
        .collect();
    QueryShown { text: &a.text, verdict: a.sentence(), answers }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::RgbImage;
    use crate::scene::seeded;

    #[test]
    fn the_focal_length_is_told_per_camera() {
        let image = RgbImage { width: 64, height: 64, data: vec![[0.5; 3]; 64 * 64] };
        let photo = |name: &str| crate::photo::from_pixels(name.as_ref(), &image, None, 64).unwrap();
        let photos = ["a.png", "b.png", "c.png", "d.png"].map(photo);
        let camera = seeded::small(1, 64, 64, 0, 1).1;
        let cameras = [300.0, 400.0, 300.0, 400.0].map(|fx| Camera { fx, ..camera.clone() });
        let fitted = |camera| Fitted { camera, sigmas: [0.002, 0.0, 0.0, 0.0, 0.0], ..Fitted::default() };
        let text = |of: [usize; 4]| focal_figure(&photos, &cameras, &of.map(fitted)).unwrap();
        assert_eq!(text([0; 4]), "300.0 px ± 0.20 %");
        assert_eq!(text([0, 1, 0, 1]), "300.0 px ± 0.20 % (a, c); 400.0 px ± 0.20 % (b, d)");
        assert_eq!(focal_figure(&photos, &cameras, &[]), None);
    }
}
