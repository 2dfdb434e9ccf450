#version 450
// subgroups: 4,8,16,32,64
// OneSweep radix sort, step 3 of 3, once per digit place (Adinets and Merrill 2022, "Onesweep: A
// Faster Least Significant Digit Radix Sort for GPUs"). Each workgroup ranks one partition tile,
// publishes its aggregate (count) of every digit, finds the exclusive prefix of every digit over
// all preceding tiles by decoupled look-back, publishes the inclusive prefix, and scatters its
// pairs in order. Every pair is read once and written once.
//
// Workgroups take tile numbers in the order in which they start, so all preceding tiles are running
// or done. Vulkan does not guarantee forward progress between workgroups, however: a running
// predecessor may stand still while this workgroup spins. After MAX_SPINS failed polls the
// workgroup therefore counts the digit of a predecessor itself.
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_ballot : require
#extension GL_KHR_shader_subgroup_shuffle : require
layout(local_size_x = 8 * SUBGROUP_SIZE) in;

layout(std430, binding = 0) readonly buffer Pairs { uvec2 pairs[]; };         // [N] (key, value)
layout(std430, binding = 1) readonly buffer Count { uint count; };            // N
layout(std430, binding = 2) readonly buffer Digits { uint digit_bases[]; };   // [passes, 256]
// [passes, stride], zero at first: the next tile number, then the status of each (tile, digit).
layout(std430, binding = 3) buffer Tiles { uint tile_status[]; };
layout(std430, binding = 4) writeonly buffer Sorted { uvec2 sorted[]; };      // [N]
layout(push_constant) uniform Push { uint pass; uint mask; uint stride; };

const uint SUBGROUPS = 8;
const uint THREADS = SUBGROUPS * SUBGROUP_SIZE;
const uint TILE = 2048;
const uint PAIRS_PER_THREAD = TILE / THREADS;
// Status of a (tile, digit): a flag and a count. The count is the aggregate of the tile, or the
// inclusive prefix over the tile and all preceding ones; 0 = not published yet.
const uint FLAG_AGGREGATE = 1u << 30, FLAG_INCLUSIVE = 2u << 30, COUNT_MASK = FLAG_AGGREGATE - 1u;

// Failed polls per digit before the predecessor is counted here. A tile takes some microseconds and
// a poll a fraction of one, so no GPU reaches this number. Lavapipe leaves the loops of a shader
// after 65535 rounds in all, which happened where the system had suspended the thread of the
// predecessor.
const uint MAX_SPINS = 1000u;

shared uint next_tile;
shared uint counters[SUBGROUPS * 256]; // per subgroup and digit: counts, then offsets in the tile
shared uint aggregates[256];
shared uint sums[2][256];
shared uint offsets[256];              // position in `sorted` minus position in the tile
shared uvec2 staged[TILE];

// Aggregate of one digit of a preceding tile, which is always full.
uint count_digit(uint tile, uint digit) {
    uint n = 0u;
    for (uint i = tile * TILE; i < (tile + 1u) * TILE; i += 8u) {
        uvec4 a = uvec4(pairs[i].x, pairs[i + 1u].x, pairs[i + 2u].x, pairs[i + 3u].x);
        uvec4 b = uvec4(pairs[i + 4u].x, pairs[i + 5u].x, pairs[i + 6u].x, pairs[i + 7u].x);
        uvec4 same = uvec4(equal(((a & mask) >> (8u * pass)) & 255u, uvec4(digit)));
        same += uvec4(equal(((b & mask) >> (8u * pass)) & 255u, uvec4(digit)));
        n += same.x + same.y + same.z + same.w;
    }
    return n;
}

void main() {
    uint thread = gl_LocalInvocationID.x;
    uint lane = gl_SubgroupInvocationID;
    uint subgroup = gl_SubgroupID; // a device may assign threads to subgroups in any order
    uint status_base = pass * stride + 1u;
    if (thread == 0u) next_tile = atomicAdd(tile_status[status_base - 1u], 1u);
    for (uint i = thread; i < SUBGROUPS * 256u; i += THREADS) counters[i] = 0u;
    barrier();
    uint tile = next_tile;
    uint first = tile * TILE;

    // Ranks among the pairs of the subgroup with the same digit, in order of index. Pairs beyond
    // the end get the last digit: they are last in order and displace no other pair.
    uvec2 own[PAIRS_PER_THREAD];
    uint ranks[PAIRS_PER_THREAD];
    // A shift by 32 is undefined, so whole words are special cases.
    uvec2 all = uvec2(SUBGROUP_SIZE < 32 ? (1u << (SUBGROUP_SIZE % 32)) - 1u : ~0u, SUBGROUP_SIZE < 64 ? 0u : ~0u);
    uvec2 before = lane < 32u ? uvec2((1u << lane) - 1u, 0u) : uvec2(~0u, (1u << (lane - 32u)) - 1u);
    for (uint i = 0u; i < PAIRS_PER_THREAD; i++) {
        uint index = first + (subgroup * PAIRS_PER_THREAD + i) * SUBGROUP_SIZE + lane;
        own[i] = index < count ? pairs[index] : uvec2(~0u);
        uint digit = index < count ? ((own[i].x & mask) >> (8u * pass)) & 255u : 255u;
        uvec2 peers = all;
        for (uint bit = 0u; bit < 8u; bit++) {
            bool set = ((digit >> bit) & 1u) != 0u;
            uvec2 setters = subgroupBallot(set).xy;
            peers &= set ? setters : ~setters;
        }
        uint rank = bitCount(peers.x & before.x) + bitCount(peers.y & before.y);
        uint earlier = 0u;
        if (rank == 0u) earlier = atomicAdd(counters[subgroup * 256u + digit], bitCount(peers.x) + bitCount(peers.y));
        uint leader = peers.x != 0u ? findLSB(peers.x) : 32u + findLSB(peers.y);
        ranks[i] = subgroupShuffle(earlier, leader) + rank;
    }
    barrier();

    // Publishes the aggregates as early as possible, then scans the counts over subgroups and
    // digits.
    for (uint digit = thread; digit < 256u; digit += THREADS) {
        uint total = 0u;
        for (uint s = 0u; s < SUBGROUPS; s++) {
            uint here = counters[s * 256u + digit];
            counters[s * 256u + digit] = total;
            total += here;
        }
        aggregates[digit] = total;
        sums[0][digit] = total;
        if (first < count) {
            atomicOr(tile_status[status_base + tile * 256u + digit],
                     tile == 0u ? FLAG_INCLUSIVE | total : FLAG_AGGREGATE | total);
        }
    }
    barrier();
    uint side = 0u;
    for (uint reach = 1u; reach < 256u; reach <<= 1u) {
        for (uint digit = thread; digit < 256u; digit += THREADS) {
            uint sum = sums[side][digit];
            if (digit >= reach) sum += sums[side][digit - reach];
            sums[1u - side][digit] = sum;
        }
        side = 1u - side;
        barrier();
    }
    for (uint digit = thread; digit < 256u; digit += THREADS) {
        uint start = sums[side][digit] - aggregates[digit];
        for (uint s = 0u; s < SUBGROUPS; s++) counters[s * 256u + digit] += start;
        uint exclusive_prefix = 0u;
        if (first < count && tile > 0u) {
            uint predecessor = tile - 1u;
            uint status = 0u;
            uint spins = 0u;
            while ((status & FLAG_INCLUSIVE) == 0u) {
                status = atomicOr(tile_status[status_base + predecessor * 256u + digit], 0u);
                if (status == 0u && ++spins > MAX_SPINS) {
                    status = count_digit(predecessor, digit) |
                             (predecessor == 0u ? FLAG_INCLUSIVE : FLAG_AGGREGATE);
                }
                if (status != 0u) {
                    exclusive_prefix += status & COUNT_MASK;
                    predecessor -= 1u;
                }
            }
            // FLAG_AGGREGATE | aggregate becomes FLAG_INCLUSIVE | (exclusive_prefix + aggregate).
            atomicAdd(tile_status[status_base + tile * 256u + digit], FLAG_AGGREGATE + exclusive_prefix);
        }
        offsets[digit] = digit_bases[pass * 256u + digit] + exclusive_prefix - start;
    }
    barrier();

    for (uint i = 0u; i < PAIRS_PER_THREAD; i++) {
        uint index = first + (subgroup * PAIRS_PER_THREAD + i) * SUBGROUP_SIZE + lane;
        uint digit = index < count ? ((own[i].x & mask) >> (8u * pass)) & 255u : 255u;
        staged[counters[subgroup * 256u + digit] + ranks[i]] = own[i];
    }
    barrier();
    for (uint position = thread; position < TILE; position += THREADS) {
        if (first + position < count) {
            uvec2 pair = staged[position];
            sorted[offsets[((pair.x & mask) >> (8u * pass)) & 255u] + position] = pair;
        }
    }
}
