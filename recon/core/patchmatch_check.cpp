// Compares the planes of a view with those of other views.
//
// A pixel's point is carried into another view, the other view's plane there is carried back, and the two must agree in
// the image (reprojection error) and in depth. What agrees is averaged: the error of a mean of independent estimates
// is smaller than that of each.
#include <cmath>

#include "patchmatch.h"
#include "patchmatch_cost.h"
#include "threads.h"

namespace patchmatch {

struct Other {
    const Plane* planes;  // (height, width), inverse depth 0 where unknown
    int32_t width, height;
    Transfer from_reference, to_reference;
};

struct Tolerance {
    float pixels, relative_depth;
};

// What the other views say about each pixel of the reference view, all (height, width).
struct Agreement {
    float* inverse_depth;      // weighted mean over the pixel and the views that agree with it
    uint8_t* num_consistent;   // views that agree
    uint8_t* num_inside;       // views whose image the point falls into
    uint8_t* num_conflicting;  // views that see something clearly behind the point: it would hide what they see
};

namespace {

void check_pixel(
    const Plane& plane, const Other* others, int num_others, float u, float v, const Tolerance& tolerance, size_t index,
    const Agreement& out
) {
    const float w = plane.inverse_depth;
    float total = w, weights = 1;
    int consistent = 0, inside = 0, conflicting = 0;
    for (int n = 0; n < num_others && w > 0; ++n) {
        const Other& other = others[n];
        const Point there = at_inverse_depth(ray_through(other.from_reference, u, v), other.from_reference, w);
        const Landing landing(there, other.width, other.height);
        if (!landing.inside) continue;
        ++inside;
        const int column = int(landing.u), row = int(landing.v);
        const Plane& seen = other.planes[size_t(row) * other.width + column];
        const float seen_w = seen.at(landing.u - column - 0.5f, landing.v - row - 0.5f);
        const Point ray_back = ray_through(other.to_reference, landing.u, landing.v);
        const Point back = at_inverse_depth(ray_back, other.to_reference, seen_w);
        if (!(seen.inverse_depth > 0 && seen_w > 0 && back.z > kSmallestZ)) continue;
        // Both homogeneous points are scaled by the inverse depth that they were made from: there.z / w is the depth of
        // the point in the other view, back.z / seen_w that of what the other view sees, in this one.
        const float back_w = seen_w / back.z;
        if (there.z * seen_w < (1 - 3 * tolerance.relative_depth) * w) ++conflicting;
        const float du = back.x / back.z - u, dv = back.y / back.z - v;
        const float error = std::sqrt(du * du + dv * dv);
        if (!(error < tolerance.pixels && std::fabs(back_w / w - 1) < tolerance.relative_depth)) continue;
        ++consistent;
        const float closeness = 1 - error / tolerance.pixels;
        total += closeness * back_w;
        weights += closeness;
    }
    out.inverse_depth[index] = total / weights;
    out.num_consistent[index] = uint8_t(consistent);
    out.num_inside[index] = uint8_t(inside);
    out.num_conflicting[index] = uint8_t(conflicting);
}

}  // namespace
}  // namespace patchmatch

// Fills every array of `agreement` for the planes (height, width) of a reference view.
CORE_API void patchmatch_check(
    const patchmatch::Plane* planes, int32_t width, int32_t height, const patchmatch::Other* others, int32_t num_others,
    const patchmatch::Tolerance* tolerance, const patchmatch::Agreement* agreement
) {
    core::run_ranges(height, 8, [&](int begin, int end, int) {
        for (int y = begin; y < end; ++y)
            for (int x = 0; x < width; ++x) {
                const size_t index = size_t(y) * width + x;
                patchmatch::check_pixel(
                    planes[index], others, num_others, x + 0.5f, y + 0.5f, *tolerance, index, *agreement);
            }
    });
}
