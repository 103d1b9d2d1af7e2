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

#include "patchmatch_pixel.h"
#include "threads.h"

namespace patchmatch {
namespace {

// Pixels of parallax, over the whole window, below which two planes match alike: the challenger is not compared.
constexpr float kSamePlanePx = 0.1f;

// Least squared z of a random unit normal: 82 degrees off the optical axis. It bounds the slope of random planes.
constexpr float kMinSquaredNormalZ = 0.02f;

// Tangent of a random plane's slope over that of its random normal: most surfaces are seen from the front.
constexpr float kRandomSlope = 0.5f;

// Change of the depth, where the slope is perturbed, over that where only the depth is.
constexpr float kDepthWithSlope = 0.25f;

// The best plane of a pixel so far, against challengers in the sources that explain it best.
class Contest {
public:
    Contest(Task& task, const Pixel& pixel)
        : task_(task), problem_(task.problem), pixel_(pixel), best_(problem_.planes[pixel.index()]),
          parallax_(pixel.parallax(best_)), data_cost_(problem_.costs[pixel.index()]),
          total_(data_cost_ + pixel.smoothness_cost(best_, parallax_)),
          source_costs_(&task.source_costs[pixel.index() * problem_.num_sources]) {
        int order[kMaxSources];
        for (int s = 0; s < problem_.num_sources; ++s) order[s] = s;  // costs that are no numbers have no order
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
        return (depth + kRadius * slope) * parallax_ < kSamePlanePx;
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
        const float scale = kRandomSlope * w / std::sqrt(std::max(1 - nx * nx - ny * ny, kMinSquaredNormalZ));
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
    steeper.inverse_depth += kDepthWithSlope * depth_step * random.symmetric();
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
