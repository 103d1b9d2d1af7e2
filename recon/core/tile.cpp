#include "tile.h"

#include <algorithm>
#include <cstring>

namespace core {
namespace {

// Stable radix sort by the bits from 32 on. Digits that all entries share are passed over: depths of a tile are
// similar, so it is seldom that all four are needed.
void sort_by_depth(uint64_t* entries, uint32_t count) {
    thread_local Buffer<uint64_t> spare;
    uint32_t positions[4][256] = {};
    for (uint32_t i = 0; i < count; ++i)
        for (int digit = 0; digit < 4; ++digit) ++positions[digit][entries[i] >> (32 + 8 * digit) & 255];
    uint64_t *from = entries, *to = spare.resize(count);
    for (int digit = 0; digit < 4; ++digit) {
        uint32_t* position = positions[digit];
        const int shift = 32 + 8 * digit;
        if (position[from[0] >> shift & 255] == count) continue;
        uint32_t sum = 0;
        for (int value = 0; value < 256; ++value) {
            const uint32_t here = position[value];
            position[value] = sum;
            sum += here;
        }
        for (uint32_t i = 0; i < count; ++i) to[position[from[i] >> shift & 255]++] = from[i];
        std::swap(from, to);
    }
    if (from != entries) std::memcpy(entries, from, sizeof(uint64_t) * count);
}

}  // namespace

void sort_entries(Raster& raster, int tile) {
    const uint32_t count = raster.num_entries(tile);
    if (count > 1) sort_by_depth(raster.entries.data() + raster.first_entries[tile], count);
}

void load_splats(Raster& raster, int tile) {
    constexpr uint32_t kAhead = 48;  // the splats are scattered over memory, whose answer takes that long
    const uint32_t count = raster.num_entries(tile);
    const uint64_t* entries = raster.entries.data() + raster.first_entries[tile];
    TileSplat* splats = raster.tile_splats.data() + raster.first_entries[tile];
    const TileOrigin origin = tile_origin(raster, tile);
    const uint32_t tile_x = tile % raster.tiles_x, tile_y = tile / raster.tiles_x;
    for (uint32_t i = 0; i < count; ++i) {
        if (i + kAhead < count) __builtin_prefetch(&raster.splats[entry_gaussian(entries[i + kAhead])]);
        const Splat& splat = raster.splats[entry_gaussian(entries[i])];
        const float x = splat.x - origin.centre_x(), y = splat.y - origin.centre_y();
        TileSplat& here = splats[i];
        here.k0 = splat.k0;
        here.k1 = -splat.slope * splat.k0;
        here.u0 = -splat.k0 * (x - splat.slope * y);
        here.k2 = splat.k2;
        here.w0 = -splat.k2 * y;
        here.log2_opacity = splat.log2_opacity;
        here.slot = splat.slot_origin + tile_y * splat.slot_row + tile_x;
        here.extent_at = splat.extent_at;
        here.x = x;
        std::memcpy(here.features, splat.features, sizeof here.features);
    }
}

void find_blocks(Raster& raster, int tile) {
    const uint32_t count = raster.num_entries(tile), words = raster.num_words(tile);
    if (!count) return;
    const TileSplat* splats = raster.tile_splats.data() + raster.first_entries[tile];
    uint64_t* block_bits = raster.block_bits.data() + raster.first_words[tile];
    std::memset(block_bits, 0, sizeof(uint64_t) * kBlocks * words);
    const float slack = 0.005f;  // pixels, against rounding

    // A lane is a splat. For each row of blocks: where the ellipse starts and ends in it.
    for (uint32_t first = 0; first < count; first += kLanes) {
        const float* rows[kLanes];
        for (uint32_t lane = 0; lane < kLanes; ++lane) rows[lane] = &splats[std::min(first + lane, count - 1)].k0;
        Vec columns[16];
        load_transposed(rows, columns);
        const Vec inverse_k0 = 1.0f / columns[0], k2 = columns[3], inverse_k2 = 1.0f / k2;
        const Vec slope = -columns[1] * inverse_k0, extent_at = columns[7];
        const Vec x = columns[15] + float(kTile / 2), y = float(kTile / 2) - columns[4] * inverse_k2;
        const Vec radius2 = maximum(columns[5] - kLog2AlphaMin, Vec{});
        const Vec extent_y = square_root(radius2) * inverse_k2 + slack;
        const unsigned valid = (1u << std::min(count - first, uint32_t(kLanes))) - 1;

        for (int row = 0; row < kBlocksDown; ++row) {
            const Vec top = float(row * kBlockHeight) + 0.5f - y, bottom = top + float(kBlockHeight - 1);
            unsigned touched = bits(at_least(extent_y, top)) & bits(at_least(bottom, -extent_y)) & valid;
            if (!touched) continue;
            // Between the rows' first and last pixel centre the ellipse reaches furthest right at dy = extent_at,
            // or as near to that as the rows come; and furthest left at dy = -extent_at.
            const Vec low = maximum(top, -extent_y), high = minimum(bottom, extent_y);
            const Vec at_right = clamp(extent_at, low, high), at_left = clamp(-extent_at, low, high);
            const Vec w_right = k2 * at_right, w_left = k2 * at_left;
            const Vec half_right = square_root(maximum(radius2 - w_right * w_right, Vec{})) * inverse_k0;
            const Vec half_left = square_root(maximum(radius2 - w_left * w_left, Vec{})) * inverse_k0;
            const Vec right = x + slope * at_right + half_right + slack;
            const Vec left = x + slope * at_left - half_left - slack;
            for (int column = 0; column < kBlocksAcross; ++column) {
                const float first_pixel = float(column * kBlockWidth) + 0.5f;
                const unsigned reached = touched & bits(at_least(right, splat(first_pixel)) &
                                                        at_least(splat(first_pixel + (kBlockWidth - 1)), left));
                block_bits[(row * kBlocksAcross + column) * words + first / 64] |= uint64_t(reached) << first % 64;
            }
        }
    }
}

}  // namespace core
