// The Gaussian window of SSIM, applied to rows and then to the columns of the last rows, in vectors of floats.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <cstring>

#include "buffer.h"
#include "simd.h"

namespace core {
namespace {

constexpr int kRadius = 5;
constexpr int kWindow = 2 * kRadius + 1;
constexpr int kMargin = 16;     // zeros on both sides of a row, at least kRadius and aligned
constexpr int kBandRows = 96;     // rows of a task: fixed, so that the sums do not depend on the threads
constexpr float kC1 = 0.01f * 0.01f, kC2 = 0.03f * 0.03f;

// The weights of an image without weights.
constexpr float kOnes[16] = {1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1};

struct Kernel {
    float half[kRadius + 1];  // from the rim to the middle
    Kernel() {
        double sum = 0, values[kRadius + 1];
        for (int i = 0; i <= kRadius; ++i) {
            values[i] = std::exp(-(i - kRadius) * (i - kRadius) / (2 * 1.5 * 1.5));
            sum += i < kRadius ? 2 * values[i] : values[i];
        }
        for (int i = 0; i <= kRadius; ++i) half[i] = float(values[i] / sum);
    }
};
const Kernel kKernel;

// The first `valid` of kLanes floats, and zeros.
inline Vec load_part(const float* from, int valid) {
    if (valid >= kLanes) return load_unaligned(from);
    alignas(64) float values[kLanes] = {};
    std::copy(from, from + valid, values);
    return load(values);
}
inline void store_part(float* to, Vec value, int valid) {
    if (valid >= kLanes) {
        store_unaligned(to, value);
        return;
    }
    alignas(64) float values[kLanes];
    store(values, value);
    std::copy(values, values + valid, to);
}

inline float sum_lanes(Vec value) {
    float sum = 0;
    for (int lane = 0; lane < kLanes; ++lane) sum += value[lane];
    return sum;
}

int padded(int width) { return (width + 15) / 16 * 16; }
int stride(int width) { return padded(width) + 2 * kMargin; }

// out[x] = blur along x of `row`, which has kMargin zeros on both sides.
void blur_along_x(const float* row, float* out, int width) {
    for (int x = 0; x < width; x += kLanes) {
        Vec sum = kKernel.half[kRadius] * load(row + x);
        for (int i = 0; i < kRadius; ++i)
            sum += kKernel.half[i] * (load_unaligned(row + x + i - kRadius) + load_unaligned(row + x + kRadius - i));
        store(out + x, sum);
    }
}

// The same of the image, its square and its product with the target, which are not stored before.
void blur_moments_along_x(const float* image, const float* target, float* mean, float* square, float* product,
                          int width) {
    for (int x = 0; x < width; x += kLanes) {
        Vec sums[3] = {};
        for (int i = -kRadius; i <= kRadius; ++i) {
            const Vec value = load_unaligned(image + x + i), other = load_unaligned(target + x + i);
            const Vec weighted = kKernel.half[kRadius - std::abs(i)] * value;
            sums[0] += weighted;
            sums[1] += weighted * value;
            sums[2] += weighted * other;
        }
        store(mean + x, sums[0]);
        store(square + x, sums[1]);
        store(product + x, sums[2]);
    }
}

// The last kWindow rows of several maps.
struct Ring {
    Buffer<float> memory;
    int maps, row_stride;

    void reset(int map_count, int width) {
        // One cache line more than the row: at a power of two, the rows' columns would share a few sets of the cache.
        maps = map_count, row_stride = padded(width) + 16;
        memory.resize(size_t(kWindow) * maps * row_stride);
    }
    float* row(int y, int map) { return &memory[size_t((y + 2 * kWindow) % kWindow * maps + map) * row_stride]; }
    void clear(int y) { std::memset(row(y, 0), 0, sizeof(float) * maps * row_stride); }
};

// Blur along y at row y, where rows y - 5 to y + 5 of a map are in the ring.
struct ColumnBlur {
    const float* rows[kWindow];
    ColumnBlur(Ring& ring, int y, int map) {
        for (int i = 0; i < kWindow; ++i) rows[i] = ring.row(y + i - kRadius, map);
    }
    Vec at(int x) const {
        Vec sum = kKernel.half[kRadius] * load(rows[kRadius] + x);
        for (int i = 0; i < kRadius; ++i)
            sum += kKernel.half[i] * (load(rows[i] + x) + load(rows[kWindow - 1 - i] + x));
        return sum;
    }
};

}  // namespace
}  // namespace core
