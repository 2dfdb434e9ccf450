//! Least time of each pass, second version (`floor v2`): bytes that must move, instruction slots
//! and exponentials of the pairs in rows that a splat reaches, launches that wait for each other.
//!
//! Floor v1 ([`super::model`]) counts an exponential as one of two operations of a fused
//! multiply-add, a comparison as half of one, only blended pairs, and projected splats once per
//! entry of a list, although caches hold them. It is printed beside this one for one release.
//!
//! A slot is one instruction of one lane, as a fused multiply-add, comparison or selection.
//! Exponentials include divisions and roots.
use super::model::PassWork;
use crate::gpu::shaders;
use crate::pass::fused_update;
use serde::{Deserialize, Serialize};

/// Limits of the device that bound a pass.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Limits {
    /// Bytes read plus bytes written by a copy, per second.
    pub bytes_per_second: f64,
    /// Fused multiply-adds per second.
    pub slots_per_second: f64,
    /// Exponentials per second.
    pub exponentials_per_second: f64,
    /// Seconds from a launch to the next one that waits for it.
    pub launch_seconds: f64,
}

/// Least work of a pass.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Least {
    /// Bytes that must be read or written.
    pub bytes: f64,
    /// Instructions, each counted per lane.
    pub slots: f64,
    /// Exponentials, divisions and roots.
    pub exponentials: f64,
    /// Launches that depend on each other.
    pub launches: f64,
}

impl std::ops::Add for Least {
    type Output = Least;
    fn add(self, other: Least) -> Least {
        Least {
            bytes: self.bytes + other.bytes,
            slots: self.slots + other.slots,
            exponentials: self.exponentials + other.exponentials,
            launches: self.launches + other.launches,
        }
    }
}

impl Limits {
    /// Least milliseconds for this much work.
    pub fn ms(&self, work: &Least) -> f64 {
        let arithmetic =
            work.slots / self.slots_per_second + work.exponentials / self.exponentials_per_second;
        let launches = work.launches * self.launch_seconds;
        1e3 * ((work.bytes / self.bytes_per_second).max(arithmetic) + launches)
    }
}

/// Geometry and opacity of a splat, numbers.
const GEOMETRY: f64 = 11.0;
/// A projected splat, bytes.
const PROJECTED: f64 = 4.0 * shaders::shared::layout::PROJECTED_FLOATS as f64;
/// Gradient by a projected splat, bytes.
const GRADIENT: f64 = 4.0 * shaders::shared::layout::GRADIENT_FLOATS as f64;
/// (key, value) or (splat, entry), bytes.
const PAIR: f64 = 8.0;
/// Digits of nine bits: depths relative to the nearest span 27 bits.
const SORT_PASSES: f64 = 3.0;
/// Columns of a tile.
const EDGE: f64 = shaders::shared::layout::TILE as f64;
/// Terms of the power that the rows of a tile share, per column.
const COLUMN: f64 = 4.0;
/// Power (2), threshold, limit of alpha, selection, weight, transmittance, threshold, two
/// selections, sign.
const WEIGH: f64 = 11.0;
/// 1 − alpha (1), where no gradient flows (2), sum behind (1), gradient by the power (2) and its
/// moments (4).
const WEIGH_BACK: f64 = 10.0;
/// Blurs of 2 × 11 taps for SSIM and its derivatives, and the arithmetic between them.
const SSIM: f64 = 7.0 * 22.0 + 20.0;
/// Adam's arithmetic per number.
const ADAM: f64 = 8.0;

impl PassWork {
    /// Least work of a pass by its name in a recording; `None` for passes without a model.
    pub fn least(&self, pass: &str) -> Option<Least> {
        let PassWork { splats: n, sh, features: d, pixels, intersections, in_rows, fused, .. } = *self;
        let (colour, channels) = (3.0 * sh, 4.0 + d);
        let parameters = GEOMETRY + colour;
        let work =
            |bytes, slots, exponentials, launches| Some(Least { bytes, slots, exponentials, launches });
        let shown = n * (PROJECTED + 4.0 * d);
        let update = n * ADAM * parameters;
        let gradients = (n * (350.0 + 2.0 * colour), 6.0 * n);
        match pass {
            "projection" => {
                let bytes = n * (4.0 * parameters + 8.0 * d + PROJECTED + PAIR);
                work(bytes, n * (150.0 + colour + 2.0 * d), 5.0 * n, 1.0)
            }
            "depth sort" => work(n * 2.0 * PAIR * SORT_PASSES, 8.0 * n * SORT_PASSES, 0.0, 1.0 + SORT_PASSES),
            // An entry is written, read and written to its tile.
            "binning" => {
                let bytes = n * (PAIR + PROJECTED) + 3.0 * PAIR * intersections;
                work(bytes, 60.0 * n + 10.0 * intersections, 3.0 * n, 3.0)
            }
            "raster forward" => {
                let bytes = shown + PAIR * intersections + 4.0 * pixels * (channels + 1.0);
                let slots = COLUMN * EDGE * intersections + in_rows * (WEIGH + channels);
                work(bytes, slots, in_rows, 1.0)
            }
            "raster backward" => {
                let sums = shown + 2.0 * n * (GRADIENT + 4.0 * d);
                let bytes = sums + PAIR * intersections + 8.0 * pixels * (channels + 1.0);
                let entry = EDGE * (COLUMN + 3.0 + 6.0 + channels);
                let slots = entry * intersections + in_rows * (WEIGH + WEIGH_BACK + 2.0 * channels);
                work(bytes, slots, 2.0 * in_rows, 1.0)
            }
            "SSIM + L1" => work(36.0 * pixels, 3.0 * pixels * SSIM, 6.0 * pixels, 2.0),
            "feature loss" => work(pixels * (8.0 * d + 8.0), 3.0 * pixels * d, 0.0, 1.0),
            "regularisers" if fused => work(8.0 * pixels, 6.0 * pixels, 0.0, 1.0),
            "regularisers" => work(8.0 * pixels + 36.0 * n, 6.0 * pixels + 10.0 * n, 3.0 * n, 1.0),
            // Gradients need not leave the pass: those of two passes are not counted.
            "projection backward" => work(n * (4.0 * parameters + GRADIENT), gradients.0, gradients.1, 1.0),
            fused_update::PASS => work(
                n * (16.0 * parameters + GRADIENT),
                gradients.0 + update,
                gradients.1 + 2.0 * n * parameters,
                1.0,
            ),
            "feature backward" => work(8.0 * n * d, 3.0 * n * d, 0.0, 1.0),
            "Adam" => {
                // With the fused update only the features have a pass of their own.
                let numbers = n * (if fused { 0.0 } else { parameters } + d);
                work(12.0 * numbers + 4.0 * n * d, ADAM * numbers, 2.0 * numbers, 1.0)
            }
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const WORK: PassWork = PassWork {
        splats: 1e5,
        sh: 1.0,
        features: 0.0,
        pixels: 3e5,
        intersections: 5e5,
        blended: 1e7,
        in_rows: 1.6e7,
        fused: false,
    };

    #[test]
    fn least_time_is_the_larger_of_memory_and_arithmetic() {
        let limits = Limits {
            bytes_per_second: 1e9,
            slots_per_second: 1e10,
            exponentials_per_second: 1e9,
            launch_seconds: 1e-3,
        };
        let arithmetic = Least { bytes: 1e6, slots: 2e7, exponentials: 1e6, launches: 2.0 };
        // 2 ms of slots, 1 ms of exponentials, 2 launches.
        assert!((limits.ms(&arithmetic) - 5.0).abs() < 1e-9);
        assert!((limits.ms(&Least { bytes: 7e6, ..arithmetic }) - 9.0).abs() < 1e-9);
    }

    #[test]
    fn one_pass_moves_the_bytes_of_both_without_gradients() {
        let least = |fused: bool, pass| PassWork { fused, ..WORK }.least(pass).unwrap();
        let both = [least(false, "projection backward"), least(false, "Adam")];
        let fused = least(true, fused_update::PASS);
        assert_eq!(both[0].bytes + both[1].bytes, fused.bytes);
        assert_eq!(both[0].slots + both[1].slots, fused.slots);
        assert_eq!(least(true, "Adam"), Least { launches: 1.0, ..Least::default() });
    }

    #[test]
    fn every_pass_with_an_old_floor_has_a_new_one() {
        for pass in ["projection", "depth sort", "binning", "raster forward", "SSIM + L1", "Adam"] {
            assert_eq!(WORK.of(pass).is_some(), WORK.least(pass).is_some(), "{pass}");
        }
        let more = PassWork { in_rows: 2.0 * WORK.in_rows, ..WORK };
        for pass in ["raster forward", "raster backward"] {
            let (a, b) = (WORK.least(pass).unwrap(), more.least(pass).unwrap());
            assert!(b.slots > a.slots && b.exponentials == 2.0 * a.exponentials, "{pass}");
        }
        assert_eq!(WORK.least("unknown"), None);
    }
}
