// Slanted-plane matching, shared by plane_sweep.comp and plane_sweep_refine.comp. A hypothesis is
// the plane pi.X = 1 in the reference camera's frame: 1/z = pi.ray, and the warp into a source view
// is the homography K_s (R + t pi^T). Same order of operations as the CPU reference,
// src/pass/plane_sweep_cpu.rs.
#extension GL_EXT_control_flow_attributes : require

// Taps along one side of the matching window.
const int TAPS = 5;
// Pixels between two taps: 5 taps at every second pixel cover a 9 x 9 window at 31 % of its cost.
const int TAP_STEP = 2;
// Cost of a source view that does not see the plane, and upper bound of any cost, so that one
// occluded view cannot outweigh the others. Unrelated patches have ZNCC about 0.
const float COST_LIMIT = 1.0;
// Luma difference at which a tap's weight falls to 1/e. A smaller one loses texture, a larger one
// fattens edges.
const float SIGMA_COLOUR = 0.03;
// Pixel distance of the spatial Gaussian, as in ACMM.
const float SIGMA_SPACE = 3.5;
// Shares of the best, second, ... source view in the aggregated cost: the second view confirms, but
// a pixel seen by only one other view still prefers the right plane.
const vec4 VIEW_SHARES = vec4(0.6, 0.3, 0.1, 0.0);
// Reprojection error (pixels) at which the geometric term saturates, as in ACMM.
const float GEOMETRIC_LIMIT = 3.0;
// Added to both variances: (1.5 grey levels)^2, the noise of an 8-bit JPEG. Flat patches get cost 1
// instead of noise.
const float VARIANCE_FLOOR = 3.5e-5;
// Relative difference of inverse depth at which the smoothness term saturates: a depth step costs
// no more.
const float SMOOTH_LIMIT = 0.03;
// Neighbours of the smoothness term: the four at one pixel and the four at three, all of the other
// checkerboard colour, so that they do not change during a step.
const int SMOOTH_NEIGHBOURS = 8;

// One source view as seen from a reference view.
struct SourceView {
    // Rows of K_s [R | t]: (ray, 1/z) of the reference -> homogeneous source pixel, scaled by the
    // inverse depth.
    vec4 forward[3];
    // Rows of the inverse mapping: (ray, 1/z) of the source -> homogeneous reference pixel.
    vec4 back[3];
    vec4 centre;     // source camera centre in the reference frame; w unused
    vec4 intrinsics; // fx, fy, cx, cy of the source, pixels
    // Width, height, index of the view's first pixel in the shared image and plane buffers, unused.
    uvec4 size;
};

layout(push_constant) uniform Push {
    vec4 intrinsics;
    vec2 range;
    float geometric;
    uint seed;
    uint width;
    uint height;
    uint first;
    uint first_source;
    uint sources;
    uint parity;
    uint planes;
    float smoothness;
    // Index of the view's first pixel among the pixels of all views, also where the buffers hold a
    // group of views only. Seeds the random numbers.
    uint identity;
} push;

// Luma of the 2 x 2 pixels from each pixel to the right and below, 16 bits each: one load per
// bilinear sample.
layout(std430, set = 0, binding = 0) readonly buffer Quads { uvec2 quads[]; };
layout(std430, set = 0, binding = 1) readonly buffer Sources { SourceView source_views[]; };
// (pi, cost) per pixel of all views.
layout(std430, set = 0, binding = 2) buffer Planes { vec4 planes[]; };

float weights[TAPS * TAPS];
float centred[TAPS * TAPS];
float window_variance;
uint random_state;

uint pcg(uint v) {
    v = v * 747796405u + 2891336453u;
    uint word = ((v >> ((v >> 28u) + 4u)) ^ v) * 277803737u;
    return (word >> 22u) ^ word;
}

float uniform01() {
    random_state = pcg(random_state);
    return float(random_state >> 8u) / 16777216.0;
}

vec3 random_cube() {
    float x = uniform01();
    float y = uniform01();
    float z = uniform01();
    return vec3(x, y, z) * 2.0 - vec3(1.0);
}

void start_random(ivec2 p) {
    random_state = pcg(push.seed ^ pcg(push.identity + uint(p.y) * push.width + uint(p.x)));
}

vec3 ray_through(ivec2 p) {
    return vec3((vec2(p) + 0.5 - push.intrinsics.zw) / push.intrinsics.xy, 1.0);
}

float luma_at(ivec2 p) {
    ivec2 q = clamp(p, ivec2(0), ivec2(push.width, push.height) - 1);
    return unpackUnorm2x16(quads[push.first + uint(q.y) * push.width + uint(q.x)].x).x;
}

void load_window(ivec2 p) {
    float centre = luma_at(p);
    float values[TAPS * TAPS];
    float sum = 0.0, mean = 0.0, square = 0.0;
    [[unroll]] for (int j = 0; j < TAPS; j++) {
        [[unroll]] for (int i = 0; i < TAPS; i++) {
            ivec2 d = (ivec2(i, j) - (TAPS - 1) / 2) * TAP_STEP;
            float value = luma_at(p + d) - centre;
            float space = float(d.x * d.x + d.y * d.y) / (2.0 * SIGMA_SPACE * SIGMA_SPACE);
            float weight = exp(-abs(value) / SIGMA_COLOUR - space);
            weights[j * TAPS + i] = weight;
            values[j * TAPS + i] = value;
            sum += weight;
            mean += weight * value;
            square += weight * value * value;
        }
    }
    mean /= sum;
    [[unroll]] for (int k = 0; k < TAPS * TAPS; k++) {
        weights[k] /= sum;
        centred[k] = weights[k] * (values[k] - mean);
    }
    window_variance = max(square / sum - mean * mean, 0.0);
}

float sample_source(uint first, uint width, vec2 limit, vec2 position) {
    vec2 p = clamp(position - 0.5, vec2(0.0), limit);
    vec2 cell = floor(p);
    vec2 f = p - cell;
    uvec2 quad = quads[first + uint(cell.y) * width + uint(cell.x)];
    vec2 top = unpackUnorm2x16(quad.x);
    vec2 bottom = unpackUnorm2x16(quad.y);
    vec2 column = top + f.y * (bottom - top);
    return column.x + f.x * (column.y - column.x);
}

vec3 rows(vec4 a, vec4 b, vec4 c, vec4 v) {
    return vec3(dot(a, v), dot(b, v), dot(c, v));
}

// 1 - ZNCC in one source view plus the geometric term.
float source_cost(uint index, ivec2 p, vec3 ray, vec3 plane) {
    vec4 a = source_views[index].forward[0];
    vec4 b = source_views[index].forward[1];
    vec4 c = source_views[index].forward[2];
    vec4 eye = source_views[index].centre;
    uvec4 size = source_views[index].size;
    vec3 q0 = rows(a, b, c, vec4(ray, dot(plane, ray)));
    vec2 at = q0.xy / q0.z;
    bool inside = q0.z > 0.0 && all(greaterThanEqual(at, vec2(0.0))) && all(lessThan(at, vec2(size.xy)));
    float cost = COST_LIMIT;
    if (inside && dot(plane, eye.xyz) < 1.0) {
        vec3 along_x = rows(a, b, c, vec4(1.0, 0.0, 0.0, plane.x)) / push.intrinsics.x;
        vec3 along_y = rows(a, b, c, vec4(0.0, 1.0, 0.0, plane.y)) / push.intrinsics.y;
        vec2 limit = vec2(size.xy) - 1.001;
        float base = sample_source(size.z, size.x, limit, at);
        float mean = 0.0, square = 0.0, covariance = 0.0;
        [[unroll]] for (int j = 0; j < TAPS; j++) {
            [[unroll]] for (int i = 0; i < TAPS; i++) {
                vec3 q = q0 + along_x * float((i - (TAPS - 1) / 2) * TAP_STEP)
                       + along_y * float((j - (TAPS - 1) / 2) * TAP_STEP);
                float value = sample_source(size.z, size.x, limit, q.xy * (1.0 / max(q.z, 1e-6))) - base;
                int k = j * TAPS + i;
                mean += weights[k] * value;
                square += weights[k] * value * value;
                covariance += centred[k] * value;
            }
        }
        float variance = max(square - mean * mean, 0.0);
        cost = min(1.0 - covariance / sqrt((window_variance + VARIANCE_FLOOR) * (variance + VARIANCE_FLOOR)), COST_LIMIT);
    }
    if (push.geometric > 0.0) {
        float error = GEOMETRIC_LIMIT;
        if (inside) {
            vec3 other = planes[size.z + uint(at.y) * size.x + uint(at.x)].xyz;
            vec4 k = source_views[index].intrinsics;
            vec3 ray_s = vec3((at - k.zw) / k.xy, 1.0);
            vec3 back = rows(source_views[index].back[0], source_views[index].back[1], source_views[index].back[2],
                             vec4(ray_s, dot(other, ray_s)));
            if (back.z > 0.0) {
                error = min(length(back.xy / back.z - vec2(p) - 0.5), GEOMETRIC_LIMIT);
            }
        }
        cost += push.geometric * error;
    }
    return cost;
}

// Inverse depth and weight of the neighbours of the smoothness term.
float neighbour_inverse[SMOOTH_NEIGHBOURS];
float neighbour_weight[SMOOTH_NEIGHBOURS];

ivec2 neighbour_offset(int n) {
    int step = n < 4 ? 1 : 3;
    return (n & 2) == 0 ? ivec2((1 - 2 * (n & 1)) * step, 0) : ivec2(0, (1 - 2 * (n & 1)) * step);
}

void load_neighbours(ivec2 p) {
    float centre = luma_at(p);
    [[unroll]] for (int n = 0; n < SMOOTH_NEIGHBOURS; n++) {
        ivec2 q = p + neighbour_offset(n);
        bool inside = all(greaterThanEqual(q, ivec2(0))) && all(lessThan(q, ivec2(push.width, push.height)));
        neighbour_weight[n] = 0.0;
        neighbour_inverse[n] = 1.0;
        if (inside) {
            neighbour_weight[n] = exp(-abs(luma_at(q) - centre) / SIGMA_COLOUR) * push.smoothness / float(SMOOTH_NEIGHBOURS);
            neighbour_inverse[n] = dot(planes[push.first + uint(q.y) * push.width + uint(q.x)].xyz, ray_through(q));
        }
    }
}

// Smoothness term: weighted differences of inverse depth between a plane and the neighbours.
float roughness(ivec2 p, vec3 plane) {
    float sum = 0.0;
    [[unroll]] for (int n = 0; n < SMOOTH_NEIGHBOURS; n++) {
        float there = dot(plane, ray_through(p + neighbour_offset(n)));
        float off = abs(there - neighbour_inverse[n]) / (SMOOTH_LIMIT * max(neighbour_inverse[n], 1e-9));
        sum += neighbour_weight[n] * min(off, 1.0);
    }
    return sum;
}

// Aggregated cost: the sorted source costs mixed by VIEW_SHARES.
float plane_cost(ivec2 p, vec3 ray, vec3 plane) {
    vec4 best = vec4(COST_LIMIT + push.geometric * GEOMETRIC_LIMIT);
    for (uint s = 0u; s < push.sources; s++) {
        float cost = source_cost(push.first_source + s, p, ray, plane);
        [[unroll]] for (int k = 0; k < 4; k++) {
            float larger = max(best[k], cost);
            best[k] = min(best[k], cost);
            cost = larger;
        }
    }
    return dot(best, VIEW_SHARES);
}

// Computes the plane through 1/z = inverse_depth with a normal; false if it is seen too obliquely
// or out of range.
bool make_plane(vec3 ray, vec3 normal, float inverse_depth, out vec3 plane) {
    float slope = dot(normal, ray);
    plane = normal * (inverse_depth / slope);
    bool facing = slope < -0.1 * length(normal) * length(ray);
    return facing && inverse_depth >= push.range.x && inverse_depth <= push.range.y;
}
