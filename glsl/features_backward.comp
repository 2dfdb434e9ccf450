#version 450
// Gradient by the stored features from the gradient by the rendered ones, per block of `width`
// numbers. Reference: pass::project_backward::features_reference.
#extension GL_GOOGLE_include_directive : require
layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer Features { float features[]; };          // [N, dim]
layout(std430, binding = 1) readonly buffer CodesGrad { float codes_grad[]; };       // [N, stride]
layout(std430, binding = 2) writeonly buffer FeaturesGrad { float features_grad[]; }; // [N, dim]
layout(push_constant) uniform Push { uint count; uint dim; uint stride; uint width; float epsilon; };

#include "shared/rows.glsl"

void main() {
    uint i = thread_number();
    if (i >= count) return;
    for (uint first = 0; first < dim; first += width) {
        float scale = 1.0, radial = 0.0;
        if (epsilon >= 0.0) {
            float squares = 0.0, along = 0.0;
            for (uint k = first; k < first + width; k++) {
                float f = features[i * dim + k];
                squares += f * f;
                along += f * codes_grad[i * stride + k];
            }
            float size = sqrt(squares);
            scale = 1.0 / (size + epsilon);
            radial = size > 0.0 ? along * scale / size : 0.0;
        }
        for (uint k = first; k < first + width; k++)
            features_grad[i * dim + k] = (codes_grad[i * stride + k] - radial * features[i * dim + k]) * scale;
    }
}
