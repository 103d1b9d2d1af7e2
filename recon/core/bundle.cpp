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

#include "threads.h"

namespace core {
namespace {

constexpr int kChunks = 16;
constexpr double kBehind = 1e6;     // squared pixels: the error of a point behind a camera
constexpr double kFloor = 1e-12;    // added to diagonals that damping scales
constexpr int kPose = 6, kLens = 4;  // numbers of a camera's pose and of a lens
constexpr int kOwn = kPose + kLens;  // parameters of an observation but its point

}  // namespace

// As recon.registration.bundle.Problem; observations ordered by point. Parameters are the cameras' poses (rotation
// vector applied from the left, translation), then the lenses' (log focal, radial, shift of the principal point).
struct Bundle {
    double *rotations, *translations;                            // (C, 3, 3), (C, 3)
    double *log_focals, *radials, *shifts, *points;              // (G,), (G,), (G, 2), (P, 3)
    const int32_t *lens_of_camera, *camera_of, *first_of_point;  // (C,), (O,), (P + 1,)
    const double* pixels;                                        // (O, 2)
    const double *prior_log_focals, *prior_sigmas, *radial_sigmas, *shift_sigmas;  // (G,); 0 fixes the parameter
    int32_t num_cameras, num_lenses, num_points, fixed_camera;
    double robust_squared;
};

namespace {

struct Projection {
    double turned[3], in_camera[3], u, v, focal, radial, squared_radius, distortion, residual[2], squared;
};

Projection project(const Bundle& bundle, int camera, const double* point, const double* pixel) {
    Projection p;
    const double* rotation = bundle.rotations + 9 * camera;
    for (int i = 0; i < 3; ++i) {
        p.turned[i] = rotation[3 * i] * point[0] + rotation[3 * i + 1] * point[1] + rotation[3 * i + 2] * point[2];
        p.in_camera[i] = p.turned[i] + bundle.translations[3 * camera + i];
    }
    const double z = std::abs(p.in_camera[2]) < 1e-9 ? 1e-9 : p.in_camera[2];
    const int lens = bundle.lens_of_camera[camera];
    p.u = p.in_camera[0] / z;
    p.v = p.in_camera[1] / z;
    p.focal = std::exp(bundle.log_focals[lens]);
    p.radial = bundle.radials[lens];
    p.squared_radius = p.u * p.u + p.v * p.v;
    p.distortion = 1 + p.radial * p.squared_radius;
    p.residual[0] = p.focal * p.distortion * p.u + bundle.shifts[2 * lens] - pixel[0];
    p.residual[1] = p.focal * p.distortion * p.v + bundle.shifts[2 * lens + 1] - pixel[1];
    p.squared = p.residual[0] * p.residual[0] + p.residual[1] * p.residual[1];
    return p;
}

// What pulls a lens' parameters; those without weight are fixed.
struct LensPrior {
    double deviations[kLens], weights[kLens];

    LensPrior(const Bundle& bundle, int g)
        : deviations{bundle.log_focals[g] - bundle.prior_log_focals[g], bundle.radials[g], bundle.shifts[2 * g],
                     bundle.shifts[2 * g + 1]} {
        const double sigmas[kLens] = {bundle.prior_sigmas[g], bundle.radial_sigmas[g], bundle.shift_sigmas[g],
                                      bundle.shift_sigmas[g]};
        for (int k = 0; k < kLens; ++k) weights[k] = sigmas[k] > 0 ? 1 / (sigmas[k] * sigmas[k]) : 0.0;
    }
};

double total_cost(const Bundle& bundle) {
    std::vector<double> costs(kChunks, 0.0);
    run_parallel(kChunks, [&](int chunk, int) {
        const int begin = int64_t(bundle.num_points) * chunk / kChunks;
        const int end = int64_t(bundle.num_points) * (chunk + 1) / kChunks;
        for (int point = begin; point < end; ++point)
            for (int o = bundle.first_of_point[point]; o < bundle.first_of_point[point + 1]; ++o) {
                const Projection p =
                    project(bundle, bundle.camera_of[o], bundle.points + 3 * point, bundle.pixels + 2 * o);
                const double squared = p.in_camera[2] > 0 ? p.squared : kBehind;
                costs[chunk] += bundle.robust_squared * std::log1p(squared / bundle.robust_squared);
            }
    });
    double cost = 0;
    for (const double value : costs) cost += value;
    for (int g = 0; g < bundle.num_lenses; ++g) {
        const LensPrior prior(bundle, g);
        for (int k = 0; k < kLens; ++k) cost += prior.deviations[k] * prior.deviations[k] * prior.weights[k];
    }
    return cost;
}

// Derivatives of a residual (2) by its camera's pose and lens (10) and by its point (3), and its weight.
struct Derivatives {
    double by_camera[2][kOwn], by_point[2][3], weight;
};

Derivatives differentiate(const Bundle& bundle, const Projection& p, int camera) {
    Derivatives d;
    const double z = std::abs(p.in_camera[2]) < 1e-9 ? 1e-9 : p.in_camera[2];
    const double cross = p.focal * 2 * p.radial * p.u * p.v;
    const double by_normalised[2][2] = {{p.focal * (p.distortion + 2 * p.radial * p.u * p.u), cross},
                                        {cross, p.focal * (p.distortion + 2 * p.radial * p.v * p.v)}};
    const double* rotation = bundle.rotations + 9 * camera;
    const double normalised[2] = {p.u, p.v};
    for (int k = 0; k < 2; ++k) {
        const double* n = by_normalised[k];
        const double position[3] = {n[0] / z, n[1] / z, -(n[0] * p.u + n[1] * p.v) / z};
        // A turn by w moves the turned point by w x turned.
        d.by_camera[k][0] = position[2] * p.turned[1] - position[1] * p.turned[2];
        d.by_camera[k][1] = position[0] * p.turned[2] - position[2] * p.turned[0];
        d.by_camera[k][2] = position[1] * p.turned[0] - position[0] * p.turned[1];
        for (int i = 0; i < 3; ++i) d.by_camera[k][3 + i] = position[i];
        d.by_camera[k][6] = normalised[k] * p.focal * p.distortion;
        d.by_camera[k][7] = normalised[k] * p.focal * p.squared_radius;
        d.by_camera[k][8] = k == 0;
        d.by_camera[k][9] = k == 1;
        for (int i = 0; i < 3; ++i)
            d.by_point[k][i] =
                position[0] * rotation[i] + position[1] * rotation[3 + i] + position[2] * rotation[6 + i];
    }
    d.weight = p.in_camera[2] > 0 ? 1 / (1 + p.squared / bundle.robust_squared) : 0.0;
    return d;
}

// False when the symmetric matrix (3, 3) is not invertible.
bool invert(const double m[3][3], double inverse[3][3]) {
    const double a = m[1][1] * m[2][2] - m[1][2] * m[2][1];
    const double b = m[1][2] * m[2][0] - m[1][0] * m[2][2];
    const double c = m[1][0] * m[2][1] - m[1][1] * m[2][0];
    const double determinant = m[0][0] * a + m[0][1] * b + m[0][2] * c;
    if (!(std::abs(determinant) > 1e-300)) return false;
    const double d = 1 / determinant;
    inverse[0][0] = a * d;
    inverse[0][1] = inverse[1][0] = b * d;
    inverse[0][2] = inverse[2][0] = c * d;
    inverse[1][1] = (m[0][0] * m[2][2] - m[0][2] * m[2][0]) * d;
    inverse[1][2] = inverse[2][1] = (m[0][2] * m[1][0] - m[0][0] * m[1][2]) * d;
    inverse[2][2] = (m[0][0] * m[1][1] - m[0][1] * m[1][0]) * d;
    return true;
}

inline void multiply(const double m[3][3], const double* vector, double* product) {
    for (int i = 0; i < 3; ++i) product[i] = m[i][0] * vector[0] + m[i][1] * vector[1] + m[i][2] * vector[2];
}

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

// Rodrigues' formula, applied from the left.
void turn(double* rotation, const double* vector) {
    const double x = vector[0], y = vector[1], z = vector[2];
    const double angle = std::sqrt(x * x + y * y + z * z);
    const double first = angle < 1e-8 ? 1.0 : std::sin(angle) / angle;
    const double second = angle < 1e-8 ? 0.5 : (1 - std::cos(angle)) / (angle * angle);
    const double by[3][3] = {{1 - second * (y * y + z * z), second * x * y - first * z, second * x * z + first * y},
                             {second * x * y + first * z, 1 - second * (x * x + z * z), second * y * z - first * x},
                             {second * x * z - first * y, second * y * z + first * x, 1 - second * (x * x + y * y)}};
    double turned[9];
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j)
            turned[3 * i + j] = by[i][0] * rotation[j] + by[i][1] * rotation[3 + j] + by[i][2] * rotation[6 + j];
    std::copy(turned, turned + 9, rotation);
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
