// Window and constants of SSIM (11 taps, sigma 1.5, normalised); the test of src/pass/ssim_l1.rs computes the taps.
const int STRIP = 16; // outputs per thread
const int HALF = 5;
const int TAPS = 2 * HALF + 1;
const float WINDOW[TAPS] = float[](0.00102838008, 0.00759875814, 0.0360007721, 0.10936069, 0.213005538, 0.266011725,
                                 0.213005538, 0.10936069, 0.0360007721, 0.00759875814, 0.00102838008);
const float C1 = 1e-4;  // 0.01², Wang et al. 2004
const float C2 = 9e-4;  // 0.03²
