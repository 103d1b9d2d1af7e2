// Vectors of single precision as wide as the instruction set allows, written with GCC/Clang vector extensions.
#pragma once

#include <cstdint>
#include <cstring>

#if defined(__AVX2__)
#include <immintrin.h>
#endif

namespace patchmatch {

#if defined(__AVX512F__)
constexpr int kLanes = 16;
#elif defined(__AVX2__)
constexpr int kLanes = 8;
#else
constexpr int kLanes = 4;
#endif

typedef float FloatVec __attribute__((vector_size(4 * kLanes)));
typedef int32_t IntVec __attribute__((vector_size(4 * kLanes)));
typedef float Float4 __attribute__((vector_size(16)));

inline FloatVec splat(float value) { return value - FloatVec{}; }
inline FloatVec min(FloatVec a, FloatVec b) { return a < b ? a : b; }
inline FloatVec max(FloatVec a, FloatVec b) { return a > b ? a : b; }
inline IntVec truncate(FloatVec x) { return __builtin_convertvector(x, IntVec); }
inline FloatVec to_float(IntVec x) { return __builtin_convertvector(x, FloatVec); }

inline FloatVec load(const float* from) {
    FloatVec result;
    std::memcpy(&result, from, sizeof result);
    return result;
}

// base[index[lane]] for every lane. The one operation that the compilers do not make from portable code.
inline IntVec gather(const int32_t* base, IntVec index) {
#if defined(__AVX512F__)
    return (IntVec)_mm512_mask_i32gather_epi32(_mm512_setzero_si512(), 0xffff, (__m512i)index, base, 4);
#elif defined(__AVX2__)
    return (IntVec)_mm256_i32gather_epi32(base, (__m256i)index, 4);
#else
    IntVec result;
    for (int lane = 0; lane < kLanes; ++lane) result[lane] = base[index[lane]];
    return result;
#endif
}

// The sum over all lanes: folded to four by halves, so that no lane is read one at a time before that.
inline float sum(FloatVec x) {
    Float4 parts[kLanes / 4];
    std::memcpy(parts, &x, sizeof x);
    for (int count = kLanes / 8; count > 0; count /= 2)
        for (int i = 0; i < count; ++i) parts[i] += parts[i + count];
    return (parts[0][0] + parts[0][2]) + (parts[0][1] + parts[0][3]);
}

}  // namespace patchmatch
