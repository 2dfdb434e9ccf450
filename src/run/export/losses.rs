//! Warnings of properties that a file cannot hold.
use crate::format::gaussians::SplatFormat;
use crate::format::scene_dir::Scene;
use crate::progress::Progress;
use crate::scene::{SH_C0, Splats};

/// Warns if a file with one set of splats gets features that were trained on others.
pub(super) fn warn_of_models(scene: &Scene, progress: &dyn Progress) {
    let levels = scene.language.iter().flat_map(|field| &field.levels);
    if levels.into_iter().any(|level| level.splats.is_some()) {
        progress.warn(
            "every level of this scene has splats of its own, a file has one set: features go with the shared splats, which \
             they were not trained on; the scene directory keeps all",
        );
    }
}

/// Upper bound of base colours in ordinary photos: of 145,000 splats of the breakfast scene one in
/// 50,000 is above 1.1, none above 1.25.
const ORDINARY: f32 = 1.25;
/// Share of the solid splats that may be clipped without a warning.
const UNNOTICED: f64 = 5e-4;

/// Warns of properties that a format cannot hold.
pub(super) fn warn_of_losses(splats: &Splats, format: &SplatFormat, progress: &dyn Progress) {
    if let Some(brightest) = format.brightest {
        warn_of_range(splats, brightest, progress);
    }
    if splats.antialiased && !format.states_filter {
        progress.warn(&format!(
            "the scene is antialiased and {} cannot say so: programs draw its thin splats too heavy; ply, compressed-ply and \
             spz keep it",
            format.name
        ));
    }
}

/// Warns if a format clips base colours of solid splats above `brightest`.
fn warn_of_range(splats: &Splats, brightest: f32, progress: &dyn Progress) {
    let row = splats.sh.len() / splats.len().max(1);
    let limit = brightest.max(ORDINARY);
    let (mut solid, mut cut) = (0usize, 0usize);
    for (logit, sh) in splats.opacity_logits.iter().zip(splats.sh.chunks_exact(row.max(1))) {
        if *logit > 0.0 {
            solid += 1;
            cut += usize::from(sh.iter().take(3).any(|dc| 0.5 + SH_C0 * dc > limit));
        }
    }
    if cut as f64 > UNNOTICED * solid as f64 {
        progress.warn(&format!(
            "the format ends at {brightest:.2} of white and {cut} splats are brighter: they are cut off; ply, \
             compressed-ply, glb and gltf keep them"
        ));
    }
}
