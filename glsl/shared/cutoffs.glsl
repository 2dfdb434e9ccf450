// Thresholds of blending: the values of every 3DGS renderer.
#ifndef CUTOFFS
#define CUTOFFS
const float ALPHA_MIN = 1.0 / 255.0;             // a contribution below is skipped
const float LOG2_ALPHA_MIN = -7.994353436858858; // log2 of it, to compare powers with
const float ALPHA_MAX = 0.99;                    // upper bound of alpha, so that T never reaches 0
const float TRANSMITTANCE_MIN = 1e-4;            // a pixel stops before T falls below
#endif
