#version 460
// Densification statistics (Kerbl et al. 2023): per splat the norm of the gradient by its screen centre, in units of half
// the image side, added up over the views that saw it. Centre gradients follow from the moments of the raster backward
// pass: d(u,v) = -(A m1 + B m2, C m2 + B m1), with the conic as projected (times -log2(e)/2 and -log2(e)).
layout(local_size_x = 64) in;
layout(std430, binding = 0) readonly buffer Projected { vec4 projected[]; };  // [N, 3]: (u, v, A', B'), (C', ..), ..
layout(std430, binding = 1) readonly buffer ProjectedGrad { vec4 projected_grad[]; };  // [N, 3]: moments first
layout(std430, binding = 2) buffer Stats { vec2 stats[]; };  // [N] (sum of norms, views)
layout(push_constant) uniform Push { uint count; float half_width; float half_height; };
const float LN2 = 0.6931471805599453;

void main() {
    uint i = gl_GlobalInvocationID.x;
    if (i >= count) return;
    vec3 m = projected_grad[3u * i].xyz;
    if (m == vec3(0.0)) return;  // not seen, or nothing to say
    float a = -2.0 * LN2 * projected[3u * i].z, b = -LN2 * projected[3u * i].w, c = -2.0 * LN2 * projected[3u * i + 1u].x;
    vec2 by_centre = vec2((a * m.y + b * m.z) * half_width, (c * m.z + b * m.y) * half_height);
    stats[i] += vec2(length(by_centre), 1.0);
}
