#version 450
// Relevancy per pixel: the score of the code that decodes it, 0 where no code does. Twin: pass::relevancy.
layout(local_size_x = 128) in; // lavapipe wants at least 128 threads in a workgroup for streaming kernels

layout(std430, binding = 0) readonly buffer Codes { int codes[]; };   // [P] code index, -1 = background
layout(std430, binding = 1) readonly buffer Scores { float scores[]; }; // [K]
layout(std430, binding = 2) writeonly buffer Relevancy { float relevancy[]; }; // [P]
layout(push_constant) uniform Push { uint pixels; };

void main() {
    uint pixel = gl_GlobalInvocationID.x;
    if (pixel >= pixels) return;
    int code = codes[pixel];
    relevancy[pixel] = code < 0 ? 0.0 : scores[code];
}
