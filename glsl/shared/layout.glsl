// Lengths of the elements of shared buffers. The Rust constants are generated from these.
#ifndef LAYOUT
#define LAYOUT
// RGB and depth, before the features. A macro, because the preprocessor compares variants with it.
#define BASE_CHANNELS 4
const int TILE = 8;              // pixels along the edge of a tile
const int PROJECTED_VECTORS = 3; // a splat on the screen, see project.comp
const int PROJECTED_FLOATS = 4 * PROJECTED_VECTORS;
// Gradient by the geometry of a projected splat: sums of s, s dx, s dy, s dx^2, s dx dy, s dy^2.
const int MOMENTS = 6;
const int GRADIENT_VECTORS = 3;  // the moments and the base channels, in whole vectors of four
const int GRADIENT_FLOATS = 4 * GRADIENT_VECTORS;
const int CAMERA_GRADIENTS = 10; // by the twist (rho, theta) and by fx, fy, cx, cy
#endif
