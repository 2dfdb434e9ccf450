// Entries of the tile lists, written by one thread or one subgroup per splat, with the counts of
// the digits of their tiles for the sort that follows. Needs `projected`, the push constants and,
// with INDEXED, `entry_splats`.
//
// INDEXED 0: entries are (tile, splat). INDEXED 1: entries are (tile, own index), and
// `entry_splats` holds the splat.
#include "shared/tiles.glsl"

const uint SUBGROUPS = SUBGROUP_SIZE < 64 ? 8 : 4; // per workgroup: at most 256 threads
const uint THREADS = SUBGROUPS * SUBGROUP_SIZE;

shared uint digit_counts[4 * 256]; // [passes of the sort, 256]

void clear_digits(uint thread) {
    for (uint i = thread; i < passes * 256u; i += THREADS) digit_counts[i] = 0u;
}

// Adds the counts of the workgroup to those of all, which begin at `first_digit`.
void add_digits(uint thread) {
    for (uint i = thread; i < passes * 256u; i += THREADS) {
        if (digit_counts[i] > 0u) atomicAdd(zeros[first_digit + i], digit_counts[i]);
    }
}

uint width_of(ivec2 interval) { return uint(max(interval.y - interval.x + 1, 0)); }

void write_entry(uint entry, int row, int x, uint splat) {
    if (entry >= capacity) return;
    uint tile = (uint(row) - first_row) * tiles_x + uint(x);
#if INDEXED
    entries[entry] = uvec2(tile, entry);
    entry_splats[entry] = splat;
#else
    entries[entry] = uvec2(tile, splat);
#endif
    for (uint pass = 0u; pass < passes; pass++) {
        atomicAdd(digit_counts[pass * 256u + ((tile >> (8u * pass)) & 255u)], 1u);
    }
}

// Writes a share of the entries of one splat, which begin at `at`, with a whole subgroup: every
// `parts`-th batch of SUBGROUP_SIZE entries, from number `part` on.
void write_by_subgroup(uint splat, uint at, uint part, uint parts) {
    uint lane = gl_SubgroupInvocationID;
    Ellipse e = ellipse_of(splat, first_row, end_row, tiles_x);
    for (int base = e.first_row; base <= e.last_row; base += SUBGROUP_SIZE) {
        int row = base + int(lane);
        ivec2 interval = interval_of(e, row, tiles_x);
        uint width = row <= e.last_row ? width_of(interval) : 0u;
        uint begin = subgroupExclusiveAdd(width), sum = subgroupAdd(width);
        for (uint first = part * SUBGROUP_SIZE; first < sum; first += parts * SUBGROUP_SIZE) {
            // The last row that begins at or before the entry contains it.
            uint own = first + lane, holder = 0u;
            for (uint reach = SUBGROUP_SIZE / 2; reach > 0u; reach >>= 1u) {
                if (subgroupShuffle(begin, holder + reach) <= own) holder += reach;
            }
            uint from = min(holder, SUBGROUP_SIZE - 1u); // as `counted` in shared/look_back.glsl
            int x = subgroupShuffle(interval.x, from) + int(own - subgroupShuffle(begin, from));
            if (own < sum) write_entry(at + own, base + int(from), x, splat);
        }
        at += sum;
    }
}
