#version 450
// One propagation and refinement step over one colour of the red-black checkerboard (Xu and Tao
// 2019, ACMM, 3.1): per pixel the present plane, the best plane of each of eight areas around it,
// then four random changes; the plane of lowest cost is kept.
#extension GL_GOOGLE_include_directive : require
#include "shared/plane_sweep.glsl"
layout(local_size_x = 16, local_size_y = 4) in;

vec4 area_best;

void consider(ivec2 p) {
    if (all(greaterThanEqual(p, ivec2(0))) && all(lessThan(p, ivec2(push.width, push.height)))) {
        vec4 candidate = planes[push.first + uint(p.y) * push.width + uint(p.x)];
        if (candidate.w < area_best.w) {
            area_best = candidate;
        }
    }
}

// Plane of lowest cost in an area (0-3: a near wedge per direction, 4-7: a far strip per
// direction); w = 3.4e38 outside.
void search_area(ivec2 p, int area) {
    area_best = vec4(0.0, 0.0, 0.0, 3.4e38);
    int direction = area & 3;
    ivec2 d = direction < 2 ? ivec2(1 - 2 * direction, 0) : ivec2(0, 5 - 2 * direction);
    if (area < 4) {
        consider(p + d);
        for (int side = -1; side <= 1; side += 2) {
            consider(p + 2 * d + side * d.yx);
            consider(p + 3 * d + 2 * side * d.yx);
        }
    } else {
        for (int step = 0; step < 8; step++) {
            consider(p + (5 + 2 * step) * d);
        }
    }
}

void main() {
    int y = int(gl_GlobalInvocationID.y);
    // Only pixels of one colour get a thread: idle lanes would cost as much as busy ones.
    ivec2 p = ivec2(2 * int(gl_GlobalInvocationID.x) + ((y + int(push.parity)) & 1), y);
    if (p.x >= int(push.width) || p.y >= int(push.height)) {
        return;
    }
    vec3 ray = ray_through(p);
    load_window(p);
    load_neighbours(p);
    start_random(p);
    uint here = push.first + uint(p.y) * push.width + uint(p.x);
    vec4 best = vec4(planes[here].xyz, 3.4e38);
    // 0: the present plane, 1-8: areas, 9-12: random changes. One loop compiles the cost once.
    for (int h = 0; h < 13; h++) {
        vec3 candidate = best.xyz;
        bool valid = h == 0;
        if (h >= 1 && h <= 8) {
            search_area(p, h - 1);
            candidate = area_best.xyz;
            float inverse_depth = dot(candidate, ray);
            valid = area_best.w < 3e38 && inverse_depth >= push.range.x && inverse_depth <= push.range.y
                && candidate != best.xyz;
        } else if (h > 8) {
            float inverse_depth = dot(best.xyz, ray);
            vec3 normal = -normalize(best.xyz);
            float depth_step = 0.1 * exp2(-9.0 * uniform01());
            float normal_step = 0.7 * exp2(-5.0 * uniform01());
            float moved = inverse_depth * (1.0 + depth_step * (2.0 * uniform01() - 1.0));
            vec3 turned = normal + random_cube() * normal_step;
            if (h == 9) {
                inverse_depth = moved;
            } else if (h == 10) {
                normal = turned;
            } else if (h == 11) {
                normal = turned;
                inverse_depth = moved;
            } else {
                inverse_depth = push.range.x + uniform01() * (push.range.y - push.range.x);
                normal = random_cube() * 0.9 - normalize(ray);
            }
            valid = make_plane(ray, normal, inverse_depth, candidate);
        }
        if (valid) {
            float cost = plane_cost(p, ray, candidate) + roughness(p, candidate);
            if (cost < best.w) {
                best = vec4(candidate, cost);
            }
        }
    }
    planes[here] = best;
}
