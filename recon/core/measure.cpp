// What `python -m tests.bench rasterize` measures against: this processor's arithmetic, and the work of a view.
#include <atomic>
#include <cstdint>
#include <ctime>

#include "threads.h"
#include "tile.h"

namespace core {
namespace {

double thread_seconds() {
    timespec now;
    clock_gettime(CLOCK_THREAD_CPUTIME_ID, &now);
    return double(now.tv_sec) + 1e-9 * double(now.tv_nsec);
}

// Pixels of a tile's blocks that take part of a splat, summed over the splats.
uint64_t count_pairs(const Raster& raster, int tile) {
    const TileSplat* splats = raster.tile_splats.data() + raster.first_entries[tile];
    const TileOrigin origin = tile_origin(raster, tile);
    const uint32_t num_words = raster.num_words(tile);
    const uint64_t* words = raster.block_bits.data() + raster.first_words[tile];
    Buffer<uint32_t> list;
    list.resize(raster.num_entries(tile) + kListPadding);
    uint64_t pairs = 0;
    for (int block = 0; block < kBlocks; ++block) {
        Vec transmittance = initial_transmittance(raster.camera, origin, block);
        const uint32_t count =
            list_splats(words + block * num_words, num_words, invisible_place(raster, tile), list.data());
        for (uint32_t first = 0; first < count; first += kGroup) {
            Vec alphas[kGroup];
            group_alphas(splats, list.data() + first, block_x(block), block_y(block), alphas);
            for (const Vec alpha : alphas) {
                const Vec weight = pass_splat(alpha, open_lanes(transmittance), transmittance);
                pairs += __builtin_popcount(bits(less(Vec{}, weight)));
            }
        }
    }
    return pairs;
}

}  // namespace
}  // namespace core

using namespace core;

// Floating point operations per second of one core: chains of fused multiply-adds that wait for nothing else.
CORE_API double core_peak_flops() {
    constexpr int kChains = 12, kRounds = 2000000;
    Vec chains[kChains];
    for (int i = 0; i < kChains; ++i) chains[i] = splat(float(i));
    volatile float factor_source = 0.999f, addend_source = 0.001f;  // not known to the compiler
    const Vec factor = splat(factor_source), addend = splat(addend_source);
    const double start = thread_seconds();
    for (int round = 0; round < kRounds; ++round)
        for (Vec& chain : chains) chain = chain * factor + addend;
    const double seconds = thread_seconds() - start;
    Vec sum{};
    for (const Vec& chain : chains) sum += chain;
    volatile float sink = sum[0];
    (void)sink;
    return 2.0 * kLanes * kChains * kRounds / seconds;
}

CORE_API int core_lanes() { return kLanes; }

// (pixel, Gaussian) pairs that a view blends: alpha at least 1/255, and light left.
CORE_API int64_t core_raster_pairs(const Raster* raster) {
    std::atomic<int64_t> pairs{0};
    run_parallel(raster->num_tiles(), [&](int tile, int) { pairs += int64_t(count_pairs(*raster, tile)); });
    return pairs;
}

// (block, Gaussian) pairs: what a register is filled for.
CORE_API int64_t core_raster_block_pairs(const Raster* raster) {
    int64_t pairs = 0;
    for (int tile = 0; tile < raster->num_tiles(); ++tile) {
        const uint64_t* words = raster->block_bits.data() + raster->first_words[tile];
        for (uint32_t word = 0; word < kBlocks * raster->num_words(tile); ++word)
            pairs += __builtin_popcountll(words[word]);
    }
    return pairs;
}

CORE_API int64_t core_raster_entries(const Raster* raster) { return raster->first_entries[raster->num_tiles()]; }
