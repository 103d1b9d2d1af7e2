// One pixel of PatchMatch stereo: random numbers, what all pixels share, and the costs of a pixel's hypotheses.
#pragma once

#include <algorithm>
#include <cmath>
#include <vector>

#include "patchmatch.h"
#include "patchmatch_cost.h"

namespace patchmatch {
namespace {

// The n-th random number of a stream, uniform in [-1, 1). The mixing function is "lowbias32" by C. Wellons.
class Random {
public:
    Random(const Problem& problem, size_t pixel, int iteration)
        : state_(mix(mix(mix(problem.seed) ^ uint32_t(pixel)) ^ (problem.stream * 256 + uint32_t(iteration)))) {}

    float symmetric() {
        state_ = mix(state_ + 0x9e3779b9u);
        return float(int32_t(state_)) * 0x1p-31f;
    }

private:
    static uint32_t mix(uint32_t x) {
        x ^= x >> 16;
        x *= 0x7feb352du;
        x ^= x >> 15;
        x *= 0x846ca68bu;
        return x ^ (x >> 16);
    }

    uint32_t state_;
};

// What all pixels share.
struct Task {
    const Problem& problem;
    const Padded padded;
    const Pattern pattern;
    std::vector<float> source_costs;  // (height, width, num_sources) of each pixel's plane
    int active;                       // sources that a new plane is compared in

    explicit Task(const Problem& given)
        : problem(given), padded(given.grey, given.width, given.height), pattern(padded.stride(), given.sigma_space),
          source_costs(size_t(given.width) * given.height * given.num_sources),
          active(std::min(given.num_sources, given.active_sources)) {}
};

// Planes may spread this much nearer or farther than the range that is searched: the ground in front of the scene.
constexpr float kReach = 3.0f;

// Least squared cosine between a plane's normal and the line of sight: 84 degrees, beyond which matching windows fold.
constexpr float kMinSquaredCosine = 0.01f;

constexpr int kNear[4][2] = {{-1, 0}, {1, 0}, {0, -1}, {0, 1}};

// Everything about one pixel that its hypotheses share.
class Pixel {
public:
    Pixel(const Task& task, int x, int y)
        : task_(task), problem_(task.problem), index_(size_t(y) * task.problem.width + x), u_(x + 0.5f), v_(y + 0.5f),
          window_(task.pattern, task.padded.at(x, y), task.problem.sigma_grey) {
        for (int s = 0; s < problem_.num_sources; ++s)
            rays_[s] = ray_through(problem_.sources[s].from_reference, u_, v_);
        const float ray_x = (u_ - problem_.cx) / problem_.fx, ray_y = (v_ - problem_.cy) / problem_.fy;
        ray_length_squared_ = 1 + ray_x * ray_x + ray_y * ray_y;
        for (int n = 0; n < 4; ++n) {
            const int nx = x + kNear[n][0], ny = y + kNear[n][1];
            const bool inside = nx >= 0 && ny >= 0 && nx < problem_.width && ny < problem_.height;
            near_[n] = inside ? kNear[n][1] * problem_.width + kNear[n][0] : 0;
            const float difference = float(problem_.grey[index_ + near_[n]]) - float(problem_.grey[index_]);
            const float relative = difference / problem_.sigma_grey;
            near_weight_[n] = inside ? problem_.smoothness / (1 + relative * relative) : 0;
        }
    }

    size_t index() const { return index_; }
    float worst_cost() const { return 1 + problem_.geometric * problem_.geometric_limit; }

    // Near the depth range, which random planes keep to, and not too oblique.
    bool plausible(const Plane& plane) const {
        const float w = plane.inverse_depth;
        const float nx = problem_.fx * plane.du, ny = problem_.fy * plane.dv;
        const float nz = plane.at(problem_.cx - u_, problem_.cy - v_);
        const float length_squared = (nx * nx + ny * ny + nz * nz) * ray_length_squared_;
        return (w >= problem_.min_inverse_depth / kReach) & (w <= problem_.max_inverse_depth * kReach) &
               (w * w >= kMinSquaredCosine * length_squared);
    }

    // Pixels of parallax per unit of inverse depth, root mean square over the sources that see the plane.
    float parallax(const Plane& plane) const {
        float total = 0, seen = 0;
        for (int s = 0; s < problem_.num_sources; ++s) {
            const Transfer& transfer = problem_.sources[s].from_reference;
            const Point point = at_inverse_depth(rays_[s], transfer, plane.inverse_depth);
            const Landing there(point, problem_.sources[s].width, problem_.sources[s].height);
            const float du = (transfer.t[0] - there.u * transfer.t[2]) / point.z;
            const float dv = (transfer.t[1] - there.v * transfer.t[2]) / point.z;
            total += there.inside ? du * du + dv * dv : 0;
            seen += there.inside ? 1 : 0;
        }
        return std::sqrt(total / std::max(seen, 1.0f));
    }

    // Matching and geometric costs of `count` planes in the `num_sources` sources named by `sources`, plane by plane.
    void data_costs(const Plane* planes, int count, const int* sources, int num_sources, float* costs) const {
        Pairs pairs;
        for (int p = 0; p < count; ++p)
            for (int n = 0; n < num_sources; ++n) add_pair(planes[p], sources[n], pairs);
        matching_costs(pairs, window_.variance, problem_.noise_variance, costs);
        if (problem_.geometric > 0)
            add_reprojection_errors(pairs, u_, v_, problem_.geometric, problem_.geometric_limit, costs);
        for (int i = 0; i < pairs.count; ++i) costs[i] = pairs.outside[i] > 0 ? worst_cost() : costs[i];
    }

    // How far the plane passes from the four neighbours' points, where the image gives no reason for an edge.
    float smoothness_cost(const Plane& plane, float parallax) const {
        float total = 0;
        for (int n = 0; n < 4; ++n) {
            const float neighbour = problem_.planes[index_ + near_[n]].inverse_depth;
            const float here = plane.at(float(kNear[n][0]), float(kNear[n][1]));
            total += near_weight_[n] * std::min(std::fabs(here - neighbour) * parallax, problem_.smoothness_limit);
        }
        return total;
    }

private:
    void add_pair(const Plane& plane, int index, Pairs& pairs) const {
        const Source& source = problem_.sources[index];
        const Point centre = at_inverse_depth(rays_[index], source.from_reference, plane.inverse_depth);
        const Landing there(centre, source.width, source.height);
        add_moments(plane, window_, task_.pattern, source, centre, pairs);
        if (problem_.geometric > 0) add_return(source, there, pairs);
        pairs.outside[pairs.count] = there.inside ? 0 : 1;
        ++pairs.count;
    }

    const Task& task_;
    const Problem& problem_;
    const size_t index_;
    const float u_, v_;
    const Window window_;
    Point rays_[kMaxSources];
    ptrdiff_t near_[4];     // offsets of the neighbours, 0 outside the image
    float near_weight_[4];  // weights of the neighbours, 0 outside the image
    float ray_length_squared_;
};

}  // namespace
}  // namespace patchmatch
