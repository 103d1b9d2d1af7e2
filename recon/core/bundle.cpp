// Bundle adjustment for up to a few dozen cameras: Levenberg-Marquardt on a Cauchy loss of the reprojection errors, the
// points eliminated by the Schur complement ("Bundle adjustment - a modern synthesis", Triggs et al. 1999, section 6).
//
// With so few cameras the reduced system is small and dense. The work is in the points: each is linearised and
// eliminated by itself, so that they are dealt with in chunks that sum into systems of their own. The number of chunks
// is fixed, and with it the order of all sums: the result does not depend on the number of threads.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <vector>

#include "bundle_algebra.h"
#include "bundle_cost.h"
#include "threads.h"

namespace core {
namespace {

constexpr double kFloor = 1e-12;  // added to diagonals that damping scales

// The normal equations of all poses and lenses after the points are eliminated, and what brings the points back.
struct System {
    int size;                      // parameters
    std::vector<double> matrix;    // (size, size), lower triangle
    std::vector<double> gradient;  // (size,)
    std::vector<double> spread;    // (O, 10, 3): (J_camera^T w J_point) (J_point^T w J_point)^-1
    std::vector<double> shift;     // (P, 3): (J_point^T w J_point)^-1 J_point^T w residual

    explicit System(const Bundle& bundle)
        : size(kPose * bundle.num_cameras + kLens * bundle.num_lenses),
          matrix(size_t(size) * size),
          gradient(size),
          spread(size_t(bundle.first_of_point[bundle.num_points]) * 3 * kOwn),
          shift(size_t(bundle.num_points) * 3) {}
};

// Where the k-th of an observation's ten parameters is among all.
inline int parameter(const Bundle& bundle, int camera, int k) {
    return k < kPose ? kPose * camera + k
                     : kPose * bundle.num_cameras + kLens * bundle.lens_of_camera[camera] + k - kPose;
}

// Scratch of a chunk: its sums, and one point's columns.
struct Sums {
    std::vector<double> matrix, reduction, gradient;
    std::vector<int> columns, place;   // the parameters that the point touches; their places in `columns`, else -1
    std::vector<double> mixed;         // (columns, 3)
};

void eliminate(const Bundle& bundle, int point, double damping, System& system, Sums& sums) {
    const int first = bundle.first_of_point[point], last = bundle.first_of_point[point + 1];
    const int size = system.size;
    double block[3][3] = {}, right[3] = {};
    sums.columns.clear();
    sums.mixed.clear();
    for (int o = first; o < last; ++o) {
        const int camera = bundle.camera_of[o];
        const Projection p = project(bundle, camera, bundle.points + 3 * point, bundle.pixels + 2 * o);
        const Derivatives d = differentiate(bundle, p, camera);
        int at[kOwn];
        for (int k = 0; k < kOwn; ++k) {
            at[k] = parameter(bundle, camera, k);
            if (sums.place[at[k]] < 0) {
                sums.place[at[k]] = int(sums.columns.size());
                sums.columns.push_back(at[k]);
                sums.mixed.insert(sums.mixed.end(), 3, 0.0);
            }
        }
        for (int k = 0; k < kOwn; ++k) {
            const double w0 = d.weight * d.by_camera[0][k], w1 = d.weight * d.by_camera[1][k];
            for (int j = 0; j <= k; ++j)
                sums.matrix[size_t(at[k]) * size + at[j]] += w0 * d.by_camera[0][j] + w1 * d.by_camera[1][j];
            sums.gradient[at[k]] += w0 * p.residual[0] + w1 * p.residual[1];
            double* mixed = &sums.mixed[size_t(sums.place[at[k]]) * 3];
            double* own = &system.spread[(size_t(o) * kOwn + k) * 3];
            for (int i = 0; i < 3; ++i) {
                own[i] = w0 * d.by_point[0][i] + w1 * d.by_point[1][i];
                mixed[i] += own[i];
            }
        }
        for (int i = 0; i < 3; ++i) {
            for (int j = 0; j < 3; ++j)
                block[i][j] += d.weight * (d.by_point[0][i] * d.by_point[0][j] + d.by_point[1][i] * d.by_point[1][j]);
            right[i] += d.weight * (d.by_point[0][i] * p.residual[0] + d.by_point[1][i] * p.residual[1]);
        }
    }
    for (int i = 0; i < 3; ++i) block[i][i] += block[i][i] * damping + kFloor;
    double inverse[3][3] = {};
    invert(block, inverse);
    double* shift = &system.shift[size_t(point) * 3];
    multiply(inverse, right, shift);
    for (int o = first; o < last; ++o)
        for (int k = 0; k < kOwn; ++k) {
            double* own = &system.spread[(size_t(o) * kOwn + k) * 3];
            const double mixed[3] = {own[0], own[1], own[2]};
            multiply(inverse, mixed, own);
        }
    const int num_columns = int(sums.columns.size());
    for (int a = 0; a < num_columns; ++a) {
        const double* mixed = &sums.mixed[size_t(a) * 3];
        double scaled[3];
        multiply(inverse, mixed, scaled);
        const int row = sums.columns[a];
        sums.gradient[row] -= scaled[0] * right[0] + scaled[1] * right[1] + scaled[2] * right[2];
        for (int b = 0; b < num_columns; ++b) {
            const double* other = &sums.mixed[size_t(b) * 3];
            sums.reduction[size_t(row) * size + sums.columns[b]] +=
                scaled[0] * other[0] + scaled[1] * other[1] + scaled[2] * other[2];
        }
    }
    for (const int column : sums.columns) sums.place[column] = -1;
}

void assemble(const Bundle& bundle, double damping, System& system) {
    const int size = system.size;
    std::vector<Sums> sums(kChunks);
    run_parallel(kChunks, [&](int chunk, int) {
        Sums& mine = sums[chunk];
        mine.matrix.assign(size_t(size) * size, 0.0);
        mine.reduction.assign(size_t(size) * size, 0.0);
        mine.gradient.assign(size, 0.0);
        mine.place.assign(size, -1);
        const int begin = int64_t(bundle.num_points) * chunk / kChunks;
        const int end = int64_t(bundle.num_points) * (chunk + 1) / kChunks;
        for (int point = begin; point < end; ++point) eliminate(bundle, point, damping, system, mine);
    });
    std::fill(system.gradient.begin(), system.gradient.end(), 0.0);
    for (const Sums& part : sums)
        for (int i = 0; i < size; ++i) system.gradient[i] += part.gradient[i];
    std::vector<double> priors(size, 0.0);
    for (int g = 0; g < bundle.num_lenses; ++g) {
        const int at = kPose * bundle.num_cameras + kLens * g;
        const LensPrior prior(bundle, g);
        for (int k = 0; k < kLens; ++k) {
            priors[at + k] = prior.weights[k];
            system.gradient[at + k] += prior.weights[k] * prior.deviations[k];
        }
    }
    for (int i = 0; i < size; ++i)
        for (int j = 0; j <= i; ++j) {
            double plain = i == j ? priors[i] : 0.0, reduction = 0;
            for (const Sums& part : sums) {
                plain += part.matrix[size_t(i) * size + j];
                reduction += part.reduction[size_t(i) * size + j];
            }
            if (i == j) plain += plain * damping + kFloor;
            system.matrix[size_t(i) * size + j] = plain - reduction;
        }
}

std::vector<int> free_parameters(const Bundle& bundle) {
    std::vector<int> kept;
    for (int i = 0; i < kPose * bundle.num_cameras; ++i)
        if (i / kPose != bundle.fixed_camera) kept.push_back(i);
    for (int g = 0; g < bundle.num_lenses; ++g) {
        const LensPrior prior(bundle, g);
        for (int k = 0; k < kLens; ++k)
            if (prior.weights[k] > 0) kept.push_back(kPose * bundle.num_cameras + kLens * g + k);
    }
    return kept;
}

// The step of all parameters (0 for those that are fixed) by Cholesky's method; false if the system is not positive.
bool solve(const System& system, const std::vector<int>& kept, std::vector<double>& step) {
    const int size = int(kept.size());
    std::vector<double> lower(size_t(size) * size), y(size);
    for (int i = 0; i < size; ++i) {
        for (int j = 0; j <= i; ++j) {
            double sum = system.matrix[size_t(kept[i]) * system.size + kept[j]];
            for (int k = 0; k < j; ++k) sum -= lower[size_t(i) * size + k] * lower[size_t(j) * size + k];
            if (i == j && !(sum > 0)) return false;
            lower[size_t(i) * size + j] = i == j ? std::sqrt(sum) : sum / lower[size_t(j) * size + j];
        }
        double sum = -system.gradient[kept[i]];
        for (int k = 0; k < i; ++k) sum -= lower[size_t(i) * size + k] * y[k];
        y[i] = sum / lower[size_t(i) * size + i];
    }
    std::fill(step.begin(), step.end(), 0.0);
    for (int i = size - 1; i >= 0; --i) {
        double sum = y[i];
        for (int k = i + 1; k < size; ++k) sum -= lower[size_t(k) * size + i] * step[kept[k]];
        step[kept[i]] = sum / lower[size_t(i) * size + i];
    }
    return true;
}

// The parameters of a bundle, to be kept and put back.
struct State {
    std::vector<double> rotations, translations, log_focals, radials, shifts, points;

    explicit State(const Bundle& b)
        : rotations(b.rotations, b.rotations + 9 * b.num_cameras),
          translations(b.translations, b.translations + 3 * b.num_cameras),
          log_focals(b.log_focals, b.log_focals + b.num_lenses),
          radials(b.radials, b.radials + b.num_lenses),
          shifts(b.shifts, b.shifts + 2 * b.num_lenses),
          points(b.points, b.points + 3 * size_t(b.num_points)) {}

    void put_back(const Bundle& b) const {
        std::copy(rotations.begin(), rotations.end(), b.rotations);
        std::copy(translations.begin(), translations.end(), b.translations);
        std::copy(log_focals.begin(), log_focals.end(), b.log_focals);
        std::copy(radials.begin(), radials.end(), b.radials);
        std::copy(shifts.begin(), shifts.end(), b.shifts);
        std::copy(points.begin(), points.end(), b.points);
    }
};

void move(const Bundle& bundle, const System& system, const std::vector<double>& step) {
    for (int point = 0; point < bundle.num_points; ++point) {
        double* at = bundle.points + 3 * size_t(point);
        for (int i = 0; i < 3; ++i) at[i] -= system.shift[3 * size_t(point) + i];
        for (int o = bundle.first_of_point[point]; o < bundle.first_of_point[point + 1]; ++o)
            for (int k = 0; k < kOwn; ++k) {
                const double by = step[parameter(bundle, bundle.camera_of[o], k)];
                for (int i = 0; i < 3; ++i) at[i] -= system.spread[(size_t(o) * kOwn + k) * 3 + i] * by;
            }
    }
    for (int camera = 0; camera < bundle.num_cameras; ++camera) {
        turn(bundle.rotations + 9 * camera, &step[kPose * camera]);
        for (int i = 0; i < 3; ++i) bundle.translations[3 * camera + i] += step[kPose * camera + 3 + i];
    }
    for (int g = 0; g < bundle.num_lenses; ++g) {
        const double* of_lens = &step[kPose * bundle.num_cameras + kLens * g];
        bundle.log_focals[g] += std::clamp(of_lens[0], -0.5, 0.5);
        bundle.radials[g] += std::clamp(of_lens[1], -0.2, 0.2);
        bundle.shifts[2 * g] += of_lens[2];
        bundle.shifts[2 * g + 1] += of_lens[3];
    }
}

}  // namespace
}  // namespace core

using namespace core;

// Minimises the robust cost in place; stops when its relative decrease is below `tolerance`. Returns the cost.
CORE_API double core_bundle_adjust(const Bundle* bundle, int max_iterations, double tolerance) {
    System system(*bundle);
    const std::vector<int> kept = free_parameters(*bundle);
    std::vector<double> step(system.size);
    double damping = 1e-4, cost = total_cost(*bundle);
    for (int iteration = 0; iteration < max_iterations; ++iteration) {
        const State before(*bundle);
        double new_cost = cost;
        bool better = false;
        for (int trial = 0; trial < 8 && !better; ++trial) {
            assemble(*bundle, damping, system);
            if (solve(system, kept, step)) {
                move(*bundle, system, step);
                new_cost = total_cost(*bundle);
                better = new_cost < cost;
            }
            if (!better) {
                before.put_back(*bundle);
                damping *= 4;
            }
        }
        if (!better) return cost;
        const double decrease = (cost - new_cost) / cost;
        cost = new_cost;
        damping = std::max(damping / 5, 1e-9);
        if (decrease < tolerance) break;
    }
    return cost;
}

// The normal matrix of all poses and lenses with the points eliminated, (6 C + 4 G, 6 C + 4 G), without damping.
CORE_API void core_bundle_information(const Bundle* bundle, double* matrix) {
    System system(*bundle);
    assemble(*bundle, 0.0, system);
    for (int i = 0; i < system.size; ++i)
        for (int j = 0; j <= i; ++j)
            matrix[size_t(i) * system.size + j] = matrix[size_t(j) * system.size + i] =
                system.matrix[size_t(i) * system.size + j];
}
