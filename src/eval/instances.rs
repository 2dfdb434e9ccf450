//! Things in space against the true ones.
use super::truth::{GroundTruth, Split};
use crate::Result;
use crate::math::{median, quantile};
use crate::query::instances::Instance;
use crate::scene::Similarity;
use glam::{DVec2, DVec3};
use serde::Serialize;
use std::collections::BTreeMap;

/// Share of an object's pixels that may lie outside its box on either side: rims of depth.
const OUTSIDE: f64 = 0.02;

/// How many things answered a phrase, and where.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[non_exhaustive]
pub struct InstanceScore {
    /// The phrase.
    pub phrase: String,
    /// Objects that it means: of its own label, and of labels that end with it ("dark red ball").
    pub expected: usize,
    /// Things found.
    pub found: usize,
    /// Per expected object the distance from the middle of what the photos show of it to that of
    /// the nearest thing, true units.
    pub centre_distance: Vec<f64>,
}

/// Label → phrase and middle of what the train frames show of it, true world; those of which they
/// show `least` pixels.
pub(super) fn middles(
    truth: &GroundTruth,
    phrases: Vec<(u32, String)>,
    least: usize,
) -> Result<Vec<(String, DVec3)>> {
    let mut points: BTreeMap<u32, Vec<DVec3>> = BTreeMap::new();
    for frame in truth.frames.iter().filter(|f| f.split == Split::Train) {
        let (Some(objects), Some(depth)) = (truth.objects(frame)?, truth.depth(frame)?) else { continue };
        for (p, label) in objects.data.iter().enumerate() {
            let (x, y) = (p % objects.width, p / objects.width);
            let z = f64::from(depth.at(x, y));
            if z > 0.0 {
                let pixel = DVec2::new(x as f64 + 0.5, y as f64 + 0.5);
                points.entry(*label).or_default().push(frame.camera.unproject(pixel, z));
            }
        }
    }
    let middle = |points: &Vec<DVec3>| {
        let along = |k: usize| {
            let mut at: Vec<f64> = points.iter().map(|p| p[k]).collect();
            let ends = (quantile(&mut at, OUTSIDE)?, quantile(&mut at, 1.0 - OUTSIDE)?);
            Some(0.5 * (ends.0 + ends.1))
        };
        Some(DVec3::new(along(0)?, along(1)?, along(2)?))
    };
    let solid = |label: &u32| points.get(label).filter(|points| points.len() >= least);
    Ok(phrases.into_iter().filter_map(|(label, phrase)| Some((phrase, middle(solid(&label)?)?))).collect())
}

/// The score of a phrase; `None` where the photos show nothing of what it means.
pub(super) fn score(
    middles: &[(String, DVec3)],
    phrase: &str,
    found: &[Instance],
    to_truth: &Similarity,
) -> Option<InstanceScore> {
    let ending = format!(" {phrase}");
    let meant = |label: &str| label == phrase || label.ends_with(&ending);
    let expected: Vec<DVec3> = middles.iter().filter(|(label, _)| meant(label)).map(|m| m.1).collect();
    let places: Vec<DVec3> = found.iter().map(|i| to_truth.transform(i.centre)).collect();
    let nearest = |at: &DVec3| places.iter().map(|p| p.distance(*at)).reduce(f64::min);
    (!expected.is_empty()).then(|| InstanceScore {
        phrase: phrase.to_owned(),
        expected: expected.len(),
        found: found.len(),
        centre_distance: expected.iter().filter_map(nearest).collect(),
    })
}

/// Median distance and share of phrases with the right number.
pub(super) fn summary(scores: &[InstanceScore]) -> Option<(f64, f64)> {
    let right = scores.iter().filter(|s| s.found == s.expected).count();
    let mut distances: Vec<f64> = scores.iter().flat_map(|s| s.centre_distance.iter().copied()).collect();
    Some((median(&mut distances)?, right as f64 / scores.len() as f64))
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DMat3;

    #[test]
    fn things_are_compared_in_the_world_of_the_truth() {
        // (x, y) of the scene is (1 − 2y, 2x) there.
        let rotation = DMat3::from_rotation_z(std::f64::consts::FRAC_PI_2);
        let to_truth = Similarity { scale: 2.0, rotation, translation: DVec3::X };
        let at = |x: f64, y: f64| Instance { centre: DVec3::new(x, y, 0.0), ..Instance::default() };
        let middles = [("red ball", 1.0, 2.0), ("dark red ball", -3.0, 0.0), ("mug", 1.0, 1.0)]
            .map(|(label, x, y)| (label.to_owned(), DVec3::new(x, y, 0.0)));
        let found = [at(0.0, 2.0), at(1.0, 0.0)];
        let balls = score(&middles, "red ball", &found, &to_truth).unwrap();
        assert_eq!((balls.expected, balls.found, balls.centre_distance.len()), (2, 2, 2));
        assert!(balls.centre_distance.iter().all(|d| *d < 1e-9), "{balls:?}");
        assert_eq!(score(&middles, "lemon", &found, &to_truth), None);
    }
}
