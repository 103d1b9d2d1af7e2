// The Gaussian scale space: each layer is the one before, blurred a little more, a tile at a time.
#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <new>

#if defined(__linux__)
#include <sys/mman.h>
#endif

#include "sift.h"
#include "threads.h"

namespace core::sift {
namespace {

constexpr float kSigmaOfImage = 1.0f;  // blur that an enlarged image is taken to have: half a pixel before
constexpr int kMaxRadius = 16;         // of a Gaussian kernel; the widest of an octave has 13
constexpr int kBlock = 4 * kLanes;     // floats of a row that are summed at once
constexpr size_t kPage = size_t(2) << 20;

struct Kernel {
    int radius;
    float weights[kMaxRadius + 1];  // from the middle outwards

    explicit Kernel(float sigma) : radius(std::lround(sigma * 8 + 1) / 2) {
        float sum = 0;
        for (int i = 0; i <= radius; ++i) {
            weights[i] = std::exp(-0.5f * i * i / (sigma * sigma));
            sum += (i ? 2 : 1) * weights[i];
        }
        for (int i = 0; i <= radius; ++i) weights[i] /= sum;
    }
};

// The image goes on behind its border as in a mirror whose surface is the last pixel.
inline int mirrored(int at, int size) {
    if (size == 1) return 0;
    while (at < 0 || at >= size) at = at < 0 ? -at : 2 * size - 2 - at;
    return at;
}

// `to` = the weighted sums of `count` floats and their neighbours on both sides, to the end of the last block.
inline void weigh(const float* const* before, const float* const* behind, const float* middle, const Kernel& kernel,
                  int count, float* to) {
    const Vec first = splat(kernel.weights[0]);
    for (int x = 0; x < count; x += kBlock) {
        const int x1 = x + kLanes, x2 = x + 2 * kLanes, x3 = x + 3 * kLanes;
        Vec sum0 = first * load_unaligned(middle + x), sum1 = first * load_unaligned(middle + x1);
        Vec sum2 = first * load_unaligned(middle + x2), sum3 = first * load_unaligned(middle + x3);
        for (int i = 0; i < kernel.radius; ++i) {
            const Vec weight = splat(kernel.weights[i + 1]);
            const float *one = before[i], *other = behind[i];
            sum0 = multiply_add(weight, load_unaligned(one + x) + load_unaligned(other + x), sum0);
            sum1 = multiply_add(weight, load_unaligned(one + x1) + load_unaligned(other + x1), sum1);
            sum2 = multiply_add(weight, load_unaligned(one + x2) + load_unaligned(other + x2), sum2);
            sum3 = multiply_add(weight, load_unaligned(one + x3) + load_unaligned(other + x3), sum3);
        }
        store_unaligned(to + x, sum0);
        store_unaligned(to + x1, sum1);
        store_unaligned(to + x2, sum2);
        store_unaligned(to + x3, sum3);
    }
}

// The tile of `to` from (top, left) on. `row` holds one row, blurred along y, with `radius` more on both sides.
void blur_tile(const Octave& octave, const float* from, float* to, const Kernel& kernel, int top, int left) {
    constexpr int kWidth = kTileColumns + 2 * kMaxRadius + kBlock;
    alignas(64) float row[kWidth + kBlock];
    const int bottom = std::min(octave.height, top + kTileRows), right = std::min(octave.width, left + kTileColumns);
    const int r = kernel.radius, first = std::max(0, left - r), last = std::min(octave.width, right + r);
    float* const at_zero = row + kMaxRadius - left;  // of column 0
    for (int y = top; y < bottom; ++y) {
        const float *before[kMaxRadius], *behind[kMaxRadius];
        for (int i = 0; i < r; ++i) {
            before[i] = from + mirrored(y - i - 1, octave.height) * octave.stride + first;
            behind[i] = from + mirrored(y + i + 1, octave.height) * octave.stride + first;
        }
        weigh(before, behind, from + y * octave.stride + first, kernel, last - first, at_zero + first);
        for (int x = left - r; x < 0; ++x) at_zero[x] = at_zero[mirrored(x, octave.width)];
        for (int x = octave.width; x < right + r; ++x) at_zero[x] = at_zero[mirrored(x, octave.width)];
        for (int i = 0; i < r; ++i) {
            before[i] = at_zero + left - i - 1;
            behind[i] = at_zero + left + i + 1;
        }
        float* out = to + y * octave.stride + left;
        if (right - left == kTileColumns) {
            weigh(before, behind, at_zero + left, kernel, kTileColumns, out);
        } else {
            alignas(64) float end[kTileColumns + kBlock];
            weigh(before, behind, at_zero + left, kernel, right - left, end);
            std::copy(end, end + (right - left), out);
        }
    }
}

void blur(const Octave& octave, const float* from, float* to, float sigma) {
    const Kernel kernel(sigma);
    const int across = (octave.width + kTileColumns - 1) / kTileColumns;
    const int down = (octave.height + kTileRows - 1) / kTileRows;
    run_parallel(across * down, [&](int tile, int) {
        blur_tile(octave, from, to, kernel, tile / across * kTileRows, tile % across * kTileColumns);
    });
}

// Twice the size: what lies between two pixels is their mean.
void enlarge(const uint8_t* grey, int width, int height, const Octave& octave, float* to) {
    run_ranges(octave.height, kTileRows, [&](int begin, int end, int) {
        for (int y = begin; y < end; ++y) {
            const uint8_t* above = grey + size_t(y / 2) * width;
            const uint8_t* below = grey + size_t(std::min((y + 1) / 2, height - 1)) * width;
            float* row = to + y * octave.stride;
            for (int x = 0; x < width; ++x) {
                const int next = std::min(x + 1, width - 1);
                row[2 * x] = 0.5f * (above[x] + below[x]);
                row[2 * x + 1] = 0.25f * ((above[x] + above[next]) + (below[x] + below[next]));
            }
        }
    });
}

// Every second pixel of every second row.
void halve(const Octave& large, const float* from, const Octave& small, float* to) {
    run_ranges(small.height, kTileRows, [&](int begin, int end, int) {
        for (int y = begin; y < end; ++y)
            for (int x = 0; x < small.width; ++x) to[y * small.stride + x] = from[2 * y * large.stride + 2 * x];
    });
}

// A row has room for the registers that are written or read behind its end.
size_t stride_of(int width) { return (width + kBlock + 31) / 16 * 16; }

}  // namespace

ScaleSpace::ScaleSpace(const uint8_t* grey, int width, int height) : grey_(grey) {
    width *= 2, height *= 2;
    const int count = int(std::lrint(std::log2(double(std::min(width, height))) - 2)) + 1;
    for (int o = 0; o < count && std::min(width >> o, height >> o) > 2 * kBorder; ++o)
        octaves_.push_back({width >> o, height >> o, stride_of(width >> o), {}});
    if (octaves_.empty()) return;
    const auto size = [&](size_t o) { return octaves_[o].stride * (octaves_[o].height + 1); };
    size_t smaller = 0;
    for (size_t o = 1; o < octaves_.size(); ++o) smaller += kLayers * size(o);
    // Those layers of the first octave that no descriptor reads make room for the smaller octaves.
    const size_t floats = kIntervals * size(0) + std::max((kLayers - kIntervals) * size(0), smaller);
    // Fresh memory in large pages: asking for small ones takes as long as the blurring.
    const size_t bytes = (floats * sizeof(float) + kPage - 1) / kPage * kPage;
    memory_ = static_cast<float*>(std::aligned_alloc(kPage, bytes));
    if (!memory_) throw std::bad_alloc();
#if defined(__linux__)
    madvise(memory_, bytes, MADV_HUGEPAGE);
#endif
    const int kept_first[kLayers] = {kIntervals, 0, 1, 2, kIntervals + 1, kIntervals + 2};
    for (int layer = 0; layer < kLayers; ++layer) octaves_[0].layers[layer] = memory_ + kept_first[layer] * size(0);
    float* next = memory_ + kIntervals * size(0);
    for (size_t o = 1; o < octaves_.size(); ++o)
        for (float*& layer : octaves_[o].layers) {
            layer = next;
            next += size(o);
        }
}

const Octave& ScaleSpace::build(size_t number) {
    const Octave& octave = octaves_[number];
    if (number == 0) {
        enlarge(grey_, octave.width / 2, octave.height / 2, octave, octave.layers[1]);
        blur(octave, octave.layers[1], octave.layers[0], std::sqrt(kSigma * kSigma - kSigmaOfImage * kSigmaOfImage));
    } else {
        halve(octaves_[number - 1], octaves_[number - 1].layers[kIntervals], octave, octave.layers[0]);
    }
    const float step = std::pow(2.0f, 1.0f / kIntervals);
    float sigma = kSigma;
    for (int layer = 1; layer < kLayers; ++layer, sigma *= step)
        blur(octave, octave.layers[layer - 1], octave.layers[layer], sigma * std::sqrt(step * step - 1));
    return octave;
}

ScaleSpace::~ScaleSpace() { std::free(memory_); }

}  // namespace core::sift
