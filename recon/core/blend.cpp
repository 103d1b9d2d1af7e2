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

// Blends one block. `words` says which splats; those that no light comes through to are taken out, 64 at a time.
template <int Channels>
void blend_block(const Raster& raster, TileOrigin origin, int block, const TileSplat* splats, uint64_t* words,
                 uint32_t num_words, const RasterImages& images) {
    using F = Features<Channels>;
    const BlockPosition at = block_position(raster.camera, origin, block);
    if (at.outside()) return;
    const Vec x = block_x(block), y = block_y(block);
    Vec transmittance = at.whole() ? splat(1.0f) : initial_transmittance(raster.camera, origin, block);
    // Where little is seen, 1 - transmittance has lost the digits that the expected depth needs of the sum of weights.
    Vec alpha{}, features[F::kCount + 1];
    for (Vec& feature : features) feature = Vec{};

    uint32_t word = 0;
    for (; word < num_words && any(at_least(transmittance, splat(kTransmittanceMin))); ++word) {
        for (uint64_t rest = words[word]; rest; rest &= rest - 1) {
            const TileSplat& splat = splats[word * 64 + __builtin_ctzll(rest)];
            const Contribution c = blend_splat(splat, x, y, transmittance);
            alpha += c.weight;
            for (int i = 0; i < F::kCount; ++i) features[i] += c.weight * splat.features[F::place(i)];
        }
    }
    std::fill(words + word, words + num_words, uint64_t(0));
    store_images<Channels>(features, alpha, raster.camera, at, images);
}

template <int Channels>
void blend_tile(Raster& raster, int tile, const RasterImages& images) {
    sort_entries(raster, tile);
    load_splats(raster, tile);
    find_blocks(raster, tile);
    const TileOrigin origin = tile_origin(raster, tile);
    const TileSplat* splats = raster.tile_splats.data() + raster.first_entries[tile];
    const uint32_t num_words = raster.num_words(tile);
    uint64_t* words = raster.block_bits.data() + raster.first_words[tile];
    for (int block = 0; block < kBlocks; ++block)
        blend_block<Channels>(raster, origin, block, splats, words + block * num_words, num_words, images);
}

struct BlendTiles {
    Raster& raster;
    const RasterImages& images;

    template <int Channels>
    void run() {
        run_parallel(raster.num_tiles(), [&](int tile, int) { blend_tile<Channels>(raster, tile, images); });
    }
};

}  // namespace

void blend(Raster& raster, int channels, const RasterImages& images) {
    with_channels(channels, BlendTiles{raster, images});
}

}  // namespace core
