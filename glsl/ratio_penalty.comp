#version 460
// Adds the gradient of weight * max(0, s_max/s_min - limit) per splat to the log-scale gradients:
// without it, splats that few views constrain become needles. The ratio is capped in the gradient
// so that one degenerate splat cannot overflow.
layout(local_size_x = 64) in;
layout(std430, binding = 0) readonly buffer LogScales { float log_scales[]; };  // [N, 3]
layout(std430, binding = 1) buffer Gradients { float gradients[]; };  // [N, 3]
layout(push_constant) uniform Push { uint count; float weight; float limit; };

void main() {
    uint i = gl_GlobalInvocationID.x;
    if (i >= count) return;
    vec3 s = vec3(log_scales[3u * i], log_scales[3u * i + 1u], log_scales[3u * i + 2u]);
    uint high = s.x >= s.y ? (s.x >= s.z ? 0u : 2u) : (s.y >= s.z ? 1u : 2u);
    uint low = s.x < s.y ? (s.x < s.z ? 0u : 2u) : (s.y < s.z ? 1u : 2u);
    float log_ratio = max(s.x, max(s.y, s.z)) - min(s.x, min(s.y, s.z));
    if (log_ratio <= log(limit)) return;
    float slope = weight * exp(min(log_ratio, 10.0));
    gradients[3u * i + high] += slope;
    gradients[3u * i + low] -= slope;
}
