// Camera, always at binding 0.
struct CameraView {
    vec4 world_to_camera[3]; // rows of (R | tau)
    vec2 focal;              // pixels
    vec2 centre;             // pixels, centre of the first pixel at 0.5
    vec2 size;               // pixels
    float near;
    float unused;
    vec3 background;         // RGB
    float unused2;
};
layout(std430, binding = 0) readonly buffer Camera { CameraView camera; };

vec3 to_camera_axes(vec3 v) {
    return vec3(dot(camera.world_to_camera[0].xyz, v), dot(camera.world_to_camera[1].xyz, v), dot(camera.world_to_camera[2].xyz, v));
}
vec3 to_world_axes(vec3 v) {
    return camera.world_to_camera[0].xyz * v.x + camera.world_to_camera[1].xyz * v.y + camera.world_to_camera[2].xyz * v.z;
}
vec3 camera_translation() { return vec3(camera.world_to_camera[0].w, camera.world_to_camera[1].w, camera.world_to_camera[2].w); }
vec3 camera_position() { return -to_world_axes(camera_translation()); }
vec2 camera_focal() { return camera.focal; }
vec2 camera_centre() { return camera.centre; }
vec2 camera_size() { return camera.size; }
float camera_near() { return camera.near; }
vec3 camera_background() { return camera.background; }
