//! Options of dense stereo.
use super::matcher::MAX_SOURCES;
use crate::preset::Preset;

/// Options of dense stereo; the defaults are for 3–4 photos of about 640 × 480.
#[derive(Clone, Debug, PartialEq)]
pub struct StereoOptions {
    /// Source views per reference view, at most 4.
    pub sources: usize,
    /// Inverse depths of the initial sweep at the coarsest resolution.
    pub planes: u32,
    /// Photometric propagation rounds at the coarsest resolution.
    pub coarse_rounds: u32,
    /// Rounds with the geometric term, one entry per resolution, coarsest first.
    pub rounds: Vec<u32>,
    /// Weight of the geometric term per pixel of forward–backward reprojection error.
    pub geometric: f32,
    /// Weight of the difference to the neighbours' depth, which extends planes over weak texture.
    pub smoothness: f32,
    /// Seed of the hashed random numbers.
    pub seed: u32,
    /// Most bytes of one binding: larger photos are matched at half their size, or less.
    pub binding: u64,
}

impl Default for StereoOptions {
    fn default() -> Self {
        StereoOptions {
            sources: MAX_SOURCES,
            planes: 48,
            coarse_rounds: 6,
            rounds: vec![4, 4, 3],
            // 0.1 per pixel, saturating at 3 px, is the strength of ACMM.
            geometric: 0.1,
            // A fully different neighbourhood costs as much as 0.1 of correlation, less than real
            // texture. On dark photos of a room (dining) 0.05 leaves 21 % and 0.4 20 % of the
            // pixels wrong by a tenth, 0.1 leaves 18 %.
            smoothness: 0.1,
            seed: 1,
            // Vulkan's required minimum of `maxStorageBufferRange`.
            binding: 1 << 27,
        }
    }
}

impl StereoOptions {
    /// The options with the seed of a run mixed in; run seed 0 changes nothing.
    pub fn seeded(mut self, run: u64) -> StereoOptions {
        // The seed increases with every sweep, so the seeds of runs must lie far apart: the upper
        // half of a product with 2^64 / φ.
        self.seed ^= (run.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 32) as u32;
        self
    }

    /// Options of a preset. A draft has one round at the finest resolution: three take three times
    /// as long and gain 0.1 dB on breakfast, while depth at half the photos' size loses 1.4 dB.
    pub fn preset(preset: Preset) -> StereoOptions {
        let full = StereoOptions::default();
        match preset {
            Preset::Draft => StereoOptions { rounds: vec![4, 4, 1], ..full },
            Preset::Default | Preset::Paper => full,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn seeded_keeps_default_for_seed_0() {
        let seed_of = |run| StereoOptions::default().seeded(run).seed;
        assert_eq!(seed_of(0), StereoOptions::default().seed);
        let mut all: Vec<u32> = (0..100).map(seed_of).collect();
        all.sort_unstable();
        // A run increases its seed by some hundred.
        assert!(all.windows(2).all(|w| w[1] - w[0] > 10_000), "{all:?}");
    }
}
