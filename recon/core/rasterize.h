// The rasteriser's data and its stages, in the order in which they run.
//
// Forward:   project   every Gaussian becomes a splat and is counted in the tiles that it may touch
//            bin       every tile gets the list of its splats, nearest first
//            blend     every 4-pixel-wide block of a tile blends the splats that touch it
// Backward:  blend_backward    every tile writes the gradient of each of its splats into a slot of its own
//            project_backward  every Gaussian gathers its slots and follows the projection back
//
// No two tasks write to the same place and every sum has a fixed order, so the result is the same on every run,
// whatever the number of threads. recon/rasterize/reference.py is the definition of what is computed.
#pragma once

#include <cstdint>

#include "buffer.h"
#include "simd.h"

namespace core {

constexpr float kLowPass = 0.3f;
constexpr float kAlphaMin = 1 / 255.0f;
constexpr float kLog2AlphaMin = -7.99435344f;
constexpr float kAlphaMax = 0.99f;
constexpr float kTransmittanceMin = 1e-4f;
constexpr float kGuard = 0.3f;

// A tile is sorted and blended by one thread; its splats and their gradients stay in that core's cache.
constexpr int kTile = 32;
// A block is one register of pixels. Splats are culled by block: smaller blocks waste fewer lanes.
constexpr int kBlockWidth = 4;
constexpr int kBlockHeight = kLanes / kBlockWidth;
constexpr int kBlocksAcross = kTile / kBlockWidth;
constexpr int kBlocksDown = kTile / kBlockHeight;
constexpr int kBlocks = kBlocksAcross * kBlocksDown;

enum Channel { kRgb = 1, kDepth = 2, kNormal = 4, kAlpha = 8 };

// What a splat carries to the pixels: 0-2 colour, 3 depth, 4-6 normal.
constexpr int kFeatures = 7;

// ---- What crosses the C interface (mirrored in recon/result/rendering.py) -------------------------------------------
struct RasterInput {
    int32_t num_gaussians, sh_bases, width, height, antialias, channels;
    float near_plane;
    const float *means, *quats, *scales, *opacities, *sh;
    double T_world_camera[16];    // row-major
    double focal[2], principal[2];  // fx, fy; cx, cy
};

// Planar images: (3, H, W) or (H, W). Null where not asked for.
struct RasterImages {
    float *rgb, *depth, *normal, *alpha;
};

struct RasterGradients {
    float *means, *quats, *scales, *opacities, *sh;
    double T_world_camera[16];
    double focal[2], principal[2];
};

// Bits of the answer of `core_raster_forward`: which input is not what it must be.
enum InputError { kBadMeans = 1, kBadQuats = 2, kBadScales = 4, kBadOpacities = 8, kBadSh = 16, kTooManyEntries = 32 };

// ---- What the stages hand on ---------------------------------------------------------------------------------------
struct Camera {
    float rotation[3][3];  // world to camera: p_camera = rotation * (p_world - centre)
    float centre[3];
    float fx, fy, cx, cy;
    int width, height;
    float near_plane;
};

// A Gaussian on the image, one cache line. With the offset (dx, dy) of a pixel from the centre,
//   u = k0 * (dx - slope * dy),  w = k2 * dy,  log2(alpha) = log2_opacity - u^2 - w^2.
// This is the Cholesky factor of the inverse covariance: where the quadratic form itself would lose all digits
// for a long thin splat, u and w keep theirs.
struct alignas(64) Splat {
    float x, y, k0, slope, k2, log2_opacity;
    float extent_at;  // dy of the rightmost point of the ellipse on which alpha = 1/255
    uint32_t slot_row;
    float features[kFeatures];
    uint32_t slot_origin;  // its gradient from tile (x, y) is in slot slot_origin + y * slot_row + x
};

// A splat in the pixel coordinates of a tile, measured from the tile's centre:
//   u = k0 * x + k1 * y + u0,  w = k2 * y + w0.
struct alignas(64) TileSplat {
    float k0, k1, u0, k2, w0, log2_opacity;
    uint32_t slot;    // of its gradient from this tile
    float extent_at;  // as in Splat
    float features[kFeatures];
    float x;  // of its centre
};

// Tiles [x0, x1) x [y0, y1) that a splat may touch; empty for a Gaussian that is not seen.
struct TileRect {
    uint16_t x0, x1, y0, y1;
    uint32_t width() const { return x1 - x0; }
    uint32_t count() const { return width() * (y1 - y0); }
};

// Sums over a tile's pixels of v = dL/d(ln alpha) times 1, u, w, u^2, u w, w^2, and of the blending weight times the
// gradient of each feature's image.
struct alignas(64) SplatGradient {
    float moments[6];
    float unused[2];
    float features[kFeatures];
    float unused2;
};

enum Stage { kStageProject, kStageBin, kStageBlend, kStageBlendBackward, kStageProjectBackward, kStages };

// One rendered view: what backward needs of forward.
struct Raster {
    Camera camera;
    int num_gaussians, tiles_x, tiles_y;
    int chunk, num_chunks;  // Gaussians are handled in fixed ranges of `chunk`

    Buffer<Splat> splats;           // (N)
    Buffer<TileRect> rects;         // (N)
    Buffer<uint32_t> counts;        // (chunks, tiles) splats of a chunk in a tile, later where they start
    Buffer<uint32_t> chunk_slots;   // (chunks) slots of a chunk, later where they start
    Buffer<uint32_t> first_entries;  // (tiles + 1)
    Buffer<uint64_t> entries;       // (E) depth and Gaussian of each splat of each tile, nearest first
    Buffer<TileSplat> tile_splats;  // (E + kLanes) the splats of the entries
    Buffer<uint64_t> first_words;   // (tiles) where a tile's bits start
    Buffer<uint64_t> block_bits;    // (tiles, blocks, words) which of the tile's splats a block blends
    Buffer<SplatGradient> slots;    // (E) by Gaussian, then by the tiles of its rectangle, row by row
    Buffer<double> camera_sums;     // (chunks, 16)
    double seconds[kStages], processor_seconds[kStages];  // spent in the last forward and backward

    int num_tiles() const { return tiles_x * tiles_y; }
    uint32_t num_entries(int tile) const { return first_entries[tile + 1] - first_entries[tile]; }
    uint32_t num_words(int tile) const { return (num_entries(tile) + 63) / 64; }
};

inline uint32_t entry_gaussian(uint64_t entry) { return uint32_t(entry); }

// ---- The stages ----------------------------------------------------------------------------------------------------
Camera make_camera(const RasterInput& input);
int project(const RasterInput& input, Raster& raster);  // InputError bits, 0 when all is well
int bin(Raster& raster);
void blend(Raster& raster, int channels, const RasterImages& images);
void blend_backward(Raster& raster, int channels, const RasterImages& images, const RasterImages& gradients);
void project_backward(const RasterInput& input, Raster& raster, RasterGradients& gradients);

}  // namespace core
