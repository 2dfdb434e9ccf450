//! Nearest points.
use glam::Vec3;

/// Balanced k-d tree over point indices: the median of each range splits it along its widest axis.
pub struct Nearest<'a> {
    positions: &'a [Vec3],
    order: Vec<u32>,
    axes: Vec<u8>,
}

impl<'a> Nearest<'a> {
    /// Builds the tree.
    pub fn new(positions: &'a [Vec3]) -> Self {
        let mut order: Vec<u32> = (0..positions.len() as u32).collect();
        let mut axes = vec![0; positions.len()];
        Self::build(positions, &mut order, &mut axes);
        Nearest { positions, order, axes }
    }

    fn build(positions: &[Vec3], order: &mut [u32], axes: &mut [u8]) {
        if order.len() < 2 {
            return;
        }
        let (mut low, mut high) = (Vec3::INFINITY, Vec3::NEG_INFINITY);
        for &i in order.iter() {
            low = low.min(positions[i as usize]);
            high = high.max(positions[i as usize]);
        }
        let axis = (high - low).max_position();
        let middle = order.len() / 2;
        order.select_nth_unstable_by(middle, |&a, &b| {
            positions[a as usize][axis].total_cmp(&positions[b as usize][axis])
        });
        axes[middle] = axis as u8;
        let (left, right) = order.split_at_mut(middle);
        let (left_axes, right_axes) = axes.split_at_mut(middle);
        // A parallel task for fewer points costs more than it saves.
        if left.len() > 4096 {
            rayon::join(
                || Self::build(positions, left, left_axes),
                || Self::build(positions, &mut right[1..], &mut right_axes[1..]),
            );
        } else {
            Self::build(positions, left, left_axes);
            Self::build(positions, &mut right[1..], &mut right_axes[1..]);
        }
    }

    /// The K nearest points other than `skip` with their squared distances, nearest first; `None`
    /// for missing ones.
    pub fn of<const K: usize>(&self, query: Vec3, skip: Option<usize>) -> [Option<(usize, f32)>; K] {
        let mut best = [(u32::MAX, f32::INFINITY); K];
        let skip = skip.map_or(u32::MAX, |i| i as u32);
        self.search(query, skip, (0, self.order.len()), &mut best);
        best.map(|(i, square)| square.is_finite().then_some((i as usize, square)))
    }

    fn search(&self, query: Vec3, skip: u32, (from, to): (usize, usize), best: &mut [(u32, f32)]) {
        if from >= to {
            return;
        }
        let middle = from + (to - from) / 2;
        let index = self.order[middle];
        let point = self.positions[index as usize];
        if index != skip {
            let mut found = (index, point.distance_squared(query));
            for slot in best.iter_mut() {
                if found.1 < slot.1 {
                    std::mem::swap(&mut found, slot);
                }
            }
        }
        if to - from == 1 {
            return;
        }
        let axis = self.axes[middle] as usize;
        let offset = query[axis] - point[axis];
        let (near, far) = match offset < 0.0 {
            true => ((from, middle), (middle + 1, to)),
            false => ((middle + 1, to), (from, middle)),
        };
        self.search(query, skip, near, best);
        if best.last().is_some_and(|last| offset * offset < last.1) {
            self.search(query, skip, far, best);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Random;

    #[test]
    fn nearest_points_match_brute_force() {
        let mut random = Random::new(3);
        let positions: Vec<Vec3> =
            (0..700).map(|_| Vec3::from([0; 3].map(|_| random.uniform() as f32))).collect();
        let tree = Nearest::new(&positions);
        for i in 0..positions.len() {
            let square = |j: &usize| positions[i].distance_squared(positions[*j]);
            let mut all: Vec<usize> = (0..positions.len()).filter(|j| *j != i).collect();
            all.sort_by(|a, b| square(a).total_cmp(&square(b)));
            let expected: Vec<_> = all[..5].iter().map(|j| Some((*j, square(j)))).collect();
            assert_eq!(tree.of::<5>(positions[i], Some(i)).to_vec(), expected);
            assert_eq!(tree.of::<1>(positions[i], None), [Some((i, 0.0))]);
        }
        assert_eq!(Nearest::new(&positions[..1]).of::<2>(Vec3::ZERO, Some(0)), [None, None]);
    }
}
