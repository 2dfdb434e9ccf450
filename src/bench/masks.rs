//! Benchmark of photos → edges → masks on data with true masks, without cameras and training: IoU
//! of the best mask of any level with each object, and of the best single level over all photos.
use crate::eval::{BACKGROUND_LABELS, GroundTruth, MIN_OBJECT_PIXELS};
use crate::infer::Registry;
use crate::infer::hed::Hed;
use crate::language::graph;
use crate::photo;
use crate::progress::Progress;
use crate::scene::LEVEL_NAMES;
use crate::{Error, Result};
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::Instant;

/// Result of one data set.
#[derive(Clone, Debug, Serialize)]
pub struct MaskRow {
    /// Its folder.
    pub data: PathBuf,
    /// Photos with true masks.
    pub photos: usize,
    /// Number of (photo, object) pairs, where the photo shows the object.
    pub shown: usize,
    /// IoU of an object with the best mask of any level, mean over these pairs.
    pub best: f64,
    /// IoU with the best mask of the level that is best for the object over all photos, mean over
    /// the objects.
    pub one_level: f64,
    /// Masks per photo on levels s, m, l.
    pub masks: [f64; 3],
    /// Seconds per photo for the edges.
    pub edge_seconds: f64,
    /// Seconds per photo for the masks.
    pub mask_seconds: f64,
    /// Each object, by phrase.
    pub objects: BTreeMap<String, ObjectFit>,
}

/// IoU of the masks with one object.
#[derive(Clone, Debug, Default, Serialize)]
pub struct ObjectFit {
    /// Photos that show the object.
    pub photos: usize,
    /// IoU of the best mask of each photo, mean.
    pub best: f64,
    /// IoU of the best mask of each photo on levels s, m, l, mean.
    pub levels: [f64; 3],
}

impl ObjectFit {
    fn best_level(&self) -> f64 {
        self.levels.into_iter().fold(0.0, f64::max)
    }
}

/// Results of all data sets, with their means.
#[derive(Clone, Debug, Serialize)]
#[non_exhaustive]
pub struct MaskReport {
    /// In the order given.
    pub rows: Vec<MaskRow>,
    /// Mean over the sets of [`MaskRow::best`].
    pub best: f64,
    /// Mean over the sets of [`MaskRow::one_level`].
    pub one_level: f64,
}

/// Segments every photo that has true masks, at a longer side of at most `max_size` pixels.
pub fn measure(
    sets: &[PathBuf],
    max_size: usize,
    registry: &Registry,
    progress: &dyn Progress,
    done: &mut dyn FnMut(&MaskRow) -> Result<()>,
) -> Result<MaskReport> {
    let truths = sets.iter().map(|s| GroundTruth::read(s)).collect::<Result<Vec<_>>>()?;
    let mut network = Hed::load(registry)?;
    let mut rows = Vec::new();
    for truth in &truths {
        let row = measure_set(truth, max_size, &mut network, progress)?;
        done(&row)?;
        rows.push(row);
    }
    let mean = |of: fn(&MaskRow) -> f64| rows.iter().map(of).sum::<f64>() / rows.len().max(1) as f64;
    Ok(MaskReport { best: mean(|r| r.best), one_level: mean(|r| r.one_level), rows })
}

fn measure_set(
    truth: &GroundTruth,
    max_size: usize,
    network: &mut Hed,
    progress: &dyn Progress,
) -> Result<MaskRow> {
    let options = graph::GraphOptions::default();
    let (mut photos, mut edge_seconds, mut mask_seconds) = (0, 0.0, 0.0);
    let (mut masks, mut objects) = ([0.0; 3], BTreeMap::<String, ObjectFit>::new());
    // True masks exist for photos without distortion.
    for frame in truth.frames.iter().filter(|f| f.lens.is_none()) {
        progress.check()?;
        let Some(shown) = truth.objects(frame)? else { continue };
        let image = photo::load_at(&truth.folder.join(&frame.file), max_size)?.image;
        let clock = Instant::now();
        let edges = network.edges(&image)?;
        edge_seconds += clock.elapsed().as_secs_f64();
        let clock = Instant::now();
        let found = graph::segment(&image, &edges, &options)?;
        mask_seconds += clock.elapsed().as_secs_f64();
        photos += 1;
        for (sum, level) in masks.iter_mut().zip(&found.levels) {
            *sum += level.quality.len() as f64;
        }
        for (label, levels) in found.best_ious(&shown, MIN_OBJECT_PIXELS) {
            let Some(phrase) = truth.labels.get(&label) else { continue };
            if !BACKGROUND_LABELS.contains(&phrase.as_str()) {
                let fit = objects.entry(phrase.clone()).or_default();
                fit.photos += 1;
                fit.best += levels.into_iter().fold(0.0, f64::max);
                fit.levels.iter_mut().zip(levels).for_each(|(sum, v)| *sum += v);
            }
        }
    }
    let shown: usize = objects.values().map(|o| o.photos).sum();
    if shown == 0 {
        let folder = truth.folder.display();
        return Err(Error::input(format!(
            "{folder}: no photo without distortion has a mask of an object; give a set with masks/STEM.png"
        )));
    }
    let best = objects.values().map(|o| o.best).sum::<f64>() / shown as f64;
    for fit in objects.values_mut() {
        let n = fit.photos as f64;
        fit.best /= n;
        fit.levels.iter_mut().for_each(|v| *v /= n);
    }
    let per_photo = |v: f64| v / photos as f64;
    Ok(MaskRow {
        data: truth.folder.clone(),
        photos,
        shown,
        best,
        one_level: objects.values().map(ObjectFit::best_level).sum::<f64>() / objects.len() as f64,
        masks: masks.map(per_photo),
        edge_seconds: per_photo(edge_seconds),
        mask_seconds: per_photo(mask_seconds),
        objects,
    })
}

/// Column heads of [`MaskRow::text`].
pub fn header() -> String {
    let [s, m, l] = LEVEL_NAMES.map(|n| format!("masks {n}"));
    format!(
        "{:<24}{:>8}{:>8}{:>8}{:>11}{s:>9}{m:>9}{l:>9}{:>9}{:>9}\n",
        "data", "photos", "shown", "best", "one level", "edges s", "masks s"
    )
}

impl MaskRow {
    /// One line of the table.
    pub fn text(&self) -> String {
        let name = self
            .data
            .file_name()
            .map_or_else(|| self.data.display().to_string(), |n| n.to_string_lossy().into());
        let [s, m, l] = self.masks;
        format!(
            "{name:<24}{:>8}{:>8}{:>8.3}{:>11.3}{s:>9.1}{m:>9.1}{l:>9.1}{:>9.2}{:>9.2}\n",
            self.photos, self.shown, self.best, self.one_level, self.edge_seconds, self.mask_seconds
        )
    }
}

impl MaskReport {
    /// The line below the table.
    pub fn text(&self) -> String {
        format!(
            "{} sets: mean best-of-three IoU {:.3}, with one level per object {:.3}\n",
            self.rows.len(),
            self.best,
            self.one_level
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::progress::Silent;
    use std::path::Path;

    #[test]
    #[ignore = "takes long: tools/test-long"]
    fn masks_of_breakfast_reach_targets() {
        let registry = Registry::open(None).unwrap();
        let breakfast = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/breakfast");
        let mut seen = String::new();
        let report = measure(std::slice::from_ref(&breakfast), 800, &registry, &Silent, &mut |row| {
            seen.push_str(&row.text());
            Ok(())
        })
        .unwrap();
        let row = &report.rows[0];
        println!("{}{seen}{:#?}", header(), row.objects);
        assert_eq!(
            (row.photos, row.shown, row.objects.len()),
            (12, 96, 8),
            "table, wall and carpet are no objects"
        );
        // Targets of the built-in masks on this set (docs/internals/method.md#graph-masks).
        assert!(row.best > 0.9 && row.one_level > 0.88, "{seen}");
        assert!(row.one_level <= row.best && report.best == row.best);
        let mut sizes = row.masks.to_vec();
        sizes.sort_by(|a, b| b.total_cmp(a));
        assert_eq!(sizes, row.masks, "finer levels have more masks");
    }
}
