// Vectors of Gaussians between the world and each Gaussian's own axes (recon/optimize/fit.py says what for).
#include <algorithm>
#include <cmath>
#include <cstdint>

#include "threads.h"

namespace core {
namespace {

constexpr int kRows = 4096;  // of a task

struct Axes {
    float column[3][3];  // an axis of the Gaussian in the world, as long as its standard deviation along it
};

inline Axes axes_of(const float* quat, const float* log_scales, float largest) {
    const float norm = std::sqrt(quat[0] * quat[0] + quat[1] * quat[1] + quat[2] * quat[2] + quat[3] * quat[3]);
    const float w = quat[0] / norm, x = quat[1] / norm, y = quat[2] / norm, z = quat[3] / norm;
    Axes axes = {{{1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)},
                  {2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)},
                  {2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)}}};
    for (int axis = 0; axis < 3; ++axis) {
        const float extent = std::min(std::exp(log_scales[axis]), largest);
        for (float& value : axes.column[axis]) value *= extent;
    }
    return axes;
}

}  // namespace
}  // namespace core

using namespace core;

// All arrays have `count` rows: quats of 4, log_scales, vectors and result of 3. `to_world` says in which direction.
CORE_API void core_own_axes(const float* quats, const float* log_scales, const float* vectors, int64_t count,
                            double largest, int to_world, float* result) {
    run_ranges(int(count), kRows, [&](int begin, int end, int) {
        for (int64_t row = begin; row < end; ++row) {
            const Axes axes = axes_of(quats + 4 * row, log_scales + 3 * row, float(largest));
            const float* in = vectors + 3 * row;
            float* out = result + 3 * row;
            for (int i = 0; i < 3; ++i)
                out[i] = to_world ? axes.column[0][i] * in[0] + axes.column[1][i] * in[1] + axes.column[2][i] * in[2]
                                  : axes.column[i][0] * in[0] + axes.column[i][1] * in[1] + axes.column[i][2] * in[2];
        }
    });
}
