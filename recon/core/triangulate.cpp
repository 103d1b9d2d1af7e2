// Scene points from their tracks, and the angles under which their cameras see them.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>

#include "threads.h"

namespace core {
namespace {

constexpr int kTracksPerTask = 128;
constexpr int kMaxIterations = 100;     // of the inverse iteration; a handful do where a point is well defined
constexpr double kSettled = 1e-14;      // largest change of a vector of unit length
constexpr double kShift = 1e-15;        // of the largest diagonal: an exact point makes the matrix singular
constexpr double kMinWeight = 1e-12;    // of a homogeneous point of unit length: with less it lies at infinity
constexpr double kMinLength = 1e-12;

struct Symmetric {
    double m[4][4] = {};

    // The outer product of `row` with itself, scaled to a length of 1.
    void add(const double* row) {
        const double squared = row[0] * row[0] + row[1] * row[1] + row[2] * row[2] + row[3] * row[3];
        for (int i = 0; i < 4; ++i)
            for (int j = 0; j <= i; ++j) m[i][j] += row[i] * row[j] / squared;
    }

    // Its lower triangle becomes L of the Cholesky decomposition; false if the matrix is not positive.
    bool decompose() {
        const double shift = kShift * std::max(std::max(m[0][0], m[1][1]), std::max(m[2][2], m[3][3]));
        for (int i = 0; i < 4; ++i)
            for (int j = 0; j <= i; ++j) {
                double sum = m[i][j] + (i == j ? shift : 0);
                for (int k = 0; k < j; ++k) sum -= m[i][k] * m[j][k];
                if (i == j && !(sum > 0)) sum = shift;  // by rounding
                if (!(sum == sum) || (i == j && !(sum > 0))) return false;
                m[i][j] = i == j ? std::sqrt(sum) : sum / m[j][j];
            }
        return true;
    }

    void solve(double* x) const {
        for (int i = 0; i < 4; ++i) {
            for (int k = 0; k < i; ++k) x[i] -= m[i][k] * x[k];
            x[i] /= m[i][i];
        }
        for (int i = 3; i >= 0; --i) {
            for (int k = i + 1; k < 4; ++k) x[i] -= m[k][i] * x[k];
            x[i] /= m[i][i];
        }
    }
};

// The eigenvector of the smallest eigenvalue, by inverse iteration.
bool smallest(Symmetric& matrix, double (&vector)[4]) {
    if (!matrix.decompose()) return false;
    double before[4] = {0.5, 0.5, 0.5, 0.5};
    for (int iteration = 0; iteration < kMaxIterations; ++iteration) {
        std::copy(before, before + 4, vector);
        matrix.solve(vector);
        double squared = 0, product = 0, change = 0;
        for (int i = 0; i < 4; ++i) squared += vector[i] * vector[i];
        if (!(squared > 0 && squared < std::numeric_limits<double>::infinity())) return false;
        for (int i = 0; i < 4; ++i) product += (vector[i] /= std::sqrt(squared)) * before[i];
        for (int i = 0; i < 4; ++i) {
            if (product < 0) vector[i] = -vector[i];
            change = std::max(change, std::abs(vector[i] - before[i]));
            before[i] = vector[i];
        }
        if (change < kSettled) break;
    }
    return true;
}

}  // namespace
}  // namespace core

using namespace core;

// `points` (num_tracks, 3) by the direct linear transform (Hartley and Zisserman, 2004, 12.2). `matrices` (C, 3, 4) are
// world to camera; the observations of track t are `camera_of` and `rays` (., 2) from first_of_track[t] on to that of the
// next. NaN where a track has fewer than two, or its point lies at infinity.
CORE_API void core_triangulate(const double* matrices, const double* rays, const int32_t* camera_of,
                               const int32_t* first_of_track, int num_tracks, double* points) {
    run_ranges(num_tracks, kTracksPerTask, [&](int begin, int end, int) {
        for (int track = begin; track < end; ++track) {
            const int first = first_of_track[track], last = first_of_track[track + 1];
            double* point = points + 3 * size_t(track);
            std::fill(point, point + 3, std::numeric_limits<double>::quiet_NaN());
            if (last - first < 2) continue;
            Symmetric normal;
            for (int o = first; o < last; ++o) {
                const double* camera = matrices + 12 * size_t(camera_of[o]);
                for (int axis = 0; axis < 2; ++axis) {
                    double row[4];
                    for (int i = 0; i < 4; ++i) row[i] = rays[2 * size_t(o) + axis] * camera[8 + i] - camera[4 * axis + i];
                    normal.add(row);
                }
            }
            double homogeneous[4];
            if (!smallest(normal, homogeneous) || std::abs(homogeneous[3]) <= kMinWeight) continue;
            for (int i = 0; i < 3; ++i) point[i] = homogeneous[i] / homogeneous[3];
        }
    });
}

// `cosines` (num_points,) of the widest angle between two rays of each of `points` (num_points, 3), from `centres` (C, 3);
// 1 where there is one ray. The observations of a point are as above.
CORE_API void core_widest_angles(const double* centres, const double* points, const int32_t* camera_of,
                                 const int32_t* first_of_point, int num_points, double* cosines) {
    run_ranges(num_points, kTracksPerTask, [&](int begin, int end, int) {
        for (int point = begin; point < end; ++point) {
            const int first = first_of_point[point], last = first_of_point[point + 1];
            double smallest = 1;
            const auto towards = [&](int o, double* direction) {
                double squared = 0;
                for (int i = 0; i < 3; ++i) {
                    direction[i] = points[3 * size_t(point) + i] - centres[3 * size_t(camera_of[o]) + i];
                    squared += direction[i] * direction[i];
                }
                const double length = std::max(std::sqrt(squared), kMinLength);
                for (int i = 0; i < 3; ++i) direction[i] /= length;
            };
            for (int a = first; a < last; ++a) {
                double one[3], other[3];
                towards(a, one);
                for (int b = first; b < a; ++b) {
                    towards(b, other);
                    smallest = std::min(smallest, one[0] * other[0] + one[1] * other[1] + one[2] * other[2]);
                }
            }
            cosines[point] = smallest;
        }
    });
}
