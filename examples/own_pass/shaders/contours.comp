#version 450
// A rendered frame with contour lines of its depth.
layout(local_size_x = 128) in;

layout(std430, binding = 0) readonly buffer Planes { float planes[]; };               // [4, H, W] red, green, blue, sum of w z
layout(std430, binding = 1) readonly buffer Transmittance { float transmittance[]; }; // [H, W]
layout(std430, binding = 2) writeonly buffer Picture { float picture[]; };            // [H, W, 3]
layout(push_constant) uniform Push { uint width; uint height; float spacing; };

float band(uint x, uint y) {
    uint pixel = min(y, height - 1) * width + min(x, width - 1);
    return floor(planes[3 * width * height + pixel] / max(1.0 - transmittance[pixel], 1e-3) / spacing);
}

void main() {
    uint pixel = gl_GlobalInvocationID.x;
    if (pixel >= width * height) return;
    uint x = pixel % width, y = pixel / width;
    float here = band(x, y);
    bool line = here != band(x + 1, y) || here != band(x, y + 1);
    for (uint c = 0; c < 3; c++) picture[3 * pixel + c] = line ? 0.0 : planes[c * width * height + pixel];
}
