#version 450
// subgroups: 4,8,16,32,64
// One-sweep radix sort, step 3 of 3, once per digit: ranks a tile of pairs, learns from the tiles before it where its
// digits begin, and writes the pairs in order, so that neighbours write neighbours. Every pair is read once and written
// once. Tiles are numbered in the order in which workgroups start, so that those before a tile are running or done; it looks
// for what they tell a while and then counts for itself, since Vulkan does not promise that they go on meanwhile.
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_ballot : require
#extension GL_KHR_shader_subgroup_shuffle : require
layout(local_size_x = 8 * SUBGROUP_SIZE) in;

layout(std430, binding = 0) readonly buffer Pairs { uvec2 pairs[]; };         // [N] (key, value)
layout(std430, binding = 1) readonly buffer Count { uint count; };            // N
layout(std430, binding = 2) readonly buffer Digits { uint digits[]; };        // [passes, 256] places
layout(std430, binding = 3) buffer Tiles { uint tiles[]; };                   // [passes, stride], zero at first: tiles begun, and what each tile tells
layout(std430, binding = 4) writeonly buffer Sorted { uvec2 sorted[]; };      // [N]
layout(push_constant) uniform Push { uint pass; uint mask; uint stride; };

const uint SUBGROUPS = 8;
const uint THREADS = SUBGROUPS * SUBGROUP_SIZE;
const uint TILE = 2048;
const uint EACH = TILE / THREADS;
// What a tile tells of a digit: its own count, or the count of all tiles up to and with it; 0 = nothing yet.
const uint OWN = 1u << 30, UP_TO_HERE = 2u << 30, VALUE = OWN - 1u;

// Looks in vain before a digit of a tile is counted here. A tile takes some microseconds and a look a fraction of one, so that no GPU
// comes near; lavapipe leaves a shader's loops after 65535 rounds in all, which it did where the system had put the other tile's thread aside.
const uint PATIENCE = 1000u;

shared uint begun;
shared uint counters[SUBGROUPS * 256]; // per subgroup: counts, then where its pairs of a digit begin among the tile's
shared uint totals[256];               // of the tile
shared uint sums[2][256];
shared uint offsets[256];              // place in `sorted` less place in the tile
shared uvec2 staged[TILE];

// Pairs of a tile before this one, which is full, that have a digit.
uint counted(uint tile, uint digit) {
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
    uint subgroup = gl_SubgroupID; // a device may deal threads to subgroups in any order
    uint told_at = pass * stride + 1u; // what the tiles of this pass tell
    if (thread == 0u) begun = atomicAdd(tiles[told_at - 1u], 1u);
    for (uint i = thread; i < SUBGROUPS * 256u; i += THREADS) counters[i] = 0u;
    barrier();
    uint tile = begun;
    uint first = tile * TILE;

    // Ranks among the subgroup's pairs of the same digit, in order of index. What lies behind the end counts as the last
    // digit: being last in order, it displaces nothing.
    uvec2 own[EACH];
    uint ranks[EACH];
    // A shift by 32 is undefined: whole words stand by themselves.
    uvec2 all = uvec2(SUBGROUP_SIZE < 32 ? (1u << (SUBGROUP_SIZE % 32)) - 1u : ~0u, SUBGROUP_SIZE < 64 ? 0u : ~0u);
    uvec2 before = lane < 32u ? uvec2((1u << lane) - 1u, 0u) : uvec2(~0u, (1u << (lane - 32u)) - 1u);
    for (uint i = 0u; i < EACH; i++) {
        uint index = first + (subgroup * EACH + i) * SUBGROUP_SIZE + lane;
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

    // Tell the counts as early as possible, then add them up: over subgroups, over digits.
    for (uint digit = thread; digit < 256u; digit += THREADS) {
        uint total = 0u;
        for (uint s = 0u; s < SUBGROUPS; s++) {
            uint here = counters[s * 256u + digit];
            counters[s * 256u + digit] = total;
            total += here;
        }
        totals[digit] = total;
        sums[0][digit] = total;
        if (first < count) atomicOr(tiles[told_at + tile * 256u + digit], tile == 0u ? UP_TO_HERE | total : OWN | total);
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
        uint start = sums[side][digit] - totals[digit];
        for (uint s = 0u; s < SUBGROUPS; s++) counters[s * 256u + digit] += start;
        uint earlier = 0u;
        if (first < count && tile > 0u) {
            uint look = tile - 1u;
            uint told = 0u;
            uint vain = 0u;
            while ((told & UP_TO_HERE) == 0u) {
                told = atomicOr(tiles[told_at + look * 256u + digit], 0u);
                if (told == 0u && ++vain > PATIENCE) told = counted(look, digit) | (look == 0u ? UP_TO_HERE : OWN);
                if (told != 0u) {
                    earlier += told & VALUE;
                    look -= 1u;
                }
            }
            // OWN | total becomes UP_TO_HERE | earlier + total.
            atomicAdd(tiles[told_at + tile * 256u + digit], OWN + earlier);
        }
        offsets[digit] = digits[pass * 256u + digit] + earlier - start;
    }
    barrier();

    for (uint i = 0u; i < EACH; i++) {
        uint index = first + (subgroup * EACH + i) * SUBGROUP_SIZE + lane;
        uint digit = index < count ? ((own[i].x & mask) >> (8u * pass)) & 255u : 255u;
        staged[counters[subgroup * 256u + digit] + ranks[i]] = own[i];
    }
    barrier();
    for (uint place = thread; place < TILE; place += THREADS) {
        if (first + place < count) {
            uvec2 pair = staged[place];
            sorted[offsets[((pair.x & mask) >> (8u * pass)) & 255u] + place] = pair;
        }
    }
}
