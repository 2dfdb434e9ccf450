// Gradient of weight * max(0, s_max/s_min - limit) by the log scales of a splat. The ratio is
// capped in the gradient so that one degenerate splat cannot overflow.
vec3 ratio_gradient(vec3 log_scale, float weight, float limit) {
    vec3 s = log_scale, gradient = vec3(0.0);
    uint high = s.x >= s.y ? (s.x >= s.z ? 0u : 2u) : (s.y >= s.z ? 1u : 2u);
    uint low = s.x < s.y ? (s.x < s.z ? 0u : 2u) : (s.y < s.z ? 1u : 2u);
    float log_ratio = max(s.x, max(s.y, s.z)) - min(s.x, min(s.y, s.z));
    if (log_ratio > log(limit)) {
        float slope = weight * exp(min(log_ratio, 10.0));
        gradient = mix(gradient, vec3(slope), equal(uvec3(0u, 1u, 2u), uvec3(high)));
        gradient = mix(gradient, vec3(-slope), equal(uvec3(0u, 1u, 2u), uvec3(low)));
    }
    return gradient;
}
