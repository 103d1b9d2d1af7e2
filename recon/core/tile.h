// A tile's splats, as its blocks see them.
#pragma once

#include "rasterize.h"

namespace core {

struct TileOrigin {
    int x, y;  // the top left pixel
    float centre_x() const { return float(x + kTile / 2); }
    float centre_y() const { return float(y + kTile / 2); }
};

inline TileOrigin tile_origin(const Raster& raster, int tile) {
    return {tile % raster.tiles_x * kTile, tile / raster.tiles_x * kTile};
}

// Pixel centres of a block relative to the tile's centre.
inline Vec block_x(int block) {
    Vec x;
    for (int lane = 0; lane < kLanes; ++lane) x[lane] = float(lane % kBlockWidth) + 0.5f - kTile / 2;
    return x + float(block % kBlocksAcross * kBlockWidth);
}
inline Vec block_y(int block) {
    Vec y;
    for (int lane = 0; lane < kLanes; ++lane) y[lane] = float(lane / kBlockWidth) + 0.5f - kTile / 2;
    return y + float(block / kBlocksAcross * kBlockHeight);
}

// Sorts the tile's entries by depth, of equal ones by Gaussian.
void sort_entries(Raster& raster, int tile);

// Fills in the tile's splats in the order of its entries.
void load_splats(Raster& raster, int tile);

// For each block the tile's splats whose ellipse alpha = 1/255 reaches a pixel centre of it, as bits.
void find_blocks(Raster& raster, int tile);

// What the pixels of a block take of a splat.
struct Contribution {
    Vec alpha, weight;
};

// Blends `splat` into the lanes at (x, y) that still let light through. `transmittance` becomes what is left; where it
// is already too small it goes on falling, so that a splat waits for little of what the one before it computes.
inline Contribution blend_splat(const TileSplat& splat_, Vec x, Vec y, Vec& transmittance) {
    const Vec u = multiply_add(splat(splat_.k0), x, multiply_add(splat(splat_.k1), y, splat(splat_.u0)));
    const Vec w = multiply_add(splat(splat_.k2), y, splat(splat_.w0));
    const Vec log2_alpha = multiply_add(-u, u, multiply_add(-w, w, splat(splat_.log2_opacity)));
    const Mask visible = at_least(log2_alpha, splat(kLog2AlphaMin));
    const Mask open = at_least(transmittance, splat(kTransmittanceMin));
    const Vec alpha = keep(visible, minimum(exp2_nonpositive(log2_alpha), splat(kAlphaMax)));
    const Vec weight = keep(open, alpha * transmittance);
    transmittance = multiply_add(-alpha, transmittance, transmittance);
    return {keep(open, alpha), weight};
}

// Lanes of a block whose pixel is inside the image let all light through, the others none.
inline Vec initial_transmittance(const Camera& camera, TileOrigin origin, int block) {
    const Vec x = block_x(block) + origin.centre_x(), y = block_y(block) + origin.centre_y();
    const Vec inside_x = keep(less(x, splat(float(camera.width))), splat(1.0f));
    return keep(less(y, splat(float(camera.height))), inside_x);
}

// The pixel of an image at which a block starts.
struct BlockPosition {
    int x, y, columns, rows;  // columns and rows that are inside the image; 0 if none is
    bool whole() const { return columns == kBlockWidth && rows == kBlockHeight; }
    bool outside() const { return columns <= 0 || rows <= 0; }
};

inline BlockPosition block_position(const Camera& camera, TileOrigin origin, int block) {
    const int x = origin.x + block % kBlocksAcross * kBlockWidth, y = origin.y + block / kBlocksAcross * kBlockHeight;
    const int columns = camera.width - x, rows = camera.height - y;
    return {x, y, columns < kBlockWidth ? columns : kBlockWidth, rows < kBlockHeight ? rows : kBlockHeight};
}

// A block of an image plane; 0 outside the image.
inline Vec load_block(const float* plane, int width, const BlockPosition& at) {
    const float* from = plane + size_t(at.y) * width + at.x;
    if (at.whole()) return load_quads(from, width);
    alignas(64) float pixels[kLanes] = {};
    for (int row = 0; row < at.rows; ++row)
        for (int column = 0; column < at.columns; ++column)
            pixels[row * kBlockWidth + column] = from[size_t(row) * width + column];
    return load(pixels);
}

inline void store_block(float* plane, int width, const BlockPosition& at, Vec value) {
    float* to = plane + size_t(at.y) * width + at.x;
    if (at.whole()) return store_quads(to, width, value);
    alignas(64) float pixels[kLanes];
    store(pixels, value);
    for (int row = 0; row < at.rows; ++row)
        for (int column = 0; column < at.columns; ++column)
            to[size_t(row) * width + column] = pixels[row * kBlockWidth + column];
}

// Which features the channels blend: known at compile time, so that what is not asked for costs nothing.
template <int Channels>
struct Features {
    static constexpr int kColours = Channels & kRgb ? 3 : 0;
    static constexpr int kDepths = Channels & kDepth ? 1 : 0;
    static constexpr int kNormals = Channels & kNormal ? 3 : 0;
    static constexpr int kCount = kColours + kDepths + kNormals;

    // The place in Splat::features of the i-th blended feature.
    static constexpr int place(int i) {
        return i < kColours ? i : i < kColours + kDepths ? 3 : 4 + i - kColours - kDepths;
    }
};

// Calls function.run<Channels>() for the channels that are blended.
template <class Function>
void with_channels(int channels, Function&& function) {
    switch (channels & (kRgb | kDepth | kNormal)) {
        case 0: return function.template run<0>();
        case 1: return function.template run<1>();
        case 2: return function.template run<2>();
        case 3: return function.template run<3>();
        case 4: return function.template run<4>();
        case 5: return function.template run<5>();
        case 6: return function.template run<6>();
        default: return function.template run<7>();
    }
}

}  // namespace core
