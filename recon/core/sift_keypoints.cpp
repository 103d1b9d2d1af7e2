// Keypoints: extrema of the difference of Gaussians over place and scale, fitted by a parabola.
#include <algorithm>
#include <cmath>

#include "sift.h"
#include "threads.h"

namespace core::sift {
namespace {

constexpr int kSteps = 5;            // to the pixel and layer nearest to the fitted extremum
constexpr float kEdgeRatio = 10.0f;  // largest ratio of the principal curvatures
constexpr int kDifferences = kLayers - 1;

// Solves the symmetric system a x = b of three unknowns by Cramer's rule; false where it has no single solution.
bool solve(const float (&a)[3][3], const float (&b)[3], float (&x)[3]) {
    const float c0 = a[1][1] * a[2][2] - a[1][2] * a[2][1], c1 = a[1][2] * a[2][0] - a[1][0] * a[2][2];
    const float c2 = a[1][0] * a[2][1] - a[1][1] * a[2][0];
    const float determinant = a[0][0] * c0 + a[0][1] * c1 + a[0][2] * c2;
    if (determinant == 0) return false;
    x[0] = (b[0] * c0 + a[0][1] * (a[1][2] * b[2] - b[1] * a[2][2]) + a[0][2] * (b[1] * a[2][1] - a[1][1] * b[2])) /
           determinant;
    x[1] = (a[0][0] * (b[1] * a[2][2] - a[1][2] * b[2]) + b[0] * c1 + a[0][2] * (a[1][0] * b[2] - b[1] * a[2][0])) /
           determinant;
    x[2] = (a[0][0] * (a[1][1] * b[2] - b[1] * a[2][1]) + a[0][1] * (b[1] * a[2][0] - a[1][0] * b[2]) + b[0] * c2) /
           determinant;
    return true;
}

// The extremum near a pixel that is larger (or smaller) than its neighbours, if it is strong and no edge.
bool fit(const Octave& octave, int layer, int y, int x, float contrast, Keypoint& keypoint) {
    for (int step = 0; step < kSteps; ++step) {
        float d[3][3][3];  // [layer][y][x]
        for (int l = 0; l < 3; ++l)
            for (int i = 0; i < 3; ++i)
                for (int j = 0; j < 3; ++j) d[l][i][j] = octave.difference(layer + l - 1, y + i - 1, x + j - 1) / 255;
        const float here = d[1][1][1];
        const float slope[3] = {(d[1][1][2] - d[1][1][0]) / 2, (d[1][2][1] - d[1][0][1]) / 2,
                                (d[2][1][1] - d[0][1][1]) / 2};
        const float xx = d[1][1][2] + d[1][1][0] - 2 * here, yy = d[1][2][1] + d[1][0][1] - 2 * here;
        const float ss = d[2][1][1] + d[0][1][1] - 2 * here;
        const float xy = (d[1][2][2] - d[1][2][0] - d[1][0][2] + d[1][0][0]) / 4;
        const float xs = (d[2][1][2] - d[2][1][0] - d[0][1][2] + d[0][1][0]) / 4;
        const float ys = (d[2][2][1] - d[2][0][1] - d[0][2][1] + d[0][0][1]) / 4;
        float to[3];  // (x, y, layer), negative
        if (!solve({{xx, xy, xs}, {xy, yy, ys}, {xs, ys, ss}}, slope, to)) return false;
        if (std::abs(to[0]) < 0.5f && std::abs(to[1]) < 0.5f && std::abs(to[2]) < 0.5f) {
            const float response = std::abs(here - 0.5f * (slope[0] * to[0] + slope[1] * to[1] + slope[2] * to[2]));
            const float trace = xx + yy, determinant = xx * yy - xy * xy;
            if (response * kIntervals < contrast || determinant <= 0 ||
                trace * trace * kEdgeRatio >= (kEdgeRatio + 1) * (kEdgeRatio + 1) * determinant)
                return false;
            keypoint.layer = layer;
            keypoint.x = x - to[0], keypoint.y = y - to[1];
            keypoint.scale = kSigma * std::exp2((layer - to[2]) / kIntervals);
            keypoint.response = response;
            return true;
        }
        if (!(std::abs(to[0]) < 1e6f && std::abs(to[1]) < 1e6f && std::abs(to[2]) < 1e6f)) return false;
        x -= int(std::lrint(to[0])), y -= int(std::lrint(to[1])), layer -= int(std::lrint(to[2]));
        if (layer < 1 || layer > kIntervals || x < kBorder || x >= octave.width - kBorder || y < kBorder ||
            y >= octave.height - kBorder)
            return false;
    }
    return false;
}

// The largest and smallest differences of three neighbours in a row, for three rows of a tile at a time.
struct Rows {
    static constexpr int kWidth = kTileColumns + 2 * kLanes;
    alignas(64) float difference[3][kDifferences][kWidth + kLanes];  // from kLanes columns left of the tile on
    alignas(64) float largest[3][kDifferences][kTileColumns], smallest[3][kDifferences][kTileColumns];

    void read(const Octave& octave, int y, int left, int count) {
        for (int layer = 0; layer < kDifferences; ++layer) {
            float* to = difference[y % 3][layer];
            const float *below = octave.row(layer, y) + left, *above = octave.row(layer + 1, y) + left;
            to[kLanes - 1] = above[-1] - below[-1];
            for (int x = 0; x < count + kLanes; x += kLanes)
                store(to + kLanes + x, load_unaligned(above + x) - load_unaligned(below + x));
            for (int x = 0; x < count; x += kLanes) {
                const Vec before = load_unaligned(to + kLanes + x - 1), here = load(to + kLanes + x);
                const Vec behind = load_unaligned(to + kLanes + x + 1);
                store(largest[y % 3][layer] + x, maximum(maximum(before, here), behind));
                store(smallest[y % 3][layer] + x, minimum(minimum(before, here), behind));
            }
        }
    }

    // Which of kLanes pixels of row y are extrema of each layer.
    void extrema(int y, int x, unsigned (&found)[kDifferences]) const {
        Vec high[kDifferences], low[kDifferences];
        for (int layer = 0; layer < kDifferences; ++layer) {
            high[layer] = maximum(maximum(load(largest[0][layer] + x), load(largest[1][layer] + x)),
                                  load(largest[2][layer] + x));
            low[layer] = minimum(minimum(load(smallest[0][layer] + x), load(smallest[1][layer] + x)),
                                 load(smallest[2][layer] + x));
        }
        const Vec zero = splat(0.0f);
        for (int layer = 1; layer < kDifferences - 1; ++layer) {
            const Vec here = load(difference[y % 3][layer] + kLanes + x);
            const Vec top = maximum(maximum(high[layer - 1], high[layer]), high[layer + 1]);
            const Vec bottom = minimum(minimum(low[layer - 1], low[layer]), low[layer + 1]);
            found[layer] = (bits(at_least(here, top)) & bits(less(zero, here))) |
                           (bits(at_least(bottom, here)) & bits(less(here, zero)));
        }
    }
};

void search_tile(const Octave& octave, int number, float contrast, int top, int left, std::vector<Keypoint>& found) {
    const int bottom = std::min(octave.height - kBorder, top + kTileRows);
    const int right = std::min(octave.width - kBorder, left + kTileColumns);
    Rows rows;
    for (int y = top - 1; y <= bottom; ++y) {
        rows.read(octave, y, left, right - left);
        if (y <= top) continue;
        for (int x = 0; x < right - left; x += kLanes) {
            unsigned places[kDifferences] = {};
            rows.extrema(y - 1, x, places);
            for (int layer = 1; layer <= kIntervals; ++layer)
                for (unsigned rest = places[layer]; rest; rest &= rest - 1) {
                    const int at = left + x + __builtin_ctz(rest);
                    Keypoint keypoint{};
                    keypoint.octave = number;
                    if (at < right && fit(octave, layer, y - 1, at, contrast, keypoint))
                        add_oriented(octave, keypoint, found);
                }
        }
    }
}

}  // namespace

std::vector<Keypoint> find_keypoints(const Octave& octave, int number, float contrast) {
    const int across = (octave.width - 2 * kBorder + kTileColumns - 1) / kTileColumns;
    const int down = (octave.height - 2 * kBorder + kTileRows - 1) / kTileRows;
    std::vector<std::vector<Keypoint>> of_tile(size_t(across) * down);
    run_parallel(across * down, [&](int tile, int) {
        const int top = kBorder + tile / across * kTileRows, left = kBorder + tile % across * kTileColumns;
        search_tile(octave, number, contrast, top, left, of_tile[tile]);
    });
    std::vector<Keypoint> found;
    for (const auto& tile : of_tile) found.insert(found.end(), tile.begin(), tile.end());
    return found;
}

}  // namespace core::sift
