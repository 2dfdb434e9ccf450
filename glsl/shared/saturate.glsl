// a + b, or the largest number where that overflows.
uint saturated(uint a, uint b) {
    uint sum = a + b;
    return sum < a ? 0xffffffffu : sum;
}
