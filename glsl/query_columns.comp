#version 450
// Text query, pass 1 of 2: sums over the 30 rows of the box of each pixel, of the excess per level
// and of the relevancy of all levels. One thread makes a strip of ROWS rows of one column by
// running sums. Reference: query::frame::HostSearch.
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
layout(local_size_x = 64) in;
// [frames, levels, P] of 16 bits, two per word; 65535 = none.
layout(std430, binding = 0) readonly buffer Codes { uint codes[]; };
layout(std430, binding = 1) readonly buffer Tables { uint tables[]; };  // [frames, levels, slots]
// [frames, levels + 1, P]: per level the excess, then the relevancy of all levels.
layout(std430, binding = 2) writeonly buffer Columns { uint columns[]; };
layout(push_constant) uniform Push { uint width; uint height; uint levels; uint slots; };
#include "shared/query.glsl"

const int ROWS = 16;

uint excess[SUMMED_LEVELS], all_levels;

// Adds a row to the sums, or subtracts it where the sign is -1 modulo 2^32.
void add(uint frame, uint pixel, uint sign) {
    [[unroll]] for (uint level = 0u; level < SUMMED_LEVELS; level++) {
        if (level < levels) {
            uint entry = entry_of(frame * levels + level, pixel);
            excess[level] += sign * excess_of(entry);
            all_levels += sign * relevancy_of(entry);
        }
    }
}

void main() {
    uint x = gl_GlobalInvocationID.x, frame = gl_WorkGroupID.z;
    if (x >= width) return;
    int top = int(gl_WorkGroupID.y) * ROWS, rows = int(height);
    [[unroll]] for (uint level = 0u; level < SUMMED_LEVELS; level++) excess[level] = 0u;
    all_levels = 0u;
    for (int k = 0; k < SIDE; k++) add(frame, uint(reflected(top + k - BEFORE, rows)) * width + x, 1u);
    for (int y = top; y < min(top + ROWS, rows); y++) {
        uint pixel = uint(y) * width + x, first = frame * (levels + 1u);
        [[unroll]] for (uint level = 0u; level < SUMMED_LEVELS; level++)
            if (level < levels) columns[(first + level) * (width * height) + pixel] = excess[level];
        columns[(first + levels) * (width * height) + pixel] = all_levels;
        add(frame, uint(reflected(y + SIDE - BEFORE, rows)) * width + x, 1u);
        add(frame, uint(reflected(y - BEFORE, rows)) * width + x, 0xffffffffu);
    }
}
