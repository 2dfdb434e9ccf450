//! Applies a list of edits to a loaded scene.
use super::{Edit, EditList, Operation, Rows};
use crate::format::scene_dir::Scene;
use crate::scene::{SH_C0, Splats};

/// Brightness that recolouring adds before it compares: the shading of dark things would be
/// amplified without it.
const LEAST_LUMA: f32 = 0.1;

/// Edits that a loaded scene contains.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct AppliedEdits {
    /// Number of edits.
    pub count: usize,
    /// [N] row in the reconstruction of every splat, ascending.
    pub rows: Vec<u32>,
}

/// The scene after its edits. `scene` is the reconstruction.
pub fn apply(mut scene: Scene, list: &EditList) -> Scene {
    if list.edits.is_empty() {
        return scene;
    }
    let count = scene.splats.len();
    let mut kept = vec![true; count];
    let mut holes = std::mem::take(&mut scene.holes);
    for Edit { operation, splats, .. } in &list.edits {
        let selected: Vec<usize> = (0..count).filter(|&i| kept[i] && splats.has(i)).collect();
        match operation {
            Operation::Delete {} => {
                add_holes(&mut holes, &scene.splats, &selected);
                selected.iter().for_each(|&i| kept[i] = false);
            }
            Operation::Isolate {} => {
                (0..count).for_each(|i| kept[i] &= splats.has(i));
                (holes, scene.backdrop) = Default::default();
            }
            Operation::Recolour { colour } => recolour(&mut scene.splats, &selected, *colour),
            Operation::Move { by } => {
                add_holes(&mut holes, &scene.splats, &selected);
                let levels = scene.language.iter_mut().flat_map(|field| &mut field.levels);
                let own = levels.filter_map(|level| level.splats.as_mut());
                own.chain([&mut scene.splats]).for_each(|splats| translate(splats, &selected, *by));
            }
        }
    }
    let rows: Vec<usize> = (0..count).filter(|i| kept[*i]).collect();
    let pixels = rows.iter().filter_map(|&i| scene.seen.pixels.get(i)).copied().collect();
    scene.splats = scene.splats.picked(&rows);
    scene.seen.pixels = pixels;
    scene.language = scene.language.map(|field| field.picked(&rows, count));
    let rows = rows.into_iter().map(|i| i as u32).collect();
    scene.holes = holes;
    scene.edits = Some(AppliedEdits { count: list.edits.len(), rows });
    scene
}

impl AppliedEdits {
    /// The set of rows of the reconstruction behind rows of the edited scene.
    pub fn originals(&self, rows: impl IntoIterator<Item = usize>) -> Rows {
        Rows::of(rows.into_iter().map(|row| self.rows[row] as usize))
    }
}

fn add_holes(holes: &mut Splats, splats: &Splats, rows: &[usize]) {
    let taken = splats.picked(rows).bare();
    match holes.is_empty() {
        true => *holes = taken,
        false => holes.append_raised(taken),
    }
}

/// Rec. 709 weights of a colour's brightness.
fn luma(colour: &[f32]) -> f32 {
    0.2126 * colour[0] + 0.7152 * colour[1] + 0.0722 * colour[2]
}

/// Gives splats a mean colour; each keeps its brightness relative to the mean. The colour is linear
/// in the old one, so that harmonics of every degree change alike.
fn recolour(splats: &mut Splats, rows: &[usize], colour: [f32; 3]) {
    let width = 3 * splats.sh_len();
    let brightness = |splats: &Splats, i: usize| 0.5 + SH_C0 * luma(&splats.sh[i * width..i * width + 3]);
    let opacity = |i: usize| 1.0 / (1.0 + f64::from(-splats.opacity_logits[i]).exp());
    let (mut sum, mut weight) = (0.0, 0.0);
    for &i in rows {
        sum += opacity(i) * f64::from(brightness(splats, i));
        weight += opacity(i);
    }
    let mean = (sum / weight.max(f64::MIN_POSITIVE)) as f32;
    let gain = 1.0 / (mean.max(0.0) + LEAST_LUMA);
    for &i in rows {
        let base = (brightness(splats, i) + LEAST_LUMA) * gain;
        for (k, term) in splats.sh[i * width..(i + 1) * width].chunks_exact_mut(3).enumerate() {
            let grey = luma(term) * gain;
            for (value, target) in term.iter_mut().zip(colour) {
                *value = if k == 0 { (base * target - 0.5) / SH_C0 } else { grey * target };
            }
        }
    }
}

fn translate(splats: &mut Splats, rows: &[usize], by: [f64; 3]) {
    for &i in rows {
        let mean = &mut splats.means[i];
        *mean = [0, 1, 2].map(|k| (f64::from(mean[k]) + by[k]) as f32);
    }
}
