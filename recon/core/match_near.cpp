// The two nearest of 8-bit descriptors and the way back, as match.cpp has them, among those that lie near in a picture.
//
// The second set is laid out in vertical strips as wide as the reach, each from top to bottom: what is near a point is
// one run of each of three strips.
#include <algorithm>
#include <cmath>
#include <cstring>
#include <numeric>
#include <vector>

#include "descriptors.h"
#include "threads.h"

namespace core {
namespace {

constexpr int kRowsPerTask = 64;
constexpr int kMostStrips = 4096;

inline int32_t dot_product(const uint8_t* a, const uint8_t* b) {
    Sums sums = {};
    for (size_t i = 0; i < kSize; i += sizeof(IntVec)) {
        IntVec one, other;
        std::memcpy(&one, a + i, sizeof one);
        std::memcpy(&other, b + i, sizeof other);
        sums = multiply_add(sums, one, other);
    }
    const IntVec products = dot_products(sums);
    int32_t sum = 0;
    for (int lane = 0; lane < kLanes; ++lane) sum += products[lane];
    return sum;
}

// The second set, by strips and from top to bottom in each.
struct Strips {
    double left = 0, width;  // as doubles, in which differences of any two floats are finite
    std::vector<int> begin;  // [strip]: place of its first; one more at the end
    std::vector<int> index;  // [place]: number in the second set
    std::vector<float> x, y;
    std::vector<uint8_t> bytes;
    std::vector<int32_t> half_norms;

    Strips(const uint8_t* descriptors, const float* points, int count, float reach) : width(reach), index(count) {
        double right = 0;
        for (int i = 0; i < count; ++i) {
            left = i ? std::min(left, double(points[2 * i])) : points[0];
            right = i ? std::max(right, double(points[2 * i])) : points[0];
        }
        width = std::max(width, (right - left) / (kMostStrips - 1));
        const int num_strips = count ? strip_of(right) + 1 : 0;
        std::iota(index.begin(), index.end(), 0);
        std::sort(index.begin(), index.end(), [&](int a, int b) {
            const int strip_a = strip_of(points[2 * a]), strip_b = strip_of(points[2 * b]);
            if (strip_a != strip_b) return strip_a < strip_b;
            return points[2 * a + 1] != points[2 * b + 1] ? points[2 * a + 1] < points[2 * b + 1] : a < b;
        });
        bytes.resize(size_t(count) * kSize);
        for (int place = 0; place < count; ++place) {
            const int i = index[place];
            x.push_back(points[2 * i]), y.push_back(points[2 * i + 1]);
            half_norms.push_back(half_norm(descriptors + size_t(i) * kSize));
            std::memcpy(&bytes[size_t(place) * kSize], descriptors + size_t(i) * kSize, kSize);
            while (int(begin.size()) <= strip_of(x.back())) begin.push_back(place);
        }
        while (int(begin.size()) <= num_strips) begin.push_back(count);
    }

    int strip_of(double at) const { return int((at - left) / width); }

    // Calls use(place) for each of those nearer than `reach` to (at_x, at_y).
    template <typename Use>
    void near(float at_x, float at_y, float reach, Use use) const {
        const int last = int(begin.size()) - 2;
        const double strip = std::floor((at_x - left) / width);
        if (!(strip >= -1 && strip <= last + 1)) return;
        for (int s = std::max(0, int(strip) - 1); s <= std::min(last, int(strip) + 1); ++s) {
            const auto from = y.begin() + begin[s], end = y.begin() + begin[s + 1];
            for (auto here = std::lower_bound(from, end, at_y - reach); here != end && *here <= at_y + reach; ++here) {
                const int place = int(here - y.begin());
                const float dx = x[place] - at_x, dy = *here - at_y;
                if (dx * dx + dy * dy < reach * reach) use(place);
            }
        }
    }
};

}  // namespace
}  // namespace core

using namespace core;

// As core_match, where only those of the second set count that are nearer than `reach` in the picture: `first_at`
// (num1, 2) and `second_at` (num2, 2) are their places, finite. Where none is near, `nearest` or `back` is -1, and
// where it is one, the second score is 0.
CORE_API int32_t core_match_near(const uint8_t* first, const float* first_at, int num1, const uint8_t* second,
                                 const float* second_at, int num2, float reach, int32_t* nearest, int32_t* score,
                                 int32_t* second_score, int32_t* back) {
    if (std::max(num1, num2) > 0xffff || !fit_sums(first, num1) || !fit_sums(second, num2)) return 1;
    const Strips strips(second, second_at, num2, reach);
    std::vector<std::vector<int32_t>> column_best(num_threads(), std::vector<int32_t>(num2, 0));
    run_ranges(num1, kRowsPerTask, [&](int begin, int end, int thread) {
        std::vector<int32_t>& mine = column_best[thread];
        for (int row = begin; row < end; ++row) {
            const uint8_t* descriptor = first + size_t(row) * kSize;
            const int32_t own_half = half_norm(descriptor);
            int32_t best = 0, runner_up = 0;
            strips.near(first_at[2 * row], first_at[2 * row + 1], reach, [&](int place) {
                const int32_t dot = dot_product(descriptor, &strips.bytes[size_t(place) * kSize]);
                const int32_t here = packed(std::max(dot + kOffset - strips.half_norms[place], 1), strips.index[place]);
                runner_up = std::max(runner_up, std::min(best, here));
                best = std::max(best, here);
                mine[place] = std::max(mine[place], packed(std::max(dot + kOffset - own_half, 1), row));
            });
            nearest[row] = best ? index_of(best) : -1;
            score[row] = score_of(best);
            second_score[row] = score_of(runner_up);
        }
    });
    for (int place = 0; place < num2; ++place) {
        int32_t winner = 0;
        for (const auto& mine : column_best) winner = std::max(winner, mine[place]);
        back[strips.index[place]] = winner ? index_of(winner) : -1;
    }
    return 0;
}
