//! Occupied and free space of splats, on a grid, and rays through it.
use crate::math::sigmoid;
use crate::scene::Splats;
use glam::{DMat3, DQuat, DVec3, IVec3, Vec3};
use rayon::prelude::*;

/// Cells along the longest side of the box of the splats.
const CELLS: f64 = 64.0;
/// Share of the mass that lies outside of the box on each side of each axis: floaters.
const OUTSIDE: f64 = 0.01;
/// Optical depth from which a cell is occupied: half of the light passes at 0.7.
const OPAQUE: f32 = 0.5;
/// Samples along each of the two longer axes of a splat, at most; larger splats leave gaps.
const MOST_SAMPLES: usize = 7;
/// Sample of the splats from which the box follows.
const BOX_SAMPLE: usize = 200_000;

/// Optical depth of the splats per cell.
pub(super) struct Space {
    origin: DVec3,
    /// Side of a cell, world units.
    cell: f64,
    size: IVec3,
    depth: Vec<f32>,
    /// Sum over the splats of a cell of ln σ, weighted like `depth`.
    log_sigma: Vec<f32>,
}

/// First occupied cell on a ray.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Hit {
    /// Index of the cell.
    pub(super) cell: u32,
    /// Distance, world units.
    pub(super) distance: f64,
}

impl Space {
    /// The grid of some splats; `None` without any.
    pub(super) fn new(splats: &Splats) -> Option<Space> {
        let (low, high) = mass_box(splats)?;
        let side = (high - low).max_element();
        if side <= 0.0 || !side.is_finite() {
            return None;
        }
        let cell = side / CELLS;
        // A margin of free cells, in which rays start.
        let (origin, extent) = (low - DVec3::splat(cell), high - low + DVec3::splat(2.0 * cell));
        let size = (extent / cell).ceil().as_ivec3().max(IVec3::ONE);
        let cells = (size.x * size.y * size.z) as usize;
        let mut space = Space { origin, cell, size, depth: vec![0.0; cells], log_sigma: vec![0.0; cells] };
        (0..splats.len()).for_each(|i| space.add(splats, i));
        Some(space)
    }

    /// Corners of the grid.
    pub(super) fn bounds(&self) -> (DVec3, DVec3) {
        (self.origin, self.origin + self.size.as_dvec3() * self.cell)
    }

    /// Longest side, world units.
    pub(super) fn side(&self) -> f64 {
        self.size.max_element() as f64 * self.cell
    }

    /// Adds the opacity times the area of a splat to the cells of its ellipse.
    fn add(&mut self, splats: &Splats, i: usize) {
        let scales = Vec3::from(splats.log_scales[i]).exp().as_dvec3();
        let [w, x, y, z] = splats.quats[i].map(f64::from);
        let axes = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize()).to_cols_array_2d();
        let mut order = [0, 1, 2];
        order.sort_by(|a, b| scales[*b].total_cmp(&scales[*a]));
        let [u, v] = [order[0], order[1]].map(|k| DVec3::from(axes[k]) * scales[k]);
        let opacity = f64::from(sigmoid(splats.opacity_logits[i]));
        // Area of the ellipse that would block as much light with full opacity: 2π σ_u σ_v.
        let area = std::f64::consts::TAU * u.length() * v.length() * opacity / (self.cell * self.cell);
        let [nu, nv] =
            [u, v].map(|a| (((3.0 * a.length() / self.cell).ceil() as usize).max(1) | 1).min(MOST_SAMPLES));
        let share = (area / (nu * nv) as f64) as f32;
        let log_sigma = (0.5 * (u.length() * v.length()).ln()) as f32;
        let centre = Vec3::from(splats.means[i]).as_dvec3();
        let step = |k: usize, n: usize| if n == 1 { 0.0 } else { 3.0 * (k as f64 / (n - 1) as f64 - 0.5) };
        for a in 0..nu {
            for b in 0..nv {
                if let Some(cell) = self.cell_at(centre + u * step(a, nu) + v * step(b, nv)) {
                    self.depth[cell] += share;
                    self.log_sigma[cell] += share * log_sigma;
                }
            }
        }
    }

    fn cell_at(&self, point: DVec3) -> Option<usize> {
        let at = ((point - self.origin) / self.cell).floor();
        let inside = at.cmpge(DVec3::ZERO).all() && at.cmplt(self.size.as_dvec3()).all();
        inside.then(|| {
            let at = at.as_ivec3();
            ((at.z * self.size.y + at.y) * self.size.x + at.x) as usize
        })
    }

    /// Standard deviation of the splats of an occupied cell in the picture of a hit, in units of the
    /// focal length.
    pub(super) fn sigma(&self, hit: &Hit) -> f64 {
        let cell = hit.cell as usize;
        f64::from(self.log_sigma[cell] / self.depth[cell]).exp() / hit.distance.max(f64::MIN_POSITIVE)
    }

    /// Whether no cell within `radius` of a point is occupied.
    pub(super) fn is_free(&self, point: DVec3, radius: f64) -> bool {
        let steps = (radius / self.cell).ceil() as i32;
        let around = -steps..=steps;
        around.clone().all(|z| {
            around.clone().all(|y| {
                around.clone().all(|x| {
                    let offset = IVec3::new(x, y, z).as_dvec3() * self.cell;
                    let is_near = offset.length() <= radius;
                    !is_near || self.cell_at(point + offset).is_none_or(|c| self.depth[c] < OPAQUE)
                })
            })
        })
    }

    /// First occupied cell from `from` along a unit vector.
    pub(super) fn cast(&self, from: DVec3, along: DVec3) -> Option<Hit> {
        let (low, high) = self.bounds();
        let inverse = along.recip();
        let (a, b) = ((low - from) * inverse, (high - from) * inverse);
        let (enter, leave) = (a.min(b).max_element().max(0.0), a.max(b).min_element());
        let mut distance = enter + 0.5 * self.cell;
        while distance < leave {
            if let Some(cell) = self.cell_at(from + along * distance).filter(|c| self.depth[*c] >= OPAQUE) {
                return Some(Hit { cell: cell as u32, distance });
            }
            distance += 0.7 * self.cell;
        }
        None
    }
}

/// Box of the splats, weighted by opacity and area, without the outermost shares.
fn mass_box(splats: &Splats) -> Option<(DVec3, DVec3)> {
    let stride = splats.len().div_ceil(BOX_SAMPLE).max(1);
    let weighted: Vec<(DVec3, f64)> = (0..splats.len())
        .into_par_iter()
        .step_by(stride)
        .map(|i| {
            let mut scales = splats.log_scales[i].map(|s| f64::from(s).exp());
            scales.sort_by(f64::total_cmp);
            let opacity = f64::from(sigmoid(splats.opacity_logits[i]));
            (Vec3::from(splats.means[i]).as_dvec3(), opacity * scales[1] * scales[2])
        })
        .collect();
    // The area of a few huge splats of a background would outweigh a scene.
    let mut areas: Vec<f64> = weighted.iter().map(|w| w.1).collect();
    areas.sort_by(f64::total_cmp);
    let middle = *areas.get(areas.len() / 2)?;
    let most = 10.0 * middle;
    let (mut low, mut high) = (DVec3::ZERO, DVec3::ZERO);
    for axis in 0..3 {
        let mut values: Vec<(f64, f64)> = weighted.iter().map(|(p, w)| (p[axis], w.min(most))).collect();
        values.sort_by(|a, b| a.0.total_cmp(&b.0));
        let total: f64 = values.iter().map(|v| v.1).sum();
        let at = |share: f64| {
            let mut sum = 0.0;
            let found = values.iter().find(|v| {
                sum += v.1;
                sum >= share * total
            });
            found.or(values.last()).map_or(0.0, |v| v.0)
        };
        (low[axis], high[axis]) = (at(OUTSIDE), at(1.0 - OUTSIDE));
    }
    // Centres have no extent where there are few; ellipses have.
    let edge = DVec3::splat(2.0 * areas.iter().fold(0.0f64, |m, a| m.max(a.min(most))).sqrt());
    Some((low - edge, high + edge))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Opaque round splats of standard deviation 0.02 on the plane z = 1, from −1 to 1.
    fn wall() -> Splats {
        let mut splats = Splats::default();
        for x in -20..=20 {
            for y in -20..=20 {
                splats.means.push([x as f32 * 0.05, y as f32 * 0.05, 1.0]);
                splats.log_scales.push([0.02f32.ln(), 0.02f32.ln(), 0.001f32.ln()]);
                splats.quats.push([1.0, 0.0, 0.0, 0.0]);
                splats.opacity_logits.push(5.0);
                splats.sh.extend([0.5; 3]);
            }
        }
        splats
    }

    #[test]
    fn rays_end_at_opaque_cells() {
        let mut splats = wall();
        // A floater far away does not stretch the grid, and a transparent splat stops no ray.
        splats.means.extend([[0.0, 0.0, 90.0], [0.0, 0.0, 0.5]]);
        splats.log_scales.extend([[-4.0; 3]; 2]);
        splats.quats.extend([[1.0, 0.0, 0.0, 0.0]; 2]);
        splats.opacity_logits.extend([5.0, -9.0]);
        let space = Space::new(&splats).unwrap();
        assert!(space.cell < 0.04, "{}", space.cell);
        let hit = space.cast(DVec3::new(0.3, 0.2, -2.0), DVec3::Z).unwrap();
        assert!((hit.distance - 3.0).abs() < 0.05, "{hit:?}");
        assert_eq!(space.cast(DVec3::new(0.0, 0.0, -2.0), -DVec3::Z), None);
        assert_eq!(space.cast(DVec3::new(3.0, 0.0, -2.0), DVec3::Z), None, "beside the wall");
        assert!(space.is_free(DVec3::new(0.0, 0.0, 0.5), 0.2));
        assert!(!space.is_free(DVec3::new(0.0, 0.0, 0.9), 0.2));
    }

    #[test]
    fn one_splat_has_space_around_it() {
        let one = wall().picked(&[0]);
        let space = Space::new(&one).unwrap();
        let from = Vec3::from(one.means[0]).as_dvec3() - DVec3::Z;
        let hit = space.cast(from, DVec3::Z).unwrap();
        assert!((hit.distance - 1.0).abs() < 0.05, "{hit:?}");
        assert!(Space::new(&Splats::default()).is_none());
    }
}
