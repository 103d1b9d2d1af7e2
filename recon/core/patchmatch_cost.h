// How well planes explain a pixel's window in other views: bilaterally weighted normalised cross-correlation.
//
// Nothing in here branches on a result. A matching cost ends a long chain of dependent instructions, and a branch
// that is predicted wrongly at its end costs as much as the chain (measured: a third of the time of a cost).
#pragma once

#include <algorithm>
#include <cmath>
#include <cstring>
#include <vector>

#include "patchmatch.h"
#include "simd.h"

namespace patchmatch {

using core::IntVec;
using core::kLanes;
using core::maximum;
using core::minimum;
using core::splat;
using core::Vec;

constexpr int kRadius = 5;    // the window is 11 x 11 pixels ...
constexpr int kSamples = 32;  // ... sampled at odd offsets without the corners: a whole number of vectors
constexpr int kVectors = kSamples / kLanes;
constexpr int kMaxCandidates = 4;  // planes that are compared at once
constexpr float kSmallestZ = 1e-6f;

// base[index] in every lane.
inline IntVec gather(const int32_t* base, IntVec index) {
#if CORE_LANES == 16
    return (IntVec)_mm512_mask_i32gather_epi32(_mm512_setzero_si512(), 0xffff, (__m512i)index, base, 4);
#elif CORE_LANES == 8
    return (IntVec)_mm256_i32gather_epi32(base, (__m256i)index, 4);
#else
    IntVec result;
    for (int lane = 0; lane < kLanes; ++lane) result[lane] = base[index[lane]];
    return result;
#endif
}

// The sum over all lanes: folded by halves to four, so that no lane is read one at a time before that.
inline float sum(Vec x) {
    typedef float Float4 __attribute__((vector_size(16)));
    Float4 parts[kLanes / 4];
    std::memcpy(parts, &x, sizeof x);
    for (int count = kLanes / 8; count > 0; count /= 2)
        for (int i = 0; i < count; ++i) parts[i] += parts[i + count];
    return (parts[0][0] + parts[0][2]) + (parts[0][1] + parts[0][3]);
}

// Moved into [0, most]; INT32_MIN stands for what no integer can hold.
inline IntVec within(IntVec x, int32_t most) {
#if CORE_LANES == 16
    return (IntVec)_mm512_min_epi32(_mm512_max_epi32((__m512i)x, _mm512_setzero_si512()), _mm512_set1_epi32(most));
#elif CORE_LANES == 8
    return (IntVec)_mm256_min_epi32(_mm256_max_epi32((__m256i)x, _mm256_setzero_si256()), _mm256_set1_epi32(most));
#else
    x &= ~(x >> 31);
    const IntVec beyond = x > most;
    return (x & ~beyond) | (most & beyond);
#endif
}

constexpr int kStepBits = 6, kSteps = 1 << kStepBits;  // of a pixel, at which sources are sampled
constexpr float kPerSquaredStep = 1.0f / (kSteps * kSteps);

// The bilinear sample, times kSteps^2, of the four grey values that each lane holds (see patchmatch_pack), `right` and
// `below` the first by so many steps. Exact, hence the same for all instruction sets.
inline IntVec between(IntVec four, IntVec right, IntVec below) {
#if CORE_LANES == 16
    const IntVec columns = (right << 8) - right + kSteps, rows = (below << 16) - below + kSteps;
    const __m512i both = _mm512_maddubs_epi16((__m512i)four, (__m512i)(columns | (columns << 16)));
    return (IntVec)_mm512_madd_epi16(both, (__m512i)rows);
#elif CORE_LANES == 8
    const IntVec columns = (right << 8) - right + kSteps, rows = (below << 16) - below + kSteps;
    const __m256i both = _mm256_maddubs_epi16((__m256i)four, (__m256i)(columns | (columns << 16)));
    return (IntVec)_mm256_madd_epi16(both, (__m256i)rows);
#else
    const IntVec top = (four & 255) * (kSteps - right) + ((four >> 8) & 255) * right;
    const IntVec bottom = ((four >> 16) & 255) * (kSteps - right) + ((four >> 24) & 255) * right;
    return top * (kSteps - below) + bottom * below;
#endif
}

inline Vec to_float(IntVec x) { return __builtin_convertvector(x, Vec); }

// Grey values as floats with kRadius repeated pixels on every side, so that windows need no bounds.
class Padded {
public:
    Padded(const uint8_t* grey, int width, int height) : stride_(width + 2 * kRadius) {
        bits_.resize(size_t(stride_) * (height + 2 * kRadius));
        for (int y = -kRadius; y < height + kRadius; ++y)
            for (int x = -kRadius; x < width + kRadius; ++x) {
                const int row = std::clamp(y, 0, height - 1), column = std::clamp(x, 0, width - 1);
                const float value = grey[size_t(row) * width + column];
                std::memcpy(&bits_[place(x, y)], &value, sizeof value);
            }
    }
    int stride() const { return stride_; }
    // The bits of a float, with as many around it as a window needs.
    const int32_t* at(int x, int y) const { return &bits_[place(x, y)]; }

private:
    size_t place(int x, int y) const { return size_t(y + kRadius) * stride_ + x + kRadius; }

    int stride_;
    std::vector<int32_t> bits_;
};

// Offsets of the samples from the centre, and their places in a row-major image that is `stride` wide.
struct Pattern {
    Vec right[kVectors], down[kVectors], closeness[kVectors];
    IntVec place[kVectors];

    Pattern(int stride, float sigma_space) {
        int sample = 0;
        for (int dy = -kRadius; dy <= kRadius; dy += 2)
            for (int dx = -kRadius; dx <= kRadius; dx += 2) {
                if (std::abs(dx) == kRadius && std::abs(dy) == kRadius) continue;
                const int vector = sample / kLanes, lane = sample % kLanes;
                right[vector][lane] = float(dx);
                down[vector][lane] = float(dy);
                closeness[vector][lane] = std::exp(-float(dx * dx + dy * dy) / (2 * sigma_space * sigma_space));
                place[vector][lane] = dy * stride + dx;
                ++sample;
            }
    }
};

// The window of a pixel: weights that sum to 1, and weighted grey values about their mean.
struct Window {
    Vec weight[kVectors], weighted[kVectors];
    float mean, variance;

    // `centre` points into a padded image.
    Window(const Pattern& pattern, const int32_t* centre, float sigma_grey) {
        float centre_grey;
        std::memcpy(&centre_grey, centre, sizeof centre_grey);
        Vec grey[kVectors], total = {}, first = {};
        const float falloff = 1.0f / (16.0f * sigma_grey * sigma_grey);
        for (int k = 0; k < kVectors; ++k) {
            grey[k] = (Vec)gather(centre, pattern.place[k]);
            const Vec difference = grey[k] - centre_grey;
            // (1 - x / 8)^8 for exp(-x): no call, and exactly zero far away.
            Vec w = maximum(1.0f - difference * difference * falloff, Vec{});
            w *= w;
            w *= w;
            w *= w;
            weight[k] = w * pattern.closeness[k] + 1e-6f;
            total += weight[k];
            first += weight[k] * grey[k];
        }
        const float scale = 1.0f / sum(total);
        mean = sum(first) * scale;
        Vec second = {};
        for (int k = 0; k < kVectors; ++k) {
            weight[k] *= scale;
            const Vec centred = grey[k] - mean;
            weighted[k] = weight[k] * centred;
            second += weighted[k] * centred;
        }
        variance = sum(second);
    }
};

// A homogeneous pixel.
struct Point {
    float x, y, z;
};

// A (u, v, 1) of a transfer, to which every hypothesis of that pixel adds t w.
inline Point ray_through(const Transfer& transfer, float u, float v) {
    const float* A = transfer.A;
    return {A[0] * u + A[1] * v + A[2], A[3] * u + A[4] * v + A[5], A[6] * u + A[7] * v + A[8]};
}

inline Point at_inverse_depth(const Point& ray, const Transfer& transfer, float w) {
    return {ray.x + transfer.t[0] * w, ray.y + transfer.t[1] * w, ray.z + transfer.t[2] * w};
}

// Where a homogeneous pixel falls: (u, v), moved into the image where it is outside or behind the camera.
struct Landing {
    float u, v;
    bool inside;

    Landing(const Point& point, int width, int height) {
        const float inverse_z = 1.0f / std::max(point.z, kSmallestZ);
        const float x = point.x * inverse_z, y = point.y * inverse_z;
        inside = (point.z > kSmallestZ) & (x >= 0) & (y >= 0) & (x < float(width)) & (y < float(height));
        u = std::min(std::max(0.0f, x), float(width) - 0.5f);  // in this order, in which NaN becomes 0
        v = std::min(std::max(0.0f, y), float(height) - 0.5f);
    }
};

// What the costs of many planes and sources are made of, one entry a pair, so that the square roots and divisions are
// done for all at once.
struct Pairs {
    static constexpr int kMost = kMaxCandidates * kMaxSources;
    // Weighted moments of the source's grey values under the plane, about the mean of the reference window.
    float first[kMost], second[kMost], product[kMost];
    // The source's own point, where the plane's point lands, back in the reference: a homogeneous pixel; z is 0 where
    // the source knows no depth.
    float back_x[kMost], back_y[kMost], back_z[kMost];
    float outside[kMost];  // 1 where the plane's point lands outside the source's image, else 0
    int count = 0;
};

// `centre` is the homogeneous source pixel of the window's centre. Samples are taken at 1 / kSteps of a pixel; outside
// the image they repeat its border.
inline void add_moments(
    const Plane& plane, const Window& window, const Pattern& pattern, const Source& source, const Point& centre,
    Pairs& pairs
) {
    const float* A = source.from_reference.A;
    const float* t = source.from_reference.t;
    const float xu = A[0] + t[0] * plane.du, xv = A[1] + t[0] * plane.dv;
    const float yu = A[3] + t[1] * plane.du, yv = A[4] + t[1] * plane.dv;
    const float zu = A[6] + t[2] * plane.du, zv = A[7] + t[2] * plane.dv;
    const Vec mean = splat(window.mean), smallest_z = splat(kSmallestZ), half = splat(0.5f * kSteps);

    Vec first = {}, second = {}, product = {};
    for (int k = 0; k < kVectors; ++k) {
        const Vec dx = pattern.right[k], dy = pattern.down[k];
        const Vec steps = float(kSteps) / maximum(centre.z + zu * dx + zv * dy, smallest_z);
        const Vec right = (centre.x + xu * dx + xv * dy) * steps, below = (centre.y + yu * dx + yv * dy) * steps;
        const IntVec x = within(core::nearest_int(right - half), kSteps * (source.width - 1));
        const IntVec y = within(core::nearest_int(below - half), kSteps * (source.height - 1));
        const IntVec four = gather(source.packed, (y >> kStepBits) * source.width + (x >> kStepBits));
        const Vec grey = to_float(between(four, x & (kSteps - 1), y & (kSteps - 1))) * kPerSquaredStep - mean;
        const Vec weighted = window.weight[k] * grey;
        first += weighted;
        second += weighted * grey;
        product += window.weighted[k] * grey;
    }
    pairs.first[pairs.count] = sum(first);
    pairs.second[pairs.count] = sum(second);
    pairs.product[pairs.count] = sum(product);
}

// The source's own depth where a plane's point lands, carried back to the reference.
inline void add_return(const Source& source, const Landing& there, Pairs& pairs) {
    const float w = source.inverse_depth[size_t(there.v) * source.width + size_t(there.u)];
    const Point back = at_inverse_depth(ray_through(source.to_reference, there.u, there.v), source.to_reference, w);
    pairs.back_x[pairs.count] = back.x;
    pairs.back_y[pairs.count] = back.y;
    pairs.back_z[pairs.count] = w > 0 ? back.z : 0;
}

// 1 - NCC, limited to [0, 1]. The noise variance makes flat windows match nothing rather than anything.
inline void matching_costs(const Pairs& pairs, float reference_variance, float noise_variance, float* costs) {
    for (int i = 0; i < pairs.count; ++i) {
        const float variance = std::max(pairs.second[i] - pairs.first[i] * pairs.first[i], 0.0f);
        const float normaliser = (reference_variance + noise_variance) * (variance + noise_variance);
        costs[i] = std::min(1.0f, 1.0f - pairs.product[i] / std::sqrt(normaliser));  // 1 where nothing has a variance
    }
}

// Adds `weight` times the distance in pixels between (u, v) and where the source's own point returns to, limited.
inline void add_reprojection_errors(const Pairs& pairs, float u, float v, float weight, float limit, float* costs) {
    for (int i = 0; i < pairs.count; ++i) {
        const float inverse_z = 1.0f / std::max(pairs.back_z[i], kSmallestZ);
        const float du = pairs.back_x[i] * inverse_z - u, dv = pairs.back_y[i] * inverse_z - v;
        const float error = std::min(limit, std::sqrt(du * du + dv * dv));
        costs[i] += weight * (pairs.back_z[i] > kSmallestZ ? error : limit);
    }
}

// The mean of the `best` lowest of `count` costs, with weights that fall by `ratio` from each to the next: an occluded
// source hardly counts, and two agreeing ones beat a single one. Sorts `costs`.
inline float combine(float* costs, int count, int best, float ratio) {
    for (int end = count - 1; end > 0; --end)
        for (int i = 0; i < end; ++i) {
            const float low = std::min(costs[i], costs[i + 1]), high = std::max(costs[i], costs[i + 1]);
            costs[i] = low;
            costs[i + 1] = high;
        }
    float total = 0, weights = 0, weight = 1;
    for (int i = 0; i < best; ++i, weight *= ratio) {
        total += weight * costs[i];
        weights += weight;
    }
    return total / weights;
}

}  // namespace patchmatch
