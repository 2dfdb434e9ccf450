#version 460
// Language loss of one view: L1 between rendered features and the target code where there is a
// label (docs/internals/method.md#language-loss). Labels index rows of `codes`, all levels one
// after the other; -1 has no influence, not even on the bits of the gradient.
// mode 0: upstream = weight[level] * sign(F - code).
// mode 1 (lifting): upstream = code, so that the backward pass returns the blending-weighted sum of
// codes of every splat, and 1 for colour number `level` where there is a label, which returns the
// blending weight itself.
// mode 2 (least squares): upstream = F - code.
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
layout(push_constant) uniform Push { uint pixels; uint levels; uint width; uint mode; };

const uint LOSS = 0u;
const uint LIFT = 1u;
const uint COLOURS = 3u;

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
                float code = codes[uint(label) * width + k];
                float difference = planes[at] - code;
                sum += abs(difference);
                slope = mode == LOSS ? weight * sign(difference) : mode == LIFT ? code : difference;
            }
            upstream[at] = slope;
        }
        if (mode == LIFT && level < COLOURS) upstream[level * pixels + pixel] = label >= 0 ? 1.0 : 0.0;
        total += weight * sum;
    }
    loss[pixel] = total;
}
