#version 460
// Moves particles by their velocities: a structure in a buffer.
struct Particle {
    vec3 position;
    float mass;
    vec3 velocity;
    float padding;
};
const uint GROUP = 64;
layout(local_size_x = 64) in;
layout(std430, binding = 0) buffer Particles { Particle particles[]; };
layout(push_constant) uniform Push { uint count; float seconds; };

void main() {
    uint i = gl_GlobalInvocationID.x;
    if (i < count) particles[i].position += seconds * particles[i].velocity;
}
