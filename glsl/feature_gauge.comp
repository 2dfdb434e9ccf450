#version 460
// Rendered features from raw ones, per block of `width` channels: f^ = f / (|f| + epsilon)  (ALGORITHMS 8.4).
layout(local_size_x = 64) in;
layout(std430, binding = 0) readonly buffer Raw { float raw[]; };  // [blocks, width]
layout(std430, binding = 1) writeonly buffer Features { float features[]; };  // [blocks, width]
layout(push_constant) uniform Push { uint blocks; uint width; float epsilon; };

void main() {
    uint block = (gl_WorkGroupID.y * gl_NumWorkGroups.x + gl_WorkGroupID.x) * 64u + gl_LocalInvocationID.x;
    if (block >= blocks) return;
    uint base = block * width;
    float square = 0.0;
    for (uint k = 0u; k < width; k++) square += raw[base + k] * raw[base + k];
    float factor = 1.0 / (sqrt(square) + epsilon);
    for (uint k = 0u; k < width; k++) features[base + k] = raw[base + k] * factor;
}
