// Where the patch around a point of one image lies in another image, to a small part of a pixel.
//
// Inverse-compositional alignment (Baker and Matthews, "Lucas-Kanade 20 years on", 2004) of an affine warp, with a gain
// and an offset of the brightness: what depends on the reference patch alone is worked out once. Pixels count less the
// further they are from the point, so that what belongs to another surface at the patch's border weighs little.
#include <algorithm>
#include <cmath>
#include <cstdint>

#include "threads.h"

namespace core {
namespace {

constexpr int kMaxRadius = 12;
constexpr int kMaxSide = 2 * kMaxRadius + 1;
constexpr int kMaxPixels = kMaxSide * kMaxSide;
constexpr int kWarp = 6;            // numbers of an affine warp: four of the matrix, two of the shift
constexpr int kModel = kWarp + 2;   // with gain and offset
constexpr int kPatchesPerTask = 16;
constexpr float kRounding = 1e-3f;     // pixels
constexpr float kConverged = 0.005f;   // pixels
constexpr float kLargestStretch = 4;   // of an axis of the warp: beyond it, two patches are not told apart from others

}  // namespace

// As splatnode.recon.registration.subpixel.Images: grey images of one allocation each.
struct Images {
    const float* const* pixels;
    const int32_t *widths, *heights;
};

// M patches. Positions have the top-left pixel's centre at (0.5, 0.5).
struct Patches {
    const int32_t *reference_image, *target_image;  // (M,)
    const float* reference;                         // (M, 2)
    float *target, *affine;                         // (M, 2) and (M, 2, 2): first guess in, result out
    float *correlation, *sigma;                     // (M,) results
    int32_t count, radius, max_iterations;
};

namespace {

struct Image {
    const float* pixels;
    int width, height;
};

// Whether there are bilinear samples at all of x +- across, y +- down: pixels' centres enclose them.
inline bool encloses(const Image& image, float x, float y, float across, float down) {
    return x - across >= 0.5f && y - down >= 0.5f && x + across < image.width - 0.5f - kRounding &&
           y + down < image.height - 0.5f - kRounding;
}

// The place of each pixel of a patch from its middle, and its weight: of the sum 1.
struct Window {
    int count;
    float x[kMaxPixels], y[kMaxPixels], weight[kMaxPixels];

    explicit Window(int radius) : count(0) {
        const float spread = 0.6f * radius;
        float total = 0;
        for (int row = -radius; row <= radius; ++row)
            for (int column = -radius; column <= radius; ++column, ++count) {
                x[count] = float(column), y[count] = float(row);
                total += weight[count] = std::exp(-(x[count] * x[count] + y[count] * y[count]) / (2 * spread * spread));
            }
        for (int i = 0; i < count; ++i) weight[i] /= total;
    }
};

// The reference patch, and the inverse normal equations of its small changes.
struct Reference {
    const Window& window;
    float value[kMaxPixels];           // of mean 0 and variance 1
    float slopes[kModel][kMaxPixels];  // weighted: how the value changes with each number of the model
    double inverse[kModel][kModel];
};

struct Moments {
    float mean, deviation;
};

Moments moments(const float* values, const float* weights, int count) {
    float sum = 0, squares = 0;
    for (int i = 0; i < count; ++i) sum += weights[i] * values[i];
    for (int i = 0; i < count; ++i) squares += weights[i] * (values[i] - sum) * (values[i] - sum);
    return {sum, std::sqrt(squares)};
}

// Gauss and Jordan with pivots on the diagonal: the matrix is symmetric and positive, or the patch is refused.
bool invert(double (&matrix)[kModel][kModel], double (&inverse)[kModel][kModel]) {
    for (int i = 0; i < kModel; ++i)
        for (int j = 0; j < kModel; ++j) inverse[i][j] = i == j;
    for (int i = 0; i < kModel; ++i) {
        if (!(matrix[i][i] > 1e-9)) return false;
        const double scale = 1 / matrix[i][i];
        for (int j = 0; j < kModel; ++j) {
            matrix[i][j] *= scale;
            inverse[i][j] *= scale;
        }
        for (int k = 0; k < kModel; ++k) {
            const double factor = matrix[k][i];
            if (k == i || factor == 0) continue;
            for (int j = 0; j < kModel; ++j) {
                matrix[k][j] -= factor * matrix[i][j];
                inverse[k][j] -= factor * inverse[i][j];
            }
        }
    }
    return true;
}

// Without `to_move`, only what a correlation takes.
bool prepare(const Image& image, float x, float y, int radius, bool to_move, Reference& reference) {
    const int side = 2 * radius + 1, wide = side + 2;
    if (!encloses(image, x, y, radius + 1, radius + 1)) return false;
    float around[(kMaxSide + 2) * (kMaxSide + 2)];
    const float left = x - 0.5f - radius - 1, top = y - 0.5f - radius - 1;
    const float right = left - int(left), down = top - int(top);
    for (int row = 0; row < wide; ++row) {
        const float* above = image.pixels + (int(top) + row) * image.width + int(left);
        const float* below = above + image.width;
        for (int column = 0; column < wide; ++column) {
            const float upper = above[column] + right * (above[column + 1] - above[column]);
            const float lower = below[column] + right * (below[column + 1] - below[column]);
            around[row * wide + column] = upper + down * (lower - upper);
        }
    }
    const Window& window = reference.window;
    for (int row = 0; row < side; ++row)
        for (int column = 0; column < side; ++column)
            reference.value[row * side + column] = around[(row + 1) * wide + column + 1];
    const Moments of = moments(reference.value, window.weight, window.count);
    if (!(of.deviation > 1)) return false;  // grey levels: what is flatter is noise
    const float contrast = 1 / of.deviation;
    for (int i = 0; i < window.count; ++i) reference.value[i] = contrast * (reference.value[i] - of.mean);
    if (!to_move) return true;
    for (int row = 0; row < side; ++row)
        for (int column = 0; column < side; ++column) {
            const int i = row * side + column;
            const float* centre = &around[(row + 1) * wide + column + 1];
            const float gx = 0.5f * contrast * (centre[1] - centre[-1]);
            const float gy = 0.5f * contrast * (centre[wide] - centre[-wide]);
            const float dx = window.x[i], dy = window.y[i];
            const float slopes[kModel] = {gx * dx, gx * dy, gy * dx, gy * dy, gx, gy, reference.value[i], 1};
            for (int k = 0; k < kModel; ++k) reference.slopes[k][i] = slopes[k];
        }
    double normal[kModel][kModel];
    for (int k = 0; k < kModel; ++k)
        for (int j = 0; j <= k; ++j) {
            float sum = 0;
            for (int i = 0; i < reference.window.count; ++i)
                sum += reference.window.weight[i] * reference.slopes[k][i] * reference.slopes[j][i];
            normal[k][j] = normal[j][k] = sum;
        }
    if (!invert(normal, reference.inverse)) return false;
    for (int k = 0; k < kModel; ++k)
        for (int i = 0; i < reference.window.count; ++i) reference.slopes[k][i] *= reference.window.weight[i];
    return true;
}

struct Warp {
    float x, y, a, b, c, d;  // (x, y) + [a b; c d] (dx, dy)
};

// The target's patch under `warp`, of mean 0 and variance 1; false where it leaves the image or shows nothing.
bool fetch(const Image& image, const Reference& reference, const Warp& warp, float* values) {
    const Window& window = reference.window;
    const float radius = -window.x[0];
    if (!encloses(image, warp.x, warp.y, radius * (std::abs(warp.a) + std::abs(warp.b)),
                  radius * (std::abs(warp.c) + std::abs(warp.d))))
        return false;
    const Warp w = warp;
    const int count = window.count, width = image.width;
    const float *dx = window.x, *dy = window.y, *pixels = image.pixels;
    int32_t at[kMaxPixels];
    float right[kMaxPixels], down[kMaxPixels];
    for (int i = 0; i < count; ++i) {
        const float x = w.x - 0.5f + w.a * dx[i] + w.b * dy[i], y = w.y - 0.5f + w.c * dx[i] + w.d * dy[i];
        const int column = int(x), row = int(y);
        at[i] = row * width + column;
        right[i] = x - column;
        down[i] = y - row;
    }
    for (int i = 0; i < count; ++i) {
        const float *above = pixels + at[i], *below = above + width;
        const float upper = above[0] + right[i] * (above[1] - above[0]);
        const float lower = below[0] + right[i] * (below[1] - below[0]);
        values[i] = upper + down[i] * (lower - upper);
    }
    const Moments of = moments(values, reference.window.weight, reference.window.count);
    if (!(of.deviation > 1)) return false;
    for (int i = 0; i < reference.window.count; ++i) values[i] = (values[i] - of.mean) / of.deviation;
    return true;
}

// The warp after the small change `by` of the reference has been undone: W <- W o dW^-1. False if that is no patch.
bool compose(Warp& warp, const double* by) {
    const double p = 1 + by[0], q = by[1], r = by[2], s = 1 + by[3], determinant = p * s - q * r;
    if (!(determinant > 0.1)) return false;
    const double ip = s / determinant, iq = -q / determinant, ir = -r / determinant, is = p / determinant;
    const Warp old = warp;
    warp.a = float(old.a * ip + old.b * ir);
    warp.b = float(old.a * iq + old.b * is);
    warp.c = float(old.c * ip + old.d * ir);
    warp.d = float(old.c * iq + old.d * is);
    warp.x = float(old.x - (warp.a * by[4] + warp.b * by[5]));
    warp.y = float(old.y - (warp.c * by[4] + warp.d * by[5]));
    const float area = warp.a * warp.d - warp.b * warp.c;
    const float squares = warp.a * warp.a + warp.b * warp.b + warp.c * warp.c + warp.d * warp.d;
    return area > 1 / (kLargestStretch * kLargestStretch) && squares < 2 * kLargestStretch * kLargestStretch;
}

// The largest standard deviation of the aligned position along any direction, pixels of the target.
float position_sigma(const Reference& reference, const Warp& warp, float correlation) {
    // Both patches have variance 1: what is left after the best gain has the variance 1 - correlation^2. Weights are
    // normalised; they hold as many independent pixels as the inverse of the sum of their squares.
    float squares = 0;
    for (int i = 0; i < reference.window.count; ++i) squares += reference.window.weight[i] * reference.window.weight[i];
    const double variance = std::max(1.0 - double(correlation) * correlation, 1e-6) * squares;
    const double xx = reference.inverse[4][4], xy = reference.inverse[4][5], yy = reference.inverse[5][5];
    const double half = 0.5 * (xx + yy), apart = std::sqrt(0.25 * (xx - yy) * (xx - yy) + xy * xy);
    const double stretch = std::sqrt(std::abs(double(warp.a) * warp.d - double(warp.b) * warp.c));
    return float(stretch * std::sqrt(variance * (half + apart)));
}

void align(const Images& images, const Patches& patches, int patch, Reference& reference) {
    patches.correlation[patch] = -1;
    patches.sigma[patch] = INFINITY;
    const auto image = [&](int index) {
        return Image{images.pixels[index], images.widths[index], images.heights[index]};
    };
    const float* from = patches.reference + 2 * patch;
    const bool to_move = patches.max_iterations > 0;
    if (!prepare(image(patches.reference_image[patch]), from[0], from[1], patches.radius, to_move, reference)) return;
    const Image target = image(patches.target_image[patch]);
    float *at = patches.target + 2 * patch, *affine = patches.affine + 4 * patch;
    Warp warp = {at[0], at[1], affine[0], affine[1], affine[2], affine[3]};
    float values[kMaxPixels];
    if (!fetch(target, reference, warp, values)) return;
    bool converged = !to_move;
    for (int iteration = 0; iteration < patches.max_iterations && !converged; ++iteration) {
        float right[kModel] = {};
        for (int k = 0; k < kModel; ++k) {
            float sum = 0;
            for (int i = 0; i < reference.window.count; ++i) sum += reference.slopes[k][i] * (values[i] - reference.value[i]);
            right[k] = sum;
        }
        double step[kWarp] = {};
        for (int k = 0; k < kWarp; ++k)
            for (int j = 0; j < kModel; ++j) step[k] += reference.inverse[k][j] * right[j];
        const Warp before = warp;
        if (!compose(warp, step) || !fetch(target, reference, warp, values)) return;
        converged = std::hypot(warp.x - before.x, warp.y - before.y) < kConverged;
    }
    if (!converged) return;
    float correlation = 0;
    for (int i = 0; i < reference.window.count; ++i)
        correlation += reference.window.weight[i] * values[i] * reference.value[i];
    const float result[] = {warp.a, warp.b, warp.c, warp.d};
    std::copy(result, result + 4, affine);
    at[0] = warp.x;
    at[1] = warp.y;
    patches.correlation[patch] = correlation;
    if (to_move) patches.sigma[patch] = position_sigma(reference, warp, correlation);
}

}  // namespace
}  // namespace core

using namespace core;

// Aligns each patch from its first guess; with no iterations, only its correlation is found. A patch that leaves an
// image, shows nothing or does not converge has the correlation -1 and keeps its guess; sigma is infinite where nothing
// was aligned. 1 when the radius is too large.
CORE_API int core_align(const Images* images, const Patches* patches) {
    if (patches->radius < 1 || patches->radius > kMaxRadius) return 1;
    run_ranges(patches->count, kPatchesPerTask, [&](int begin, int end, int) {
        const Window window(patches->radius);
        Reference reference{window, {}, {}, {}};
        for (int patch = begin; patch < end; ++patch) align(*images, *patches, patch, reference);
    });
    return 0;
}
