// `condition ? yes : no` without a branch: both are computed. GLSL's own operator becomes a branch where one of them is more than
// a name, and so does &&. SwiftShader's compiler takes time and memory that double with every branch of a loop.
#ifndef SELECT
#define SELECT
float select(bool condition, float yes, float no) { return mix(no, yes, condition); }
uint select(bool condition, uint yes, uint no) { return mix(no, yes, condition); }
int select(bool condition, int yes, int no) { return mix(no, yes, condition); }
vec2 select(bool condition, vec2 yes, vec2 no) { return mix(no, yes, bvec2(condition)); }
vec3 select(bool condition, vec3 yes, vec3 no) { return mix(no, yes, bvec3(condition)); }
bool both(bool a, bool b) { return all(bvec2(a, b)); }
#endif
