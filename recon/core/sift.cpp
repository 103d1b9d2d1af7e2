// SIFT of an image: scale space, keypoints, the strongest of them, descriptors.
#include <algorithm>
#include <cmath>
#include <numeric>
#include <tuple>

#include "sift.h"
#include "threads.h"

using namespace core;
using namespace core::sift;

namespace {

constexpr int kDescribedAtOnce = 32;
constexpr int kDescriptorSize = 128;

// The same order whatever the number of threads, and equal keypoints side by side.
auto place_of(const Keypoint& k) { return std::make_tuple(-k.response, k.octave, k.layer, k.y, k.x, k.turn); }

auto tile_of(const Keypoint& k) {
    return std::make_tuple(k.octave, k.layer, int(k.y) / kTileRows, int(k.x) / kTileColumns, k.y, k.x);
}

}  // namespace

// The up to `limit` strongest features of `grey` (height, width), the strongest first: `points` (limit, 2) as (x, y) in
// pixels with their centres at whole numbers, and `descriptors` (limit, 128) of length `unit` (below 128 a byte).
// `contrast` is the least response, over kIntervals, of an image in [0, 1]. Returns their number.
CORE_API int core_sift(const uint8_t* grey, int width, int height, int limit, float contrast, float unit, float* points,
                       uint8_t* descriptors) {
    ScaleSpace space(grey, width, height);
    std::vector<Keypoint> found;
    for (size_t o = 0; o < space.num_octaves(); ++o) {
        const std::vector<Keypoint> more = find_keypoints(space.build(o), int(o), contrast);
        found.insert(found.end(), more.begin(), more.end());
    }
    std::sort(found.begin(), found.end(), [](const Keypoint& a, const Keypoint& b) { return place_of(a) < place_of(b); });
    const auto same = [](const Keypoint& a, const Keypoint& b) { return place_of(a) == place_of(b); };
    found.erase(std::unique(found.begin(), found.end(), same), found.end());
    if (int(found.size()) > limit) found.resize(limit);
    // Neighbours are described one after the other: they read the same part of the image.
    std::vector<int> order(found.size());
    std::iota(order.begin(), order.end(), 0);
    std::sort(order.begin(), order.end(), [&](int a, int b) { return tile_of(found[a]) < tile_of(found[b]); });
    run_ranges(int(found.size()), kDescribedAtOnce, [&](int begin, int end, int) {
        for (int place = begin; place < end; ++place) {
            const int i = order[place];
            const Keypoint& keypoint = found[i];
            points[2 * i] = std::ldexp(keypoint.x, keypoint.octave - 1);
            points[2 * i + 1] = std::ldexp(keypoint.y, keypoint.octave - 1);
            describe(space.octave(keypoint.octave), keypoint, unit, descriptors + size_t(i) * kDescriptorSize);
        }
    });
    return int(found.size());
}
