//! Scalar codebooks: 256 numbers for many.
use super::CODES;
use rayon::slice::ParallelSliceMut;

/// Most rounds of Lloyd's algorithm; it mostly stops before.
const ROUNDS: usize = 100;
/// Steps of the distribution by which the first codes are placed.
const STEPS: usize = 4096;

/// Codes in ascending order.
pub(super) struct Codebook(Vec<f32>);

impl Codebook {
    /// The codes with the least squared error that Lloyd's algorithm finds; the numbers themselves
    /// where they are few.
    pub(super) fn fit(mut numbers: Vec<f32>) -> Codebook {
        numbers.par_sort_unstable_by(f32::total_cmp);
        let mut distinct = numbers.clone();
        distinct.dedup();
        if distinct.len() <= CODES {
            return Codebook(distinct);
        }
        let mut sums = Vec::with_capacity(numbers.len() + 1);
        sums.push(0.0);
        let mut sum = 0.0;
        sums.extend(numbers.iter().map(|v| {
            sum += f64::from(*v);
            sum
        }));
        let mut codes = Codebook(placed(&numbers));
        for _ in 0..ROUNDS {
            let ends = codes.ends(&numbers);
            let mean = |k: usize| {
                let (start, end) = (if k == 0 { 0 } else { ends[k - 1] }, ends[k]);
                // A code without numbers stays.
                if end > start {
                    ((sums[end] - sums[start]) / (end - start) as f64) as f32
                } else {
                    codes.0[k]
                }
            };
            let moved = Codebook((0..CODES).map(mean).collect());
            let done = moved.0 == codes.0;
            codes = moved;
            if done {
                break;
            }
        }
        codes
    }

    /// End of the numbers of each code, of ascending numbers.
    fn ends(&self, numbers: &[f32]) -> Vec<usize> {
        let middles = self.0.windows(2).map(middle);
        let mut ends: Vec<usize> = middles.map(|m| numbers.partition_point(|v| *v < m)).collect();
        ends.push(numbers.len());
        ends
    }

    /// Index of the nearest code.
    pub(super) fn index(&self, v: f32) -> u8 {
        let above = self.0.partition_point(|code| *code < v);
        let nearest = match above {
            0 => 0,
            k if k < self.0.len() && v >= middle(&self.0[k - 1..=k]) => k,
            k => k - 1,
        };
        // At most 256 codes.
        nearest as u8
    }

    /// All 256 codes; the last one fills up.
    pub(super) fn padded(&self) -> Vec<Option<f32>> {
        let last = self.0.last().copied().unwrap_or(0.0);
        self.0.iter().copied().chain(std::iter::repeat(last)).take(CODES).map(Some).collect()
    }
}

/// Between two codes; f64 holds the sum of any two f32.
fn middle(pair: &[f32]) -> f32 {
    ((f64::from(pair[0]) + f64::from(pair[1])) / 2.0) as f32
}

/// First codes of ascending numbers: with the cube root of their density, as is best for many codes
/// (Panter and Dite 1951). Where a step holds 1/n of the numbers in a width w, its codes are as
/// w^(2/3).
fn placed(numbers: &[f32]) -> Vec<f32> {
    let steps = STEPS.min(numbers.len() - 1);
    let at = |step: usize| f64::from(numbers[step * (numbers.len() - 1) / steps]);
    let mut ends = Vec::with_capacity(steps);
    let mut end = 0.0;
    for step in 0..steps {
        end += (at(step + 1) - at(step)).powf(2.0 / 3.0);
        ends.push(end);
    }
    let place = |k: usize| {
        let target = end * (k as f64 + 0.5) / CODES as f64;
        let step = ends.partition_point(|e| *e < target).min(steps - 1);
        let start = if step == 0 { 0.0 } else { ends[step - 1] };
        let share = if ends[step] > start { (target - start) / (ends[step] - start) } else { 0.5 };
        (at(step) + share * (at(step + 1) - at(step))) as f32
    };
    (0..CODES).map(place).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Numbers in (−1, 1) from a hash.
    fn noise(i: usize) -> f32 {
        let h = (i as u64 + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        (h >> 40) as f32 / (1u64 << 23) as f32 - 1.0
    }

    #[test]
    fn few_numbers_are_exact() {
        let numbers: Vec<f32> = (0..300).map(|i| [-90.0, -2.0, -1.999, 41.0][i % 4]).collect();
        let codes = Codebook::fit(numbers.clone());
        let padded = codes.padded();
        assert_eq!(padded.len(), CODES);
        assert!(numbers.iter().all(|v| padded[usize::from(codes.index(*v))] == Some(*v)));
        assert_eq!(Codebook::fit(Vec::new()).padded(), vec![Some(0.0); CODES]);
    }

    #[test]
    fn codes_are_nearest_and_close_to_optimal() {
        // Cubes: dense about zero, thin outside.
        let numbers: Vec<f32> = (0..50_000).map(|i| noise(i).powi(3)).collect();
        let codes = Codebook::fit(numbers.clone());
        let error = |v: &f32| {
            let chosen = codes.0[usize::from(codes.index(*v))];
            let best = codes.0.iter().map(|c| (c - v).abs()).fold(f32::INFINITY, f32::min);
            assert!((chosen - v).abs() <= best + 1e-7, "{v}: {chosen}");
            f64::from(chosen - v).powi(2)
        };
        let found = numbers.iter().map(error).sum::<f64>() / 5e4;
        // Panter and Dite: (∫ p^(1/3))³ / 12 / 256², where x³ of uniform x has p = |v|^(−2/3) / 6.
        let integral = 2.0 * (1.0f64 / 6.0).powf(1.0 / 3.0) / (1.0 - 2.0 / 9.0);
        let best = integral.powi(3) / 12.0 / 65536.0;
        assert!(found < 1.1 * best && found > 0.7 * best, "{found:e} of {best:e}");
    }
}
