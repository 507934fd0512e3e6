// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <algorithm>
#include <atomic>
#include <cstddef>
#include <cstdint>
#include <exception>
#include <mutex>
#include <type_traits>

namespace espalier {

/// Threads this process may run on at the same time, at least 1.
int hardware_threads();

/// Waits for a change, awake for two milliseconds or so: a build has barriers microseconds apart, and a thread that
/// sleeps takes 50 to wake. Whoever makes the change calls notify_all.
void wait_while_equal(const std::atomic<uint32_t>& value, uint32_t old);

/// Runs body(context, worker) once for each worker in [0, threads), worker 0 being the calling thread, and returns when
/// all have ended. The threads are kept for the next call. While they are busy for another caller, and in calls made
/// from inside a body, worker 0 runs alone.
void run_on_threads(int threads, void (*body)(void* context, int worker), void* context);

/// Calls f(i) or f(i, worker) for each i in [0, count) on at most `threads` threads, the calling one included; worker
/// is in [0, threads). Indices are handed out in order, one at a time, so put the largest work first. The first
/// exception thrown is thrown again here.
template <class F>
void parallel_for(int threads, size_t count, const F& f) {
    struct Context {
        const F* f;
        size_t count;
        std::atomic<size_t> next{0};
        std::mutex mutex;
        std::exception_ptr error;
    } context{&f, count, {}, {}, {}};

    const auto body = [](void* data, int worker) {
        auto& shared = *static_cast<Context*>(data);
        try {
            for (size_t i = shared.next.fetch_add(1, std::memory_order_relaxed); i < shared.count;
                 i = shared.next.fetch_add(1, std::memory_order_relaxed)) {
                if constexpr (std::is_invocable_v<const F&, size_t, int>) {
                    (*shared.f)(i, worker);
                } else {
                    (*shared.f)(i);
                }
            }
        } catch (...) {
            shared.next.store(shared.count, std::memory_order_relaxed);
            const std::lock_guard lock(shared.mutex);
            if (!shared.error) {
                shared.error = std::current_exception();
            }
        }
    };
    const auto useful = static_cast<int>(std::min<size_t>(count, static_cast<size_t>(threads)));
    run_on_threads(useful, body, &context);
    if (context.error) {
        std::rethrow_exception(context.error);
    }
}

}  // namespace espalier
