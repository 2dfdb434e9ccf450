#version 450
// Text query, pass 2 of 2: sums over the 30 columns of the box, and per level the largest blended
// excess and the pixel of an answering code with the largest relevancy of all levels in its box.
// One thread makes RUN pixels of a row, a workgroup the largest of its threads. Reference:
// query::frame::HostSearch.
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
layout(local_size_x = 128) in;
// Codes and tables of query_columns.comp.
layout(std430, binding = 0) readonly buffer Codes { uint codes[]; };
layout(std430, binding = 1) readonly buffer Tables { uint tables[]; };
layout(std430, binding = 2) readonly buffer Columns { uint columns[]; };
// [frames, levels, workgroups] largest of 900 times the excess of a pixel and of its box; largest
// sum of relevancy with its pixel, NONE without an answering code.
layout(std430, binding = 3) writeonly buffer Found { uvec4 found[]; };
layout(push_constant) uniform Push { uint width; uint height; uint levels; uint slots; };
#include "shared/query.glsl"

const uint RUN = 8u;
const uint NONE = 4294967295u;

shared uint peaks[128], largest[128], places[128];

uint column(uint plane, uint row, int x) {
    return columns[plane * (width * height) + row * width + uint(reflected(x, int(width)))];
}

// Box sums of the pixels first .. first + RUN of a row.
void box_sums(uint plane, uint row, int first, out uint sums[RUN]) {
    uint sum = 0u;
    for (int k = 0; k < SIDE; k++) sum += column(plane, row, first + k - BEFORE);
    [[unroll]] for (uint j = 0u; j < RUN; j++) {
        sums[j] = sum;
        int x = first + int(j);
        sum += column(plane, row, x + SIDE - BEFORE) - column(plane, row, x - BEFORE);
    }
}

// The larger sum; of equal sums the earlier pixel.
bool precedes(uint sum, uint pixel, uint other_sum, uint other) {
    return pixel != NONE && (other == NONE || sum > other_sum || (sum == other_sum && pixel < other));
}

void main() {
    uint lane = gl_LocalInvocationID.x, frame = gl_WorkGroupID.y;
    uint runs = (width + RUN - 1u) / RUN;
    uint row = gl_GlobalInvocationID.x / runs, first = gl_GlobalInvocationID.x % runs * RUN;
    bool inside = row < height;
    uint evidence[RUN], sums[RUN];
    [[unroll]] for (uint j = 0u; j < RUN; j++) evidence[j] = sums[j] = 0u;
    if (inside) box_sums(frame * (levels + 1u) + levels, row, int(first), evidence);
    for (uint level = 0u; level < levels; level++) {
        uint peak = 0u, sum = 0u, place = NONE;
        if (inside) {
            box_sums(frame * (levels + 1u) + level, row, int(first), sums);
            [[unroll]] for (uint j = 0u; j < RUN; j++) {
                uint x = first + j, pixel = row * width + x;
                if (x < width) {
                    uint entry = entry_of(frame * levels + level, pixel);
                    peak = max(peak, uint(SIDE * SIDE) * excess_of(entry) + sums[j]);
                    if ((entry & ANSWERS) != 0u && precedes(evidence[j], pixel, sum, place)) {
                        sum = evidence[j];
                        place = pixel;
                    }
                }
            }
        }
        peaks[lane] = peak;
        largest[lane] = sum;
        places[lane] = place;
        barrier();
        for (uint half_width = 64u; half_width > 0u; half_width >>= 1) {
            if (lane < half_width) {
                uint other = lane + half_width;
                peaks[lane] = max(peaks[lane], peaks[other]);
                if (precedes(largest[other], places[other], largest[lane], places[lane])) {
                    largest[lane] = largest[other];
                    places[lane] = places[other];
                }
            }
            barrier();
        }
        if (lane == 0u)
            found[(frame * levels + level) * gl_NumWorkGroups.x + gl_WorkGroupID.x] =
                uvec4(peaks[0], largest[0], places[0], 0u);
        // No barrier: behind the last one only the first thread reads, and only its own elements.
    }
}
