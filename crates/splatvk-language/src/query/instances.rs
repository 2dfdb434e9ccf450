//! Instances in space: connected groups of the selected splats
//! (docs/internals/method.md#instances).
use super::cells;
use crate::scene::code_mix::MIN_LENGTH;
use crate::scene::{Camera, Image, LanguageField, LevelField, Splats};
use glam::{DMat3, DQuat, DVec2, DVec3};
use rayon::prelude::*;
use std::cmp::Ordering;

/// Side of a cell, in median radii of the selected splats: touching cells belong to one instance.
/// On the data of [`LEAST_SHARE`], 3 to 8 give the same instances; with 2 more fragments are
/// separate.
const CELL: f64 = 4.0;

/// Smallest weight of an instance, as a share of the heaviest group. In generated scenes of seeds 1
/// to 3 (tuning; opacities summed, cells of 4 radii) 56 things have 0.24 and more; of the other
/// groups, two pieces of wall have 0.24, the rest 0.08 and less.
const LEAST_SHARE: f64 = 0.15;

/// Share of a group's weight outside its box on each side of an axis: a few splats always float.
const OUTSIDE: f64 = 0.02;

/// Relative difference to the rendered depth up to which a splat is visible: twice the accuracy of
/// depth (`run::metric` of splatvk).
const DEPTH_SHARE: f64 = 0.03;

/// Code of every splat, `argmax_k f·c_k`; `None` for splats without a feature.
pub fn splat_codes(level: &LevelField) -> Vec<Option<usize>> {
    let d = level.codebook.code_dim.max(1);
    let decode = |f: &[f32]| {
        let length = f.iter().map(|v| v * v).sum::<f32>().sqrt();
        if length < MIN_LENGTH { None } else { level.codebook.decode(f) }
    };
    level.features.par_chunks_exact(d).map(decode).collect()
}

/// Data of a scene's splats for selection in space.
#[derive(Clone, Debug, Default)]
pub struct Places {
    /// [N] world units.
    centres: Vec<DVec3>,
    /// [N] the two longest half axes (one standard deviation), world units.
    spans: Vec<[DVec3; 2]>,
    /// [N] opacities. Weighted by area, the few coarse splats of surfaces that no photo shows would
    /// outweigh the many fine ones of a thing.
    weights: Vec<f64>,
    /// Per level [N] agreement of the photos on every splat, in 0..1; empty if unknown.
    reliability: Vec<Vec<f32>>,
    /// Per level the splats of every code.
    lists: Vec<CodeLists>,
}

/// The splats of every code of a level.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct CodeLists {
    /// [K + 1] first entry of each code.
    starts: Vec<usize>,
    /// Splats by code, ascending within a code.
    splats: Vec<u32>,
}

impl CodeLists {
    fn new(codes: &[Option<usize>]) -> CodeLists {
        let count = codes.iter().flatten().max().map_or(0, |k| k + 1);
        let mut starts = vec![0; count + 1];
        codes.iter().flatten().for_each(|&k| starts[k + 1] += 1);
        for k in 0..count {
            starts[k + 1] += starts[k];
        }
        let (mut next, mut splats) = (starts.clone(), vec![0; starts[count]]);
        for (i, &k) in codes.iter().enumerate().filter_map(|(i, k)| Some((i, k.as_ref()?))) {
            splats[next[k]] = i as u32;
            next[k] += 1;
        }
        CodeLists { starts, splats }
    }

    /// Number of splats of each code.
    pub fn counts(&self) -> impl Iterator<Item = usize> + '_ {
        self.starts.windows(2).map(|s| s[1] - s[0])
    }

    /// Splats of some codes, ascending.
    pub fn splats_of(&self, codes: impl Iterator<Item = usize>) -> Vec<usize> {
        let list = |k: usize| self.splats.get(*self.starts.get(k)?..*self.starts.get(k + 1)?);
        let mut all: Vec<usize> = codes.filter_map(list).flatten().map(|&i| i as usize).collect();
        // A stable sort merges the ascending lists.
        all.sort();
        all
    }
}

/// A box along the principal axes of a thing, largest variance first.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct OrientedBox {
    /// Its centre, world units.
    pub centre: DVec3,
    /// Unit vectors along its edges.
    pub axes: [DVec3; 3],
    /// Lengths of its edges, world units.
    pub size: DVec3,
}

/// One of the things that answer a query.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Instance {
    /// Its splats, ascending.
    pub splats: Vec<usize>,
    /// Its share of the weight of all selected splats.
    pub share: f64,
    /// Agreement of the photos on the thing, 0 to 1 (docs/internals/method.md#reliability); `None`
    /// if unknown.
    pub reliability: Option<f64>,
    /// Centre of the oriented box, world units.
    pub centre: DVec3,
    /// Lowest and highest corner of the box along the scene's axes.
    pub bounds: [DVec3; 2],
    /// The box along its own axes.
    pub oriented: OrientedBox,
    /// Per view the pixel that shows its centre, the first pixel's centre at (0.5, 0.5); `None`
    /// where it is not visible.
    pub pixels: Vec<Option<[f64; 2]>>,
}

impl Places {
    /// Collects the data of a scene.
    pub fn of(splats: &Splats, field: &LanguageField) -> Places {
        let spans = (0..splats.len()).into_par_iter().map(|i| longest_half_axes(splats, i)).collect();
        let opacity = |logit: &f32| 1.0 / (1.0 + f64::from(-logit).exp());
        Places {
            centres: splats.means.iter().map(|m| DVec3::from_array(m.map(f64::from))).collect(),
            weights: splats.opacity_logits.iter().map(opacity).collect(),
            reliability: field.levels.iter().map(|l| l.reliability.clone()).collect(),
            spans,
            lists: field.levels.iter().map(|level| CodeLists::new(&splat_codes(level))).collect(),
        }
    }

    /// [N] centres, world units.
    pub fn centres(&self) -> &[DVec3] {
        &self.centres
    }

    /// [N] opacities.
    pub fn weights(&self) -> &[f64] {
        &self.weights
    }

    /// Per level the splats of every code.
    pub fn lists(&self) -> &[CodeLists] {
        &self.lists
    }

    /// Connected groups of the splats `chosen` on a level, heaviest first.
    pub fn instances(&self, chosen: &[usize], level: usize) -> Vec<Instance> {
        let all: f64 = chosen.iter().map(|&i| self.weights[i]).sum();
        let mut groups: Vec<(f64, Vec<usize>)> = self
            .groups(chosen)
            .into_iter()
            .map(|group| (group.iter().map(|&i| self.weights[i]).sum::<f64>(), group))
            .collect();
        groups.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        let least = groups.first().map_or(0.0, |g| LEAST_SHARE * g.0);
        let solid: Vec<_> = groups.into_iter().take_while(|g| g.0 >= least && g.0 > 0.0).collect();
        solid.into_par_iter().map(|(own, splats)| self.instance(splats, own / all, level)).collect()
    }

    /// Groups of splats whose cells are connected through touching cells.
    fn groups(&self, chosen: &[usize]) -> Vec<Vec<usize>> {
        let mut radii: Vec<f64> =
            chosen.iter().map(|&i| (self.spans[i][0].length() * self.spans[i][1].length()).sqrt()).collect();
        let Some(cell) = crate::math::median(&mut radii).map(|r| CELL * r).filter(|c| *c > 0.0) else {
            return Vec::new();
        };
        let points = |i: usize| covered(self.centres[i], self.spans[i], cell);
        cells::groups(chosen, cell, points, |i| self.centres[i])
    }

    /// An instance of splats, which ascend.
    pub(super) fn instance(&self, splats: Vec<usize>, share: f64, level: usize) -> Instance {
        let total: f64 = splats.iter().map(|&i| self.weights[i]).sum();
        let mean = splats.iter().map(|&i| self.weights[i] * self.centres[i]).sum::<DVec3>() / total;
        let mut covariance = nalgebra::Matrix3::<f64>::zeros();
        for &i in &splats {
            let d = self.centres[i] - mean;
            let d = nalgebra::Vector3::new(d.x, d.y, d.z);
            covariance += self.weights[i] / total * d * d.transpose();
        }
        let eigen = nalgebra::SymmetricEigen::new(covariance);
        let mut order = [0, 1, 2];
        order.sort_by(|&a, &b| eigen.eigenvalues[b].total_cmp(&eigen.eigenvalues[a]));
        let axes = order.map(|k| {
            let v = eigen.eigenvectors.column(k);
            DVec3::new(v[0], v[1], v[2])
        });
        let directions = [axes[0], axes[1], axes[2], DVec3::X, DVec3::Y, DVec3::Z];
        let extents: Vec<[f64; 2]> = directions.par_iter().map(|axis| self.extent(&splats, *axis)).collect();
        let (along, straight) = extents.split_at(3);
        let centre = (0..3).map(|k| axes[k] * 0.5 * (along[k][0] + along[k][1])).sum();
        let size = DVec3::from_array([0, 1, 2].map(|k| along[k][1] - along[k][0]));
        let corner = |side: usize| DVec3::from_array([0, 1, 2].map(|k| straight[k][side]));
        let oriented = OrientedBox { centre, axes, size };
        let reliability = self.reliability(&splats, level);
        Instance {
            splats,
            share,
            reliability,
            centre,
            bounds: [corner(0), corner(1)],
            oriented,
            pixels: Vec::new(),
        }
    }

    /// Range of the splats along an axis, without [`OUTSIDE`] of the weight on each side.
    fn extent(&self, splats: &[usize], axis: DVec3) -> [f64; 2] {
        let mut along: Vec<(f64, f64)> =
            splats.iter().map(|&i| (axis.dot(self.centres[i]), self.weights[i])).collect();
        let outside = OUTSIDE * along.iter().map(|a| a.1).sum::<f64>();
        let low = first_inside(&mut along, outside, f64::total_cmp);
        [low, first_inside(&mut along, outside, |a, b| b.total_cmp(a))]
    }

    /// Weighted mean of the photos' agreement on splats; `None` if unknown.
    pub fn reliability(&self, splats: &[usize], level: usize) -> Option<f64> {
        let known = self.reliability.get(level)?;
        let weighted = |&i: &usize| Some((self.weights[i], f64::from(*known.get(i)?)));
        let sums = splats.iter().filter_map(weighted).fold((0.0, 0.0), |s, (w, r)| (s.0 + w, s.1 + w * r));
        (sums.0 > 0.0).then(|| sums.1 / sums.0)
    }

    /// Splats of `splats` that are visible in a view, with the pixels of their centres.
    pub fn visible(&self, splats: &[usize], camera: &Camera, depth: &Image<f32>) -> Visible {
        let pixel = |&i: &usize| Some((i, self.visible_pixel(i, camera, depth)?));
        Visible(splats.par_iter().with_min_len(2048).filter_map(pixel).collect())
    }

    /// Pixel of a splat's centre in a view, if it is visible.
    fn visible_pixel(&self, splat: usize, camera: &Camera, depth: &Image<f32>) -> Option<DVec2> {
        let inside = |v: f64, size: u32| (0.0..f64::from(size)).contains(&v);
        let (pixel, z) = camera.project(self.centres[splat]);
        let shown = z > 0.0 && inside(pixel.x, camera.width) && inside(pixel.y, camera.height);
        let rendered = shown.then(|| f64::from(depth.at(pixel.x as usize, pixel.y as usize)))?;
        ((rendered - z).abs() <= DEPTH_SHARE * z).then_some(pixel)
    }

    /// Pixel of a view that shows a thing: of its visible splats, the one nearest to their mean.
    /// `visible` has the visible splats of the view.
    pub fn pixel(&self, instance: &Instance, visible: &Visible) -> Option<[f64; 2]> {
        let seen: Vec<(DVec2, f64)> =
            visible.of(&instance.splats).map(|(i, pixel)| (pixel, self.weights[i])).collect();
        let total: f64 = seen.iter().map(|s| s.1).sum();
        let mean = seen.iter().map(|(p, w)| *p * *w).sum::<DVec2>() / total;
        let nearest = seen
            .iter()
            .map(|s| s.0)
            .min_by(|a, b| a.distance_squared(mean).total_cmp(&b.distance_squared(mean)));
        nearest.map(|p| [p.x, p.y])
    }
}

/// Splats that a view shows, ascending, with the pixels of their centres.
#[derive(Clone, Debug, Default)]
pub struct Visible(Vec<(usize, DVec2)>);

impl Visible {
    /// The splats.
    pub fn splats(&self) -> Vec<usize> {
        self.0.iter().map(|s| s.0).collect()
    }

    /// Those of `splats`, which ascend.
    pub fn of<'a>(&'a self, splats: &'a [usize]) -> impl Iterator<Item = (usize, DVec2)> + 'a {
        let mut rest = splats;
        self.0.iter().copied().filter(move |(i, _)| {
            let skipped = rest.iter().take_while(|own| **own < *i).count();
            rest = &rest[skipped..];
            rest.first() == Some(i)
        })
    }
}

/// The two longest half axes of a splat, one standard deviation.
fn longest_half_axes(splats: &Splats, i: usize) -> [DVec3; 2] {
    let [w, x, y, z] = splats.quats[i].map(f64::from);
    let axes = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize());
    let mut half: Vec<DVec3> =
        (0..3).map(|k| axes.col(k) * f64::from(splats.log_scales[i][k]).exp()).collect();
    half.sort_by(|a, b| b.length_squared().total_cmp(&a.length_squared()));
    [half[0], half[1]]
}

/// First position in an order of (position, weight) pairs at which the summed weight exceeds
/// `outside`; 0 if none does. Reorders the pairs. Halves that cannot have it are not sorted.
fn first_inside(pairs: &mut [(f64, f64)], outside: f64, order: fn(&f64, &f64) -> Ordering) -> f64 {
    let (mut rest, mut passed) = (pairs, 0.0);
    while rest.len() > 1 {
        let middle = rest.len() / 2;
        rest.select_nth_unstable_by(middle, |a, b| order(&a.0, &b.0));
        let (before, behind) = rest.split_at_mut(middle);
        let weight: f64 = before.iter().map(|p| p.1).sum();
        if passed + weight > outside {
            rest = before;
        } else {
            passed += weight;
            rest = behind;
        }
    }
    rest.first().filter(|p| passed + p.1 > outside).map_or(0.0, |p| p.0)
}

/// Points of a splat at most a cell apart: large splats occupy several cells.
fn covered(centre: DVec3, [a, b]: [DVec3; 2], cell: f64) -> impl Iterator<Item = DVec3> {
    // Limit in cells: a wider splat is not part of a small thing.
    const MOST: f64 = 8.0;
    let steps = |half: DVec3| (half.length() / cell).ceil().min(MOST) as i32 - 1;
    let (u, v) = (steps(a).max(0), steps(b).max(0));
    let share = move |k: i32, n: i32| if n > 0 { f64::from(k) / f64::from(n) } else { 0.0 };
    (-u..=u).flat_map(move |i| (-v..=v).map(move |j| centre + a * share(i, u) + b * share(j, v)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn instances_drop_floating_specks() {
        // Two rows of splats, the second with half as many as the first, and a single splat.
        let row_from = |x: f32, count: usize| (0..count).map(move |i| [x + 0.01 * i as f32, 0.0, 1.0]);
        let means: Vec<[f32; 3]> =
            row_from(0.0, 20).chain(row_from(5.0, 10)).chain(row_from(9.0, 1)).collect();
        let count = means.len();
        let splats = Splats {
            means,
            log_scales: vec![[0.01f32.ln(); 3]; count],
            quats: vec![[1.0, 0.0, 0.0, 0.0]; count],
            opacity_logits: vec![2.0; count],
            ..Splats::default()
        };
        let places = Places::of(&splats, &LanguageField::default());
        let found = places.instances(&(0..count).collect::<Vec<_>>(), 0);
        assert_eq!(found.iter().map(|i| i.splats.len()).collect::<Vec<_>>(), [20, 10]);
    }

    #[test]
    fn first_inside_equals_that_of_sorted_pairs() {
        let mut random = crate::math::Random::new(4);
        for count in [1usize, 2, 7, 500] {
            // Whole weights have exact sums in any order; positions repeat.
            let pairs: Vec<(f64, f64)> =
                (0..count).map(|_| (random.below(40) as f64, random.below(9) as f64)).collect();
            let total: f64 = pairs.iter().map(|p| p.1).sum();
            for outside in [0.0, 0.02 * total, 0.5 * total, total] {
                let mut sorted = pairs.clone();
                sorted.sort_by(|a, b| a.0.total_cmp(&b.0));
                let mut passed = 0.0;
                let first = sorted.iter().find(|p| {
                    passed += p.1;
                    passed > outside
                });
                let got = first_inside(&mut pairs.clone(), outside, f64::total_cmp);
                assert_eq!(got, first.map_or(0.0, |p| p.0), "{count} {outside}");
            }
        }
    }

    #[test]
    fn lists_have_splats_of_codes_in_order() {
        let lists = CodeLists::new(&[Some(2), None, Some(0), Some(2), Some(4), Some(0)]);
        assert_eq!(lists.counts().collect::<Vec<_>>(), [2, 0, 2, 0, 1]);
        assert_eq!(lists.splats_of([0, 2, 3, 9].into_iter()), [0, 2, 3, 5]);
        assert!(CodeLists::default().splats_of([0].into_iter()).is_empty());
    }
}
