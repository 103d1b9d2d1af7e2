// The normal equations of a bundle, its points eliminated by the Schur complement.
//
// The work is in the points: each is linearised and eliminated by itself, so that they are dealt with in chunks that sum
// into systems of their own. The number of chunks is fixed, and with it the order of all sums: the result does not
// depend on the number of threads.
#pragma once

#include <algorithm>
#include <cstdint>
#include <vector>

#include "bundle_algebra.h"
#include "bundle_cost.h"
#include "threads.h"

namespace core {
namespace {

constexpr double kFloor = 1e-12;  // added to diagonals that damping scales
constexpr int kRowsPerTask = 16;   // of the system, when the chunks are added up

// Where the parameters of frame sets and of mounts begin.
inline int first_set(const Bundle& bundle) { return kPose * bundle.num_cameras + kLens * bundle.num_lenses; }
inline int first_mount(const Bundle& bundle) { return first_set(bundle) + kPose * bundle.num_sets; }

// Parameters of one camera or lens that a point touches: `size` of them from `start` on, and their place among the
// columns of the point.
struct Block {
    int start, size, place;
};

// Sums of a chunk of points, and scratch for one point.
struct Sums {
    std::vector<double> matrix, diagonal, gradient;  // (size, size) lower triangle, (size,) before elimination, (size,)
    std::vector<Block> blocks;
    std::vector<double> mixed[3], scaled[3];  // columns of the point's parameters, times the inverse of their matrix
};

// The normal equations of all poses and lenses after the points are eliminated, and what brings the points back.
struct System {
    int size;                      // parameters
    std::vector<double> matrix;    // (size, size), lower triangle
    std::vector<double> gradient;  // (size,)
    std::vector<double> spread;    // (O, 13, 3): (J_camera^T w J_point) (J_point^T w J_point)^-1
    std::vector<double> shift;     // (P, 3): (J_point^T w J_point)^-1 J_point^T w residual
    std::vector<Sums> sums;        // of each chunk

    explicit System(const Bundle& bundle)
        : size(first_mount(bundle) + kPose * bundle.num_mounts),
          matrix(size_t(size) * size),
          gradient(size),
          spread(size_t(bundle.first_of_point[bundle.num_points]) * 3 * kOwn),
          shift(size_t(bundle.num_points) * 3),
          sums(kChunks) {}
};

// Where the k-th of an observation's twelve parameters is among all.
inline int parameter(const Bundle& bundle, int camera, int k) {
    return k < kPose ? kPose * camera + k
                     : kPose * bundle.num_cameras + kLens * bundle.lens_of_camera[camera] + k - kPose;
}

// The columns of the block from `start` on, which is added (filled with 0) if the point does not have it yet.
int columns_of(Sums& sums, int start, int size, int& num_columns) {
    for (const Block& block : sums.blocks)
        if (block.start == start) return block.place;
    sums.blocks.push_back({start, size, num_columns});
    for (auto& row : sums.mixed) {
        row.resize(std::max(row.size(), size_t(num_columns + size)));
        std::fill(row.begin() + num_columns, row.begin() + num_columns + size, 0.0);
    }
    num_columns += size;
    return sums.blocks.back().place;
}

// What an observation says of its camera and lens, into the sums and the point's columns.
void add_observation(const Bundle& bundle, int observation, const Projection& p, const Derivatives& d, System& system,
                     Sums& sums, int& num_columns) {
    const int camera = bundle.camera_of[observation];
    const int pose = parameter(bundle, camera, 0), lens = parameter(bundle, camera, kPose);
    const int of_pose = columns_of(sums, pose, kPose, num_columns), of_lens = columns_of(sums, lens, kLens, num_columns);
    for (int k = 0; k < kOwn; ++k) {
        const double w0 = d.weight * d.by_camera[0][k], w1 = d.weight * d.by_camera[1][k];
        const int row = k < kPose ? pose + k : lens + k - kPose;
        double* of_row = &sums.matrix[size_t(row) * system.size];
        for (int j = 0; j <= std::min(k, kPose - 1); ++j)
            of_row[pose + j] += w0 * d.by_camera[0][j] + w1 * d.by_camera[1][j];
        for (int j = kPose; j <= k; ++j)
            of_row[lens + j - kPose] += w0 * d.by_camera[0][j] + w1 * d.by_camera[1][j];
        sums.diagonal[row] += w0 * d.by_camera[0][k] + w1 * d.by_camera[1][k];
        sums.gradient[row] += w0 * p.residual[0] + w1 * p.residual[1];
        const int column = k < kPose ? of_pose + k : of_lens + k - kPose;
        double* own = &system.spread[(size_t(observation) * kOwn + k) * 3];
        for (int i = 0; i < 3; ++i) {
            own[i] = w0 * d.by_point[0][i] + w1 * d.by_point[1][i];
            sums.mixed[i][column] += own[i];
        }
    }
}

// to -= the products of kSize columns with one of them.
template <int kSize>
inline void subtract(const double (&factors)[3], const Sums& sums, int place, double* to) {
    const double *m0 = &sums.mixed[0][place], *m1 = &sums.mixed[1][place], *m2 = &sums.mixed[2][place];
    for (int c = 0; c < kSize; ++c) to[c] -= factors[0] * m0[c] + factors[1] * m1[c] + factors[2] * m2[c];
}

// What the eliminated point takes away: columns^T inverse columns, the lower triangle by blocks.
void reduce(const double inverse[3][3], const double* right, int num_columns, int size, Sums& sums) {
    for (int i = 0; i < 3; ++i) {
        sums.scaled[i].resize(std::max(sums.scaled[i].size(), size_t(num_columns)));
        for (int a = 0; a < num_columns; ++a)
            sums.scaled[i][a] = inverse[i][0] * sums.mixed[0][a] + inverse[i][1] * sums.mixed[1][a] +
                                inverse[i][2] * sums.mixed[2][a];
    }
    for (const Block& rows : sums.blocks)
        for (int r = 0; r < rows.size; ++r) {
            const int a = rows.place + r;
            const double factors[3] = {sums.scaled[0][a], sums.scaled[1][a], sums.scaled[2][a]};
            sums.gradient[rows.start + r] -= factors[0] * right[0] + factors[1] * right[1] + factors[2] * right[2];
            double* of_row = &sums.matrix[size_t(rows.start + r) * size];
            for (const Block& columns : sums.blocks) {
                if (columns.start > rows.start) continue;
                if (columns.size == kPose) subtract<kPose>(factors, sums, columns.place, of_row + columns.start);
                else subtract<kLens>(factors, sums, columns.place, of_row + columns.start);
            }
        }
}

void eliminate(const Bundle& bundle, int point, double damping, System& system, Sums& sums) {
    const int first = bundle.first_of_point[point], last = bundle.first_of_point[point + 1];
    double block[3][3] = {}, right[3] = {};
    int num_columns = 0;
    sums.blocks.clear();
    for (int o = first; o < last; ++o) {
        const int camera = bundle.camera_of[o];
        const Projection p = project(bundle, camera, bundle.points + 3 * point, bundle.pixels + 2 * o);
        const Derivatives d = differentiate(bundle, p, camera);
        add_observation(bundle, o, p, d, system, sums, num_columns);
        for (int i = 0; i < 3; ++i) {
            for (int j = 0; j < 3; ++j)
                block[i][j] += d.weight * (d.by_point[0][i] * d.by_point[0][j] + d.by_point[1][i] * d.by_point[1][j]);
            right[i] += d.weight * (d.by_point[0][i] * p.residual[0] + d.by_point[1][i] * p.residual[1]);
        }
    }
    for (int i = 0; i < 3; ++i) block[i][i] += block[i][i] * damping + kFloor;
    double inverse[3][3] = {};
    invert(block, inverse);
    multiply(inverse, right, &system.shift[size_t(point) * 3]);
    for (int o = first; o < last; ++o)
        for (int k = 0; k < kOwn; ++k) {
            double* own = &system.spread[(size_t(o) * kOwn + k) * 3];
            const double mixed[3] = {own[0], own[1], own[2]};
            multiply(inverse, mixed, own);
        }
    reduce(inverse, right, num_columns, system.size, sums);
}

// How a deviation (turn, shift) changes with its camera's pose, (6, 6): a turn by w moves R c by w x R c. Turns are small,
// so that a turn's deviation changes as the turn itself does.
void differentiate_deviation(const PoseDeviation& d, double by_pose[kPose][kPose]) {
    const double* q = d.seen;
    const double by_turn[3][3] = {{0, q[2], -q[1]}, {-q[2], 0, q[0]}, {q[1], -q[0], 0}};
    for (int i = 0; i < kPose; ++i)
        for (int j = 0; j < kPose; ++j) by_pose[i][j] = i == j ? 1.0 : i >= 3 && j < 3 ? by_turn[i - 3][j] : 0.0;
}

// What given poses say of their cameras, of two of them where these depend on each other.
void add_given_poses(const Bundle& bundle, double damping, System& system) {
    const PosePriors priors(bundle);
    const size_t count = priors.cameras.size();
    std::vector<double> derivatives(count * kPose * kPose);
    for (size_t a = 0; a < count; ++a)
        differentiate_deviation(priors.seen[a],
                                reinterpret_cast<double(*)[kPose]>(&derivatives[a * kPose * kPose]));
    for (size_t a = 0; a < count; ++a) {
        const double* first = &derivatives[a * kPose * kPose];
        for (size_t b = 0; b <= a; ++b) {
            const double* second = &derivatives[b * kPose * kPose];
            double half[kPose][kPose] = {};  // information times the second's derivatives
            bool any = false;
            for (int i = 0; i < kPose; ++i) {
                const double* row = PosePriors::information(bundle, priors.cameras[a], i) + kPose * priors.cameras[b];
                for (int k = 0; k < kPose; ++k) {
                    if (row[k] == 0) continue;
                    any = true;
                    for (int j = 0; j < kPose; ++j) half[i][j] += row[k] * second[kPose * k + j];
                }
            }
            if (!any) continue;
            for (int i = 0; i < kPose; ++i) {
                double* row = &system.matrix[size_t(kPose * priors.cameras[a] + i) * system.size];
                for (int j = 0; j < kPose; ++j) {
                    if (a == b && j > i) continue;
                    double product = 0;
                    for (int k = 0; k < kPose; ++k) product += first[kPose * k + i] * half[k][j];
                    row[kPose * priors.cameras[b] + j] += product * (a == b && i == j ? 1 + damping : 1.0);
                }
            }
        }
        for (int i = 0; i < kPose; ++i)
            for (int k = 0; k < kPose; ++k)
                system.gradient[kPose * priors.cameras[a] + i] += first[kPose * k + i] * priors.pull[kPose * a + k];
    }
}

// What a given mount says of its own, as a given pose does of its camera.
void add_given_mount(const Bundle& bundle, int mount, double damping, System& system) {
    const double* information = bundle.given_mount_information + 2 * mount;
    if (!(information[0] > 0 || information[1] > 0)) return;
    const PoseDeviation d = deviate_mount(bundle, mount);
    double by_pose[kPose][kPose];
    differentiate_deviation(d, by_pose);
    const int start = first_mount(bundle) + kPose * mount;
    for (int i = 0; i < kPose; ++i) {
        double* row = &system.matrix[size_t(start + i) * system.size + start];
        for (int k = 0; k < kPose; ++k) {
            const double weighed = information[k / 3] * by_pose[k][i];
            system.gradient[start + i] += weighed * (k < 3 ? d.turn[k] : d.shift[k - 3]);
            for (int j = 0; j <= i; ++j) row[j] += weighed * by_pose[k][j] * (i == j ? 1 + damping : 1.0);
        }
    }
}

// The lines of a cross product with v: cross(v, w) = product w.
inline void fill_cross(const double* v, double (&product)[3][3]) {
    const double rows[3][3] = {{0, -v[2], v[1]}, {v[2], 0, -v[0]}, {-v[1], v[0], 0}};
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) product[i][j] = rows[i][j];
}

// What a rig says of a camera, its frame set and its mount. The deviations are a turn (3) and a shift (3); turns are
// small, as above.
void add_rig(const Bundle& bundle, int camera, double damping, System& system) {
    const int set = bundle.set_of_camera[camera], mount = bundle.mount_of_camera[camera];
    if (set < 0) return;
    const RigPose by_rig(bundle, camera);
    const PoseDeviation d(bundle.rotations + 9 * camera, bundle.translations + 3 * camera, by_rig.rotation,
                          by_rig.centre);
    const double* of_mount = bundle.mount_rotations + 9 * mount;
    double seen[3][3], placed[3][3], offset[3][3], by[6][18] = {};
    fill_cross(d.seen, seen);
    fill_cross(by_rig.translation, placed);
    fill_cross(bundle.mount_translations + 3 * mount, offset);
    for (int i = 0; i < 3; ++i) {
        by[i][i] = by[3 + i][3 + i] = 1;
        by[i][12 + i] = by[3 + i][15 + i] = -1;
        for (int j = 0; j < 3; ++j) {
            by[3 + i][j] = -seen[i][j];
            by[3 + i][12 + j] = -offset[i][j];
            by[i][6 + j] = by[3 + i][9 + j] = -of_mount[3 * i + j];
            for (int k = 0; k < 3; ++k) by[3 + i][6 + j] -= placed[i][k] * of_mount[3 * k + j];
        }
    }
    const int starts[3] = {kPose * camera, first_set(bundle) + kPose * set, first_mount(bundle) + kPose * mount};
    const double* information = bundle.rig_information + 2 * camera;
    for (int a = 0; a < 18; ++a) {
        const int row = starts[a / 6] + a % 6;
        double* of_row = &system.matrix[size_t(row) * system.size];
        for (int i = 0; i < 6; ++i) {
            const double weighed = information[i / 3] * by[i][a];
            system.gradient[row] += weighed * (i < 3 ? d.turn[i] : d.shift[i - 3]);
            for (int b = 0; b <= a; ++b) of_row[starts[b / 6] + b % 6] += weighed * by[i][b];
            of_row[row] += damping * weighed * by[i][a];
        }
    }
}

void assemble(const Bundle& bundle, double damping, System& system) {
    const int size = system.size;
    run_parallel(kChunks, [&](int chunk, int) {
        Sums& mine = system.sums[chunk];
        mine.matrix.assign(size_t(size) * size, 0.0);
        mine.diagonal.assign(size, 0.0);
        mine.gradient.assign(size, 0.0);
        const int begin = int64_t(bundle.num_points) * chunk / kChunks;
        const int end = int64_t(bundle.num_points) * (chunk + 1) / kChunks;
        for (int point = begin; point < end; ++point) eliminate(bundle, point, damping, system, mine);
    });
    run_ranges(size, kRowsPerTask, [&](int begin, int end, int) {
        for (int i = begin; i < end; ++i) {
            double* row = &system.matrix[size_t(i) * size];
            double diagonal = 0;
            std::fill(row, row + i + 1, 0.0);
            system.gradient[i] = 0;
            for (const Sums& part : system.sums) {
                const double* of_part = &part.matrix[size_t(i) * size];
                for (int j = 0; j <= i; ++j) row[j] += of_part[j];
                diagonal += part.diagonal[i];
                system.gradient[i] += part.gradient[i];
            }
            row[i] += diagonal * damping + kFloor;
        }
    });
    const LensPriors priors(bundle);
    const int first = kPose * bundle.num_cameras;
    for (int i = 0; i < priors.size; ++i) {
        const double* information = bundle.prior_information + size_t(i) * priors.size;
        double* row = &system.matrix[size_t(first + i) * size + first];
        for (int j = 0; j <= i; ++j) row[j] += information[j];
        row[i] += information[i] * damping;
        system.gradient[first + i] += priors.pull[i];
    }
    add_given_poses(bundle, damping, system);
    if (bundle.num_sets == 0) return;
    for (int camera = 0; camera < bundle.num_cameras; ++camera) add_rig(bundle, camera, damping, system);
    for (int mount = 0; mount < bundle.num_mounts; ++mount) add_given_mount(bundle, mount, damping, system);
}

}  // namespace
}  // namespace core
