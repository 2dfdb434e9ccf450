// `raster.glsl` with a batch in the registers of the lanes at every size of a subgroup, for shaders
// that reduce over the lanes anyway.
#define SHARED_SPLATS 0
#include "shared/raster.glsl"
#define HALF (SUBGROUP_SIZE / 2)
