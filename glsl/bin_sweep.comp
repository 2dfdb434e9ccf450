#version 450
// variants: INDEXED=0,1
// subgroups: 4,8,16,32,64
// Grouping by sorting, first step, in one sweep over the splats in depth order: counts the tiles of
// every splat, finds its first entry by a scan with decoupled look-back (Merrill and Garland 2016,
// "Single-pass Parallel Prefix Scan with Decoupled Look-back"), and writes its entries, row by row.
// Few tiles are written by the thread of the splat, more by its subgroup, and splats with many
// tiles are left to bin_large.comp, which spreads them over the device. If the entries do not fit,
// the count is 0 and the status holds the number needed: the image then has no splats at all, never
// a few missing. Reference: pass::bin.
//
// Rows of tiles from first_row up to end_row of the image are binned; tile 0 is the first of these.
// The look-back needs no forward progress of other workgroups, as that of sort_sweep.comp.
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_arithmetic : require
#extension GL_KHR_shader_subgroup_ballot : require
#extension GL_KHR_shader_subgroup_shuffle : require
#if SUBGROUP_SIZE < 64
layout(local_size_x = 8 * SUBGROUP_SIZE) in;
#else
layout(local_size_x = 4 * SUBGROUP_SIZE) in;
#endif

layout(std430, binding = 0) readonly buffer Projected { vec4 projected[]; };  // [N, 3]
// [N] (key, splat), sorted.
layout(std430, binding = 1) readonly buffer DepthPairs { uvec2 depth_pairs[]; };
layout(std430, binding = 2) buffer Status { uint status[]; };  // [3] see FrameBuffers
// Entries, 0 if they do not fit.
layout(std430, binding = 3) writeonly buffer EntryCount { uint entry_count; };
layout(std430, binding = 4) writeonly buffer Entries { uvec2 entries[]; };  // [capacity]
// All zero at first: the next chunk, the number of large splats, the status of each chunk, and from
// first_digit on the digits of the sort.
layout(std430, binding = 5) buffer Zeros { uint zeros[]; };
// [capacity / LARGE] (splat, first entry), in any order.
layout(std430, binding = 6) writeonly buffer LargeSplats { uvec2 large_splats[]; };
#if INDEXED
layout(std430, binding = 7) writeonly buffer EntrySplats { uint entry_splats[]; };  // [capacity]
// [N] entries and first entry, in depth order.
layout(std430, binding = 8) writeonly buffer TileCounts { uint tile_counts[]; };
layout(std430, binding = 9) writeonly buffer Starts { uint starts[]; };
#endif
layout(std430, binding = 10) readonly buffer SplatCount { uint count; };  // visible splats
layout(push_constant) uniform Push {
    uint tiles_x; uint first_row; uint end_row; uint capacity; uint first_digit; uint passes;
};

#include "shared/ballot.glsl"
#include "shared/look_back.glsl"
#include "shared/entries.glsl"

const uint CHUNK_SPLATS = 256;               // splats per workgroup, in depth order
const uint BATCHES = CHUNK_SPLATS / THREADS; // splats per thread
// Index in `zeros` of the status of the first chunk. A chunk has less than 2^28 entries, since an
// image has less than 2^20 tiles.
const uint CHUNK_STATUS = 2;
// 128 chunks with subgroups of 32: a large GPU runs some hundred at once.
const uint LOOKS = 4;
// A thread takes about 20 cycles per entry while its whole subgroup waits; the subgroup takes some
// hundred per splat. Reasoned, not tuned.
const uint WIDE = 32;
// More rows than this are counted by the subgroup.
const int TALL = 8;
// More tiles than this would keep one workgroup busy after the others are done: the splats nearest
// to the camera are in one chunk. Fewer than 65535 rounds of lavapipe's loops per thread.
const uint LARGE = 256;

shared uint next_chunk;
shared uint chunk_start; // entries of all preceding chunks
shared uint subgroup_counts[SUBGROUPS];

// Sum over the subgroup, COUNT_MASK where it is larger than any list.
uint saturated_sum(uint value) {
    uint sum = subgroupAdd(value);
    return subgroupAdd(float(value)) < 1e9 ? sum : COUNT_MASK;
}

// Number of tiles of the splats of a subgroup, one per lane.
uint tiles_of(uint splat, Ellipse e) {
    bool tall = e.last_row - e.first_row >= TALL;
    uint sum = 0u;
    if (!tall) {
        for (int row = e.first_row; row <= e.last_row; row++) sum += width_of(interval_of(e, row, tiles_x));
    }
    for (LaneSet left = lanes_where(tall); !is_empty(left); left = without_lowest(left)) {
        uint leader = lowest(left);
        Ellipse other = ellipse_of(subgroupShuffle(splat, leader), first_row, end_row, tiles_x);
        uint part = 0u;
        int first = other.first_row + int(gl_SubgroupInvocationID);
        for (int row = first; row <= other.last_row; row += SUBGROUP_SIZE) {
            part += width_of(interval_of(other, row, tiles_x));
        }
        uint total = subgroupAdd(counted(part));
        if (gl_SubgroupInvocationID == leader) sum = total;
    }
    return sum;
}

Ellipse ellipse_at(uint rank, out uint splat) {
    splat = rank < count ? depth_pairs[rank].y : 0u;
    Ellipse e = ellipse_of(splat, first_row, end_row, tiles_x);
    if (rank >= count) e.last_row = -1;
    return e;
}

// Aggregate of a preceding chunk, which is always full.
uint count_chunk(uint chunk) {
    uint sum = 0u, splat;
    for (uint i = gl_SubgroupInvocationID; i < CHUNK_SPLATS; i += SUBGROUP_SIZE) {
        Ellipse e = ellipse_at(chunk * CHUNK_SPLATS + i, splat);
        sum += tiles_of(splat, e);
    }
    return subgroupAdd(counted(sum));
}

// Entries of all chunks before `chunk`, by one subgroup that looks at LOOKS for each of its lanes
// at once.
uint look_back(uint chunk) {
    uint lane = gl_SubgroupInvocationID;
    uint sum = 0u, end = chunk, spins = 0u; // `sum` has the chunks from `end` on
    bool done = end == 0u;
    while (!done) {
        uint seen[LOOKS];
        [[unroll]] for (uint k = 0u; k < LOOKS; k++) {
            uint back = k * SUBGROUP_SIZE + lane;
            seen[k] = FLAG_INCLUSIVE; // before the first chunk
            if (back < end) seen[k] = atomicOr(zeros[CHUNK_STATUS + end - 1u - back], 0u);
        }
        uint used = 0u;
        bool published = true;
        [[unroll]] for (uint k = 0u; k < LOOKS; k++) {
            if (published && !done) { // of the whole subgroup
                LaneSet inclusive = lanes_where((seen[k] & FLAG_INCLUSIVE) != 0u);
                LaneSet missing = lanes_where(seen[k] == 0u);
                uint nearest = is_empty(inclusive) ? SUBGROUP_SIZE : lowest(inclusive);
                uint gap = is_empty(missing) ? SUBGROUP_SIZE : lowest(missing);
                done = nearest < gap;
                uint here = done ? nearest + 1u : gap;
                sum = min(sum + saturated_sum(lane < here ? seen[k] & COUNT_MASK : 0u), COUNT_MASK);
                published = here == SUBGROUP_SIZE;
                used += here;
            }
        }
        spins = used > 0u ? 0u : spins + 1u;
        if (spins > MAX_SPINS) {
            sum = min(sum + count_chunk(end - 1u), COUNT_MASK);
            used = 1u;
            spins = 0u;
        }
        end -= min(used, end);
        done = done || end == 0u;
    }
    return sum;
}

void main() {
    uint lane = gl_SubgroupInvocationID;
    uint subgroup = gl_SubgroupID; // a device may assign threads to subgroups in any order
    uint thread = subgroup * SUBGROUP_SIZE + lane;
    if (gl_LocalInvocationID.x == 0u) next_chunk = atomicAdd(zeros[0], 1u);
    clear_digits(thread);
    barrier();
    uint chunk = next_chunk, chunks = max((count + CHUNK_SPLATS - 1u) / CHUNK_SPLATS, 1u);
    if (chunk >= chunks) return;

    Ellipse ellipses[BATCHES];
    uint splats[BATCHES], counts[BATCHES], before[BATCHES];
    uint sum = 0u;
    uint first_rank = chunk * CHUNK_SPLATS + subgroup * BATCHES * SUBGROUP_SIZE + lane;
    for (uint b = 0u; b < BATCHES; b++) {
        ellipses[b] = ellipse_at(first_rank + b * SUBGROUP_SIZE, splats[b]);
        counts[b] = tiles_of(splats[b], ellipses[b]);
        before[b] = sum + subgroupExclusiveAdd(counts[b]);
        sum += subgroupAdd(counts[b]);
    }
    if (lane == 0u) subgroup_counts[subgroup] = sum;
    barrier();
    uint start = 0u, total = 0u;
    for (uint s = 0u; s < SUBGROUPS; s++) {
        if (s < subgroup) start += subgroup_counts[s];
        total += subgroup_counts[s];
    }
    if (subgroup == 0u) {
        uint here = CHUNK_STATUS + chunk;
        if (lane == 0u) atomicOr(zeros[here], (chunk == 0u ? FLAG_INCLUSIVE : FLAG_AGGREGATE) | total);
        uint prefix = look_back(chunk);
        uint inclusive = min(prefix + total, COUNT_MASK);
        if (lane == 0u) {
            // The larger flag replaces the smaller one.
            atomicMax(zeros[here], FLAG_INCLUSIVE | inclusive);
            chunk_start = prefix;
            if (chunk == chunks - 1u) {
                bool fits = inclusive <= capacity;
                status[0] = inclusive;
                entry_count = fits ? inclusive : 0u;
                if (!fits) status[1] = max(status[1], inclusive);
            }
        }
    }
    barrier();
    start += chunk_start;

    for (uint b = 0u; b < BATCHES; b++) {
        uint first = start + before[b];
        if (counts[b] <= WIDE) {
            Ellipse e = ellipses[b];
            int row = e.first_row - 1;
            ivec2 interval = ivec2(0, -1);
            for (uint k = 0u; k < counts[b]; k++) {
                while (interval.x > interval.y && row < e.last_row) {
                    interval = interval_of(e, ++row, tiles_x);
                }
                write_entry(first + k, row, interval.x++, splats[b]);
            }
        } else if (counts[b] > LARGE) {
            uint place = atomicAdd(zeros[1], 1u);
            if (place < capacity / LARGE) large_splats[place] = uvec2(splats[b], first);
        }
        bool wide = counts[b] > WIDE && counts[b] <= LARGE;
        for (LaneSet left = lanes_where(wide); !is_empty(left); left = without_lowest(left)) {
            uint leader = lowest(left);
            uint splat = subgroupShuffle(splats[b], leader), at = subgroupShuffle(first, leader);
            write_by_subgroup(splat, at, 0u, 1u);
        }
#if INDEXED
        uint rank = first_rank + b * SUBGROUP_SIZE;
        if (rank < count) {
            tile_counts[rank] = counts[b];
            starts[rank] = first;
        }
#endif
    }
    barrier();
    add_digits(thread);
}
