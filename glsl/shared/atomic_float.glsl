// The one place that knows whether float atomics exist. A shader that includes this file is compiled twice, with
// FLOAT_ATOMICS=1 (VK_EXT_shader_atomic_float) and FLOAT_ATOMICS=0 (compare-and-swap loop), and the device picks.
//
//   buffer Grad { ATOMIC_FLOAT grad[]; };      // 32-bit floats in memory either way
//   ATOMIC_ADD(grad[i], value);                // statement; the memory operand is evaluated more than once
//   float v = ATOMIC_VALUE(grad[i]);           // plain read
#if FLOAT_ATOMICS
#extension GL_EXT_shader_atomic_float : require
#define ATOMIC_FLOAT float
#define ATOMIC_ADD(memory, value) atomicAdd(memory, value)
#define ATOMIC_VALUE(memory) (memory)
#else
#define ATOMIC_FLOAT uint
#define ATOMIC_ADD(memory, value)                                                                  \
    do {                                                                                           \
        float atomic_addend = (value);                                                             \
        uint atomic_seen = memory;                                                                 \
        uint atomic_expected;                                                                      \
        do {                                                                                       \
            atomic_expected = atomic_seen;                                                         \
            atomic_seen = atomicCompSwap(memory, atomic_expected,                                  \
                                         floatBitsToUint(uintBitsToFloat(atomic_expected) + atomic_addend)); \
        } while (atomic_seen != atomic_expected);                                                  \
    } while (false)
#define ATOMIC_VALUE(memory) uintBitsToFloat(memory)
#endif
