// What bundle adjustment makes small, and how it changes: residuals of observations with their derivatives, what pulls
// the lenses, and the robust cost of it all.
#pragma once

#include <cmath>
#include <cstdint>
#include <vector>

#include "threads.h"

namespace core {

constexpr int kChunks = 16;          // of points, that are dealt with in parallel
constexpr double kBehind = 1e6;      // squared pixels: the error of a point behind a camera
constexpr int kPose = 6, kLens = 7;  // numbers of a camera's pose and of a lens
constexpr int kOwn = kPose + kLens;  // parameters of an observation but its point

// As splatnode.recon.registration.bundle_adjustment.Problem; observations ordered by point. Parameters are the cameras' poses (rotation
// vector applied from the left, translation), then the lenses' (log focal, two radial, shift of the principal point, log
// of the focal length down over that across, skew).
struct Bundle {
    double *rotations, *translations;                            // (C, 3, 3), (C, 3)
    double *log_focals, *radials, *shifts, *log_aspects, *skews;  // (G,), (G, 2), (G, 2), (G,), (G,)
    double* points;                                              // (P, 3)
    const int32_t *lens_of_camera, *camera_of, *first_of_point;  // (C,), (O,), (P + 1,)
    const double* pixels;                                        // (O, 2)
    // (G, 7) means of the lens parameters and their information (7 G, 7 G); a diagonal element of 0 fixes a parameter.
    const double *prior_means, *prior_information;
    int32_t num_cameras, num_lenses, num_points, fixed_camera;  // fixed_camera -1: given poses hold all of them
    double robust_squared;
    // Given poses, world to camera: rotations (C, 3, 3), centres (C, 3), and the information (6 C, 6 C) of their errors in
    // the cameras' axes, of each a turn and a shift; 0 on the diagonal: nothing is given. Null: nothing of any camera.
    const double *given_rotations, *given_centres, *given_information;
    // A rig: cameras of a frame set have one pose together, and each its mount on the rig. Rotations (., 3, 3) and
    // translations (., 3) of S sets, world to rig, and of M mounts, rig to camera, are parameters after the lenses.
    double *set_rotations, *set_translations, *mount_rotations, *mount_translations;
    const int32_t *set_of_camera, *mount_of_camera;  // (C,) -1: this camera is in no frame set
    const double* rig_information;                   // (C, 2) of a turn and of a shift between camera and rig
    // Given mounts as given poses are: (M, 3, 3), (M, 3), (M, 2); a negative information fixes the mount.
    const double *given_mount_rotations, *given_mount_centres, *given_mount_information;
    int32_t num_sets, num_mounts;
};

struct Projection {
    double turned[3], in_camera[3], u, v, focal, aspect, skew, squared_radius, residual[2], squared;
    double distortion, bend;  // 1 + k1 r^2 + k2 r^4, and its derivative by r^2
};

static Projection project(const Bundle& bundle, int camera, const double* point, const double* pixel) {
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
    p.aspect = std::exp(bundle.log_aspects[lens]);
    p.skew = bundle.skews[lens];
    p.squared_radius = p.u * p.u + p.v * p.v;
    const double first = bundle.radials[2 * lens], second = bundle.radials[2 * lens + 1] * p.squared_radius;
    p.distortion = 1 + (first + second) * p.squared_radius;
    p.bend = first + 2 * second;
    p.residual[0] = p.focal * p.distortion * (p.u + p.skew * p.v) + bundle.shifts[2 * lens] - pixel[0];
    p.residual[1] = p.focal * p.aspect * p.distortion * p.v + bundle.shifts[2 * lens + 1] - pixel[1];
    p.squared = p.residual[0] * p.residual[0] + p.residual[1] * p.residual[1];
    return p;
}

// What pulls the lenses' parameters: a Gaussian prior, under which lenses may depend on each other.
struct LensPriors {
    int size;                        // 7 G
    std::vector<double> deviations;  // (7 G,) from the means
    std::vector<double> pull;        // (7 G,) information times deviations: half the gradient

    explicit LensPriors(const Bundle& bundle)
        : size(kLens * bundle.num_lenses), deviations(size), pull(size, 0.0) {
        for (int g = 0; g < bundle.num_lenses; ++g) {
            const double values[kLens] = {bundle.log_focals[g], bundle.radials[2 * g],    bundle.radials[2 * g + 1],
                                          bundle.shifts[2 * g], bundle.shifts[2 * g + 1], bundle.log_aspects[g],
                                          bundle.skews[g]};
            for (int k = 0; k < kLens; ++k)
                deviations[kLens * g + k] = values[k] - bundle.prior_means[kLens * g + k];
        }
        for (int i = 0; i < size; ++i) {
            const double* row = bundle.prior_information + size_t(i) * size;
            for (int j = 0; j < size; ++j) pull[i] += row[j] * deviations[j];
        }
    }

    double cost() const {
        double sum = 0;
        for (int i = 0; i < size; ++i) sum += deviations[i] * pull[i];
        return sum;
    }
};

inline bool is_free(const Bundle& bundle, int parameter) {
    return bundle.prior_information[size_t(parameter) * (kLens * bundle.num_lenses) + parameter] > 0;
}

// How far a pose is from a given one, in its own axes: the turn (3) and the shift (3), and what they depend on.
struct PoseDeviation {
    double turn[3], shift[3], seen[3];  // seen: the given centre from the pose's origin of translation, R c

    // `rotation` (3, 3) and `translation` (3) of the pose, `given` (3, 3) and `centre` (3) of the given one.
    PoseDeviation(const double* rotation, const double* translation, const double* given, const double* centre) {
        double by[3][3];
        for (int i = 0; i < 3; ++i) {
            for (int j = 0; j < 3; ++j) {
                by[i][j] = 0;
                for (int k = 0; k < 3; ++k) by[i][j] += rotation[3 * i + k] * given[3 * j + k];
            }
            seen[i] = 0;
            for (int k = 0; k < 3; ++k) seen[i] += rotation[3 * i + k] * centre[k];
            shift[i] = seen[i] + translation[i];
        }
        const double half[3] = {(by[2][1] - by[1][2]) / 2, (by[0][2] - by[2][0]) / 2, (by[1][0] - by[0][1]) / 2};
        const double sine = std::sqrt(half[0] * half[0] + half[1] * half[1] + half[2] * half[2]);
        const double angle = std::atan2(sine, (by[0][0] + by[1][1] + by[2][2] - 1) / 2);
        const double factor = sine < 1e-12 ? 1.0 : angle / sine;
        for (int i = 0; i < 3; ++i) turn[i] = factor * half[i];
    }
};

inline PoseDeviation deviate_camera(const Bundle& b, int i) {
    return {b.rotations + 9 * i, b.translations + 3 * i, b.given_rotations + 9 * i, b.given_centres + 3 * i};
}

inline PoseDeviation deviate_mount(const Bundle& b, int i) {
    return {b.mount_rotations + 9 * i, b.mount_translations + 3 * i, b.given_mount_rotations + 9 * i,
            b.given_mount_centres + 3 * i};
}

// The pose that a camera has by the rig, world to camera: that of its frame set, then its mount.
struct RigPose {
    double rotation[9], translation[3], centre[3];

    RigPose(const Bundle& bundle, int camera) {
        const int set = bundle.set_of_camera[camera], mount = bundle.mount_of_camera[camera];
        const double *m = bundle.mount_rotations + 9 * mount, *s = bundle.set_rotations + 9 * set;
        for (int i = 0; i < 3; ++i) {
            translation[i] = bundle.mount_translations[3 * mount + i];
            for (int k = 0; k < 3; ++k) translation[i] += m[3 * i + k] * bundle.set_translations[3 * set + k];
            for (int j = 0; j < 3; ++j) {
                rotation[3 * i + j] = 0;
                for (int k = 0; k < 3; ++k) rotation[3 * i + j] += m[3 * i + k] * s[3 * k + j];
            }
        }
        for (int j = 0; j < 3; ++j) {
            centre[j] = 0;
            for (int i = 0; i < 3; ++i) centre[j] -= rotation[3 * i + j] * translation[i];
        }
    }
};

inline double deviation_cost(const PoseDeviation& d, const double* information) {
    double cost = 0;
    for (int i = 0; i < 3; ++i)
        cost += information[0] * d.turn[i] * d.turn[i] + information[1] * d.shift[i] * d.shift[i];
    return cost;
}

// What pulls the cameras: Gaussian priors on how far they are from their given poses, which may depend on each other.
struct PosePriors {
    std::vector<int> cameras;         // that have a given pose
    std::vector<PoseDeviation> seen;  // of each of these
    std::vector<double> deviations;   // (6,) of each of these: turn, shift
    std::vector<double> pull;         // likewise: information times deviations

    explicit PosePriors(const Bundle& bundle) {
        if (!bundle.given_information) return;
        for (int camera = 0; camera < bundle.num_cameras; ++camera) {
            if (!(information(bundle, camera, 0)[kPose * camera] > 0)) continue;
            cameras.push_back(camera);
            seen.push_back(deviate_camera(bundle, camera));
            deviations.insert(deviations.end(), seen.back().turn, seen.back().turn + 3);
            deviations.insert(deviations.end(), seen.back().shift, seen.back().shift + 3);
        }
        pull.assign(deviations.size(), 0.0);
        for (size_t a = 0; a < cameras.size(); ++a)
            for (int i = 0; i < kPose; ++i) {
                const double* row = information(bundle, cameras[a], i);
                for (size_t b = 0; b < cameras.size(); ++b)
                    for (int j = 0; j < kPose; ++j)
                        pull[kPose * a + i] += row[kPose * cameras[b] + j] * deviations[kPose * b + j];
            }
    }

    // The i-th row of a camera.
    static const double* information(const Bundle& bundle, int camera, int i) {
        return bundle.given_information + size_t(kPose * camera + i) * kPose * bundle.num_cameras;
    }

    double cost() const {
        double sum = 0;
        for (size_t i = 0; i < pull.size(); ++i) sum += deviations[i] * pull[i];
        return sum;
    }
};

// What the rig says: how far cameras are from where their frame sets and mounts have them, and mounts from given ones.
static double rig_cost(const Bundle& bundle) {
    if (bundle.num_sets == 0) return 0;
    double cost = 0;
    for (int camera = 0; camera < bundle.num_cameras; ++camera) {
        if (bundle.set_of_camera[camera] < 0) continue;
        const RigPose by_rig(bundle, camera);
        const double *rotation = bundle.rotations + 9 * camera, *translation = bundle.translations + 3 * camera;
        const PoseDeviation d(rotation, translation, by_rig.rotation, by_rig.centre);
        cost += deviation_cost(d, bundle.rig_information + 2 * camera);
    }
    for (int mount = 0; mount < bundle.num_mounts; ++mount) {
        const double* information = bundle.given_mount_information + 2 * mount;
        if (information[0] > 0 || information[1] > 0) cost += deviation_cost(deviate_mount(bundle, mount), information);
    }
    return cost;
}

static double total_cost(const Bundle& bundle) {
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
    return cost + LensPriors(bundle).cost() + PosePriors(bundle).cost() + rig_cost(bundle);
}

// Derivatives of a residual (2) by its camera's pose and lens (13) and by its point (3), and its weight.
struct Derivatives {
    double by_camera[2][kOwn], by_point[2][3], weight;
};

static Derivatives differentiate(const Bundle& bundle, const Projection& p, int camera) {
    Derivatives d;
    const double z = std::abs(p.in_camera[2]) < 1e-9 ? 1e-9 : p.in_camera[2];
    const double focals[2] = {p.focal, p.focal * p.aspect};
    const double cross = 2 * p.bend * p.u * p.v;
    const double across[2] = {p.distortion + 2 * p.bend * p.u * p.u, cross};
    const double down[2] = {cross, p.distortion + 2 * p.bend * p.v * p.v};
    const double by_normalised[2][2] = {
        {focals[0] * (across[0] + p.skew * down[0]), focals[0] * (across[1] + p.skew * down[1])},
        {focals[1] * down[0], focals[1] * down[1]}};
    const double* rotation = bundle.rotations + 9 * camera;
    const double normalised[2] = {p.u + p.skew * p.v, p.v};
    for (int k = 0; k < 2; ++k) {
        const double* n = by_normalised[k];
        const double position[3] = {n[0] / z, n[1] / z, -(n[0] * p.u + n[1] * p.v) / z};
        // A turn by w moves the turned point by w x turned.
        d.by_camera[k][0] = position[2] * p.turned[1] - position[1] * p.turned[2];
        d.by_camera[k][1] = position[0] * p.turned[2] - position[2] * p.turned[0];
        d.by_camera[k][2] = position[1] * p.turned[0] - position[0] * p.turned[1];
        for (int i = 0; i < 3; ++i) d.by_camera[k][3 + i] = position[i];
        d.by_camera[k][6] = normalised[k] * focals[k] * p.distortion;
        d.by_camera[k][7] = normalised[k] * focals[k] * p.squared_radius;
        d.by_camera[k][8] = d.by_camera[k][7] * p.squared_radius;
        d.by_camera[k][9] = k == 0;
        d.by_camera[k][10] = k == 1;
        d.by_camera[k][11] = k == 1 ? d.by_camera[k][6] : 0.0;
        d.by_camera[k][12] = k == 0 ? focals[0] * p.distortion * p.v : 0.0;
        for (int i = 0; i < 3; ++i)
            d.by_point[k][i] =
                position[0] * rotation[i] + position[1] * rotation[3 + i] + position[2] * rotation[6 + i];
    }
    d.weight = p.in_camera[2] > 0 ? 1 / (1 + p.squared / bundle.robust_squared) : 0.0;
    return d;
}

}  // namespace core
