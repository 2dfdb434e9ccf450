#version 450
// variants: SH_DEGREE=0,1,2,3
// Projects splats to the screen and writes their depth sort keys. Equations and reference:
// pass::project. Also clears the counters of the sort and of the tile lists that follow: a fill of
// each would be a command of its own.
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
layout(local_size_x = 64) in;

layout(std430, binding = 1) readonly buffer Means { float means[]; };  // [N, 3]
layout(std430, binding = 2) readonly buffer LogScales { float log_scales[]; };  // [N, 3]
layout(std430, binding = 3) readonly buffer Quats { vec4 quats[]; };  // [N]
layout(std430, binding = 4) readonly buffer OpacityLogits { float opacity_logits[]; };  // [N]
layout(std430, binding = 5) readonly buffer Sh { float sh[]; };  // [N, sh_stride, 3]
// [N, 3]: (u, v, A', B'), (C', log2 o, A'C' − B'²/4, 0), (r, g, b, z), with
//   log2(o e^p) = A' dx² + B' dx dy + C' dy² + log2 o
layout(std430, binding = 6) writeonly buffer Projected { vec4 projected[]; };
// [N] (sort key, splat).
layout(std430, binding = 7) writeonly buffer DepthPairs { uvec2 depth_pairs[]; };
layout(std430, binding = 8) writeonly buffer SplatCount { uint splat_count[]; };   // N, N
layout(std430, binding = 9) writeonly buffer SortZeros { uint sort_zeros[]; };     // [sort_words]
layout(std430, binding = 10) writeonly buffer ListZeros { uint list_zeros[]; };    // [list_words]
layout(push_constant) uniform Push {
    uint count; uint sh_stride; uint antialiased; uint sort_words; uint list_words;
};

#include "shared/camera.glsl"
#include "shared/cutoffs.glsl"
#include "shared/layout.glsl"
#include "shared/rows.glsl"
#include "shared/sh.glsl"
#include "shared/splat.glsl"

const float LOG2_E = 1.4426950408889634;
// Depth keys have three digits of the radix sort. They are the bits of camera z, which grow with z:
// without the last 4 in the octaves from 1/256 to 65536, without the last 9 elsewhere. Depths that
// differ by less than two millionths (60 elsewhere) keep the order of the splats.
const uint DEPTH_BITS = 24;
const uint HIDDEN_KEY = 16777215; // behind all others
const uint FINE_FIRST = 998244352, FINE_END = 1199570944; // bits of 1/256 and 65536
const uint FINE_DROPPED = 4, COARSE_DROPPED = 9;

// Whether the ellipse of a splat, where o e^p reaches the threshold, may lie on a tile of the
// image. `power` is (A', B', C'), `det` A'C' - B'^2/4.
bool is_on_image(vec2 centre, vec3 power, float det, float log2_opacity) {
    float k = (log2_opacity - LOG2_ALPHA_MIN) / det;
    vec2 reach = 1.001 * sqrt(max(-k * power.zx, vec2(0.0))) + 1.0;
    vec2 far = ceil(camera_size() / float(TILE)) * float(TILE) - 1.0;
    // Numbers that are not finite stay.
    return !(any(lessThan(centre + reach, vec2(0.0))) || any(greaterThan(centre - reach, far)));
}

uint depth_key(float z) {
    uint bits = floatBitsToUint(z);
    uint below = min(bits, FINE_FIRST), above = max(bits, FINE_END) - FINE_END;
    uint fine = clamp(bits, FINE_FIRST, FINE_END) - FINE_FIRST;
    return (below >> COARSE_DROPPED) + (fine >> FINE_DROPPED) + (above >> COARSE_DROPPED);
}

void main() {
    uint i = thread_number(), threads = 64u * gl_NumWorkGroups.x * gl_NumWorkGroups.y;
    if (i == 0u) splat_count[0] = splat_count[1] = count;
    for (uint k = i; k < sort_words; k += threads) sort_zeros[k] = 0u;
    for (uint k = i; k < list_words; k += threads) list_zeros[k] = 0u;
    if (i >= count) return;
    vec3 mean = vec3(means[3 * i], means[3 * i + 1], means[3 * i + 2]);
    Geometry g = geometry_of(mean, vec3(log_scales[3 * i], log_scales[3 * i + 1], log_scales[3 * i + 2]), quats[i]);
    // exp(80) is finite, so an extreme logit gives a tiny opacity and not a NaN.
    float log2_opacity = -log2(1.0 + exp(min(-opacity_logits[i], 80.0)));

    if (antialiased != 0) log2_opacity += 0.5 * log2(max(dot(g.area, g.area), SMALLEST_AREA) * g.conic_det);

    float basis[SH_COUNT];
    sh_basis(normalize(mean - camera_position()), basis);
    vec3 colour = vec3(0.5);
    [[unroll]] for (int k = 0; k < SH_COUNT; k++) {
        uint at = 3 * (i * sh_stride + k);
        colour += basis[k] * vec3(sh[at], sh[at + 1], sh[at + 2]);
    }
    colour = max(colour, vec3(0.0));

    vec2 centre = camera_focal() * g.t.xy / g.t.z + camera_centre() - 0.5;
    vec3 power = vec3(-0.5 * LOG2_E, -LOG2_E, -0.5 * LOG2_E) * g.conic;
    float det = 0.25 * LOG2_E * LOG2_E * g.conic_det;
    bool visible = g.visible && log2_opacity >= LOG2_ALPHA_MIN && is_on_image(centre, power, det, log2_opacity);
    // A log opacity of -1e4 makes an invisible splat fail every later comparison.
    projected[PROJECTED_VECTORS * i] = vec4(centre, power.xy);
    projected[PROJECTED_VECTORS * i + 1] = vec4(power.z, visible ? log2_opacity : -1e4, det, 0.0);
    projected[PROJECTED_VECTORS * i + 2] = vec4(colour, g.t.z);
    depth_pairs[i] = uvec2(visible ? depth_key(g.t.z) : HIDDEN_KEY, i);
}
