//! Memory of the tile lists of [`super::bin`].
use super::frame::GradientReduction;
use super::scan::Scan;
use super::sort::{Sort, SortAlgorithm};
use crate::Result;
use crate::gpu::{Buffer, Device, KernelVariant, LOOP_ROUNDS, VariantPair, shaders};

/// Tile edge, pixels. Tiles of 8 evaluate 2.9 times the pairs that they blend, tiles of 16 six
/// times (measured on the seeded scene).
pub const TILE: u32 = shaders::shared::layout::TILE as u32;

/// Method that turns entries in splat order into lists per tile.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TileBinning {
    /// A counter per (tile, lane): little work, but few lanes only.
    Counting,
    /// A radix sort by tile: any number of lanes.
    Sorting,
}

impl TileBinning {
    /// The faster method for the device, unless it is disabled.
    pub fn of(device: &Device) -> TileBinning {
        match VariantPair::LISTS.chosen(device.info()) {
            KernelVariant::CountedLists => TileBinning::Counting,
            _ => TileBinning::Sorting,
        }
    }
}

/// Tile lists of one frame, with the scratch buffers of the binning.
pub(super) struct TileLists {
    /// [tiles + 1] starts of the lists.
    pub ranges: Buffer<u32>,
    /// [capacity] (entry, splat), grouped by tile, nearest first; without entries, the sorted
    /// `entries` themselves, (tile, splat).
    pub splats: Buffer<u32>,
    /// [N] number of entries of each splat, in depth order, where a pass needs it.
    pub counts: Buffer<u32>,
    /// [N] first entry of each splat, in depth order, where a pass needs it.
    pub starts: Buffer<u32>,
    /// [1] entries of this frame, 0 when they did not fit.
    pub entry_count: Buffer<u32>,
    /// Most entries.
    pub capacity: usize,
    /// Most tiles.
    tiles: u32,
    pub entries: Buffer<u32>,
    pub group: Group,
}

pub(super) enum Group {
    Counting(Counting),
    Sorting(Sorting),
}

/// Scratch buffers of [`TileBinning::Counting`].
pub(super) struct Counting {
    pub scan: Scan,
    /// [tiles, lanes].
    pub counters: Buffer<u32>,
    /// [lanes] first entry of each lane.
    pub lane_starts: Buffer<u32>,
    pub lanes: u32,
}

/// Scratch buffers of [`TileBinning::Sorting`].
pub(super) struct Sorting {
    /// [capacity / LARGE] (splat, first entry).
    pub large_splats: Buffer<u32>,
    /// [capacity] splat of each entry, where lists have entries.
    pub entry_splats: Buffer<u32>,
    /// Its zeros begin with those of `glsl/bin_sweep.comp`.
    pub sort: Sort,
}

/// Splats per workgroup of `glsl/bin_sweep.comp`.
pub(super) const CHUNK_SPLATS: usize = shaders::bin_sweep::CHUNK_SPLATS as usize;

/// Most entries and splats of a lane of [`TileBinning::Counting`]: its loop also visits a few rows
/// without entries.
const SHARE: usize = LOOP_ROUNDS / 2;

/// Longest tile list within [`LOOP_ROUNDS`]: a round per splat and, at subgroups of four, up to
/// half as many for batches of splats.
pub(super) const LONGEST_LIST: u32 = 40_000;

impl TileLists {
    /// Allocates for `capacity` entries of up to `splats` splats on `tiles` tiles.
    pub fn new(
        device: &Device,
        grouping: TileBinning,
        summation: GradientReduction,
        splats: usize,
        tiles: usize,
        capacity: usize,
    ) -> Result<TileLists> {
        // Sums of the atomics need no entries.
        let indexed = grouping == TileBinning::Counting || summation == GradientReduction::Entries;
        let if_indexed = |count: usize| if indexed { count } else { 1 };
        let name = if indexed { "entries" } else { "tile_splats" };
        let entries = device.buffer::<u32>(name, 2 * capacity)?;
        let group = match grouping {
            TileBinning::Counting => {
                let lanes = counting_lanes(tiles, capacity + splats, device.info().max_storage_range);
                let counters = device.buffer::<u32>("tile counters", tiles * lanes as usize)?;
                let lane_starts = device.buffer::<u32>("lane starts", lanes as usize)?;
                Group::Counting(Counting { scan: Scan::new(device)?, counters, lane_starts, lanes })
            }
            TileBinning::Sorting => {
                let chunks = splats.div_ceil(CHUNK_SPLATS).max(1);
                let room = shaders::bin_sweep::CHUNK_STATUS as usize + chunks;
                let large = 2 * (capacity / shaders::bin_sweep::LARGE as usize).max(1);
                Group::Sorting(Sorting {
                    large_splats: device.buffer::<u32>("large splats", large)?,
                    entry_splats: device.buffer::<u32>("entry splats", if_indexed(capacity))?,
                    sort: Sort::with_room(device, capacity, SortAlgorithm::of(device), room)?,
                })
            }
        };
        Ok(TileLists {
            ranges: device.buffer::<u32>("tile_ranges", tiles + 1)?,
            splats: match indexed {
                true => device.buffer::<u32>("tile_splats", 2 * capacity)?,
                false => entries.clone(),
            },
            counts: device.buffer::<u32>("tile_counts", if_indexed(splats))?,
            starts: device.buffer::<u32>("tile_starts", if_indexed(splats))?,
            entry_count: device.buffer::<u32>("entry_count", 1)?,
            capacity,
            tiles: tiles as u32,
            entries,
            group,
        })
    }

    /// Words that must be zero before binning that is [`Lists::Cleared`]: the first ones of a
    /// buffer.
    pub fn zeros(&self) -> (&Buffer<u32>, u32) {
        match &self.group {
            // Any buffer, of which nothing is cleared.
            Group::Counting(_) => (&self.entry_count, 0),
            Group::Sorting(group) => group.sort.zeros(tile_bits(self.tiles)),
        }
    }
}

/// State of [`TileLists::zeros`] before binning.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Lists {
    /// The projection cleared them.
    Cleared,
    /// Earlier lists used them.
    Used,
}

/// Bits of a number that is at most `tiles`.
pub(super) fn tile_bits(tiles: u32) -> u32 {
    u32::BITS - tiles.leading_zeros()
}

/// Number of lanes of [`TileBinning::Counting`]. Few lanes keep a CPU device busy, and more only
/// add counters to clear and scan, unless a lane would exceed its [`SHARE`] of the `work`, entries
/// and splats.
fn counting_lanes(tiles: usize, work: usize, binding: u64) -> u32 {
    work.div_ceil(SHARE).max(64).min(most_lanes(tiles, binding)) as u32 / 8 * 8
}

/// Most lanes that memory allows: 16 M counters are 64 MiB, half of the smallest buffer limit that
/// Vulkan allows.
fn most_lanes(tiles: usize, binding: u64) -> usize {
    let counters = (binding / 4).min(1 << 24) as usize;
    (counters / tiles.max(1)).max(8) / 8 * 8
}

/// Entries that lists have room for before any frame: about five per splat lie on the seeded scene,
/// and no frame is repeated there. Large lists begin with few, since most splats of a large scene
/// are small or outside the view; they grow with the first frame that needs more.
pub(super) fn first_entries(splats: usize, tiles: usize) -> usize {
    const LARGE: usize = 1 << 24;
    (6 * splats).min(splats.max(LARGE)) + 4 * tiles
}

/// Bytes per entry of the widest list.
const ENTRY_BYTES: u64 = 8;

/// Most entries of `splats` splats that the device binds and the lanes of [`TileBinning::Counting`]
/// process; at least the splats of a lane.
pub(super) fn most_entries(device: &Device, grouping: TileBinning, splats: usize, tiles: usize) -> usize {
    let binding = device.info().max_storage_range;
    let bound = (binding / ENTRY_BYTES) as usize;
    match grouping {
        TileBinning::Counting => {
            bound.min((most_lanes(tiles, binding) * SHARE).saturating_sub(splats).max(SHARE))
        }
        TileBinning::Sorting => bound,
    }
}
