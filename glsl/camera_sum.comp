#version 450
// Sums of the parts of the camera gradient that project_backward.comp leaves, in a fixed order.
layout(local_size_x = 16) in;

layout(std430, binding = 0) readonly buffer CameraParts { float camera_parts[]; };  // [10, parts]
layout(std430, binding = 1) writeonly buffer CameraGrad { float camera_grad[]; };   // [10]
layout(push_constant) uniform Push { uint parts; };

void main() {
    uint k = gl_LocalInvocationID.x;
    if (k >= 10) return;
    float sum = 0.0;
    for (uint part = 0; part < parts; part++) sum += camera_parts[k * parts + part];
    camera_grad[k] = sum;
}
