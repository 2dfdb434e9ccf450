// `condition ? yes : no` and `a && b` without a branch: both operands are computed. GLSL's own
// operators become branches where an operand is more than a name, and the time and memory of
// SwiftShader's compiler double with every branch of a loop. Its subgroups have 4 lanes. On
// lavapipe, with 8, the passes of the rasteriser take a tenth longer without branches, so larger
// subgroups keep them.
#ifndef SELECT
#define SELECT
#if defined(SUBGROUP_SIZE) && SUBGROUP_SIZE > 4
#define select(condition, yes, no) ((condition) ? (yes) : (no))
#define both(a, b) ((a) && (b))
#else
float select(bool condition, float yes, float no) { return mix(no, yes, condition); }
uint select(bool condition, uint yes, uint no) { return mix(no, yes, condition); }
vec2 select(bool condition, vec2 yes, vec2 no) { return mix(no, yes, bvec2(condition)); }
vec3 select(bool condition, vec3 yes, vec3 no) { return mix(no, yes, bvec3(condition)); }
bool both(bool a, bool b) { return all(bvec2(a, b)); }
#endif
#endif
