// Slanted-plane PatchMatch multi-view stereo for one reference view at one resolution.
//
// Bleyer et al., "PatchMatch Stereo" (2011): planes spread to neighbours and are perturbed at random. Galliani et al.,
// "Massively Parallel Multiview Stereopsis by Surface Normal Diffusion" (2015): red pixels read black ones only, so a
// half-step has no order. Xu and Tao, "Multi-Scale Geometric Consistency Guided Multi-View Stereo" (2019): spreading
// from the best of several distances, and the forward-backward reprojection error as part of the cost.
// Random numbers depend on seed, pixel and iteration only: the result is the same for any number of threads.
#include "patchmatch.h"

#include <algorithm>
#include <cmath>
#include <vector>

#include "patchmatch_cost.h"
#include "threads.h"

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

    // Near the depth range, which random planes keep to, and less than about 84 degrees off the line of sight.
    bool plausible(const Plane& plane) const {
        const float w = plane.inverse_depth;
        const float nx = problem_.fx * plane.du, ny = problem_.fy * plane.dv;
        const float nz = plane.at(problem_.cx - u_, problem_.cy - v_);
        const float length_squared = (nx * nx + ny * ny + nz * nz) * ray_length_squared_;
        return (w >= problem_.min_inverse_depth / kReach) & (w <= problem_.max_inverse_depth * kReach) & (w * w >= 0.01f * length_squared);
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

// The best plane of a pixel so far, against challengers in the sources that explain it best.
class Contest {
public:
    Contest(Task& task, const Pixel& pixel)
        : task_(task), problem_(task.problem), pixel_(pixel), best_(problem_.planes[pixel.index()]),
          parallax_(pixel.parallax(best_)), data_cost_(problem_.costs[pixel.index()]),
          total_(data_cost_ + pixel.smoothness_cost(best_, parallax_)),
          source_costs_(&task.source_costs[pixel.index() * problem_.num_sources]) {
        int order[kMaxSources];
        for (int s = 0; s < problem_.num_sources; ++s) {
            int place = 0;
            for (int other = 0; other < problem_.num_sources; ++other)
                place += source_costs_[other] < source_costs_[s] || (source_costs_[other] == source_costs_[s] && other < s);
            order[place] = s;
        }
        std::copy(order, order + task.active, active_);
    }

    const Plane& best() const { return best_; }
    float parallax() const { return parallax_; }

    void add(const Plane& plane) {
        if (pixel_.plausible(plane) && !nearly_best(plane)) candidates_[num_candidates_++] = plane;
    }

    // Compares the planes that were added.
    void decide() {
        const int active = task_.active;
        float costs[kMaxCandidates * kMaxSources];
        pixel_.data_costs(candidates_, num_candidates_, active_, active, costs);
        int winner = -1;
        for (int c = 0; c < num_candidates_; ++c) {
            float sorted[kMaxSources];
            std::copy(costs + c * active, costs + (c + 1) * active, sorted);
            const float data_cost = combine(sorted, active, active, problem_.best_weight_ratio);
            const float total = data_cost + pixel_.smoothness_cost(candidates_[c], parallax_);
            const bool wins = total < total_;
            winner = wins ? c : winner;
            total_ = wins ? total : total_;
            data_cost_ = wins ? data_cost : data_cost_;
        }
        num_candidates_ = 0;
        if (winner < 0) return;
        best_ = candidates_[winner];
        for (int n = 0; n < active; ++n) source_costs_[active_[n]] = costs[winner * active + n];
    }

    void store() const {
        problem_.planes[pixel_.index()] = best_;
        problem_.costs[pixel_.index()] = data_cost_;
    }

private:
    // Closer over the whole window than a match can tell.
    bool nearly_best(const Plane& plane) const {
        const float depth = std::fabs(plane.inverse_depth - best_.inverse_depth);
        const float slope = std::fabs(plane.du - best_.du) + std::fabs(plane.dv - best_.dv);
        return (depth + kRadius * slope) * parallax_ < 0.1f;
    }

    const Task& task_;
    const Problem& problem_;
    const Pixel& pixel_;
    Plane best_;
    const float parallax_;
    float data_cost_, total_;
    float* source_costs_;
    int active_[kMaxSources];
    Plane candidates_[kMaxCandidates];
    int num_candidates_ = 0;
};

// The given plane against random ones, one in each of equal slices of inverse depth.
void start(Task& task, int x, int y) {
    const Problem& problem = task.problem;
    const Pixel pixel(task, x, y);
    int all[kMaxSources];
    for (int s = 0; s < problem.num_sources; ++s) all[s] = s;
    float* best_costs = &task.source_costs[pixel.index() * problem.num_sources];
    Plane& best = problem.planes[pixel.index()];
    float& best_cost = problem.costs[pixel.index()];
    best_cost = 2 * pixel.worst_cost();
    std::fill_n(best_costs, problem.num_sources, best_cost);
    const auto challenge = [&](const Plane& plane) {
        if (!pixel.plausible(plane)) return;
        float costs[kMaxSources], sorted[kMaxSources];
        pixel.data_costs(&plane, 1, all, problem.num_sources, costs);
        std::copy(costs, costs + problem.num_sources, sorted);
        const float cost = combine(sorted, problem.num_sources, task.active, problem.best_weight_ratio);
        if (cost >= best_cost) return;
        best = plane;
        best_cost = cost;
        std::copy(costs, costs + problem.num_sources, best_costs);
    };
    challenge(Plane(best));
    Random random(problem, pixel.index(), 255);
    const float slice = (problem.max_inverse_depth - problem.min_inverse_depth) / std::max(problem.random_starts, 1);
    for (int n = 0; n < problem.random_starts; ++n) {
        const float w = problem.min_inverse_depth + slice * (n + 0.5f + 0.5f * random.symmetric());
        const float nx = random.symmetric(), ny = random.symmetric();
        const float scale = 0.5f * w / std::sqrt(std::max(1 - nx * nx - ny * ny, 0.02f));
        challenge({w, nx * scale / problem.fx, ny * scale / problem.fy});
    }
}

// In each direction, the neighbour of the other colour with the lowest cost among several distances.
void spread(const Problem& problem, int x, int y, Contest& contest) {
    static constexpr int kDistances[4] = {1, 3, 7, 15};
    for (const auto& direction : kNear) {
        int nearest = 0;
        float lowest = INFINITY;
        for (int distance : kDistances) {
            const int nx = x + direction[0] * distance, ny = y + direction[1] * distance;
            if (nx < 0 || ny < 0 || nx >= problem.width || ny >= problem.height) break;
            const float cost = problem.costs[size_t(ny) * problem.width + nx];
            nearest = cost < lowest ? distance : nearest;
            lowest = std::min(cost, lowest);
        }
        if (nearest == 0) continue;
        const int dx = direction[0] * nearest, dy = direction[1] * nearest;
        Plane plane = problem.planes[size_t(y + dy) * problem.width + x + dx];
        plane.inverse_depth = plane.at(float(-dx), float(-dy));
        contest.add(plane);
    }
    contest.decide();
}

// A random change of the depth, and one of the slope with a small one of the depth.
void perturb(float size, Random random, Contest& contest) {
    if (contest.parallax() == 0) return;
    const float depth_step = size / contest.parallax(), slope_step = depth_step / kRadius;
    Plane deeper = contest.best(), steeper = contest.best();
    deeper.inverse_depth += depth_step * random.symmetric();
    steeper.inverse_depth += 0.25f * depth_step * random.symmetric();
    steeper.du += slope_step * random.symmetric();
    steeper.dv += slope_step * random.symmetric();
    contest.add(deeper);
    contest.add(steeper);
    contest.decide();
}

void visit(Task& task, int x, int y, int iteration) {
    const Pixel pixel(task, x, y);
    Contest contest(task, pixel);
    spread(task.problem, x, y, contest);
    perturb(std::ldexp(task.problem.perturbation, -iteration), Random(task.problem, pixel.index(), iteration), contest);
    contest.store();
}

void run(const Problem& problem) {
    Task task(problem);
    constexpr int kRowsPerTask = 4;
    core::run_ranges(problem.height, kRowsPerTask, [&](int begin, int end, int) {
        for (int y = begin; y < end; ++y)
            for (int x = 0; x < problem.width; ++x) start(task, x, y);
    });
    for (int iteration = 0; iteration < problem.iterations; ++iteration)
        for (int colour = 0; colour < 2; ++colour)
            core::run_ranges(problem.height, kRowsPerTask, [&](int begin, int end, int) {
                for (int y = begin; y < end; ++y)
                    for (int x = (y + colour) & 1; x < problem.width; x += 2) visit(task, x, y, iteration);
            });
}

}  // namespace
}  // namespace patchmatch

// Improves problem->planes and fills problem->costs. Returns 0, or 1 when there are no or too many sources.
CORE_API int32_t patchmatch_run(const patchmatch::Problem* problem) {
    if (problem->num_sources < 1 || problem->num_sources > patchmatch::kMaxSources) return 1;
    patchmatch::run(*problem);
    return 0;
}

// Packs each pixel with its right, lower and lower right neighbours into one int32, so that a bilinear sample needs one
// gather. The last column and row repeat.
CORE_API void patchmatch_pack(const uint8_t* grey, int32_t width, int32_t height, int32_t* packed) {
    for (int y = 0; y < height; ++y) {
        const uint8_t* top = grey + size_t(y) * width;
        const uint8_t* bottom = grey + size_t(std::min(y + 1, height - 1)) * width;
        for (int x = 0; x < width; ++x) {
            const int next = std::min(x + 1, width - 1);
            const uint32_t four = uint32_t(top[x]) | uint32_t(top[next]) << 8 | uint32_t(bottom[x]) << 16 |
                                  uint32_t(bottom[next]) << 24;
            packed[size_t(y) * width + x] = int32_t(four);
        }
    }
}
