// Stage 4: every tile writes the gradient of each of its splats into a slot of its own.
//
// Per block: (a) the blending is repeated and each splat's alpha and weight kept, front to back; (b) back to front, the
// gradient v = dL/d(ln alpha) of each pixel; (c) the sums over the block's pixels, as a small matrix product.
#include <algorithm>
#include <cstring>

#include "threads.h"
#include "tile.h"

namespace core {
namespace {

constexpr int kMoments = 6;
constexpr int kColumns = 16;  // of a row of sums: moments in even places, features in odd ones
constexpr int kPairFloats = 2 * kLanes;
constexpr int kSumsInFlight = 8;  // registers
constexpr int kPadding = 16;      // sums, and splats of a block, beyond the last one, for whole groups and registers
constexpr int kRowsAhead = 2 * kBlockHeight;  // of the images, between asking memory for them and using them

// Sums over the pixels of a tile, of v times a monomial and of the weight times a feature's gradient.
struct alignas(64) Sums {
    float columns[kColumns];
};

struct Scratch {
    Buffer<Sums> sums;          // one per splat, then padding
    Buffer<uint32_t> list;      // places of a block's splats
    Buffer<float> pairs;        // (splats of a block, 2, lanes)
};

// dL/d(what the pixels accumulate): per feature, and for the sum of weights.
template <int Channels>
struct PixelGradients {
    Vec features[Features<Channels>::kCount + 1];
    Vec alpha;
    bool any;
};

template <int Channels>
PixelGradients<Channels> load_gradients(const Camera& camera, const BlockPosition& at, const RasterImages& images,
                                        const RasterImages& gradients) {
    using F = Features<Channels>;
    const int width = camera.width;
    const size_t plane = size_t(width) * camera.height;
    PixelGradients<Channels> g;
    g.alpha = gradients.alpha ? load_block(gradients.alpha, width, at) : Vec{};
    for (int c = 0; c < F::kColours; ++c) g.features[c] = load_block(gradients.rgb + c * plane, width, at);
    if (F::kDepths) {
        // depth = accumulated / alpha
        const Vec alpha = load_block(images.alpha, width, at), depth = load_block(images.depth, width, at);
        const Mask seen = less(Vec{}, alpha);
        const Vec gradient = load_block(gradients.depth, width, at);
        const Vec accumulated = keep(seen, gradient / select(seen, alpha, splat(1.0f)));
        g.features[F::kColours] = accumulated;
        g.alpha -= accumulated * depth;
    }
    for (int c = 0; c < F::kNormals; ++c)
        g.features[F::kColours + F::kDepths + c] = load_block(gradients.normal + c * plane, width, at);
    Vec largest = absolute(g.alpha);
    for (int i = 0; i < F::kCount; ++i) largest = maximum(largest, absolute(g.features[i]));
    g.any = any(less(Vec{}, largest));
    return g;
}

// (a) Repeats the forward pass over `count` splats and keeps (alpha, weight).
void repeat_blending(const TileSplat* splats, const uint32_t* list, uint32_t count, Vec x, Vec y, Vec transmittance,
                     float* pairs) {
    for (uint32_t first = 0; first < count; first += kGroup) {
        Vec alphas[kGroup];
        group_alphas(splats, list + first, x, y, alphas);
        for (int i = 0; i < kGroup; ++i) {
            float* pair = pairs + (first + i) * kPairFloats;
            const Mask open = open_lanes(transmittance);
            store(pair, keep(open, alphas[i]));
            store(pair + kLanes, pass_splat(alphas[i], open, transmittance));
        }
    }
}

// (b) Back to front. With g the gradient-weighted features of a splat and `behind` those of everything behind it, as
// seen through nothing: dL/d(alpha) = transmittance * (g - behind). Replaces (alpha, weight) by the pairs (v, weight).
// Neither a division by 1 - alpha nor a difference of sums: both would lose digits behind opaque splats.
template <int Channels>
void differentiate(const TileSplat* splats, const uint32_t* list, uint32_t count,
                   const PixelGradients<Channels>& pixel_gradients, float* pairs) {
    using F = Features<Channels>;
    const PixelGradients<Channels> gradients = pixel_gradients;  // in registers: `pairs` might overlap the original
    Vec behind{};
    for (uint32_t i = count; i-- > 0;) {
        const TileSplat& splat = splats[list[i]];
        float* pair = pairs + i * kPairFloats;
        const Vec alpha = load(pair), weight = load(pair + kLanes);
        Vec value = gradients.alpha;
        for (int c = 0; c < F::kCount; ++c)
            value = multiply_add(gradients.features[c], core::splat(splat.features[F::place(c)]), value);
        const Vec v = keep(less(alpha, core::splat(kAlphaMax)), weight * (value - behind));
        behind = multiply_add(1.0f - alpha, behind, alpha * value);  // one operation from splat to splat
        store_pairs(pair, v, weight);
    }
}

// The right-hand side of (c): for each place of `store_pairs`, the columns that its two numbers are multiplied by.
template <int Channels>
void make_columns(Vec x, Vec y, const PixelGradients<Channels>& gradients, float (&columns)[kLanes][kColumns]) {
    using F = Features<Channels>;
    const Vec monomials[kMoments] = {splat(1.0f), x, y, x * x, x * y, y * y};
    Vec by_lane[kColumns];
    for (int i = 0; i < kColumns / 2; ++i) {
        by_lane[2 * i] = i < kMoments ? monomials[i] : Vec{};
        by_lane[2 * i + 1] = i < F::kCount ? gradients.features[i] : Vec{};
    }
    float* places[kLanes];
    for (int place = 0; place < kLanes; ++place) places[pair_lane(place)] = columns[place];
    store_transposed(by_lane, places);
}

// (c) sums[splat] += pairs * columns, for several splats at a time to hide the latency of the additions. Each step is one
// operation: free to reorder the sums, GCC made products and additions of them, and kept some of the sums in memory.
template <int Channels>
void add_sums(const uint32_t* list, uint32_t count, const float* pairs, const float (&columns)[kLanes][kColumns],
              Sums* sums) {
    constexpr int kUsed = 2 * (Features<Channels>::kCount > kMoments ? Features<Channels>::kCount : kMoments);
    constexpr int kParts = (kUsed + kLanes - 1) / kLanes;
    constexpr int kTogether = kSumsInFlight / kParts;
    for (uint32_t first = 0; first < count; first += kTogether) {
        Vec totals[kTogether][kParts] = {};
        for (int place = 0; place < kLanes; ++place)
            for (int i = 0; i < kTogether; ++i) {
                const Vec pair = broadcast_pair(pairs + (first + i) * kPairFloats + 2 * place);
                for (int part = 0; part < kParts; ++part)
                    totals[i][part] = multiply_add(pair, load(columns[place] + part * kLanes), totals[i][part]);
            }
        for (int i = 0; i < kTogether; ++i) {
            float* to = sums[list[first + i]].columns;
            for (int part = 0; part < kParts; ++part)
                store(to + part * kLanes, load(to + part * kLanes) + totals[i][part]);
        }
    }
}

template <int Channels>
void differentiate_block(const Raster& raster, int tile, int block, const RasterImages& images,
                         const RasterImages& image_gradients, Scratch& scratch) {
    const TileOrigin origin = tile_origin(raster, tile);
    const BlockPosition at = block_position(raster.camera, origin, block);
    if (at.outside()) return;
    const auto gradients = load_gradients<Channels>(raster.camera, at, images, image_gradients);
    if (!gradients.any) return;

    const uint32_t num_words = raster.num_words(tile);
    const uint64_t* words = raster.block_bits.data() + raster.first_words[tile] + block * num_words;
    const TileSplat* splats = raster.tile_splats.data() + raster.first_entries[tile];
    const Vec x = block_x(block), y = block_y(block);
    const Vec transmittance = initial_transmittance(raster.camera, origin, block);
    uint32_t* list = scratch.list.data();
    float* pairs = scratch.pairs.data();
    const uint32_t count = list_splats(words, num_words, invisible_place(raster, tile), list);
    if (!count) return;
    repeat_blending(splats, list, count, x, y, transmittance, pairs);
    differentiate<Channels>(splats, list, count, gradients, pairs);
    std::fill(list + count, list + count + kSumsInFlight, raster.num_entries(tile));
    std::fill(pairs + count * kPairFloats, pairs + (count + kSumsInFlight) * kPairFloats, 0.0f);
    alignas(64) float columns[kLanes][kColumns];
    make_columns<Channels>(x, y, gradients, columns);
    add_sums<Channels>(list, count, pairs, columns, scratch.sums.data());
}

// Sums become the gradients of kLanes splats: from monomials in the tile's pixels to
// u and w, which are of order one wherever a splat is seen.
template <int Channels>
void store_gradients(const TileSplat* splats, const Sums* sums, SplatGradient* const (&slots)[kLanes]) {
    using F = Features<Channels>;
    const float *splat_rows[kLanes], *sum_rows[kLanes];
    float* slot_rows[kLanes];
    for (int lane = 0; lane < kLanes; ++lane) {
        splat_rows[lane] = &splats[lane].k0;
        sum_rows[lane] = sums[lane].columns;
        slot_rows[lane] = slots[lane]->moments;
    }
    Vec s[16], m[16], out[16] = {};
    load_transposed(splat_rows, s);
    load_transposed(sum_rows, m);
    const Vec k0 = s[0], k1 = s[1], u0 = s[2], k2 = s[3], w0 = s[4];
    const Vec one = m[0], x = m[2], y = m[4], xx = m[6], xy = m[8], yy = m[10];
    const Vec x_u = k0 * xx + k1 * xy + u0 * x, y_u = k0 * xy + k1 * yy + u0 * y, u = k0 * x + k1 * y + u0 * one;
    const Vec y_w = k2 * yy + w0 * y, w = k2 * y + w0 * one;
    out[0] = one;
    out[1] = u;
    out[2] = w;
    out[3] = k0 * x_u + k1 * y_u + u0 * u;
    out[4] = k2 * y_u + w0 * u;
    out[5] = k2 * y_w + w0 * w;
    for (int i = 0; i < F::kCount; ++i) out[8 + F::place(i)] = m[2 * i + 1];
    store_transposed(out, slot_rows);
}

// Asks for rows [begin, end) of a tile: they lie far apart in each plane, so the processor does not foresee them.
template <int Channels>
void prefetch_images(const Camera& camera, TileOrigin origin, int begin, int end, const RasterImages& images,
                     const RasterImages& gradients) {
    using F = Features<Channels>;
    const size_t plane_size = size_t(camera.width) * camera.height;
    const float* planes[10];
    int count = 0;
    for (int c = 0; c < F::kColours; ++c) planes[count++] = gradients.rgb + c * plane_size;
    for (int c = 0; c < F::kNormals; ++c) planes[count++] = gradients.normal + c * plane_size;
    if (F::kDepths)
        for (const float* plane : {gradients.depth, images.depth, images.alpha}) planes[count++] = plane;
    if (gradients.alpha) planes[count++] = gradients.alpha;
    for (int y = origin.y + begin; y < std::min(origin.y + end, camera.height); ++y)
        for (int i = 0; i < count; ++i)
            for (int x = origin.x; x < std::min(origin.x + kTile, camera.width); x += 16)
                __builtin_prefetch(planes[i] + size_t(y) * camera.width + x);
}

template <int Channels>
void differentiate_tile(Raster& raster, int tile, const RasterImages& images, const RasterImages& gradients,
                        Scratch& scratch) {
    const uint32_t count = raster.num_entries(tile);
    if (!count) return;
    const uint32_t padded = count + kPadding;
    scratch.sums.resize(padded);
    scratch.list.resize(padded);
    scratch.pairs.resize(size_t(padded) * kPairFloats);
    const TileOrigin origin = tile_origin(raster, tile);
    const TileSplat* splats = raster.tile_splats.data() + raster.first_entries[tile];
    prefetch_images<Channels>(raster.camera, origin, 0, kRowsAhead, images, gradients);
    for (uint32_t i = 0; i < count; ++i) __builtin_prefetch(splats + i);
    std::memset(scratch.sums.data(), 0, sizeof(Sums) * padded);
    for (int row = 0; row < kBlocksDown; ++row) {
        const int ahead = row * kBlockHeight + kRowsAhead;
        if (ahead < kTile)
            prefetch_images<Channels>(raster.camera, origin, ahead, ahead + kBlockHeight, images, gradients);
        for (int column = 0; column < kBlocksAcross; ++column)
            differentiate_block<Channels>(raster, tile, row * kBlocksAcross + column, images, gradients, scratch);
    }

    for (uint32_t first = 0; first < count; first += kLanes) {
        SplatGradient unwanted, *slots[kLanes];
        for (uint32_t lane = 0; lane < kLanes; ++lane)
            slots[lane] = first + lane < count ? &raster.slots[splats[first + lane].slot] : &unwanted;
        store_gradients<Channels>(splats + first, &scratch.sums[first], slots);
    }
}

struct DifferentiateTiles {
    Raster& raster;
    const RasterImages& images;
    const RasterImages& gradients;

    template <int Channels>
    void run() {
        raster.slots.resize(raster.first_entries[raster.num_tiles()]);
        run_parallel(raster.num_tiles(), [&](int tile, int) {
            thread_local Scratch scratch;
            differentiate_tile<Channels>(raster, tile, images, gradients, scratch);
        });
    }
};

}  // namespace

void blend_backward(Raster& raster, int channels, const RasterImages& images, const RasterImages& gradients) {
    with_channels(channels, DifferentiateTiles{raster, images, gradients});
}

}  // namespace core
