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

// A block's splats, nearest first, are listed before they are blended, in groups whose alphas are computed in turns.
constexpr int kGroup = 6;

// The place, counted from the tile's first splat, of one that no pixel sees: it fills up the last group.
inline uint32_t invisible_place(const Raster& raster, int tile) {
    return raster.first_entries[raster.num_tiles()] - raster.first_entries[tile];
}

// The places of the bits of every byte, from the lowest.
struct BitPlaces {
    uint8_t places[256][8];
    constexpr BitPlaces() : places() {
        for (int byte = 0; byte < 256; ++byte)
            for (int bit = 0, count = 0; bit < 8; ++bit)
                if (byte >> bit & 1) places[byte][count++] = uint8_t(bit);
    }
};
inline constexpr BitPlaces kBitPlaces;
constexpr uint32_t kListPadding = 8 + kGroup;  // of a list's memory

// Lists the places whose bits are set, fills up the last group with `invisible`, and returns how many there are. Eight
// are written at a time, of which as many stay as there are bits: a loop over bits is mispredicted once a word.
inline uint32_t list_splats(const uint64_t* words, uint32_t num_words, uint32_t invisible, uint32_t* list) {
    uint32_t* next = list;
    for (uint32_t word = 0; word < num_words; ++word)
        for (int byte = 0; byte < 8; ++byte) {
            const unsigned here = words[word] >> 8 * byte & 255;
            for (int i = 0; i < 8; ++i) next[i] = word * 64 + 8 * byte + kBitPlaces.places[here][i];
            next += __builtin_popcount(here);
        }
    for (int i = 0; i < kGroup; ++i) next[i] = invisible;
    return uint32_t(next - list);
}

// What pixels would take of each splat of a group with nothing before it.
inline void group_alphas(const TileSplat* splats, const uint32_t* group, Vec x, Vec y, Vec (&alphas)[kGroup]) {
    const TileSplat* s[kGroup];
    Vec u[kGroup], w[kGroup], log2_alpha[kGroup];
    for (int i = 0; i < kGroup; ++i) s[i] = splats + group[i];
    for (int i = 0; i < kGroup; ++i) u[i] = multiply_add(splat(s[i]->k1), y, splat(s[i]->u0));
    for (int i = 0; i < kGroup; ++i) w[i] = multiply_add(splat(s[i]->k2), y, splat(s[i]->w0));
    for (int i = 0; i < kGroup; ++i) u[i] = multiply_add(splat(s[i]->k0), x, u[i]);
    for (int i = 0; i < kGroup; ++i) log2_alpha[i] = multiply_add(-w[i], w[i], splat(s[i]->log2_opacity));
    for (int i = 0; i < kGroup; ++i) log2_alpha[i] = multiply_add(-u[i], u[i], log2_alpha[i]);
    exp2_nonpositive(log2_alpha, alphas);
    for (int i = 0; i < kGroup; ++i)
        alphas[i] = keep(at_least(log2_alpha[i], splat(kLog2AlphaMin)), minimum(alphas[i], splat(kAlphaMax)));
}

// Lanes that still let light through.
inline Mask open_lanes(Vec transmittance) { return at_least(transmittance, splat(kTransmittanceMin)); }

// The weight of a splat in the open lanes. `transmittance` becomes what is left; where it is already too small it goes on
// falling, so that a splat waits for little of what the one before it computes.
inline Vec pass_splat(Vec alpha, Mask open, Vec& transmittance) {
    const Vec weight = keep(open, alpha * transmittance);
    transmittance = multiply_add(-alpha, transmittance, transmittance);
    return weight;
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
