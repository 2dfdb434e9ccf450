#version 450
// Stored features to rendered ones: f / (|f| + epsilon), or f where epsilon < 0. Twin: pass::project::features_twin.
layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer Features { float features[]; }; // [N, dim]
layout(std430, binding = 1) writeonly buffer Codes { float codes[]; };      // [N, stride], zeros beyond dim
layout(push_constant) uniform Push { uint count; uint dim; uint stride; float epsilon; };

void main() {
    uint i = gl_GlobalInvocationID.x;
    if (i >= count) return;
    float squares = 0.0;
    for (uint k = 0; k < dim; k++) squares += features[i * dim + k] * features[i * dim + k];
    float scale = epsilon < 0.0 ? 1.0 : 1.0 / (sqrt(squares) + epsilon);
    for (uint k = 0; k < dim; k++) codes[i * stride + k] = features[i * dim + k] * scale;
    for (uint k = dim; k < stride; k++) codes[i * stride + k] = 0.0;
}
