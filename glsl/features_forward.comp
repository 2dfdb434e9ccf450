#version 450
// Rendered features from the stored ones, per block of `width` numbers: f / (|f| + epsilon), or f
// where epsilon < 0 (docs/internals/method.md#feature-gauge). Reference:
// pass::project::features_reference.
#extension GL_GOOGLE_include_directive : require
layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer Features { float features[]; };  // [N, dim]
// [N, stride], zeros beyond dim.
layout(std430, binding = 1) writeonly buffer Codes { float codes[]; };
layout(push_constant) uniform Push { uint count; uint dim; uint stride; uint width; float epsilon; };

#include "shared/rows.glsl"

void main() {
    uint i = thread_number();
    if (i >= count) return;
    for (uint first = 0; first < dim; first += width) {
        float squares = 0.0;
        for (uint k = first; k < first + width; k++) squares += features[i * dim + k] * features[i * dim + k];
        float scale = epsilon < 0.0 ? 1.0 : 1.0 / (sqrt(squares) + epsilon);
        for (uint k = first; k < first + width; k++) codes[i * stride + k] = features[i * dim + k] * scale;
    }
    for (uint k = dim; k < stride; k++) codes[i * stride + k] = 0.0;
}
