// What the points of one view are in another: where they fall, which is nearest, and what they would hide.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdlib>

#include "threads.h"

namespace core {
namespace {

// Pixel (u, v) of the source at depth z lies at z A (u, v, 1) + t of the target: homogeneous pixels, whose third entry
// is the depth there.
struct Reprojection {
    const float* depth;  // (height, width) of the source, 0 where unknown
    int32_t width, height;
    int32_t target_width, target_height;
    float A[9], t[3];
};

constexpr float kSmallestDepth = 1e-6f;

// Calls landed(source, target, z) for every known point that falls into the target's image: the indices of both pixels
// and the depth there.
template <class Landed>
void for_each_landing(const Reprojection& r, const Landed& landed) {
    const float *A = r.A, *t = r.t;
    for (int y = 0; y < r.height; ++y) {
        const float v = y + 0.5f;
        const float row[3] = {A[1] * v + A[2], A[4] * v + A[5], A[7] * v + A[8]};
        for (int x = 0; x < r.width; ++x) {
            const size_t source = size_t(y) * r.width + x;
            const float depth = r.depth[source], u = x + 0.5f;
            if (!(depth > 0)) continue;
            const float z = depth * (A[6] * u + row[2]) + t[2];
            if (!(z > kSmallestDepth)) continue;
            const float column = std::floor((depth * (A[0] * u + row[0]) + t[0]) / z);
            const float line = std::floor((depth * (A[3] * u + row[1]) + t[1]) / z);
            if (!(column >= 0 && line >= 0 && column < r.target_width && line < r.target_height)) continue;
            landed(source, size_t(line) * r.target_width + size_t(column), z);
        }
    }
}

}  // namespace
}  // namespace core

using namespace core;

// The nearest of the source's points in each of the target's pixels: its depth and how large its own pixel is there
// (its depth over the source's focal length). Both arrays are (target_height, target_width) and infinite at the start.
CORE_API void core_reproject_nearest(const Reprojection* r, float source_focal, float* depth, float* footprint) {
    for_each_landing(*r, [&](size_t source, size_t target, float z) {
        if (z >= depth[target]) return;
        depth[target] = z;
        footprint[target] = r->depth[source] / source_focal;
    });
}

// Marks the target's pixels on which points of the source fall, and those that one of them explains: whose three
// channels each differ by at most `like` grey levels. Images are (height, width, 3).
CORE_API void core_reproject_explained(
    const Reprojection* r, const uint8_t* source_image, const uint8_t* target_image, int like, uint8_t* falls,
    uint8_t* explained
) {
    for_each_landing(*r, [&](size_t source, size_t target, float) {
        falls[target] = 1;
        int difference = 0;
        for (int channel = 0; channel < 3; ++channel)
            difference = std::max(difference, std::abs(source_image[3 * source + channel] - target_image[3 * target + channel]));
        if (difference <= like) explained[target] = 1;
    });
}

// Marks the source's pixels whose point lies before what the target knows there by more than the part `in_front` of it.
CORE_API void core_reproject_hiding(const Reprojection* r, const float* target_depth, float in_front, uint8_t* hiding) {
    for_each_landing(*r, [&](size_t source, size_t target, float z) {
        if (z < (1 - in_front) * target_depth[target]) hiding[source] = 1;
    });
}
