// Compares the depth maps of several views with each other.
//
// A pixel's point is carried into another view, the other view's plane there is carried back, and the two must agree in
// the image (reprojection error) and in depth. What agrees is averaged: the error of a mean of independent estimates
// is smaller than that of each.
#include <algorithm>
#include <cmath>

#include "patchmatch.h"
#include "patchmatch_cost.h"
#include "threads.h"

namespace patchmatch {

// What the other views say about each pixel of the reference view, all (height, width).
struct Agreement {
    float* inverse_depth;      // weighted mean over the pixel and the views that agree with it
    float* relative_spread;    // root mean square relative difference of depth of the views that agree
    float* angle;              // largest angle in radians between the rays of this view and of one that agrees
    uint8_t* num_consistent;   // views that agree
    uint8_t* num_inside;       // views whose image the point falls into
    uint8_t* num_conflicting;  // views that see something clearly behind the point: it would hide what they see
};

struct Other {
    const Plane* planes;  // (height, width), inverse depth 0 where unknown
    int32_t width, height;
    Transfer from_reference, to_reference;
    float centre[3];  // of the other camera, in the reference camera's frame
};

namespace {

struct Tolerance {
    float pixels, relative_depth;
};

void check_pixel(
    const Plane& plane, const Other* others, int num_others, int x, int y, const float* ray, Tolerance tolerance,
    const Agreement& out, size_t index
) {
    const float u = x + 0.5f, v = y + 0.5f, w = plane.inverse_depth;
    float total = w, weights = 1, squares = 0, smallest_cosine = 1;
    int consistent = 0, inside = 0, conflicting = 0;
    for (int n = 0; n < num_others && w > 0; ++n) {
        const Other& other = others[n];
        const Point there = at_inverse_depth(ray_through(other.from_reference, u, v), other.from_reference, w);
        const Landing landing(there, other.width, other.height);
        if (!landing.inside) continue;
        ++inside;
        const int column = int(landing.u), row = int(landing.v);
        const Plane& seen = other.planes[size_t(row) * other.width + column];
        if (!(seen.inverse_depth > 0)) continue;
        const float seen_w = seen.at(landing.u - column - 0.5f, landing.v - row - 0.5f);
        const Point ray_back = ray_through(other.to_reference, landing.u, landing.v);
        const Point back = at_inverse_depth(ray_back, other.to_reference, seen_w);
        if (!(seen_w > 0 && back.z > kSmallestZ)) continue;
        // `there` and `back` are scaled by the inverse depth that they were made from.
        const float back_w = seen_w / back.z;
        const float ratio = there.z * seen_w / w;  // depth of the point in the other view / depth that it sees there
        if (ratio < 1 - 3 * tolerance.relative_depth) ++conflicting;
        const float error = std::hypot(back.x / back.z - u, back.y / back.z - v);
        const float difference = back_w / w - 1;
        if (!(error <= tolerance.pixels && std::fabs(difference) <= tolerance.relative_depth)) continue;
        ++consistent;
        const float closeness = 1 - error / (tolerance.pixels * 1.001f);
        total += closeness * back_w;
        weights += closeness;
        squares += difference * difference;
        const float to_camera[3] = {ray[0] / w - other.centre[0], ray[1] / w - other.centre[1],
                                    1 / w - other.centre[2]};
        const float dot = ray[0] * to_camera[0] + ray[1] * to_camera[1] + to_camera[2];
        const float lengths = std::sqrt((ray[0] * ray[0] + ray[1] * ray[1] + 1) *
                                        (to_camera[0] * to_camera[0] + to_camera[1] * to_camera[1] +
                                         to_camera[2] * to_camera[2]));
        smallest_cosine = std::min(smallest_cosine, dot / lengths);
    }
    out.inverse_depth[index] = total / weights;
    out.relative_spread[index] = consistent ? std::sqrt(squares / consistent) : 0;
    out.angle[index] = std::acos(std::clamp(smallest_cosine, -1.0f, 1.0f));
    out.num_consistent[index] = uint8_t(consistent);
    out.num_inside[index] = uint8_t(inside);
    out.num_conflicting[index] = uint8_t(conflicting);
}

}  // namespace
}  // namespace patchmatch

// Fills every array of `agreement` for the planes (height, width) of a reference view with the pinhole (fx, fy, cx, cy).
CORE_API void patchmatch_check(
    const patchmatch::Plane* planes, int32_t width, int32_t height, const float* pinhole,
    const patchmatch::Other* others, int32_t num_others, float pixels, float relative_depth,
    const patchmatch::Agreement* agreement
) {
    core::run_ranges(height, 8, [&](int begin, int end, int) {
        for (int y = begin; y < end; ++y)
            for (int x = 0; x < width; ++x) {
                const size_t index = size_t(y) * width + x;
                const float ray[2] = {(x + 0.5f - pinhole[2]) / pinhole[0], (y + 0.5f - pinhole[3]) / pinhole[1]};
                patchmatch::check_pixel(planes[index], others, num_others, x, y, ray, {pixels, relative_depth},
                                        *agreement, index);
            }
    });
}
