//! Instances in space: connected groups of the selected splats
//! (docs/internals/method.md#instances).
use crate::scene::code_mix::MIN_LENGTH;
use crate::scene::{Camera, Image, LanguageField, LevelField, Splats};
use ahash::{HashMap, HashMapExt}; // quicker than the standard library's: a query looks up cells some million times
use glam::{DMat3, DQuat, DVec2, DVec3, IVec3};
use rayon::prelude::*;

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
    /// Per level [N] code of every splat.
    codes: Vec<Vec<Option<usize>>>,
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
            codes: field.levels.iter().map(splat_codes).collect(),
        }
    }

    /// Per level the code of every splat.
    pub fn codes(&self) -> &[Vec<Option<usize>>] {
        &self.codes
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
        let cell_of = |p: DVec3| (p / cell).floor().as_ivec3();
        let mut cells: HashMap<IVec3, usize> = HashMap::new();
        for &i in chosen {
            for point in covered(self.centres[i], self.spans[i], cell) {
                let next = cells.len();
                cells.entry(cell_of(point)).or_insert(next);
            }
        }
        let mut union = Union::new(cells.len());
        for (cell, &a) in &cells {
            // Half of the 26 neighbours: the other half visits the same pairs.
            for step in 14..27 {
                let near = *cell + IVec3::new(step % 3, step / 3 % 3, step / 9) - IVec3::ONE;
                if let Some(&b) = cells.get(&near) {
                    union.join(a, b);
                }
            }
        }
        let mut groups: HashMap<usize, Vec<usize>> = HashMap::new();
        for &i in chosen {
            if let Some(&index) = cells.get(&cell_of(self.centres[i])) {
                groups.entry(union.root(index)).or_default().push(i);
            }
        }
        groups.into_values().collect()
    }

    fn instance(&self, splats: Vec<usize>, share: f64, level: usize) -> Instance {
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
        let mut sorted: Vec<(f64, f64)> =
            splats.iter().map(|&i| (axis.dot(self.centres[i]), self.weights[i])).collect();
        sorted.sort_by(|a, b| a.0.total_cmp(&b.0));
        let outside = OUTSIDE * sorted.iter().map(|a| a.1).sum::<f64>();
        [first_inside(sorted.iter(), outside), first_inside(sorted.iter().rev(), outside)]
    }

    /// Weighted mean of the photos' agreement on splats; `None` if unknown.
    pub fn reliability(&self, splats: &[usize], level: usize) -> Option<f64> {
        let known = self.reliability.get(level)?;
        let weighted = |&i: &usize| Some((self.weights[i], f64::from(*known.get(i)?)));
        let sums = splats.iter().filter_map(weighted).fold((0.0, 0.0), |s, (w, r)| (s.0 + w, s.1 + w * r));
        (sums.0 > 0.0).then(|| sums.1 / sums.0)
    }

    /// Splats of `splats` that are visible in a view.
    pub fn seen_of(&self, splats: &[usize], camera: &Camera, depth: &Image<f32>) -> Vec<usize> {
        splats.iter().copied().filter(|i| self.visible_pixel(*i, camera, depth).is_some()).collect()
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
    pub fn pixel(&self, instance: &Instance, camera: &Camera, depth: &Image<f32>) -> Option<[f64; 2]> {
        let pixel = |&i: &usize| Some((self.visible_pixel(i, camera, depth)?, self.weights[i]));
        let seen: Vec<_> = instance.splats.iter().filter_map(pixel).collect();
        let total: f64 = seen.iter().map(|s| s.1).sum();
        let mean = seen.iter().map(|(p, w)| *p * *w).sum::<DVec2>() / total;
        let nearest = seen
            .iter()
            .map(|s| s.0)
            .min_by(|a, b| a.distance_squared(mean).total_cmp(&b.distance_squared(mean)));
        nearest.map(|p| [p.x, p.y])
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

/// First position of (position, weight) pairs at which the summed weight exceeds `outside`.
fn first_inside<'a>(mut sorted: impl Iterator<Item = &'a (f64, f64)>, outside: f64) -> f64 {
    let mut passed = 0.0;
    let found = sorted.find(|(_, weight)| {
        passed += weight;
        passed > outside
    });
    found.map_or(0.0, |f| f.0)
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

/// Disjoint sets.
struct Union(Vec<usize>);

impl Union {
    fn new(count: usize) -> Union {
        Union((0..count).collect())
    }
    fn root(&mut self, mut i: usize) -> usize {
        while self.0[i] != i {
            self.0[i] = self.0[self.0[i]];
            i = self.0[i];
        }
        i
    }
    fn join(&mut self, a: usize, b: usize) {
        let (a, b) = (self.root(a), self.root(b));
        self.0[a.max(b)] = a.min(b);
    }
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
}
