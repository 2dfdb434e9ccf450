//! Planes by vote: cells of matched pixels elect the planes of an area.
use crate::math::hash;
use std::collections::BTreeMap;

/// Side of the cells that vote, pixels: a textured corner shall not outvote the rest of the
/// outline.
pub const CELL: usize = 4;
/// Three-cell hypotheses per plane; one in eight cells on the plane makes 400 of them miss with
/// 0.46.
const TRIALS: u32 = 400;
/// Fewest voting cells of a plane.
const FEWEST: usize = 12;
/// Voting cells must spread over this share of the area's extent across their longer direction:
/// else the plane may tilt.
const SPREAD: f32 = 0.2;
/// Weight of a vote from around the area: it may be on something else.
const OUTER: f32 = 0.3;
/// Pixels around a cell without a plane in which it counts against one: a wrong match is no larger
/// than some windows.
const DISSENT: f32 = 24.0;
/// How far from the middle of its voters a plane reaches, in their standard deviations: the corner
/// of an evenly filled square lies at 2.4, so a seventh of its size beyond it.
pub const REACH: f32 = 2.8;
/// Fewest of an area's cells that elect a plane, share.
const QUORUM: f32 = 0.08;
/// Most planes of an area: those of a room's corner and one more.
const MOST_PLANES: usize = 4;
/// Share of the voters of either plane that lie on the same side of the other where the two form a
/// corner.
const CORNER: f32 = 0.75;
/// Share of the area's own votes within reach that must be for a plane: the table around a mug is
/// not the mug.
const OWN_SHARE: f32 = 0.3;

/// A vote: the mean inverse depth of a cell's matched pixels that lie closest together.
#[derive(Clone, Copy)]
pub struct Cell {
    /// Column of its middle, from pixel centres.
    pub x: f32,
    /// Row of its middle.
    pub y: f32,
    /// Inverse depth.
    pub inverse: f32,
    /// Of the area itself; the others lie around it, perhaps on something else.
    pub inner: bool,
}

/// Inverse depth as an affine function of the pixel: `a + b x + c y`.
pub type Affine = [f32; 3];

pub fn at(plane: Affine, x: f32, y: f32) -> f32 {
    plane[0] + plane[1] * x + plane[2] * y
}

/// The votes of the matched pixels (depth above 0) of and around an area; `inner` tells which are
/// its own.
pub fn cells(around: &[usize], depth: &[f32], inner: &dyn Fn(usize) -> bool, width: usize) -> Vec<Cell> {
    let mut grid: BTreeMap<(usize, usize), Vec<usize>> = BTreeMap::new();
    for &k in around.iter().filter(|&&k| depth[k] > 0.0) {
        grid.entry((k / width / CELL, k % width / CELL)).or_default().push(k);
    }
    let of = |mut all: Vec<usize>| {
        all.sort_by(|a, b| depth[*a].total_cmp(&depth[*b]));
        // The middle half: a cell on a depth edge votes for the side that it has more of.
        let (from, until) = (all.len() / 4, (3 * all.len()).div_ceil(4));
        let n = (until - from) as f32;
        let mean = |f: &dyn Fn(usize) -> f32| all[from..until].iter().map(|&k| f(k)).sum::<f32>() / n;
        Cell {
            x: mean(&|k| (k % width) as f32),
            y: mean(&|k| (k / width) as f32),
            inverse: mean(&|k| 1.0 / depth[k]),
            inner: 2 * all.iter().filter(|&&k| inner(k)).count() > all.len(),
        }
    };
    grid.into_values().filter(|all| all.len() >= CELL).map(of).collect()
}

/// Larger side of the smallest upright rectangle around an area, pixels.
pub fn extent(area: &[usize], width: usize) -> f32 {
    let range = |f: &dyn Fn(usize) -> usize| {
        let all = || area.iter().map(|&k| f(k));
        all().max().unwrap_or(0) - all().min().unwrap_or(0)
    };
    range(&|k| k % width).max(range(&|k| k / width)) as f32
}

/// What an area's cells elect from.
pub struct Votes {
    /// Of the area and around it.
    pub cells: Vec<Cell>,
    /// Distance from a plane at which a cell votes for it, share of inverse depth.
    pub tolerance: f32,
    /// Larger side of the area, pixels.
    pub extent: f32,
}

/// A plane with the cells that voted for it.
pub struct Elected {
    /// The plane.
    pub plane: Affine,
    /// Its cells.
    pub voters: Vec<Cell>,
    spread: Spread,
}

/// Where cells lie: mean and covariance.
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

    /// Distance from the middle in standard deviations.
    pub fn distance(&self, x: f32, y: f32) -> f32 {
        let [xx, xy, yy] = self.covariance;
        let (x, y) = (x - self.mean[0], y - self.mean[1]);
        ((yy * x * x - 2.0 * xy * x * y + xx * y * y) / (xx * yy - xy * xy)).sqrt()
    }
}

impl Votes {
    fn on(&self, plane: Affine, c: &Cell) -> bool {
        (at(plane, c.x, c.y) - c.inverse).abs() < self.tolerance * c.inverse
    }

    /// Planes by votes, none of them `refused`, and the area's cells that voted for none.
    pub fn planes(&self, seed: u32, refused: &dyn Fn(Affine, &Spread) -> bool) -> (Vec<Elected>, Vec<Cell>) {
        let mut left = self.cells.clone();
        let mut elected: Vec<Elected> = Vec::new();
        let mut state = seed;
        let quorum = FEWEST.max((QUORUM * self.cells.len() as f32) as usize);
        while left.len() >= quorum && elected.len() < MOST_PLANES {
            let Some(found) = self.best(&left, quorum, &mut state, refused) else { break };
            left.retain(|c| !self.on(found.plane, c));
            elected.push(found);
        }
        left.retain(|c| c.inner);
        (elected, left)
    }

    /// The plane that most cells are on.
    fn best(
        &self,
        cells: &[Cell],
        quorum: usize,
        state: &mut u32,
        refused: &dyn Fn(Affine, &Spread) -> bool,
    ) -> Option<Elected> {
        let own_cells = self.cells.iter().filter(|c| c.inner).count();
        let candidate = |plane: Affine, more_than: usize| -> Option<Elected> {
            if cells.iter().filter(|c| self.on(plane, c)).count() <= more_than {
                return None;
            }
            let voters: Vec<Cell> = cells.iter().filter(|c| self.on(plane, c)).copied().collect();
            let spread = Spread::of(&voters);
            let own = |cells: &[Cell]| {
                cells.iter().filter(|c| c.inner && spread.distance(c.x, c.y) < REACH).count() as f32
            };
            // The standard deviation of an even spread is its length over √12.
            let sound = 12f32.sqrt() * spread.across() > SPREAD * self.extent
                && (own_cells < FEWEST || own(&voters) >= (OWN_SHARE * own(&self.cells)).max(FEWEST as f32))
                && !refused(plane, &spread);
            sound.then_some(Elected { plane, voters, spread })
        };
        let mut best: Option<Elected> = None;
        for _ in 0..TRIALS {
            let mut draw = || {
                *state = hash(*state);
                cells[*state as usize % cells.len()]
            };
            let Some(plane) = through([draw(), draw(), draw()]) else { continue };
            let least = best.as_ref().map_or(quorum - 1, |b| b.voters.len());
            best = candidate(plane, least).or(best);
        }
        for _ in 0..3 {
            let refined = best.as_ref().and_then(|b| candidate(fitted(&b.voters)?, quorum - 1));
            best = refined.or(best);
        }
        best
    }
}

/// The plane of a pixel: of those that reach it the one with the nearest voters, unless cells of
/// the area that voted for none are nearer. Where the voters of the two nearest lie so that either
/// plane is in front on its own side, they meet in an inner corner and the nearer counts; where
/// either is behind, in an outer one.
pub fn chosen(planes: &[Elected], against: &[Cell], x: f32, y: f32) -> Option<Affine> {
    let near = |cells: &[Cell], limit: f32| -> f32 {
        let squared = |c: &Cell| (c.x - x).powi(2) + (c.y - y).powi(2) + 1.0;
        let weight = |c: &Cell| if c.inner { 1.0 } else { OUTER };
        cells.iter().filter(|c| squared(c) < limit * limit).map(|c| weight(c) / squared(c)).sum()
    };
    let mut reaching: Vec<(f32, &Elected)> = planes
        .iter()
        .filter(|e| e.spread.distance(x, y) < REACH)
        .map(|e| (near(&e.voters, f32::INFINITY), e))
        .collect();
    reaching.sort_by(|a, b| b.0.total_cmp(&a.0));
    let (support, first) = *reaching.first()?;
    if near(against, DISSENT) > support {
        return None;
    }
    let Some(&(_, second)) = reaching.get(1) else { return Some(first.plane) };
    let ahead = |of: &Elected, other: &Elected| {
        let ahead = of.voters.iter().filter(|c| at(of.plane, c.x, c.y) > at(other.plane, c.x, c.y)).count();
        ahead as f32 / of.voters.len() as f32
    };
    let (a, b) = (ahead(first, second), ahead(second, first));
    let nearer = at(first.plane, x, y) > at(second.plane, x, y);
    let keep = if a.min(b) > CORNER {
        nearer
    } else if a.max(b) < 1.0 - CORNER {
        !nearer
    } else {
        true
    };
    Some(if keep { first.plane } else { second.plane })
}

fn through(three: [Cell; 3]) -> Option<Affine> {
    let [p, q, r] = three;
    let (ux, uy, uv) = (q.x - p.x, q.y - p.y, q.inverse - p.inverse);
    let (vx, vy, vv) = (r.x - p.x, r.y - p.y, r.inverse - p.inverse);
    let det = ux * vy - uy * vx;
    // Three cells in a row tell nothing across it.
    if det.abs() < 4.0 * (CELL * CELL) as f32 {
        return None;
    }
    let (b, c) = ((uv * vy - uy * vv) / det, (ux * vv - uv * vx) / det);
    Some([p.inverse - b * p.x - c * p.y, b, c])
}

/// Least squares, relative to inverse depth.
fn fitted(cells: &[Cell]) -> Option<Affine> {
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

    /// Two walls of even colour that meet at column 100, known along a line at the top and one at
    /// the bottom.
    fn room() -> Votes {
        let left = |x: f32| 1.0 - 0.004 * x;
        let right = |x: f32| 0.2 + 0.004 * x;
        let rows = [4.0, 8.0, 90.0, 94.0];
        let columns = (0..50).map(|c| 4.0 * c as f32);
        let cells = columns.flat_map(|x| rows.map(|y| cell(x, y, left(x).max(right(x))))).collect();
        Votes { cells, tolerance: 0.015, extent: 200.0 }
    }

    #[test]
    fn two_walls_meet_where_their_planes_do() {
        let (planes, against) = room().planes(1, &|_, _| false);
        assert_eq!(planes.len(), 2);
        assert!(against.len() < 10, "{}", against.len());
        for x in [10.0, 60.0, 95.0, 105.0, 140.0, 190.0] {
            let plane = chosen(&planes, &against, x, 50.0).unwrap();
            let truth = (1.0 - 0.004 * x).max(0.2 + 0.004 * x);
            assert!((at(plane, x, 50.0) / truth - 1.0).abs() < 0.01, "column {x}: {}", at(plane, x, 50.0));
        }
    }

    #[test]
    fn what_is_refused_few_or_in_a_row_elects_nothing() {
        let (planes, against) = room().planes(1, &|_, _| true);
        assert!(planes.is_empty() && against.len() == 200);
        let line = |n: usize| (0..n).map(|k| cell(4.0 * k as f32, 20.0, 1.0)).collect();
        let votes = |cells| Votes { cells, tolerance: 0.015, extent: 200.0 };
        assert!(votes(line(50)).planes(1, &|_, _| false).0.is_empty(), "a line leaves the tilt open");
        assert!(votes(room().cells[..8].to_vec()).planes(1, &|_, _| false).0.is_empty(), "too few");
    }

    #[test]
    fn a_plane_ends_beyond_its_voters_and_at_cells_that_are_elsewhere() {
        let wall = room().cells.into_iter().filter(|c| c.x < 90.0).collect();
        let (planes, _) = Votes { cells: wall, tolerance: 0.015, extent: 200.0 }.planes(1, &|_, _| false);
        assert!(chosen(&planes, &[], 45.0, 50.0).is_some() && chosen(&planes, &[], 190.0, 50.0).is_none());
        let box_before = [cell(45.0, 50.0, 2.0)];
        assert!(chosen(&planes, &box_before, 46.0, 50.0).is_none());
        assert!(chosen(&planes, &box_before, 46.0, 80.0).is_some());
    }
}
