//! Splats from points: size from the pixel footprint and the nearest neighbours, a disc in the
//! surface where its normal is known, colour from the photos
//! (docs/internals/method.md#splats-from-points).
use super::options::InitOptions;
use crate::math::{Nearest, Random};
use crate::scene::{PointCloud, SH_C0, Splats};
use crate::{Error, Result};
use glam::{Quat, Vec3};
use rayon::prelude::*;
use std::collections::HashMap;
use std::hash::{BuildHasherDefault, Hasher};

/// Makes one splat per (kept) point, SH degree 0.
pub fn splats_from_points(points: &PointCloud, options: &InitOptions, seed: u64) -> Result<Splats> {
    let finite: Vec<usize> = (0..points.len())
        .filter(|&i| points.positions[i].iter().chain(&points.colours[i]).all(|v| v.is_finite()))
        .collect();
    if finite.len() < 4 {
        return Err(Error::work(format!(
            "training needs at least 4 points and got {}; the photos may not overlap enough",
            finite.len()
        )));
    }
    let keep = thin(points, finite, options.max_points.max(4), seed);
    let positions: Vec<Vec3> = keep.iter().map(|&i| Vec3::from(points.positions[i])).collect();
    let spacing = neighbour_distances(&positions);
    let logit = (options.opacity / (1.0 - options.opacity)).ln();
    // Thinning leaves fewer splats for the same surface: each must cover proportionally more of it.
    let grow = (points.len() as f32 / keep.len() as f32).sqrt();
    let mut splats = Splats { sh_degree: 0, ..Splats::default() };
    for (n, &i) in keep.iter().enumerate() {
        let footprint = match points.radius.get(i) {
            Some(&r) if r > 0.0 && r.is_finite() => r * options.footprint * grow,
            _ => f32::INFINITY,
        };
        // 1e-7 is the squared-distance floor of the reference implementation for coincident points.
        let scale = footprint.min(spacing[n] * options.neighbours).max(1e-7f32.sqrt());
        splats.means.push(points.positions[i]);
        let normal = points.normals.get(i).map_or(Vec3::ZERO, |n| Vec3::from(*n));
        let thickness = if normal == Vec3::ZERO { 1.0 } else { options.thickness };
        splats.log_scales.push([scale, scale, thickness * scale].map(f32::ln));
        let turn = Quat::from_rotation_arc(Vec3::Z, normal.try_normalize().unwrap_or(Vec3::Z));
        splats.quats.push([turn.w, turn.x, turn.y, turn.z]);
        splats.opacity_logits.push(logit);
        splats.sh.extend(points.colours[i].map(|c| (c - 0.5) / SH_C0));
    }
    Ok(splats)
}

/// Reduces `candidates` to at most `max` points: the most confident point of every voxel, in voxels
/// just large enough, then random points up to `max`. Sparse and far regions stay covered.
fn thin(points: &PointCloud, mut candidates: Vec<usize>, max: usize, seed: u64) -> Vec<usize> {
    if candidates.len() <= max {
        return candidates;
    }
    Random::new(seed).shuffle(&mut candidates);
    // The voxel edge is in pixel footprints: on a surface with one point per footprint, a voxel of
    // edge √ratio holds `ratio` points. Overlapping views have more points, so the edge starts
    // there and grows until the number of voxels is at most `max`.
    let mut edge = (candidates.len() as f32 / max as f32).sqrt() * 0.7;
    let best = loop {
        match occupied(points, &candidates, edge, max) {
            Some(best) => break best,
            None => edge *= 1.2,
        }
    };
    let mut chosen = vec![false; points.len()];
    best.values().for_each(|&i| chosen[i] = true);
    let (mut keep, rest): (Vec<usize>, Vec<usize>) = candidates.into_iter().partition(|&i| chosen[i]);
    keep.extend(rest);
    keep.truncate(max);
    keep.sort_unstable();
    keep
}

/// Octave and position of a voxel.
type Voxel = [i64; 4];

/// A fast hash of a [`Voxel`]; the standard one takes most of the time of [`thin`].
#[derive(Default)]
struct VoxelHasher(u64);

impl Hasher for VoxelHasher {
    fn write(&mut self, bytes: &[u8]) {
        for word in bytes.chunks(8) {
            let mut padded = [0; 8];
            padded[..word.len()].copy_from_slice(word);
            // The odd number nearest to 2⁶⁴ over the golden ratio, as in Fibonacci hashing.
            self.0 =
                (self.0.rotate_left(23) ^ u64::from_le_bytes(padded)).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        }
    }
    fn finish(&self) -> u64 {
        // The table takes its position from the low bits, which a product mixes least.
        self.0 ^ self.0 >> 32
    }
}

/// Most confident candidate of every occupied voxel of `edge` pixel footprints; `None` if more than
/// `most` are occupied.
fn occupied(
    points: &PointCloud,
    candidates: &[usize],
    edge: f32,
    most: usize,
) -> Option<HashMap<Voxel, usize, BuildHasherDefault<VoxelHasher>>> {
    let confidence = |j: usize| points.confidence.get(j).copied().unwrap_or(0.0);
    let voxel = |&i: &usize| -> Voxel {
        let radius = points.radius.get(i).copied().filter(|r| *r > 0.0 && r.is_finite()).unwrap_or(1e-3);
        // By octaves of the footprint, so that near and far surfaces are thinned in image space.
        let octave = radius.log2().round();
        let cell = octave.exp2() * edge;
        let p = points.positions[i].map(|v| (v / cell).floor() as i64);
        [octave as i64, p[0], p[1], p[2]]
    };
    let mut best = HashMap::default();
    // In parts, since too small an edge shows after few of many candidates.
    for part in candidates.chunks(1 << 16) {
        let voxels: Vec<Voxel> = part.par_iter().map(voxel).collect();
        for (&i, voxel) in part.iter().zip(voxels) {
            let entry = best.entry(voxel).or_insert(i);
            if confidence(i) > confidence(*entry) {
                *entry = i;
            }
            if best.len() > most {
                return None;
            }
        }
    }
    Some(best)
}

/// Root of the mean squared distance to the three nearest other points, per point.
pub fn neighbour_distances(positions: &[Vec3]) -> Vec<f32> {
    let tree = Nearest::new(positions);
    (0..positions.len())
        .into_par_iter()
        .map(|i| {
            let others = tree.of::<3>(positions[i], Some(i));
            let found: Vec<f32> = others.into_iter().flatten().map(|(_, square)| square).collect();
            (found.iter().sum::<f32>() / found.len().max(1) as f32).sqrt()
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cloud(n: usize, seed: u64) -> PointCloud {
        let mut random = Random::new(seed);
        let mut points = PointCloud::default();
        for _ in 0..n {
            points.positions.push([0; 3].map(|_| random.uniform() as f32));
            points.colours.push([0; 3].map(|_| random.uniform() as f32));
            points.confidence.push(random.uniform() as f32);
            points.view.push(0);
            points.radius.push(0.01);
        }
        points
    }

    #[test]
    fn neighbour_distances_match_brute_force() {
        let points = cloud(700, 3);
        let positions: Vec<Vec3> = points.positions.iter().map(|p| Vec3::from(*p)).collect();
        for (i, got) in neighbour_distances(&positions).into_iter().enumerate() {
            let mut all: Vec<f32> = (0..positions.len())
                .filter(|&j| j != i)
                .map(|j| positions[i].distance_squared(positions[j]))
                .collect();
            all.sort_by(f32::total_cmp);
            let expected = (all[..3].iter().sum::<f32>() / 3.0).sqrt();
            assert!((got - expected).abs() < 1e-6, "{i}: {got} {expected}");
        }
    }

    #[test]
    fn new_splats_keep_colour_within_sizes() {
        let points = cloud(200, 5);
        let options =
            InitOptions { max_points: 1000, opacity: 0.3, footprint: 0.5, neighbours: 1.0, thickness: 0.2 };
        let splats = splats_from_points(&points, &options, 0).unwrap();
        let positions: Vec<Vec3> = points.positions.iter().map(|p| Vec3::from(*p)).collect();
        let spacing = neighbour_distances(&positions);
        for i in 0..splats.len() {
            let scale = splats.log_scales[i][0].exp();
            assert!((scale - spacing[i].min(0.005)).abs() < 1e-6);
            let o = 1.0 / (1.0 + (-splats.opacity_logits[i]).exp());
            assert!((o - 0.3).abs() < 1e-6);
            for c in 0..3 {
                assert!((0.5 + SH_C0 * splats.sh[3 * i + c] - points.colours[i][c]).abs() < 1e-6);
            }
        }
    }

    #[test]
    fn thinning_limits_count_keeps_sparse_regions() {
        let mut points = cloud(4000, 9);
        points.positions[77] = [50.0, 50.0, 50.0];
        let options =
            InitOptions { max_points: 500, opacity: 0.5, footprint: 0.7, neighbours: 1.0, thickness: 0.2 };
        let splats = splats_from_points(&points, &options, 1).unwrap();
        assert_eq!(splats.len(), 500);
        assert!(splats.means.contains(&[50.0, 50.0, 50.0]), "the only point of its region survives");
        assert_eq!(splats, splats_from_points(&points, &options, 1).unwrap(), "seeded");
    }

    #[test]
    fn too_few_valid_points_fail() {
        let mut points = cloud(5, 1);
        points.positions[0][1] = f32::NAN;
        points.colours[1][0] = f32::INFINITY;
        let options =
            InitOptions { max_points: 10, opacity: 0.5, footprint: 0.7, neighbours: 1.0, thickness: 0.2 };
        assert!(splats_from_points(&points, &options, 0).is_err());
    }
}
