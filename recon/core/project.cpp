// Stage 1: every Gaussian becomes a splat.
#include <algorithm>
#include <atomic>
#include <cfloat>
#include <cstring>

#include "projection.h"
#include "spherical_harmonics.h"
#include "threads.h"

namespace core {
namespace {

constexpr float kRootHalfLog2e = 0.849321800288019f;  // sqrt(log2(e) / 2)

Mask finite(Vec value) { return at_least(splat(FLT_MAX), absolute(value)); }

// Colours of the lanes, from coefficients (N, bases, 3). The lanes that are not seen may be anything.
void evaluate_colours(const RasterInput& input, int first, int valid, const Projection& p, Vec (&colours)[3]) {
    const int bases = input.sh_bases;
    Vec basis[16];
    const Vec inverse = 1.0f / square_root(dot(p.to_mean, p.to_mean));
    sh_basis(bases, p.to_mean[0] * inverse, p.to_mean[1] * inverse, p.to_mean[2] * inverse, basis);
    for (Vec& colour : colours) colour = splat(0.5f);
    const float* rows = input.sh + size_t(first) * bases * 3;
    for (int i = 0; i < bases; ++i) {
        alignas(64) float coefficients[3][kLanes];
        for (int lane = 0; lane < kLanes; ++lane) {
            const float* from = rows + (size_t(std::min(lane, valid - 1)) * bases + i) * 3;
            for (int c = 0; c < 3; ++c) coefficients[c][lane] = from[c];
        }
        for (int c = 0; c < 3; ++c) colours[c] += basis[i] * load(coefficients[c]);
    }
}

int check_input(const Gaussians& g) {
    unsigned bad_mean = 0, bad_quat = 0, bad_scale = 0;
    const unsigned all = bits(at_least(Vec{}, Vec{}));
    for (Vec mean : g.mean) bad_mean |= all ^ bits(finite(mean));
    const Vec norm2 = g.quat[0] * g.quat[0] + g.quat[1] * g.quat[1] + g.quat[2] * g.quat[2] + g.quat[3] * g.quat[3];
    bad_quat = (all ^ bits(finite(norm2))) | (all ^ bits(at_least(norm2, splat(1e-30f))));
    for (Vec scale : g.scale) bad_scale |= (all ^ bits(finite(scale))) | (all ^ bits(at_least(scale, Vec{})));
    const unsigned bad_opacity =
        (all ^ bits(at_least(splat(1.0f), g.opacity[0]))) | (all ^ bits(at_least(g.opacity[0], Vec{})));
    return (bad_mean ? kBadMeans : 0) | (bad_quat ? kBadQuats : 0) | (bad_scale ? kBadScales : 0) |
           (bad_opacity ? kBadOpacities : 0);
}

// Lanes in front of the camera and inside the guarded frustum, where the affine approximation holds.
unsigned inside_frustum(const Projection& p, const Camera& camera) {
    const float width = float(camera.width), height = float(camera.height);
    const Vec u = p.x_by_z * camera.fx + camera.cx, v = p.y_by_z * camera.fy + camera.cy;
    return bits(at_least(p.z, splat(camera.near_plane))) &
           bits(at_least(u, splat(-kGuard * width))) & bits(at_least(splat((1 + kGuard) * width), u)) &
           bits(at_least(v, splat(-kGuard * height))) & bits(at_least(splat((1 + kGuard) * height), v));
}

// The tiles with a pixel centre in [centre - extent, centre + extent], of `tiles` tiles.
void tile_range(float centre, float extent, int tiles, uint16_t& begin, uint16_t& end) {
    const float first = std::ceil((centre - extent - (kTile - 0.5f)) * (1.0f / kTile));
    const float last = std::floor((centre + extent - 0.5f) * (1.0f / kTile));
    begin = uint16_t(std::min(std::max(first, 0.0f), float(tiles)));
    end = uint16_t(std::max(std::min(last + 1, float(tiles)), float(begin)));
}

// Projects Gaussians [first, first + valid) and counts their splats by tile. Returns InputError bits.
int project_lanes(const RasterInput& input, Raster& raster, int first, int valid, uint32_t* tile_counts,
                  uint32_t& slots) {
    const Camera& camera = raster.camera;
    const Gaussians gaussians = load_gaussians(input, first, valid);
    int errors = check_input(gaussians);
    const Projection p = project_gaussians(gaussians, camera, input.antialias);

    const Vec opacity = gaussians.opacity[0] * p.compensation;
    unsigned seen = inside_frustum(p, camera) & bits(at_least(opacity, splat(kAlphaMin))) &
                    bits(less(Vec{}, p.factor_x)) & bits(finite(p.xx)) & bits(finite(p.yy)) & ((1u << valid) - 1);
    TileRect* rects = &raster.rects[first];
    if (!seen || errors) {
        std::fill(rects, rects + valid, TileRect{0, 0, 0, 0});
        return errors;
    }

    Vec row[16];
    row[0] = p.x_by_z * camera.fx + camera.cx;
    row[1] = p.y_by_z * camera.fy + camera.cy;
    row[2] = p.factor_x * kRootHalfLog2e;
    row[3] = p.slope;
    row[4] = p.factor_y * kRootHalfLog2e;
    row[5] = log2_positive(opacity);
    // The ellipse on which alpha = 1/255, half a hundredth of a pixel wider so that rounding loses no pixel.
    const Vec radius = square_root(maximum(row[5] - kLog2AlphaMin, Vec{})) * (1 / kRootHalfLog2e);
    const Vec deviation_x = square_root(p.xx);
    const Vec extent_x = radius * deviation_x * 1.0001f + 0.005f, extent_y = radius / p.factor_y * 1.0001f + 0.005f;
    row[6] = p.slope * p.yy / deviation_x * radius;
    row[7] = Vec{};
    Vec colours[3] = {};
    if (input.channels & kRgb) evaluate_colours(input, first, valid, p, colours);
    for (int c = 0; c < 3; ++c) {
        if (seen & ~bits(finite(colours[c]))) errors |= kBadSh;
        row[8 + c] = maximum(colours[c], Vec{});
    }
    row[11] = p.z;
    Vec sign[3];
    choose_normal(gaussians, p, sign);
    for (int i = 0; i < 3; ++i) {
        const Vec(&axes)[3] = p.axes_camera[i];
        row[12 + i] = sign[0] * axes[0] + sign[1] * axes[1] + sign[2] * axes[2];
    }
    row[15] = Vec{};
    store_rows(&raster.splats[first].x, valid, row);

    alignas(64) float extents_x[kLanes], extents_y[kLanes];
    store(extents_x, extent_x);
    store(extents_y, extent_y);
    for (int lane = 0; lane < valid; ++lane) {
        TileRect rect = {0, 0, 0, 0};
        if (seen >> lane & 1) {
            const Splat& splat = raster.splats[first + lane];
            tile_range(splat.x, extents_x[lane], raster.tiles_x, rect.x0, rect.x1);
            tile_range(splat.y, extents_y[lane], raster.tiles_y, rect.y0, rect.y1);
        }
        rects[lane] = rect;
        slots += rect.count();
        for (int y = rect.y0; y < rect.y1; ++y)
            for (int x = rect.x0; x < rect.x1; ++x) ++tile_counts[y * raster.tiles_x + x];
    }
    return errors;
}

}  // namespace

Camera make_camera(const RasterInput& input) {
    Camera camera;
    const double* T = input.T_world_camera;
    for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) camera.rotation[i][j] = float(T[4 * j + i]);
        camera.centre[i] = float(T[4 * i + 3]);
    }
    camera.fx = float(input.focal[0]), camera.fy = float(input.focal[1]);
    camera.cx = float(input.principal[0]), camera.cy = float(input.principal[1]);
    camera.width = input.width, camera.height = input.height;
    camera.near_plane = input.near_plane;
    return camera;
}

int project(const RasterInput& input, Raster& raster) {
    const int n = input.num_gaussians;
    raster.num_gaussians = n;
    raster.camera = make_camera(input);
    raster.tiles_x = (input.width + kTile - 1) / kTile;
    raster.tiles_y = (input.height + kTile - 1) / kTile;
    // At most 64 ranges, so that their counts by tile stay small; a multiple of every register's width.
    raster.chunk = std::max(512, (n / 64 + 15) / 16 * 16);
    raster.num_chunks = (n + raster.chunk - 1) / raster.chunk;
    raster.splats.resize(n);
    raster.rects.resize(n);
    raster.counts.resize(size_t(raster.num_chunks) * raster.num_tiles());
    raster.chunk_slots.resize(raster.num_chunks);

    std::atomic<int> errors{0};
    run_parallel(raster.num_chunks, [&](int chunk, int) {
        uint32_t* tile_counts = &raster.counts[size_t(chunk) * raster.num_tiles()];
        std::memset(tile_counts, 0, sizeof(uint32_t) * raster.num_tiles());
        uint32_t slots = 0;
        int chunk_errors = 0;
        const int end = std::min(n, (chunk + 1) * raster.chunk);
        for (int first = chunk * raster.chunk; first < end; first += kLanes)
            chunk_errors |= project_lanes(input, raster, first, std::min(kLanes, end - first), tile_counts, slots);
        raster.chunk_slots[chunk] = slots;
        if (chunk_errors) errors |= chunk_errors;
    });
    return errors;
}

}  // namespace core
