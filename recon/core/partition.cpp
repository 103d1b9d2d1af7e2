// Cuts an image into pieces that one colour and one depth explain: many small ones where there is detail, few large
// ones where there is none, long ones along edges.
//
// A piece is cut in two by a straight line, in the one of four directions and at the place that leave the smallest sum
// of squared deviations (Otsu's criterion, "A Threshold Selection Method from Gray-Level Histograms", 1979, for several
// channels), until what is left in a piece is below what a Gaussian costs.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "threads.h"

namespace core {
namespace {

constexpr int kChannels = 4;

struct Partition {
    const float* features;  // (height, width, kChannels)
    const float* weights;   // (height, width), by which squared deviations count
    const uint8_t* wanted;  // (height, width), 0 for pixels that belong to no piece
    int32_t width, height;
    int32_t tile;         // pixels: no piece reaches beyond a square of a grid of this spacing
    int32_t smallest;     // pixels of a piece that is not cut any more
    float most_error;     // sum of squared deviations, over pixels and channels, that a piece may keep
    float noise;          // variance of all channels together that every pixel has and no cut explains: it counts alike
};

struct Pixel {
    int32_t index;
    int16_t x, y;
};

struct Sums {
    float weight = 0;
    float total[kChannels] = {};  // of weighted values

    void add(const float* f, float w) {
        weight += w;
        for (int c = 0; c < kChannels; ++c) total[c] += w * f[c];
    }
    void add(const Sums& other) {
        weight += other.weight;
        for (int c = 0; c < kChannels; ++c) total[c] += other.total[c];
    }
    // Sum over channels of (sum of values)^2 / weight: what the mean explains of the sum of squares.
    float explained() const {
        float squares = 0;
        for (int c = 0; c < kChannels; ++c) squares += total[c] * total[c];
        return weight > 0 ? squares / weight : 0.0f;
    }
};

// x cos + y sin for 0, 90, 45 and 135 degrees, in whole pixels (the diagonals: in steps of half a diagonal).
constexpr int kDirections[4][2] = {{1, 0}, {0, 1}, {1, 1}, {1, -1}};

struct Cut {
    int direction = -1, first_behind = 0;  // pixels whose place along the direction is at least this are behind the cut
    float gain = 0;
};

// Work space of one thread.
class Cutter {
public:
    Cutter(const Partition& task) : task_(task), bins_(size_t(4) * task.tile) {}

    // Writes into `labels` the number, from 0 in each tile, of the piece that each pixel belongs to. Returns how many.
    int cut_tile(int left, int top, int32_t* labels) {
        pixels_.clear();
        const int right = std::min(left + task_.tile, task_.width), bottom = std::min(top + task_.tile, task_.height);
        for (int y = top; y < bottom; ++y)
            for (int x = left; x < right; ++x) {
                const int index = y * task_.width + x;
                if (task_.wanted[index]) pixels_.push_back({index, int16_t(x - left), int16_t(y - top)});
            }
        pieces_.assign(1, {0, int(pixels_.size())});
        int count = 0;
        while (!pieces_.empty()) {
            const Piece piece = pieces_.back();
            pieces_.pop_back();
            if (piece.begin == piece.end) continue;
            const Cut cut = best_cut(piece);
            if (cut.direction < 0) {
                for (int i = piece.begin; i < piece.end; ++i) labels[pixels_[i].index] = count;
                ++count;
                continue;
            }
            const auto before = [&](const Pixel& p) { return place(p, cut.direction) < cut.first_behind; };
            const auto middle = std::stable_partition(pixels_.begin() + piece.begin, pixels_.begin() + piece.end, before);
            const int at = int(middle - pixels_.begin());
            pieces_.push_back({at, piece.end});
            pieces_.push_back({piece.begin, at});
        }
        return count;
    }

private:
    struct Piece {
        int begin, end;  // of pixels_
    };

    const float* feature(const Pixel& pixel) const { return task_.features + size_t(kChannels) * pixel.index; }
    float weight(const Pixel& pixel) const { return task_.weights[pixel.index]; }

    // From 0 to below 2 * tile.
    int place(const Pixel& p, int direction) const {
        const auto& d = kDirections[direction];
        return d[0] * p.x + d[1] * p.y + (d[1] < 0 ? task_.tile : 0);
    }

    // No direction where the piece is to stay whole.
    Cut best_cut(const Piece& piece) {
        const int count = piece.end - piece.begin;
        Cut best;
        if (count <= task_.smallest) return best;
        Sums whole;
        float squares = 0;
        for (int i = piece.begin; i < piece.end; ++i) {
            const float* f = feature(pixels_[i]);
            const float w = weight(pixels_[i]);
            whole.add(f, w);
            for (int c = 0; c < kChannels; ++c) squares += w * f[c] * f[c];
        }
        const float error = squares - whole.explained() - task_.noise * whole.weight;
        if (error <= task_.most_error) return best;
        for (int direction = 0; direction < 4; ++direction) try_direction(piece, whole, error, direction, best);
        return best;
    }

    void try_direction(const Piece& piece, const Sums& whole, float error, int direction, Cut& best) {
        int low = 4 * task_.tile, high = 0;
        for (int i = piece.begin; i < piece.end; ++i) {
            const int at = place(pixels_[i], direction);
            low = std::min(low, at);
            high = std::max(high, at);
        }
        std::fill(bins_.begin() + low, bins_.begin() + high + 1, Sums());
        for (int i = piece.begin; i < piece.end; ++i)
            bins_[place(pixels_[i], direction)].add(feature(pixels_[i]), weight(pixels_[i]));
        Sums before;
        for (int at = low; at < high; ++at) {
            before.add(bins_[at]);
            Sums behind;
            behind.weight = whole.weight - before.weight;
            for (int c = 0; c < kChannels; ++c) behind.total[c] = whole.total[c] - before.total[c];
            // Of cuts that explain the same, the one through the middle: nothing is left to chance in plain texture.
            const float balance = 4.0f * before.weight * behind.weight / (whole.weight * whole.weight);
            const float gain = before.explained() + behind.explained() - whole.explained() + kBalance * error * balance;
            if (gain > best.gain) best = {direction, at + 1, gain};
        }
    }

    static constexpr float kBalance = 0.1f;

    const Partition& task_;
    std::vector<Pixel> pixels_;
    std::vector<Piece> pieces_;
    std::vector<Sums> bins_;
};

}  // namespace
}  // namespace core

using namespace core;

// Fills `labels` (height, width) with the number of each pixel's piece, -1 where it is not wanted. Returns how many.
CORE_API int32_t core_partition(const Partition* task, int32_t* labels) {
    const int columns = (task->width + task->tile - 1) / task->tile, rows = (task->height + task->tile - 1) / task->tile;
    std::fill_n(labels, size_t(task->width) * task->height, -1);
    std::vector<int> counts(size_t(columns) * rows);
    run_parallel(columns * rows, [&](int index, int) {
        Cutter cutter(*task);
        counts[index] = cutter.cut_tile(index % columns * task->tile, index / columns * task->tile, labels);
    });
    int total = 0;
    for (int& count : counts) {
        const int here = count;
        count = total;
        total += here;
    }
    for (int y = 0; y < task->height; ++y)
        for (int x = 0; x < task->width; ++x) {
            int32_t& label = labels[size_t(y) * task->width + x];
            if (label >= 0) label += counts[y / task->tile * columns + x / task->tile];
        }
    return total;
}
