// How well a plane explains the reference window in one source: bilaterally weighted normalised cross-correlation.
#pragma once

#include <algorithm>
#include <cmath>

#include "patchmatch.h"
#include "patchmatch_simd.h"

namespace patchmatch {

constexpr int kRadius = 5;    // the window is 11 x 11 pixels ...
constexpr int kSamples = 32;  // ... sampled at odd offsets without the corners: a whole number of vectors
constexpr int kVectors = kSamples / kLanes;

// Offsets of the samples from the centre, and their places in a row-major image that is `stride` wide.
struct Pattern {
    FloatVec right[kVectors], down[kVectors], closeness[kVectors];
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

// The reference window: weights that sum to 1 and weighted grey values about their mean.
struct Window {
    FloatVec weight[kVectors], weighted[kVectors];
    float mean, variance;

    // `centre` points into an image of floats, stored as the bits of int32, with kRadius pixels around it.
    Window(const Pattern& pattern, const int32_t* centre, float sigma_grey) {
        float centre_grey;
        std::memcpy(&centre_grey, centre, sizeof centre_grey);
        FloatVec grey[kVectors], total = {}, first = {};
        const float falloff = 1.0f / (16.0f * sigma_grey * sigma_grey);
        for (int k = 0; k < kVectors; ++k) {
            grey[k] = (FloatVec)gather(centre, pattern.place[k]);
            const FloatVec difference = grey[k] - centre_grey;
            // (1 - x / 8)^8 for exp(-x): no call, and exactly zero far away.
            FloatVec w = max(1.0f - difference * difference * falloff, FloatVec{});
            w *= w;
            w *= w;
            w *= w;
            weight[k] = w * pattern.closeness[k] + 1e-6f;
            total += weight[k];
            first += weight[k] * grey[k];
        }
        const float scale = 1.0f / sum(total);
        mean = sum(first) * scale;
        FloatVec second = {};
        for (int k = 0; k < kVectors; ++k) {
            weight[k] *= scale;
            const FloatVec centred = grey[k] - mean;
            weighted[k] = weight[k] * centred;
            second += weighted[k] * centred;
        }
        variance = sum(second);
    }
};

// A (u, v, 1) of a transfer, to which every hypothesis of that pixel adds t w.
struct Ray {
    float x, y, z;
};

inline Ray ray_through(const Transfer& transfer, float u, float v) {
    const float* A = transfer.A;
    return {A[0] * u + A[1] * v + A[2], A[3] * u + A[4] * v + A[5], A[6] * u + A[7] * v + A[8]};
}

inline Ray at_inverse_depth(const Ray& ray, const Transfer& transfer, float w) {
    return {ray.x + transfer.t[0] * w, ray.y + transfer.t[1] * w, ray.z + transfer.t[2] * w};
}

// Whether a homogeneous pixel is in front of the camera and inside its image; then (u, v) is where.
inline bool lands_inside(const Ray& point, int width, int height, float& u, float& v) {
    if (!(point.z > 1e-6f)) return false;
    u = point.x / point.z;
    v = point.y / point.z;
    return u >= 0 && v >= 0 && u < float(width) && v < float(height);
}

// 1 - NCC of the window with its image in the source under the plane, limited to [0, 1]. `centre` is the homogeneous
// source pixel of the window's centre and must be inside the image; samples outside repeat the border.
inline float matching_cost(
    const Window& window, const Pattern& pattern, const Source& source, const Plane& plane, const Ray& centre,
    float noise_variance
) {
    const float* A = source.from_reference.A;
    const float* t = source.from_reference.t;
    const float xu = A[0] + t[0] * plane.du, xv = A[1] + t[0] * plane.dv;
    const float yu = A[3] + t[1] * plane.du, yv = A[4] + t[1] * plane.dv;
    const float zu = A[6] + t[2] * plane.du, zv = A[7] + t[2] * plane.dv;
    const FloatVec max_x = splat(float(source.width - 1)), max_y = splat(float(source.height - 1));
    const FloatVec zero = {}, smallest_z = splat(1e-6f);

    FloatVec first = {}, second = {}, product = {};
    for (int k = 0; k < kVectors; ++k) {
        const FloatVec dx = pattern.right[k], dy = pattern.down[k];
        const FloatVec inverse_z = 1.0f / max(centre.z + zu * dx + zv * dy, smallest_z);
        const FloatVec x = min(max((centre.x + xu * dx + xv * dy) * inverse_z - 0.5f, zero), max_x);
        const FloatVec y = min(max((centre.y + yu * dx + yv * dy) * inverse_z - 0.5f, zero), max_y);
        const IntVec column = truncate(x), row = truncate(y);
        const FloatVec right = x - to_float(column), below = y - to_float(row);
        const IntVec four = gather(source.packed, row * source.width + column);
        const FloatVec top_left = to_float(four & 255), top_right = to_float((four >> 8) & 255);
        const FloatVec bottom_left = to_float((four >> 16) & 255), bottom_right = to_float((four >> 24) & 255);
        const FloatVec top = top_left + right * (top_right - top_left);
        const FloatVec bottom = bottom_left + right * (bottom_right - bottom_left);
        const FloatVec grey = top + below * (bottom - top) - window.mean;
        const FloatVec weighted = window.weight[k] * grey;
        first += weighted;
        second += weighted * grey;
        product += window.weighted[k] * grey;
    }
    const float mean = sum(first);
    const float variance = std::max(sum(second) - mean * mean, 0.0f);
    const float normaliser = (window.variance + noise_variance) * (variance + noise_variance);
    return std::min(1.0f - sum(product) / std::sqrt(normaliser), 1.0f);
}

}  // namespace patchmatch
