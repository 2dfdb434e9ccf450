//! Stable least-significant-digit radix sort of (key, value) pairs of `u32`, eight bits at a time,
//! by two algorithms.
//!
//! [`SortAlgorithm::Chunks`] gives every lane one contiguous chunk: count digits, scan the counts
//! to positions, move. Measured on lavapipe (Mesa 22.3.6, two cores): 100k pairs by 32 bits in
//! about 3 ms, where a classic 256-thread 4-bit sort takes 180. [`SortAlgorithm::Sweep`] is
//! OneSweep (Adinets & Merrill 2022), for GPUs: one pass counts the digits of all passes, then each
//! pass reads and writes every pair once, coalesced. A partition tile finds its exclusive prefix by
//! decoupled look-back, and counts a predecessor itself where that makes no progress. Both are
//! correct on any device and any subgroup size.
use crate::Result;
use crate::gpu::{Buffer, Device, KernelVariant, LOOP_ROUNDS, Recorder, VariantPair, shaders};

/// Algorithm of the radix sort.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SortAlgorithm {
    /// A chunk of the pairs per lane, for CPU devices.
    Chunks,
    /// OneSweep, for GPUs.
    Sweep,
}

impl SortAlgorithm {
    /// The faster algorithm for the device, unless it is disabled.
    pub fn of(device: &Device) -> SortAlgorithm {
        match VariantPair::SORTS.chosen(device.info()) {
            KernelVariant::ChunkSort => SortAlgorithm::Chunks,
            _ => SortAlgorithm::Sweep,
        }
    }
}

/// Scratch space for sorting up to `capacity` pairs.
pub struct Sort {
    scratch: Buffer<u32>,
    /// Words that are zero when a sort begins: `room` words of the caller, and those of
    /// [`Work::Sweep`], from there on [4, 256] digit counts and the tile status of each pass.
    zeros: Buffer<u32>,
    room: usize,
    work: Work,
}

enum Work {
    /// [lanes, 256] digit counts.
    Chunks { histogram: Buffer<u32>, lanes: u32 },
    /// Words of the tile status of one pass.
    Sweep { stride: usize },
}

/// Bits per pass: 256 counters for each of 8 lanes are 8 KiB of shared memory.
const DIGIT_BITS: u32 = 8;
/// Most passes, for 32-bit keys.
const PASSES: usize = (u32::BITS / DIGIT_BITS) as usize;
/// Pairs per partition tile in `glsl/sort_sweep.comp`.
const TILE: usize = shaders::sort_sweep::TILE as usize;
/// Loads in flight per thread in `glsl/sort_digits.comp`.
const DIGITS_BLOCK: usize = shaders::sort_digits::BLOCK as usize;
/// Words of the digit counts.
const DIGITS: usize = PASSES << DIGIT_BITS;

/// Bits of the key that one call sorts by.
#[derive(Clone, Copy)]
struct Key {
    mask: u32,
    passes: u32,
}

impl Key {
    fn new(bits: u32) -> Key {
        let bits = bits.min(32);
        let mask = if bits == 32 { u32::MAX } else { (1 << bits) - 1 };
        Key { mask, passes: bits.div_ceil(DIGIT_BITS) }
    }

    fn is_odd(self) -> bool {
        !self.passes.is_multiple_of(2)
    }
}

/// Pairs that a sort moves.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Moves {
    /// All of the first `counts[0]`.
    All,
    /// Of the first `counts[1]` those whose key is not the largest; the first pass drops the others
    /// and writes the number of those left to `counts[0]`.
    Visible,
}

/// One pass of a sort. `drop` is 1 where the pass drops pairs.
#[derive(Clone, Copy)]
struct Place<'a> {
    counts: &'a Buffer<u32>,
    drop: u32,
    key: Key,
    pass: u32,
}

/// Work that the passes before a sort did for it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Prepared {
    /// The [`Sort::zeros`] are zero.
    Cleared,
    /// Besides, [`Sort::digits`] has the counts of the digits.
    Counted,
}

impl Sort {
    /// Allocates 8 bytes per pair and the counters, for the fastest algorithm of the device.
    pub fn new(device: &Device, capacity: usize) -> Result<Sort> {
        Self::with(device, capacity, SortAlgorithm::of(device))
    }

    /// [`Sort::new`] with a given algorithm.
    pub fn with(device: &Device, capacity: usize, algorithm: SortAlgorithm) -> Result<Sort> {
        Self::with_room(device, capacity, algorithm, 0)
    }

    /// [`Sort::with`] and `room` words before its own [`Sort::zeros`], for the passes before it.
    pub(super) fn with_room(
        device: &Device,
        capacity: usize,
        algorithm: SortAlgorithm,
        room: usize,
    ) -> Result<Sort> {
        let (work, words) = match algorithm {
            SortAlgorithm::Chunks => {
                // 256 lanes measured best on lavapipe for 100k to 1M pairs; more pairs need more
                // lanes, since its loops are limited.
                let lanes = capacity.div_ceil(LOOP_ROUNDS / 2).next_multiple_of(256).max(256);
                let histogram = device.buffer::<u32>("sort histogram", 256 * lanes)?;
                (Work::Chunks { histogram, lanes: lanes as u32 }, 0)
            }
            SortAlgorithm::Sweep => {
                let stride = 1 + 256 * capacity.div_ceil(TILE);
                (Work::Sweep { stride }, DIGITS + PASSES * stride)
            }
        };
        Ok(Sort {
            scratch: device.buffer::<u32>("sort scratch", 2 * capacity)?,
            zeros: device.buffer::<u32>("sort zeros", (room + words).max(1))?,
            room,
            work,
        })
    }

    /// Words that must be zero before a sort by `bits` bits that is [`Prepared`]: the first ones of
    /// a buffer, beginning with the caller's own.
    pub(super) fn zeros(&self, bits: u32) -> (&Buffer<u32>, u32) {
        let words = match &self.work {
            Work::Chunks { .. } => 0,
            Work::Sweep { stride } => DIGITS + Key::new(bits).passes as usize * stride,
        };
        (&self.zeros, (self.room + words) as u32)
    }

    /// Place in the zeros where a pass before the sort may count the digits of the keys, as
    /// `[passes, 256]`, and the passes; none where the algorithm does not need the counts.
    pub(super) fn digits(&self, bits: u32) -> (u32, u32) {
        let passes = match &self.work {
            Work::Chunks { .. } => 0,
            Work::Sweep { .. } => Key::new(bits).passes,
        };
        (self.room as u32, passes)
    }

    /// Records the stable sort of the first `count[0]` elements of `pairs` (`[N]` of (key, value))
    /// by the lowest `bits` bits of the key; later elements are undefined afterwards. `count` is
    /// read on the device. Reference: [`sort_pairs`].
    pub fn record(&self, rec: &mut Recorder, pairs: &Buffer<u32>, count: &Buffer<u32>, bits: u32) {
        if let Work::Sweep { .. } = &self.work {
            rec.fill(&self.zeros, 0);
        }
        let key = Key::new(bits);
        self.record_passes(rec, [pairs, &self.scratch], (count, Moves::All), key, Prepared::Cleared);
        if key.is_odd() {
            rec.copy_bytes(&self.scratch, 0, pairs, 0, pairs.bytes());
        }
    }

    /// The buffer that holds the pairs before [`Sort::record_prepared`] sorts them to `pairs`.
    pub(super) fn unsorted<'a>(&'a self, pairs: &'a Buffer<u32>, bits: u32) -> &'a Buffer<u32> {
        if Key::new(bits).is_odd() { &self.scratch } else { pairs }
    }

    /// [`Sort::record`] of `moves` after other preparation, from [`Sort::unsorted`] to `pairs`
    /// without a copy.
    pub(super) fn record_prepared(
        &self,
        rec: &mut Recorder,
        pairs: &Buffer<u32>,
        moves: (&Buffer<u32>, Moves),
        bits: u32,
        prepared: Prepared,
    ) {
        let key = Key::new(bits);
        let buffers = if key.is_odd() { [&self.scratch, pairs] } else { [pairs, &self.scratch] };
        self.record_passes(rec, buffers, moves, key, prepared);
    }

    /// Records the passes from the first of two buffers, each to the other one.
    fn record_passes(
        &self,
        rec: &mut Recorder,
        [mut from, mut to]: [&Buffer<u32>; 2],
        (counts, moves): (&Buffer<u32>, Moves),
        key: Key,
        prepared: Prepared,
    ) {
        if from.bytes().max(to.bytes()) > self.scratch.bytes() {
            rec.fail("sort: more pairs than the capacity of the sort");
        }
        if let (Work::Sweep { .. }, Prepared::Cleared) = (&self.work, prepared) {
            self.record_digits(rec, from, (counts, moves), key);
        }
        for pass in 0..key.passes {
            let drop = (moves == Moves::Visible && pass == 0).into();
            let place = Place { counts, drop, key, pass };
            match &self.work {
                Work::Chunks { histogram, lanes } => {
                    record_chunks(rec, (from, to), (histogram, *lanes), place);
                }
                Work::Sweep { stride } => self.record_sweep(rec, (from, to), *stride, place),
            }
            (from, to) = (to, from);
        }
    }

    /// Records the digit histograms of all passes.
    fn record_digits(
        &self,
        rec: &mut Recorder,
        pairs: &Buffer<u32>,
        (counts, moves): (&Buffer<u32>, Moves),
        key: Key,
    ) {
        // About a workgroup per multiprocessor of a large GPU, which adds 1024 sums at the end.
        let rounds =
            capacity(pairs).div_ceil(256 * 128).next_multiple_of(DIGITS_BLOCK).clamp(DIGITS_BLOCK, 32);
        let call = shaders::sort_digits::call(
            &shaders::sort_digits::Bindings { pairs, counts, zeros: &self.zeros },
            &shaders::sort_digits::Push {
                mask: key.mask,
                passes: key.passes,
                first_digit: self.room as u32,
                rounds: rounds as u32,
                drop: (moves == Moves::Visible).into(),
            },
        );
        rec.dispatch(call, rows_of_groups(capacity(pairs).div_ceil(256 * rounds)));
    }

    fn record_sweep(
        &self,
        rec: &mut Recorder,
        (from, to): (&Buffer<u32>, &Buffer<u32>),
        stride: usize,
        Place { counts, drop, key, pass }: Place,
    ) {
        let call = shaders::sort_sweep::call(
            &shaders::sort_sweep::Bindings { pairs: from, counts, zeros: &self.zeros, sorted: to },
            &shaders::sort_sweep::Push {
                pass,
                mask: key.mask,
                first_digit: self.room as u32,
                stride: stride as u32,
                drop,
            },
        );
        // Workgroups beyond the last tile do nothing.
        rec.dispatch(call, rows_of_groups(capacity(from).div_ceil(TILE)));
    }
}

fn record_chunks(
    rec: &mut Recorder,
    (from, to): (&Buffer<u32>, &Buffer<u32>),
    (histogram, lanes): (&Buffer<u32>, u32),
    Place { counts, drop, key, pass }: Place,
) {
    let (shift, mask) = (pass * DIGIT_BITS, key.mask);
    let groups = [lanes / shaders::sort_count::WORKGROUP[0], 1, 1];
    rec.dispatch(
        shaders::sort_count::call(
            &shaders::sort_count::Bindings { pairs: from, counts, histogram },
            &shaders::sort_count::Push { shift, mask, lanes, drop },
        ),
        groups,
    );
    rec.dispatch(
        shaders::sort_offsets::call(
            &shaders::sort_offsets::Bindings { histogram, counts },
            &shaders::sort_offsets::Push { lanes, drop },
        ),
        [1, 1, 1],
    );
    rec.dispatch(
        shaders::sort_scatter::call(
            &shaders::sort_scatter::Bindings { pairs: from, counts, histogram, sorted: to },
            &shaders::sort_scatter::Push { shift, mask, lanes, drop },
        ),
        groups,
    );
}

/// Workgroup counts for at least `groups` workgroups, and at least one, that a shader numbers row by
/// row: at most 32768 per row, since a dimension may be limited to 65535.
pub(super) fn rows_of_groups(groups: usize) -> [u32; 3] {
    let groups = groups.max(1);
    let row = groups.min(32768);
    [row as u32, groups.div_ceil(row) as u32, 1]
}

/// Number of pairs that a buffer holds.
fn capacity(pairs: &Buffer<u32>) -> usize {
    pairs.bytes() as usize / std::mem::size_of::<[u32; 2]>()
}

/// CPU reference of [`Sort::record`].
pub fn sort_pairs(pairs: &mut [[u32; 2]], bits: u32) {
    let mask = if bits >= 32 { u32::MAX } else { (1 << bits) - 1 };
    pairs.sort_by_key(|pair| pair[0] & mask);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::{Options, TestDevice, native, options, test_device};

    /// Pairs with keys below `range`, values the original index.
    fn random_pairs(n: usize, range: u64, mut seed: u64) -> Vec<[u32; 2]> {
        (0..n)
            .map(|i| {
                // Knuth's MMIX constants.
                seed = seed.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
                [((seed >> 32) % range) as u32, i as u32]
            })
            .collect()
    }

    /// Sorts by both algorithms, each compared with the reference.
    fn sorted_on_device(pairs: &[[u32; 2]], n: usize, bits: u32) -> Vec<[u32; 2]> {
        let device = test_device();
        let mut expected = pairs[..n].to_vec();
        sort_pairs(&mut expected, bits);
        for algorithm in [SortAlgorithm::Chunks, SortAlgorithm::Sweep] {
            let sorted = sorted_by(&device, pairs, n, bits, algorithm);
            let wrong = sorted.iter().zip(&expected).filter(|(a, b)| a != b).count();
            assert_eq!(wrong, 0, "{n} pairs, {bits} bits, {algorithm:?}");
        }
        expected
    }

    fn sorted_by(
        device: &Device,
        pairs: &[[u32; 2]],
        n: usize,
        bits: u32,
        algorithm: SortAlgorithm,
    ) -> Vec<[u32; 2]> {
        let buffer = device.buffer_from("pairs", pairs.as_flattened()).unwrap();
        let count = device.buffer_from("count", &[n as u32]).unwrap();
        let sort = Sort::with(device, pairs.len(), algorithm).unwrap();
        let mut rec = Recorder::new(device, "sort");
        sort.record(&mut rec, &buffer, &count, bits);
        rec.run().unwrap();
        buffer.read().unwrap().as_chunks().0.to_vec()
    }

    #[test]
    fn rows_of_groups_cover_large_scenes() {
        // Splats of a workgroup of 64, and entries of a partition tile.
        for groups in [0, 1, 32_768, 32_769, 65_536, 20_000_000usize.div_ceil(64), 200_000_000 / 256] {
            let [x, y, z] = rows_of_groups(groups);
            assert!(x as usize * y as usize >= groups.max(1) && z == 1, "{groups}");
            assert!(x <= 65_535 && y <= 65_535, "{groups}: {x} × {y}");
        }
    }

    #[test]
    fn sort_at_odd_sizes_matches_reference() {
        for n in [0, 1, 2, 7, 8, 255, 256, 257, 2048, 2049, 50_000] {
            for (bits, range) in [(32, 1u64 << 32), (16, 1 << 16), (10, 1 << 10), (24, 7), (5, 1 << 32)] {
                sorted_on_device(&random_pairs(n, range, n as u64 + u64::from(bits)), n, bits);
            }
        }
    }

    #[test]
    fn sort_of_a_part_matches_reference() {
        sorted_on_device(&random_pairs(1000, 50, 3), 600, 16);
    }

    /// The largest key, of hidden splats, leaves in the first pass, whatever its share.
    #[test]
    fn largest_keys_are_dropped() {
        let natives = TestDevice::open(&Options { natives: native::ALL, ..options(None) }).unwrap();
        let shaders = test_device();
        let ways = [
            (&shaders, SortAlgorithm::Chunks),
            (&shaders, SortAlgorithm::Sweep),
            (&natives, SortAlgorithm::Chunks),
        ];
        for (n, of_ten, bits) in
            [(0, 0, 24), (1, 10, 24), (700, 3, 24), (5000, 0, 24), (5000, 9, 16), (9000, 10, 24)]
        {
            let mask = (1 << bits) - 1;
            let mut pairs = random_pairs(n, u64::from(mask), 5);
            // Keys with the same last digit stay.
            pairs.iter_mut().step_by(3).for_each(|pair| pair[0] |= 255);
            pairs.iter_mut().filter(|pair| pair[0] == mask).for_each(|pair| pair[0] -= 256);
            pairs.iter_mut().filter(|pair| pair[1] % 10 < of_ten).for_each(|pair| pair[0] = mask);
            let mut expected: Vec<[u32; 2]> = pairs.iter().copied().filter(|pair| pair[0] != mask).collect();
            sort_pairs(&mut expected, bits);
            for (device, algorithm) in ways {
                let sort = Sort::with(device, n.max(1), algorithm).unwrap();
                let sorted = device.buffer::<u32>("pairs", 2 * n.max(1)).unwrap();
                sort.unsorted(&sorted, bits).write(pairs.as_flattened()).unwrap();
                let counts = device.buffer_from("counts", &[0, n as u32]).unwrap();
                let mut rec = Recorder::new(device, "sort");
                sort.record_prepared(&mut rec, &sorted, (&counts, Moves::Visible), bits, Prepared::Cleared);
                rec.run().unwrap();
                let left = counts.read().unwrap()[0] as usize;
                assert_eq!(left, expected.len(), "{n} pairs, {algorithm:?}");
                assert!(
                    sorted.read_range(0..2 * left).unwrap() == expected.as_flattened(),
                    "{n}, {algorithm:?}"
                );
            }
        }
    }

    #[test]
    fn sort_of_float_bits_orders_floats() {
        let depths: Vec<f32> = (0..3000).map(|i| 0.2 + ((i * 7919) % 3000) as f32 * 0.01).collect();
        let pairs: Vec<[u32; 2]> = depths.iter().enumerate().map(|(i, d)| [d.to_bits(), i as u32]).collect();
        let sorted = sorted_on_device(&pairs, pairs.len(), 32);
        assert!(sorted.windows(2).all(|w| depths[w[0][1] as usize] <= depths[w[1][1] as usize]));
    }
}
