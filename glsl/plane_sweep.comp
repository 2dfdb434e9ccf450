#version 450
// Initial sweep: per pixel the best of push.planes inverse depths, each with a random normal.
#extension GL_GOOGLE_include_directive : require
#include "shared/plane_sweep.glsl"
layout(local_size_x = 16, local_size_y = 4) in;

void main() {
    ivec2 p = ivec2(gl_GlobalInvocationID.xy);
    if (p.x >= int(push.width) || p.y >= int(push.height)) {
        return;
    }
    vec3 ray = ray_through(p);
    load_window(p);
    start_random(p);
    vec3 view = normalize(ray);
    vec4 best = vec4(-view * (push.range.x / -dot(view, ray)), 3.4e38);
    for (uint k = 0u; k < push.planes; k++) {
        float share = (float(k) + uniform01()) / float(push.planes);
        float inverse_depth = push.range.x + share * (push.range.y - push.range.x);
        vec3 normal = random_cube() * 0.9 - view;
        vec3 plane;
        if (make_plane(ray, normal, inverse_depth, plane)) {
            float cost = plane_cost(p, ray, plane);
            if (cost < best.w) {
                best = vec4(plane, cost);
            }
        }
    }
    planes[push.first + uint(p.y) * push.width + uint(p.x)] = best;
}
