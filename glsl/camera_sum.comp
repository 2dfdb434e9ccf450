#version 450
// Sums of the parts of the camera gradient that project_backward.comp leaves, in a fixed order.
#extension GL_GOOGLE_include_directive : require
#include "shared/layout.glsl"
layout(local_size_x = 16) in;

layout(std430, binding = 0) readonly buffer CameraParts { float camera_parts[]; };  // [CAMERA_GRADIENTS, parts]
layout(std430, binding = 1) writeonly buffer CameraGrad { float camera_grad[]; };   // [CAMERA_GRADIENTS]
layout(push_constant) uniform Push { uint parts; };

void main() {
    uint k = gl_LocalInvocationID.x;
    if (k >= CAMERA_GRADIENTS) return;
    float sum = 0.0;
    for (uint part = 0; part < parts; part++) sum += camera_parts[k * parts + part];
    camera_grad[k] = sum;
}
