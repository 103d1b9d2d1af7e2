// L1 + D-SSIM between an image and a fixed target, with its gradient, in one sweep over the rows.
//
// SSIM ("Image quality assessment", Wang et al. 2004) compares moments under an 11 x 11 Gaussian window of sigma 1.5;
// beyond the border the images count as 0, as in 3DGS. With the blur B, which is its own transpose,
//   dSSIM/dx = B[dS/dm] + 2 x B[dS/d(xx)] + y B[dS/d(xy)],   m = B[x], xx = B[x^2], xy = B[x y].
// A row is blurred along x, waits in a ring until its neighbours are there to blur along y, gives the derivatives,
// which are blurred the same way five rows later. The rings stay in the cache; nothing of image size is stored.
#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <cstring>

#include "photometric_blur.h"
#include "threads.h"

namespace core {
namespace {

struct Plane {
    const float* image;
    const float* target;
    const float* target_mean;      // blurred target
    const float* target_variance;  // blurred square minus squared mean
    const float* weights;          // null: all 1
    float* gradient;               // null: not wanted
    int width, height;
};

struct Sums {
    double absolute = 0, dissimilarity = 0;
};

// Rows of the image with zeros around them. Where the weight is 0 the image is taken to equal the target, so that
// such a pixel has no influence through its neighbours' windows either.
struct Rows {
    Buffer<float> memory;
    int row_stride;

    void reset(int rows, int width) {
        row_stride = stride(width);
        std::memset(memory.resize(size_t(rows) * row_stride), 0, sizeof(float) * rows * row_stride);
    }
    float* row(int index) { return &memory[size_t(index) * row_stride + kMargin]; }
};

void read_image_row(const Plane& plane, int y, float* row) {
    const size_t at = size_t(y) * plane.width;
    std::memcpy(row, plane.image + at, sizeof(float) * plane.width);
    if (!plane.weights) return;
    for (int x = 0; x < plane.width; ++x)
        if (plane.weights[at + x] == 0) row[x] = plane.target[at + x];
}

struct Scratch {
    Rows rows;         // image, target, and the three derivatives
    Ring moments;      // blurred along x: image, its square, its product with the target
    Ring derivatives;  // blurred along x
};

// Weighted 1 - SSIM of row y summed; its derivatives into three rows.
double similarity_row(const Plane& plane, int y, Ring& moments, float* (&derivatives)[3]) {
    const ColumnBlur mean(moments, y, 0), square(moments, y, 1), product(moments, y, 2);
    const size_t at = size_t(y) * plane.width;
    Vec sum{};
    for (int x = 0; x < plane.width; x += kLanes) {
        const int valid = plane.width - x;
        const Vec m1 = mean.at(x), m2 = load_part(plane.target_mean + at + x, valid);
        const Vec variance2 = load_part(plane.target_variance + at + x, valid);
        const Vec a1 = 2.0f * m1 * m2 + kC1, a2 = 2.0f * (product.at(x) - m1 * m2) + kC2;
        const Vec b1 = m1 * m1 + m2 * m2 + kC1, b2 = square.at(x) - m1 * m1 + variance2 + kC2;
        const Vec inverse = 1.0f / (b1 * b2), similarity = a1 * a2 * inverse;
        const Vec weight = load_part(plane.weights ? plane.weights + at + x : kOnes, valid);
        store(derivatives[0] + x, weight * inverse * 2.0f * (m2 * (a2 - a1) - m1 * similarity * (b2 - b1)));
        store(derivatives[1] + x, -weight * similarity * b1 * inverse);
        store(derivatives[2] + x, weight * 2.0f * a1 * inverse);
        sum += weight * (1.0f - similarity);
    }
    return sum_lanes(sum);
}

// Gradient of row y, and the sum of its weighted absolute differences.
double gradient_row(const Plane& plane, int y, Ring& derivatives, float l1_factor, float ssim_factor) {
    const ColumnBlur mean(derivatives, y, 0), square(derivatives, y, 1), product(derivatives, y, 2);
    const size_t at = size_t(y) * plane.width;
    const Vec one = splat(1.0f);
    Vec sum{};
    for (int x = 0; x < plane.width; x += kLanes) {
        const int valid = plane.width - x;
        const Vec image = load_part(plane.image + at + x, valid), target = load_part(plane.target + at + x, valid);
        const Vec weight = load_part(plane.weights ? plane.weights + at + x : kOnes, valid);
        const Vec difference = image - target;
        sum += weight * absolute(difference);
        if (!plane.gradient) continue;
        const Vec sign = keep(less(Vec{}, difference), one) - keep(less(difference, Vec{}), one);
        const Vec structure = mean.at(x) + 2.0f * image * square.at(x) + target * product.at(x);
        const Vec gradient = keep(less(Vec{}, weight), l1_factor * weight * sign - ssim_factor * structure);
        store_part(plane.gradient + at + x, gradient, valid);
    }
    return sum_lanes(sum);
}

Sums sweep(const Plane& plane, int begin, int end, float l1_factor, float ssim_factor, Scratch& scratch) {
    const int width = plane.width, height = plane.height;
    scratch.rows.reset(5, width);
    scratch.moments.reset(3, width);
    scratch.derivatives.reset(3, width);
    float *image = scratch.rows.row(0), *target = scratch.rows.row(1);
    float* derivatives[3] = {scratch.rows.row(2), scratch.rows.row(3), scratch.rows.row(4)};

    Sums sums;
    // `y` is the row that comes in; its moments are whole 5 rows later, its derivatives after 10.
    for (int y = begin - 2 * kRadius; y < end + 2 * kRadius; ++y) {
        if (y >= 0 && y < height) {
            read_image_row(plane, y, image);
            std::memcpy(target, plane.target + size_t(y) * width, sizeof(float) * width);
            blur_moments_along_x(image, target, scratch.moments.row(y, 0), scratch.moments.row(y, 1),
                                 scratch.moments.row(y, 2), width);
        } else {
            scratch.moments.clear(y);
        }

        const int middle = y - kRadius;
        if (middle < begin - kRadius) continue;
        if (middle >= 0 && middle < height) {
            const double lost = similarity_row(plane, middle, scratch.moments, derivatives);
            if (middle >= begin && middle < end) sums.dissimilarity += lost;
            for (int map = 0; map < 3 && plane.gradient; ++map) {
                std::fill(derivatives[map] + width, derivatives[map] + padded(width), 0.0f);
                blur_along_x(derivatives[map], scratch.derivatives.row(middle, map), width);
            }
        } else {
            scratch.derivatives.clear(middle);
        }

        const int out = middle - kRadius;
        if (out >= begin) sums.absolute += gradient_row(plane, out, scratch.derivatives, l1_factor, ssim_factor);
    }
    return sums;
}

// Blurred target and its variance of one plane.
void target_moments(const float* target, int width, int height, float* mean_out, float* variance_out) {
    Rows rows;
    Ring ring;
    rows.reset(2, width);
    ring.reset(2, width);
    for (int y = -kRadius; y < height + kRadius; ++y) {
        if (y >= 0 && y < height) {
            std::memcpy(rows.row(0), target + size_t(y) * width, sizeof(float) * width);
            for (int x = 0; x < width; ++x) rows.row(1)[x] = rows.row(0)[x] * rows.row(0)[x];
            for (int map = 0; map < 2; ++map) blur_along_x(rows.row(map), ring.row(y, map), width);
        } else {
            ring.clear(y);
        }
        const int out = y - kRadius;
        if (out < 0) continue;
        const ColumnBlur mean(ring, out, 0), square(ring, out, 1);
        for (int x = 0; x < width; x += kLanes) {
            const Vec m = mean.at(x);
            store_part(mean_out + size_t(out) * width + x, m, width - x);
            store_part(variance_out + size_t(out) * width + x, square.at(x) - m * m, width - x);
        }
    }
}

}  // namespace
}  // namespace core

using namespace core;

// Planar images (3, H, W). The moments that `core_photometric` needs of a target.
CORE_API void core_photometric_moments(const float* target, int width, int height, float* mean, float* variance) {
    const size_t plane = size_t(width) * height;
    run_parallel(3, [&](int channel, int) {
        const size_t at = channel * plane;
        target_moments(target + at, width, height, mean + at, variance + at);
    });
}

// (1 - ssim_weight) * mean |image - target| + ssim_weight * mean (1 - SSIM), the means weighted by `weights` (H, W), of
// which `total_weight` is the sum. Planar images (3, H, W); `gradient` as the image, or null.
CORE_API double core_photometric(const float* image, const float* target, const float* target_mean,
                                 const float* target_variance, const float* weights, double total_weight,
                                 double ssim_weight, int width, int height, float* gradient) {
    const size_t plane_size = size_t(width) * height;
    const int bands = (height + kBandRows - 1) / kBandRows;
    const double unit = total_weight > 0 ? 1 / (3 * total_weight) : 0;
    Buffer<Sums> sums;
    sums.resize(size_t(3) * bands);
    run_parallel(3 * bands, [&](int task, int) {
        thread_local Scratch scratch;
        const size_t at = task / bands * plane_size;
        const Plane plane = {image + at, target + at, target_mean + at, target_variance + at, weights,
                             gradient ? gradient + at : nullptr, width, height};
        const int begin = task % bands * kBandRows, end = std::min(height, begin + kBandRows);
        sums[task] = sweep(plane, begin, end, float(unit * (1 - ssim_weight)), float(unit * ssim_weight), scratch);
    });
    double loss = 0;
    for (int task = 0; task < 3 * bands; ++task)
        loss += (1 - ssim_weight) * sums[task].absolute + ssim_weight * sums[task].dissimilarity;
    return unit * loss;
}
