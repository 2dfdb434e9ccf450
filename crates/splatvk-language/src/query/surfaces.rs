//! Surfaces that carry things: large planes, such as a table and the walls behind it. Masks cut
//! them into patches, which are no things of their own.
use super::instances::Places;
use super::things::Thing;
use crate::math::Random;
use glam::Vec3;

/// Distance from a plane up to which a splat may be on it, relative to the median distance of the
/// splats from their mean. Generated scenes and breakfast are the tuning sets of all constants.
const THICKNESS: f32 = 0.015;
/// Least share of the splats of things that is a surface.
const LEAST: f64 = 0.08;
/// Least share of the opacity of the scene of a thing whose splats define surfaces.
const LEAST_THING: f64 = 0.001;
/// Share of its splats on a surface from which a thing is a patch of it.
const PATCH: f64 = 0.7;
/// Most surfaces.
const MOST: usize = 8;
/// Planes tried per surface, and splats that they are tried on.
const TRIALS: usize = 300;
const SAMPLES: usize = 3000;

/// A plane: points `p` with `normal · p = offset`.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Plane {
    /// Unit normal.
    pub normal: Vec3,
    pub offset: f32,
}

impl Plane {
    /// The plane through three of the points that has most of them within `thickness`, with their
    /// number.
    pub fn most_common(
        points: &[Vec3],
        thickness: f32,
        trials: usize,
        random: &mut Random,
    ) -> (Plane, usize) {
        let mut best = (Plane::default(), 0);
        for _ in 0..trials {
            let [a, b, c] = random.sample::<3>(points.len()).map(|i| points[i]);
            let normal = (b - a).cross(c - a).normalize_or_zero();
            let plane = Plane { normal, offset: normal.dot(a) };
            let on = points.iter().filter(|p| plane.distance(**p) < thickness).count();
            if normal != Vec3::ZERO && on > best.1 {
                best = (plane, on);
            }
        }
        best
    }

    /// Distance of a point.
    pub fn distance(&self, point: Vec3) -> f32 {
        (point.dot(self.normal) - self.offset).abs()
    }
}

impl Places {
    /// Per thing the surface that it is a patch of, numbered by their number of splats, largest
    /// first. A thing of several faces, and one that stands out of a surface, is none.
    pub(super) fn surfaces(&self, things: &[Thing]) -> Vec<Option<usize>> {
        let place = |i: &usize| self.centres()[*i].as_vec3();
        let large = things.iter().filter(|thing| thing.instance.share >= LEAST_THING);
        let mut left: Vec<usize> = large.flat_map(|thing| thing.instance.splats.iter().copied()).collect();
        left.sort_unstable();
        left.dedup();
        let all = left.len();
        let mean = left.iter().map(place).sum::<Vec3>() / all.max(1) as f32;
        let mut distances: Vec<f64> = left.iter().map(|i| f64::from(place(i).distance(mean))).collect();
        let thickness = crate::math::median(&mut distances).unwrap_or(0.0) as f32 * THICKNESS;
        let mut random = Random::new(0);
        let mut planes: Vec<Plane> = Vec::new();
        while planes.len() < MOST && left.len() >= 3 {
            let step = left.len().div_ceil(SAMPLES);
            let points: Vec<Vec3> = left.iter().step_by(step).map(place).collect();
            // Thinner than the surface, so that its middle is found.
            let (plane, on) = Plane::most_common(&points, thickness / 1.5, TRIALS, &mut random);
            if (on * step) as f64 <= LEAST * all as f64 {
                break;
            }
            left.retain(|i| plane.distance(place(i)) >= thickness);
            planes.push(plane);
        }
        let patch_of = |thing: &Thing| {
            let splats = &thing.instance.splats;
            let is_patch = |plane: &Plane| {
                let on = splats.iter().filter(|i| plane.distance(place(i)) < thickness).count();
                on as f64 >= PATCH * splats.len() as f64
            };
            planes.iter().position(is_patch)
        };
        things.iter().map(patch_of).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::level_of;
    use super::super::things::OBJECTS;
    use super::*;
    use crate::scene::{LanguageField, LevelField, Splats};

    /// A table of two patches, a wall, and a cube on the table; a code each.
    #[test]
    fn patches_of_planes_are_surfaces() {
        let (mut means, mut codes): (Vec<[f32; 3]>, Vec<usize>) = Default::default();
        for k in 0..3600 {
            let (x, y) = (0.1 * (k % 60) as f32, 0.1 * (k / 60) as f32);
            means.push([x, y, 0.001 * (k % 7) as f32]);
            codes.push(usize::from(x > 3.0));
            if k % 2 == 0 {
                means.push([x, 6.0, y]);
                codes.push(2);
            }
        }
        for k in 0..1000 {
            means.push([k % 10, k / 10 % 10, k / 100].map(|v| 2.0 + 0.08 * v as f32));
            codes.push(3);
        }
        means.iter_mut().skip(5400).for_each(|mean| mean[2] -= 1.95);
        let count = means.len();
        let level = level_of(codes, 4);
        let splats = Splats {
            means,
            log_scales: vec![[0.06f32.ln(); 3]; count],
            quats: vec![[1.0, 0.0, 0.0, 0.0]; count],
            opacity_logits: vec![2.0; count],
            sh: vec![0.0; 3 * count],
            ..Splats::default()
        };
        let places = Places::of(
            &splats,
            &LanguageField { levels: vec![LevelField::default(), level], space: String::new() },
        );
        let things = places.things(0.001);
        let of_level = |level: usize| things.iter().filter(move |thing| thing.level == level);
        let objects: Vec<_> =
            of_level(OBJECTS).map(|o| (o.id(), o.is_surface, o.instance.splats.len())).collect();
        let expected = [("o1", true, 3600), ("o3", true, 1800), ("o4", false, 1000)];
        assert_eq!(objects, expected.map(|(id, is_surface, splats)| (id.to_owned(), is_surface, splats)));
        let shares: f64 = of_level(OBJECTS).map(|o| o.instance.share).sum();
        assert!((shares - 1.0).abs() < 1e-9, "{shares}");
        // The second patch of the table is a part of the first object.
        let parents: Vec<usize> = of_level(1).filter_map(|part| part.parent).collect();
        assert_eq!(parents, [0, 0, 1, 2]);
        assert!(places.surfaces(&[]).is_empty());
    }
}
