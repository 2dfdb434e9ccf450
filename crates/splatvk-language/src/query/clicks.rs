//! Level that a click selects: the whole thing, without the surface it stands on
//! (docs/use/viewer.md).
use super::instances::splat_codes;
use super::surfaces::Plane;
use crate::math::Random;
use crate::scene::{Camera, LanguageField, Splats};
use glam::Vec3;
use std::collections::BTreeMap;

/// Share of all splats from which a code is a table or a wall merged with its objects.
const LARGE: f64 = 0.25;
/// Size of a code, relative to that of the next finer one at the same place, above which it joins
/// things. On four tuning sets the mean IoU of clicks with labelled things is 0.33 without this
/// rule, 0.36 with 8, 0.37 with 6, 0.38 with 4 and 0.36 with 3.
const MOST_PARTS: usize = 6;
/// Planes tried per code.
const TRIALS: usize = 60;
/// Most splats of a code that they are tried on.
const SAMPLES: usize = 1500;
/// Fewest splats of a code that may be a surface.
const LEAST_SURFACE: usize = 200;
/// Fewest splats of a code that may stand on it.
const LEAST_THING: usize = 20;
/// Half the thickness of a plane, relative to the root mean square radius of the code.
const THICKNESS: f32 = 0.03;
/// Share of a code's splats on its plane from which the code is a surface.
const FLAT: f64 = 0.4;
/// Share of a thing's splats in front of the plane from which it stands on the plane.
const IN_FRONT: f64 = 0.6;
/// Largest radius of a thing, relative to that of the surface. Beyond, both are parts of one thing:
/// seat and back of a chair, screen and keys.
const SMALL: f32 = 0.5;

/// Things that the masks of a coarser level join with the surface that carries them.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Standing {
    /// Number of splats per level and code.
    sizes: Vec<Vec<usize>>,
    splats: usize,
    /// Per level [code, finer level, code of that level].
    pairs: Vec<Vec<[usize; 3]>>,
}

impl Standing {
    /// Compares the codes of all levels of a scene; the cameras are in front of its surfaces.
    pub fn of(splats: &Splats, field: &LanguageField, cameras: &[Camera]) -> Standing {
        let codes: Vec<Vec<Option<usize>>> = field.levels.iter().map(splat_codes).collect();
        let centres: Vec<Vec3> = cameras.iter().map(|c| c.pose.centre().as_vec3()).collect();
        let mut standing = Standing { splats: splats.len(), ..Standing::default() };
        for (level, own) in codes.iter().enumerate() {
            let members = grouped(own);
            let mut sizes = vec![0; field.levels[level].codebook.len()];
            members.iter().for_each(|(code, list)| sizes[*code] = list.len());
            standing.sizes.push(sizes);
            let mut pairs = Vec::new();
            for (code, list) in members.iter().filter(|m| level > 0 && m.1.len() >= LEAST_SURFACE) {
                let Some(plane) = Surface::of(&splats.means, list, &centres) else { continue };
                for finer in 0..level {
                    let things = plane.carried(&splats.means, list, (&codes[finer], &standing.sizes[finer]));
                    pairs.extend(things.into_iter().map(|thing| [*code, finer, thing]));
                }
            }
            standing.pairs.push(pairs);
        }
        standing
    }

    /// Per level [code, finer level, code of that level]: the second stands on the surface that is
    /// most of the first.
    pub fn pairs(&self) -> &[Vec<[usize; 3]>] {
        &self.pairs
    }

    /// Level that a click on a pixel with these codes, finest level first, selects: the coarsest
    /// one whose code is not large, joins few parts and is no surface below the thing. `None`
    /// without a code.
    pub fn level_of(&self, codes: &[Option<usize>]) -> Option<usize> {
        let of_level = |level: &usize| codes[*level].is_some();
        let is_whole = |level: &usize| {
            let Some(code) = codes[*level] else { return false };
            let carries = |pair: &[usize; 3]| pair[0] == code && codes[pair[1]] == Some(pair[2]);
            let large = self.sizes[*level][code] as f64 >= LARGE * self.splats as f64;
            let part = (0..*level).rev().find_map(|finer| Some(self.sizes[finer][codes[finer]?]));
            let joined = part.is_some_and(|n| self.sizes[*level][code] > MOST_PARTS * n);
            !large && !joined && !self.pairs[*level].iter().any(carries)
        };
        let levels = 0..codes.len();
        levels.clone().rev().find(is_whole).or_else(|| levels.rev().find(of_level))
    }
}

/// The splats of every code.
fn grouped(codes: &[Option<usize>]) -> BTreeMap<usize, Vec<usize>> {
    let mut groups: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
    for (i, code) in codes.iter().enumerate() {
        if let Some(code) = code {
            groups.entry(*code).or_default().push(i);
        }
    }
    groups
}

/// The surface of a code.
struct Surface {
    /// Unit normal towards the cameras.
    normal: Vec3,
    offset: f32,
    thickness: f32,
    /// Root mean square radius of the splats on it.
    radius: f32,
}

impl Surface {
    /// The plane with most of a code's splats, if they are enough.
    fn of(means: &[[f32; 3]], list: &[usize], cameras: &[Vec3]) -> Option<Surface> {
        let step = list.len().div_ceil(SAMPLES);
        let points: Vec<Vec3> = list.iter().step_by(step).map(|i| Vec3::from(means[*i])).collect();
        let thickness = THICKNESS * radius(&points);
        let (plane, on) = Plane::most_common(&points, thickness, TRIALS, &mut Random::new(0));
        let Plane { mut normal, mut offset } = plane;
        if (on as f64) < FLAT * points.len() as f64 {
            return None;
        }
        let behind = cameras.iter().filter(|c| c.dot(normal) < offset).count();
        if 2 * behind > cameras.len() {
            (normal, offset) = (-normal, -offset);
        }
        let inside: Vec<Vec3> =
            points.into_iter().filter(|p| (p.dot(normal) - offset).abs() < thickness).collect();
        Some(Surface { normal, offset, thickness, radius: radius(&inside) })
    }

    /// Codes of a finer level whose splats are mostly among `list` and in front of the plane.
    fn carried(
        &self,
        means: &[[f32; 3]],
        list: &[usize],
        (finer, sizes): (&[Option<usize>], &[usize]),
    ) -> Vec<usize> {
        let mut within: BTreeMap<usize, Vec<Vec3>> = BTreeMap::new();
        for &i in list {
            if let Some(code) = finer.get(i).copied().flatten() {
                within.entry(code).or_default().push(Vec3::from(means[i]));
            }
        }
        let stands = |(code, points): (usize, Vec<Vec3>)| {
            let front =
                points.iter().filter(|p| p.dot(self.normal) - self.offset > self.thickness).count() as f64;
            let own = 2 * points.len() > sizes[code] && points.len() >= LEAST_THING;
            let small = radius(&points) < SMALL * self.radius;
            (own && small && front >= IN_FRONT * points.len() as f64).then_some(code)
        };
        within.into_iter().filter_map(stands).collect()
    }
}

/// Root mean square distance of points from their mean.
fn radius(points: &[Vec3]) -> f32 {
    let n = points.len().max(1) as f32;
    let mean = points.iter().sum::<Vec3>() / n;
    (points.iter().map(|p| (*p - mean).length_squared()).sum::<f32>() / n).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{Codebook, LevelField, Pose};

    /// A table of 40 × 40 splats with a cube of 6 × 6 × 6 on it, and a box of three faces.
    /// Fine codes: 0 table, 1 cube, 2 to 4 faces of the box. The middle
    /// level has no codes. Coarse codes: 0 table and cube, 1 box.
    fn scene() -> (Splats, LanguageField) {
        let (mut means, mut fine): (Vec<[f32; 3]>, Vec<usize>) = Default::default();
        let mut add = |code: usize, point: [f32; 3]| {
            means.push(point.map(|v| 0.1 * v));
            fine.push(code);
        };
        for (x, y) in (0..40).flat_map(|x| (0..40).map(move |y| (x as f32, y as f32))) {
            add(0, [x, y, 0.0]);
        }
        for k in 0..216 {
            add(1, [10 + k % 6, 20 + k / 6 % 6, 1 + k / 36].map(|v| v as f32));
        }
        // A high front towards the camera, which is most of the box; top and side lie behind it.
        for (a, b) in (0..20).flat_map(|a| (0..20).map(move |b| (a as f32, b as f32))) {
            add(2, [60.0 + a, b, 10.0]);
        }
        for (a, b) in (0..20).flat_map(|a| (0..8).map(move |b| (a as f32, b as f32))) {
            add(3, [60.0 + a, 20.0, 9.0 - b]);
            add(4, [80.0, a, 9.0 - b]);
        }
        let coarse = fine.iter().map(|c| usize::from(*c >= 2)).collect();
        let level = |codes: Vec<usize>, count: usize| {
            let unit = |k: usize| (0..count).map(move |c| f32::from(u8::from(c == k)));
            let rows: Vec<f32> = (0..count).flat_map(unit).collect();
            let codebook = Codebook {
                embedding_dim: count,
                code_dim: count,
                embeddings: rows.clone(),
                codes: rows,
                ..Codebook::default()
            };
            LevelField {
                codebook,
                features: codes.into_iter().flat_map(unit).collect(),
                ..LevelField::default()
            }
        };
        let levels = vec![level(fine, 5), LevelField::default(), level(coarse, 2)];
        (Splats { means, ..Splats::default() }, LanguageField { levels, space: "t".into() })
    }

    #[test]
    fn click_selects_cube_without_its_table_and_box_with_its_faces() {
        let (splats, field) = scene();
        let mut camera = crate::scene::seeded::small(1, 8, 8, 0, 0).1;
        camera.pose = Pose { translation: glam::DVec3::new(-2.0, -2.0, 10.0), ..Pose::IDENTITY };
        camera.pose.rotation = glam::DMat3::from_diagonal(glam::DVec3::new(1.0, -1.0, -1.0));
        assert!(camera.pose.centre().z > 1.0, "above the table");
        let standing = Standing::of(&splats, &field, std::slice::from_ref(&camera));
        assert_eq!(standing.pairs()[2], [[0, 0, 1]]);
        let mut standing = standing;
        let level = |standing: &Standing, fine, coarse| standing.level_of(&[fine, None, coarse]);
        // A quarter of the splats or more on every level: the coarsest.
        assert_eq!(level(&standing, Some(0), Some(0)), Some(2));
        standing.splats *= 10;
        assert_eq!(level(&standing, Some(1), Some(0)), Some(0));
        assert_eq!(level(&standing, Some(0), Some(0)), Some(2));
        // A face of the box is the box; a speck with a sixth of it is a thing.
        assert_eq!(level(&standing, Some(4), Some(1)), Some(2));
        standing.sizes[0][4] = 100;
        assert_eq!(level(&standing, Some(4), Some(1)), Some(0));
        assert_eq!(level(&standing, None, Some(1)), Some(2));
        assert_eq!(level(&standing, None, None), None);
    }
}
