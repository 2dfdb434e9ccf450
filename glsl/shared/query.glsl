// Code maps and relevancy of a text query; included behind the buffers and the push constants.
// Relevancy is in multiples of 1 / UNIT: its sums over a box are exact in any order.
#ifndef QUERY
#define QUERY
// Side of the box, and its columns or rows before its pixel.
const int SIDE = 30;
const int BEFORE = 15;
// Relevancy 1.
const uint UNIT = 1048576u;
// Bit of a table's entry whose code answers.
const uint ANSWERS = 2147483648u;
// Levels whose sum over a box fits in 32 bits.
const uint SUMMED_LEVELS = 4u;

// Index in 0 .. n of a reflection that does not repeat the border.
int reflected(int i, int n) {
    int period = max(2 * (n - 1), 1), m = abs(i) % period;
    return m < n ? m : period - m;
}

// Entry of a pixel's code in the table of its map; the last entry is that of pixels without a code.
uint entry_of(uint map, uint pixel) {
    uint k = map * (width * height) + pixel;
    uint code = (codes[k >> 1] >> (16u * (k & 1u))) & 0xffffu;
    return tables[map * slots + min(code, slots - 1u)];
}

uint relevancy_of(uint entry) { return entry & ~ANSWERS; }

// Excess over a canonical phrase, max(0, 2 rel - 1).
uint excess_of(uint entry) { return max(2u * relevancy_of(entry), UNIT) - UNIT; }
#endif
