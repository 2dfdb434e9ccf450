//! Planes of an area by sequential RANSAC over cells of matched pixels.
use crate::math::hash;
use std::collections::BTreeMap;

/// Side of a cell, pixels: a textured corner must not outweigh the rest of the outline.
pub const CELL: usize = 4;
/// Three-cell hypotheses per plane: with one in eight cells on the plane, all 400 miss with
/// probability 0.46.
const TRIALS: u32 = 400;
/// Fewest inliers of a plane.
const MIN_INLIERS: usize = 12;
/// Least spread of the inliers across their longer direction, share of the area's extent: else the
/// tilt is undetermined.
const MIN_SPREAD: f32 = 0.2;
/// Weight of a cell from around the area: it may lie on another surface.
const OUTER_WEIGHT: f32 = 0.3;
/// Radius of an outlier's effect, pixels: a wrong match is no larger than a few windows.
const OUTLIER_RADIUS: f32 = 24.0;
/// Extent of a plane around the mean of its inliers, in their standard deviations: the corner of an
/// evenly filled square lies at 2.4, so a plane extends a seventh beyond it.
pub const REACH: f32 = 2.8;
/// Least share of an area's cells that are inliers of a plane.
const MIN_INLIER_SHARE: f32 = 0.08;
/// Most planes of an area: three of a room's corner and one more.
const MAX_PLANES: usize = 4;
/// Share of the inliers of each plane on the same side of the other where the two form a corner.
const CORNER_SHARE: f32 = 0.75;
/// Least share of inliers among the area's own cells in reach: the table is not the mug on it.
const OWN_INLIER_SHARE: f32 = 0.3;

/// Mean position and inverse depth of the middle half, by depth, of a square's matched pixels.
#[derive(Clone, Copy)]
pub struct Cell {
    /// Mean column; pixel centres are integers.
    pub x: f32,
    /// Mean row.
    pub y: f32,
    /// Inverse depth.
    pub inverse: f32,
    /// In the area itself; other cells lie around it, perhaps on another surface.
    pub inner: bool,
}

/// Inverse depth as an affine function of the pixel: `a + b x + c y`.
pub type Affine = [f32; 3];

pub fn evaluate(plane: Affine, x: f32, y: f32) -> f32 {
    plane[0] + plane[1] * x + plane[2] * y
}

/// Cells of the matched pixels (depth > 0) of `around`; `inner` is true inside the area.
pub fn cells(around: &[usize], depth: &[f32], inner: &dyn Fn(usize) -> bool, width: usize) -> Vec<Cell> {
    let mut grid: BTreeMap<(usize, usize), Vec<usize>> = BTreeMap::new();
    for &k in around.iter().filter(|&&k| depth[k] > 0.0) {
        grid.entry((k / width / CELL, k % width / CELL)).or_default().push(k);
    }
    let grid = grid.into_values().filter(|all| all.len() >= CELL);
    grid.map(|all| mean_cell(all, depth, inner, width)).collect()
}

fn mean_cell(mut all: Vec<usize>, depth: &[f32], inner: &dyn Fn(usize) -> bool, width: usize) -> Cell {
    all.sort_by(|a, b| depth[*a].total_cmp(&depth[*b]));
    // The middle half: a cell on a depth edge takes the side that has more pixels.
    let (from, until) = (all.len() / 4, (3 * all.len()).div_ceil(4));
    let n = (until - from) as f32;
    let mean = |f: &dyn Fn(usize) -> f32| all[from..until].iter().map(|&k| f(k)).sum::<f32>() / n;
    Cell {
        x: mean(&|k| (k % width) as f32),
        y: mean(&|k| (k / width) as f32),
        inverse: mean(&|k| 1.0 / depth[k]),
        inner: 2 * all.iter().filter(|&&k| inner(k)).count() > all.len(),
    }
}

/// Larger side of an area's bounding box, pixels.
pub fn extent(area: &[usize], width: usize) -> f32 {
    let range = |f: &dyn Fn(usize) -> usize| {
        let values = || area.iter().map(|&k| f(k));
        values().max().unwrap_or(0) - values().min().unwrap_or(0)
    };
    range(&|k| k % width).max(range(&|k| k / width)) as f32
}

/// Cells of an area.
pub struct CellSet {
    /// Cells in the area and around it.
    pub cells: Vec<Cell>,
    /// Largest distance of an inlier from its plane, share of inverse depth.
    pub tolerance: f32,
    /// Larger side of the area, pixels.
    pub extent: f32,
}

/// A plane with its inliers.
pub struct PlaneFit {
    /// The plane.
    pub plane: Affine,
    /// Inliers of the plane.
    pub inliers: Vec<Cell>,
    spread: Spread,
}

/// Mean and covariance of the positions of cells.
#[derive(Clone, Copy)]
pub struct Spread {
    mean: [f32; 2],
    /// xx, xy, yy.
    covariance: [f32; 3],
}

impl Spread {
    fn of(cells: &[Cell]) -> Spread {
        let n = cells.len() as f32;
        let mean = [cells.iter().map(|c| c.x).sum::<f32>() / n, cells.iter().map(|c| c.y).sum::<f32>() / n];
        let mut covariance = [0.0; 3];
        for c in cells {
            let (x, y) = (c.x - mean[0], c.y - mean[1]);
            covariance.iter_mut().zip([x * x, x * y, y * y]).for_each(|(s, v)| *s += v / n);
        }
        Spread { mean, covariance }
    }

    /// Standard deviation across the longer direction.
    fn across(&self) -> f32 {
        let [xx, xy, yy] = self.covariance;
        let smaller = 0.5 * (xx + yy) - (0.25 * (xx - yy) * (xx - yy) + xy * xy).sqrt();
        smaller.max(0.0).sqrt()
    }

    /// Mahalanobis distance from the mean.
    pub fn distance(&self, x: f32, y: f32) -> f32 {
        let [xx, xy, yy] = self.covariance;
        let (x, y) = (x - self.mean[0], y - self.mean[1]);
        ((yy * x * x - 2.0 * xy * x * y + xx * y * y) / (xx * yy - xy * xy)).sqrt()
    }
}

impl CellSet {
    fn is_inlier(&self, plane: Affine, c: &Cell) -> bool {
        (evaluate(plane, c.x, c.y) - c.inverse).abs() < self.tolerance * c.inverse
    }

    /// Planes by falling number of inliers, none of them `rejected`, and the area's cells that are
    /// inliers of none.
    pub fn planes(
        &self,
        seed: u32,
        rejected: &dyn Fn(Affine, &Spread) -> bool,
    ) -> (Vec<PlaneFit>, Vec<Cell>) {
        let mut left = self.cells.clone();
        let mut found: Vec<PlaneFit> = Vec::new();
        let mut state = seed;
        let min_inliers = MIN_INLIERS.max((MIN_INLIER_SHARE * self.cells.len() as f32) as usize);
        while left.len() >= min_inliers && found.len() < MAX_PLANES {
            let Some(best) = self.ransac(&left, min_inliers, &mut state, rejected) else { break };
            left.retain(|c| !self.is_inlier(best.plane, c));
            found.push(best);
        }
        left.retain(|c| c.inner);
        (found, left)
    }

    /// The plane with the most inliers.
    fn ransac(
        &self,
        cells: &[Cell],
        min_inliers: usize,
        state: &mut u32,
        rejected: &dyn Fn(Affine, &Spread) -> bool,
    ) -> Option<PlaneFit> {
        let candidate = |plane, more_than| self.candidate(cells, plane, more_than, rejected);
        let mut best: Option<PlaneFit> = None;
        for _ in 0..TRIALS {
            let mut draw = || {
                *state = hash(*state);
                cells[*state as usize % cells.len()]
            };
            let Some(plane) = plane_through([draw(), draw(), draw()]) else { continue };
            let least = best.as_ref().map_or(min_inliers - 1, |b| b.inliers.len());
            best = candidate(plane, least).or(best);
        }
        for _ in 0..3 {
            let refined = best.as_ref().and_then(|b| candidate(least_squares(&b.inliers)?, min_inliers - 1));
            best = refined.or(best);
        }
        best
    }

    /// The plane with its inliers among `cells`, if they are more than `more_than`, spread widely
    /// enough, and not rejected.
    fn candidate(
        &self,
        cells: &[Cell],
        plane: Affine,
        more_than: usize,
        rejected: &dyn Fn(Affine, &Spread) -> bool,
    ) -> Option<PlaneFit> {
        if cells.iter().filter(|c| self.is_inlier(plane, c)).count() <= more_than {
            return None;
        }
        let inliers: Vec<Cell> = cells.iter().filter(|c| self.is_inlier(plane, c)).copied().collect();
        let spread = Spread::of(&inliers);
        let own_in_reach = |cells: &[Cell]| {
            cells.iter().filter(|c| c.inner && spread.distance(c.x, c.y) < REACH).count() as f32
        };
        let least_own = || (OWN_INLIER_SHARE * own_in_reach(&self.cells)).max(MIN_INLIERS as f32);
        let few_own = self.cells.iter().filter(|c| c.inner).count() < MIN_INLIERS;
        // The standard deviation of an even spread is its length over √12.
        let sound = 12f32.sqrt() * spread.across() > MIN_SPREAD * self.extent
            && (few_own || own_in_reach(&inliers) >= least_own())
            && !rejected(plane, &spread);
        sound.then_some(PlaneFit { plane, inliers, spread })
    }
}

/// Plane of a pixel: of the planes that extend to it the one with the largest support, unless the
/// outliers have more. If either of the two best planes is nearer at its own inliers, they form a
/// concave corner and the nearer counts; if either is farther, a convex one.
pub fn plane_at(planes: &[PlaneFit], outliers: &[Cell], x: f32, y: f32) -> Option<Affine> {
    let mut within = planes.iter().filter(|e| e.spread.distance(x, y) < REACH);
    let nearest = within.next()?;
    let outlying = support(outliers, OUTLIER_RADIUS, x, y);
    let others: Vec<&PlaneFit> = within.collect();
    if others.is_empty() && outlying <= 0.0 {
        return Some(nearest.plane);
    }
    let mut reaching: Vec<(f32, &PlaneFit)> = std::iter::once(nearest)
        .chain(others)
        .map(|e| (support(&e.inliers, f32::INFINITY, x, y), e))
        .collect();
    reaching.sort_by(|a, b| b.0.total_cmp(&a.0));
    let (first_support, first) = *reaching.first()?;
    if outlying > first_support {
        return None;
    }
    let Some(&(_, second)) = reaching.get(1) else { return Some(first.plane) };
    let (a, b) = (nearer_share(first, second), nearer_share(second, first));
    let nearer = evaluate(first.plane, x, y) > evaluate(second.plane, x, y);
    let keep = if a.min(b) > CORNER_SHARE {
        nearer
    } else if a.max(b) < 1.0 - CORNER_SHARE {
        !nearer
    } else {
        true
    };
    Some(if keep { first.plane } else { second.plane })
}

/// Sum of weight over squared distance of the cells within `radius` of a pixel.
fn support(cells: &[Cell], radius: f32, x: f32, y: f32) -> f32 {
    let squared = |c: &Cell| (c.x - x).powi(2) + (c.y - y).powi(2) + 1.0;
    let weight = |c: &Cell| if c.inner { 1.0 } else { OUTER_WEIGHT };
    cells.iter().filter(|c| squared(c) < radius * radius).map(|c| weight(c) / squared(c)).sum()
}

/// Share of the inliers of `of` at which its plane is nearer than that of `other`.
fn nearer_share(of: &PlaneFit, other: &PlaneFit) -> f32 {
    let nearer = |c: &&Cell| evaluate(of.plane, c.x, c.y) > evaluate(other.plane, c.x, c.y);
    of.inliers.iter().filter(nearer).count() as f32 / of.inliers.len() as f32
}

fn plane_through(three: [Cell; 3]) -> Option<Affine> {
    let [p, q, r] = three;
    let (ux, uy, uv) = (q.x - p.x, q.y - p.y, q.inverse - p.inverse);
    let (vx, vy, vv) = (r.x - p.x, r.y - p.y, r.inverse - p.inverse);
    let det = ux * vy - uy * vx;
    // Nearly collinear cells do not determine a plane.
    if det.abs() < 4.0 * (CELL * CELL) as f32 {
        return None;
    }
    let (b, c) = ((uv * vy - uy * vv) / det, (ux * vv - uv * vx) / det);
    Some([p.inverse - b * p.x - c * p.y, b, c])
}

/// Least-squares plane in relative inverse depth.
fn least_squares(cells: &[Cell]) -> Option<Affine> {
    let mut m = nalgebra::Matrix3::<f64>::zeros();
    let mut rhs = nalgebra::Vector3::<f64>::zeros();
    for c in cells {
        let row = nalgebra::Vector3::new(1.0, f64::from(c.x), f64::from(c.y)) / f64::from(c.inverse);
        m += row * row.transpose();
        rhs += row;
    }
    m.cholesky().map(|m| m.solve(&rhs)).map(|s| [s[0] as f32, s[1] as f32, s[2] as f32])
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cell(x: f32, y: f32, inverse: f32) -> Cell {
        Cell { x, y, inverse, inner: true }
    }

    /// Two walls that meet at column 100, with two lines of cells each at the top and bottom.
    fn room() -> CellSet {
        let left = |x: f32| 1.0 - 0.004 * x;
        let right = |x: f32| 0.2 + 0.004 * x;
        let rows = [4.0, 8.0, 90.0, 94.0];
        let columns = (0..50).map(|c| 4.0 * c as f32);
        let cells = columns.flat_map(|x| rows.map(|y| cell(x, y, left(x).max(right(x))))).collect();
        CellSet { cells, tolerance: 0.015, extent: 200.0 }
    }

    #[test]
    fn plane_at_switches_at_wall_corner() {
        let (planes, outliers) = room().planes(1, &|_, _| false);
        assert_eq!(planes.len(), 2);
        assert!(outliers.len() < 10, "{}", outliers.len());
        for x in [10.0, 60.0, 95.0, 105.0, 140.0, 190.0] {
            let plane = plane_at(&planes, &outliers, x, 50.0).unwrap();
            let truth = (1.0 - 0.004 * x).max(0.2 + 0.004 * x);
            assert!(
                (evaluate(plane, x, 50.0) / truth - 1.0).abs() < 0.01,
                "column {x}: {}",
                evaluate(plane, x, 50.0)
            );
        }
    }

    #[test]
    fn planes_rejects_few_or_collinear_cells() {
        let (planes, outliers) = room().planes(1, &|_, _| true);
        assert!(planes.is_empty() && outliers.len() == 200);
        let line = |n: usize| (0..n).map(|k| cell(4.0 * k as f32, 20.0, 1.0)).collect();
        let set = |cells| CellSet { cells, tolerance: 0.015, extent: 200.0 };
        assert!(set(line(50)).planes(1, &|_, _| false).0.is_empty(), "a line leaves the tilt open");
        assert!(set(room().cells[..8].to_vec()).planes(1, &|_, _| false).0.is_empty(), "too few");
    }

    #[test]
    fn plane_at_ends_beyond_its_inliers() {
        let wall = room().cells.into_iter().filter(|c| c.x < 90.0).collect();
        let (planes, _) = CellSet { cells: wall, tolerance: 0.015, extent: 200.0 }.planes(1, &|_, _| false);
        assert!(
            plane_at(&planes, &[], 45.0, 50.0).is_some() && plane_at(&planes, &[], 190.0, 50.0).is_none()
        );
        let box_before = [cell(45.0, 50.0, 2.0)];
        assert!(plane_at(&planes, &box_before, 46.0, 50.0).is_none());
        assert!(plane_at(&planes, &box_before, 46.0, 80.0).is_some());
    }
}
