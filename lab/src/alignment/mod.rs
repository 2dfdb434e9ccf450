//! The three steps of the alignment against true objects, without splats: one kind of error at a
//! time, in masks, features, matches, depth or cameras (docs/internals/method.md#alignment).
mod faults;
mod rand_index;

pub use faults::{FAULTS, Fault, Faults};
pub use rand_index::{Agreement, Contingency};

use crate::Result;
use crate::generate::regions::Shown;
use crate::generate::{SceneSpec, build_scene, geometry};
use serde::Serialize;
use splatvk::eval::BACKGROUND_LABELS;
use splatvk::language::align::{AlignOptions, Alignment, PairLinks, align, links_from_depth};
use splatvk::language::{ViewMasks, dir};
use splatvk::scene::{Camera, DepthMap, Image};
use splatvk_test_support::embedding::DIM;
use std::collections::BTreeMap;

/// Steps that run, by name.
pub const STEPS: [(&str, [bool; 3]); 5] = [
    ("1", [true, false, false]),
    ("1, 2", [true, true, false]),
    ("1, 3", [true, false, true]),
    ("1, 2, 3", [true, true, true]),
    ("3", [false, false, true]),
];

/// Kinds of feature spaces by the weight of the mean feature that is added to all features: between
/// different things and two views of one thing the cosine is about 0.3 and 0.8, 0.65 and 0.9, 0.8
/// and 0.95.
pub const SPACES: [(&str, f32); 3] = [("words", -0.5), ("CLIP", 0.0), ("SigLIP", 0.6)];

/// Photos of a generated scene without pictures.
pub struct TruthScene {
    seed: u64,
    labels: BTreeMap<u32, String>,
    cameras: Vec<Camera>,
    noisy: Vec<Camera>,
    objects: Vec<Image<u32>>,
    depths: Vec<Option<Image<f32>>>,
}

/// Agreement of one scene's components with its objects, per entry of [`STEPS`]: of the objects'
/// parts (levels s and m), and of whole objects (level l).
#[derive(Clone, Debug, Serialize)]
pub struct Scored {
    /// Seed of the scene.
    pub seed: u64,
    /// Per entry of [`STEPS`] and level.
    pub steps: Vec<[Agreement; 3]>,
}

impl TruthScene {
    /// Generates a scene of four photos.
    pub fn new(seed: u64, size: (u32, u32)) -> Result<TruthScene> {
        let scene = build_scene(&SceneSpec { seed, size, held_out: 0, similar: 2, ..SceneSpec::default() })?;
        let seen: Vec<_> = scene.train.iter().map(|camera| geometry(&scene, camera)).collect();
        let (depths, objects): (Vec<_>, Vec<_>) = seen.into_iter().unzip();
        Ok(TruthScene {
            seed,
            labels: scene.objects.iter().map(|o| (o.label, o.phrase.clone())).collect(),
            cameras: scene.train,
            noisy: scene.noisy,
            objects,
            depths: depths.into_iter().map(Some).collect(),
        })
    }

    fn shown(&self) -> Shown<'_> {
        Shown { labels: &self.labels, cameras: &self.cameras, objects: &self.objects, depths: &self.depths }
    }

    /// Aligns the scene's masks with a fault by all combinations of steps.
    pub fn score(&self, fault: &Fault) -> Result<Scored> {
        let faulty = self.with(fault);
        let steps = STEPS.iter().map(|(_, [matching, fusion, reprojection])| {
            let options = AlignOptions {
                matching: *matching,
                fusion: *fusion,
                reprojection: *reprojection,
                ..AlignOptions::DEFAULT
            };
            self.aligned(&faulty, &faulty.masks, &options)
        });
        Ok(Scored { seed: self.seed, steps: steps.collect::<Result<_>>()? })
    }

    /// Aligns the scene's masks with a fault by all steps, in each of [`SPACES`]: by cosines, then
    /// by their ranks.
    pub fn score_spaces(&self, fault: &Fault) -> Result<[Vec<[Agreement; 3]>; 2]> {
        let faulty = self.with(fault);
        let in_space = |(_, weight): &(&str, f32), ranked| {
            let options = AlignOptions { ranked, ..AlignOptions::DEFAULT };
            self.aligned(&faulty, &shifted(&faulty.masks, *weight), &options)
        };
        let of = |ranked| SPACES.iter().map(|space| in_space(space, ranked)).collect::<Result<_>>();
        Ok([of(false)?, of(true)?])
    }

    fn with(&self, fault: &Fault) -> Faulty {
        let faults = Faults::new(fault, self.seed);
        let masks = self.shown().regions(&faults.masks).masks;
        let true_depths: Vec<DepthMap> = self.depths.iter().flatten().map(with_confidence).collect();
        let depths: Vec<DepthMap> =
            true_depths.iter().enumerate().map(|(view, depth)| faults.depth(view, depth)).collect();
        let cameras = if faults.noisy_cameras() { &self.noisy } else { &self.cameras };
        let views = self.cameras.len();
        let pairs = (0..views).flat_map(|i| (i + 1..views).map(move |j| (i, j)));
        let (mut matched, mut projected): (Vec<PairLinks>, Vec<PairLinks>) = (Vec::new(), Vec::new());
        for (i, j) in pairs {
            let exact = [(&self.cameras[i], &true_depths[i]), (&self.cameras[j], &true_depths[j])];
            matched.push(faults.matches((i, j), exact, [&self.objects[i], &self.objects[j]]));
            projected.push(links_from_depth(i, j, (&cameras[i], &cameras[j]), (&depths[i], &depths[j])));
        }
        Faulty { masks, matched, projected, numbers: self.shown().part_numbers() }
    }

    fn aligned(
        &self,
        faulty: &Faulty,
        masks: &[ViewMasks],
        options: &AlignOptions,
    ) -> Result<[Agreement; 3]> {
        let aligned = align(masks, &faulty.matched, &faulty.projected, options)?;
        Ok([0, 1, 2].map(|level| self.agreement(&aligned, level, &faulty.numbers[level])))
    }

    /// Agreement over the pixels of all photos that show an object.
    fn agreement(&self, aligned: &Alignment, level: usize, numbers: &[Image<u32>]) -> Agreement {
        let background = |label: &u32| {
            self.labels.get(label).is_none_or(|phrase| BACKGROUND_LABELS.contains(&phrase.as_str()))
        };
        let mut owner: Vec<Vec<Option<u32>>> =
            aligned.views.iter().map(|v| vec![None; v.levels[level].quality.len()]).collect();
        for (component, number) in aligned.components[level].iter().zip(0..) {
            for m in &component.members {
                owner[m.view as usize][m.mask as usize] = Some(number);
            }
        }
        let mut table = Contingency::default();
        for (view, masks) in aligned.views.iter().enumerate() {
            let pixels = masks.levels[level].labels.data.iter().zip(&self.objects[view].data);
            for (p, (label, _)) in pixels.enumerate().filter(|(_, (_, object))| !background(object)) {
                // A pixel without a mask is a thing of its own.
                let own = usize::try_from(*label).ok().and_then(|l| owner[view].get(l).copied().flatten());
                table.add(own, numbers[view].data[p]);
            }
        }
        table.agreement()
    }
}

/// Inputs of the alignment with one kind of error.
struct Faulty {
    masks: Vec<ViewMasks>,
    matched: Vec<PairLinks>,
    projected: Vec<PairLinks>,
    numbers: [Vec<Image<u32>>; 3],
}

/// The masks with `weight` times the mean feature added to every feature.
fn shifted(views: &[ViewMasks], weight: f32) -> Vec<ViewMasks> {
    let rows = || views.iter().flat_map(|v| &v.levels).flat_map(|l| l.features.chunks_exact(DIM));
    let count = rows().count().max(1) as f32;
    let mean: Vec<f32> = (0..DIM).map(|c| weight * rows().map(|row| row[c]).sum::<f32>() / count).collect();
    let mut views = views.to_vec();
    for level in views.iter_mut().flat_map(|v| &mut v.levels) {
        level
            .features
            .chunks_exact_mut(DIM)
            .for_each(|row| row.iter_mut().zip(&mean).for_each(|(v, m)| *v += m));
        dir::normalise_rows(&mut level.features, DIM);
    }
    views
}

fn with_confidence(depth: &Image<f32>) -> DepthMap {
    let confidence = depth.data.iter().map(|z| if *z > 0.0 { 1.0 } else { 0.0 }).collect();
    DepthMap {
        depth: depth.clone(),
        confidence: Image { width: depth.width, height: depth.height, data: confidence },
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spaces_have_cosines_of_their_kind() {
        let scene = TruthScene::new(1001, (160, 120)).unwrap();
        let faulty = scene.with(&Fault::named("noisy features").unwrap());
        let mean = |weight| {
            let views = shifted(&faulty.masks, weight);
            let rows: Vec<&[f32]> = views[0].levels[2].features.chunks_exact(DIM).collect();
            let pairs = (0..rows.len()).flat_map(|a| (a + 1..rows.len()).map(move |b| (a, b)));
            let cosines: Vec<f32> = pairs.map(|(a, b)| splatvk::math::dot_f32(rows[a], rows[b])).collect();
            cosines.iter().sum::<f32>() / cosines.len() as f32
        };
        let [words, clip, siglip] = SPACES.map(|(_, weight)| mean(weight));
        assert!(
            (0.1..0.45).contains(&words) && clip > words + 0.1 && siglip > clip + 0.1,
            "{words} {clip} {siglip}"
        );
    }

    #[test]
    fn exact_masks_align_to_true_objects() {
        let scene = TruthScene::new(1001, (160, 120)).unwrap();
        let exact = scene.score(&FAULTS[0]).unwrap();
        for (agreement, (steps, _)) in exact.steps.iter().zip(STEPS) {
            assert!(agreement[2].rand > 0.97, "steps {steps}: {agreement:?}");
        }
        // Masks that no step joins are things of their own.
        let cut = FAULTS.iter().find(|f| f.name == "masks cut").unwrap();
        let cut = scene.score(cut).unwrap();
        let [alone, fused] = [0, 1].map(|k| cut.steps[k][2]);
        assert!(alone.recall < 0.95 && fused.recall > alone.recall, "{alone:?} {fused:?}");
    }
}
