// Products of 8-bit descriptors, and scores made of them: what matching among all and matching nearby share.
//
// A descriptor is 128 bytes below 128 (one factor of _mm256_maddubs is signed) of norm at most 181, so that the dot
// product of any two, and each part of it, is below 2^15 (Cauchy and Schwarz): products may be summed in 16-bit lanes,
// exactly and alike on every instruction set.
#pragma once

#include <cstddef>
#include <cstdint>

#include "simd.h"

namespace core {

constexpr int kSize = 128;      // bytes of a descriptor
constexpr int kLargestHalf = 16380;  // half of 181^2, rounded down
constexpr int kOffset = 16320;  // above half the largest squared norm: keeps scores positive

// NEON multiplies bytes into 16-bit lanes of two registers or, since Armv8.2, adds four products into a 32-bit lane.
#if defined(__ARM_FEATURE_DOTPROD)
typedef IntVec Sums;
#elif defined(__aarch64__)
struct Sums {
    uint16x8_t low, high;
};
#else
typedef int16_t Sums __attribute__((vector_size(4 * CORE_LANES)));
#endif

// sums += the products of bytes, added in pairs or fours, or not yet.
inline Sums multiply_add(Sums sums, IntVec a, IntVec b) {
#if CORE_LANES == 16 && defined(__AVX512BW__)
    return sums + (Sums)_mm512_maddubs_epi16((__m512i)a, (__m512i)b);
#elif CORE_LANES == 8
    return sums + (Sums)_mm256_maddubs_epi16((__m256i)a, (__m256i)b);
#elif defined(__ARM_FEATURE_DOTPROD)
    return (Sums)vdotq_u32((uint32x4_t)sums, (uint8x16_t)a, (uint8x16_t)b);
#elif defined(__aarch64__)
    const uint8x16_t x = (uint8x16_t)a, y = (uint8x16_t)b;
    return {vmlal_u8(sums.low, vget_low_u8(x), vget_low_u8(y)), vmlal_high_u8(sums.high, x, y)};
#else
    const Sums low = (Sums)(a & 0x00ff00ff) * (Sums)(b & 0x00ff00ff);
    const Sums high = (Sums)(((BitVec)a >> 8) & 0x00ff00ffu) * (Sums)(((BitVec)b >> 8) & 0x00ff00ffu);
    return sums + low + high;
#endif
}

// One dot product a lane. Each part of a sum is at least 0, and together they fit 16 bits.
inline IntVec dot_products(Sums sums) {
#if defined(__ARM_FEATURE_DOTPROD)
    return sums;
#elif defined(__aarch64__)
    return (IntVec)vpaddq_u32(vpaddlq_u16(sums.low), vpaddlq_u16(sums.high));
#else
    const BitVec both = (BitVec)sums;
    return (IntVec)((both & 0xffffu) + (both >> 16));
#endif
}

// Half the squared norm of a descriptor, rounded down.
inline int32_t half_norm(const uint8_t* descriptor) {
    int32_t squared = 0;
    for (int k = 0; k < kSize; ++k) squared += descriptor[k] * descriptor[k];
    return squared / 2;
}

// Whether sums of products of these descriptors fit: each byte is below 128, and each norm at most 181.
inline bool fit_sums(const uint8_t* descriptors, int count) {
    for (int i = 0; i < count; ++i) {
        const uint8_t* descriptor = descriptors + size_t(i) * kSize;
        uint8_t bits = 0;
        for (int k = 0; k < kSize; ++k) bits |= descriptor[k];
        if (bits > 127 || half_norm(descriptor) > kLargestHalf) return false;
    }
    return true;
}

// A score and the index that has it in one number, so that the larger is the better and, of equals, the earlier.
inline int32_t index_of(int32_t packed) { return 0xffff - (packed & 0xffff); }
inline int32_t score_of(int32_t packed) { return packed >> 16; }

// The same as one number.
inline int32_t packed(int32_t score, int index) { return (score << 16) + (0xffff - index); }

}  // namespace core
