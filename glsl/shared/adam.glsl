// Adam (Kingma & Ba 2015); beta1 0.9, beta2 0.999, as in 3D Gaussian splatting.
#ifndef ADAM
#define ADAM
const float BETA1 = 0.9, BETA2 = 0.999;

// The moments of a parameter share 32 bits: m is a bfloat16 in the upper half, v, which has no sign,
// has eight bits of exponent and eight of mantissa in the lower half. A step uses the numbers before
// they are rounded. Rounding is stochastic (Gupta et al. 2015): the nearest number would keep v,
// which changes by a thousandth per step, for ever.
const uint SIGN_AND_M = 0xffff0000u, V_BITS = 0xffffu, V_SHIFT = 15u;

// Multipliers of a hash that is uniform enough for rounding.
const uint SPREAD = 0x9e3779b1u, STIR = 0x85ebca77u;

// Different for each step and class.
uint rounding_seed(float step, uint slot) { return uint(step) * STIR + slot * SPREAD; }

// 32 random bits for each parameter of a class.
uvec4 rounding_noise(uvec4 index, uint seed) {
    uvec4 hash = (index ^ (seed ^ seed >> 16)) * SPREAD;
    hash = (hash ^ hash >> 15) * STIR;
    return hash ^ hash >> 13;
}

// Moves four parameters with their moments:
//   p -= rate * m / (sqrt(v) * second + eps)
// Returns which gradients are finite; the parameters of the others stay.
bvec4 adam(inout vec4 parameter, inout uvec4 moments, vec4 gradient, vec4 rate, float second, float eps,
           uvec4 noise) {
    // Drivers may optimise isnan and isinf away.
    bvec4 finite = notEqual(floatBitsToUint(gradient) & uvec4(0x7f800000u), uvec4(0x7f800000u));
    vec4 m = BETA1 * uintBitsToFloat(moments & SIGN_AND_M) + (1.0 - BETA1) * gradient;
    vec4 v = BETA2 * uintBitsToFloat((moments & V_BITS) << V_SHIFT) + (1.0 - BETA2) * gradient * gradient;
    vec4 change = rate * m / (sqrt(v) * second + eps);
    parameter = mix(parameter, parameter - change, finite);
    uvec4 upper = (floatBitsToUint(m) + (noise & 0xffffu)) & SIGN_AND_M;
    uvec4 lower = (floatBitsToUint(v) + (noise >> 17)) >> V_SHIFT;
    moments = mix(moments, upper | lower, finite);
    return finite;
}
#endif
