//! Validity of Gaussians in files, for reading and writing; and the form of notes on files.
use crate::scene::{LanguageField, Splats};
use crate::{Error, Result};
use std::path::Path;

/// Greatest magnitude of a number of a Gaussian: the square of more than 1.8e19 overflows f32.
const GREATEST: f32 = 1e18;

/// Whether the numbers, standard deviations and squared quaternion of a Gaussian are finite and at
/// most [`GREATEST`], and its quaternion has a direction.
fn is_usable(s: &Splats, i: usize) -> bool {
    let width = 3 * s.sh_len();
    let plain = [&s.means[i][..], &s.log_scales[i], &s.quats[i], &s.sh[i * width..(i + 1) * width]];
    let squared = s.quats[i].iter().map(|v| v * v).sum::<f32>();
    // NaN fails every comparison.
    plain.into_iter().flatten().chain([&s.opacity_logits[i]]).all(|v| v.abs() <= GREATEST)
        && s.log_scales[i].iter().all(|v| *v <= GREATEST.ln())
        && squared > 0.0
        && squared.is_finite()
}

/// Number of unusable Gaussians, and the index of the first.
fn unusable(s: &Splats) -> Option<(usize, usize)> {
    let mut bad = (0..s.len()).filter(|i| !is_usable(s, *i));
    bad.next().map(|first| (1 + bad.count(), first))
}

const WHY: &str = "numbers that are not finite, are beyond 1e18 or give no rotation";

/// Filters Gaussians of another program's file: drops unusable ones, with their language, and notes
/// their number. Scales of 0 and opacities of 0 and 1, whose parameters are infinite, become the
/// nearest values in f32.
pub(super) fn keep(
    mut s: Splats,
    language: Option<LanguageField>,
    path: &Path,
    notes: &mut Vec<String>,
) -> Result<(Splats, Option<LanguageField>)> {
    let smallest = f32::MIN_POSITIVE.ln();
    s.log_scales
        .as_flattened_mut()
        .iter_mut()
        .filter(|v| **v == f32::NEG_INFINITY)
        .for_each(|v| *v = smallest);
    let (clear, solid) = (crate::format::logit(0.0), crate::format::logit(1.0));
    s.opacity_logits.iter_mut().filter(|v| v.is_infinite()).for_each(|v| *v = v.clamp(clear, solid));
    let Some((count, first)) = unusable(&s) else { return Ok((s, language)) };
    let all = s.len();
    if count == all {
        return Err(Error::input(format!(
            "{}: all its {all} Gaussians have {WHY}; it is damaged or of another format",
            path.display()
        )));
    }
    let rows: Vec<usize> = (0..all).filter(|i| is_usable(&s, *i)).collect();
    notes.push(format!(
        "{count} of {all} Gaussians are left out, the first is number {first}: they have {WHY}"
    ));
    Ok((s.picked(&rows), language.map(|l| l.picked(&rows, all))))
}

/// Largest number of notes on one file.
const MOST_NOTES: usize = 20;

/// Final form of the notes on a file: with its name, and limited in number.
pub(super) fn finished(mut notes: Vec<String>, path: &Path) -> Vec<String> {
    let more = notes.len().saturating_sub(MOST_NOTES);
    notes.truncate(MOST_NOTES);
    notes.extend((more > 0).then(|| format!("and {more} more such notes")));
    notes.into_iter().map(|note| format!("{}: {note}", path.display())).collect()
}

/// Largest step between two coordinates, relative to the extent: a tenth of a pixel in an image of
/// the whole scene.
const FINEST_STEP: f32 = 1e-4;

/// A note where coordinates are so large relative to their extent that single precision is too
/// coarse, as in map coordinates.
pub(super) fn precision(positions: &[[f32; 3]]) -> Option<String> {
    let finite = || positions.iter().filter(|p| p.iter().all(|v| v.abs() <= GREATEST));
    let mut bounds = [[f32::INFINITY, f32::NEG_INFINITY]; 3];
    for position in finite() {
        for (bound, v) in bounds.iter_mut().zip(position) {
            *bound = [bound[0].min(*v), bound[1].max(*v)];
        }
    }
    let extent = bounds.iter().fold(0f32, |m, [low, high]| m.max(high - low));
    let greatest = bounds.iter().flatten().filter(|v| v.is_finite()).fold(0f32, |m, v| m.max(v.abs()));
    let step = greatest * f32::EPSILON;
    (extent > 0.0 && step > FINEST_STEP * extent).then(|| {
        format!(
            "coordinates of up to {greatest} over an extent of {extent} are held to {step:.1e} only: subtract an offset before"
        )
    })
}

/// Refuses a scene of this program with unusable Gaussians.
pub fn check_read(path: &Path, s: &Splats) -> Result<()> {
    refuse(s)
        .map_err(|what| Error::input(format!("{}: {what}; the scene is damaged, run again", path.display())))
}

/// Refuses to write Gaussians that the reader would drop.
pub(super) fn check_written(s: &Splats) -> Result<()> {
    refuse(s).map_err(|what| Error::work(format!("nothing is written: {what}")))
}

fn refuse(s: &Splats) -> Result<(), String> {
    match unusable(s) {
        Some((count, first)) => {
            Err(format!("{count} of {} Gaussians, the first is number {first}, have {WHY}", s.len()))
        }
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::format::gaussians::{FORMATS, read_noted};
    use crate::scene::LevelField;

    fn four() -> Splats {
        Splats {
            means: (0..4).map(|i| [i as f32, 0.5, -0.5]).collect(),
            log_scales: vec![[-2.0; 3]; 4],
            quats: vec![[1.0, 0.0, 0.0, 0.0]; 4],
            opacity_logits: vec![0.5; 4],
            sh_degree: 0,
            sh: vec![0.1; 12],
            antialiased: false,
        }
    }

    #[test]
    fn unusable_gaussians_are_dropped_and_counted() {
        type Change = fn(&mut Splats);
        let changes: [Change; 6] = [
            |s| s.means[2][0] = f32::INFINITY,
            |s| s.log_scales[2][1] = 100.0,
            |s| s.quats[2] = [0.0; 4],
            |s| s.quats[2] = [1e20, 0.0, 0.0, 0.0],
            |s| s.opacity_logits[2] = f32::NAN,
            |s| s.sh[7] = f32::NAN,
        ];
        for change in changes {
            let mut s = four();
            change(&mut s);
            assert_eq!(unusable(&s), Some((1, 2)));
            assert!(check_written(&s).unwrap_err().to_string().contains("the first is number 2"));
            let level = LevelField { features: vec![0.0, 1.0, 2.0, 3.0], ..LevelField::default() };
            let field = LanguageField { levels: vec![level], ..LanguageField::default() };
            let mut notes = Vec::new();
            let (kept, language) = keep(s, Some(field), Path::new("a.ply"), &mut notes).unwrap();
            assert_eq!(kept, four().picked(&[0, 1, 3]));
            assert_eq!(language.unwrap().levels[0].features, [0.0, 1.0, 3.0]);
            assert!(notes[0].contains("1 of 4 Gaussians are left out, the first is number 2"));
        }
        let mut all = four();
        all.means.iter_mut().for_each(|m| m[0] = f32::NAN);
        assert_eq!(keep(all, None, Path::new("a.ply"), &mut Vec::new()).unwrap_err().exit_code(), 2);
    }

    #[test]
    fn flat_and_solid_ones_are_kept() {
        let mut s = four();
        (s.log_scales[0][2], s.opacity_logits[1]) = (f32::NEG_INFINITY, f32::INFINITY);
        let mut notes = Vec::new();
        let (kept, _) = keep(s, None, Path::new("a.ply"), &mut notes).unwrap();
        assert!(notes.is_empty() && unusable(&kept).is_none() && kept.len() == 4);
        assert!(kept.opacity_logits[1] > 10.0 && kept.log_scales[0][2] < -80.0);
    }

    #[test]
    fn writers_refuse_unusable_gaussians() {
        let folder = tempfile::tempdir().unwrap();
        for format in &FORMATS {
            let path = folder.path().join(format!("a{}", format.ending));
            let mut s = four();
            (s.means[0], s.log_scales[1], s.sh[0]) = ([1e17, -1e17, 3.0], [41.0, -90.0, 0.0], 1e17);
            if format.name == "spz" {
                // Its 24 bits end far below that.
                s.means[0] = [8e6, -8e6, 3.0];
            }
            super::super::write(&path, &s, None).unwrap();
            let (back, _, notes) = read_noted(&path).unwrap();
            assert!(back.len() == 4 && notes.is_empty(), "{}: {notes:?}", format.name);
            s.means[3][1] = f32::NAN;
            std::fs::remove_file(&path).unwrap();
            let e = super::super::write(&path, &s, None).unwrap_err().to_string();
            assert!(e.contains("nothing is written") && !path.exists(), "{}: {e}", format.name);
        }
    }
}
