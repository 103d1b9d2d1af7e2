// Orientations and descriptors of keypoints: histograms of the gradients around them.
#include <algorithm>
#include <cmath>
#include <cstring>

#include "sift.h"

namespace core::sift {
namespace {

constexpr int kDirections = 36;          // bins of the histogram that orientations are taken from
constexpr float kOrientationSigma = 1.5f;  // of its window, over the keypoint's scale
constexpr float kPeakRatio = 0.8f;       // of a further orientation's peak over the highest
constexpr int kCells = 4;                // of a descriptor along each side
constexpr int kBins = 8;                 // directions of a cell
constexpr float kCellSize = 3.0f;        // over the keypoint's scale
constexpr float kMostOfOne = 0.2f;       // of a descriptor's length that one bin may have
constexpr int kMaxRadius = 96;           // of a window: 10.6 times the largest scale of an octave, and rounding

// The bins of one direction histogram in as many registers as they need.
constexpr int kWide = kLanes < kBins ? kLanes : kBins, kRegisters = kBins / kWide;
typedef float Bins __attribute__((vector_size(4 * (CORE_LANES < 8 ? CORE_LANES : 8))));
typedef uint32_t BinBits __attribute__((vector_size(4 * (CORE_LANES < 8 ? CORE_LANES : 8))));

// Weights of a Gaussian window at whole distances, and on to the end of the last register.
struct Window {
    alignas(64) float weights[2 * kMaxRadius + 2 * kLanes];
    int radius;

    Window(int radius, float sigma) : radius(radius) {
        const Vec factor = splat(-0.5f * 1.44269504f / (sigma * sigma));  // exp2 instead of exp
        Vec distance;
        for (int lane = 0; lane < kLanes; ++lane) distance[lane] = float(lane - radius);
        for (int i = 0; i <= 2 * radius + kLanes; i += kLanes, distance += float(kLanes)) {
            const Vec exponent[1] = {maximum(distance * distance * factor, splat(-120.0f))};
            Vec weight[1];
            exp2_nonpositive(exponent, weight);
            store(weights + i, weight[0]);
        }
    }

    const float* at(int distance) const { return weights + radius + distance; }
};

constexpr int kRowsAhead = 3, kLine = 16;  // rows that are fetched before their turn; floats of a line of the cache

// Floats that a row of a window fills, to the end of its last register.
constexpr int kRowSize = 2 * kMaxRadius + 2 * kLanes;

struct Histogram {
    float bins[kDirections];

    // Of the gradients around a keypoint, smoothed.
    Histogram(const Octave& octave, const Keypoint& keypoint) {
        const int column = int(std::lrint(keypoint.x)), line = int(std::lrint(keypoint.y));
        const float sigma = kOrientationSigma * keypoint.scale;
        const int radius = std::min(int(std::lrint(3 * sigma)), kMaxRadius);
        const Window weights(radius, sigma);
        float sums[2][kDirections + 1] = {};  // in turns, so that a sum need not wait for the one before
        alignas(64) float shares[kRowSize];
        alignas(64) int32_t places[kRowSize];
        const int first = std::max(1, column - radius), last = std::min(octave.width - 2, column + radius);
        for (int y = std::max(1, line - radius); y <= std::min(octave.height - 2, line + radius); ++y) {
            const float across = weights.at(y - line)[0];
            for (int x = first; x <= last; x += kLanes) {
                Vec length, turn;
                gradients(octave, keypoint.layer, y, x, length, turn);
                store(shares + (x - first), length * across * load_unaligned(weights.at(x - column)));
                const IntVec place = nearest_int(turn * kDirections);
                std::memcpy(places + (x - first), &place, sizeof place);
            }
            for (int i = 0; i <= last - first; ++i) sums[i & 1][places[i]] += shares[i];
        }
        for (int i = 0; i <= kDirections; ++i) sums[0][i] += sums[1][i];
        sums[0][0] += sums[0][kDirections];
        const auto sum = [&](int bin) { return sums[0][(bin + kDirections) % kDirections]; };
        for (int i = 0; i < kDirections; ++i)
            bins[i] = (sum(i - 2) + sum(i + 2)) / 16 + (sum(i - 1) + sum(i + 1)) / 4 + sum(i) * 3 / 8;
    }
};

// For each direction the bins with a share of 1, and what a bin more adds: the next bin gains what this one loses.
struct Directions {
    Bins here[kBins + 1][kRegisters] = {}, further[kBins + 1][kRegisters] = {};

    Directions() {
        for (int bin = 0; bin <= kBins; ++bin) {  // the last is the first again, reached by rounding
            const int at = bin % kBins, next = (bin + 1) % kBins;
            here[bin][at / kWide][at % kWide] = 1;
            further[bin][at / kWide][at % kWide] = -1;
            further[bin][next / kWide][next % kWide] = 1;
        }
    }
};
const Directions kTable;

// A descriptor's cells with one more on every side, which is not kept.
struct Cells {
    static constexpr int kSide = kCells + 2;
    Bins bins[kSide * kSide][kRegisters];

    void add(int cell, float weight, const Bins (&share)[kRegisters]) {
        for (int part = 0; part < kRegisters; ++part) bins[cell][part] += weight * share[part];
    }
};

// A row of the samples of a descriptor, turned by its orientation: their cells, directions and weights.
struct Samples {
    alignas(64) int32_t cell[kRowSize], bin[kRowSize];  // of four cells the one with the lowest number
    alignas(64) float direction[kRowSize];              // beyond the bin, of 1
    alignas(64) float weights[4][kRowSize];             // for (x, y), (x + 1, y), (x, y + 1), (x + 1, y + 1)

    void add_to(Cells (&cells)[2], int count) const {
        for (int i = 0; i < count; ++i) {
            Bins share[kRegisters];
            for (int part = 0; part < kRegisters; ++part)
                share[part] = direction[i] * kTable.further[bin[i]][part] + kTable.here[bin[i]][part];
            Cells& sums = cells[i & 1];  // in turns, so that a sum need not wait for the one before
            sums.add(cell[i], weights[0][i], share);
            sums.add(cell[i] + 1, weights[1][i], share);
            sums.add(cell[i] + Cells::kSide, weights[2][i], share);
            sums.add(cell[i] + Cells::kSide + 1, weights[3][i], share);
        }
    }
};

// The bytes of a histogram of 128 bins: those of SIFT (whole numbers, 512 long), then their root, `unit` long.
void write(const float* histogram, float unit, uint8_t* descriptor) {
    constexpr int kSize = kCells * kCells * kBins;
    float squared = 0;
    for (int i = 0; i < kSize; ++i) squared += histogram[i] * histogram[i];
    const float most = kMostOfOne * std::sqrt(squared);
    squared = 0;
    for (int i = 0; i < kSize; ++i) {
        const float value = std::min(histogram[i], most);
        squared += value * value;
    }
    const float scale = 512.0f / std::max(std::sqrt(squared), 1e-7f);
    float values[kSize], sum = 0;
    for (int i = 0; i < kSize; ++i) {
        values[i] = float(std::lrint(std::min(std::min(histogram[i], most) * scale, 255.0f)));
        sum += values[i];
    }
    for (int i = 0; i < kSize; ++i)
        descriptor[i] = uint8_t(std::min(std::lrint(std::sqrt(values[i] / std::max(sum, 1e-9f)) * unit), 127L));
}

// The next rows of a window lie in other pages, where no processor looks for them by itself.
inline void prefetch(const float* middle, int radius) {
    for (int x = -radius; x <= radius + kLine; x += kLine) __builtin_prefetch(middle + x);
}

inline float clamped(float column) { return std::min(std::max(column, -1e6f), 1e6f); }

// The columns j around 0 for which j / inverse + b is within +-half; (first > last): none.
void narrow(float inverse, float b, float half, int& first, int& last) {
    const float one = clamped((-half - b) * inverse), other = clamped((half - b) * inverse);
    first = std::max(first, int(std::min(one, other)) - 1);
    last = std::min(last, int(std::max(one, other)) + 1);
}

}  // namespace

void add_oriented(const Octave& octave, Keypoint keypoint, std::vector<Keypoint>& found) {
    const Histogram histogram(octave, keypoint);
    const float* bins = histogram.bins;
    const float least = kPeakRatio * *std::max_element(bins, bins + kDirections);
    for (int i = 0; i < kDirections; ++i) {
        const float left = bins[(i + kDirections - 1) % kDirections], right = bins[(i + 1) % kDirections];
        if (bins[i] <= left || bins[i] <= right || bins[i] < least) continue;
        const float peak = i + 0.5f * (left - right) / (left - 2 * bins[i] + right);
        keypoint.turn = 1.0f - peak / kDirections;
        keypoint.turn -= std::floor(keypoint.turn);
        found.push_back(keypoint);
    }
}

void describe(const Octave& octave, const Keypoint& keypoint, float unit, uint8_t* descriptor) {
    constexpr float kHalf = (kCells + 1) * 0.5f;  // the outer cells' middles are this far from the keypoint, in cells
    const int column = int(std::lrint(keypoint.x)), line = int(std::lrint(keypoint.y));
    const float angle = -6.28318531f * keypoint.turn, size = kCellSize * keypoint.scale;
    const float cosine = std::cos(angle) / size, sine = std::sin(angle) / size;
    const float to_cosine = 1 / (std::abs(cosine) > 1e-9f ? cosine : 1e-9f);
    const float to_sine = 1 / (std::abs(sine) > 1e-9f ? sine : 1e-9f);
    const int radius = std::min(int(std::lrint(size * 1.41421356f * kHalf)), kMaxRadius);
    const Window weights(radius, size * kCells * 0.5f);
    const Vec half = splat(kHalf), no_turn = splat(keypoint.turn * kBins - kBins);
    Vec lanes;
    for (int lane = 0; lane < kLanes; ++lane) lanes[lane] = float(lane);
    Cells cells[2];
    std::memset(static_cast<void*>(&cells), 0, sizeof cells);
    Samples samples;
    for (int i = std::max(-radius, 1 - line); i <= std::min(radius, octave.height - 2 - line); ++i) {
        prefetch(octave.row(keypoint.layer, line + i) + kRowsAhead * octave.stride + column, radius);
        int first = std::max(-radius, 1 - column), last = std::min(radius, octave.width - 2 - column);
        narrow(to_cosine, -i * sine, kHalf, first, last);
        narrow(to_sine, i * cosine, kHalf, first, last);
        for (int j = first; j <= last; j += kLanes) {
            const int at = j - first;
            Vec length, turn;
            gradients(octave, keypoint.layer, line + i, column + j, length, turn);
            const Vec place = lanes + float(j), x = place * cosine - i * sine, y = place * sine + i * cosine;
            length *= weights.at(i)[0] * load_unaligned(weights.at(j));
            length = keep(less(absolute(x), half), keep(less(absolute(y), half), length));
            // From the middle of the first cell on, which is one that is not kept.
            const Vec cell_x = clamp(x + half, splat(0), splat(kCells + 0.999f));
            const Vec cell_y = clamp(y + half, splat(0), splat(kCells + 0.999f));
            const IntVec whole_x = __builtin_convertvector(cell_x, IntVec), whole_y = __builtin_convertvector(cell_y, IntVec);
            const Vec share_x = cell_x - __builtin_convertvector(whole_x, Vec);
            const Vec share_y = cell_y - __builtin_convertvector(whole_y, Vec);
            const Vec below = length * share_y, above = length - below;
            store(samples.weights[1] + at, above * share_x);
            store(samples.weights[0] + at, above - above * share_x);
            store(samples.weights[3] + at, below * share_x);
            store(samples.weights[2] + at, below - below * share_x);
            Vec direction = turn * kBins + no_turn;  // in [-kBins, kBins]
            direction += keep(less(direction, splat(0)), splat(kBins));
            const IntVec bin = __builtin_convertvector(direction, IntVec), cell = whole_y * Cells::kSide + whole_x;
            store(samples.direction + at, direction - __builtin_convertvector(bin, Vec));
            std::memcpy(samples.bin + at, &bin, sizeof bin);
            std::memcpy(samples.cell + at, &cell, sizeof cell);
        }
        samples.add_to(cells, last - first + 1);
    }
    float histogram[kCells * kCells * kBins];
    for (int y = 0; y < kCells; ++y)
        for (int x = 0; x < kCells; ++x) {
            const int cell = (y + 1) * Cells::kSide + x + 1;
            float* to = histogram + (y * kCells + x) * kBins;
            for (int bin = 0; bin < kBins; ++bin)
                to[bin] = cells[0].bins[cell][bin / kWide][bin % kWide] + cells[1].bins[cell][bin / kWide][bin % kWide];
        }
    write(histogram, unit, descriptor);
}

}  // namespace core::sift
