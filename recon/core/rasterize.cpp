// The C interface of the rasteriser. recon/rasterize/reference.py checks shapes and types before it is called.
#include "rasterize.h"

#include <ctime>
#include <memory>
#include <mutex>
#include <vector>

#include "threads.h"

namespace core {
namespace {

// Rasters are used again, because their memory costs more to get from the system than to fill.
class RasterPool {
public:
    Raster* take() {
        std::lock_guard<std::mutex> lock(mutex_);
        if (idle_.empty()) return new Raster();
        Raster* raster = idle_.back().release();
        idle_.pop_back();
        return raster;
    }

    void give_back(Raster* raster) {
        std::unique_ptr<Raster> owned(raster);
        std::lock_guard<std::mutex> lock(mutex_);
        if (idle_.size() < kKept) idle_.push_back(std::move(owned));
    }

private:
    static constexpr size_t kKept = 2;
    std::mutex mutex_;
    std::vector<std::unique_ptr<Raster>> idle_;
};

RasterPool& raster_pool() {
    static RasterPool pool;
    return pool;
}

double now(clockid_t clock) {
    timespec time;
    clock_gettime(clock, &time);
    return double(time.tv_sec) + 1e-9 * double(time.tv_nsec);
}

template <class Function>
auto timed(Raster& raster, Stage stage, Function&& function) {
    const double wall = now(CLOCK_MONOTONIC), processor = now(CLOCK_PROCESS_CPUTIME_ID);
    const auto result = function();
    raster.seconds[stage] = now(CLOCK_MONOTONIC) - wall;
    raster.processor_seconds[stage] = now(CLOCK_PROCESS_CPUTIME_ID) - processor;
    return result;
}

}  // namespace
}  // namespace core

using namespace core;

// Renders into `images` (alpha always) and returns 0 and the raster that backward needs, or InputError bits and none.
CORE_API int core_raster_forward(const RasterInput* input, const RasterImages* images, Raster** result) {
    *result = nullptr;
    Raster* raster = raster_pool().take();
    int errors = timed(*raster, kStageProject, [&] { return project(*input, *raster); });
    if (!errors) errors = timed(*raster, kStageBin, [&] { return bin(*raster); });
    if (errors) {
        raster_pool().give_back(raster);
        return errors;
    }
    timed(*raster, kStageBlend, [&] { return blend(*raster, input->channels, *images), 0; });
    *result = raster;
    return 0;
}

// `channels` are those whose gradient is not null. May be called more than once.
CORE_API void core_raster_backward(const RasterInput* input, Raster* raster, int channels, const RasterImages* images,
                                   const RasterImages* image_gradients, RasterGradients* gradients) {
    timed(*raster, kStageBlendBackward, [&] {
        return blend_backward(*raster, channels, *images, *image_gradients), 0;
    });
    timed(*raster, kStageProjectBackward, [&] { return project_backward(*input, *raster, *gradients), 0; });
}

CORE_API void core_raster_release(Raster* raster) { raster_pool().give_back(raster); }

// Of the five stages, in the order of `Stage`, in the raster's last forward and backward: seconds on the clock, then
// seconds of all processors together.
CORE_API void core_raster_seconds(const Raster* raster, double* seconds) {
    for (int stage = 0; stage < kStages; ++stage) {
        seconds[stage] = raster->seconds[stage];
        seconds[kStages + stage] = raster->processor_seconds[stage];
    }
}
