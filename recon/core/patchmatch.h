// Slanted-plane PatchMatch multi-view stereo: shared types.
//
// A hypothesis of a pixel is a plane, written as the inverse depth at the pixel's centre and its gradient over the
// image. Inverse depth is affine in pixel coordinates on any plane, so moving a plane to a neighbour is one
// multiply-add per axis and the homography that it induces is A + t * (gradient_u, gradient_v, value): no division and
// no trigonometry per hypothesis.
#pragma once

#include <cstdint>

namespace patchmatch {

struct Plane {
    float inverse_depth;  // 1 / z at the pixel's centre
    float du, dv;         // change per pixel to the right and downwards

    float at(float right, float down) const { return inverse_depth + du * right + dv * down; }
};

// Pixel (u, v) of one camera, seen at inverse depth w, lies at A (u, v, 1) + t w of another (homogeneous pixels).
struct Transfer {
    float A[9];  // K_other R_other_this K_this^-1, row-major
    float t[3];  // K_other t_other_this
};

// A view that the reference view is compared with. The layout is repeated in recon/priors/stereo.py.
struct Source {
    const int32_t* packed;       // (height, width) 2x2 neighbourhoods of grey values, see patchmatch_pack
    const float* inverse_depth;  // (height, width), 0 where unknown; read only where Problem.geometric is not 0
    int32_t width, height;
    Transfer from_reference;
    Transfer to_reference;
};

constexpr int kMaxSources = 16;

// What one call works on and how. Lengths are pixels of the level at hand.
struct Problem {
    const uint8_t* grey;  // (height, width) of the reference view
    Plane* planes;        // (height, width), read and overwritten
    float* costs;         // (height, width) overwritten: matching cost of each plane, in [0, 1] plus geometric term
    int32_t width, height;
    float fx, fy, cx, cy;
    float min_inverse_depth, max_inverse_depth;

    const Source* sources;
    int32_t num_sources;

    int32_t active_sources;  // of each pixel, those that explain its plane best: new planes are compared in these
    int32_t random_starts;   // planes tried per pixel before the first iteration, beside the one given
    int32_t iterations;      // each visits every pixel once, in two half-steps of a checkerboard
    uint32_t stream, seed;   // choose the random numbers

    float perturbation;         // size of random changes in the first iteration, pixels of parallax; halved in each
    float best_weight_ratio;    // weight of the next-best source relative to the better one
    float sigma_grey;           // bilateral weight: grey levels
    float sigma_space;          // bilateral weight: pixels
    float noise_variance;       // grey levels squared, added to both variances: flat patches give no evidence
    float smoothness;           // weight of the deviation from the neighbours' planes
    float smoothness_limit;     // pixels of parallax
    float geometric;            // weight of the forward-backward reprojection error
    float geometric_limit;      // pixels
};

}  // namespace patchmatch
