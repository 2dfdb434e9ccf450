// Window and constants of SSIM (11 taps, sigma 1.5, normalised). A test of src/pass/ssim_l1.rs
// computes the taps.
const int STRIP = 16; // outputs per thread
const int HALF = 5;
const int TAPS = 2 * HALF + 1;
const float WINDOW[TAPS] = float[](0.00102838008, 0.00759875814, 0.0360007721, 0.10936069, 0.213005538, 0.266011725,
                                 0.213005538, 0.10936069, 0.0360007721, 0.00759875814, 0.00102838008);
const float C1 = 1e-4;  // 0.01², Wang et al. 2004
const float C2 = 9e-4;  // 0.03²

// Derivatives of SSIM by (E[x], E[x²], E[xy]), and SSIM, from blurred (x, y) and (x² + y², xy).
vec4 ssim_of(vec2 mean, vec2 moment) {
    float product = mean.x * mean.y, squares = mean.x * mean.x + mean.y * mean.y;
    float a1 = 2.0 * product + C1, a2 = 2.0 * (moment.y - product) + C2;
    float b1 = squares + C1, b2 = (moment.x - squares) + C2;
    float inverse = 1.0 / (b1 * b2);
    float s = a1 * a2 * inverse;
    float by_mean = 2.0 * mean.y * (a2 - a1) * inverse - 2.0 * mean.x * s / b1 + 2.0 * mean.x * s / b2;
    return vec4(by_mean, -s / b2, 2.0 * a1 * inverse, s);
}
