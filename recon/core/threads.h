// A small pool of worker threads shared by every stage of the core.
//
// Workers sleep on a condition variable when there is nothing to do. They never spin: on a robot's busy processor a
// spinning worker takes the core that the next stage needs (measured: it doubled the time of an iteration).
#pragma once

#include <functional>

#if defined(_WIN32)
#define CORE_API extern "C" __declspec(dllexport)
#else
#define CORE_API extern "C" __attribute__((visibility("default")))
#endif

namespace core {

// Number of threads that run_parallel uses for this caller, the caller included: those of the pool, and at most as many
// as core_limit_threads allowed the calling thread.
int num_threads();

// Calls task(index, thread) once for every index in [0, num_tasks). Indices are handed out in order, to whichever
// thread is free, so a result must not depend on `thread` if it is to be the same on every run. `thread` is in
// [0, num_threads()) and at most one task of a call runs with it at a time: use it to pick scratch memory of the call.
// Calls from several threads at once are served one after the other, but a call that may use one thread waits for none.
// A task must not call run_parallel and must not throw.
void run_parallel(int num_tasks, const std::function<void(int index, int thread)>& task);

// The same over [0, count) in ranges of at most `grain`.
void run_ranges(int count, int grain, const std::function<void(int begin, int end, int thread)>& range);

}  // namespace core
