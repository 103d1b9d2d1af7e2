// Bundle adjustment for up to a few dozen cameras: Levenberg-Marquardt on a Cauchy loss of the reprojection errors, the
// points eliminated by the Schur complement ("Bundle adjustment - a modern synthesis", Triggs et al. 1999, section 6).
//
// With so few cameras the reduced system is small and dense.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <vector>

#include "bundle_algebra.h"
#include "bundle_cost.h"
#include "bundle_system.h"

namespace core {
namespace {

std::vector<int> free_parameters(const Bundle& bundle) {
    std::vector<int> kept;
    for (int i = 0; i < kPose * bundle.num_cameras; ++i)
        if (i / kPose != bundle.fixed_camera) kept.push_back(i);
    for (int k = 0; k < kLens * bundle.num_lenses; ++k)
        if (is_free(bundle, k)) kept.push_back(kPose * bundle.num_cameras + k);
    for (int i = 0; i < kPose * bundle.num_sets; ++i) kept.push_back(first_set(bundle) + i);
    for (int i = 0; i < kPose * bundle.num_mounts; ++i)
        if (!(bundle.given_mount_information[2 * (i / kPose)] < 0)) kept.push_back(first_mount(bundle) + i);
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
    std::vector<double> rotations, translations, log_focals, radials, shifts, log_aspects, skews, points;
    std::vector<double> set_rotations, set_translations, mount_rotations, mount_translations;

    explicit State(const Bundle& b)
        : rotations(b.rotations, b.rotations + 9 * b.num_cameras),
          translations(b.translations, b.translations + 3 * b.num_cameras),
          log_focals(b.log_focals, b.log_focals + b.num_lenses),
          radials(b.radials, b.radials + 2 * b.num_lenses),
          shifts(b.shifts, b.shifts + 2 * b.num_lenses),
          log_aspects(b.log_aspects, b.log_aspects + b.num_lenses),
          skews(b.skews, b.skews + b.num_lenses),
          points(b.points, b.points + 3 * size_t(b.num_points)),
          set_rotations(b.set_rotations, b.set_rotations + 9 * b.num_sets),
          set_translations(b.set_translations, b.set_translations + 3 * b.num_sets),
          mount_rotations(b.mount_rotations, b.mount_rotations + 9 * b.num_mounts),
          mount_translations(b.mount_translations, b.mount_translations + 3 * b.num_mounts) {}

    void put_back(const Bundle& b) const {
        std::copy(rotations.begin(), rotations.end(), b.rotations);
        std::copy(translations.begin(), translations.end(), b.translations);
        std::copy(log_focals.begin(), log_focals.end(), b.log_focals);
        std::copy(radials.begin(), radials.end(), b.radials);
        std::copy(shifts.begin(), shifts.end(), b.shifts);
        std::copy(log_aspects.begin(), log_aspects.end(), b.log_aspects);
        std::copy(skews.begin(), skews.end(), b.skews);
        std::copy(points.begin(), points.end(), b.points);
        std::copy(set_rotations.begin(), set_rotations.end(), b.set_rotations);
        std::copy(set_translations.begin(), set_translations.end(), b.set_translations);
        std::copy(mount_rotations.begin(), mount_rotations.end(), b.mount_rotations);
        std::copy(mount_translations.begin(), mount_translations.end(), b.mount_translations);
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
    const auto move_poses = [&](double* rotations, double* translations, int count, int start) {
        for (int pose = 0; pose < count; ++pose) {
            turn(rotations + 9 * pose, &step[start + kPose * pose]);
            for (int i = 0; i < 3; ++i) translations[3 * pose + i] += step[start + kPose * pose + 3 + i];
        }
    };
    move_poses(bundle.rotations, bundle.translations, bundle.num_cameras, 0);
    move_poses(bundle.set_rotations, bundle.set_translations, bundle.num_sets, first_set(bundle));
    move_poses(bundle.mount_rotations, bundle.mount_translations, bundle.num_mounts, first_mount(bundle));
    for (int g = 0; g < bundle.num_lenses; ++g) {
        const double* of_lens = &step[kPose * bundle.num_cameras + kLens * g];
        bundle.log_focals[g] += std::clamp(of_lens[0], -0.5, 0.5);
        bundle.log_aspects[g] += std::clamp(of_lens[5], -0.2, 0.2);
        bundle.skews[g] += std::clamp(of_lens[6], -0.2, 0.2);
        for (int k = 0; k < 2; ++k) {
            bundle.radials[2 * g + k] += std::clamp(of_lens[1 + k], -0.2, 0.2);
            bundle.shifts[2 * g + k] += of_lens[3 + k];
        }
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

// The normal matrix of all poses, lenses, frame sets and mounts with the points eliminated, without damping:
// (6 C + 7 G + 6 S + 6 M) on a side.
CORE_API void core_bundle_information(const Bundle* bundle, double* matrix) {
    System system(*bundle);
    assemble(*bundle, 0.0, system);
    for (int i = 0; i < system.size; ++i)
        for (int j = 0; j <= i; ++j)
            matrix[size_t(i) * system.size + j] = matrix[size_t(j) * system.size + i] =
                system.matrix[size_t(i) * system.size + j];
}
