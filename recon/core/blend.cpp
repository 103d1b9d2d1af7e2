// Stage 3: every block of pixels blends the splats that touch it, nearest first.
#include <algorithm>

#include "threads.h"
#include "tile.h"

namespace core {
namespace {

template <int Channels>
void store_images(const Vec* features, Vec alpha, const Camera& camera, const BlockPosition& at,
                  const RasterImages& images) {
    using F = Features<Channels>;
    const int width = camera.width;
    const size_t plane = size_t(width) * camera.height;
    store_block(images.alpha, width, at, alpha);
    for (int c = 0; c < F::kColours; ++c) store_block(images.rgb + c * plane, width, at, features[c]);
    if (F::kDepths) {
        const Mask seen = less(Vec{}, alpha);
        store_block(images.depth, width, at, keep(seen, features[F::kColours] / select(seen, alpha, splat(1.0f))));
    }
    for (int c = 0; c < F::kNormals; ++c)
        store_block(images.normal + c * plane, width, at, features[F::kColours + F::kDepths + c]);
}

// Clears the bits from `place` on.
void clear_from(uint64_t* words, uint32_t num_words, uint32_t place) {
    words[place / 64] &= (uint64_t(1) << place % 64) - 1;
    std::fill(words + place / 64 + 1, words + num_words, uint64_t(0));
}

// Blends one block. `words` says which splats; those that no light comes through to are taken out.
template <int Channels>
void blend_block(const Raster& raster, int tile, int block, uint64_t* words, const RasterImages& images,
                 uint32_t* list) {
    using F = Features<Channels>;
    const TileOrigin origin = tile_origin(raster, tile);
    const BlockPosition at = block_position(raster.camera, origin, block);
    if (at.outside()) return;
    const TileSplat* splats = raster.tile_splats.data() + raster.first_entries[tile];
    const uint32_t num_words = raster.num_words(tile);
    const Vec x = block_x(block), y = block_y(block);
    Vec transmittance = at.whole() ? splat(1.0f) : initial_transmittance(raster.camera, origin, block);
    // Where little is seen, 1 - transmittance has lost the digits that the expected depth needs of the sum of weights.
    Vec alpha{}, features[F::kCount + 1];
    // Zeros that the compilers do not foresee: they would clear the few registers with a loop in microcode.
    for (Vec& feature : features) feature = x - x;

    const uint32_t count = list_splats(words, num_words, invisible_place(raster, tile), list);
    uint32_t first = 0;
    for (; first < count && any(open_lanes(transmittance)); first += kGroup) {
        const uint32_t* group = list + first;
        Vec weights[kGroup];
        group_alphas(splats, group, x, y, weights);
        for (Vec& weight : weights) weight = pass_splat(weight, open_lanes(transmittance), transmittance);
        for (const Vec& weight : weights) alpha += weight;
        for (int f = 0; f < F::kCount; ++f)
            for (int i = 0; i < kGroup; ++i)
                features[f] = multiply_add(weights[i], splat(splats[group[i]].features[F::place(f)]), features[f]);
    }
    if (first < count) clear_from(words, num_words, list[first]);
    store_images<Channels>(features, alpha, raster.camera, at, images);
}

template <int Channels>
void blend_tile(Raster& raster, int tile, const RasterImages& images, Buffer<uint32_t>& list) {
    list.resize(raster.num_entries(tile) + kListPadding);
    sort_entries(raster, tile);
    load_splats(raster, tile);
    find_blocks(raster, tile);
    const uint32_t num_words = raster.num_words(tile);
    uint64_t* words = raster.block_bits.data() + raster.first_words[tile];
    for (int block = 0; block < kBlocks; ++block)
        blend_block<Channels>(raster, tile, block, words + block * num_words, images, list.data());
}

struct BlendTiles {
    Raster& raster;
    const RasterImages& images;

    template <int Channels>
    void run() {
        run_parallel(raster.num_tiles(), [&](int tile, int) {
            thread_local Buffer<uint32_t> list;
            blend_tile<Channels>(raster, tile, images, list);
        });
    }
};

}  // namespace

void blend(Raster& raster, int channels, const RasterImages& images) {
    with_channels(channels, BlendTiles{raster, images});
}

}  // namespace core
