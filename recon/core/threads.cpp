#include "threads.h"

#include <algorithm>
#include <atomic>
#include <condition_variable>
#include <limits>
#include <mutex>
#include <thread>
#include <vector>

#include <unistd.h>

namespace core {
namespace {

thread_local int limit = std::numeric_limits<int>::max();  // Of the calls that this thread makes.

class Pool {
public:
    int size() const { return size_; }

    void resize(int size) {
        std::lock_guard<std::mutex> guard(callers_);
        stop_workers();
        size_ = std::max(1, size);
    }

    void run(int num_tasks, const std::function<void(int, int)>& task) {
        const int allowed = num_threads();
        if (allowed == 1 || num_tasks <= 1) {  // Needs no other thread, and waits for no other caller.
            for (int index = 0; index < num_tasks; ++index) task(index, 0);
            return;
        }
        std::lock_guard<std::mutex> guard(callers_);
        if (process_ != getpid()) abandon_workers();  // A fork keeps the memory but not the threads.
        while (int(workers_.size()) < size_ - 1) start_worker(int(workers_.size()) + 1);
        {
            std::lock_guard<std::mutex> lock(mutex_);
            task_ = &task;
            num_tasks_ = num_tasks;
            allowed_ = allowed;
            next_ = 0;
            running_ = int(workers_.size());
            ++round_;
        }
        wake_.notify_all();
        take_tasks(0);
        std::unique_lock<std::mutex> lock(mutex_);
        done_.wait(lock, [&] { return running_ == 0; });
    }

    ~Pool() {
        if (process_ == getpid()) stop_workers();
        else abandon_workers();
    }

private:
    void start_worker(int thread) {
        process_ = getpid();
        long round = round_;
        workers_.emplace_back([this, thread, round]() mutable {
            for (;;) {
                std::unique_lock<std::mutex> lock(mutex_);
                wake_.wait(lock, [&] { return stopping_ || round_ != round; });
                if (stopping_) return;
                round = round_;
                const bool takes_part = thread < allowed_;
                lock.unlock();
                if (takes_part) take_tasks(thread);
                lock.lock();
                if (--running_ == 0) done_.notify_one();
            }
        });
    }

    void take_tasks(int thread) {
        for (int index = next_++; index < num_tasks_; index = next_++) (*task_)(index, thread);
    }

    void stop_workers() {
        {
            std::lock_guard<std::mutex> lock(mutex_);
            stopping_ = true;
        }
        wake_.notify_all();
        for (std::thread& worker : workers_) worker.join();
        workers_.clear();
        stopping_ = false;
    }

    void abandon_workers() {
        // The handles name threads of the parent process: they can be neither joined nor destroyed here.
        for (std::thread& worker : workers_) new std::thread(std::move(worker));
        workers_.clear();
    }

    std::mutex callers_, mutex_;
    std::condition_variable wake_, done_;
    std::vector<std::thread> workers_;
    const std::function<void(int, int)>* task_ = nullptr;
    std::atomic<int> next_{0};
    std::atomic<int> size_{1};
    int num_tasks_ = 0, allowed_ = 1, running_ = 0;
    long round_ = 0;
    bool stopping_ = false;
    pid_t process_ = getpid();
};

Pool& pool() {
    static Pool instance;
    return instance;
}

}  // namespace

int num_threads() { return std::min(pool().size(), limit); }

void run_parallel(int num_tasks, const std::function<void(int, int)>& task) { pool().run(num_tasks, task); }

void run_ranges(int count, int grain, const std::function<void(int, int, int)>& range) {
    const int num_ranges = (count + grain - 1) / grain;
    run_parallel(num_ranges, [&](int index, int thread) {
        range(index * grain, std::min(count, (index + 1) * grain), thread);
    });
}

}  // namespace core

CORE_API void core_set_threads(int threads) { core::pool().resize(threads); }
CORE_API void core_limit_threads(int threads) {
    core::limit = threads < 1 ? std::numeric_limits<int>::max() : threads;
}
CORE_API int core_get_threads() { return core::num_threads(); }
