// SIFT (Lowe, "Distinctive Image Features from Scale-Invariant Keypoints", IJCV 2004): the parts and what passes
// between them. Coordinates are (x, y) with pixel centres at whole numbers.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "simd.h"

namespace core::sift {

constexpr int kIntervals = 3;             // scales an octave in which keypoints are found
constexpr int kLayers = kIntervals + 3;   // blurred images an octave
constexpr float kSigma = 1.6f;            // blur of an octave's first layer, in its pixels
constexpr int kBorder = 5;                // pixels at an octave's border in which there are no keypoints
constexpr int kTileRows = 32, kTileColumns = 256;  // of a task: what it reads stays in the first cache

// One octave of the scale space: the image at kLayers blurs, kIntervals of which double it.
struct Octave {
    int width, height;
    size_t stride;  // floats from a row to the next; a register may be read behind the end of a row
    float* layers[kLayers];

    const float* row(int layer, int y) const { return layers[layer] + y * stride; }
    // Difference of Gaussians: of a layer's next one and its own.
    float difference(int layer, int y, int x) const { return row(layer + 1, y)[x] - row(layer, y)[x]; }
};

// The Gaussian scale space of an image, which is enlarged to twice its size first. Octaves are built in their order. The
// smaller ones lie where the first one's layers 0, 4 and 5 lay: from then on these are lost.
class ScaleSpace {
public:
    ScaleSpace(const uint8_t* grey, int width, int height);
    ScaleSpace(const ScaleSpace&) = delete;
    ScaleSpace& operator=(const ScaleSpace&) = delete;
    ~ScaleSpace();

    size_t num_octaves() const { return octaves_.size(); }
    const Octave& build(size_t number);
    const Octave& octave(size_t number) const { return octaves_[number]; }

private:
    const uint8_t* grey_;
    std::vector<Octave> octaves_;
    float* memory_ = nullptr;
};

struct Keypoint {
    int octave, layer;
    float x, y;      // in pixels of the octave
    float scale;     // standard deviation of its blur, in pixels of the octave
    float response;  // absolute value of the difference of Gaussians, images being in [0, 1]
    float turn;      // its orientation, as a share of a full turn, from +x towards +y
};

// The orientations of a keypoint: one for each peak of the histogram of gradients around it.
void add_oriented(const Octave& octave, Keypoint keypoint, std::vector<Keypoint>& found);

// The keypoints of an octave, with their orientations. Whatever the number of threads, their order is the same.
std::vector<Keypoint> find_keypoints(const Octave& octave, int number, float contrast);

// 128 bytes of the keypoint: RootSIFT (Arandjelovic and Zisserman, CVPR 2012), `unit` long.
void describe(const Octave& octave, const Keypoint& keypoint, float unit, uint8_t* descriptor);

// The gradients at kLanes pixels from (x, y) on: their lengths, twice as long, and directions as shares of a turn from
// +x towards -y, in [0, 1]. The polynomial for the arc tangent is exact to 2e-6.
inline void gradients(const Octave& octave, int layer, int y, int x, Vec& length, Vec& turn) {
    const float* here = octave.row(layer, y) + x;
    const Vec dx = load_unaligned(here + 1) - load_unaligned(here - 1);
    const Vec dy = load_unaligned(here - octave.stride) - load_unaligned(here + octave.stride);
    const Vec ax = absolute(dx), ay = absolute(dy), zero = splat(0.0f);
    length = square_root(dx * dx + dy * dy);
    const Vec t = minimum(ax, ay) / maximum(maximum(ax, ay), splat(1e-20f)), s = t * t;
    const Vec odd = ((((s * -0.01172120f + 0.05265332f) * s - 0.11643287f) * s + 0.19354346f) * s - 0.33262347f) * s;
    Vec eighth = t * (odd + 0.99997726f) * 0.15915494f;
    eighth = select(less(ax, ay), 0.25f - eighth, eighth);
    eighth = select(less(dx, zero), 0.5f - eighth, eighth);
    turn = select(less(dy, zero), 1.0f - eighth, eighth);
}

}  // namespace core::sift
