#version 450
// Sums the partial camera gradients in a fixed order, one workgroup per component.
layout(local_size_x = 256) in;

// [CAMERA_GRADIENTS, parts].
layout(std430, binding = 0) readonly buffer CameraParts { float camera_parts[]; };
// [CAMERA_GRADIENTS].
layout(std430, binding = 1) writeonly buffer CameraGrad { float camera_grad[]; };
layout(push_constant) uniform Push { uint parts; };

shared float sums[256];

void main() {
    uint thread = gl_LocalInvocationID.x, k = gl_WorkGroupID.x;
    float sum = 0.0;
    for (uint part = thread; part < parts; part += 256) sum += camera_parts[k * parts + part];
    sums[thread] = sum;
    for (uint half_way = 128; half_way > 0; half_way /= 2) {
        barrier();
        if (thread < half_way) sums[thread] += sums[thread + half_way];
    }
    if (thread == 0) camera_grad[k] = sums[0];
}
