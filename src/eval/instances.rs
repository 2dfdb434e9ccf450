//! Instances against the true objects.
use super::truth::{GroundTruth, Split};
use crate::Result;
use crate::math::{median, quantile};
use crate::query::instances::Instance;
use crate::scene::Similarity;
use glam::{DVec2, DVec3};
use serde::Serialize;
use std::collections::BTreeMap;

/// Share of an object's pixels that may lie outside its box on either side: depth noise at its rim.
const OUTSIDE: f64 = 0.02;

/// Number and positions of the instances of a phrase.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[non_exhaustive]
pub struct InstanceScore {
    /// The phrase.
    pub phrase: String,
    /// Objects of the phrase: with its own label, or with a label that ends with it ("dark red
    /// ball").
    pub expected: usize,
    /// Number of instances found.
    pub found: usize,
    /// Distance from the middle of each expected object, over its visible pixels, to the nearest
    /// instance, true units.
    pub centre_distance: Vec<f64>,
}

/// Phrase and middle of the visible surface of every label with at least `least` pixels in the
/// train frames, true world.
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
    let visible = |label: &u32| points.get(label).filter(|points| points.len() >= least);
    Ok(phrases.into_iter().filter_map(|(label, phrase)| Some((phrase, middle(visible(&label)?)?))).collect())
}

/// Centre of the box of points without the share [`OUTSIDE`] on either side.
fn middle(points: &[DVec3]) -> Option<DVec3> {
    let along = |k: usize| {
        let mut coordinates: Vec<f64> = points.iter().map(|p| p[k]).collect();
        let ends = (quantile(&mut coordinates, OUTSIDE)?, quantile(&mut coordinates, 1.0 - OUTSIDE)?);
        Some(0.5 * (ends.0 + ends.1))
    };
    Some(DVec3::new(along(0)?, along(1)?, along(2)?))
}

/// Scores a phrase; `None` if the photos show none of its objects.
pub(super) fn score(
    middles: &[(String, DVec3)],
    phrase: &str,
    found: &[Instance],
    to_truth: &Similarity,
) -> Option<InstanceScore> {
    let ending = format!(" {phrase}");
    let matches = |label: &str| label == phrase || label.ends_with(&ending);
    let expected: Vec<DVec3> = middles.iter().filter(|(label, _)| matches(label)).map(|m| m.1).collect();
    let centres: Vec<DVec3> = found.iter().map(|i| to_truth.transform(i.centre)).collect();
    let nearest = |middle: &DVec3| centres.iter().map(|c| c.distance(*middle)).reduce(f64::min);
    (!expected.is_empty()).then(|| InstanceScore {
        phrase: phrase.to_owned(),
        expected: expected.len(),
        found: found.len(),
        centre_distance: expected.iter().filter_map(nearest).collect(),
    })
}

/// Median distance, and share of phrases with the right number of instances.
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
    fn instances_are_compared_in_true_world() {
        // The truth has (1 − 2y, 2x) for (x, y) of the scene.
        let rotation = DMat3::from_rotation_z(std::f64::consts::FRAC_PI_2);
        let to_truth = Similarity { scale: 2.0, rotation, translation: DVec3::X };
        let instance = |x: f64, y: f64| Instance { centre: DVec3::new(x, y, 0.0), ..Instance::default() };
        let middles = [("red ball", 1.0, 2.0), ("dark red ball", -3.0, 0.0), ("mug", 1.0, 1.0)]
            .map(|(label, x, y)| (label.to_owned(), DVec3::new(x, y, 0.0)));
        let found = [instance(0.0, 2.0), instance(1.0, 0.0)];
        let balls = score(&middles, "red ball", &found, &to_truth).unwrap();
        assert_eq!((balls.expected, balls.found, balls.centre_distance.len()), (2, 2, 2));
        assert!(balls.centre_distance.iter().all(|d| *d < 1e-9), "{balls:?}");
        assert_eq!(score(&middles, "lemon", &found, &to_truth), None);
    }
}
