#version 460
// Language loss of one view: L1 between rendered features and the target code where there is a
// label (docs/internals/method.md#language-loss). Labels index rows of `codes`, all levels one
// after the other; -1 has no influence, not even on the bits of the gradient.
// The gradient is weight[level] * sign(F - code).
#extension GL_GOOGLE_include_directive : require
#include "shared/layout.glsl"
layout(local_size_x = 64) in;
layout(std430, binding = 0) readonly buffer Labels { int labels[]; };  // [levels, H*W]
layout(std430, binding = 1) readonly buffer Codes { float codes[]; };  // [K, width]
layout(std430, binding = 2) readonly buffer Weights { float weights[]; };  // [levels]
// [4 + levels*width, H*W]: RGB, depth, features.
layout(std430, binding = 3) readonly buffer Planes { float planes[]; };
// [4 + levels*width + 1, H*W].
layout(std430, binding = 4) writeonly buffer Upstream { float upstream[]; };
// [H*W] weighted sum over levels.
layout(std430, binding = 5) writeonly buffer Loss { float loss[]; };
layout(push_constant) uniform Push { uint pixels; uint levels; uint width; };

void main() {
    uint pixel = gl_GlobalInvocationID.x;
    if (pixel >= pixels) return;
    float total = 0.0;
    for (uint level = 0u; level < levels; level++) {
        int label = labels[level * pixels + pixel];
        float weight = weights[level];
        float sum = 0.0;
        for (uint k = 0u; k < width; k++) {
            uint at = (BASE_CHANNELS + level * width + k) * pixels + pixel;
            float slope = 0.0;
            if (label >= 0) {
                float difference = planes[at] - codes[uint(label) * width + k];
                sum += abs(difference);
                slope = weight * sign(difference);
            }
            upstream[at] = slope;
        }
        total += weight * sum;
    }
    loss[pixel] = total;
}
