// The one place that depends on float atomics. A shader that includes this file is compiled twice,
// with FLOAT_ATOMICS=1 (VK_EXT_shader_atomic_float) and FLOAT_ATOMICS=0 (compare-and-swap loop), and
// the device picks.
//
//   buffer Grad { ATOMIC_FLOAT grad[]; };      // 32-bit floats in memory either way
//   ATOMIC_ADD(grad[i], value);                // statement; the memory operand is evaluated more than once
//   float v = ATOMIC_VALUE(grad[i]);           // plain read
#if FLOAT_ATOMICS
#extension GL_EXT_shader_atomic_float : require
#define ATOMIC_FLOAT float
// naga 30 reads an atomic's value only if it was computed in the same block; `precise` keeps the addition of zero there
// through the optimiser.
float atomic_addend(float value) {
    precise float here = value + 0.0;
    return here;
}
#define ATOMIC_ADD(memory, value) atomicAdd(memory, atomic_addend(value))
#define ATOMIC_VALUE(memory) (memory)
#else
#define ATOMIC_FLOAT uint
// The first exchange guesses zero: a plain read would race with the additions of others.
#define ATOMIC_ADD(memory, value)                                                                  \
    do {                                                                                           \
        float atomic_addend = (value);                                                             \
        uint atomic_seen = 0u;                                                                     \
        uint atomic_expected;                                                                      \
        do {                                                                                       \
            atomic_expected = atomic_seen;                                                         \
            atomic_seen = atomicCompSwap(memory, atomic_expected,                                  \
                                         floatBitsToUint(uintBitsToFloat(atomic_expected) + atomic_addend)); \
        } while (atomic_seen != atomic_expected);                                                  \
    } while (false)
#define ATOMIC_VALUE(memory) uintBitsToFloat(memory)
#endif
