#version 450
// subgroups: 4,8,16,32,64
// OneSweep radix sort, step 2 of 2, once per digit place (Adinets and Merrill 2022, "Onesweep: A
// Faster Least Significant Digit Radix Sort for GPUs"). Each workgroup ranks one partition tile,
// publishes its aggregate (count) of every digit, finds the exclusive prefix of every digit over
// all preceding tiles by decoupled look-back, publishes the inclusive prefix, and scatters its
// pairs in order. Every pair is read once and written once.
//
// Workgroups take tile numbers in the order in which they start, so all preceding tiles are running
// or done. Vulkan does not guarantee forward progress between workgroups, however: a running
// predecessor may stand still while this workgroup spins. After MAX_SPINS failed polls the
// workgroup therefore counts the digit of a predecessor itself.
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_arithmetic : require
#extension GL_KHR_shader_subgroup_ballot : require
#extension GL_KHR_shader_subgroup_shuffle : require
layout(local_size_x = 8 * SUBGROUP_SIZE) in;

layout(std430, binding = 0) readonly buffer Pairs { uvec2 pairs[]; };         // [N] (key, value)
layout(std430, binding = 1) buffer Counts { uint counts[]; };                 // see pass::sort
// From first_digit on: [4, 256] counts of the digits, and for each pass [stride], zero at first: the
// next tile number, then the status of each (tile, digit).
layout(std430, binding = 2) buffer Zeros { uint zeros[]; };
layout(std430, binding = 3) writeonly buffer Sorted { uvec2 sorted[]; };      // [N]
layout(push_constant) uniform Push { uint pass; uint mask; uint first_digit; uint stride; uint drop; };

#include "shared/ballot.glsl"
#include "shared/look_back.glsl"

const uint SUBGROUPS = 8;
const uint THREADS = SUBGROUPS * SUBGROUP_SIZE;
const uint TILE = 2048;
const uint PAIRS_PER_THREAD = TILE / THREADS;
const uint DIGITS_PER_THREAD = (255u + THREADS) / THREADS;
// A thread polls several predecessors at once, since one poll after the other would wait for memory
// each time: tiles that all run at once publish their aggregates at about the same time. Polls are
// atomic accesses, so that the more tiles there are, the fewer each one polls.
const uint LEAST_POLLS = 4, MOST_POLLS = 16, ALL_POLLS = 4096;

shared uint next_tile;
shared uint counters[SUBGROUPS * 256]; // per subgroup and digit: counts, then offsets in the tile
shared uvec2 chunk_sums[256 / SUBGROUP_SIZE]; // counts of SUBGROUP_SIZE digits, here and everywhere
shared uint offsets[256];              // position in `sorted` minus position in the tile
shared uvec2 staged[TILE];

uint digit_of(uint key) { return ((key & mask) >> (8u * pass)) & 255u; }

bool is_kept(uint key) { return drop == 0u || (key & mask) != mask; }

// Aggregate of one digit of a preceding tile, which is always full. Dropped pairs have the last
// digit.
uint count_digit(uint tile, uint digit) {
    uint n = 0u;
    for (uint i = tile * TILE; i < (tile + 1u) * TILE; i += 8u) {
        uvec4 a = uvec4(pairs[i].x, pairs[i + 1u].x, pairs[i + 2u].x, pairs[i + 3u].x);
        uvec4 b = uvec4(pairs[i + 4u].x, pairs[i + 5u].x, pairs[i + 6u].x, pairs[i + 7u].x);
        uvec4 same = uvec4(equal(((a & mask) >> (8u * pass)) & 255u, uvec4(digit)));
        same += uvec4(equal(((b & mask) >> (8u * pass)) & 255u, uvec4(digit)));
        if (drop != 0u) {
            same -= uvec4(equal(a & mask, uvec4(mask))) * uint(digit == 255u);
            same -= uvec4(equal(b & mask, uvec4(mask))) * uint(digit == 255u);
        }
        n += same.x + same.y + same.z + same.w;
    }
    return n;
}

// Count of a digit in all tiles before `tile`; `statuses` is the index of that of the first tile.
uint look_back(uint statuses, uint tile, uint digit, uint polls) {
    uint sum = 0u, end = tile, spins = 0u; // `sum` has the tiles from `end` on
    bool done = end == 0u;
    while (!done) {
        uint seen[MOST_POLLS];
        [[unroll]] for (uint k = 0u; k < MOST_POLLS; k++) {
            seen[k] = k < end ? 0u : FLAG_INCLUSIVE; // not seen, or before the first tile
            if (k < min(end, polls)) seen[k] = atomicOr(zeros[statuses + (end - 1u - k) * 256u + digit], 0u);
        }
        uint used = 0u;
        bool published = true;
        [[unroll]] for (uint k = 0u; k < MOST_POLLS; k++) {
            published = published && seen[k] != 0u;
            if (published && !done) {
                sum += seen[k] & COUNT_MASK;
                used++;
                done = (seen[k] & FLAG_INCLUSIVE) != 0u;
            }
        }
        spins = used > 0u ? 0u : spins + 1u;
        if (spins > MAX_SPINS) {
            sum += count_digit(end - 1u, digit);
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
    uint next = first_digit + 1024u + pass * stride, statuses = first_digit + 1024u + pass * stride + 1u;
    if (gl_LocalInvocationID.x == 0u) next_tile = atomicAdd(zeros[next], 1u);
    for (uint i = thread; i < SUBGROUPS * 256u; i += THREADS) counters[i] = 0u;
    // Read while the tile number is on its way.
    uint end = counts[drop];
    uint everywhere[DIGITS_PER_THREAD];
    for (uint k = 0u; k < DIGITS_PER_THREAD; k++) {
        everywhere[k] = zeros[first_digit + pass * 256u + min(k * THREADS + thread, 255u)];
    }
    uint polls = clamp(ALL_POLLS * TILE / max(end, 1u), LEAST_POLLS, MOST_POLLS);
    barrier();
    uint tile = next_tile;
    uint first = tile * TILE;
    if (first >= end) return;

    // Ranks among the kept pairs of the subgroup with the same digit, in order of index.
    uvec2 own[PAIRS_PER_THREAD];
    uint ranks[PAIRS_PER_THREAD];
    for (uint i = 0u; i < PAIRS_PER_THREAD; i++) {
        uint index = first + (subgroup * PAIRS_PER_THREAD + i) * SUBGROUP_SIZE + lane;
        own[i] = index < end ? pairs[index] : uvec2(~0u);
    }
    for (uint i = 0u; i < PAIRS_PER_THREAD; i++) {
        uint index = first + (subgroup * PAIRS_PER_THREAD + i) * SUBGROUP_SIZE + lane;
        uint digit = digit_of(own[i].x);
        bool kept = index < end && is_kept(own[i].x);
        LaneSet keepers = lanes_where(kept), peers = kept ? keepers : ~keepers;
        [[unroll]] for (uint bit = 0u; bit < 8u; bit++) {
            bool set = ((digit >> bit) & 1u) != 0u;
            LaneSet setters = lanes_where(set);
            peers &= set ? setters : ~setters;
        }
        uint rank = size_of(peers & lanes_before(lane));
        uint earlier = 0u;
        if (rank == 0u && kept) earlier = atomicAdd(counters[subgroup * 256u + digit], size_of(peers));
        ranks[i] = subgroupShuffle(earlier, lowest(peers)) + rank;
    }
    barrier();

    // Publishes the aggregates as early as possible, then scans the counts over subgroups and
    // digits, those of the tile and those of all pairs.
    uvec2 starts[DIGITS_PER_THREAD];
    for (uint k = 0u; k < DIGITS_PER_THREAD; k++) {
        uint digit = k * THREADS + thread;
        if (digit < 256u) { // of a whole subgroup
            uint total = 0u;
            for (uint s = 0u; s < SUBGROUPS; s++) {
                uint here = counters[s * 256u + digit];
                counters[s * 256u + digit] = total;
                total += here;
            }
            // A digit that no pair has is never used.
            if (everywhere[k] > 0u) {
                uint flag = tile == 0u ? FLAG_INCLUSIVE : FLAG_AGGREGATE;
                atomicOr(zeros[statuses + tile * 256u + digit], flag | total);
            }
            starts[k] = uvec2(subgroupExclusiveAdd(counted(total)), subgroupExclusiveAdd(everywhere[k]));
            if (lane == SUBGROUP_SIZE - 1u) {
                chunk_sums[digit / SUBGROUP_SIZE] = starts[k] + uvec2(total, everywhere[k]);
            }
        }
    }
    barrier();
    for (uint k = 0u; k < DIGITS_PER_THREAD; k++) {
        uint digit = k * THREADS + thread;
        if (digit < 256u) {
            for (uint c = 0u; c < digit / SUBGROUP_SIZE; c++) starts[k] += chunk_sums[c];
            for (uint s = 0u; s < SUBGROUPS; s++) counters[s * 256u + digit] += starts[k].x;
        }
    }
    uvec2 kept_pairs = uvec2(0u); // of the tile, and of all tiles
    for (uint c = 0u; c < 256u / SUBGROUP_SIZE; c++) kept_pairs += chunk_sums[c];
    if (drop != 0u && tile == 0u && thread == 0u) counts[0] = kept_pairs.y;
    barrier();
    // The other tiles publish their aggregates while the pairs are staged.
    for (uint i = 0u; i < PAIRS_PER_THREAD; i++) {
        uint index = first + (subgroup * PAIRS_PER_THREAD + i) * SUBGROUP_SIZE + lane;
        if (index < end && is_kept(own[i].x)) staged[counters[subgroup * 256u + digit_of(own[i].x)] + ranks[i]] = own[i];
    }
    for (uint k = 0u; k < DIGITS_PER_THREAD; k++) {
        uint digit = k * THREADS + thread;
        if (digit < 256u && everywhere[k] > 0u) {
            uint prefix = look_back(statuses, tile, digit, polls);
            // FLAG_AGGREGATE | aggregate becomes FLAG_INCLUSIVE | (prefix + aggregate).
            if (tile > 0u) atomicAdd(zeros[statuses + tile * 256u + digit], FLAG_AGGREGATE + prefix);
            offsets[digit] = starts[k].y + prefix - starts[k].x;
        }
    }
    barrier();
    for (uint position = thread; position < TILE; position += THREADS) {
        if (position < kept_pairs.x) {
            uvec2 pair = staged[position];
            sorted[offsets[digit_of(pair.x)] + position] = pair;
        }
    }
}
