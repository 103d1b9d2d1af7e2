// One register of floats, as wide as the instruction set that this file is compiled for.
//
// GCC's and Clang's vector extensions give arithmetic; the few operations that they express badly are intrinsics
// behind guards. Wider vectors than the processor has are split into scalars by the compilers (measured: ten times
// slower), hence the width at compile time.
#pragma once

#include <cmath>
#include <cstddef>
#include <cstdint>

#if defined(__x86_64__)
#include <immintrin.h>
#elif defined(__aarch64__)
#include <arm_neon.h>
#endif

#if defined(__AVX512F__)
#define CORE_LANES 16
#elif defined(__AVX2__)
#define CORE_LANES 8
#else
#define CORE_LANES 4
#endif

namespace core {

constexpr int kLanes = CORE_LANES;

typedef float Vec __attribute__((vector_size(4 * CORE_LANES)));
typedef int32_t IntVec __attribute__((vector_size(4 * CORE_LANES)));
typedef uint32_t BitVec __attribute__((vector_size(4 * CORE_LANES)));
typedef int64_t PairVec __attribute__((vector_size(4 * CORE_LANES)));  // pairs of floats moved as one

inline Vec splat(float value) { return Vec{} + value; }

// For addresses that are multiples of the register's size.
inline Vec load(const float* from) { return *reinterpret_cast<const Vec*>(from); }
inline void store(float* to, Vec value) { *reinterpret_cast<Vec*>(to) = value; }

inline Vec load_unaligned(const float* from) {
    Vec value;
    __builtin_memcpy(&value, from, sizeof value);
    return value;
}
inline void store_unaligned(float* to, Vec value) { __builtin_memcpy(to, &value, sizeof value); }

// ---- Masks: one truth value a lane -------------------------------------------------------------------------------
#if CORE_LANES == 16
typedef __mmask16 Mask;
inline Mask at_least(Vec a, Vec b) { return _mm512_cmp_ps_mask((__m512)a, (__m512)b, _CMP_GE_OQ); }
inline Mask less(Vec a, Vec b) { return _mm512_cmp_ps_mask((__m512)a, (__m512)b, _CMP_LT_OQ); }
inline Vec select(Mask mask, Vec yes, Vec no) { return (Vec)_mm512_mask_blend_ps(mask, (__m512)no, (__m512)yes); }
inline Vec keep(Mask mask, Vec value) { return (Vec)_mm512_maskz_mov_ps(mask, (__m512)value); }
inline unsigned bits(Mask mask) { return mask; }
inline bool any(Mask mask) { return mask != 0; }
#else
typedef IntVec Mask;
inline Mask at_least(Vec a, Vec b) { return a >= b; }
inline Mask less(Vec a, Vec b) { return a < b; }
inline Vec select(Mask mask, Vec yes, Vec no) { return (Vec)(((IntVec)yes & mask) | ((IntVec)no & ~mask)); }
inline Vec keep(Mask mask, Vec value) { return (Vec)((IntVec)value & mask); }
#if CORE_LANES == 8
inline unsigned bits(Mask mask) { return unsigned(_mm256_movemask_ps((__m256)mask)); }
#elif defined(__x86_64__)
inline unsigned bits(Mask mask) { return unsigned(_mm_movemask_ps((__m128)mask)); }
#elif defined(__aarch64__)
inline unsigned bits(Mask mask) {
    const uint32x4_t place = {1, 2, 4, 8};
    return vaddvq_u32(vandq_u32((uint32x4_t)mask, place));
}
#else
inline unsigned bits(Mask mask) { return (mask[0] & 1) | (mask[1] & 2) | (mask[2] & 4) | (mask[3] & 8); }
#endif
#if defined(__aarch64__)
inline bool any(Mask mask) { return vmaxvq_u32((uint32x4_t)mask) != 0; }
#else
inline bool any(Mask mask) { return bits(mask) != 0; }
#endif
#endif

// ---- Functions ---------------------------------------------------------------------------------------------------
inline Vec minimum(Vec a, Vec b) {
#if CORE_LANES == 16
    return (Vec)_mm512_min_ps((__m512)a, (__m512)b);
#elif CORE_LANES == 8
    return (Vec)_mm256_min_ps((__m256)a, (__m256)b);
#elif defined(__x86_64__)
    return (Vec)_mm_min_ps((__m128)a, (__m128)b);
#elif defined(__aarch64__)
    return (Vec)vminnmq_f32((float32x4_t)a, (float32x4_t)b);
#else
    return select(less(a, b), a, b);
#endif
}

inline Vec maximum(Vec a, Vec b) {
#if defined(__aarch64__)
    return (Vec)vmaxnmq_f32((float32x4_t)a, (float32x4_t)b);
#elif CORE_LANES == 8
    return (Vec)_mm256_max_ps((__m256)a, (__m256)b);
#else
    return -minimum(-a, -b);
#endif
}
inline Vec clamp(Vec value, Vec low, Vec high) { return minimum(maximum(value, low), high); }
inline Vec absolute(Vec value) { return (Vec)((BitVec)value & 0x7fffffffu); }

inline Vec square_root(Vec value) {
#if CORE_LANES == 16
    return (Vec)_mm512_sqrt_ps((__m512)value);
#elif CORE_LANES == 8
    return (Vec)_mm256_sqrt_ps((__m256)value);
#elif defined(__x86_64__)
    return (Vec)_mm_sqrt_ps((__m128)value);
#elif defined(__aarch64__)
    return (Vec)vsqrtq_f32((float32x4_t)value);
#else
    for (int lane = 0; lane < kLanes; ++lane) value[lane] = std::sqrt(value[lane]);
    return value;
#endif
}

// The nearest integers; rubbish, but never a trap, for what no int32 can hold.
inline IntVec nearest_int(Vec value) {
#if CORE_LANES == 16
    return (IntVec)_mm512_cvtps_epi32((__m512)value);
#elif CORE_LANES == 8
    return (IntVec)_mm256_cvtps_epi32((__m256)value);
#elif defined(__x86_64__)
    return (IntVec)_mm_cvtps_epi32((__m128)value);
#elif defined(__aarch64__)
    return (IntVec)vcvtnq_s32_f32((float32x4_t)value);
#else
    IntVec nearest;
    for (int lane = 0; lane < kLanes; ++lane)
        nearest[lane] = std::abs(value[lane]) < 1e9f ? int(std::lrint(value[lane])) : 0;
    return nearest;
#endif
}

// a * b + c as one operation where the processor has it. Free to reorder sums, the compilers would make two of some.
inline Vec multiply_add(Vec a, Vec b, Vec c) {
#if CORE_LANES == 16
    return (Vec)_mm512_fmadd_ps((__m512)a, (__m512)b, (__m512)c);
#elif CORE_LANES == 8
    return (Vec)_mm256_fmadd_ps((__m256)a, (__m256)b, (__m256)c);
#elif defined(__aarch64__)
    return (Vec)vfmaq_f32((float32x4_t)c, (float32x4_t)a, (float32x4_t)b);
#else
    return a * b + c;
#endif
}

// 2^x to 2e-7 relative for x in [-126, 0]. Other x give rubbish, never a trap: mask them. Several registers take turns,
// because each waits for its own results: a splat's alpha took 14 cycles by itself and 11.5 in turns with five others.
template <int Count>
inline void exp2_nonpositive(const Vec (&x)[Count], Vec (&power)[Count]) {
    IntVec exponent[Count];
    Vec fraction[Count], square[Count], low[Count], middle[Count], high[Count];
    for (int i = 0; i < Count; ++i) exponent[i] = nearest_int(x[i]);
    for (int i = 0; i < Count; ++i) fraction[i] = x[i] - __builtin_convertvector(exponent[i], Vec);
    // Three pairs of terms at once, then their sum: half as long a wait as term after term.
    for (int i = 0; i < Count; ++i) square[i] = fraction[i] * fraction[i];
    for (int i = 0; i < Count; ++i) high[i] = fraction[i] * 1.326472721e-3f + 9.671512813e-3f;
    for (int i = 0; i < Count; ++i) middle[i] = fraction[i] * 5.550733745e-2f + 2.402224208e-1f;
    for (int i = 0; i < Count; ++i) low[i] = fraction[i] * 6.931469776e-1f + 1.0f;
    for (int i = 0; i < Count; ++i) high[i] = high[i] * square[i] + middle[i];
    for (int i = 0; i < Count; ++i) low[i] = high[i] * square[i] + low[i];
    for (int i = 0; i < Count; ++i) power[i] = (Vec)(((BitVec)exponent[i] << 23) + (BitVec)low[i]);
}

// log2(x) to 1e-7 absolute for normal positive x.
inline Vec log2_positive(Vec x) {
    // x = 2^exponent * mantissa with the mantissa in [sqrt(1/2), sqrt(2)).
    const BitVec offset = (BitVec)x - 0x3f3504f3u;
    const IntVec exponent = (IntVec)offset >> 23;
    const Vec mantissa = (Vec)((offset & 0x007fffffu) + 0x3f3504f3u);
    const Vec s = (mantissa - 1.0f) / (mantissa + 1.0f), ss = s * s;
    const Vec series = (((ss * (1 / 9.0f) + 1 / 7.0f) * ss + 1 / 5.0f) * ss + 1 / 3.0f) * ss + 1.0f;
    return __builtin_convertvector(exponent, Vec) + series * s * 2.88539008177793f;
}

// ---- Lanes from one register to another ---------------------------------------------------------------------------
#if defined(__clang__)
#define CORE_SHUFFLE(a, b, ...) __builtin_shufflevector(a, b, __VA_ARGS__)
#else
#define CORE_SHUFFLE(a, b, ...) __builtin_shuffle(a, b, IntVec{__VA_ARGS__})
#endif

// The lanes of `a` and `b` in turn: those of the first halves, then those of the second.
inline void zip(Vec a, Vec b, Vec& first, Vec& second) {
#if CORE_LANES == 16
    first = CORE_SHUFFLE(a, b, 0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23);
    second = CORE_SHUFFLE(a, b, 8, 24, 9, 25, 10, 26, 11, 27, 12, 28, 13, 29, 14, 30, 15, 31);
#elif CORE_LANES == 8
    first = CORE_SHUFFLE(a, b, 0, 8, 1, 9, 2, 10, 3, 11);
    second = CORE_SHUFFLE(a, b, 4, 12, 5, 13, 6, 14, 7, 15);
#else
    first = CORE_SHUFFLE(a, b, 0, 4, 1, 5);
    second = CORE_SHUFFLE(a, b, 2, 6, 3, 7);
#endif
}

// Rows become columns. Zipping each row of the upper half with its partner of the lower half, log2(kLanes) times.
inline void transpose(Vec (&rows)[kLanes]) {
    for (int round = kLanes; round > 1; round /= 2) {
        Vec zipped[kLanes];
        for (int i = 0; i < kLanes / 2; ++i) zip(rows[i], rows[i + kLanes / 2], zipped[2 * i], zipped[2 * i + 1]);
        for (int i = 0; i < kLanes; ++i) rows[i] = zipped[i];
    }
}

// The same for kLanes rows of 16 floats, which are one register or several.
inline void load_transposed(const float* const (&rows)[kLanes], Vec (&columns)[16]) {
    for (int part = 0; part < 16; part += kLanes) {
        Vec square[kLanes];
        for (int i = 0; i < kLanes; ++i) square[i] = load(rows[i] + part);
        transpose(square);
        for (int i = 0; i < kLanes; ++i) columns[part + i] = square[i];
    }
}
inline void store_transposed(const Vec (&columns)[16], float* const (&rows)[kLanes]) {
    for (int part = 0; part < 16; part += kLanes) {
        Vec square[kLanes];
        for (int i = 0; i < kLanes; ++i) square[i] = columns[part + i];
        transpose(square);
        for (int i = 0; i < kLanes; ++i) store(rows[i] + part, square[i]);
    }
}

// Four floats from each of kLanes / 4 places.
inline Vec load_quads(const float* from, size_t step) {
#if CORE_LANES == 16
    const __m512 first = _mm512_castps128_ps512(_mm_loadu_ps(from));
    const __m512 two = _mm512_insertf32x4(first, _mm_loadu_ps(from + step), 1);
    const __m512 three = _mm512_insertf32x4(two, _mm_loadu_ps(from + 2 * step), 2);
    return (Vec)_mm512_insertf32x4(three, _mm_loadu_ps(from + 3 * step), 3);
#elif CORE_LANES == 8
    return (Vec)_mm256_insertf128_ps(_mm256_castps128_ps256(_mm_loadu_ps(from)), _mm_loadu_ps(from + step), 1);
#else
    (void)step;
    Vec value;
    __builtin_memcpy(&value, from, sizeof value);
    return value;
#endif
}
inline void store_quads(float* to, size_t step, Vec value) {
#if CORE_LANES == 16
    _mm_storeu_ps(to, _mm512_castps512_ps128((__m512)value));
    _mm_storeu_ps(to + step, _mm512_extractf32x4_ps((__m512)value, 1));
    _mm_storeu_ps(to + 2 * step, _mm512_extractf32x4_ps((__m512)value, 2));
    _mm_storeu_ps(to + 3 * step, _mm512_extractf32x4_ps((__m512)value, 3));
#elif CORE_LANES == 8
    _mm_storeu_ps(to, _mm256_castps256_ps128((__m256)value));
    _mm_storeu_ps(to + step, _mm256_extractf128_ps((__m256)value, 1));
#else
    (void)step;
    __builtin_memcpy(to, &value, sizeof value);
#endif
}

// ---- Pairs: lane l of two registers side by side, so that one 64-bit load broadcasts both --------------------------

// Stores 2 * kLanes floats: the pairs (a[l], b[l]) in the order of `pair_lane`, which is the cheap one to make.
inline void store_pairs(float* to, Vec a, Vec b) {
#if CORE_LANES == 16
    store(to, CORE_SHUFFLE(a, b, 0, 16, 1, 17, 4, 20, 5, 21, 8, 24, 9, 25, 12, 28, 13, 29));
    store(to + 16, CORE_SHUFFLE(a, b, 2, 18, 3, 19, 6, 22, 7, 23, 10, 26, 11, 27, 14, 30, 15, 31));
#elif CORE_LANES == 8
    store(to, CORE_SHUFFLE(a, b, 0, 8, 1, 9, 4, 12, 5, 13));
    store(to + 8, CORE_SHUFFLE(a, b, 2, 10, 3, 11, 6, 14, 7, 15));
#else
    store(to, CORE_SHUFFLE(a, b, 0, 4, 1, 5));
    store(to + 4, CORE_SHUFFLE(a, b, 2, 6, 3, 7));
#endif
}

// The lane whose pair `store_pairs` writes at this place.
constexpr int pair_lane(int place) {
    return place % (kLanes / 2) / 2 * 4 + place % 2 + place / (kLanes / 2) * 2;
}

// The two floats at `pair` in every two lanes: (a, b, a, b, ...).
inline Vec broadcast_pair(const float* pair) {
    int64_t both;
    __builtin_memcpy(&both, pair, sizeof both);
    return (Vec)(PairVec{} + both);
}

}  // namespace core
