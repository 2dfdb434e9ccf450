//! Dense matches between two views for step 1 of the alignment (`--matcher xfeat`), and the warp
//! that depth and poses imply.
//!
//! XFeat's descriptors on an 8×8 grid are matched mutually along epipolar lines (the poses are
//! known by then), kept where neighbours agree, and spread over their cells by a local affine fit.
//! Both directions come from one set of matches, so they are each other's inverse.
use crate::math::dot_f32 as dot;
use crate::scene::{Camera, DenseWarp, DepthMap, Image};
use glam::{DMat2, DMat3, DVec2, DVec3};
use rayon::prelude::*;
use splatvk_infer::xfeat::DenseFeatures;

/// Descriptor length.
const DIM: usize = splatvk_infer::xfeat::DIM;

/// Cells whose centre lies farther from the epipolar line than this many cells are no candidates:
/// half a cell of quantisation on each side, and half a cell for pose errors.
const BAND_CELLS: f64 = 1.5;

/// Acceptance limits of descriptor matches.
#[derive(Clone, Copy, Debug, PartialEq)]
struct MatchLimits {
    /// Cosine of certainty 0; 1 has certainty 1.
    cosine: f32,
    /// Largest difference between the displacements of agreeing neighbours, cells.
    agreement: f64,
    /// Number of the eight neighbours that must agree.
    neighbours: usize,
}

/// Chosen for pixels that land on the right thing, which alignment counts. Breakfast views 0 and 1
/// (25° apart): 42 % of the co-visible pixels are matched, 98.2 % of them on the same object and 62
/// % within 8 px; 7 neighbours at cosine 0.85 give 92 % within 8 px and 99.4 % on the same object,
/// but 6 % of the pixels, too few for an area share.
const MATCH_LIMITS: MatchLimits = MatchLimits { cosine: 0.6, agreement: 0.5, neighbours: 3 };

/// A match between cell centres, refined to sub-cell accuracy in the second view.
#[derive(Clone, Copy)]
struct Match {
    cell: usize,
    a: DVec2,
    b: DVec2,
    cosine: f32,
}

/// Dense warps i → j and j → i from XFeat descriptors; `cameras` have the working resolution the
/// features were computed at.
pub fn xfeat(a: &DenseFeatures, b: &DenseFeatures, cameras: (&Camera, &Camera)) -> (DenseWarp, DenseWarp) {
    match_cells(a, b, cameras, MATCH_LIMITS)
}

fn match_cells(
    a: &DenseFeatures,
    b: &DenseFeatures,
    cameras: (&Camera, &Camera),
    limits: MatchLimits,
) -> (DenseWarp, DenseWarp) {
    let epipolar = fundamental(cameras.0, cameras.1);
    let forward = best_cells(a, b, &epipolar);
    let backward = best_cells(b, a, &epipolar.transpose());
    let mut matches: Vec<Match> = Vec::new();
    for (cell, best) in forward.iter().enumerate() {
        let Some((target, cosine)) = *best else { continue };
        // the backward match may be a neighbouring cell, since both grids quantise
        let consistent = backward[target].is_some_and(|(c, _)| neighbours(c, cell, a.width));
        if consistent {
            matches.push(Match { cell, a: centre(a, cell), b: refine(a, b, cell, target), cosine });
        }
    }
    let fits = local_fits(a, &matches, limits);
    let kept: Vec<(Match, DMat2)> =
        matches.into_iter().zip(fits).filter_map(|(m, f)| f.map(|f| (m, f))).collect();
    let certainty = |m: &Match| ((m.cosine - limits.cosine) / (1.0 - limits.cosine)).clamp(0.0, 1.0);
    let size = |c: &Camera| (c.width as usize, c.height as usize);
    let there = spread(size(cameras.0), a, kept.iter().map(|(m, j)| (m.a, m.b, *j, certainty(m))));
    let back = spread(size(cameras.1), b, kept.iter().map(|(m, j)| (m.b, m.a, j.inverse(), certainty(m))));
    (there, back)
}

/// Warp that depth and poses imply: reprojected pixels, with certainty 1 where the other view's
/// depth agrees and the forward-backward error is below `1.5·width/512` pixels.
pub fn geometry(from: &Camera, depth: &DepthMap, to: &Camera, other: &DepthMap) -> DenseWarp {
    let links = super::align::links_from_depth(0, 1, (from, to), (depth, other)).forward;
    let (width, height) = (depth.depth.width, depth.depth.height);
    let mut warp = DenseWarp {
        target: Image::filled(width, height, [-1.0; 2]),
        certainty: Image::filled(width, height, 0.0),
    };
    for p in 0..width * height {
        if links.target(p).is_some() {
            let pixel = DVec2::new((p % width) as f64 + 0.5, (p / width) as f64 + 0.5);
            let (q, _) = to.project(from.unproject(pixel, depth.depth.data[p] as f64));
            warp.target.data[p] = [q.x as f32, q.y as f32];
            warp.certainty.data[p] = 1.0;
        }
    }
    warp
}

/// F with `q_bᵀ F q_a = 0` for pixel positions (x, y, 1).
fn fundamental(a: &Camera, b: &Camera) -> DMat3 {
    let relative = b.pose.compose(&a.pose.inverse());
    let t = relative.translation.normalize_or_zero();
    let cross =
        DMat3::from_cols(DVec3::new(0.0, t.z, -t.y), DVec3::new(-t.z, 0.0, t.x), DVec3::new(t.y, -t.x, 0.0));
    inverse_intrinsics(b).transpose() * cross * relative.rotation * inverse_intrinsics(a)
}

fn inverse_intrinsics(c: &Camera) -> DMat3 {
    DMat3::from_cols(
        DVec3::new(1.0 / c.fx, 0.0, 0.0),
        DVec3::new(0.0, 1.0 / c.fy, 0.0),
        DVec3::new(-c.cx / c.fx, -c.cy / c.fy, 1.0),
    )
}

/// Pixel position of a cell's centre.
fn centre(f: &DenseFeatures, cell: usize) -> DVec2 {
    let (x, y) = ((cell % f.width) as f64 + 0.5, (cell / f.width) as f64 + 0.5);
    DVec2::new(x * f.pixels_per_cell[0] as f64, y * f.pixels_per_cell[1] as f64)
}

fn descriptor(f: &DenseFeatures, cell: usize) -> &[f32] {
    &f.descriptors[cell * DIM..(cell + 1) * DIM]
}

/// Most similar cell of `b` near the epipolar line of each cell of `a`.
fn best_cells(a: &DenseFeatures, b: &DenseFeatures, epipolar: &DMat3) -> Vec<Option<(usize, f32)>> {
    let band = BAND_CELLS * b.pixels_per_cell[0].max(b.pixels_per_cell[1]) as f64;
    let centres: Vec<DVec2> = (0..b.width * b.height).map(|c| centre(b, c)).collect();
    (0..a.width * a.height)
        .into_par_iter()
        .map(|cell| {
            let line = *epipolar * centre(a, cell).extend(1.0);
            let norm = line.truncate().length();
            let mut best: Option<(usize, f32)> = None;
            for (k, q) in centres.iter().enumerate() {
                // without a baseline (norm 0) every cell is a candidate
                if line.dot(q.extend(1.0)).abs() > band * norm {
                    continue;
                }
                let cosine = dot(descriptor(a, cell), descriptor(b, k));
                if best.is_none_or(|(_, c)| cosine > c) {
                    best = Some((k, cosine));
                }
            }
            best
        })
        .collect()
}

/// Same cell or one of its eight neighbours.
fn neighbours(a: usize, b: usize, width: usize) -> bool {
    (a % width).abs_diff(b % width) <= 1 && (a / width).abs_diff(b / width) <= 1
}

/// Peak of a parabola through the similarity of the matched cell and its neighbours, per axis.
fn refine(a: &DenseFeatures, b: &DenseFeatures, cell: usize, target: usize) -> DVec2 {
    let (x, y) = (target % b.width, target / b.width);
    let similarity = |x: usize, y: usize| dot(descriptor(a, cell), descriptor(b, y * b.width + x)) as f64;
    let mut shift = DVec2::ZERO;
    if x > 0 && x + 1 < b.width {
        shift.x = parabola_peak(similarity(x - 1, y), similarity(x, y), similarity(x + 1, y));
    }
    if y > 0 && y + 1 < b.height {
        shift.y = parabola_peak(similarity(x, y - 1), similarity(x, y), similarity(x, y + 1));
    }
    centre(b, target) + shift * DVec2::new(b.pixels_per_cell[0] as f64, b.pixels_per_cell[1] as f64)
}

/// Offset of the maximum of the parabola through three equidistant values, at most half a step.
fn parabola_peak(low: f64, mid: f64, high: f64) -> f64 {
    let curve = low - 2.0 * mid + high;
    if curve < 0.0 { (0.5 * (low - high) / curve).clamp(-0.5, 0.5) } else { 0.0 }
}

/// Local Jacobian of each match, fitted to its agreeing neighbours; `None` if too few agree.
fn local_fits(a: &DenseFeatures, matches: &[Match], limits: MatchLimits) -> Vec<Option<DMat2>> {
    let mut match_at = vec![None; a.width * a.height];
    for (k, m) in matches.iter().enumerate() {
        match_at[m.cell] = Some(k);
    }
    matches.par_iter().map(|m| local_fit(m, a, matches, &match_at, limits)).collect()
}

/// Local Jacobian of one match; `match_at` has the index of the match in each cell.
fn local_fit(
    m: &Match,
    a: &DenseFeatures,
    matches: &[Match],
    match_at: &[Option<usize>],
    limits: MatchLimits,
) -> Option<DMat2> {
    let cell = a.pixels_per_cell[0].max(a.pixels_per_cell[1]) as f64;
    let (x, y) = ((m.cell % a.width) as isize, (m.cell / a.width) as isize);
    let (mut agreeing, mut normal, mut moved) = (0, DMat2::ZERO, DMat2::ZERO);
    for (dx, dy) in [(-1, -1), (0, -1), (1, -1), (-1, 0), (1, 0), (-1, 1), (0, 1), (1, 1)] {
        let (nx, ny) = (x + dx, y + dy);
        if nx < 0 || ny < 0 || nx >= a.width as isize || ny >= a.height as isize {
            continue;
        }
        let Some(other) = match_at[ny as usize * a.width + nx as usize].map(|k| &matches[k]) else {
            continue;
        };
        let (u, v) = (other.a - m.a, other.b - m.b);
        if (u - v).length() <= limits.agreement * cell {
            agreeing += 1;
            normal += DMat2::from_cols(u * u.x, u * u.y);
            moved += DMat2::from_cols(v * u.x, v * u.y);
        }
    }
    // half a neighbourhood's weight on the identity: parabola peaks scatter by a pixel or two
    let ridge = 4.0 * cell * cell;
    let identity = DMat2::from_diagonal(DVec2::splat(ridge));
    let jacobian = (moved + identity) * (normal + identity).inverse();
    (agreeing >= limits.neighbours && jacobian.determinant() > 0.1).then_some(jacobian)
}

/// Paints each match over the pixels nearest to it, within one cell.
fn spread(
    (width, height): (usize, usize),
    grid: &DenseFeatures,
    matches: impl Iterator<Item = (DVec2, DVec2, DMat2, f32)>,
) -> DenseWarp {
    let mut warp = DenseWarp {
        target: Image::filled(width, height, [-1.0; 2]),
        certainty: Image::filled(width, height, 0.0),
    };
    let mut distance = Image::filled(width, height, f64::INFINITY);
    let reach = DVec2::new(grid.pixels_per_cell[0] as f64, grid.pixels_per_cell[1] as f64) * 0.75;
    for (from, to, jacobian, certainty) in matches {
        let (low, high) = (from - reach, from + reach);
        for y in low.y.max(0.0) as usize..(high.y.max(0.0) as usize + 1).min(height) {
            for x in low.x.max(0.0) as usize..(high.x.max(0.0) as usize + 1).min(width) {
                let offset = DVec2::new(x as f64 + 0.5, y as f64 + 0.5) - from;
                let p = y * width + x;
                if offset.abs().cmpgt(reach).any() || offset.length_squared() >= distance.data[p] {
                    continue;
                }
                let q = to + jacobian * offset;
                distance.data[p] = offset.length_squared();
                warp.target.data[p] = [q.x as f32, q.y as f32];
                warp.certainty.data[p] = certainty;
            }
        }
    }
    warp
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::align::links_from_warps;
    use splatvk_infer::Registry;
    use splatvk_infer::xfeat::XFeat;
    use splatvk_test_support::breakfast::{TestView, train_views};

    fn depth(view: &TestView) -> DepthMap {
        let known = view.depth.data.iter().map(|&z| f32::from(z > 0.0)).collect();
        DepthMap { depth: view.depth.clone(), confidence: Image { data: known, ..view.depth } }
    }

    #[test]
    fn xfeat_warps_agree_with_geometry() {
        let views = train_views();
        let mut net = XFeat::load(&Registry::open(None).unwrap()).unwrap();
        let f: Vec<DenseFeatures> = views.iter().take(2).map(|v| net.dense(&v.image).unwrap()).collect();
        let (a, b) = (&views[0], &views[1]);
        let exact = geometry(&a.camera, &depth(a), &b.camera, &depth(b));
        let total = exact.certainty.data.iter().filter(|&&c| c > 0.0).count();
        let score = |limits: MatchLimits| {
            let (there, back) = match_cells(&f[0], &f[1], (&a.camera, &b.camera), limits);
            let links = links_from_warps(0, 1, &there, &back);
            let (mut kept, mut close, mut label) = (0, 0, 0);
            for p in 0..there.target.data.len() {
                if links.forward.target(p).is_none() || exact.certainty.data[p] == 0.0 {
                    continue;
                }
                let (q, e) = (there.target.data[p], exact.target.data[p]);
                kept += 1;
                // one cell: less than the width of any object
                close += usize::from((q[0] - e[0]).hypot(q[1] - e[1]) < 8.0);
                label += usize::from(a.masks.data[p] == b.masks.at(q[0] as usize, q[1] as usize));
            }
            println!("{limits:?}: {kept} of {total}, {close} within 8 px, {label} on the same object");
            (kept, close, label)
        };
        let (kept, close, label) = score(MATCH_LIMITS);
        assert!(kept > total / 3 && 2 * close > kept, "{kept} {close}");
        // 70 % of the image is table and wall: uniformly random matches agree in about half of the
        // cases
        assert!(label as f64 > 0.97 * kept as f64, "{label} of {kept}");
    }

    #[test]
    fn geometry_warp_is_consistent() {
        let views = train_views();
        let (a, b) = (&views[1], &views[2]);
        let (da, db) = (depth(a), depth(b));
        let there = geometry(&a.camera, &da, &b.camera, &db);
        let back = geometry(&b.camera, &db, &a.camera, &da);
        let links = links_from_warps(0, 1, &there, &back);
        let share =
            links.forward.count() as f64 / there.certainty.data.iter().filter(|&&c| c > 0.0).count() as f64;
        assert!(share > 0.9, "{share}");
        let same = there.certainty.data.iter().enumerate().filter(|(_, c)| **c > 0.0).filter(|(p, _)| {
            let q = there.target.data[*p];
            a.masks.data[*p] == b.masks.at(q[0] as usize, q[1] as usize)
        });
        let all = there.certainty.data.iter().filter(|&&c| c > 0.0).count();
        // labels agree except along outlines
        assert!(same.count() as f64 > 0.98 * all as f64);
    }
}
