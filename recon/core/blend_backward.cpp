// Stage 4: every tile writes the gradient of each of its splats into a slot of its own.
//
// Per block: (a) the blending is repeated and each splat's alpha and weight kept, front to back; (b) back to front, the
// gradient v = dL/d(ln alpha) of each pixel; (c) the sums over the block's pixels, as a small matrix product.
#include <cstring>

#include "threads.h"
#include "tile.h"

namespace core {
namespace {

constexpr int kMoments = 6;
constexpr int kColumns = 16;  // of a row of sums: moments in even places, features in odd ones
constexpr int kPairFloats = 2 * kLanes;
constexpr int kSumsTogether = 8;  // registers of sums in flight

// Sums over the pixels of a tile, of v times a monomial and of the weight times a feature's gradient.
struct alignas(64) Sums {
    float columns[kColumns];
};

struct Scratch {
    Buffer<TileSplat> splats;
    Buffer<Sums> sums;          // one per splat, and one for padding
    Buffer<uint32_t> blended;   // the splats of a block
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

// (a) Repeats the forward pass over the splats in `words`; returns how many there are.
uint32_t repeat_blending(const TileSplat* splats, const uint64_t* words, uint32_t num_words, Vec x, Vec y,
                         Vec transmittance, uint32_t* blended, float* pairs) {
    uint32_t count = 0;
    for (uint32_t word = 0; word < num_words; ++word) {
        for (uint64_t rest = words[word]; rest; rest &= rest - 1) {
            const uint32_t index = word * 64 + __builtin_ctzll(rest);
            const Contribution c = blend_splat(splats[index], x, y, transmittance);
            store(pairs + count * kPairFloats, c.alpha);
            store(pairs + count * kPairFloats + kLanes, c.weight);
            blended[count++] = index;
        }
    }
    return count;
}

// (b) Back to front. With g the gradient-weighted features of a splat and `behind` those of everything behind it, as
// seen through nothing: dL/d(alpha) = transmittance * (g - behind). Replaces (alpha, weight) by the pairs (v, weight).
// Neither a division by 1 - alpha nor a difference of sums: both would lose digits behind opaque splats.
template <int Channels>
void differentiate(const TileSplat* splats, const uint32_t* blended, uint32_t count,
                   const PixelGradients<Channels>& gradients, float* pairs) {
    using F = Features<Channels>;
    Vec behind{};
    for (uint32_t i = count; i-- > 0;) {
        const TileSplat& splat = splats[blended[i]];
        float* pair = pairs + i * kPairFloats;
        const Vec alpha = load(pair), weight = load(pair + kLanes);
        Vec value = gradients.alpha;
        for (int c = 0; c < F::kCount; ++c) value += gradients.features[c] * splat.features[F::place(c)];
        const Vec difference = value - behind;
        behind += alpha * difference;
        const Vec v = keep(less(alpha, core::splat(kAlphaMax)), weight * difference);
        store_pairs(pair, v, weight);
    }
}

// The right-hand side of (c): for each place of `store_pairs`, the columns that its two numbers are multiplied by.
template <int Channels>
void make_columns(Vec x, Vec y, const PixelGradients<Channels>& gradients, float (&columns)[kLanes][kColumns]) {
    using F = Features<Channels>;
    const Vec monomials[kMoments] = {splat(1.0f), x, y, x * x, x * y, y * y};
    for (int place = 0; place < kLanes; ++place) {
        const int lane = pair_lane(place);
        for (int i = 0; i < kMoments; ++i) columns[place][2 * i] = monomials[i][lane];
        for (int i = 0; i < F::kCount; ++i) columns[place][2 * i + 1] = gradients.features[i][lane];
    }
}

// (c) sums[splat] += pairs * columns, for several splats at a time to hide the latency of the additions.
template <int Channels>
void add_sums(const uint32_t* blended, uint32_t count, const float* pairs, const float (&columns)[kLanes][kColumns],
              Sums* sums) {
    constexpr int kUsed = 2 * (Features<Channels>::kCount > kMoments ? Features<Channels>::kCount : kMoments);
    constexpr int kParts = (kUsed + kLanes - 1) / kLanes;
    constexpr int kTogether = kSumsTogether / kParts;
    for (uint32_t first = 0; first < count; first += kTogether) {
        Vec totals[kTogether][kParts] = {};
        for (int place = 0; place < kLanes; ++place)
            for (int i = 0; i < kTogether; ++i) {
                const Vec pair = broadcast_pair(pairs + (first + i) * kPairFloats + 2 * place);
                for (int part = 0; part < kParts; ++part)
                    totals[i][part] += pair * load(columns[place] + part * kLanes);
            }
        for (int i = 0; i < kTogether; ++i) {
            float* to = sums[blended[first + i]].columns;
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

    const uint32_t num_words = raster.num_words(tile), padding = raster.num_entries(tile);
    const uint64_t* words = raster.block_bits.data() + raster.first_words[tile] + block * num_words;
    const Vec x = block_x(block), y = block_y(block);
    const Vec transmittance = initial_transmittance(raster.camera, origin, block);
    uint32_t* blended = scratch.blended.data();
    float* pairs = scratch.pairs.data();
    const uint32_t count = repeat_blending(scratch.splats.data(), words, num_words, x, y, transmittance, blended, pairs);
    if (!count) return;
    differentiate<Channels>(scratch.splats.data(), blended, count, gradients, pairs);
    for (int i = 0; i < kSumsTogether; ++i) blended[count + i] = padding;
    std::memset(pairs + count * kPairFloats, 0, sizeof(float) * kSumsTogether * kPairFloats);
    alignas(64) float columns[kLanes][kColumns] = {};
    make_columns<Channels>(x, y, gradients, columns);
    add_sums<Channels>(blended, count, pairs, columns, scratch.sums.data());
}

// From monomials in the tile's pixels to u and w, which are of order one wherever a splat is seen.
template <int Channels>
SplatGradient splat_gradient(const TileSplat& splat, const Sums& sums) {
    using F = Features<Channels>;
    const float* m = sums.columns;
    const float one = m[0], x = m[2], y = m[4], xx = m[6], xy = m[8], yy = m[10];
    const float k0 = splat.k0, k1 = splat.k1, k2 = splat.k2, u0 = splat.u0, w0 = splat.w0;
    const float x_u = k0 * xx + k1 * xy + u0 * x, y_u = k0 * xy + k1 * yy + u0 * y, u = k0 * x + k1 * y + u0 * one;
    const float y_w = k2 * yy + w0 * y, w = k2 * y + w0 * one;
    SplatGradient gradient = {};
    gradient.moments[0] = one;
    gradient.moments[1] = u;
    gradient.moments[2] = w;
    gradient.moments[3] = k0 * x_u + k1 * y_u + u0 * u;
    gradient.moments[4] = k2 * y_u + w0 * u;
    gradient.moments[5] = k2 * y_w + w0 * w;
    for (int i = 0; i < F::kCount; ++i) gradient.features[F::place(i)] = m[2 * i + 1];
    return gradient;
}

template <int Channels>
void differentiate_tile(Raster& raster, int tile, const RasterImages& images, const RasterImages& gradients,
                        Scratch& scratch) {
    const uint32_t count = raster.num_entries(tile);
    if (!count) return;
    scratch.splats.resize(count + 1);
    scratch.sums.resize(count + 1);
    scratch.blended.resize(count + kSumsTogether);
    scratch.pairs.resize(size_t(count + kSumsTogether) * kPairFloats);
    load_splats(raster, tile, scratch.splats.data());
    std::memset(scratch.sums.data(), 0, sizeof(Sums) * (count + 1));
    for (int block = 0; block < kBlocks; ++block)
        differentiate_block<Channels>(raster, tile, block, images, gradients, scratch);

    const int tile_x = tile % raster.tiles_x, tile_y = tile / raster.tiles_x;
    const uint64_t* entries = raster.entries.data() + raster.first_entries[tile];
    for (uint32_t i = 0; i < count; ++i) {
        const uint32_t gaussian = entry_gaussian(entries[i]);
        const TileRect rect = raster.rects[gaussian];
        const uint32_t slot =
            raster.first_slots[gaussian] + (tile_y - rect.y0) * (rect.x1 - rect.x0) + (tile_x - rect.x0);
        raster.slots[slot] = splat_gradient<Channels>(scratch.splats[i], scratch.sums[i]);
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
