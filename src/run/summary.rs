//! The report and the closing table of a finished run, made from [`RunOutcome`].
use super::answer::Answers;
use super::outcome::RunOutcome;
use super::record::{curves, run_record};
use crate::Result;
use crate::fit::ViewDependence;
use crate::format::views::Views;
use crate::infer::words;
use crate::photo::Photo;
use crate::pose::{Confidence, Fitted};
use crate::query::presence::Presence;
use crate::report::viewer::{CodeNames, Layers, Scene3d};
use crate::report::{self, AnswerShown, Certainty, Figure, HtmlReport, QueryShown, ViewShown};
use crate::scene::{Camera, LEVEL_NAMES, RgbImage, Seen, Splats, World};
use rayon::prelude::*;
use std::path::Path;
use std::sync::LazyLock;

/// A line for every photo that joined a scene.
fn added_figures(o: &RunOutcome) -> Vec<Figure> {
    if o.known == 0 {
        return Vec::new();
    }
    (o.known..o.photos.len()).map(|view| added_figure(o, view)).collect()
}

fn added_figure(o: &RunOutcome, view: usize) -> Figure {
    let confidence = confidence(&o.geometry.fitted[view], &o.psnr).name();
    let psnr = o.psnr.get(view).copied().unwrap_or(0.0);
    let value = format!("{}: {confidence} confidence, {psnr:.2} dB", o.photos[view].stem);
    Figure::that_matters("added", value, "A photo that joined the scene: its camera, and its PSNR.")
}

/// Measured focal length of every camera id.
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

/// Confidence in the camera of a photo, limited by how well the scene shows the photos.
pub(super) fn confidence(fitted: &Fitted, psnr: &[f64]) -> Confidence {
    fitted.confidence().min(super::fidelity::ceiling(psnr))
}

/// Lowest confidence over the cameras, with the photos below the highest.
fn confidence_figure(photos: &[Photo], fitted: &[Fitted], psnr: &[f64]) -> Option<String> {
    let levels: Vec<Confidence> = fitted.iter().map(|f| confidence(f, psnr)).collect();
    let (worst, best) = (levels.iter().min()?, levels.iter().max()?);
    let doubtful = photos.iter().zip(&levels).filter(|(_, l)| *l < best).map(|(p, _)| p.stem.as_str());
    let doubtful: Vec<&str> = doubtful.collect();
    let suffix = if doubtful.is_empty() { String::new() } else { format!(" ({})", doubtful.join(", ")) };
    Some(format!("{} confidence{suffix}", worst.name()))
}

/// Estimated lens: the strongest distortion taken out, and the offset of the principal point from
/// the centre.
fn lens_figure(o: &RunOutcome) -> Option<String> {
    let all = o.photos.iter().zip(&o.cameras).map(|(p, c)| (corner_distortion(p, c), p.lens()));
    let (share, lens) = all.max_by(|a, b| a.0.abs().total_cmp(&b.0.abs()))?;
    let camera = o.cameras.first()?;
    let offset = [camera.cx / camera.width as f64 - 0.5, camera.cy / camera.height as f64 - 0.5];
    let distortion = match lens.is_none() {
        true => "no distortion seen".to_owned(),
        false => {
            format!("k1 {:.3}, k2 {:.3} ({:+.1} % at the corner), taken out", lens.k1, lens.k2, 100.0 * share)
        }
    };
    let centre = match offset.iter().all(|s| s.abs() < 1e-9) {
        true => String::new(),
        false => format!("; centre off by {:+.1}, {:+.1} %", 100.0 * offset[0], 100.0 * offset[1]),
    };
    (!o.geometry.fitted.is_empty()).then(|| distortion + &centre)
}

/// Relative displacement of the image corner by the lens.
fn corner_distortion(photo: &Photo, camera: &Camera) -> f64 {
    let corner = glam::DVec2::new(0.5 * camera.width as f64, 0.5 * camera.height as f64) / camera.fx;
    photo.lens().distort(corner).length() / corner.length() - 1.0
}

/// Figures of the report and the closing table.
fn figures(o: &RunOutcome) -> Vec<Figure> {
    // The progress output and run.json list the choice with reasons.
    let mut chosen = o.choice.as_ref().map_or(String::new(), |c| {
        format!("; {} chosen of {}", c.used.len(), c.used.len() + c.left_out.len())
    });
    if !o.left_out.is_empty() {
        let names: Vec<&str> = o.left_out.iter().map(|l| l.photo.as_str()).collect();
        chosen += &format!("; left out: {}", names.join(", "));
    }
    let mut list = match o.psnr.is_empty() {
        true => vec![Figure::that_matters(
            "views",
            sizes(&o.photos) + ", rendered from the splats",
            "The pictures in which things were found and named. No photo confirms them.",
        )],
        false => vec![
            Figure::that_matters(
                "photos",
                sizes(&o.photos) + &chosen,
                "The photos that the scene was made from, at the size they were worked on.",
            ),
            super::fidelity::figure(&o.psnr),
        ],
    };
    list.extend(super::ignored::figure(&o.ignored));
    list.extend(confidence_figure(&o.photos, &o.geometry.fitted, &o.psnr).map(|text| {
        let meaning = "How well the photos agree on where they were taken. Below high, shapes and lengths may be wrong.";
        Figure::that_matters("cameras", text, meaning)
    }));
    list.extend(added_figures(o));
    if let Some(language) = &o.language {
        let codes = |k: usize| language.field.levels.get(k).map_or(0, |l| l.codebook.len());
        let text = format!("{}, of {} parts and {} subparts", codes(2), codes(1), codes(0));
        let meaning =
            "What the scene is divided into. A click selects one; a thing may still be several that touch.";
        list.push(Figure::that_matters("things", text, meaning));
        if words::is_space(&language.field.space) {
            let text = "the built-in ones; `splatvk models fetch open` installs better ones".to_owned();
            let meaning = "A stand-in for a language network: English names of about a thousand everyday things, and colours. \
                           An answer about anything else is a guess.";
            list.push(Figure::that_matters("words", text, meaning));
        }
    }
    list.extend(sky_figure(&o.photos, &o.geometry.sky));
    list.push(up_figure(&o.world, o.psnr.is_empty()));
    list.push(splats_figure(&o.splats, &o.seen));
    list.extend(view_dependence_figure(&o.rgb.view_dependence));
    list.extend(focal_figure(&o.photos, &o.cameras, &o.geometry.fitted).map(|text| {
        Figure::new("focal length", text, "Of the photos at their working size, with one standard deviation.")
    }));
    list.extend(lens_figure(o).map(|text| {
        Figure::new("lens", text, "Radial distortion k1, k2 and offset of the principal point, as estimated.")
    }));
    list.extend(super::light::figure(&o.photos));
    list
}

/// Lines of the closing table: figures, device, and the answers last.
fn closing_lines(o: &RunOutcome) -> Vec<(String, String)> {
    // Equal cards of one machine differ by their address.
    let which = match &o.device.pci {
        _ if o.device.is_cpu => " (CPU)".to_owned(),
        Some(pci) => format!(" (pci:{pci})"),
        None => String::new(),
    };
    let device = std::iter::once(("device".to_owned(), format!("{}{which}", o.device.name)));
    let figures = figures(o).into_iter().map(|f| (f.label.to_owned(), f.value));
    let answers = o.language.iter().flat_map(|l| &l.answers);
    let answers = answers.map(|a| (format!("“{}”", report::one_line(&a.text)), a.sentence()));
    device.chain(figures).chain(answers).collect()
}

/// Photos in which sky was found: a wall taken for sky lies too far away.
fn sky_figure(photos: &[Photo], shares: &[f32]) -> Option<Figure> {
    let with_sky: Vec<&str> =
        photos.iter().zip(shares).filter(|(_, share)| **share > 0.0).map(|(p, _)| p.stem.as_str()).collect();
    let meaning = "Bright, even areas at the top of photos are placed far behind the scene. A wall among them lies too far away.";
    let text = format!("in {} of {} photos: {}", with_sky.len(), photos.len(), with_sky.join(", "));
    (!with_sky.is_empty()).then(|| Figure::that_matters("sky", text, meaning))
}

/// Number of splats, and how many of them are extrapolated.
fn splats_figure(splats: &Splats, seen: &Seen) -> Figure {
    let unseen = match seen.unseen() {
        0 => String::new(),
        n => format!(", {n} of them where no photo looks"),
    };
    let meaning = "The soft dots that the scene consists of. Where no photo looks they are guessed.";
    Figure::new("splats", format!("{}{unseen}", splats.len()), meaning)
}

/// SH degree of the colours unless it is 0, with the gain on photos left out.
fn view_dependence_figure(found: &ViewDependence) -> Option<Figure> {
    let text = match (found.degree, found.trials.last()) {
        (0, _) => return None,
        (degree, Some(t)) if t.supported() => {
            format!("SH degree {degree}: photos left out are shown {:.1} dB better by it", t.gain)
        }
        (degree, _) => format!("SH degree {degree}"),
    };
    Some(Figure::new("colours", text, "Colours depend on the direction, as on shiny things."))
}

/// Uncertainty of the direction up, with its evidence; photos alone are evidence.
fn up_figure(world: &World, are_renders: bool) -> Figure {
    match &world.up {
        Some(up) => {
            let evidence: Vec<&str> = up.evidence.iter().map(|e| e.text()).collect();
            let text = format!("± {:.1}° ({})", up.sigma_degrees, evidence.join(", "));
            Figure::new("up", text, "How exactly the direction up is known, and from what.")
        }
        None => Figure::that_matters(
            "up",
            match are_renders {
                true => {
                    "not known: the views were placed by an assumption, and no photo confirms it".to_owned()
                }
                false => "not known: too few edges and surfaces agree on one direction".to_owned(),
            },
            "The scene may stand tilted in other programs.",
        ),
    }
}

/// Number and sizes of the photos, with a hint if they were scaled down.
fn sizes(photos: &[Photo]) -> String {
    let mut distinct: Vec<String> = Vec::new();
    for photo in photos {
        let text = size_text(photo);
        if !distinct.contains(&text) {
            distinct.push(text);
        }
    }
    // A line fits only a few sizes; run.json has them all.
    let more = if distinct.len() > 3 { ", …" } else { "" };
    distinct.truncate(3);
    let hint = if photos.iter().any(|p| p.zoom() < 1.0) { " (--max-size changes it)" } else { "" };
    format!("{} at {}{more}{hint}", photos.len(), distinct.join(", "))
}

/// Working size of a photo, with the original size if it was scaled.
fn size_text(photo: &Photo) -> String {
    let (w, h) = (photo.image.width, photo.image.height);
    let original = (photo.original_size.0 as usize, photo.original_size.1 as usize);
    match original == (w, h) {
        true => format!("{w} × {h}"),
        false => format!("{w} × {h} of {} × {}", original.0, original.1),
    }
}

/// The table that ends `splatvk run`; a warning of doubtful quality precedes it.
pub fn closing_table(o: &RunOutcome) -> String {
    super::fidelity::heading(&o.psnr) + &report::table(&o.stages, o.seconds, &closing_lines(o))
}

/// Writes `run.json`, `report.html` and `previews/`.
pub(super) fn write(folder: &Path, o: &RunOutcome) -> Result<()> {
    let record = run_record(o).without_folders(o.plan.read().chain([o.plan.output.out.as_path()]))?;
    record.write(folder)?;
    let levels: Vec<Vec<_>> =
        o.frames.iter().map(|f| LEVEL_NAMES.into_iter().zip(f.codes.iter().cloned()).collect()).collect();
    // Renders are compared with these.
    let targets: Vec<RgbImage> = o.photos.par_iter().map(Photo::target).collect();
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
    let title = o.plan.output.out.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
    let report = HtmlReport {
        title: &title,
        views,
        queries: o.language.iter().flat_map(|l| &l.answers).map(shown).collect(),
        curves: curves(o),
        space: o.language.as_ref().map(|l| l.field.space.as_str()),
        scene: Some(scene(&title, &targets, o)),
        figures: figures(o),
        run: &record,
    };
    let (html, previews) =
        rayon::join(|| report::write_html(folder, &report), || report::write_previews(folder, &report));
    html.and(previews)
}

/// Names of codes for scenes without language.
static NO_NAMES: CodeNames = Vec::new();
/// Holes of scenes that are made: they have no edits.
static NO_SPLATS: LazyLock<Splats> = LazyLock::new(Splats::default);

fn scene<'a>(title: &'a str, photos: &'a [RgbImage], o: &'a RunOutcome) -> Scene3d<'a> {
    Scene3d {
        title,
        layers: Layers { splats: &o.splats, seen: &o.seen, holes: &NO_SPLATS, backdrop: &o.backdrop },
        cameras: &o.cameras,
        world: &o.world,
        photos: photos.iter().collect(),
        language: o.language.as_ref().map(|l| &l.field),
        names: o.language.as_ref().map_or(&NO_NAMES, |l| &l.names),
        answers: o.language.iter().flat_map(|l| &l.answers).map(Answers::shown).collect(),
        suggested: Vec::new(),
        named: Views::default(),
    }
}

fn shown(a: &Answers) -> QueryShown<'_> {
    let answers = a
        .views
        .iter()
        .enumerate()
        .map(|(view, v)| AnswerShown { view, relevancy: v.relevancy(), mask: Some(v.mask()), found: v.found })
        .collect();
    let certainty = match a.presence {
        _ if a.found() == 0 => Certainty::Nothing,
        Some(Presence::Unsure) => Certainty::Unsure,
        _ => Certainty::Found,
    };
    QueryShown { text: &a.text, verdict: a.sentence(), certainty, answers }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::RgbImage;
    use crate::scene::seeded;

    #[test]
    fn focal_figure_groups_by_camera() {
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
