#version 450
// Packs planes of a rendered frame into texels of a chosen encoding. Reference: pass::pack.
layout(local_size_x = 128) in;

layout(std430, binding = 0) readonly buffer Planes { float planes[]; };              // [C, stride]
layout(std430, binding = 1) readonly buffer Transmittance { float transmittance[]; }; // [stride]
// [layers, P, group] in `encoding`.
layout(std430, binding = 2) writeonly buffer Texels { uint texels[]; };
// source 0: colour and alpha, 1: alpha, 2: expected depth, 3: `channels` planes from `first` on.
// encoding 0: 32-bit float, 1: 16-bit float, 2: 8-bit unorm; 1 and 2 with groups of four. Packs
// `count` pixels of the planes from `from` on, to the texels from `to` on, of `pixels` in all.
layout(push_constant) uniform Push {
    uint pixels; uint source; uint first; uint channels; uint group; uint encoding; uint stride; uint from; uint to; uint count;
};

// Least alpha with a depth: below it the sum of w z describes no surface
// (docs/internals/method.md#forward-rasterisation).
const float DEPTH_ALPHA_MIN = 0.5;

float value(uint pixel, uint k) {
    if (k >= channels) return 0.0;
    float alpha = 1.0 - transmittance[pixel];
    if (source == 1 || (source == 0 && k == 3)) return alpha;
    if (source == 2) return alpha >= DEPTH_ALPHA_MIN ? planes[3 * stride + pixel] / alpha : 0.0;
    return planes[(first + k) * stride + pixel];
}

void main() {
    uint index = gl_GlobalInvocationID.x, pixel = from + index;
    if (index >= count) return;
    for (uint layer = 0; layer * group < channels; layer++) {
        uint texel = layer * pixels + to + index, k = layer * group;
        if (encoding == 0) {
            for (uint j = 0; j < group; j++) texels[texel * group + j] = floatBitsToUint(value(pixel, k + j));
        } else {
            vec4 v = vec4(value(pixel, k), value(pixel, k + 1), value(pixel, k + 2), value(pixel, k + 3));
            if (encoding == 1) {
                texels[2 * texel] = packHalf2x16(v.xy);
                texels[2 * texel + 1] = packHalf2x16(v.zw);
            } else {
                texels[texel] = packUnorm4x8(clamp(v, 0.0, 1.0));
            }
        }
    }
}
