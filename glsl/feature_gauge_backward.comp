#version 460
// In place, gradient by f^ to gradient by f for f^ = f / (|f| + epsilon), per block of `width` channels:
//   df = (g - u (u.g) |f| / (|f| + epsilon)) / (|f| + epsilon),  u = f / |f|, and g / epsilon at f = 0.
layout(local_size_x = 64) in;
layout(std430, binding = 0) readonly buffer Raw { float raw[]; };  // [blocks, width]
layout(std430, binding = 1) buffer Gradients { float gradients[]; };  // [blocks, width]
layout(push_constant) uniform Push { uint blocks; uint width; float epsilon; };

void main() {
    uint block = (gl_WorkGroupID.y * gl_NumWorkGroups.x + gl_WorkGroupID.x) * 64u + gl_LocalInvocationID.x;
    if (block >= blocks) return;
    uint base = block * width;
    float square = 0.0, product = 0.0;
    for (uint k = 0u; k < width; k++) {
        square += raw[base + k] * raw[base + k];
        product += raw[base + k] * gradients[base + k];
    }
    float norm = sqrt(square);
    float factor = 1.0 / (norm + epsilon);
    // u (u.g) |f| = f (f.g) / |f|, which vanishes with f.
    float along = norm > 0.0 ? product * factor / norm : 0.0;
    for (uint k = 0u; k < width; k++) gradients[base + k] = (gradients[base + k] - raw[base + k] * along) * factor;
}
