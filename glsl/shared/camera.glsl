// The camera buffer, 24 floats, as pass::View::to_gpu writes it. The including shader has declared
//   readonly buffer Camera { vec4 camera[]; };
// rows 0-2: (R | tau), world to camera; 3: fx, fy, cx, cy; 4: width, height, near, 0; 5: background RGB, 0.
vec3 to_camera_axes(vec3 v) {
    return vec3(dot(camera[0].xyz, v), dot(camera[1].xyz, v), dot(camera[2].xyz, v));
}
vec3 to_world_axes(vec3 v) { return camera[0].xyz * v.x + camera[1].xyz * v.y + camera[2].xyz * v.z; }
vec3 camera_translation() { return vec3(camera[0].w, camera[1].w, camera[2].w); }
vec3 camera_position() { return -to_world_axes(camera_translation()); }
vec2 camera_focal() { return camera[3].xy; }
vec2 camera_centre() { return camera[3].zw; }
vec2 camera_size() { return camera[4].xy; }
float camera_near() { return camera[4].z; }
vec3 camera_background() { return camera[5].xyz; }
