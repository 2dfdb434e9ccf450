//! Palettes: a limited number of vectors for many, by bisecting k-means (Steinbach et al. 2000):
//! the cell of vectors with the largest squared error is split in two by 2-means, beginning with its
//! principal axis, until the entries are used up. The result depends neither on the number of
//! threads nor on chance.

/// Rounds of the power iteration for the principal axis.
const AXIS_ROUNDS: usize = 3;
/// Rounds of 2-means.
const SPLIT_ROUNDS: usize = 3;
/// Depth beyond which cells are halved: it bounds the depth where each split takes off one vector.
const DEEPEST: usize = 48;
/// A cell is not split further below this part of the mean number of vectors per entry.
const SMALLEST: usize = 8;

/// Entries, and the entry of each vector.
pub(super) struct Palette {
    pub entries: Vec<f32>,
    pub labels: Vec<u16>,
}

/// At most `most` ≤ 65,536 entries for vectors of a width.
pub(super) fn fit(rows: &[f32], width: usize, most: usize) -> Palette {
    let rows = Rows { rows, width };
    let mut members: Vec<u32> = (0..(rows.rows.len() / width) as u32).collect();
    let smallest = members.len() / most / SMALLEST;
    let tree = rows.tree(&mut members, smallest, 0);
    // No part has a larger error than its whole: the splits with the largest errors are those that
    // are made one by one, each in the worst cell.
    let mut errors = Vec::new();
    tree.errors(&mut errors);
    errors.sort_unstable_by(|a, b| b.total_cmp(a));
    let mut cells = Vec::new();
    tree.cut(errors.get(most - 1).copied().unwrap_or(0.0), &mut cells);
    let mut palette =
        Palette { entries: Vec::with_capacity(cells.len() * width), labels: vec![0; members.len()] };
    let mut rest = members.as_slice();
    for (label, size) in cells.into_iter().enumerate() {
        let (own, after) = rest.split_at(size);
        rest = after;
        palette.entries.extend(rows.mean(own));
        own.iter().for_each(|i| palette.labels[*i as usize] = label as u16);
    }
    palette
}

/// A cell of vectors, and its two parts.
struct Cell {
    size: usize,
    error: f64,
    parts: Option<Box<[Cell; 2]>>,
}

impl Cell {
    /// Errors of all cells that have parts.
    fn errors(&self, into: &mut Vec<f64>) {
        if let Some(parts) = &self.parts {
            into.push(self.error);
            parts.iter().for_each(|part| part.errors(into));
        }
    }

    /// Sizes of the cells that remain if those of a larger error are split.
    fn cut(&self, error: f64, into: &mut Vec<usize>) {
        match &self.parts {
            Some(parts) if self.error > error => parts.iter().for_each(|part| part.cut(error, into)),
            _ => into.push(self.size),
        }
    }
}

#[derive(Clone, Copy)]
struct Rows<'a> {
    rows: &'a [f32],
    width: usize,
}

impl<'a> Rows<'a> {
    fn row(self, i: u32) -> &'a [f32] {
        &self.rows[i as usize * self.width..][..self.width]
    }

    /// Sorts the members by cells.
    fn tree(self, members: &mut [u32], smallest: usize, depth: usize) -> Cell {
        let (size, error) = (members.len(), self.error(members));
        let whole = Cell { size, error, parts: None };
        if size <= smallest.max(1) || error <= 0.0 {
            return whole;
        }
        let Some(first) = self.halved(members, depth) else { return whole };
        let (left, right) = members.split_at_mut(first);
        let (left, right) =
            rayon::join(|| self.tree(left, smallest, depth + 1), || self.tree(right, smallest, depth + 1));
        Cell { parts: Some(Box::new([left, right])), ..whole }
    }

    /// Splits a cell by 2-means; returns the size of the first part, or none for equal vectors.
    fn halved(self, members: &mut [u32], depth: usize) -> Option<usize> {
        let centre = self.mean(members);
        let axis = self.axis(members, &centre)?;
        let along =
            |i: u32| self.row(i).iter().zip(&centre).zip(&axis).map(|((v, c), a)| (v - c) * a).sum::<f32>();
        if depth > DEEPEST {
            let middle = members.len() / 2;
            members.select_nth_unstable_by(middle, |a, b| along(*a).total_cmp(&along(*b)).then(a.cmp(b)));
            return Some(middle);
        }
        let mut size = parted(members, |i| along(i) < 0.0)?;
        for _ in 0..SPLIT_ROUNDS {
            let (left, right) = (self.mean(&members[..size]), self.mean(&members[size..]));
            let nearer = |i: u32| distance(self.row(i), &left) < distance(self.row(i), &right);
            match parted(members, nearer) {
                Some(moved) if moved == size => break,
                Some(moved) => size = moved,
                None => break,
            }
        }
        Some(size)
    }

    fn mean(self, members: &[u32]) -> Vec<f32> {
        let mut sums = vec![0.0f64; self.width];
        for i in members {
            sums.iter_mut().zip(self.row(*i)).for_each(|(sum, v)| *sum += f64::from(*v));
        }
        sums.into_iter().map(|sum| (sum / members.len().max(1) as f64) as f32).collect()
    }

    /// Sum of squared distances from the mean.
    fn error(self, members: &[u32]) -> f64 {
        let centre = self.mean(members);
        members.iter().map(|i| f64::from(distance(self.row(*i), &centre))).sum()
    }

    /// Unit vector of the largest variance, by power iteration from the member farthest away.
    fn axis(self, members: &[u32], centre: &[f32]) -> Option<Vec<f32>> {
        let away = |i: u32| distance(self.row(i), centre);
        let far = members.iter().copied().max_by(|a, b| away(*a).total_cmp(&away(*b)).then(b.cmp(a)))?;
        let mut axis: Vec<f32> = self.row(far).iter().zip(centre).map(|(v, c)| v - c).collect();
        for round in 0..=AXIS_ROUNDS {
            let length = axis.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt();
            if !(length > 0.0 && length.is_finite()) {
                return None;
            }
            axis.iter_mut().for_each(|v| *v = (f64::from(*v) / length) as f32);
            if round == AXIS_ROUNDS {
                break;
            }
            let mut next = vec![0.0f64; self.width];
            for i in members {
                let row = self.row(*i);
                let along = row.iter().zip(centre).zip(&axis).map(|((v, c), a)| (v - c) * a).sum::<f32>();
                let offsets = row.iter().zip(centre).map(|(v, c)| v - c);
                next.iter_mut().zip(offsets).for_each(|(n, v)| *n += f64::from(along) * f64::from(v));
            }
            let greatest = next.iter().fold(f64::MIN_POSITIVE, |m, v| m.max(v.abs()));
            axis = next.into_iter().map(|v| (v / greatest) as f32).collect();
        }
        Some(axis)
    }
}

fn distance(a: &[f32], b: &[f32]) -> f32 {
    a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum()
}

/// Moves the members that belong to the first part to the front, in their order; returns their
/// number, or none where one part would be empty.
fn parted(members: &mut [u32], first: impl Fn(u32) -> bool) -> Option<usize> {
    let (front, back): (Vec<u32>, Vec<u32>) = members.iter().partition(|i| first(**i));
    if front.is_empty() || back.is_empty() {
        return None;
    }
    members[..front.len()].copy_from_slice(&front);
    members[front.len()..].copy_from_slice(&back);
    Some(front.len())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn noise(i: usize) -> f32 {
        let h = (i as u64 + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        (h >> 40) as f32 / (1u64 << 23) as f32 - 1.0
    }

    #[test]
    fn clusters_are_found() {
        // 40 clusters of 25 vectors each.
        let rows: Vec<f32> =
            (0..1000 * 9).map(|k| 5.0 * noise(k / 9 % 40 * 9 + k % 9) + 0.01 * noise(90_000 + k)).collect();
        let palette = fit(&rows, 9, 40);
        assert_eq!((palette.entries.len(), palette.labels.len()), (40 * 9, 1000));
        for i in 0..1000 {
            let entry = &palette.entries[usize::from(palette.labels[i]) * 9..][..9];
            assert!(distance(entry, &rows[9 * i..][..9]) < 0.01, "{i}");
        }
    }

    #[test]
    fn palette_is_limited_and_repeatable() {
        let rows: Vec<f32> = (0..3000 * 24).map(noise).collect();
        let (once, again) = (fit(&rows, 24, 256), fit(&rows, 24, 256));
        assert!(once.entries == again.entries && once.labels == again.labels);
        assert_eq!(once.entries.len(), 256 * 24);
        let alone = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
        assert_eq!(alone.install(|| fit(&rows, 24, 256)).labels, once.labels);
        // More entries than different vectors, and vectors that take off one by one.
        let equal = fit(&vec![0.5; 100 * 3], 3, 64);
        assert_eq!((equal.entries, equal.labels), (vec![0.5; 3], vec![0; 100]));
        let steep: Vec<f32> = (0..60 * 3).map(|k| 2f32.powi(k / 3 - 30)).collect();
        let palette = fit(&steep, 3, 64);
        assert_eq!(palette.entries.len(), 60 * 3);
        let exact = |i: usize| palette.entries[usize::from(palette.labels[i]) * 3] == steep[3 * i];
        assert!((0..60).all(exact));
    }
}
