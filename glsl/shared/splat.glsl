// Screen-space geometry of one splat, shared by projection and its backward pass. Equations:
// pass::project. Needs shared/camera.glsl.
const float DILATION = 0.3; // a splat never gets thinner than about a pixel (INRIA's value)
// Least squared area, px⁴: below it a splat is invisible and the logarithm would not be finite.
const float SMALLEST_AREA = 1e-12;

struct Geometry {
    bool visible;       // beyond the near plane; the other fields are meaningless otherwise
    vec3 t;             // mean in camera axes
    vec4 quat;          // unit (w, x, y, z)
    float quat_length;  // of the raw quaternion
    mat3 rotation;      // of the unit quaternion
    vec3 scale;
    vec2 clamped;       // t.xy, moved towards the image where it is far outside
    bvec2 inside;       // true where t.xy was not moved
    vec3 j0, j1;        // Jacobian of the projection
    vec3 t0, t1;        // J R
    vec3 b0, b1;        // J R M
    vec3 conic;         // (A, B, C)
    float conic_det;    // AC − B²
    vec3 area;          // b0 × b1; its square is the determinant without the dilation
};

mat3 rotation_of(vec4 q) {
    float r = q.x, x = q.y, y = q.z, z = q.w;
    return mat3(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + r * z), 2.0 * (x * z - r * y),
                2.0 * (x * y - r * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + r * x),
                2.0 * (x * z + r * y), 2.0 * (y * z - r * x), 1.0 - 2.0 * (x * x + y * y));
}

Geometry geometry_of(vec3 mean, vec3 log_scale, vec4 raw_quat) {
    Geometry g;
    g.t = to_camera_axes(mean) + camera_translation();
    g.visible = g.t.z > camera_near();
    if (!g.visible) g.t.z = 1.0; // keeps the arithmetic below finite
    g.quat_length = length(raw_quat);
    g.quat = raw_quat / g.quat_length;
    g.rotation = rotation_of(g.quat);
    g.scale = exp(log_scale);
    vec2 focal = camera_focal(), margin = 0.15 * camera_size();
    vec2 low = -(camera_centre() + margin) / focal;
    vec2 high = (camera_size() - camera_centre() + margin) / focal;
    float inv_z = 1.0 / g.t.z;
    vec2 slope = g.t.xy * inv_z, limited = clamp(slope, low, high);
    g.inside = equal(slope, limited);
    g.clamped = limited * g.t.z;
    g.j0 = vec3(focal.x * inv_z, 0.0, -focal.x * limited.x * inv_z);
    g.j1 = vec3(0.0, focal.y * inv_z, -focal.y * limited.y * inv_z);
    g.t0 = to_world_axes(g.j0);
    g.t1 = to_world_axes(g.j1);
    g.b0 = (g.t0 * g.rotation) * g.scale;
    g.b1 = (g.t1 * g.rotation) * g.scale;
    // det(B B' + cI) by Lagrange's identity: no cancellation for needles.
    vec3 area = cross(g.b0, g.b1);
    float xx = dot(g.b0, g.b0), yy = dot(g.b1, g.b1), xy = dot(g.b0, g.b1);
    float inv_det = 1.0 / (dot(area, area) + DILATION * (xx + yy) + DILATION * DILATION);
    g.conic_det = inv_det;
    g.area = area;
    g.conic = vec3(yy + DILATION, -xy, xx + DILATION) * inv_det;
    return g;
}
