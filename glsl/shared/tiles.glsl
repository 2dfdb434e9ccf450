// Tiles that a splat can change, row by row of tiles: the tiles where log2(o e^p) reaches
// log2(1/255) within the rectangle spanned by the pixel centres. The band of a row cuts a convex
// piece out of the ellipse, so the tiles of a row are an interval, whose ends follow from two
// chords. `precise`, because counting and writing must take exactly the same decisions. Needs
// `projected`.
#include "shared/layout.glsl"
#include "shared/cutoffs.glsl"
// The raster pass evaluates the same power in another order; 1e-3 covers the rounding difference of
// powers up to 1e4.
const float MARGIN = 1e-3;

struct Ellipse { // A' dx² + B' dx dy + C' dy² + k = 0, with A', C' < 0
    float u, v;          // centre
    float inv_a, det, k; // 1 / A', A'C' − B'²/4, A' k
    float slope;         // dx per dy of the middles of horizontal chords
    float right_dy;      // dy of the rightmost point; that of the leftmost is its negative
    int first_row, last_row;
};

// Added to either side of the rows that an ellipse reaches within the image's columns, pixels:
// `interval_of` decides, and its rounding differs.
const float ROW_SLACK = 0.0625;

// Ellipse of a splat, with its rows of tiles within `begin` .. `end`: those that it reaches within
// the `columns` of tiles, and at most one where it reaches none. A near splat beside the image
// would have hundreds.
Ellipse ellipse_of(uint splat, uint begin, uint end, uint columns) {
    vec4 p = projected[PROJECTED_VECTORS * splat], q = projected[PROJECTED_VECTORS * splat + 1];
    precise float inv_a = 1.0 / p.z, det = q.z;
    precise float k = max(q.y - LOG2_ALPHA_MIN + MARGIN, 0.0) * p.z;
    precise float kc = k * inv_a * q.x; // C' k
    precise float half_height = sqrt(max(-k / det, 0.0)), half_width = sqrt(max(-kc / det, 0.0));
    precise float slope = -0.5 * p.w * inv_a, slope_y = -0.5 * p.w / q.x, right_dy = slope_y * half_width;
    Ellipse e = Ellipse(p.x, p.y, inv_a, det, k, slope, right_dy, 0, 0);
    // Its lowest and highest points, or where it leaves the columns.
    precise float low = -e.u, high = low + float(columns * TILE - 1);
    precise float lowest = slope * half_height;
    precise float bottom = clamp(lowest, low, high), top = clamp(-lowest, low, high);
    precise float down = bottom == lowest ? half_height : slope_y * bottom - sqrt(max(-kc - det * bottom * bottom, 0.0)) / q.x;
    precise float up = top == -lowest ? -half_height : slope_y * top + sqrt(max(-kc - det * top * top, 0.0)) / q.x;
    // Clamped as floats first: a far splat must not overflow the conversion to int.
    e.first_row = int(clamp(ceil((e.v + up - ROW_SLACK - float(TILE - 1)) / float(TILE)), float(begin), float(end)));
    e.last_row = int(clamp(floor((e.v + down + ROW_SLACK) / float(TILE)), float(begin) - 1.0, float(end) - 1.0));
    if (q.y < LOG2_ALPHA_MIN) e.last_row = e.first_row - 1;
    return e;
}

// First and last tile of a row; none when first > last.
ivec2 interval_of(Ellipse e, int row, uint columns) {
    precise float low = float(row * TILE) - e.v, high = low + float(TILE - 1);
    precise float right = clamp(e.right_dy, low, high), left = clamp(-e.right_dy, low, high);
    precise float chord_right = sqrt(max(-e.k - e.det * right * right, 0.0));
    precise float chord_left = sqrt(max(-e.k - e.det * left * left, 0.0));
    precise float x1 = e.u + e.slope * right - e.inv_a * chord_right;
    precise float x0 = e.u + e.slope * left + e.inv_a * chord_left;
    float last = float(columns) - 1.0;
    return ivec2(int(clamp(ceil((x0 - float(TILE - 1)) / float(TILE)), 0.0, last + 1.0)),
                 int(clamp(floor(x1 / float(TILE)), -1.0, last)));
}
