// Stage 2: every tile gets the list of its splats.
#include <algorithm>
#include <cstring>

#include "rasterize.h"
#include "threads.h"

namespace core {
namespace {

// Positive floats compare like the integers that they are made of.
uint64_t make_entry(float depth, uint32_t gaussian) {
    uint32_t key;
    std::memcpy(&key, &depth, sizeof key);
    return uint64_t(key) << 32 | gaussian;
}

}  // namespace

int bin(Raster& raster) {
    const int tiles = raster.num_tiles(), chunks = raster.num_chunks;
    raster.first_entries.resize(tiles + 1);
    raster.first_words.resize(tiles);

    // Counts become positions: within a tile by chunk, so by the index of the Gaussian.
    uint64_t entries = 0, words = 0;
    for (int tile = 0; tile < tiles; ++tile) {
        raster.first_entries[tile] = uint32_t(entries);
        const uint64_t first = entries;
        for (int chunk = 0; chunk < chunks; ++chunk) {
            uint32_t& count = raster.counts[size_t(chunk) * tiles + tile];
            const uint32_t here = count;
            count = uint32_t(entries);
            entries += here;
        }
        raster.first_words[tile] = words;
        words += (entries - first + 63) / 64 * kBlocks;
    }
    if (entries >= (uint64_t(1) << 31)) return kTooManyEntries;
    raster.first_entries[tiles] = uint32_t(entries);
    uint32_t slots = 0;
    for (int chunk = 0; chunk < chunks; ++chunk) {
        const uint32_t here = raster.chunk_slots[chunk];
        raster.chunk_slots[chunk] = slots;
        slots += here;
    }
    raster.entries.resize(entries);
    raster.tile_splats.resize(entries + kLanes);  // read a whole register of splats at a time
    raster.tile_splats[entries] = {0, 0, 0, 0, 0, 2 * kLog2AlphaMin, 0, 0, {}, 0};  // seen by no pixel
    raster.block_bits.resize(words);

    run_parallel(chunks, [&](int chunk, int) {
        uint32_t* next = &raster.counts[size_t(chunk) * tiles];
        const int end = std::min(raster.num_gaussians, (chunk + 1) * raster.chunk);
        uint32_t slot = raster.chunk_slots[chunk];
        for (int gaussian = chunk * raster.chunk; gaussian < end; ++gaussian) {
            const TileRect rect = raster.rects[gaussian];
            if (!rect.count()) continue;
            Splat& splat = raster.splats[gaussian];
            splat.slot_row = rect.width();
            splat.slot_origin = slot - rect.y0 * rect.width() - rect.x0;
            slot += rect.count();
            const uint64_t entry = make_entry(splat.features[3], uint32_t(gaussian));
            for (int y = rect.y0; y < rect.y1; ++y)
                for (int x = rect.x0; x < rect.x1; ++x) raster.entries[next[y * raster.tiles_x + x]++] = entry;
        }
    });
    return 0;
}

}  // namespace core
