// SPDX-License-Identifier: GPL-3.0-or-later
#include "kdtree/parallel.h"

#include <sched.h>
#include <unistd.h>

#include <memory>
#include <system_error>
#include <thread>
#include <vector>

#include "geometry/float_environment.h"

namespace espalier {
namespace {

/// Looks at a value this often before it goes to sleep over it.
constexpr int kSpins = 40000;

void pause_briefly() {
#if defined(__x86_64__)
    _mm_pause();
#elif defined(__aarch64__)
    asm volatile("yield");
#endif
}

/// One thread that sleeps until it is given a body to run.
struct alignas(64) Worker {
    std::atomic<uint32_t> ticket{0};
    void (*body)(void*, int) = nullptr;
    void* context = nullptr;
};

class Pool {
 public:
    void run(int threads, void (*body)(void*, int), void* context) {
        const std::unique_lock lock(mutex_, std::try_to_lock);
        if (!lock) {  // another caller has the workers: better alone than waiting, deaf to cancels, for its end
            body(context, 0);
            return;
        }
        const int helpers = grow(threads - 1);
        remaining_.store(static_cast<uint32_t>(helpers), std::memory_order_relaxed);
        for (int i = 0; i < helpers; ++i) {
            Worker& worker = *workers_[static_cast<size_t>(i)];
            worker.body = body;
            worker.context = context;
            worker.ticket.fetch_add(1, std::memory_order_release);
            worker.ticket.notify_one();
        }
        body(context, 0);
        for (uint32_t left = remaining_.load(std::memory_order_acquire); left != 0;
             left = remaining_.load(std::memory_order_acquire)) {
            wait_while_equal(remaining_, left);
        }
    }

 private:
    /// Makes up to `count` workers; returns how many of them there are. A machine that gives no more threads gets on
    /// with those it has.
    int grow(int count) {
        workers_.reserve(static_cast<size_t>(count));
        while (workers_.size() < static_cast<size_t>(count)) {
            const int index = static_cast<int>(workers_.size()) + 1;
            auto worker = std::make_unique<Worker>();
            try {
                std::thread(&Pool::serve, this, worker.get(), index).detach();
            } catch (const std::system_error&) {
                break;
            }
            workers_.push_back(std::move(worker));
        }
        return std::min(count, static_cast<int>(workers_.size()));
    }

    void serve(Worker* worker, int index) {
        const FloatEnvironment environment;
        is_worker = true;
        for (uint32_t seen = 0;; ++seen) {
            wait_while_equal(worker->ticket, seen);
            worker->body(worker->context, index);
            if (remaining_.fetch_sub(1, std::memory_order_acq_rel) == 1) {
                remaining_.notify_all();
            }
        }
    }

    std::mutex mutex_;
    std::vector<std::unique_ptr<Worker>> workers_;
    std::atomic<uint32_t> remaining_{0};

 public:
    static thread_local bool is_worker;  ///< this thread already runs a body: what it starts, it runs alone
};

thread_local bool Pool::is_worker = false;

/// Kept to the end of the process, since its threads are; made anew in a forked child, which has none of them.
Pool& pool() {
    static std::mutex mutex;
    static Pool* instance = nullptr;
    static pid_t owner = 0;
    const std::lock_guard lock(mutex);
    if (instance == nullptr || owner != ::getpid()) {
        instance = new Pool;
        owner = ::getpid();
    }
    return *instance;
}

}  // namespace

void wait_while_equal(const std::atomic<uint32_t>& value, uint32_t old) {
    for (int spin = 0; spin < kSpins; ++spin) {
        if (value.load(std::memory_order_acquire) != old) {
            return;
        }
        pause_briefly();
    }
    value.wait(old, std::memory_order_acquire);
}

int hardware_threads() {
    cpu_set_t allowed;
    if (::sched_getaffinity(0, sizeof allowed, &allowed) == 0) {
        return std::max(1, CPU_COUNT(&allowed));
    }
    return static_cast<int>(std::max(1U, std::thread::hardware_concurrency()));
}

void run_on_threads(int threads, void (*body)(void* context, int worker), void* context) {
    if (threads <= 1 || Pool::is_worker) {
        body(context, 0);
        return;
    }
    struct NestedCallsRunAlone {
        NestedCallsRunAlone() { Pool::is_worker = true; }
        ~NestedCallsRunAlone() { Pool::is_worker = false; }
    } const guard;
    pool().run(threads, body, context);
}

}  // namespace espalier
