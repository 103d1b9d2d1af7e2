// Sampson errors of matches under the poses of their two cameras, and whether the points lie before both.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>

#include "threads.h"

// As splatnode.recon.registration.multiview_geometry.Pose: the second camera's pose in the first one's frame, and both lenses.
struct EpipolarPose {
    double rotation[9], translation[3];
    double focals[4], radials[4], shifts[4];  // across and down, of the first camera, then of the second
    double skews[2];                          // across for one down, at depth 1
    double min_parallax;  // the sine of the angle between two rays from which on their order along each other is told
    int32_t undistort_iterations;
};

namespace core {
namespace {

// At depth 1, without distortion.
inline void normalise(const EpipolarPose& pose, int camera, const double* pixel, double* ray) {
    const double y = (pixel[1] - pose.shifts[2 * camera + 1]) / pose.focals[2 * camera + 1];
    const double x = (pixel[0] - pose.shifts[2 * camera]) / pose.focals[2 * camera] - pose.skews[camera] * y;
    ray[0] = x, ray[1] = y, ray[2] = 1;
    for (int i = 0; i < pose.undistort_iterations; ++i) {
        const double squared = ray[0] * ray[0] + ray[1] * ray[1];
        const double by = 1 + (pose.radials[2 * camera] + pose.radials[2 * camera + 1] * squared) * squared;
        ray[0] = x / by, ray[1] = y / by;
    }
}

inline void cross(const double* a, const double* b, double* product) {
    product[0] = a[1] * b[2] - a[2] * b[1];
    product[1] = a[2] * b[0] - a[0] * b[2];
    product[2] = a[0] * b[1] - a[1] * b[0];
}

inline double dot(const double* a, const double* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

}  // namespace
}  // namespace core

using namespace core;

// `errors` (count,) in pixels of the matches `pixels1`, `pixels2` (count, 2), relative to the principal points; infinite
// where a match's point lies behind a camera (Hartley and Zisserman, 2004, 11.4.3).
CORE_API void core_sampson_errors(const EpipolarPose* pose, const double* pixels1, const double* pixels2, int count,
                                  double* errors) {
    const double *R = pose->rotation, *t = pose->translation;
    double essential[9];  // [t]x R
    for (int j = 0; j < 3; ++j) {
        essential[j] = t[1] * R[6 + j] - t[2] * R[3 + j];
        essential[3 + j] = t[2] * R[j] - t[0] * R[6 + j];
        essential[6 + j] = t[0] * R[3 + j] - t[1] * R[j];
    }
    double inverse[4];  // of the squared focal lengths
    for (int k = 0; k < 4; ++k) inverse[k] = 1 / (pose->focals[k] * pose->focals[k]);
    for (int i = 0; i < count; ++i) {
        double ray1[3], ray2[3], line1[3], line2[3], turned[3], normal[3], across[3];
        normalise(*pose, 0, pixels1 + 2 * i, ray1);
        normalise(*pose, 1, pixels2 + 2 * i, ray2);
        for (int k = 0; k < 3; ++k) {
            line2[k] = dot(essential + 3 * k, ray1);
            line1[k] = essential[k] * ray2[0] + essential[3 + k] * ray2[1] + essential[6 + k] * ray2[2];
            turned[k] = dot(R + 3 * k, ray1);
        }
        const double gradient = line2[0] * line2[0] * inverse[2] + line2[1] * line2[1] * inverse[3] +
                                line1[0] * line1[0] * inverse[0] + line1[1] * line1[1] * inverse[1];
        // Depths along both rays where they come closest: depth1 * turned + t = depth2 * ray2, up to a positive factor.
        cross(ray2, turned, normal);
        cross(ray2, t, across);
        const double depth1 = -dot(normal, across);
        cross(turned, t, across);
        const double depth2 = -dot(normal, across);
        const bool in_front = (depth1 > 0 && depth2 > 0) || std::sqrt(dot(normal, normal)) < pose->min_parallax;
        errors[i] = in_front ? std::abs(dot(ray2, line2)) / std::sqrt(std::max(gradient, 1e-30))
                             : std::numeric_limits<double>::infinity();
    }
}
