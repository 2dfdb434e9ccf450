// Sets of lanes of a subgroup: one word where a word has room for all of them, which halves the
// work with each set. Needs GL_KHR_shader_subgroup_ballot.
#if SUBGROUP_SIZE <= 32
#define LaneSet uint
LaneSet lanes_where(bool condition) { return subgroupBallot(condition).x; }
bool is_empty(LaneSet set) { return set == 0u; }
uint size_of(LaneSet set) { return uint(bitCount(set)); }
uint lowest(LaneSet set) { return uint(findLSB(set)); }
LaneSet without_lowest(LaneSet set) { return set & (set - 1u); }
// A shift by 32 is undefined, so whole words are special cases.
LaneSet all_lanes() { return SUBGROUP_SIZE < 32 ? (1u << (SUBGROUP_SIZE % 32)) - 1u : ~0u; }
LaneSet lanes_before(uint lane) { return (1u << lane) - 1u; }
#else
#define LaneSet uvec2
LaneSet lanes_where(bool condition) { return subgroupBallot(condition).xy; }
bool is_empty(LaneSet set) { return (set.x | set.y) == 0u; }
uint size_of(LaneSet set) { return uint(bitCount(set.x) + bitCount(set.y)); }
uint lowest(LaneSet set) { return set.x != 0u ? uint(findLSB(set.x)) : 32u + uint(findLSB(set.y)); }
LaneSet without_lowest(LaneSet set) {
    return set.x != 0u ? uvec2(set.x & (set.x - 1u), set.y) : uvec2(0u, set.y & (set.y - 1u));
}
LaneSet all_lanes() { return uvec2(~0u); }
LaneSet lanes_before(uint lane) {
    return lane < 32u ? uvec2((1u << lane) - 1u, 0u) : uvec2(~0u, (1u << (lane - 32u)) - 1u);
}
#endif
