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
    Random(uint32_t seed, uint32_t pixel, uint32_t iteration) : state_(mix(mix(mix(seed) ^ pixel) ^ iteration)) {}
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

// Grey values as floats with kRadius repeated pixels on every side, so that windows need no bounds.
struct Padded {
    int stride;
    std::vector<int32_t> bits;

    Padded(const uint8_t* grey, int width, int height) : stride(width + 2 * kRadius) {
        bits.resize(size_t(stride) * (height + 2 * kRadius));
        for (int y = -kRadius; y < height + kRadius; ++y)
            for (int x = -kRadius; x < width + kRadius; ++x) {
                const int row = std::clamp(y, 0, height - 1), column = std::clamp(x, 0, width - 1);
                const float value = grey[size_t(row) * width + column];
                std::memcpy(&bits[size_t(y + kRadius) * stride + x + kRadius], &value, sizeof value);
            }
    }
    const int32_t* at(int x, int y) const { return &bits[size_t(y + kRadius) * stride + x + kRadius]; }
};

// Everything about one pixel that its hypotheses share.
class Pixel {
public:
    Pixel(const Problem& problem, const Pattern& pattern, const Padded& padded, int x, int y)
        : problem_(problem), pattern_(pattern), x_(x), y_(y), u_(x + 0.5f), v_(y + 0.5f),
          window_(pattern, padded.at(x, y), problem.sigma_grey) {
        for (int s = 0; s < problem.num_sources; ++s)
            rays_[s] = ray_through(problem.sources[s].from_reference, u_, v_);
        float ray_x = (u_ - problem.cx) / problem.fx, ray_y = (v_ - problem.cy) / problem.fy;
        ray_length_squared_ = 1 + ray_x * ray_x + ray_y * ray_y;
        const float centre = grey(0, 0);
        for (int n = 0; n < 4; ++n) {
            const int nx = x + kNear[n][0], ny = y + kNear[n][1];
            const bool inside = nx >= 0 && ny >= 0 && nx < problem.width && ny < problem.height;
            const float difference = inside ? (grey(kNear[n][0], kNear[n][1]) - centre) / problem.sigma_grey : 0;
            near_weight_[n] = inside ? 1 / (1 + difference * difference) : 0;
        }
    }

    // In the depth range and less than about 84 degrees off the line of sight.
    bool plausible(const Plane& plane) const {
        if (!(plane.inverse_depth >= problem_.min_inverse_depth && plane.inverse_depth <= problem_.max_inverse_depth))
            return false;
        const float nx = problem_.fx * plane.du, ny = problem_.fy * plane.dv;
        const float nz = plane.at(problem_.cx - u_, problem_.cy - v_);
        const float length_squared = (nx * nx + ny * ny + nz * nz) * ray_length_squared_;
        return plane.inverse_depth * plane.inverse_depth >= 0.01f * length_squared;
    }

    // Pixels of parallax per unit of inverse depth, root mean square over the sources that see the plane.
    float parallax(const Plane& plane) const {
        float total = 0;
        int seen = 0;
        for (int s = 0; s < problem_.num_sources; ++s) {
            const Transfer& transfer = problem_.sources[s].from_reference;
            const Ray point = at_inverse_depth(rays_[s], transfer, plane.inverse_depth);
            float u, v;
            if (!lands_inside(point, problem_.sources[s].width, problem_.sources[s].height, u, v)) continue;
            const float du = (transfer.t[0] - u * transfer.t[2]) / point.z;
            const float dv = (transfer.t[1] - v * transfer.t[2]) / point.z;
            total += du * du + dv * dv;
            ++seen;
        }
        return seen ? std::sqrt(total / seen) : 0;
    }

    // Matching and geometric cost: the sources from best to worst with geometrically falling weights, so that an
    // occluded source hardly counts and two agreeing ones beat a single one.
    float data_cost(const Plane& plane) const {
        float costs[kMaxSources];
        for (int s = 0; s < problem_.num_sources; ++s) costs[s] = source_cost(s, plane);
        std::sort(costs, costs + problem_.num_sources);
        float total = 0, weights = 0, weight = 1;
        for (int s = 0; s < problem_.num_sources; ++s, weight *= problem_.best_weight_ratio) {
            total += weight * costs[s];
            weights += weight;
        }
        return total / weights;
    }

    // How far the plane passes from the four neighbours' points, where the image gives no reason for an edge.
    float smoothness_cost(const Plane& plane, float parallax) const {
        const Plane* planes = problem_.planes + size_t(y_) * problem_.width + x_;
        float total = 0;
        for (int n = 0; n < 4; ++n) {
            if (near_weight_[n] == 0) continue;
            const int dx = kNear[n][0], dy = kNear[n][1];
            const Plane& neighbour = planes[dy * problem_.width + dx];
            const float deviation = std::fabs(plane.at(float(dx), float(dy)) - neighbour.inverse_depth) * parallax;
            total += near_weight_[n] * std::min(deviation, problem_.smoothness_limit);
        }
        return problem_.smoothness * total;
    }

private:
    static constexpr int kNear[4][2] = {{-1, 0}, {1, 0}, {0, -1}, {0, 1}};

    float grey(int dx, int dy) const {
        const int x = std::clamp(x_ + dx, 0, problem_.width - 1), y = std::clamp(y_ + dy, 0, problem_.height - 1);
        return problem_.grey[size_t(y) * problem_.width + x];
    }

    float source_cost(int index, const Plane& plane) const {
        const Source& source = problem_.sources[index];
        const Ray centre = at_inverse_depth(rays_[index], source.from_reference, plane.inverse_depth);
        float u, v;
        if (!lands_inside(centre, source.width, source.height, u, v)) return 1 + problem_.geometric * problem_.geometric_limit;
        const float cost = matching_cost(window_, pattern_, source, plane, centre, problem_.noise_variance);
        return cost + problem_.geometric * reprojection_error(source, u, v);
    }

    // From the source's own depth at (u, v) back to here: distance from this pixel, limited.
    float reprojection_error(const Source& source, float u, float v) const {
        if (source.inverse_depth == nullptr || problem_.geometric == 0) return 0;
        const float w = source.inverse_depth[size_t(v) * source.width + size_t(u)];
        if (w == 0) return problem_.geometric_limit;
        const Ray back = at_inverse_depth(ray_through(source.to_reference, u, v), source.to_reference, w);
        if (!(back.z > 1e-6f)) return problem_.geometric_limit;
        return std::min(std::hypot(back.x / back.z - u_, back.y / back.z - v_), problem_.geometric_limit);
    }

    const Problem& problem_;
    const Pattern& pattern_;
    const int x_, y_;
    const float u_, v_;
    const Window window_;
    Ray rays_[kMaxSources];
    float near_weight_[4];
    float ray_length_squared_;
};

// The best plane of a pixel so far. A challenger pays for its roughness first: often that is enough to refuse it.
class Contest {
public:
    Contest(const Pixel& pixel, const Plane& plane, float data_cost, float parallax)
        : pixel_(pixel), parallax_(parallax), best_(plane), data_cost_(data_cost),
          total_(data_cost + pixel.smoothness_cost(plane, parallax)) {}

    void challenge(const Plane& plane) {
        if (!pixel_.plausible(plane)) return;
        const float smoothness = pixel_.smoothness_cost(plane, parallax_);
        if (smoothness >= total_) return;
        const float data_cost = pixel_.data_cost(plane);
        if (data_cost + smoothness >= total_) return;
        best_ = plane;
        data_cost_ = data_cost;
        total_ = data_cost + smoothness;
    }

    const Plane& best() const { return best_; }
    float data_cost() const { return data_cost_; }

private:
    const Pixel& pixel_;
    const float parallax_;
    Plane best_;
    float data_cost_, total_;
};

// The given plane against random ones, one in each of equal slices of inverse depth.
void start(const Problem& problem, const Pattern& pattern, const Padded& padded, int x, int y) {
    const size_t index = size_t(y) * problem.width + x;
    const Pixel pixel(problem, pattern, padded, x, y);
    Plane best = problem.planes[index];
    float best_cost = pixel.plausible(best) ? pixel.data_cost(best) : 1e9f;
    Random random(problem.seed, uint32_t(index), problem.stream * 256 + 255);
    const float slice = (problem.max_inverse_depth - problem.min_inverse_depth) / std::max(problem.random_starts, 1);
    for (int n = 0; n < problem.random_starts; ++n) {
        const float w = problem.min_inverse_depth + slice * (n + 0.5f + 0.5f * random.symmetric());
        const Plane plane = {w, 0.5f * w / problem.fx * random.symmetric(), 0.5f * w / problem.fy * random.symmetric()};
        if (!pixel.plausible(plane)) continue;
        const float cost = pixel.data_cost(plane);
        if (cost < best_cost) {
            best = plane;
            best_cost = cost;
        }
    }
    problem.planes[index] = best;
    problem.costs[index] = best_cost;
}

// In each direction, the neighbour of the other colour with the lowest cost among several distances.
void spread(const Problem& problem, int x, int y, Contest& contest) {
    static constexpr int kDirections[4][2] = {{-1, 0}, {1, 0}, {0, -1}, {0, 1}};
    static constexpr int kDistances[4] = {1, 3, 7, 15};
    for (const auto& direction : kDirections) {
        int nearest = 0;
        float lowest = 1e9f;
        for (int distance : kDistances) {
            const int nx = x + direction[0] * distance, ny = y + direction[1] * distance;
            if (nx < 0 || ny < 0 || nx >= problem.width || ny >= problem.height) break;
            const float cost = problem.costs[size_t(ny) * problem.width + nx];
            if (cost < lowest) {
                lowest = cost;
                nearest = distance;
            }
        }
        if (nearest == 0) continue;
        const int dx = direction[0] * nearest, dy = direction[1] * nearest;
        Plane plane = problem.planes[size_t(y + dy) * problem.width + x + dx];
        plane.inverse_depth = plane.at(float(-dx), float(-dy));
        contest.challenge(plane);
    }
}

// Random changes of the depth, of the slope, and of both a quarter as large.
void perturb(float size, float parallax, Random& random, Contest& contest) {
    const float depth_step = size / parallax, slope_step = depth_step / kRadius;
    Plane plane = contest.best();
    plane.inverse_depth += depth_step * random.symmetric();
    contest.challenge(plane);
    plane = contest.best();
    plane.du += slope_step * random.symmetric();
    plane.dv += slope_step * random.symmetric();
    contest.challenge(plane);
    plane = contest.best();
    plane.inverse_depth += 0.25f * depth_step * random.symmetric();
    plane.du += 0.25f * slope_step * random.symmetric();
    plane.dv += 0.25f * slope_step * random.symmetric();
    contest.challenge(plane);
}

void visit(const Problem& problem, const Pattern& pattern, const Padded& padded, int x, int y, int iteration) {
    const size_t index = size_t(y) * problem.width + x;
    const Pixel pixel(problem, pattern, padded, x, y);
    const Plane current = problem.planes[index];
    const float parallax = pixel.parallax(current);
    Contest contest(pixel, current, problem.costs[index], parallax);
    spread(problem, x, y, contest);
    if (parallax > 0) {
        Random random(problem.seed, uint32_t(index), problem.stream * 256 + uint32_t(iteration));
        perturb(problem.perturbation * std::ldexp(1.0f, -iteration), parallax, random, contest);
    }
    problem.planes[index] = contest.best();
    problem.costs[index] = contest.data_cost();
}

void run(const Problem& problem) {
    const Padded padded(problem.grey, problem.width, problem.height);
    const Pattern pattern(padded.stride, problem.sigma_space);
    constexpr int kRowsPerTask = 4;
    core::run_ranges(problem.height, kRowsPerTask, [&](int begin, int end, int) {
        for (int y = begin; y < end; ++y)
            for (int x = 0; x < problem.width; ++x) start(problem, pattern, padded, x, y);
    });
    for (int iteration = 0; iteration < problem.iterations; ++iteration)
        for (int colour = 0; colour < 2; ++colour)
            core::run_ranges(problem.height, kRowsPerTask, [&](int begin, int end, int) {
                for (int y = begin; y < end; ++y)
                    for (int x = (y + colour) & 1; x < problem.width; x += 2)
                        visit(problem, pattern, padded, x, y, iteration);
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
