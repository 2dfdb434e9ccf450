// Adam (Kingma & Ba 2015); beta1 0.9, beta2 0.999, as in 3D Gaussian splatting.
#ifndef ADAM
#define ADAM
const float BETA1 = 0.9, BETA2 = 0.999;

// Moves four parameters with their moments, (m, v) of two parameters a vector:
//   p -= rate * m / (sqrt(v) * second + eps)
// Returns which gradients are finite; the parameters of the others stay.
bvec4 adam(inout vec4 parameter, inout vec4 moments[2], vec4 gradient, vec4 rate, float second,
           float eps) {
    // Drivers may optimise isnan and isinf away.
    bvec4 finite = notEqual(floatBitsToUint(gradient) & uvec4(0x7f800000u), uvec4(0x7f800000u));
    vec4 m = vec4(moments[0].xz, moments[1].xz), v = vec4(moments[0].yw, moments[1].yw);
    vec4 next_m = BETA1 * m + (1.0 - BETA1) * gradient;
    vec4 next_v = BETA2 * v + (1.0 - BETA2) * gradient * gradient;
    vec4 change = rate * next_m / (sqrt(next_v) * second + eps);
    parameter = mix(parameter, parameter - change, finite);
    m = mix(m, next_m, finite);
    v = mix(v, next_v, finite);
    moments[0] = vec4(m.x, v.x, m.y, v.y);
    moments[1] = vec4(m.z, v.z, m.w, v.w);
    return finite;
}
#endif
